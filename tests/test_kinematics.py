"""Kinematics against constructions that share no code with it: Drake's rotations, brute force."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.optimize import minimize_scalar

from stewart_drake.core.library import core
from stewart_drake.dynamics.workspace import margin
from stewart_drake.mechanism.assembly import joint_state
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import (
    ForwardKinematicsError,
    SingularPoseError,
    UnreachablePoseError,
    angle_rate_map,
    leg_geometry,
    rotation,
)
from tests import singular
from tests.mechanisms import PAPER, random_mechanism, random_pose

seeds = st.integers(0, 2**32 - 1)
seeded = settings(max_examples=40, deadline=None, derandomize=True)


def random_machine(rng):
    """Return a random mechanism whose legs use either crank branch."""
    return dataclasses.replace(random_mechanism(rng), branches=rng.choice([-1, 1], 6))


def crank_tips(mechanism, angles):
    """p_WT (6, 3): the cranks turned by Drake."""
    return np.array(
        [
            p + u * AngleAxis(angle, R[:, 2]).rotation() @ R[:, 0]
            for p, R, u, angle in zip(
                mechanism.p_WS, mechanism.R_WS, mechanism.crank_lengths, angles, strict=True
            )
        ]
    )


def plate_joints(mechanism, pose):
    """p_WQ (6, 3): the plate placed by Drake."""
    X_WP = RigidTransform(RollPitchYaw(np.array(pose[:3])), np.array(pose[3:]))
    return X_WP.multiply(mechanism.p_PQ.T).T


def rod_lengths(mechanism, pose, angles):
    return np.linalg.norm(plate_joints(mechanism, pose) - crank_tips(mechanism, angles), axis=1)


def turn(a, b):
    """Smallest angles from b to a."""
    return (a - b + np.pi) % (2 * np.pi) - np.pi


# ------------------------------------------------------------------ rotations


@pytest.mark.parametrize("seed", range(20))
def test_rotation_and_angle_rates_are_those_of_drake(seed):
    rng = np.random.default_rng(seed)
    rpy, rates = rng.uniform(-np.pi, np.pi, 3), rng.normal(size=3)
    drake = RollPitchYaw(rpy)
    np.testing.assert_allclose(rotation(rpy), RotationMatrix(drake).matrix(), atol=1e-15)
    np.testing.assert_allclose(
        angle_rate_map(rpy) @ rates, drake.CalcAngularVelocityInParentFromRpyDt(rates), atol=1e-14
    )
    h = 1e-6  # R_dot R' = [w] x
    R_dot = (rotation(rpy + h * rates) - rotation(rpy - h * rates)) / (2 * h)
    W = R_dot @ rotation(rpy).T
    w = [W[2, 1], W[0, 2], W[1, 0]]
    np.testing.assert_allclose(angle_rate_map(rpy) @ rates, w, atol=1e-8)


# ------------------------------------------------------------------ pose -> cranks


@seeded
@given(seeds)
def test_branches_are_the_two_solutions_on_either_side_of_the_joint(seed):
    rng = np.random.default_rng(seed)
    plus = dataclasses.replace(random_mechanism(rng), branches=np.ones(6))
    minus = dataclasses.replace(plus, branches=-np.ones(6))
    pose = random_pose(rng, plus)
    p_SQ_S = np.einsum("lij,li->lj", plus.R_WS, plate_joints(plus, pose) - plus.p_WS)
    azimuth = np.arctan2(p_SQ_S[:, 1], p_SQ_S[:, 0])
    to_plus = turn(plus.crank_angles(pose), azimuth)
    to_minus = turn(minus.crank_angles(pose), azimuth)
    assert np.all(to_plus > 0)
    np.testing.assert_allclose(to_minus, -to_plus, atol=1e-12)
    for mechanism in (plus, minus):
        lengths = rod_lengths(mechanism, pose, mechanism.crank_angles(pose))
        np.testing.assert_allclose(lengths, mechanism.rod_lengths, rtol=1e-13)


@seeded
@given(seeds)
def test_leg_geometry_is_that_of_the_assembled_leg(seed):
    rng = np.random.default_rng(seed)
    mechanism = random_machine(rng)
    pose = random_pose(rng, mechanism)
    legs = leg_geometry(mechanism, pose)
    angles, h = mechanism.crank_angles(pose), 1e-6
    tips, u = crank_tips(mechanism, angles), mechanism.crank_lengths[:, None]
    np.testing.assert_allclose(mechanism.p_WS + u * legs.crank, tips, atol=1e-13)
    motion = (crank_tips(mechanism, angles + h) - crank_tips(mechanism, angles - h)) / (2 * h)
    np.testing.assert_allclose(u * legs.tangent, motion, atol=1e-9)
    rod = plate_joints(mechanism, pose) - tips
    np.testing.assert_allclose(mechanism.rod_lengths[:, None] * legs.rod, rod, atol=1e-13)
    cosine = np.sum(rod * motion, axis=1) / (mechanism.rod_lengths * mechanism.crank_lengths)
    np.testing.assert_allclose(legs.transmission, cosine, atol=1e-8)


@seeded
@given(seeds)
def test_jacobian_is_the_derivative_of_the_crank_angles(seed):
    rng = np.random.default_rng(seed)
    mechanism = random_machine(rng)
    pose, h = random_pose(rng, mechanism), 1e-6
    differences = [
        turn(mechanism.crank_angles(pose + step), mechanism.crank_angles(pose - step)) / (2 * h)
        for step in h * np.eye(6)
    ]
    np.testing.assert_allclose(
        mechanism.jacobian(pose), np.column_stack(differences), rtol=1e-6, atol=1e-6
    )


# ------------------------------------------------------------------ cranks -> pose


@seeded
@given(seeds)
def test_poses_of_any_mechanism_survive_the_round_trip(seed):
    rng = np.random.default_rng(seed)
    mechanism = random_machine(rng)
    pose = random_pose(rng, mechanism)
    back = mechanism.forward_kinematics(mechanism.crank_angles(pose))
    np.testing.assert_allclose(back, pose, atol=1e-10)


@seeded
@given(seeds)
def test_forward_kinematics_returns_an_assembly_or_raises(seed):
    """Any guess and crank angles: a returned pose closes all loops on its branches."""
    rng = np.random.default_rng(seed)
    angles = PAPER.crank_angles(PAPER.home) + rng.uniform(-1.5, 1.5, 6)
    guess = PAPER.home + rng.uniform(-1, 1, 6) * [1.5, 1.5, 3, 0.5, 0.5, 0.5]
    try:
        pose = PAPER.forward_kinematics(angles, guess)
    except ForwardKinematicsError:
        return
    np.testing.assert_allclose(rod_lengths(PAPER, pose, angles), PAPER.rod_lengths, rtol=1e-11)
    np.testing.assert_allclose(turn(PAPER.crank_angles(pose), angles), 0, atol=1e-6)


def test_forward_kinematics_refuses_angles_that_no_pose_has():
    """Two legs whose plate joints are neighbours, their tips further apart than both rods reach."""
    short = dataclasses.replace(
        PAPER,
        home=[0, 0, 0, 0, 0, 0.30],
        crank_lengths=np.full(6, 0.26),
        rod_lengths=np.full(6, 0.29),
    )
    grid = np.linspace(-np.pi, np.pi, 361)
    sweep = np.array([crank_tips(short, np.full(6, angle)) for angle in grid])
    apart = np.linalg.norm(sweep[:, None, 0] - sweep[None, :, 5], axis=-1)
    first, last = np.unravel_index(apart.argmax(), apart.shape)
    assert apart.max() > 2 * 0.29 + np.linalg.norm(short.p_PQ[0] - short.p_PQ[5]) + 0.05
    angles = short.crank_angles(short.home)
    angles[[0, 5]] = grid[first], grid[last]
    with pytest.raises(ForwardKinematicsError, match=r"did not converge.*guess"):
        short.forward_kinematics(angles)


@pytest.mark.parametrize("leg", range(6))
def test_forward_kinematics_refuses_the_other_crank_branch(leg):
    flipped = PAPER.branches * np.where(np.arange(6) == leg, -1, 1)
    other = dataclasses.replace(PAPER, branches=flipped)
    pose = PAPER.home + [0.1, -0.05, 0.1, 0.01, 0, 0.02]
    angles = other.crank_angles(pose)
    np.testing.assert_allclose(other.forward_kinematics(angles, pose), pose, atol=1e-12)
    with pytest.raises(ForwardKinematicsError, match=f"other crank branch on leg {leg + 1}"):
        PAPER.forward_kinematics(angles, pose)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_none_are_refused(bad):
    pose = PAPER.home.copy()
    pose[5] = bad
    with pytest.raises(UnreachablePoseError), np.errstate(invalid="ignore"):
        PAPER.crank_angles(pose)
    with pytest.raises(ForwardKinematicsError), np.errstate(invalid="ignore"):
        PAPER.forward_kinematics([bad, 0, 0, 0, 0, 0])


# ------------------------------------------------------------------ reach


def distance_to_crank_circle(mechanism, leg, p_WQ):
    """Smallest and largest distance from a point to the circle of a crank's tip, by search."""
    R, u = mechanism.R_WS[leg], mechanism.crank_lengths[leg]

    def distance(angle):
        tip = mechanism.p_WS[leg] + u * AngleAxis(angle, R[:, 2]).rotation() @ R[:, 0]
        return float(np.linalg.norm(p_WQ - tip))

    grid = np.linspace(-np.pi, np.pi, 37)
    sampled = [distance(angle) for angle in grid]
    best = []
    for sign, start in ((1, grid[np.argmin(sampled)]), (-1, grid[np.argmax(sampled)])):
        found = minimize_scalar(
            lambda angle, sign=sign: sign * distance(angle),
            bounds=(start - 0.2, start + 0.2),
            options={"xatol": 1e-9},
            method="bounded",
        )
        best.append(sign * found.fun)
    return best[0], best[1]


