"""Kinematics of the rotary Stewart platform: equations (1)-(5), with the errata of docs/errata.md.

Leg i, with L = p_SQ_W from the shaft centre to the plate joint, crank length u, rod length l and
motor frame (x, y, n): the crank tip is u (cos(alpha) x + sin(alpha) y) from the shaft centre and
must lie at distance l from the joint,

    A cos(alpha) + B sin(alpha) = C,   A = 2u L.x,  B = 2u L.y,  C = L.L + u^2 - l^2,
    alpha = atan2(B, A) + e acos(C / hypot(A, B)),   e = -1 or +1 the crank branch.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stewart_drake.scenario.signals import ANGLES, LEGS, POSITION
from stewart_drake.types import Array

FORWARD_KINEMATICS_TOLERANCE = 1e-13
"""Largest rod-length residual, relative to the rod, at which Newton's method stops."""
DEAD_CENTRE_TRANSMISSION = 1e-7
"""|rod . tangent| that counts as zero. Next to a dead centre acos resolves the crank angle to the
square root of the rounding, 1.5e-8 rad: quotients by less than this have no correct digit."""


class Legs(Protocol):
    """What kinematics needs of a machine; `mechanism.geometry.Mechanism` has it."""

    @property
    def p_WS(self) -> Array:
        """Motor shaft centres (6, 3) in m."""

    @property
    def R_WS(self) -> Array:
        """Motor frames (6, 3, 3); columns x, y and the motor axis z."""

    @property
    def p_PQ(self) -> Array:
        """Plate joints (6, 3) in m."""

    @property
    def crank_lengths(self) -> Array:
        """(6,) m."""

    @property
    def rod_lengths(self) -> Array:
        """(6,) m."""

    @property
    def branches(self) -> Array:
        """(6,) of -1 or +1, the crank solution that a leg uses."""


class UnreachablePoseError(ValueError):
    """A pose out of reach; `legs` numbered from one, `margins` (6,) in m, negative where short."""

    def __init__(self, margins: Array, prefix: str = "pose out of reach", suffix: str = "") -> None:
        self.margins = np.asarray(margins)
        self.legs = tuple(leg for leg, m in zip(LEGS, self.margins, strict=True) if not m >= 0)
        by = {leg: f"short by {-1e3 * self.margins[leg - 1]:.3g} mm" for leg in self.legs}
        if len(by) == len(LEGS) and len(set(by.values())) == 1:
            short = f"all legs {by[LEGS[0]]}"
        else:
            short = ", ".join(f"leg {leg} {text}" for leg, text in by.items())
        super().__init__(f"{prefix}: {short}{suffix}")


class SingularPoseError(ValueError):
    """A pose at the dead centre of `legs` (from one), where crank rates are not defined."""

    def __init__(self, legs: tuple[int, ...]) -> None:
        self.legs = legs
        names = ", ".join(str(leg) for leg in legs)
        super().__init__(
            f"pose at the dead centre of leg {names}: no crank rate moves the rod's end along the "
            "rod; expected a pose off the edge of the workspace"
        )


class ForwardKinematicsError(ValueError):
    """No pose with these crank angles was found near the guess, on the mechanism's branches."""


def rotation(angles: Array) -> Array:
    """R_WP (3, 3) = Rz(psi) Ry(theta) Rx(phi) of roll, pitch, yaw (3,) = Drake's RollPitchYaw."""
    (cf, ct, cp), (sf, st, sp) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf],
            [sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf],
            [-st, ct * sf, ct * cf],
        ]
    )


def angle_rate_map(angles: Array) -> Array:
    """E (3, 3) with w_WP = E d(roll, pitch, yaw)/dt; singular at a pitch of +-90 degrees.

    The columns are the axes about which the three angles turn: Rz Ry x, Rz y and z.
    """
    _, ct, cp = np.cos(angles)
    _, st, sp = np.sin(angles)
    return np.array([[cp * ct, -sp, 0.0], [sp * ct, cp, 0.0], [-st, 0.0, 1.0]])


