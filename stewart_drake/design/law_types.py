"""What the control law is told once (`LawOptions`) and what it carries along (`Memory`)."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.design.estimator import Estimate
from stewart_drake.design.filter_settings import FilterSettings
from stewart_drake.mechanism.torque_map import TorqueMap
from stewart_drake.signals import queue_length

Array = NDArray[np.float64]

VIGOROUS = 2


@dataclass(frozen=True)
class LawOptions:
    """What the controller is and believes; see `config.ControllerConfig` for the options.

    Attributes:
        period: dt in s.
        steps, fraction: the delay that the controller believes in, in periods.
        substeps: Runge-Kutta steps per period of the prediction.
        gentle_torque: N m; where a torque in flight exceeds it, VIGOROUS times as many.
        error_weights: (6,) scale of the pose error in the cost, 1 / s^2.
        integral_weights: (6,) scale of its integral.
        torque_weights: (6,) scale of the torques.
        torque_limit: of each motor in N m, or None.
        filter: settings of the parameter estimator, or None.
    """

    period: float
    steps: int
    fraction: float
    integral: bool
    prediction: Literal["linear", "nonlinear"]
    feedforward: Literal["none", "equilibrium", "inverse_dynamics"]
    model: Literal["paper", "multibody"]
    torque_map: TorqueMap
    substeps: int
    gentle_torque: float
    error_weights: Array
    integral_weights: Array
    torque_weights: Array
    torque_limit: float | None = None
    filter: FilterSettings | None = None

    def substeps_for(self, torques: Array) -> int:
        """Runge-Kutta steps per period for a prediction through these torques (n, 6)."""
        vigorous = np.abs(torques).max(initial=0.0) > self.gentle_torque
        return self.substeps * (VIGOROUS if vigorous else 1)

    @property
    def queue_length(self) -> int:
        """Torques in flight at a sampling instant, as the controller believes."""
        return queue_length(self.steps, self.fraction)


class Counts(NamedTuple):
    """Things that went wrong and were survived."""

    riccati_failures: int = 0
    bad_measurements: int = 0
    saturated_steps: int = 0


@dataclass(frozen=True)
class Memory:
    """What the controller carries from one sample to the next.

    Attributes:
        in_flight: (L + 1, 6) torques, oldest first; the last is the newest. The first (and, where
            eta0 > 0, the second) acted during the last period; the rest is the queue.
        state: (12,) estimated state at the last sample; NaN before the first.
        error: (6,) pose error at the last sample.
        integral: (6,) of the pose error.
        gain: last good feedback gain, or None.
        estimate: of the parameter estimator, or None.
        torque: (6,) last torque.
        weights: (2,) w_Q and w_R that were used.
        counts: see `Counts`.
        seconds: time that the last step took to compute.
    """

    in_flight: Array
    state: Array
    error: Array
    integral: Array
    gain: Array | None
    estimate: Estimate | None
    torque: Array
    weights: Array
    counts: Counts
    seconds: float
