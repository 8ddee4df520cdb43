"""The motion that a law is to follow, as a function of the time from now."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_REFERENCE,
    POSE,
    RATES,
)
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

Motion = Callable[[Array], Array]
"""The reference (p, 18), pose, rates and accelerations, at instants (p,) in s from now; some of
them may be negative."""

FURTHER = 1.25
"""Times as far as to its rest, a motion that is not known any more has to stay within reach."""
DOUBLINGS = 6
"""Of the rate at which a motion that is not known any more comes to rest, at the most."""


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
    given: Previewed, last: Previewed, timeline: Timeline, reaches: Callable[[Array], bool]
) -> Array:
    """Return the reference (p, 18), with numbers for what is NaN or infinite in the given one.

    They lie between the rows next to them in time, of this preview or of the last one, or continue
    one of them. Without any complete row, which is at the start only, they stay missing.

    Args:
        given: for this sample.
        last: what `completed` returned for the sample before, with its instants.
        timeline: period and delay.
        reaches: whether a pose (6,) is one that the plate can be in.
    """
    times, preview = given
    finite = np.all(np.isfinite(preview), axis=1)
    if np.all(finite):
        return preview
    there = np.all(np.isfinite(last.reference[1:]), axis=1)
    known = np.append(times[finite], last.times[1:][there] - timeline.period)
    rows = np.vstack([preview[finite], last.reference[1:][there]])
    if not len(known):
        return preview.copy()
    rate = 2 / (timeline.eta + timeline.period)
    complete = preview.copy()
    for i in np.flatnonzero(~finite):
        gaps = known - times[i]
        sides = [np.where(gaps <= 0, -gaps, np.inf), np.where(gaps > 0, gaps, np.inf)]
        nearest = [int(np.argmin(side)) for side in sides if np.isfinite(side).any()]
        j, k = nearest[0], nearest[-1]
        if j == k:
            found = _continued(rows[j], -gaps[j], rate, reaches)
        else:
            found = between(rows[j], rows[k], gaps[k] - gaps[j], gaps[j] / (gaps[j] - gaps[k]))
        v, near = preview[i, RATES], [j, k] if j != k else [j]
        if np.all(np.isfinite(v)) and np.all(np.abs(gaps[near]) >= timeline.period / 20):
            # (v1 - v) / h = (a + a1) / 2, to each side
            slopes = 2 * (rows[near][:, RATES] - v) / gaps[near, None]
            found[ACCELERATIONS] = np.mean(slopes - rows[near][:, ACCELERATIONS], axis=0)
        complete[i] = np.where(np.isfinite(preview[i]), preview[i], found)
    return complete


def _continued(row: Array, later: float, w: float, reaches: Callable[[Array], bool]) -> Array:
    """Return the reference (18,) `later` s after a row, coming to rest with the rate w in 1/s.

    From da/dt = -2 w a - w^2 v, with b = a0 + w v0: v = (v0 + b t) e^(-w t). It comes to rest
    (2 v0 + a0 / w) / w away; w doubles until the plate could go FURTHER.
    """
    x, v, a = row[POSE], row[RATES], row[ACCELERATIONS]
    for _ in range(DOUBLINGS):
        if reaches(x + FURTHER * (2 * v + a / w) / w):
            break
        w = 2 * w
    left, b = np.exp(-w * later), a + w * v
    moved = (v * (1 - left) + b / w * (1 - left * (1 + w * later))) / w
    return np.concatenate([x + moved, left * (v + b * later), left * (a - w * b * later)])


def between(a: Array, b: Array, h: float, s: float) -> Array:
    """Return the reference (18,) at the share s of the way between two rows that are h s apart.

    The polynomial of fifth order with their poses, rates and accelerations.
    """
    (p0, v0, a0), (p1, v1, a1) = (row.reshape(3, NUM_COORDINATES) for row in (a, b))
    v0, v1, a0, a1 = h * v0, h * v1, h * h * a0, h * h * a1
    c2, d = a0 / 2, p1 - p0 - v0 - a0 / 2
    e, f = v1 - v0 - a0, a1 - a0
    c3, c4, c5 = 10 * d - 4 * e + f / 2, -15 * d + 7 * e - f, 6 * d - 3 * e + f / 2
    pose = p0 + s * (v0 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
    rates = v0 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))
    accelerations = 2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))
    return np.concatenate([pose, rates / h, accelerations / h**2])


def interpolated(times: Array, reference: Array, time: float) -> Array:
    """Return the reference (18,) at `time`, between the rows before and after it."""
    gaps = times - time
    j = int(np.argmin(np.where(gaps <= 0, -gaps, np.inf)))
    k = int(np.argmin(np.where(gaps > 0, gaps, np.inf)))
    return between(reference[j], reference[k], gaps[k] - gaps[j], gaps[j] / (gaps[j] - gaps[k]))
