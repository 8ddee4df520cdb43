"""The way back onto the reference, planned in flight.

When the prediction is far off the reference, as where the delay has just been found or has jumped,
feedback of a large error through a long delay is no good way back. What the torques in flight do
cannot be changed; from the instant on from which the next one acts, `law.catch_up` plans a way that
held torques can follow without error. What is followed from now on is the predicted way, then the
plan, then the reference: there is no error left to feed back, and the integral begins anew.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import Model, periods_of
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array


class Followed(NamedTuple):
    """What the law is to follow."""

    motion: Motion
    path: Array | None
    """(n, 38) pieces of what was planned in flight, see core/planning.h, or None."""
    anew: bool
    """Whether it was planned now."""


class Planner(Protocol):
    """A kind of planner. Instances are immutable."""

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> Followed:
        """What to follow from now on.

        Args:
            path: pieces (n, 38) planned before, or None.
            belief: of now.
            in_flight: (n, 6) torques, before this sample's.
            motion: that is asked for.
            plant: as it is known.
        """
        ...


@dataclass(frozen=True)
class NoPlanner:
    """Follows what is asked for."""

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> Followed:
        """See `Planner.follow`."""
        return Followed(motion, None, False)


@dataclass(frozen=True)
class Rejoin:
    """Plans a way back where the prediction is off.

    Attributes:
        duration: of the plan, s.
        size: (6,) of the motion, peak to peak, rad and m.
    """

    duration: float
    size: Array

    def follow(
        self,
        path: Array | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> Followed:
        """See `Planner.follow`; only a `KnownMotion` can be left and come back to."""
        if not isinstance(motion, KnownMotion):
            return Followed(motion, path, False)
        followed = motion if path is None else replace(motion, pieces=path)
        before = Followed(followed, path, False)
        if not (belief.has_state and belief.settled):
            return before
        timeline, c = belief.timeline, core()
        schedule = timeline.until_next(timeline.queue(in_flight))
        states = np.vstack([belief.state, plant.predict(belief.state, schedule, belief.parameters)])
        wanted = followed(np.array([timeline.eta]))[0, :NUM_STATE].copy()
        where = c.at(np.array(self.size, np.float64)), c.at(states[-1]), c.at(wanted)
        if not c.lib.stewart_is_off(*where, belief.found):
            return before
        model = Model(plant.dynamics.assuming(belief.parameters))
        begin, periods = motion.now + timeline.eta, periods_of(self.duration, timeline.period)
        plan = model.plan(motion.reference, states[-1], begin, timeline.period, periods)
        if plan is None:
            return before  # there is none from here; the next sample may see another
        pieces = np.vstack([model.way(schedule, states, motion.now), plan.pieces])
        return Followed(replace(motion, pieces=pieces), pieces, True)
