"""Where a mechanism may be: off dead centres and parallel singularities, angles distinct."""

from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.compiled import Compiled
from stewart_drake.dynamics.equations import DEAD_CENTRE_SINE
from stewart_drake.dynamics.threads import BUILDING
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import LEGS, NUM_LEGS

Array = NDArray[np.float64]

PITCH_LIMIT = np.deg2rad(85.0)
"""Roll and yaw become one rotation at a pitch of 90 degrees."""
SINGULARITY_LIMIT = 1e-3
"""Least |det| of the dimensionless wrenches of the six rods, see `parallel_measure`."""


class Failure(NamedTuple):
    """Why a run stopped: time in s, leg (from 1, or None), margin and the reason in words.

    `margin` is the reach margin of that leg in m, or the measure that the reason names.
    """

    time: float
    leg: int | None
    margin: float
    reason: str

    def __str__(self) -> str:
        return f"{self.reason} at t = {self.time:.3f} s (margin {self.margin:.2g})"


class Standing(NamedTuple):
    """`sines` (6,): of the cranks' angles off dead centre, negative on the other branch.
    `parallel`: signed measure of parallel singularity, 0 where cranks no longer hold the plate.
    `pitch`: rad. `margin`: see the function of this name."""

    sines: Array
    parallel: float
    pitch: float
    margin: float


def standing(mechanism: Mechanism, pose: Array, crank_angles: Array | None = None) -> Standing:
    """Where a pose (6,) is in the workspace; defined everywhere, also out of reach.

    With the crank angles (6,) of a simulated tree given, a crank that has passed its dead centre
    shows as a negative sine; from the pose alone it cannot be seen.
    """
    measures = _measures(mechanism, pose, crank_angles)
    parallel, least = float(measures[NUM_LEGS]), _margin(mechanism, measures)
    return Standing(measures[:NUM_LEGS], parallel, float(pose[1]), least)


def margin(mechanism: Mechanism, pose: Array, crank_angles: Array | None = None) -> float:
    """Positive where `standing` is permitted, zero on the boundary, dimensionless; NaN for NaN."""
    return _margin(mechanism, _measures(mechanism, pose, crank_angles))


_LEAST = np.array([DEAD_CENTRE_SINE] * NUM_LEGS + [SINGULARITY_LIMIT, -PITCH_LIMIT])


def _margin(mechanism: Mechanism, measures: Array) -> float:
    above = measures - _LEAST
    above[NUM_LEGS] = home_sign(mechanism) * measures[NUM_LEGS] - _LEAST[NUM_LEGS]
    return float(above.min())


def _measures(mechanism: Mechanism, pose: Array, crank_angles: Array | None) -> Array:
    """(8,): the six sines, the parallel measure, minus the pitch's amount in rad."""
    functions = _functions(mechanism)
    if crank_angles is None:
        return functions.of_pose(pose)[0]
    return functions.of_tree(pose, crank_angles)[0]


class _Functions(NamedTuple):
    """The measures, from a pose or from a pose and crank angles."""

    of_pose: Compiled
    of_tree: Compiled


@lru_cache(maxsize=64)
def _functions(mechanism: Mechanism) -> _Functions:
    """Compiled, because every integration step asks."""
    with BUILDING:
        return _compile(mechanism)


def _compile(mechanism: Mechanism) -> _Functions:
    pose, angles = ca.SX.sym("pose", 6), ca.SX.sym("angles", 6)
    R_WP = equations.rotation(pose[:3])
    # Forces along the rods, and their moments over the plate's mean radius, are free of units.
    radius = float(np.linalg.norm(mechanism.p_PQ, axis=1).mean())
    legs: dict[str, list[tuple[ca.SX, ca.SX]]] = {"pose": [], "tree": []}
    for leg in range(NUM_LEGS):
        u, length = float(mechanism.crank_lengths[leg]), float(mechanism.rod_lengths[leg])
        branch, R_WS = float(mechanism.branches[leg]), ca.DM(mechanism.R_WS[leg])
        b = ca.mtimes(R_WP, ca.DM(mechanism.p_PQ[leg]))
        q = ca.mtimes(R_WS.T, pose[3:] + b - ca.DM(mechanism.p_WS[leg]))
        azimuth = ca.atan2(q[1], q[0])
        cosine = equations.swing_cosine(q, u, length)
        square = 1 - cosine**2
        swing = ca.acos(ca.fmin(ca.fmax(cosine, -1.0), 1.0))
        for kind, alpha, sine in (
            ("pose", azimuth + branch * swing, ca.sign(square) * ca.sqrt(ca.fabs(square))),
            ("tree", angles[leg], branch * ca.sin(angles[leg] - azimuth)),
        ):
            rod = (q - u * ca.vertcat(ca.cos(alpha), ca.sin(alpha), 0)) / length
            e = ca.mtimes(R_WS, rod)
            legs[kind].append((sine, ca.vertcat(ca.cross(b, e) / radius, e)))
    functions = []
    for kind, arguments in (("pose", [pose]), ("tree", [pose, angles])):
        sines, wrenches = zip(*legs[kind], strict=True)
        # CasADi expands the determinant by minors: no division, so it passes zero smoothly.
        measures = ca.vertcat(*sines, ca.det(ca.horzcat(*wrenches)), -ca.fabs(pose[1]))
        functions.append(Compiled(ca.Function(kind, arguments, [measures], {"cse": True})))
    return _Functions(*functions)


@lru_cache(maxsize=64)
def home_sign(mechanism: Mechanism) -> float:
    """Sign of `Standing.parallel` at home, which a continuous motion can only change at zero."""
    return float(np.sign(_measures(mechanism, mechanism.home, None)[NUM_LEGS]))


def diagnose(
    mechanism: Mechanism, time: float, pose: Array, crank_angles: Array | None = None
) -> Failure | None:
    """The failure at a pose that has left the permitted region, or None inside it."""
    if not np.all(np.isfinite(pose)):
        return Failure(time, None, np.nan, "the simulated state is not finite")
    now, sign = standing(mechanism, pose, crank_angles), home_sign(mechanism)
    if now.margin > 0:
        return None
    leg = int(now.sines.argmin())
    if now.sines[leg] <= DEAD_CENTRE_SINE:
        reach = float(mechanism.reach_margins(pose)[leg])
        return Failure(time, LEGS[leg], reach, f"leg {LEGS[leg]} reached the end of its reach")
    if abs(now.pitch) >= PITCH_LIMIT:
        return Failure(time, None, PITCH_LIMIT - abs(now.pitch), "the pitch passed 85 degrees")
    return Failure(
        time, None, sign * now.parallel, "parallel singularity: the cranks do not hold the plate"
    )
