"""The workspace around home: how singular a pose is, travel of each coordinate, and sections.

Rod i pushes the plate with a force along the unit vector r_i at b_i from the centre of mass: the
unit-free wrench w_i = [b_i x r_i / rho; r_i], rho the mean distance of the plate joints from it.
With W = [w_1 ... w_6] and the twist made alike in its parts, [rho omega; v] in m/s,

    crank rates = A [rho omega; v],    A = diag(1 / (u_i t_i)) W',    t_i = r_i . tangent_i.

A leg at its dead centre has t_i = 0 (serial singularity: it cannot follow); det W = 0 means that
locked cranks do not hold the plate (parallel singularity). Singular values of A need no angles and
do not change with the frame; by rho they do not change with the machine's size either.
"""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from stewart_drake.dynamics.workspace import diagnose, home_sign, margin, standing
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import LegGeometry, leg_geometry
from stewart_drake.scenario.signals import COORDINATES, NUM_COORDINATES
from stewart_drake.types import Array


class Measures(NamedTuple):
    """Measures of one pose; NaN from `transmission` on for a pose outside the workspace."""

    reach: Array
    """(6,) reach margin of each leg, m, negative where short."""
    sines: Array
    """(6,) of the cranks' angles off dead centre, 0 there, negative out of reach."""
    parallel: float
    """det W with its sign at home made positive, 0 at a parallel singularity."""
    margin: float
    """Positive inside the workspace, see `dynamics.workspace.margin`."""
    transmission: Array
    """(6,) |r . tangent|: share of a crank's push that goes along its rod."""
    held: float
    """Least singular value of W: how firmly the rods hold the plate in their weakest direction."""
    condition: float
    """Largest over least singular value of A; 1 is a machine alike in all directions."""
    play: float
    """m per rad, 1 / least singular value of A: how far crank errors of norm 1 move the plate."""


def characteristic_length(mechanism: Mechanism) -> float:
    """rho in m, mean distance of the plate joints from the plate's centre of mass."""
    return float(np.linalg.norm(mechanism.p_PQ, axis=1).mean())


def measure(mechanism: Mechanism, pose: Array) -> Measures:
    """All measures of a pose (6,), which may be out of reach."""
    pose = np.asarray(pose, dtype=np.float64)
    now, sign = standing(mechanism, pose), home_sign(mechanism)
    rest = (np.full(6, np.nan), np.nan, np.nan, np.nan)
    if now.margin > 0:
        legs = leg_geometry(mechanism, pose)
        W = wrenches(mechanism, legs)
        A = W.T / (mechanism.crank_lengths * legs.transmission)[:, None]
        values = np.linalg.svd(A, compute_uv=False)
        held = float(np.linalg.svd(W, compute_uv=False)[-1])
        rest = (np.abs(legs.transmission), held, values[0] / values[-1], 1 / values[-1])
    parallel = (sign or 1.0) * now.parallel
    return Measures(mechanism.reach_margins(pose), now.sines, parallel, now.margin, *rest)


def wrenches(mechanism: Mechanism, legs: LegGeometry) -> Array:
    """W (6, 6), a column per rod, of the legs at a pose."""
    moments = np.cross(legs.p_PQ_W, legs.rod) / characteristic_length(mechanism)
    return np.hstack([moments, legs.rod]).T


SECTIONS: Final = ((3, 4), (3, 5), (0, 1), (2, 5))
"""Pairs of coordinates: x-y, x-z, roll-pitch, yaw-z; the other four stay as at home."""
POINTS: Final = 51
"""Poses along each side of a section."""
_STEPS: Final = 200
_BISECTIONS: Final = 30
_WIDER: Final = 2.0
"""A section is first looked for this many travels wide: leaning may give room to shift."""
_ROUGH: Final = 31
_RIM: Final = 0.06


class Travel(NamedTuple):
    """How far one coordinate goes from home while the others stay, rad or m from home.

    `low_reason` and `high_reason` say what ends it; "" where nothing did within half a turn or a
    rod's length.
    """

    coordinate: str
    low: float
    high: float
    low_reason: str
    high_reason: str


class Section(NamedTuple):
    """A section of the workspace through home; arrays (len(y), len(x)).

    `condition` is NaN outside the part that is connected with home within the section; `margin` is
    positive in that part and zero on its border, see `dynamics.workspace.margin`.
    """

    first: int
    """Index of the coordinate along x."""
    second: int
    x: Array
    """rad or m."""
    y: Array
    condition: Array
    margin: Array