@dataclass(frozen=True)
class LegGeometry:
    """The six legs at one pose; unit vectors in W, arrays (6, 3) or (6,); or at n of them.

    `p_PQ_W`: plate joint from the plate's COM. `tangent`: direction in which the crank tip moves
    for growing crank angle. `rod`: from the crank tip to the plate joint. `transmission` =
    rod . tangent, zero at a dead centre, where crank and rod lie in one plane with the motor axis.
    """

    crank_angles: Array
    p_PQ_W: Array
    crank: Array
    tangent: Array
    rod: Array
    transmission: Array


def _shaft_to_joint(mechanism: Legs, pose: Array) -> tuple[Array, Array]:
    """p_PQ_W (6, 3) and p_SQ_S (6, 3), the latter in each motor frame."""
    p_PQ_W = mechanism.p_PQ @ rotation(pose[ANGLES]).T
    p_SQ_W = pose[POSITION] + p_PQ_W - mechanism.p_WS
    return p_PQ_W, np.einsum("lij,li->lj", mechanism.R_WS, p_SQ_W)


def _margins(mechanism: Legs, p_SQ_S: Array) -> Array:
    # The crank tip runs on a circle; Q lies at distance h from its plane and rho from its axis, so
    # that the tip's distance from Q covers [hypot(rho - u, h), hypot(rho + u, h)].
    rho, h = np.hypot(p_SQ_S[..., 0], p_SQ_S[..., 1]), p_SQ_S[..., 2]
    u, rod = mechanism.crank_lengths, mechanism.rod_lengths
    return np.minimum(rod - np.hypot(rho - u, h), np.hypot(rho + u, h) - rod)


def _closing(mechanism: Legs, p_SQ_S: Array) -> tuple[Array, Array]:
    """atan2(B, A) and C / hypot(A, B) (..., 6) of joints at p_SQ_S (..., 6, 3)."""
    u, rod = mechanism.crank_lengths, mechanism.rod_lengths
    a, b = 2 * u * p_SQ_S[..., 0], 2 * u * p_SQ_S[..., 1]
    c = np.einsum("...li,...li->...l", p_SQ_S, p_SQ_S) + u**2 - rod**2
    return np.arctan2(b, a), c / np.hypot(a, b)


def reach_margins(mechanism: Legs, pose: Array) -> Array:
    """Distance (6,) in m by which the rod end can still be moved before leg i cannot be closed."""
    return _margins(mechanism, _shaft_to_joint(mechanism, np.asarray(pose, dtype=np.float64))[1])


def reachable_heights(mechanism: Legs, pose: Array) -> tuple[float, float] | None:
    """The range of z in m nearest to a pose's own within which all legs reach; None without one.

    x, y and the orientation stay those of the pose. No leg reaches further than crank and rod
    together, |z + p_PQ_W - p_WS| <= u + l in z, so that the heights worth a look are bounded; among
    them a scan finds the ranges, and bisection their ends. A range narrower than the scan's step
    of a thousandth may be missed.
    """
    pose = np.array(pose, dtype=np.float64)
    offset = (mechanism.p_WS - mechanism.p_PQ @ rotation(pose[ANGLES]).T)[:, 2]
    stretched = mechanism.crank_lengths + mechanism.rod_lengths
    low, high = (offset - stretched).max(), (offset + stretched).min()

    def reached(z: float) -> bool:
        return bool(np.all(reach_margins(mechanism, np.array([*pose[:5], z])) > 0))

    def edge(inside: float, outside: float) -> float:
        for _ in range(40):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if reached(middle) else (inside, middle)
        return inside

    if low >= high:
        return None
    heights = np.linspace(low, high, 1000)
    # At both ends some leg is stretched at least, so that every range lies between two scanned z.
    hit = 1 + np.flatnonzero([reached(z) for z in heights[1:-1]])
    if len(hit) == 0:
        return None
    ranges = np.split(hit, np.flatnonzero(np.diff(hit) > 1) + 1)
    nearest = min(ranges, key=lambda r: np.abs(heights[r] - pose[5]).min())
    first, last = nearest[0], nearest[-1]
    return edge(heights[first], heights[first - 1]), edge(heights[last], heights[last + 1])


