"""The motion that a law follows, as a function of the time from now."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.mechanism.trajectories import PlateTrajectory, rows_along
from stewart_drake.types import Array

Motion = Callable[[Array], Array]
"""The reference (p, 18), pose, rates and accelerations, at times (p,) in s from now; some of them
may be negative."""


@dataclass(frozen=True)
class Preview:
    """A motion that is known at the times that a law asks for."""

    times: Array  # (p,) s from now
    reference: Array  # (p, 18)

    def __call__(self, times: Array) -> Array:
        """Return the reference at all of `times`.

        Raises:
            ValueError: at other times.
        """
        asked = times is self.times or np.array_equal(times, self.times)
        if not asked or len(self.reference) != len(times):
            raise ValueError(
                f"preview: got {len(self.reference)} rows for {len(self.times)} instants; "
                f"expected the {len(times)} that the law asks for. A law that plans (see "
                "controller.replan) asks for any instants: give it the motion"
            )
        return self.reference


@dataclass(frozen=True)
class KnownMotion:
    """A motion that is known at all times.

    Attributes:
        planned: trajectory (6, 1) to follow: the catch-up, then the reference.
        reference: trajectory that a new plan leads back to.
        now: s, on the clock of both.
    """

    planned: Trajectory
    reference: Trajectory
    now: float

    def __call__(self, times: Array) -> Array:
        """Return the motion at all of `times`."""
        return rows_along(self.planned, np.maximum(0.0, np.add(self.now, times)))

    def goal(self, times: Array) -> Array:
        """Return the reference at all of `times`."""
        return rows_along(self.reference, np.maximum(0.0, np.add(self.now, times)))

    def compiled(self) -> Any:
        """Return `stewart_known_motion *`, valid as long as this, or None for motions in Python."""
        motions = self.planned, self.reference
        if not all(isinstance(one, PlateTrajectory) for one in motions):
            return None
        given = *(one.data for one in motions), self.now  # type: ignore[attr-defined]
        return core().ffi.new("stewart_known_motion *", given)
