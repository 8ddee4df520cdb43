"""Kinematics of the rotary Stewart platform: equations (1)-(5), with the errata of docs/errata.md.

Leg i, with L = p_SQ_W from the shaft centre to the plate joint, crank length u, rod length l and
motor frame (x, y, n): the crank tip is u (cos(alpha) x + sin(alpha) y) from the shaft centre and
must lie at distance l from the joint,

    A cos(alpha) + B sin(alpha) = C,   A = 2u L.x,  B = 2u L.y,  C = L.L + u^2 - l^2,
    alpha = atan2(B, A) + e acos(C / hypot(A, B)),   e = -1 or +1 the crank branch.

Functions of `poses` take one pose (6,) or many (..., 6).
"""

import math
from dataclasses import dataclass

import numpy as np

from stewart_drake.scenario.signals import ANGLES, LEGS, POSITION
from stewart_drake.types import Array

DEAD_CENTRE_TRANSMISSION = 1e-7
"""|rod . tangent| that counts as zero. Next to a dead centre acos resolves the crank angle to the
square root of the rounding, 1.5e-8 rad: quotients by less than this have no correct digit."""
_HEIGHTS = 1000  # number of heights that `reachable_heights` evaluates


@dataclass(frozen=True, eq=False)
class Legs:
    """Dimensions of the six legs, SI units."""

    p_WS: Array  # motor shaft centres (6, 3)
    R_WS: Array  # motor frames (6, 3, 3); columns x, y and the motor axis z
    p_PQ: Array  # plate joints (6, 3) in the plate frame
    crank_lengths: Array  # (6,)
    rod_lengths: Array  # (6,)
    branches: Array  # (6,) of -1 or +1, the crank solution that a leg uses


def numbers_of(legs: Legs) -> Array:
    """Return the numbers (108,) of the legs as the core takes them, see `core.layout`."""
    R_WS = legs.R_WS.transpose(0, 2, 1).reshape(-1, 9)
    lengths = legs.crank_lengths, legs.rod_lengths, legs.branches
    return np.column_stack([*lengths, R_WS, legs.p_PQ, legs.p_WS]).T.ravel()


class UnreachablePoseError(ValueError):
    """Error for a pose out of reach: `margins` (6,) in m of `legs` (from one) are negative."""

    def __init__(self, margins: Array, prefix: str = "pose out of reach", suffix: str = "") -> None:
        self.margins = np.asarray(margins)
        self.legs = tuple(leg for leg, m in zip(LEGS, self.margins, strict=True) if not m >= 0)
        by = {leg: f"short by {-1e3 * self.margins[leg - 1]:.3g} mm" for leg in self.legs}
        if np.isnan(self.margins).any():
            short = "got numbers that are not finite"
        elif len(by) == len(LEGS) and len(set(by.values())) == 1:
            short = f"all legs {by[LEGS[0]]}"
        else:
            short = ", ".join(f"leg {leg} {text}" for leg, text in by.items())
        super().__init__(f"{prefix}: {short}{suffix}")


class SingularPoseError(ValueError):
    """Error for a pose at the dead centre of `legs` (from one), where crank rates are undefined."""

    def __init__(self, legs: tuple[int, ...]) -> None:
        self.legs = legs
        super().__init__(
            f"pose at the dead centre of leg {', '.join(map(str, legs))}: no crank rate moves the "
            "rod's end along the rod; expected a pose off the edge of the workspace"
        )


class ForwardKinematicsError(ValueError):
    """Error for crank angles without a pose near the guess, on the mechanism's crank branches."""


def rotation(angles: Array) -> Array:
    """Return R_WP (..., 3, 3) = Rz(yaw) Ry(pitch) Rx(roll), Drake's RollPitchYaw, of (..., 3)."""
    (cf, ct, cp), (sf, st, sp) = np.cos(angles).T, np.sin(angles).T
    columns = [
        [cp * ct, sp * ct, -st],
        [cp * st * sf - sp * cf, sp * st * sf + cp * cf, ct * sf],
        [cp * st * cf + sp * sf, sp * st * cf - cp * sf, ct * cf],
    ]
    return np.array(columns).T


