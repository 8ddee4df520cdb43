"""Prediction of error and integral to the time at which the next torque begins to act."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.delay_model import DelayedModel, LinearModel
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.riccati import prediction_matrix
from stewart_drake.law.timeline import Timeline
from stewart_drake.types import Array


class PredictedState(NamedTuple):
    """State (12,) to linearise at, its error (12,), and the integral (6,) of the pose error."""

    state: Array
    error: Array
    integral: Array


class Predictor(Protocol):
    """A kind of prediction. Instances are immutable."""

    def samples(self, timeline: Timeline) -> Array:
        """Return the times (s,), s from now, of further comparisons with the reference."""
        ...

    def pending(self, timeline: Timeline) -> int:
        """Return the number of newest torques in flight that enter linearly, by the gain."""
        ...

    def predict(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> PredictedState:
        """Predict, except for the part that is left to the gain.

        Args:
            belief: now.
            integral: (6,) of the pose error, now.
            queue: (L, 6) torques in flight, oldest first.
            wanted: (1 + s, 12) reference now and at `samples`.
        """
        ...

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """Return the gain (6, n) on [error; integral; pending torques] for a `reduced_gain` K."""
        ...

    def model(self, design: LinearModel, exact: LinearModel) -> LinearModel:
        """Return the linearised prediction, given those of the gain and of the exact equations."""
        ...


@dataclass(frozen=True)
class LinearPredictor:
    """Prediction by the gain of the whole queue, K_aug, as in the paper."""

    def samples(self, timeline: Timeline) -> Array:
        return np.empty(0)

    def pending(self, timeline: Timeline) -> int:
        return timeline.queue_length

    def predict(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> PredictedState:
        return PredictedState(belief.state, belief.state - wanted[0], integral)

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """Return K_aug, K times the prediction by the model of the gain."""
        return K @ prediction_matrix(model)

    def model(self, design: LinearModel, exact: LinearModel) -> LinearModel:
        return design


@dataclass(frozen=True)
class NonlinearPredictor:
    """Integration of the exact equations over mu periods, with the torques in flight (core/law.c).

    A torque that still acts for eta0 then is left to the gain. The integral is constant in each
    period in which a motor is at its limit.
    """

    def samples(self, timeline: Timeline) -> Array:
        return timeline.samples

    def pending(self, timeline: Timeline) -> int:
        return timeline.queue_length - timeline.steps

    def gain(self, K: Array, model: DelayedModel) -> Array:
        return K

    def model(self, design: LinearModel, exact: LinearModel) -> LinearModel:
        return exact


@dataclass(frozen=True)
class ArrivalPredictor(NonlinearPredictor):
    """Integration to the exact time at which the next torque acts, for an estimated delay."""

    def pending(self, timeline: Timeline) -> int:
        return 0
