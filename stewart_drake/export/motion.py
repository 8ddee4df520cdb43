"""A motion as knots of a piecewise polynomial of fifth order, for C.

The polynomial has pose, rates and accelerations of the motion at both knots. Between them it is off
by O(h^6) where the motion is smooth; where it is not, or h is too long, knots come closer.
"""

from itertools import pairwise
from typing import Final

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.law.motion import between
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

TOLERANCE: Final = 1e-7
"""Tolerance, as a share of the largest value of a coordinate, rate or acceleration."""
LONGEST: Final = 0.5
"""Longest time between two knots, s."""
_HALVES: Final = 16
"""Largest number of halvings of LONGEST, as at a jump of the motion."""
_LOOKS: Final = (0.21, 0.5, 0.79)
"""Shares of the time between two knots at which the polynomial is compared."""


def knots(motion: Trajectory, end: float) -> Array:
    """Return times and motion (n, 19) at sufficiently close knots."""
    number = max(1, int(np.ceil(end / LONGEST)))
    coarse = np.linspace(0.0, end, number + 1)
    rows = [_row(motion, t) for t in coarse]
    size = np.abs(np.array(rows)[:, 1:]).max(axis=0)
    size = np.maximum(size, 1e-3 * size.reshape(3, 6).max(axis=1).repeat(6) + 1e-9)
    found = [rows[0]]
    for before, after in pairwise(rows):
        _refine(motion, before, after, size, found, _HALVES)
    return np.array(found)


def _row(motion: Trajectory, time: float) -> Array:
    return np.append(time, evaluate(motion, time))


def _refine(
    motion: Trajectory, a: Array, b: Array, size: Array, found: list[Array], halves: int
) -> None:
    """Append the knots after `a`, up to `b`."""
    span = b[0] - a[0]
    off = [
        np.abs(between(a[1:], b[1:], span, share) - evaluate(motion, a[0] + share * span)) / size
        for share in _LOOKS
    ]
    if np.max(off) > TOLERANCE and halves > 0:
        middle = _row(motion, a[0] + span / 2)
        _refine(motion, a, middle, size, found, halves - 1)
        _refine(motion, middle, b, size, found, halves - 1)
    else:
        found.append(b)