def turned(angles: Array, near: Array | float) -> Array:
    """Return the angles in rad, moved by whole turns to within half a turn of others."""
    return near + (angles - near + np.pi) % (2 * np.pi) - np.pi


def turns_between(angles: Array, others: Array) -> Array:
    """Return the angles (n,) of the rotations from one roll-pitch-yaw (n, 3) to another, rad.

    With the Frobenius norm |R - R'|^2 = 2 tr(1 - R' R) = 4 (1 - cos t) = 8 sin^2(t / 2).
    """
    apart = np.linalg.norm(rotation(angles) - rotation(others), axis=(-2, -1))
    return 2 * np.arcsin(np.minimum(apart / math.sqrt(8), 1.0))


def angle_rate_map(angles: Array) -> Array:
    """Return E (3, 3) with w_WP = E d(roll, pitch, yaw)/dt; singular at a pitch of +-90 degrees.

    The columns are the axes about which the three angles turn: Rz Ry x, Rz y and z.
    """
    _, ct, cp = np.cos(angles)
    _, st, sp = np.sin(angles)
    return np.array([[cp * ct, -sp, 0.0], [sp * ct, cp, 0.0], [-st, 0.0, 1.0]])


@dataclass(frozen=True)
class LegGeometry:
    """The six legs at some poses; unit vectors in W, arrays (..., 6, 3) or (..., 6)."""

    crank_angles: Array  # rad
    p_PQ_W: Array  # plate joint from the plate's COM
    crank: Array  # direction of the crank
    tangent: Array  # direction in which the crank tip moves for growing crank angle
    rod: Array  # direction from the crank tip to the plate joint
    # rod . tangent, zero at a dead centre, where crank and rod lie in one plane with the motor axis
    transmission: Array


def dot(a: Array, b: Array) -> Array:
    """Return the scalar products (...) of vectors (..., 3)."""
    return np.einsum("...i,...i->...", a, b)


def _joints(legs: Legs, poses: Array) -> tuple[Array, Array]:
    """Return p_PQ_W and p_SQ_S (..., 6, 3), the latter in each motor frame."""
    p_PQ_W = legs.p_PQ @ rotation(poses[..., ANGLES]).swapaxes(-1, -2)
    p_SQ_W = poses[..., None, POSITION] + p_PQ_W - legs.p_WS
    return p_PQ_W, np.einsum("lij,...li->...lj", legs.R_WS, p_SQ_W)


def _margins(legs: Legs, p_SQ_S: Array) -> Array:
    # The crank tip runs on a circle; Q lies at distance h from its plane and rho from its axis, so
    # that the tip's distance from Q covers [hypot(rho - u, h), hypot(rho + u, h)].
    rho, h = np.hypot(p_SQ_S[..., 0], p_SQ_S[..., 1]), p_SQ_S[..., 2]
    u, rod = legs.crank_lengths, legs.rod_lengths
    return np.minimum(rod - np.hypot(rho - u, h), np.hypot(rho + u, h) - rod)


def reach_margins(legs: Legs, poses: Array) -> Array:
    """Return the distance (..., 6) in m that each leg has left; negative out of reach."""
    return _margins(legs, _joints(legs, np.asarray(poses, dtype=np.float64))[1])


