"""Sizes of the parts, and least distances of cranks and rods, for many poses at once.

Each link lies in a capsule, the points within a radius of its centre line: hypot(w, h) / 2 for a
crank, a bar of width w and thickness h, and its own radius for a rod. The distance of two lines
less both radii is a lower bound of the links' distance. `loop.clearance` measures the shapes
themselves, with plate and base.
"""

from functools import lru_cache
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.library import core
from stewart_drake.mechanism.kinematics import Legs, numbers_of
from stewart_drake.scenario.signals import LEGS, NUM_LEGS
from stewart_drake.types import Array

LINKS: Final = tuple(f"{kind} {leg}" for kind in ("crank", "rod") for leg in LEGS)
"""Names of the links, in the order of core/clearance.h."""
LINK_PAIRS: Final = tuple(
    (i, j) for i, j in combinations(range(2 * NUM_LEGS), 2) if j - i != NUM_LEGS
)
"""Pairs (60) of links without a common joint: all but a crank and its own rod."""
_LINK_PAIRS: Final = np.array(LINK_PAIRS, np.intc)


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


def link_radii(mechanism: Legs) -> Array:
    """Return the radii (12,) of the links' capsules, m."""
    size = proportions(mechanism)
    crank = float(np.hypot(size.crank_width, size.crank_thickness)) / 2
    return np.repeat([crank, size.rod_radius], NUM_LEGS)


@lru_cache(maxsize=64)
def _capsules(mechanism: Legs) -> tuple[Array, Array]:
    """Return the numbers of the legs, and the radii of their links, for C."""
    return numbers_of(mechanism), link_radii(mechanism)


def room(
    mechanism: Legs, poses: Array, pairs: NDArray[np.integer], unit: float, least: Array
) -> Array:
    """Return reach margins and clearances (n, 6 + k) of poses (n, 6) above `least` (6 + k,).

    All are in units of `unit` m; `pairs` (k,) are indices in LINK_PAIRS. See core/clearance.h.
    """
    rows, links = np.array(poses, np.float64), _LINK_PAIRS[pairs]
    numbers, radii = _capsules(mechanism)
    found = np.empty((len(rows), len(least)))
    core().call("room", numbers, len(rows), rows, len(links), links, radii, unit, least, found)
    return found


def clearances(mechanism: Legs, poses: Array) -> Array:
    """Return lower bounds (n, 60) of the distances of the pairs LINK_PAIRS, m, also negative.

    They are NaN for links of a leg out of reach.
    """
    pairs, least = np.arange(len(LINK_PAIRS)), np.zeros(NUM_LEGS + len(LINK_PAIRS))
    return room(mechanism, poses, pairs, 1.0, least)[:, NUM_LEGS:]
