"""Replanning: a path back onto the reference during the motion, see core/replan.h."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from stewart_drake.files.arguments import fixed, positive
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import periods_of
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_COORDINATES
from stewart_drake.types import Array

SURE = 0.03
"""Largest standard deviation of a predicted pose from which to plan, as a share of the motion."""


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
        """
        ...


@dataclass(frozen=True)
class NoPlanner:
    """Follows the requested motion."""


@dataclass(frozen=True)
class Replan:
    """Plans a path back where the prediction is off the reference.

    Attributes:
        duration: of the plan, s. It is doubled while the plan exceeds the motors' limit.
        longest: largest duration, s. A plan that still exceeds the limit is not made.
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