@settings(seeded, max_examples=20)
@given(seeds)
def test_reach_margins_are_what_a_search_over_the_crank_circle_finds(seed):
    """Poses are within reach, out of reach, and too close to the base for the rod."""
    rng = np.random.default_rng(seed)
    mechanism = random_machine(rng)
    pose = mechanism.home + rng.uniform(-1, 1, 6) * [1, 1, 1, 0.3, 0.3, 0.6]
    found = []
    for leg, p_WQ in enumerate(plate_joints(mechanism, pose)):
        nearest, farthest = distance_to_crank_circle(mechanism, leg, p_WQ)
        rod = mechanism.rod_lengths[leg]
        found.append(min(rod - nearest, farthest - rod))
    np.testing.assert_allclose(mechanism.reach_margins(pose), found, atol=1e-9)


@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("beyond", [1e-6, 0.012, 0.3])
def test_error_names_the_legs_and_how_far_each_is_out_of_reach(leg, beyond):
    rng = np.random.default_rng(leg)
    mechanism = random_machine(rng)
    pose = random_pose(rng, mechanism)
    # Straight away from the nearest point that the crank's tip can have.
    p_WQ = plate_joints(mechanism, pose)[leg]
    axis = mechanism.R_WS[leg][:, 2]
    from_shaft = p_WQ - mechanism.p_WS[leg]
    in_plane = from_shaft - (from_shaft @ axis) * axis
    nearest = mechanism.p_WS[leg] + mechanism.crank_lengths[leg] * in_plane / np.linalg.norm(
        in_plane
    )
    away = p_WQ - nearest
    slack = mechanism.rod_lengths[leg] - np.linalg.norm(away)
    pose[3:] += (slack + beyond) * away / np.linalg.norm(away)

    with pytest.raises(UnreachablePoseError) as caught:
        mechanism.crank_angles(pose)
    error = caught.value
    assert isinstance(error, ValueError)
    np.testing.assert_allclose(error.margins[leg], -beyond, atol=1e-12)
    assert f"leg {leg + 1} short by {1e3 * beyond:.3g} mm" in str(error)
    margins = mechanism.reach_margins(pose)
    assert error.legs == tuple(i for i in range(1, 7) if margins[i - 1] < 0)
    assert all((f"leg {i} " in str(error)) == (i in error.legs) for i in range(1, 7))
    for method in (mechanism.jacobian, lambda p: leg_geometry(mechanism, p)):
        with pytest.raises(UnreachablePoseError):
            method(pose)
        with pytest.raises(UnreachablePoseError, match="numbers that are not finite"):
            method(np.full(6, np.nan))


