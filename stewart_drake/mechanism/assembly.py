"""The assembled machine: placement of every body, and the map of torques to accelerations.

Link frames: crank link C at the shaft centre with x along the crank and z along the motor axis; rod
link D at the crank tip with x along the rod and y along the universal joint's second axis, which is
perpendicular to motor axis and rod. The tree is base - crank (revolute) - rod (universal), and the
plate on its own; the joint angles are zero at the mechanism's home pose.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import (
    angle_rate_map,
    dot,
    leg_geometry,
    levers,
    rotation,
    turned,
)
from stewart_drake.scenario.signals import ANGLES, POSITION
from stewart_drake.types import Array

TorqueMap = Literal["virtual_work", "printed"]


@dataclass(frozen=True)
class Assembly:
    """Link frames of the six legs and of the plate in W."""

    crank_angles: Array  # (6,) rad
    R_WC: Array  # (6, 3, 3)
    p_WT: Array  # (6, 3) crank tips, m
    R_WD: Array  # (6, 3, 3)
    R_WP: Array  # (3, 3)


def assemble(mechanism: Mechanism, pose: Array) -> Assembly:
    """Return the link frames at a pose (6,).

    Raises:
        UnreachablePoseError: the pose is out of reach.
    """
    legs = leg_geometry(mechanism, pose)
    axes = mechanism.R_WS[:, :, 2]
    second = np.cross(axes, legs.rod)
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    return Assembly(
        crank_angles=legs.crank_angles,
        R_WC=np.stack([legs.crank, legs.tangent, axes], axis=2),
        p_WT=mechanism.p_WS + mechanism.crank_lengths[:, None] * legs.crank,
        R_WD=np.stack([legs.rod, second, np.cross(legs.rod, second)], axis=2),
        R_WP=rotation(np.asarray(pose)[ANGLES]),
    )


@dataclass(frozen=True)
class JointState:
    """Angles in rad, from the home pose, and their rates: cranks (6,), universal joints (6, 2)."""

    crank: Array
    universal: Array
    crank_rate: Array
    universal_rate: Array


def joint_state(mechanism: Mechanism, pose: Array, rates: Array) -> JointState:
    """Return joint angles and rates that close all loops at a pose (6,) with rates (6,).

    Raises:
        UnreachablePoseError: the pose is out of reach.
        SingularPoseError: the plate moves at the dead centre of a leg.
    """
    home, now = assemble(mechanism, mechanism.home), assemble(mechanism, pose)
    axes = mechanism.R_WS[:, :, 2]
    # theta_1 turns the cross-piece of the universal joint relative to the crank, about the motor
    # axis n. theta_2 turns the rod about the cross-piece's axis y. Both are zero at home;
    # `y_of_crank` is the y of the home pose, carried by the crank.
    y_of_crank = (now.R_WC @ home.R_WC.swapaxes(1, 2) @ home.R_WD[:, :, 1, None])[..., 0]
    y = now.R_WD[:, :, 1]
    theta_1 = np.arctan2(dot(np.cross(y_of_crank, y), axes), dot(y_of_crank, y))
    theta_2 = _elevation(now.R_WD, axes) - _elevation(home.R_WD, axes)
    crank = turned(now.crank_angles - home.crank_angles, 0.0)

    # Rates. The rod's length l is constant, so its axis r gives r . (v_Q - v_T) = 0, and from this
    # alpha_dot. Without spin the rod's angular velocity is r x (v_Q - v_T) / l. The rod turns about
    # n and y only: its spin about r cancels the component along n x y, that is n x (n x r).
    legs = leg_geometry(mechanism, pose)
    w_WP = angle_rate_map(pose[ANGLES]) @ rates[ANGLES]
    v_WQ = rates[POSITION] + np.cross(w_WP, legs.p_PQ_W)
    along = dot(legs.rod, v_WQ)
    # `levers` refuses a dead centre. A plate at rest has alpha_dot = 0 even there.
    alpha_dot = along / levers(mechanism, legs) if along.any() else along
    v_WT = (mechanism.crank_lengths * alpha_dot)[:, None] * legs.tangent
    swing = np.cross(legs.rod, v_WQ - v_WT) / mechanism.rod_lengths[:, None]
    swing_n, rod_n = dot(swing, axes), dot(legs.rod, axes)
    w_WD = swing + (swing_n * rod_n / (1 - rod_n**2))[:, None] * legs.rod
    theta_1_rate = dot(w_WD, axes) - alpha_dot
    theta_2_rate = dot(w_WD, now.R_WD[:, :, 1])
    return JointState(
        crank=crank,
        universal=np.column_stack([theta_1, theta_2]),
        crank_rate=alpha_dot,
        universal_rate=np.column_stack([theta_1_rate, theta_2_rate]),
    )


def _elevation(R_WD: Array, axes: Array) -> Array:
    """Return the angle (6,) of the rod x about y, from the direction n x y towards n."""
    x, y = R_WD[:, :, 0], R_WD[:, :, 1]
    return np.asarray(np.arctan2(dot(x, axes), dot(x, np.cross(axes, y))), dtype=np.float64)


def torque_map(mechanism: Mechanism, pose: Array, form: TorqueMap = "virtual_work") -> Array:
    """Return tau_tot (6, 6), equation (19): d accelerations / d torque at rest, SI units.

    Each rod pushes the plate with a force F_i along itself, so that (11)-(14)

        [M; F] = tau_1 [F_1 ... F_6]',   tau_1 = [p_PQ_W x e_rod; e_rod]  column by column,

    and (15)-(16) relate F_i to the motor torque, F = tau_2 T. A massless leg of crank length u does
    no net work: T alpha_dot = F v_Q.e_rod = F u alpha_dot e_rod.tangent, so tau_2 =
    1 / (u e_rod.tangent). The paper prints e_rod.e_N / u instead, which `printed` keeps, with e_N
    the crank's tangent.

    `virtual_work` has the accelerations of the pose coordinates at rest: d2(angles)/dt2 =
    E^-1 (R I R')^-1 M, with E the map from rates of the angles to angular velocity. `printed` has
    (17)-(18) as they stand: d2(angles)/dt2 = I^-1 M.

    Raises:
        UnreachablePoseError: the pose (6,) is out of reach.
        SingularPoseError: `virtual_work` at the dead centre of a leg.
    """
    legs = leg_geometry(mechanism, pose)
    tau_1 = np.vstack([np.cross(legs.p_PQ_W, legs.rod).T, legs.rod.T])
    if form == "printed":
        tau_2 = legs.transmission / mechanism.crank_lengths
        angular = np.diag(1 / mechanism.plate.inertia)
    else:
        tau_2 = 1 / levers(mechanism, legs)
        R_WP = rotation(pose[ANGLES])
        I_W = R_WP @ np.diag(mechanism.plate.inertia) @ R_WP.T
        angular = np.asarray(np.linalg.inv(I_W @ angle_rate_map(pose[ANGLES])), dtype=np.float64)
    tau = tau_1 * tau_2
    return np.vstack([angular @ tau[:3], tau[3:] / mechanism.plate.mass])