def leg_geometry(mechanism: Legs, pose: Array) -> LegGeometry:
    """All six legs at a pose (6,).

    Raises:
        UnreachablePoseError: naming the legs and by how much each falls short.
    """
    pose = np.asarray(pose, dtype=np.float64)
    p_PQ_W, p_SQ_S = _shaft_to_joint(mechanism, pose)
    margins = _margins(mechanism, p_SQ_S)
    if not np.all(margins >= 0):
        raise UnreachablePoseError(margins)
    direction, cosine = _closing(mechanism, p_SQ_S)
    # Rounding may lift |c| over hypot(a, b) by one ulp where the margin is exactly zero.
    swing = np.arccos(np.clip(cosine, -1.0, 1.0))
    return _assembled(mechanism, pose[POSITION], p_PQ_W, direction + mechanism.branches * swing)


def _assembled(mechanism: Legs, position: Array, p_PQ_W: Array, alpha: Array) -> LegGeometry:
    """The legs whose cranks are at alpha (..., 6), with joints p_PQ_W (..., 6, 3)."""
    u, rod = mechanism.crank_lengths, mechanism.rod_lengths
    cos, sin = np.cos(alpha)[..., None], np.sin(alpha)[..., None]
    x, y = mechanism.R_WS[:, :, 0], mechanism.R_WS[:, :, 1]
    crank, tangent = cos * x + sin * y, -sin * x + cos * y
    p_TQ_W = position + p_PQ_W - mechanism.p_WS - u[:, None] * crank
    e_rod = p_TQ_W / rod[:, None]
    return LegGeometry(
        crank_angles=alpha,
        p_PQ_W=p_PQ_W,
        crank=crank,
        tangent=tangent,
        rod=e_rod,
        transmission=np.einsum("...li,...li->...l", e_rod, tangent),
    )


def crank_angles(mechanism: Legs, pose: Array) -> Array:
    """See `Mechanism.crank_angles`."""
    return leg_geometry(mechanism, pose).crank_angles


def crank_angles_along(mechanism: Legs, poses: Array) -> Array:
    """Crank angles (n, 6) in rad at poses (n, 6); NaN where a leg does not reach."""
    _, p_SQ_S = _shafts_to_joints(mechanism, poses)
    direction, cosine = _closing(mechanism, p_SQ_S)
    with np.errstate(invalid="ignore"):
        return direction + mechanism.branches * np.arccos(cosine)


def reach_margins_along(mechanism: Legs, poses: Array) -> Array:
    """`reach_margins` (n, 6) in m at poses (n, 6)."""
    return _margins(mechanism, _shafts_to_joints(mechanism, poses)[1])


def legs_along(mechanism: Legs, poses: Array) -> LegGeometry:
    """The legs at poses (n, 6), arrays (n, 6, 3) or (n, 6); NaN where a leg does not reach."""
    p_PQ_W, _ = _shafts_to_joints(mechanism, poses)
    alpha = crank_angles_along(mechanism, poses)
    return _assembled(mechanism, poses[:, None, POSITION], p_PQ_W, alpha)


def _shafts_to_joints(mechanism: Legs, poses: Array) -> tuple[Array, Array]:
    """`_shaft_to_joint` of poses (n, 6), both (n, 6, 3)."""
    R_WP = np.moveaxis(rotation(poses[:, ANGLES].T), -1, 0)
    p_PQ_W = mechanism.p_PQ @ R_WP.swapaxes(1, 2)
    p_SQ_W = poses[:, None, POSITION] + p_PQ_W - mechanism.p_WS
    return p_PQ_W, np.einsum("lij,nli->nlj", mechanism.R_WS, p_SQ_W)


