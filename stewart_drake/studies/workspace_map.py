"""The workspace around home and along a motion: singularity measures, travel, sections, scaling.

Rod i pushes the plate with a force along the unit vector r_i at b_i from the centre of mass: the
unit-free wrench w_i = [b_i x r_i / rho; r_i], rho the mean distance of the plate joints from it.
With W = [w_1 ... w_6] and the twist scaled alike, [rho omega; v] in m/s,

    crank rates = A [rho omega; v],    A = diag(1 / (u_i t_i)) W',    t_i = r_i . tangent_i.

A leg at its dead centre has t_i = 0 (serial singularity: it cannot follow); det W = 0 means that
locked cranks do not hold the plate (parallel singularity). Singular values of A need no angles and
do not change with the frame; by rho they do not change with the machine's size either.
"""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory
from scipy.ndimage import label

from stewart_drake.dynamics.workspace import (
    Failure,
    border,
    diagnose,
    home_sign,
    margin,
    margins,
    measures_at,
)
from stewart_drake.mechanism.geometry import Mechanism, plate_radius
from stewart_drake.mechanism.kinematics import LegGeometry, Legs, legs_along, reach_margins
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.signals import COORDINATES, NUM_COORDINATES
from stewart_drake.types import Array, Flags

SECTIONS: Final = ((3, 4), (3, 5), (0, 1), (2, 5))
"""Pairs of coordinates: x-y, x-z, roll-pitch, yaw-z; the other four stay as at home."""
POINTS: Final = 51
"""Poses along each side of a section."""
LARGEST_FACTOR: Final = 3.0
"""Largest factor on an amplitude that is tried."""
FACTOR_STEP: Final = 0.05
"""Step of the scan for the first amplitude that does not fit."""
_STEPS: Final = 200
_BISECTIONS: Final = 30
_WIDER: Final = 2.0
"""Width of the first look at a section, in travels: a tilted plate may have more room."""
_ROUGH: Final = 31
_RIM: Final = 0.06
_TIME_TOLERANCE: Final = 1e-9
_FACTOR_TOLERANCE: Final = 1e-6


# ---------------------------------------------------------------- poses


class Measures(NamedTuple):
    """Measures of poses; NaN from `transmission` on outside the workspace.

    Those of one pose are without the first dimension.
    """

    reach: Array  # (n, 6) reach margin of each leg, m, negative out of reach
    sines: Array  # (n, 6) of the cranks' angles off dead centre, negative out of reach
    parallel: Array  # (n,) det W, positive at home, 0 at a parallel singularity
    margin: Array  # (n,) positive inside the workspace, see `dynamics.workspace.margin`
    transmission: Array  # (n, 6) |r . tangent|: share of a crank's push along its rod
    # (n,) least singular value of W: how firmly the rods hold the plate in their weakest direction
    held: Array
    # (n,) largest over least singular value of A; 1 for a machine that is alike in all directions
    condition: Array
    # (n,) m per rad, 1 / least singular value of A: how far crank errors of norm 1 move the plate
    play: Array


def wrenches(mechanism: Legs, legs: LegGeometry) -> Array:
    """Return W (..., 6, 6), a column per rod, of the legs at some poses."""
    moments = np.cross(legs.p_PQ_W, legs.rod) / plate_radius(mechanism)
    return np.concatenate([moments, legs.rod], axis=-1).swapaxes(-1, -2)


def rate_gains(mechanism: Legs, legs: LegGeometry, W: Array) -> Array:
    """Return the singular values (..., 6) of A, the largest first."""
    A = W.swapaxes(-1, -2) / (mechanism.crank_lengths * legs.transmission)[..., None]
    return np.asarray(np.linalg.svd(A, compute_uv=False), dtype=np.float64)


def measure(mechanism: Mechanism, poses: Array) -> Measures:
    """Return all measures of a pose (6,) or of poses (n, 6), which may be out of reach."""
    poses, one = np.reshape(poses, (-1, NUM_COORDINATES)), np.ndim(poses) == 1
    now = [measures_at(mechanism, pose) for pose in poses]
    sines, parallel = np.array([at.sines for at in now]), np.array([at.parallel for at in now])
    margin, sign = np.array([at.margin for at in now]), home_sign(mechanism) or 1.0
    inside, rest = margin > 0, np.full((len(poses), 9), np.nan)
    legs = legs_along(mechanism, poses[inside])
    W = wrenches(mechanism, legs)
    gains, held = rate_gains(mechanism, legs, W), np.linalg.svd(W, compute_uv=False)[:, -1]
    condition, play = gains[:, 0] / gains[:, -1], 1 / gains[:, -1]
    rest[inside] = np.column_stack([np.abs(legs.transmission), held, condition, play])
    columns = (
        reach_margins(mechanism, poses),
        sines,
        sign * parallel,
        margin,
        rest[:, :6],
        *rest[:, 6:].T,
    )
    return Measures(*(column[0] if one else column for column in columns))


# ---------------------------------------------------------------- along a motion


def first_exit(mechanism: Mechanism, reference: Trajectory, time: Array) -> Failure | None:
    """Return why a reference leaves the workspace, and when to 1e-9 s; None if it never does.

    An excursion that is shorter than the spacing of `time` (n,) can go unseen.
    """

    def failure(t: float) -> Failure | None:
        return diagnose(mechanism, float(t), reference.value(t)[:, 0])

    for k, t in enumerate(time):
        if failure(t) is not None:
            before = time[max(k - 1, 0)]
            return failure(border(lambda s: failure(s) is None, before, t, _TIME_TOLERANCE)[1])
    return None


