"""Margins of a scenario's delayed LQI loop over the delay: peaks, gain, phase, delay."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.law.delay_model import DelayedModel
from stewart_drake.law.error_model import double_integrators, linear_model
from stewart_drake.law.riccati import law_gain
from stewart_drake.law.stability import (
    LinearLoop,
    Peak,
    frequency_grid,
    loop_gain,
    peaks,
    sensitivity,
    spectral_radius,
    worst_margins,
)
from stewart_drake.loop.experiment import believed_delay, true_dynamics
from stewart_drake.loop.law_design import quadratic_cost
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.studies.verdict import Basis
from stewart_drake.types import Array

DELAYS: Final = (0, 1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 25, 30)
"""Delays in periods for which the loop is judged; the scenario's is added."""
_POINTS: Final = 800
"""Number of frequencies of a motor's loop for python-control, without some low ones."""
_BEYOND: Final = 1.1
"""End of the grid in Nyquist frequencies, for a crossing right at Nyquist's."""


class MotorMargins(NamedTuple):
    """Worst margins of the six loops that are cut at one motor."""

    gain_up: float
    """Factor by which the motor may be stronger, > 1."""
    gain_down: float
    """Factor by which it may be weaker, < 1, 0 where it may fail."""
    phase: float
    """Degrees."""


@dataclass(frozen=True)
class LoopMargins:
    """Margins of the loop of one delay.

    Attributes:
        steps: mu.
        radius: spectral radius of the closed loop.
        S, T: peaks of sensitivity and complementary sensitivity at the motors.
        gain_up, gain_down: factors on the torques of all motors.
        motor: classical margins of one motor at a time; None if the loop is unstable.
        later, earlier: errors of the believed delay, s.
    """

    steps: int
    radius: float
    S: Peak
    T: Peak
    gain_up: float
    gain_down: float
    motor: MotorMargins | None
    later: float
    earlier: float

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "mu": self.steps,
            "spectral_radius": self.radius,
            "sensitivity_peak": self.S.value,
            "sensitivity_frequency": self.S.frequency,
            "complementary_peak": self.T.value,
            "complementary_frequency": self.T.frequency,
            "gain_margin": [self.gain_down, self.gain_up],
            "motor_gain_margin": self.motor and [self.motor.gain_down, self.motor.gain_up],
            "motor_phase_margin_deg": self.motor and self.motor.phase,
            "delay_margin_later": self.later,
            "delay_margin_earlier": self.earlier,
        }


def loop_margins(found: Basis, delays: Iterable[int] = DELAYS) -> list[LoopMargins]:
    """Judge the loop over the delay, linearised at the reference's first pose, held still.

    The law is designed as the scenario's controller (model, prediction, weights, believed delay)
    and closed around the true plant. An estimator is assumed to have found payload and friction.

    Raises:
        RiccatiError: the Riccati equation has no solution.
        numpy.linalg.LinAlgError: no torques hold the plate at that pose.
    """
    experiment, sc = found.experiment, found.experiment.scenario
    c, pose = sc.controller, evaluate(experiment.reference, 0.0)[POSE]
    plant = linear_model(*true_dynamics(experiment).linearize(pose))
    known = true_dynamics(experiment) if c.estimate else experiment.nominal
    predictor = design = linear_model(*known.linearize(pose))
    if c.model == "paper":
        design = double_integrators(torque_map(experiment.mechanism, pose, c.torque_map))
    if c.prediction == "linear":
        predictor = design
    weights = quadratic_cost(experiment, found.torque).matrices(np.array([c.w_Q, c.w_R]))
    judged = []
    for steps in sorted({*delays, sc.delay.steps}):
        believed = believed_delay(replace(sc, delay=replace(sc.delay, steps=steps)))
        K = law_gain(design, predictor, c.period, believed, weights)
        loop = LinearLoop(plant, K, c.period, Delay(steps, sc.delay.fraction), c.integral)
        judged.append(_judge(loop))
    return judged


def _judge(loop: LinearLoop) -> LoopMargins:
    radius, true = spectral_radius(loop.matrix()), loop.sampled()
    unknown = Peak(math.nan, math.nan)
    S, T = peaks(true, loop.K, loop.period) if radius < 1 else (unknown, unknown)
    margins = worst_margins([loop])
    return LoopMargins(
        steps=loop.delay.steps,
        radius=radius,
        S=S,
        T=T,
        gain_up=margins.gain_up,
        gain_down=margins.gain_down,
        motor=_motor_margins(true, loop.K, loop.period) if radius < 1 else None,
        later=margins.longer,
        earlier=margins.shorter,
    )


def _motor_margins(plant: DelayedModel, K: Array, period: float) -> MotorMargins:
    """Return the worst margins of six single loops, from their frequency responses.

    With the other five closed, the loop of motor i is L_i = 1 / S_ii - 1.
    """
    import control

    nyquist = np.pi / period
    evenly = np.linspace(0.0, _BEYOND * nyquist, _POINTS)[1:]
    grid = np.union1d(frequency_grid(period, _POINTS // 8), evenly)
    S = sensitivity(loop_gain(plant, K, np.exp(1j * grid * period)))
    up, down, phase = math.inf, 0.0, math.inf
    for motor in range(S.shape[1]):
        response = control.frd(1 / S[:, motor, motor] - 1, grid, smooth=True)
        gains, phases, *_ = control.stability_margins(response, returnall=True)
        up = min([up, *gains[gains > 1]])
        down = max([down, *gains[gains < 1]])
        phase = min([phase, *np.abs(phases)])
    return MotorMargins(float(up), float(down), float(phase))