# ------------------------------------------------------------------ dead centre


@pytest.fixture
def stretched():
    """Leg 1 exactly at its dead centre at home."""
    return singular.stretched()


def test_dead_centre_is_the_edge_of_reach(stretched):
    home = stretched.home
    assert stretched.reach_margins(home)[0] == 0
    assert stretched.crank_angles(home)[0] == 0
    assert leg_geometry(stretched, home).transmission[0] == 0
    with pytest.raises(UnreachablePoseError, match="leg 1 short by 1e-06 mm"):
        stretched.crank_angles(home + [0, 0, 0, 1e-9, 0, 0])
    # Inside by x the triangle of crank, rod and u + l - x has the angle sqrt(2 x l / (u (u + l))).
    inside = home - [0, 0, 0, 1e-9, 0, 0]
    angle = abs(stretched.crank_angles(inside)[0])
    u, rod = 0.125, 0.375
    np.testing.assert_allclose(angle, np.sqrt(2e-9 * rod / (u * (u + rod))), rtol=1e-6)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_jacobian_at_a_dead_centre_names_the_leg(stretched):
    """A millimetre inside it is there, and large: the crank's angle goes with the square root."""
    with pytest.raises(SingularPoseError, match="dead centre of leg 1") as caught:
        stretched.jacobian(stretched.home)
    assert caught.value.legs == (1,)
    with pytest.raises(SingularPoseError):
        joint_state(stretched, stretched.home, np.array([0, 0, 0, 1.0, 0, 0]))
    at_rest = joint_state(stretched, stretched.home, np.zeros(6))
    assert not at_rest.crank_rate.any() and np.isfinite(at_rest.universal).all()
    # From sqrt(2 x l / (u (u + l))): half of it over x.
    u, rod, x = 0.125, 0.375, 1e-6
    inside = stretched.home - [0, 0, 0, x, 0, 0]
    expected = np.sqrt(2 * rod / (u * (u + rod) * x)) / 2
    np.testing.assert_allclose(abs(stretched.jacobian(inside)[0, 3]), expected, rtol=1e-4)