def jacobian(mechanism: Legs, pose: Array) -> Array:
    """See `Mechanism.jacobian`.

    The rod keeps its length: rod . (v_Q - v_T) = 0 with v_T = u alpha_dot tangent and
    v_Q = v + w x p_PQ_W, w = E d(angles)/dt, hence
    alpha_dot = [(p_PQ_W x rod)' E, rod'] rates / (u rod.tangent).
    """
    legs = leg_geometry(mechanism, pose)
    moment = np.cross(legs.p_PQ_W, legs.rod) @ angle_rate_map(np.asarray(pose)[ANGLES])
    return np.hstack([moment, legs.rod]) / levers(mechanism, legs)[:, None]


def levers(mechanism: Legs, legs: LegGeometry) -> Array:
    """u rod . tangent (6,) in m: speed of the plate joint along the rod per crank rate.

    Raises:
        SingularPoseError: a leg is at its dead centre, where a crank rate divides by zero.
    """
    dead = np.abs(legs.transmission) < DEAD_CENTRE_TRANSMISSION
    if dead.any():
        raise SingularPoseError(tuple(np.compress(dead, LEGS).tolist()))
    return mechanism.crank_lengths * legs.transmission


def forward_kinematics(
    mechanism: Legs, angles: Array, guess: Array, max_iterations: int = 50
) -> Array:
    """See `Mechanism.forward_kinematics`.

    Newton's method with halving steps on f_i = |p_TQ|^2 - l^2, which stays smooth through dead
    centres and outside the workspace, df_i = 2 [(p_PQ_W x p_TQ)' E, p_TQ'] d pose.
    """
    angles = np.asarray(angles, dtype=np.float64)
    x, y = mechanism.R_WS[:, :, 0], mechanism.R_WS[:, :, 1]
    crank = np.cos(angles)[:, None] * x + np.sin(angles)[:, None] * y
    p_WT = mechanism.p_WS + mechanism.crank_lengths[:, None] * crank
    scale = mechanism.rod_lengths**2

    def residual(pose: Array) -> tuple[Array, Array, Array]:
        p_PQ_W = mechanism.p_PQ @ rotation(pose[ANGLES]).T
        p_TQ_W = pose[POSITION] + p_PQ_W - p_WT
        return np.einsum("li,li->l", p_TQ_W, p_TQ_W) / scale - 1.0, p_PQ_W, p_TQ_W

    pose = np.array(guess, dtype=np.float64)
    f, p_PQ_W, p_TQ_W = residual(pose)
    for _ in range(max_iterations):
        if np.abs(f).max() <= FORWARD_KINEMATICS_TOLERANCE:
            break
        moment = np.cross(p_PQ_W, p_TQ_W) @ angle_rate_map(pose[ANGLES])
        df = 2 * np.hstack([moment, p_TQ_W]) / scale[:, None]
        try:
            step = np.linalg.solve(df, f)
        except np.linalg.LinAlgError:
            break
        size = 1.0
        while size > 1e-3 and not _improves(residual(pose - size * step)[0], f):
            size /= 2
        pose = pose - size * step
        f, p_PQ_W, p_TQ_W = residual(pose)
    worst = np.abs(f).max()
    # Rounding limits the residual to a few ulp of |p|^2 / l^2; a failure is orders above that.
    if not worst <= 1e2 * FORWARD_KINEMATICS_TOLERANCE:
        raise ForwardKinematicsError(
            f"forward kinematics did not converge: rod length off by {50 * worst:.2g} % after "
            f"{max_iterations} Newton steps; give a guess closer to the assembly"
        )
    # rod . tangent = -branch rho sin(delta) / l: its sign tells the branches apart.
    tangent = -np.sin(angles)[:, None] * x + np.cos(angles)[:, None] * y
    wrong = mechanism.branches * np.einsum("li,li->l", p_TQ_W, tangent) / mechanism.rod_lengths
    if wrong.max() > 1e-5:
        raise ForwardKinematicsError(
            "forward kinematics found a pose that needs the other crank branch on leg "
            f"{LEGS[int(wrong.argmax())]}; expected crank angles of the mechanism's own branches"
        )
    return pose


def _improves(new: Array, old: Array) -> bool:
    return float(new @ new) < float(old @ old)
