"""Planning, during the motion, of a way back onto the reference.

The prediction can be far off the reference, for example when the delay has just been found or has
changed. Feedback of such an error through a long delay responds badly. The torques in flight cannot
be changed, so `law.catch_up` plans a motion from the instant at which the next one acts. Torques
that are constant over each period follow it without error. The law then follows the predicted
motion, the plan, and the reference: no error is left to feed back, and the integral starts at 0.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.files.arguments import fixed, positive
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import Model, periods_of
from stewart_drake.law.compiled import machine_of, numbers
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE
from stewart_drake.types import Array

EARLY = 0.5
"""No torque arrives before this share of the assumed delay."""
SURE = 0.03
"""Largest standard deviation of a predicted pose from which to plan, as a share of the motion."""
UNPUNCTUAL = 2.0
"""Factor on the weight of torques above which no plan is made."""
ROUNDING = 1e-3
"""Periods; an instant that is nearer to a sample is there."""


class FollowedMotion(NamedTuple):
    """Motion to follow.

    Attributes:
        motion: as a function of the time from now.
        path: (n, 38) pieces of the last plan, see core/planning.h, or None.
        replanned: whether it was made at this sample.
    """

    motion: Motion
    path: Array | None
    replanned: bool


class Planner(Protocol):
    """A kind of planner. Instances are immutable."""

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> FollowedMotion:
        """Return the motion to follow from now on.

        Args:
            path: pieces (n, 38) planned before, or None.
            belief: estimate at this sample.
            in_flight: (n, 6) torques sent before this sample.
            motion: the requested motion.
            plant: model of the plant.
        """
        ...


@dataclass(frozen=True)
class NoPlanner:
    """Follows the requested motion."""

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> FollowedMotion:
        return FollowedMotion(motion, None, False)


@dataclass(frozen=True)
class Replan:
    """Plans a way back where the prediction is off the reference.

    Attributes:
        duration: of the plan, s. It is doubled while the plan exceeds the motors' limit.
        longest: s, up to which; a plan of this length may exceed the limit.
        size: (6,) of the motion, peak to peak, rad and m.
        sure: largest standard deviation of the predicted pose at which a plan is made, as a share
            of the size. A plan from an uncertain state can make things worse.
    """

    duration: float
    longest: float
    size: Array
    sure: float = SURE

    def __post_init__(self) -> None:
        fixed("duration", self.duration, (), 0.0)
        fixed("longest", self.longest, (), 0.0)
        fixed("size", self.size, (NUM_COORDINATES,), 0.0)
        positive("sure", self.sure)

    def lengths(self, period: float) -> tuple[int, int]:
        """Return the usual and the greatest length of a plan in periods, two at least."""
        usual = periods_of(self.duration, period)
        return usual, max(usual, periods_of(self.longest, period))

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> FollowedMotion:
        """Return the motion to follow; a plan takes a `KnownMotion`."""
        if not isinstance(motion, KnownMotion):
            return FollowedMotion(motion, path, False)
        followed = motion if path is None else replace(motion, pieces=path)
        before = FollowedMotion(followed, path, False)
        timeline, c = belief.timeline, core()
        # While the delay is unknown, plan only before a torque can have acted.
        early = motion.now + (1 - ROUNDING) * timeline.period <= EARLY * timeline.eta
        late = belief.settled and belief.caution > UNPUNCTUAL  # late torques would undo a plan
        if late or not (belief.has_state and (belief.settled or early)):
            return before
        schedule = timeline.until_next(timeline.queue(in_flight))
        states = np.vstack([belief.state, plant.predict(belief.state, schedule, belief.parameters)])
        wanted = followed(np.array([timeline.eta]))[0, :NUM_STATE].copy()
        size = np.array(self.size, np.float64)
        # A known delay counts as found from the sample at which the first torque has acted for a
        # period until the next plan.
        acted = timeline.eta + (1 - ROUNDING) * timeline.period
        planned = 0.0 if path is None else path[0, 0]
        first = math.isnan(belief.delay_mean) and motion.now >= acted > planned
        arrays = c.at(size), c.at(states[-1]), c.at(wanted)
        if not c.lib.stewart_is_off(*arrays, belief.found or first):
            return before
        if belief.estimate.uncertain and not self._is_sure(belief, schedule, states, plant):
            return before
        model = Model(plant.dynamics.assuming(belief.parameters))
        given = motion.reference, states[-1], motion.now + timeline.eta, timeline.period
        periods, most = self.lengths(timeline.period)
        plan = model.plan(*given, periods)
        while plan is not None and plan.peak > plant.motors.limit and periods < most:
            periods = min(2 * periods, most)
            plan = model.plan(*given, periods)
        if plan is None:
            return before  # no plan exists from here; it may at the next sample
        pieces = np.vstack([model.way(schedule, states, motion.now), plan.pieces])
        return FollowedMotion(replace(motion, pieces=pieces), pieces, True)

    def _is_sure(
        self, belief: Belief, schedule: TorqueSchedule, states: Array, plant: NominalPlant
    ) -> bool:
        """Return whether the pose after the torques in flight is known well enough."""
        c, machine, number = core(), machine_of(plant), len(schedule.torques)
        w, U = np.linalg.eigh(belief.estimate.covariance)
        L = U * np.sqrt(np.maximum(w, 0.0))
        arrays = [numbers(a) for a in (*schedule, states, belief.parameters, L, self.size)]
        torques, durations, *rest = map(c.at, arrays)
        until_next = c.ffi.new("stewart_schedule *", [number, torques, durations, 0])
        scratch = c.scratch(c.lib.stewart_sure_scratch(len(belief.parameters), number))
        return bool(c.lib.stewart_is_sure(machine.it, until_next, *rest, self.sure, scratch))
