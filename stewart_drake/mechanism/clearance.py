"""Sizes of the parts, and least distances of cranks and rods, for many poses at once.

Each link lies in a capsule, the points within a radius of its centre line: hypot(w, h) / 2 for a
crank, a bar of width w and thickness h, and its own radius for a rod. The distance of two lines
less both radii is a lower bound of the links' distance. `loop.clearance` measures the shapes
themselves, with plate and base.
"""

from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from stewart_drake.mechanism.kinematics import LegGeometry, Legs, dot
from stewart_drake.scenario.signals import LEGS, NUM_LEGS, POSITION
from stewart_drake.types import Array

LINKS: Final = tuple(f"{kind} {leg}" for kind in ("crank", "rod") for leg in LEGS)
"""Names of the links, in the order of `center_lines`."""
LINK_PAIRS: Final = tuple(
    (i, j) for i, j in combinations(range(2 * NUM_LEGS), 2) if j - i != NUM_LEGS
)
"""Pairs (60) of links without a common joint: all but a crank and its own rod."""


class Proportions(NamedTuple):
    """Sizes of the shapes that are drawn and that collide, in m."""

    crank_thickness: float  # along the motor axis
    crank_width: float
    motor_radius: float
    motor_length: float
    rod_radius: float
    plate_thickness: float


def proportions(mechanism: Legs) -> Proportions:
    """Return sizes by the shortest crank and rod, as a machine's file has none."""
    u, rod = float(mechanism.crank_lengths.min()), float(mechanism.rod_lengths.min())
    crank = 0.10 * u
    return Proportions(crank, 1.6 * crank, 0.22 * u, 0.40 * u, 0.012 * rod, 0.03 * rod)


def center_lines(mechanism: Legs, poses: Array, legs: LegGeometry) -> tuple[Array, Array]:
    """Return the lines of cranks, then rods, at poses (n, 6) whose legs are `legs`.

    These are the starts in W, m, and the vectors from there to the ends, (n, 12, 3).
    """
    cranks = mechanism.crank_lengths[:, None] * legs.crank
    rods = mechanism.rod_lengths[:, None] * legs.rod
    joints = poses[:, None, POSITION] + legs.p_PQ_W
    shafts = np.broadcast_to(mechanism.p_WS, joints.shape)
    return np.hstack([shafts, joints - rods]), np.hstack([cranks, rods])


def segment_distances(p: Array, u: Array, q: Array, v: Array) -> Array:
    """Return distances (...) of the segments p + s u and q + t v, 0 <= s, t <= 1; arrays (..., 3).

    |r + s u - t v|^2, r = p - q, is convex in (s, t). Over all s and t it is least where
    s (u.u v.v - (u.v)^2) = (u.v)(v.r) - (u.r)(v.v). That s is cut to the segment, then the best t
    for it, and then the best s for that t: if one of the three was cut, the minimum over the
    square lies on its border, and these steps end there. Parallel lines have many minima, and s = 0
    leads to one. Lengths are not zero.
    """
    r = p - q
    uu, vv, uv = dot(u, u), dot(v, v), dot(u, v)
    ur, vr = dot(u, r), dot(v, r)
    area = uu * vv - uv**2
    skew = area > 1e-14 * uu * vv
    s = np.clip(np.where(skew, (uv * vr - ur * vv) / np.where(skew, area, 1.0), 0.0), 0.0, 1.0)
    t = np.clip((uv * s + vr) / vv, 0.0, 1.0)
    s = np.clip((uv * t - ur) / uu, 0.0, 1.0)
    return np.sqrt(dot(d := r + s[..., None] * u - t[..., None] * v, d))


def link_radii(mechanism: Legs) -> Array:
    """Return the radii (12,) of the links' capsules, m."""
    size = proportions(mechanism)
    crank = float(np.hypot(size.crank_width, size.crank_thickness)) / 2
    return np.repeat([crank, size.rod_radius], NUM_LEGS)


def clearances(mechanism: Legs, poses: Array, legs: LegGeometry) -> Array:
    """Return lower bounds (n, 60) of the distances of the pairs `LINK_PAIRS`, m, also negative."""
    first, second = np.transpose(LINK_PAIRS)
    start, along = center_lines(mechanism, poses, legs)
    lines = start[:, first], along[:, first], start[:, second], along[:, second]
    radii = link_radii(mechanism)
    return segment_distances(*lines) - radii[first] - radii[second]
