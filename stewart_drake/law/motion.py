"""The motion that a law is to follow, as a function of the time from now."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_REFERENCE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

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
        pieces: (n, 38) of what was planned in flight, see core/planning.h, in the place of
            `planned`; then comes the reference.
    """

    planned: Trajectory
    reference: Trajectory
    now: float
    pieces: Array | None = None

    def __call__(self, times: Array) -> Array:
        """Return the motion at all of `times`."""
        return np.array([self._at(max(0.0, self.now + t)) for t in times])

    def goal(self, times: Array) -> Array:
        """Return the reference at all of `times`."""
        return np.array([evaluate(self.reference, max(0.0, self.now + t)) for t in times])

    def _at(self, time: float) -> Array:
        if self.pieces is None:
            return evaluate(self.planned, time)
        c, row = core(), np.empty(NUM_REFERENCE)
        if c.lib.stewart_along(len(self.pieces), c.at(self.pieces), time, c.at(row)):
            return row
        return evaluate(self.reference, time)


class Previewed(NamedTuple):
    """A reference as it was followed: instants (p,) in s from its sample, rows (p, 18) there."""

    times: Array
    reference: Array

    @classmethod
    def nothing(cls, times: Array) -> "Previewed":
        """Return one that is not known at any of the instants."""
        return cls(times, np.full((len(times), NUM_REFERENCE), np.nan))


def completed(
    given: Previewed, last: Previewed, timeline: Timeline, geometry: Array | None
) -> Array:
    """Return the reference (p, 18), with numbers for what is NaN or infinite in the given one.

    They lie between the rows next to them in time, of this preview or of the last one, or continue
    one of them. Without any complete row, which is at the start only, they stay missing.

    Args:
        given: for this sample.
        last: what `completed` returned for the sample before, with its instants.
        timeline: period and delay.
        geometry: of the machine, or None where any pose is within reach.
    """
    if np.all(np.isfinite(given.reference)):
        return given.reference
    c, rows = core(), np.empty((len(given.times), NUM_REFERENCE))
    previews, where = (_preview(given), _preview(last)), c.at(geometry)
    times = timeline.period, timeline.eta
    c.lib.stewart_complete(where, *times, previews[0][0], -math.inf, previews[1][0], c.at(rows))
    return rows


def between(a: Array, b: Array, h: float, s: float) -> Array:
    """Return the reference (18,) at the share s of the way between two rows that are h s apart.

    The polynomial of fifth order with their poses, rates and accelerations.
    """
    c, row = core(), np.empty(NUM_REFERENCE)
    c.lib.stewart_between(c.at(a), c.at(b), h, s, c.at(row))
    return row


def interpolated(times: Array, reference: Array, time: float) -> Array:
    """Return the reference (18,) at `time`, between the rows before and after it."""
    c, row = core(), np.empty(NUM_REFERENCE)
    known = _preview(Previewed(times, reference))
    c.lib.stewart_interpolate(known[0], time, c.at(row))
    return row


def _preview(known: Previewed) -> tuple[Any, ...]:
    """Return the `stewart_preview` of core/reference.h, and what it points to."""
    c = core()
    kept = [np.ascontiguousarray(a, np.float64) for a in known]
    return c.ffi.new("stewart_preview *", [len(kept[0]), *map(c.at, kept)]), kept