def largest_factor(mechanism: Mechanism, reference: Trajectory, time: Array) -> float:
    """Return the largest f so that X(0) + f (X(t) - X(0)) is inside at all of `time` (n,).

    It is NaN for a motion that does not move; 0 if the first pose is outside; `LARGEST_FACTOR`, the
    largest one that is tried, if that much fits.

    For a sine, f scales its amplitude. Workspaces are not convex: a motion that does not fit may
    fit again when it is larger. So f is the end of the first range that fits, found by a scan in
    steps of `FACTOR_STEP` and bisection; a gap narrower than a step can go unseen.
    """
    poses = poses_along(reference, time)
    change = poses - poses[0]

    def fits(factor: float) -> bool:
        return bool(np.all(margins(mechanism, poses[0] + factor * change) > 0))

    if not fits(0.0):
        return 0.0
    if not change.any():
        return math.nan
    steps = round(LARGEST_FACTOR / FACTOR_STEP)
    return last_inside(fits, LARGEST_FACTOR, steps, _FACTOR_TOLERANCE)


def last_inside(
    inside: Callable[[float], bool], limit: float, steps: int = _STEPS, tolerance: float = 0.0
) -> float:
    """Return the largest s in [0, limit] with everything before it inside.

    The scan finds the first exit unless one is narrower than a step; `inside(0)` holds. The
    default tolerance is that of 30 bisections of a step.
    """
    step = limit / steps
    last = next((k for k in range(steps) if not inside((k + 1) * step)), None)
    if last is None:
        return limit
    return border(inside, last * step, (last + 1) * step, tolerance or step / 2**_BISECTIONS)[0]


# ---------------------------------------------------------------- around home


class Travel(NamedTuple):
    """Travel of one coordinate from home while the others stay, rad or m from home.

    `low_reason` and `high_reason` say what ends it; empty if nothing did within half a turn or a
    rod's length.
    """

    coordinate: str
    low: float
    high: float
    low_reason: str
    high_reason: str


class Section(NamedTuple):
    """Section of the workspace through home; arrays (len(y), len(x)), axes in rad or m.

    `first` and `second` are the indices of the coordinates along x and y. `condition` is NaN
    outside the part that is connected with home within the section; `margin` is positive in that
    part and zero on its border, see `dynamics.workspace.margin`.
    """

    first: int
    second: int
    x: Array
    y: Array
    condition: Array
    margin: Array


def travel(mechanism: Mechanism) -> list[Travel]:
    """Return the travel of all six coordinates; empty for a home pose outside the workspace."""
    home = mechanism.home
    if diagnose(mechanism, 0.0, home) is not None:
        return []

    def end(direction: Array, limit: float) -> tuple[float, str]:
        last = last_inside(lambda s: margin(mechanism, home + s * direction) > 0, limit)
        failure = diagnose(mechanism, 0.0, home + (last + 1e-6 * limit) * direction)
        return last, "" if last == limit or failure is None else failure.reason

    limits = [np.pi] * 3 + [float(mechanism.rod_lengths.max())] * 3
    found = []
    for name, axis, limit in zip(COORDINATES, np.eye(NUM_COORDINATES), limits, strict=True):
        (low, why_low), (high, why_high) = end(-axis, limit), end(axis, limit)
        found.append(Travel(name, -low, high, why_low, why_high))
    return found


def sections(mechanism: Mechanism, points: int = POINTS) -> list[Section]:
    """Return the sections `SECTIONS`; empty for a home pose outside the workspace."""
    spans = [(t.low, t.high) for t in travel(mechanism)]
    return [_section(mechanism, pair, spans, points) for pair in SECTIONS if spans]


def poses_in_section(mechanism: Mechanism, pair: tuple[int, int], x: Array, y: Array) -> Array:
    """Return poses (len(y), len(x), 6) as at home but for the pair of coordinates."""
    poses = np.tile(mechanism.home, (len(y), len(x), 1))
    poses[..., list(pair)] = np.stack(np.meshgrid(x, y), axis=-1)
    return poses


def _section(
    mechanism: Mechanism, pair: tuple[int, int], spans: list[tuple[float, float]], points: int
) -> Section:
    home = mechanism.home[list(pair)]
    x_range, y_range = (
        (home[i] + _WIDER * spans[k][0], home[i] + _WIDER * spans[k][1]) for i, k in enumerate(pair)
    )

    # Twice: over a window that is surely too large, then over the part that the workspace fills.
    for number in (_ROUGH, points):
        x, y = np.linspace(*x_range, number), np.linspace(*y_range, number)
        poses = poses_in_section(mechanism, pair, x, y)
        inside = margins(mechanism, poses.reshape(-1, NUM_COORDINATES)).reshape(number, number)
        connected = _connected(inside > 0, np.hypot(*np.meshgrid(x - home[0], y - home[1])))
        x_range, y_range = _window(x, connected), _window(y, connected.T)
    condition = np.full(connected.shape, np.nan)
    condition[connected] = measure(mechanism, poses[connected]).condition
    return Section(*pair, x, y, condition, np.where(connected, inside, -np.abs(inside)))


def _connected(inside: Flags, distance: Array) -> Flags:
    """Return the part of `inside` that holds the point nearest to home."""
    if not inside.any():
        return inside
    parts, _ = label(inside)
    nearest = np.unravel_index(np.where(inside, distance, np.inf).argmin(), inside.shape)
    return np.asarray(parts == parts[nearest])


def _window(axis: Array, inside: Flags) -> tuple[float, float]:
    """Return the part of an axis over the inside, with a rim; all of it if nothing is inside."""
    used = np.asarray(inside.any(axis=0))
    ends = axis[used][[0, -1]] if used.any() else axis[[0, -1]]
    rim = axis[1] - axis[0] + _RIM * (ends[1] - ends[0])
    return float(ends[0] - rim), float(ends[1] + rim)
