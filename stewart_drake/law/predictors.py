"""Error and integral at the instant from which the next torque acts."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.delay_model import DelayedModel
from stewart_drake.law.error_model import ContinuousModel, linear_model
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.riccati import prediction_matrix
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array


class Ahead(NamedTuple):
    """What the gain multiplies, and where it is designed."""

    point: Array
    """(12,) state to linearise at."""
    error: Array
    """(12,) of the state."""
    integral: Array
    """(6,) of the pose error."""


class Predictor(Protocol):
    """A kind of prediction. Instances are immutable."""

    def samples(self, timeline: Timeline) -> Array:
        """(s,) instants, s from now, at which it compares with the reference, beside now."""
        ...

    def pending(self, timeline: Timeline) -> int:
        """How many of the newest torques in flight enter linearly, by the gain."""
        ...

    def ahead(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> Ahead:
        """Go ahead as far as the gain does not.

        Args:
            belief: of now.
            integral: (6,) of the pose error, now.
            queue: (L, 6) torques in flight, the oldest first.
            wanted: (1 + s, 12) reference now and at `samples`.
            plant: as it is known.
        """
        ...

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """(6, n) on [error; integral; pending torques], of the `reduced_gain` K of a model."""
        ...

    def model(
        self,
        design: ContinuousModel,
        state: Array,
        torque: Array,
        parameters: Array,
        plant: NominalPlant,
    ) -> ContinuousModel:
        """What it comes to where errors are small, about a state (12,) under a torque (6,).

        `design` is the model of the gain there.
        """
        ...


@dataclass(frozen=True)
class LinearPredictor:
    """Leaves it to the gain: that of the whole queue, K_aug, which is the paper's."""

    def samples(self, timeline: Timeline) -> Array:
        """None."""
        return np.empty(0)

    def pending(self, timeline: Timeline) -> int:
        """All."""
        return timeline.queue_length

    def ahead(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> Ahead:
        """What is now."""
        return Ahead(belief.state, belief.state - wanted[0], integral)

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """K_aug = K times the prediction by the model of the gain."""
        return K @ prediction_matrix(model)

    def model(
        self,
        design: ContinuousModel,
        state: Array,
        torque: Array,
        parameters: Array,
        plant: NominalPlant,
    ) -> ContinuousModel:
        """That of the gain."""
        return design


@dataclass(frozen=True)
class NonlinearPredictor:
    """Integrates the exact equations over mu periods, through the torques in flight."""

    def samples(self, timeline: Timeline) -> Array:
        """Every sample until the torque acts."""
        return timeline.samples

    def pending(self, timeline: Timeline) -> int:
        """The one that is still to act for eta0 by then, if any."""
        return timeline.queue_length - timeline.steps

    def ahead(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> Ahead:
        """The integral waits in every period in which a motor is at its limit."""
        x, timeline = belief.state, belief.timeline
        if timeline.steps == 0:
            return Ahead(x, x - wanted[0], integral)
        # The queue ends with the torque that is still to act for eta0 after the last sample.
        schedule = timeline.schedule(queue)
        each = timeline.per_period
        ends = plant.predict(x, schedule, belief.parameters)[each - 1 :: each]
        states = np.vstack([x, ends])
        errors = states - wanted
        added = timeline.period / 2 * (errors[:-1, POSE] + errors[1:, POSE])
        held = [plant.motors.reached(t) for t in schedule.torques.reshape(timeline.steps, -1)]
        integral = integral + added[~np.array(held)].sum(axis=0)
        return Ahead(states[-1], errors[-1], integral)

    def gain(self, K: Array, model: DelayedModel) -> Array:
        """K: the prediction is made."""
        return K

    def model(
        self,
        design: ContinuousModel,
        state: Array,
        torque: Array,
        parameters: Array,
        plant: NominalPlant,
    ) -> ContinuousModel:
        """The equations that it integrates."""
        derivatives = plant.dynamics.derivatives(state[POSE], state[RATES], torque, parameters)
        return linear_model(derivatives.A, derivatives.B)


@dataclass(frozen=True)
class ArrivalPredictor(NonlinearPredictor):
    """Integrates to the very instant from which the next torque acts, whatever part of a period."""

    def pending(self, timeline: Timeline) -> int:
        """None: by then all have acted."""
        return 0

    def ahead(
        self, belief: Belief, integral: Array, queue: Array, wanted: Array, plant: NominalPlant
    ) -> Ahead:
        """The integral goes on from one change of torque to the next."""
        schedule = belief.timeline.until_next(queue)
        states = np.vstack([belief.state, plant.predict(belief.state, schedule, belief.parameters)])
        errors = states - wanted
        added = schedule.durations[:, None] / 2 * (errors[:-1, POSE] + errors[1:, POSE])
        held = [plant.motors.reached(torque) for torque in schedule.torques]
        return Ahead(states[-1], errors[-1], integral + added[~np.array(held)].sum(axis=0))
