"""Workspace of a mechanism: no dead centres, no parallel singularities, pitch below its limit."""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.core.layout import DEAD_CENTRE_SINE
from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import LEGS, NUM_LEGS
from stewart_drake.types import Array

PITCH_LIMIT = np.deg2rad(85.0)
"""Largest |pitch|, rad. At 90 degrees roll and yaw are one rotation."""
SINGULARITY_LIMIT = 1e-3
"""Least |det| of the dimensionless wrenches of the six rods."""
LEAST = np.array([DEAD_CENTRE_SINE] * NUM_LEGS + [SINGULARITY_LIMIT, -PITCH_LIMIT])
"""Lower bounds of the measures (8,): six sines, the signed determinant, and minus |pitch|."""


class Failure(NamedTuple):
    """Reason of an early end."""

    time: float  # s
    leg: int | None  # from 1; None for a reason without a leg
    margin: float  # reach margin of the leg in m, or distance from the named limit; NaN for none
    reason: str

    def __str__(self) -> str:
        margin = "" if np.isnan(self.margin) else f" (margin {self.margin:.2g})"
        return f"{self.reason} at t = {self.time:.3f} s{margin}"


class Measures(NamedTuple):
    """Distances from the workspace's boundary at a pose."""

    sines: Array  # (6,) of the cranks' angles off dead centre, negative on the other branch
    parallel: float  # det of the rods' wrenches, 0 where the cranks do not hold the plate
    pitch: float  # rad
    margin: float  # see the function of this name


def measures_at(mechanism: Mechanism, pose: Array, crank_angles: Array | None = None) -> Measures:
    """Return the measures of a pose (6,), in or out of reach.

    A pose does not show whether a crank has passed its dead centre. With the crank angles (6,) of a
    simulated tree, the sine of such a crank is negative.
    """
    measures = functions_of(mechanism).measures(pose, crank_angles)
    parallel, signed = float(measures[NUM_LEGS]), measures.copy()
    signed[NUM_LEGS] *= home_sign(mechanism)
    return Measures(measures[:NUM_LEGS], parallel, float(pose[1]), float((signed - LEAST).min()))


def margin(mechanism: Mechanism, pose: Array) -> float:
    """Return a margin, positive inside the workspace, zero on its boundary; NaN for NaN."""
    return float(margins(mechanism, pose)[0])


def border(
    inside: Callable[[float], bool], low: float, high: float, tolerance: float
) -> tuple[float, float]:
    """Bisect between `low`, inside, and `high`, outside, until they are closer than a tolerance."""
    while high - low > tolerance:
        middle = (low + high) / 2
        low, high = (middle, high) if inside(middle) else (low, middle)
    return low, high


def margins(mechanism: Mechanism, poses: Array) -> Array:
    """Return `margin` (n,) of poses (n, 6)."""
    return functions_of(mechanism).margins(poses, home_sign(mechanism), LEAST)


@lru_cache(maxsize=64)
def home_sign(mechanism: Mechanism) -> float:
    """Return the sign of `Measures.parallel` at home; a motion that changes it passes 0."""
    return float(np.sign(functions_of(mechanism).measures(mechanism.home)[NUM_LEGS]))


def diagnose(
    mechanism: Mechanism, time: float, pose: Array, crank_angles: Array | None = None
) -> Failure | None:
    """Return the failure at a pose outside the workspace, or None inside it."""
    if not np.all(np.isfinite(pose)):
        return Failure(time, None, np.nan, "the simulated state is not finite")
    measures = measures_at(mechanism, pose, crank_angles)
    if measures.margin > 0:
        return None
    leg = int(measures.sines.argmin())
    if measures.sines[leg] <= DEAD_CENTRE_SINE:
        reach = float(mechanism.reach_margins(pose)[leg])
        return Failure(time, LEGS[leg], reach, f"leg {LEGS[leg]} reached the end of its reach")
    if (pitch := abs(measures.pitch)) >= PITCH_LIMIT:
        return Failure(time, None, PITCH_LIMIT - pitch, "the pitch passed 85 degrees")
    singular = "parallel singularity: the cranks do not hold the plate"
    return Failure(time, None, home_sign(mechanism) * measures.parallel, singular)


class Limits(Protocol):
    """Limits of a plate's motion."""

    def margin(self, time: float, pose: Array) -> float:
        """Return a margin, positive where a pose (6,) is permitted at a time in s."""
        ...

    def diagnose(self, time: float, pose: Array) -> Failure | None:
        """Return the failure at a pose that is not permitted, else None."""
        ...


class Workspace(NamedTuple):
    """Workspace of a machine as limits, the same at all times."""

    mechanism: Mechanism

    def margin(self, time: float, pose: Array) -> float:
        return margin(self.mechanism, pose)

    def diagnose(self, time: float, pose: Array) -> Failure | None:
        return diagnose(self.mechanism, time, pose)
