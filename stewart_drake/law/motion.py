"""The motion that a law is to follow, as a function of the time from now."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from stewart_drake.scenario.trajectories import evaluate

Array = NDArray[np.float64]
Motion = Callable[[Array], Array]
"""The reference (p, 18), pose, rates and accelerations, at instants (p,) in s from now; some of
them may be negative."""


@dataclass(frozen=True)
class Preview:
    """A motion that is known at some instants only, those that a law asks for.

    Attributes:
        times: (p,) s from now.
        reference: (p, 18) there.
    """

    times: Array
    reference: Array

    def __call__(self, times: Array) -> Array:
        """The reference at all of `times`.

        Raises:
            ValueError: at other instants than those.
        """
        asked = times is self.times or np.array_equal(times, self.times)
        if not asked or len(self.reference) != len(times):
            raise ValueError(
                f"preview: got {len(self.reference)} rows for {len(self.times)} instants; "
                f"expected the {len(times)} that the law asks for"
            )
        return self.reference


@dataclass(frozen=True)
class KnownMotion:
    """A motion that is known at all times.

    Attributes:
        planned: what is followed, a trajectory (6, 1): the way onto the reference, then that.
        reference: what there is to come back to.
        now: s, on the clock of both.
    """

    planned: Trajectory
    reference: Trajectory
    now: float

    def __call__(self, times: Array) -> Array:
        """`planned` at all of `times`."""
        return np.array([evaluate(self.planned, max(0.0, self.now + t)) for t in times])
