"""One linear loop of law and plant, stable or not, and how wrong delay and motors may be.

Near the reference the law, whatever its options, multiplies the error, its integral and the torques
in flight by a constant matrix. With the gain K of the state at which the next torque begins to act
(`law.riccati.reduced_gain`) and the prediction P to there (`law.riccati.prediction_matrix`),

    T_k = -K P [e_k; z_k; T_{k-L} ... T_{k-1}].                                         (law)

K comes from the model the law is designed with, P from the one it predicts with, both with the
delay the law believes in; the plant has its own A, B and delay. (law) around the sampled plant is
`law.limits.closed_loop`: the loop is stable when all its eigenvalues are inside the circle.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

from stewart_drake.law.delay_model import DelayedModel, delayed_model
from stewart_drake.law.error_model import ContinuousModel
from stewart_drake.law.limits import closed_loop, first_instability, is_stable
from stewart_drake.law.riccati import prediction_matrix, reduced_gain
from stewart_drake.scenario.delay import Delay
from stewart_drake.types import Array

_LONGEST_ERROR: Final = 30
"""Periods; a true delay longer than believed by more than this is not looked at."""
_GAIN_LIMIT: Final = 100.0
"""Motors stronger by more than this factor are not looked at."""
_FINEST_DELAY: Final = 1e-4
"""Of the period, and the least error of the motors, with which the search begins."""
_FINEST_GAIN: Final = 1e-3


class Margins(NamedTuple):
    """Errors at which the first eigenvalue leaves the circle; 0 and 1 where one is outside."""

    shorter: float
    """s, by which the true delay may be shorter than it is; infinite where it may be 0."""
    longer: float
    """s, longer; infinite beyond 30 periods."""
    gain_down: float
    """Factor by which all motors together may be weaker, < 1, 0 where they may fail."""
    gain_up: float
    """Stronger, > 1."""


@dataclass(frozen=True)
class LinearLoop:
    """The plant as it is under a law as it is.

    Attributes:
        plant: the true one, without integral states.
        K: (m, n + m L) of (law), which knows the last L torques.
        period: s.
        delay: the true one.
        integral: whether the law integrates the error.
    """

    plant: ContinuousModel
    K: Array
    period: float
    delay: Delay
    integral: bool

    def sampled(self, longer: float = 0.0, step: float | None = None) -> DelayedModel:
        """The plant over one period, its delay longer by so many s, or moved in an engine's steps.

        `step` as of `delayed_model`.
        """
        delay = self.delay
        if longer:
            delay = Delay.of(delay.eta(self.period) + longer, self.period)
        return delayed_model(
            self.plant, self.period, delay.steps, delay.fraction, integral=self.integral, step=step
        )

    def matrix(self, longer: float = 0.0, gain: float = 1.0, step: float | None = None) -> Array:
        """The closed loop, with motors stronger by the factor `gain`; see `sampled`."""
        return closed_loop(self.sampled(longer, step), self.K, gain)


def law_gain(
    design: ContinuousModel,
    predictor: ContinuousModel,
    period: float,
    delay: Delay,
    weights: tuple[Array, Array],
) -> Array:
    """K P (m, n + m L) of (law).

    Args:
        design: model behind the gain.
        predictor: model that predicts, the same for linear prediction.
        period: s.
        delay: that the law believes in.
        weights: Q (p, p) and R (m, m); a Q of twice the outputs asks for the integral.

    Raises:
        RiccatiError: there is no gain.
    """
    Q, R = weights
    integral = len(Q) > len(design.C)
    designed, predicted = (
        delayed_model(model, period, delay.steps, delay.fraction, integral=integral)
        for model in (design, predictor)
    )
    return reduced_gain(designed, Q, R) @ prediction_matrix(predicted)


def worst_margins(loops: Sequence[LinearLoop]) -> Margins:
    """The least margins of several loops, all of the same period and delay."""
    if not all(is_stable(loop.matrix()) for loop in loops):
        return Margins(0.0, 0.0, 1.0, 1.0)
    period = loops[0].period
    eta = loops[0].delay.eta(period)
    finest = _FINEST_DELAY * period

    def least(disturbed: Callable[[LinearLoop, float], Array], start: float, limit: float) -> float:
        found = math.inf
        for loop in loops:
            if math.isfinite(found) and is_stable(disturbed(loop, found)):
                continue  # it bears more than another does
            up_to = min(limit, found)
            found = min(found, first_instability(partial(disturbed, loop), start, up_to))
        return found

    longer = least(lambda loop, by: loop.matrix(longer=by), finest, _LONGEST_ERROR * period)
    shorter = least(lambda loop, by: loop.matrix(longer=-by), finest, eta) if eta else math.inf
    up = least(lambda loop, by: loop.matrix(gain=1 + by), _FINEST_GAIN, _GAIN_LIMIT)
    down = least(lambda loop, by: loop.matrix(gain=1 - by), _FINEST_GAIN, 1.0)
    return Margins(shorter, longer, max(0.0, 1 - down), 1 + up)
