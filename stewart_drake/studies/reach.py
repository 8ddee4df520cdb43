"""A reference against the workspace: margins along it, its first exit, its largest amplitude."""

from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.workspace import Failure, diagnose, margin
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.studies.workspace_map import border, last_inside, measure
from stewart_drake.types import Array

LARGEST_FACTOR: Final = 3.0
"""Amplitudes are not scaled up by more."""
FACTOR_STEP: Final = 0.05
"""Of the scan that finds the first amplitude that does not fit."""
_TIME_TOLERANCE: Final = 1e-9
_FACTOR_TOLERANCE: Final = 1e-6


class Margins(NamedTuple):
    """Along a motion at n instants; see `singularity.Measures`, NaN outside the workspace."""

    time: Array
    pose: Array
    """(n, 6) rad and m."""
    reach: Array
    """(n, 6) m."""
    sines: Array
    """(n, 6)"""
    parallel: Array
    transmission: Array
    """(n, 6)"""
    held: Array
    condition: Array
    play: Array
    """m per rad."""


class Factor(NamedTuple):
    """By what the motion can be scaled about its first pose.

    `value` is NaN where nothing moves; 0 where not even the first pose is in the workspace;
    `LARGEST_FACTOR` where that much fits, which `limited` False tells.
    """

    value: float
    limited: bool

    @property
    def told(self) -> str:
        """In words, rounded down, so that the motion that is told does fit."""
        return f"{np.floor(1e3 * self.value) / 1e3:g}"


def margins_along(mechanism: Mechanism, reference: Trajectory, time: Array) -> Margins:
    """All margins of a reference at the instants (n,) in s."""
    poses = np.array([reference.value(t)[:, 0] for t in time])
    rows = [measure(mechanism, pose) for pose in poses]
    columns = {
        name: np.array([getattr(row, name) for row in rows])
        for name in Margins._fields
        if name not in ("time", "pose")
    }
    return Margins(time=time, pose=poses, **columns)


def first_exit(mechanism: Mechanism, reference: Trajectory, time: Array) -> Failure | None:
    """Why a reference leaves the workspace, and when to 1e-9 s; None if it never does.

    An excursion that is shorter than the spacing of `time` (n,) can go unseen.
    """

    def failure(t: float) -> Failure | None:
        return diagnose(mechanism, float(t), reference.value(t)[:, 0])

    for k, t in enumerate(time):
        if failure(t) is not None:
            before = time[max(k - 1, 0)]
            return failure(border(lambda s: failure(s) is None, before, t, _TIME_TOLERANCE)[1])
    return None


def largest_factor(mechanism: Mechanism, reference: Trajectory, time: Array) -> Factor:
    """The largest f for which X(0) + f (X(t) - X(0)) stays in the workspace at all of `time` (n,).

    For a sine, f scales its amplitude. Workspaces are not convex: a motion that does not fit may
    fit again when it is larger. So f is the end of the first range that fits, found by a scan in
    steps of `FACTOR_STEP` and bisection; a gap narrower than a step can go unseen.
    """
    poses = np.array([reference.value(t)[:, 0] for t in time])
    change = poses - poses[0]

    def fits(factor: float) -> bool:
        return all(margin(mechanism, poses[0] + factor * row) > 0 for row in change)

    if not fits(0.0):
        return Factor(0.0, True)
    if not change.any():
        return Factor(np.nan, False)
    steps = round(LARGEST_FACTOR / FACTOR_STEP)
    factor = last_inside(fits, LARGEST_FACTOR, steps, _FACTOR_TOLERANCE)
    return Factor(factor, factor < LARGEST_FACTOR)