def test_forward_kinematics_passes_through_a_dead_centre(stretched):
    home = stretched.home
    angles = stretched.crank_angles(home)
    for seed in range(10):
        guess = home + np.random.default_rng(seed).normal(0, 0.01, 6)
        np.testing.assert_allclose(stretched.forward_kinematics(angles, guess), home, atol=1e-12)


# ------------------------------------------------------------------ the paper's mechanism


def test_trajectory_of_the_paper_is_within_reach_and_well_conditioned():
    """Equation (46); the angle between rod and crank tangent is taken from Drake's rotations."""
    amplitude = np.array([np.pi / 12, np.pi / 12, np.pi / 12, 0.02, 0.02, 0.08])
    worst, closest = 1.0, np.inf
    for t in np.linspace(0, 2 * np.pi, 400, endpoint=False):
        pose = amplitude * np.sin(t) + [0, 0, 0, 0, 0, 0.38]
        angles = PAPER.crank_angles(pose)
        closest = min(closest, PAPER.reach_margins(pose).min())
        h = 1e-6
        tangent = (crank_tips(PAPER, angles + h) - crank_tips(PAPER, angles - h)) / (2 * h * 0.11)
        rod = (plate_joints(PAPER, pose) - crank_tips(PAPER, angles)) / 0.404
        worst = min(worst, np.abs(np.sum(rod * tangent, axis=1)).min())
    np.testing.assert_allclose(worst, 0.40, atol=0.01)
    assert closest == pytest.approx(7.4e-3, abs=5e-5)


# ------------------------------------------------------------------ the compiled core


def joined_to_home(mechanism, number):
    """Poses at the ends of straight lines from home that stay within the workspace."""
    rng, scale = np.random.default_rng(1), np.repeat([3.0, 4 * mechanism.crank_lengths.max()], 3)
    found = []
    while len(found) < number:
        way, last = rng.normal(size=6), None
        for share in np.linspace(0, 1, 61)[1:]:
            pose = mechanism.home + share * scale * way / np.linalg.norm(way)
            if not (margin(mechanism, pose) > 0 and mechanism.reach_margins(pose).min() > 0):
                break
            last = pose
        if last is not None:
            found.append(last)
    return found


@pytest.mark.parametrize("name", ["desktop", "motion_base", "paper", "paper_clear"])
def test_the_core_has_the_same_kinematics(name):
    """Angles and Jacobian; and every pose up to a singularity, from the guess of home."""
    mechanism, c = load_mechanism(name), core()
    legs, angles, J = np.array(mechanism.numbers), np.empty(6), np.empty((6, 6))
    for pose in joined_to_home(mechanism, 100):
        c.lib.stewart_crank_angles(c.at(legs), c.at(pose), c.at(angles))
        assert c.lib.stewart_crank_jacobian(c.at(legs), c.at(pose), c.at(J))
        np.testing.assert_allclose(angles, mechanism.crank_angles(pose), rtol=0, atol=1e-13)
        np.testing.assert_allclose(J, mechanism.jacobian(pose), rtol=1e-9, atol=1e-9)
        found = mechanism.home.copy()
        given = (c.at(legs), c.at(angles), c.at(found), c.scratch(48))
        assert c.lib.stewart_forward_kinematics(*given)
        np.testing.assert_allclose(found, pose, rtol=0, atol=1e-8)


def test_the_core_refuses_what_no_pose_has():
    c, legs, J = core(), np.array(PAPER.numbers), np.empty((6, 6))
    angles, away = np.array([0.0, 3, 0, 3, 0, 3]), PAPER.home + [0, 0, 0, 0, 0, 1.0]
    found = PAPER.home.copy()
    given = (c.at(legs), c.at(angles), c.at(found), c.scratch(48))
    assert not c.lib.stewart_forward_kinematics(*given)
    assert not c.lib.stewart_crank_jacobian(c.at(legs), c.at(away), c.at(J))
    c.lib.stewart_crank_angles(c.at(legs), c.at(away), c.at(angles))
    assert np.isnan(J).all() and np.isnan(angles).all()
