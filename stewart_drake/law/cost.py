"""Cost that the gain minimises, and the gain."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from stewart_drake.law.delay_model import DelayedModel, delayed_model
from stewart_drake.law.error_model import ContinuousModel
from stewart_drake.law.riccati import prediction_matrix, reduced_gain
from stewart_drake.law.timeline import Timeline
from stewart_drake.types import Array


class Cost(Protocol):
    """A kind of gain. Instances are immutable."""

    @property
    def integrates(self) -> bool:
        """Whether the law has an integral."""
        ...

    def regulated(self, integral: Array) -> Array:
        """Return the part of an integral (6,) that the gain multiplies: all or nothing."""
        ...

    def sampled(self, model: ContinuousModel, timeline: Timeline) -> DelayedModel:
        """Return a model of error, rates and, if there is one, integral."""
        ...

    def gain(self, model: DelayedModel, weights: Array) -> Array:
        """Return the gain (6, n) for a model from `sampled` and w_Q and w_R (2,).

        It multiplies [error; integral; the torque that is still to act], see
        `law.riccati.reduced_gain`.
        """
        ...


def law_gain(
    cost: Cost,
    design: ContinuousModel,
    predictor: ContinuousModel,
    timeline: Timeline,
    weights: Array,
) -> Array:
    """Return K P (m, n + m L): the gain of one model on the prediction of another.

    Args:
        cost: that has the gain.
        design: model of the gain.
        predictor: model of the prediction.
        timeline: with the delay that the law assumes.
        weights: (2,) w_Q and w_R.

    Raises:
        RiccatiError: no gain was found.
    """
    K = cost.gain(cost.sampled(design, timeline), weights)
    return K @ prediction_matrix(cost.sampled(predictor, timeline))


@dataclass(frozen=True)
class QuadraticCost:
    """w_Q [e; z]' Q [e; z] + w_R T' R T, with diagonal Q and R.

    Attributes:
        errors: (6,) scale of the pose error, 1 / s^2.
        integrals: (6,) scale of its integral, or None for a law without one.
        torques: (6,) scale of the torques.
    """

    errors: Array
    integrals: Array | None
    torques: Array

    @property
    def integrates(self) -> bool:
        """Whether the law has an integral."""
        return self.integrals is not None

    def regulated(self, integral: Array) -> Array:
        """Return the part of an integral (6,) that the gain multiplies: all or nothing."""
        return integral if self.integrates else np.empty(0)

    def matrices(self, weights: Array) -> tuple[Array, Array]:
        """Return w_Q Q and w_R R for w_Q and w_R (2,)."""
        Q, R = self._unweighted
        return weights[0] * Q, weights[1] * R

    @cached_property
    def _unweighted(self) -> tuple[Array, Array]:
        scales = [self.errors] if self.integrals is None else [self.errors, self.integrals]
        return np.diag(np.concatenate(scales)), np.diag(self.torques)

    def sampled(self, model: ContinuousModel, timeline: Timeline) -> DelayedModel:
        """Return `law.delay_model.delayed_model`, with the integral if there is one.

        Raises:
            FloatingPointError: the model cannot be sampled.
        """
        period, steps, fraction = timeline.period, timeline.steps, timeline.fraction
        return delayed_model(model, period, steps, fraction, integral=self.integrates)

    def gain(self, model: DelayedModel, weights: Array) -> Array:
        """Return `law.riccati.reduced_gain` of a model from `sampled`.

        Raises:
            RiccatiError: no gain was found.
        """
        return reduced_gain(model, *self.matrices(weights))
