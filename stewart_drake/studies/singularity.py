"""How far a pose is from singular: serial (cranks), parallel (rods and plate), and both in one.

Rod i pushes the plate with a force along the unit vector r_i at b_i from the centre of mass: the
unit-free wrench w_i = [b_i x r_i / rho; r_i], rho the mean distance of the plate joints from it.
With W = [w_1 ... w_6] and the twist made alike in its parts, [rho omega; v] in m/s,

    crank rates = A [rho omega; v],    A = diag(1 / (u_i t_i)) W',    t_i = r_i . tangent_i.

A leg at its dead centre has t_i = 0 (serial singularity: it cannot follow); det W = 0 means that
locked cranks do not hold the plate (parallel singularity). Singular values of A need no angles and
do not change with the frame; by rho they do not change with the machine's size either.
"""

from typing import NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import home_sign, standing
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import LegGeometry, leg_geometry
from stewart_drake.types import Array


class Measures(NamedTuple):
    """Of one pose; NaN from `transmission` on where the pose is out of the workspace."""

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