def border(
    inside: Callable[[float], bool], low: float, high: float, tolerance: float
) -> tuple[float, float]:
    """Two numbers so close to each other, the first inside and the second not, by bisection."""
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) else (low, middle)
    return low, high


def last_inside(
    inside: Callable[[float], bool], limit: float, steps: int = _STEPS, tolerance: float = 0.0
) -> float:
    """Largest s in [0, limit] with everything before it inside.

    The scan finds the first exit unless one is narrower than a step; `inside(0)` holds. The
    tolerance, if none is given, is that of 30 bisections of a step.
    """
    step = limit / steps
    last = next((k for k in range(steps) if not inside((k + 1) * step)), None)
    if last is None:
        return limit
    return border(inside, last * step, (last + 1) * step, tolerance or step / 2**_BISECTIONS)[0]


def travel(mechanism: Mechanism) -> list[Travel]:
    """The travel of all six coordinates; none from a home pose outside the workspace."""
    if diagnose(mechanism, 0.0, mechanism.home) is not None:
        return []
    limits = [np.pi] * 3 + [float(mechanism.rod_lengths.max())] * 3
    found = []
    for k, limit in enumerate(limits):
        axis = np.eye(NUM_COORDINATES)[k]
        (low, why_low), (high, why_high) = (_end(mechanism, d * axis, limit) for d in (-1, 1))
        found.append(Travel(COORDINATES[k], -low, high, why_low, why_high))
    return found


def sections(mechanism: Mechanism, points: int = POINTS) -> list[Section]:
    """The sections `SECTIONS`; none from a home pose outside the workspace."""
    spans = [(t.low, t.high) for t in travel(mechanism)]
    return [_section(mechanism, pair, spans, points) for pair in SECTIONS if spans]


def _end(mechanism: Mechanism, direction: Array, limit: float) -> tuple[float, str]:
    """How far it goes from home in a direction, and what is there."""
    home = mechanism.home
    end = last_inside(lambda s: margin(mechanism, home + s * direction) > 0, limit)
    failure = diagnose(mechanism, 0.0, home + (end + 1e-6 * limit) * direction)
    return end, "" if end == limit or failure is None else failure.reason


def _section(
    mechanism: Mechanism, pair: tuple[int, int], spans: list[tuple[float, float]], points: int
) -> Section:
    home = mechanism.home[list(pair)]
    x_range, y_range = (
        (home[i] + _WIDER * spans[k][0], home[i] + _WIDER * spans[k][1]) for i, k in enumerate(pair)
    )
    # Twice: over a window that is surely too large, then over what the workspace fills of it.
    for number in (_ROUGH, points):
        x, y = np.linspace(*x_range, number), np.linspace(*y_range, number)
        inside = np.array([[margin(mechanism, _at(mechanism, pair, a, b)) for a in x] for b in y])
        connected = _connected(inside > 0, np.hypot(*np.meshgrid(x - home[0], y - home[1])))
        x_range, y_range = _window(x, connected), _window(y, connected.T)
    condition = np.full(connected.shape, np.nan)
    for j, i in zip(*np.nonzero(connected), strict=True):
        pose = _at(mechanism, pair, float(x[i]), float(y[j]))
        condition[j, i] = measure(mechanism, pose).condition
    return Section(*pair, x, y, condition, np.where(connected, inside, -np.abs(inside)))


def _connected(inside: NDArray[np.bool_], distance: Array) -> NDArray[np.bool_]:
    """The part of `inside` that holds the point nearest to home."""
    if not inside.any():
        return inside
    parts, _ = label(inside)
    nearest = np.unravel_index(np.where(inside, distance, np.inf).argmin(), inside.shape)
    return np.asarray(parts == parts[nearest])


def _window(axis: Array, inside: NDArray[np.bool_]) -> tuple[float, float]:
    """The part of an axis over the inside, with a rim; all of it where nothing is inside."""
    used = np.asarray(inside.any(axis=0))
    ends = axis[used][[0, -1]] if used.any() else axis[[0, -1]]
    rim = axis[1] - axis[0] + _RIM * (ends[1] - ends[0])
    return float(ends[0] - rim), float(ends[1] + rim)


def _at(mechanism: Mechanism, pair: tuple[int, int], a: float, b: float) -> Array:
    pose = mechanism.home.copy()
    pose[list(pair)] = a, b
    return pose
