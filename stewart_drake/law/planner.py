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
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import plan_catch_up
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.scenario.trajectories import Piece, through_states
from stewart_drake.types import Array

SURPRISE = 0.02
"""Share of the motion by which a prediction is off the reference, when the delay was just found."""
OFF = 0.08
"""The same at any other time."""

SHORTEST = 1e-6
"""s; a hold that is shorter is no piece of a path."""


class Followed(NamedTuple):
    """What the law is to follow."""

    motion: Motion
    path: Trajectory | None
    """The same as a trajectory, where it was planned in flight."""
    anew: bool
    """Whether it was planned now."""


class Planner(Protocol):
    """A kind of planner. Instances are immutable."""

    def follow(
        self,
        path: Trajectory | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> Followed:
        """What to follow from now on.

        Args:
            path: planned before, or None.
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
        path: Trajectory | None,
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
        path: Trajectory | None,
        belief: Belief,
        in_flight: Array,
        motion: Motion,
        plant: NominalPlant,
    ) -> Followed:
        """See `Planner.follow`; only a `KnownMotion` can be left and come back to."""
        if not isinstance(motion, KnownMotion):
            return Followed(motion, path, False)
        followed = motion if path is None else replace(motion, planned=path)
        before = Followed(followed, path, False)
        if not (belief.has_state and belief.settled):
            return before
        acting = belief.timeline.until_next(belief.timeline.queue(in_flight))
        states = np.vstack([belief.state, plant.predict(belief.state, acting, belief.parameters)])
        wanted = followed(np.array([belief.timeline.eta]))[0, :NUM_STATE]
        away = np.abs(states[-1] - wanted) / np.tile(self.size, 2)
        if not away.max() > (SURPRISE if belief.found else OFF):  # or NaN
            return before
        dynamics = plant.dynamics.assuming(belief.parameters)
        begin = motion.now + belief.timeline.eta
        period = belief.timeline.period
        try:
            plan, span = plan_catch_up(
                dynamics, motion.reference, states[-1], begin, period, self.duration, None
            )
        except (ConfigError, ArithmeticError, np.linalg.LinAlgError):
            return before  # there is none from here; the next sample may see another
        if span == 0:
            return before
        times = motion.now + np.append(0.0, np.cumsum(acting.durations))
        pieces: list[Piece] = []
        for i, torque in enumerate(acting.torques):
            if acting.durations[i] > SHORTEST:
                ends = (
                    np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque))
                    for x in states[i : i + 2]
                )
                pieces.append((float(times[i]), next(ends), float(times[i + 1]), next(ends)))
        whole = through_states(pieces, plan) if pieces else plan
        return Followed(replace(motion, planned=whole), whole, True)