def reachable_heights(legs: Legs, pose: Array) -> tuple[float, float] | None:
    """Return the range of z in m nearest to a pose's own within which all legs reach, or None.

    x, y and the orientation stay those of the pose. No leg reaches further than crank and rod
    together, |z + p_PQ_W - p_WS| <= u + l in z, which bounds the heights. A range narrower than a
    thousandth of these may be missed.
    """
    from scipy.optimize import brentq  # slow to import, for messages only

    offset = (legs.p_WS - legs.p_PQ @ rotation(np.asarray(pose)[ANGLES]).T)[:, 2]
    stretched = legs.crank_lengths + legs.rod_lengths
    # At both ends at least one leg is stretched, so that every range lies inside.
    heights = np.linspace((offset - stretched).max(), (offset + stretched).min(), _HEIGHTS)
    poses = np.tile(np.asarray(pose, dtype=np.float64), (_HEIGHTS, 1))
    poses[:, 5] = heights
    hit = np.flatnonzero(reach_margins(legs, poses[1:-1]).min(axis=1) > 0) + 1
    if heights[0] >= heights[-1] or len(hit) == 0:
        return None
    ranges = np.split(hit, np.flatnonzero(np.diff(hit) > 1) + 1)
    nearest = min(ranges, key=lambda r: np.abs(heights[r] - pose[5]).min())

    def margin(z: float) -> float:
        return float(reach_margins(legs, np.array([*pose[:5], z])).min())

    first, last = nearest[0], nearest[-1]
    low, high = heights[first - 1 : first + 1], heights[last : last + 2]
    return float(brentq(margin, *low)), float(brentq(margin, *high))


def legs_along(legs: Legs, poses: Array) -> LegGeometry:
    """Return the legs at some poses, NaN where a leg does not reach."""
    poses = np.asarray(poses, dtype=np.float64)
    u, rod = legs.crank_lengths, legs.rod_lengths
    p_PQ_W, p_SQ_S = _joints(legs, poses)
    a, b = 2 * u * p_SQ_S[..., 0], 2 * u * p_SQ_S[..., 1]
    c = dot(p_SQ_S, p_SQ_S) + u**2 - rod**2
    # Rounding may lift |c| over hypot(a, b) by one ulp where the margin is exactly zero.
    swing = np.arccos(np.clip(c / np.hypot(a, b), -1.0, 1.0))
    swing = np.where(_margins(legs, p_SQ_S) >= 0, swing, np.nan)
    alpha = np.arctan2(b, a) + legs.branches * swing

    cos, sin = np.cos(alpha)[..., None], np.sin(alpha)[..., None]
    x, y = legs.R_WS[:, :, 0], legs.R_WS[:, :, 1]
    crank, tangent = cos * x + sin * y, -sin * x + cos * y
    p_TQ_W = poses[..., None, POSITION] + p_PQ_W - legs.p_WS - u[:, None] * crank
    e_rod = p_TQ_W / rod[:, None]
    transmission = dot(e_rod, tangent)
    return LegGeometry(alpha, p_PQ_W, crank, tangent, e_rod, transmission)


def leg_geometry(legs: Legs, pose: Array) -> LegGeometry:
    """Return the legs at a pose (6,).

    Raises:
        UnreachablePoseError: naming the legs and by how much each falls short.
    """
    margins = reach_margins(legs, pose)
    if not np.all(margins >= 0):
        raise UnreachablePoseError(margins)
    return legs_along(legs, pose)


def jacobian(mechanism: Legs, pose: Array) -> Array:
    """Return d crank_angles / d pose (6, 6).

    The rod keeps its length: rod . (v_Q - v_T) = 0 with v_T = u alpha_dot tangent and
    v_Q = v + w x p_PQ_W, w = E d(angles)/dt, hence
    alpha_dot = [(p_PQ_W x rod)' E, rod'] rates / (u rod.tangent).
    """
    legs = leg_geometry(mechanism, pose)
    moment = np.cross(legs.p_PQ_W, legs.rod) @ angle_rate_map(np.asarray(pose)[ANGLES])
    return np.hstack([moment, legs.rod]) / levers(mechanism, legs)[:, None]


def levers(mechanism: Legs, legs: LegGeometry) -> Array:
    """Return u rod . tangent (6,) in m: speed of the plate joint along the rod per crank rate.

    Raises:
        SingularPoseError: a leg is at its dead centre, where a crank rate divides by zero.
    """
    dead = np.abs(legs.transmission) < DEAD_CENTRE_TRANSMISSION
    if dead.any():
        raise SingularPoseError(tuple(np.compress(dead, LEGS).tolist()))
    return mechanism.crank_lengths * legs.transmission
