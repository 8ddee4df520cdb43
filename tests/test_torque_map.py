"""The paper's torque map against exact dynamics, the balance of power and the printed formula."""

import dataclasses

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.mechanism.geometry import Link
from stewart_drake.mechanism.kinematics import UnreachablePoseError, leg_geometry
from tests.mechanisms import PAPER, random_mechanism, random_pose


def with_legs_scaled(mechanism, factor):
    """Return the same mechanism, mass and inertia of cranks and rods multiplied by `factor`."""
    crank, rod = (
        Link(factor * link.mass, factor * link.inertia, link.center)
        for link in (mechanism.crank, mechanism.rod)
    )
    return dataclasses.replace(mechanism, crank=crank, rod=rod)


def acceleration_per_torque(mechanism, pose):
    """(6, 6) of the exact dynamics at rest without gravity, column by column."""
    dynamics = StewartDynamics(mechanism, gravity=False)
    columns = [dynamics.accelerations(pose, np.zeros(6), torque) for torque in np.eye(6)]
    return np.column_stack(columns)


def relative(a, b):
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


@pytest.mark.parametrize("seed", range(3))
def test_exact_dynamics_approach_the_map_as_the_legs_lose_their_mass(seed):
    """The difference is proportional to the legs' mass: ten times lighter, ten times closer."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism, least_transmission=0.4)
    tau_tot = torque_map(mechanism, pose)
    errors = [
        relative(acceleration_per_torque(with_legs_scaled(mechanism, factor), pose), tau_tot)
        for factor in (1e-4, 1e-5, 1e-6)
    ]
    assert errors[-1] < 1e-4
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 10, rtol=0.05)


@pytest.mark.parametrize("seed", range(10))
def test_motor_power_is_what_the_plate_receives(seed):
    """Massless legs store nothing: T' alpha_dot = w' I w_dot + m v' v_dot, from rest."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism)
    torque, rates = rng.normal(size=6), rng.normal(size=6)
    accelerations = torque_map(mechanism, pose) @ torque

    rpy = RollPitchYaw(pose[:3])
    R_WP = rpy.ToRotationMatrix().matrix()
    I_W = R_WP @ np.diag(mechanism.plate.inertia) @ R_WP.T
    w = rpy.CalcAngularVelocityInParentFromRpyDt(rates[:3])
    w_dot = rpy.CalcAngularVelocityInParentFromRpyDt(accelerations[:3])  # the same map, from rest
    received = w @ I_W @ w_dot + mechanism.plate.mass * rates[3:] @ accelerations[3:]

    h = 1e-7
    ahead, behind = (mechanism.crank_angles(pose + s * h * rates) for s in (1, -1))
    alpha_dot = (ahead - behind) / (2 * h)
    np.testing.assert_allclose(received, torque @ alpha_dot, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_printed_form_is_the_formula_of_the_paper(seed):
    """(11)-(19) as they stand, with e_N the crank's tangent; geometry built from Drake's frames."""
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    pose = random_pose(rng, mechanism)
    R_WP = RollPitchYaw(pose[:3]).ToRotationMatrix().matrix()
    tau_1, tau_2 = np.zeros((6, 6)), np.zeros((6, 6))
    for i, alpha in enumerate(mechanism.crank_angles(pose)):
        x, y, _ = mechanism.R_WS[i].T
        u = mechanism.crank_lengths[i]
        p = R_WP @ mechanism.p_PQ[i]
        tip = mechanism.p_WS[i] + u * (np.cos(alpha) * x + np.sin(alpha) * y)
        e_N = -np.sin(alpha) * x + np.cos(alpha) * y
        e_l = pose[3:] + p - tip
        e_l /= np.linalg.norm(e_l)
        tau_1[:, i] = [*np.cross(p, e_l), *e_l]  # (14)
        tau_2[i, i] = e_l @ e_N / u  # (16)
    inertia = np.diag([*mechanism.plate.inertia, *[mechanism.plate.mass] * 3])
    tau_tot = np.linalg.inv(inertia) @ tau_1 @ tau_2  # (19)
    printed = torque_map(mechanism, pose, "printed")
    np.testing.assert_allclose(printed, tau_tot, rtol=1e-10, atol=1e-12)


def test_forms_differ_by_the_squared_force_factor_where_the_plate_is_level():
    """e_l . e_N stands in the numerator of (15) as printed, in the denominator by virtual work."""
    pose = PAPER.home + [0, 0, 0, 0.02, -0.01, 0.06]
    factor = leg_geometry(PAPER, pose).transmission
    assert np.ptp(np.abs(factor)) > 0.01
    np.testing.assert_allclose(
        torque_map(PAPER, pose, "printed"), torque_map(PAPER, pose) * factor**2, rtol=1e-12
    )


def test_map_over_predicts_angular_accelerations_about_twofold():
    """Seen from the plate, the legs have about the rotational inertia of the plate itself."""
    tau_tot = torque_map(PAPER, PAPER.home)
    exact = acceleration_per_torque(PAPER, PAPER.home)
    angular = np.linalg.norm(tau_tot[:3], axis=1) / np.linalg.norm(exact[:3], axis=1)
    linear = np.linalg.norm(tau_tot[3:], axis=1) / np.linalg.norm(exact[3:], axis=1)
    assert np.all((angular > 1.6) & (angular < 2.4))
    assert np.all((linear > 1.0) & (linear < 1.5))


def test_poses_out_of_reach_are_refused():
    with pytest.raises(UnreachablePoseError):
        torque_map(PAPER, PAPER.home + [0, 0, 0, 0, 0, 0.3])
