"""Prediction of error and integral at the instant at which the next torque begins to act."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.delay_model import ContinuousModel, DelayedModel
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.riccati import prediction_matrix
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.scenario.signals import POSE
from stewart_drake.types import Array


class PredictedState(NamedTuple):
    """State (12,) to linearise at, its error (12,), and the integral (6,) of the pose error."""

    state: Array
    error: Array
    integral: Array


class Predictor(Protocol):
    """A kind of prediction. Instances are immutable."""

    def samples(self, timeline: Timeline) -> Array:
        """Return the instants (s,), s from now, of further comparisons with the reference."""
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
            plant: model of the plant.
        """
        ...

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """Return the gain (6, n) on [error; integral; pending torques] for a `reduced_gain` K."""
        ...

    def model(self, design: ContinuousModel, exact: ContinuousModel) -> ContinuousModel:
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

    def model(self, design: ContinuousModel, exact: ContinuousModel) -> ContinuousModel:
        return design


@dataclass(frozen=True)
class NonlinearPredictor:
    """Integration of the exact equations over mu periods, with the torques in flight.

    A torque that still acts for eta0 by then is left to the gain.
    """

    def samples(self, timeline: Timeline) -> Array:
        return timeline.samples

    def pending(self, timeline: Timeline) -> int:
        return timeline.queue_length - timeline.steps

    def predict(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> PredictedState:
        """Predict; the integral waits in every period with a motor at its limit."""
        x, timeline = belief.state, belief.timeline
        if timeline.steps == 0:
            return PredictedState(x, x - wanted[0], integral)
        schedule, each = timeline.schedule(queue), timeline.per_period
        ends = plant.predict(x, schedule, belief.parameters)[each - 1 :: each]
        periods = TorqueSchedule(
            schedule.torques.reshape(timeline.steps, -1), np.full(timeline.steps, timeline.period)
        )
        return _compared(np.vstack([x, ends]), wanted, periods, integral, plant)

    def gain(self, K: Array, model: DelayedModel) -> Array:
        return K

    def model(self, design: ContinuousModel, exact: ContinuousModel) -> ContinuousModel:
        return exact


@dataclass(frozen=True)
class ArrivalPredictor(NonlinearPredictor):
    """Integration to the exact instant at which the next torque acts, for an estimated delay."""

    def pending(self, timeline: Timeline) -> int:
        return 0

    def predict(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> PredictedState:
        """Predict; the integral continues from one change of torque to the next."""
        schedule = belief.timeline.until_next(queue)
        states = np.vstack([belief.state, plant.predict(belief.state, schedule, belief.parameters)])
        return _compared(states, wanted, schedule, integral, plant)


def _compared(
    states: Array, wanted: Array, schedule: TorqueSchedule, integral: Array, plant: NominalPlant
) -> PredictedState:
    """Return the last of states (1 + n, 12), with the integral over n intervals with torques."""
    errors = states - wanted
    added = schedule.durations[:, None] / 2 * (errors[:-1, POSE] + errors[1:, POSE])
    free = np.array([not plant.motors.reached(torque) for torque in schedule.torques], bool)
    return PredictedState(states[-1], errors[-1], integral + added[free].sum(axis=0))
