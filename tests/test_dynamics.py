"""`StewartDynamics` against Drake's tree closed by coordinate partitioning, and against physics."""

import functools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stewart_drake.core.layout import DEAD_CENTRE_SINE, DEFAULT_GRAVITY
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.mechanism.kinematics import (
    UnreachablePoseError,
    angle_rate_map,
    rotation,
)
from stewart_drake.scenario.signals import (
    BIAS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    PLANT_PARAMETERS,
    WRENCH,
)
from stewart_drake.types import Array
from tests.mechanisms import PAPER, SPREAD, random_mechanism, random_pose
from tests.oracles import (
    PartitionedTree,
    central_difference,
    central_difference_linearization,
    field,
    integrate,
    off_dead_centre,
    relative,
    size,
)

State = tuple[StewartDynamics, Array, Array]

AMPLITUDE = np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08])
TIMES = (0.0, 0.4, 1.2, 1.6, 4.7)
"""Instants of the trajectory (46), s: at home, ..., next to its top, next to its bottom."""
ALTERNATING = np.array([1.0, -1, 1, -1, 1, -1])
AT_REST = np.zeros(6)


all_free = functools.partial(StewartDynamics, free=PLANT_PARAMETERS)
"""Dynamics whose methods take all parameters of the plant (22,)."""


def random_parameters(rng):
    """Bias, payload, damping, Coulomb friction and its speed, payload's place, wrench (22,)."""
    friction = rng.uniform([0.1, 0.0, 0.0, 0.05], [2.0, 0.1, 0.1, 1.0])
    place, wrench = rng.normal(0, 0.05, 3), rng.normal(0, 1, 6)
    no_ball_joints = [0.0, 0.0, 0.1]
    return np.concatenate([rng.normal(0, 0.1, 6), friction, place, no_ball_joints, wrench])


@functools.cache
def shared(index):
    """Dynamics with gravity of the paper's mechanism (-1) or of a random one (0, 1, ...)."""
    rng = np.random.default_rng(abs(index))
    return all_free(PAPER if index < 0 else random_mechanism(rng))


def friction(parameters, crank_rates):
    """Torque (6,) against the cranks."""
    coulomb, speed = parameters[COULOMB], parameters[COULOMB_SPEED]
    return parameters[DAMPING] * crank_rates + coulomb * np.tanh(crank_rates / speed)


def trajectory(t):
    """Pose, rates and accelerations of the trajectory (46)."""
    sine, cosine = AMPLITUDE * np.sin(t), AMPLITUDE * np.cos(t)
    return np.array([0, 0, 0, 0, 0, 0.38]) + sine, cosine, -sine


def assert_agrees(dynamics, tree, rng, poses):
    """Accelerations, inverse dynamics, equilibrium and energy agree with the oracle's to 1e-9."""
    mechanism = dynamics.mechanism
    for _ in range(poses):
        pose, rates = random_pose(rng, mechanism), rng.normal(0, 1, 6) * size(mechanism)
        torque, parameters = rng.normal(0, 1, 6), random_parameters(rng)
        calls = {
            "accelerations": (pose, rates, torque, parameters),
            "inverse_dynamics": (pose, rates, 10 * torque, parameters),
            "equilibrium_torque": (pose, parameters),
        }
        for name, arguments in calls.items():
            value, expected = (getattr(m, name)(*arguments) for m in (dynamics, tree))
            assert relative(value, expected) < 1e-9
        gained, expected = (
            m.energy(pose, rates, parameters) - m.energy(mechanism.home, AT_REST, parameters)
            for m in (dynamics, tree)
        )
        assert gained == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("gravity", [True, False])
def test_agrees_with_the_oracle_for_the_paper(gravity):
    rng = np.random.default_rng(46)
    assert_agrees(all_free(PAPER, gravity), PartitionedTree(PAPER, gravity), rng, 500)


@pytest.mark.parametrize("index", range(50))
def test_agrees_with_the_oracle_for_random_mechanisms(index):
    rng = np.random.default_rng(index)
    dynamics = all_free(random_mechanism(rng))
    for gravity in (True, False):
        # An argument of the compiled functions: nothing is built a second time.
        dynamics.gravity = DEFAULT_GRAVITY * gravity
        assert_agrees(dynamics, PartitionedTree(dynamics.mechanism, gravity), rng, 4)


def test_gravity_is_a_switch_or_a_number():
    given_as = (True, np.True_, False, np.False_, 1.62)
    assert [StewartDynamics(PAPER, g).gravity for g in given_as] == [9.81, 9.81, 0.0, 0.0, 1.62]


# Conservation laws.


@pytest.mark.parametrize("index", range(-1, 5))
def test_energy_is_kept_without_torque_and_gravity(index):
    mechanism, rng = shared(index).mechanism, np.random.default_rng(index + 1)
    dynamics = StewartDynamics(mechanism, False)
    rates = rng.normal(0, 1, 6) * size(mechanism) * ([0.1] * 3 + [0.03] * 3)
    start = np.concatenate([mechanism.home, rates])
    motion = integrate(field(dynamics.accelerations, AT_REST), start, 1.0)
    assert all(off_dead_centre(mechanism, x[:6]) > 0.2 for x in motion)
    energy = np.array([dynamics.energy(x[:6], x[6:]) for x in motion])
    assert np.ptp(energy) < 1e-9 * energy[0]


@pytest.mark.parametrize("index", range(-1, 3))
def test_energy_changes_by_the_work_of_torque_bias_and_friction(index):
    dynamics, rng = shared(index), np.random.default_rng(index + 1)
    mechanism = dynamics.mechanism
    parameters = np.concatenate([rng.normal(0, 0.05, 6), [0.5, 0.05, 0.03, 0.2]])
    parameters = plant_parameters(np.append(parameters, [0.03, -0.02, 0.05]))
    span = size(mechanism) * (1.0 if mechanism is PAPER else 0.3)

    def with_work(x):
        """x = [pose; rates; work; time]; the torque pulls the plate after the trajectory (46)."""
        pose, rates, target = x[:6], x[6:12], mechanism.home + span * AMPLITUDE * np.sin(x[13])
        accelerations = 100 * (target - pose) - 20 * rates
        torque = dynamics.inverse_dynamics(pose, rates, accelerations, parameters)
        crank_rates = mechanism.jacobian(pose) @ rates
        power = (torque + parameters[BIAS] - friction(parameters, crank_rates)) @ crank_rates
        x_dot = field(dynamics.accelerations, torque, parameters)(x[:12])
        return np.concatenate([x_dot, [power, 1.0]])

    motion = integrate(with_work, np.concatenate([mechanism.home, np.zeros(8)]), 1.5)
    assert all(off_dead_centre(mechanism, x[:6]) > 0.2 for x in motion)
    energy = np.array([dynamics.energy(x[:6], x[6:12], parameters) for x in motion])
    gained = energy - energy[0]
    assert np.abs(gained - motion[:, 12]).max() < 1e-9 * np.abs(gained).max()


@st.composite
def states(draw):
    """Dynamics with a pose well within reach, and rates."""
    dynamics = shared(draw(st.integers(-1, 4)))
    mechanism, unit = dynamics.mechanism, st.floats(-1, 1)
    pose, rates = (np.array(draw(st.tuples(*[unit] * 6))) for _ in range(2))
    pose = mechanism.home + pose * SPREAD * size(mechanism)
    assume(off_dead_centre(mechanism, pose) > 0.2)
    return dynamics, pose, rates * size(mechanism)


@settings(max_examples=200, deadline=None)
@given(states(), st.floats(0, 5))
def test_mass_matrix_is_symmetric_positive_definite(state, payload):
    dynamics, pose, rates = state
    parameters = plant_parameters()
    parameters[PAYLOAD], parameters[PAYLOAD_POSITION] = payload, 0.1 * pose[:3]
    mass = dynamics.mass_matrix(pose, parameters)
    assert relative(mass.T, mass) < 1e-14
    assert np.linalg.eigvalsh(mass).min() > 0
    kinetic = dynamics.energy(pose, rates, parameters) - dynamics.energy(pose, AT_REST, parameters)
    assert kinetic == pytest.approx(rates @ mass @ rates / 2, rel=1e-10, abs=1e-10)


@settings(max_examples=200, deadline=None)
@given(states(), st.integers(0, 2**32 - 1))
def test_inverse_dynamics_inverts_accelerations(state, seed):
    (dynamics, pose, rates), rng = state, np.random.default_rng(seed)
    torque, parameters = rng.normal(0, 1, 6), random_parameters(rng)
    accelerations = dynamics.accelerations(pose, rates, torque, parameters)
    found = dynamics.inverse_dynamics(pose, rates, accelerations, parameters)
    assert relative(found, torque) < 1e-10
    home = np.append(dynamics.mechanism.home, np.zeros(12))
    rows = np.array([home, np.concatenate([pose, rates, accelerations])])
    still = dynamics.inverse_dynamics(*np.split(home, 3), parameters)
    np.testing.assert_array_equal(dynamics.torques_along(rows, parameters), [still, found])
    again = dynamics.accelerations(pose, rates, found, parameters)
    assert relative(again, accelerations) < 1e-10
    jacobian = dynamics.mechanism.jacobian(pose)
    assert relative(dynamics.actuation_map(pose), jacobian.T) < 1e-11
    shaft = torque + parameters[BIAS] - friction(parameters, jacobian @ rates)
    left = dynamics.mass_matrix(pose, parameters) @ accelerations
    moment, push = np.split(parameters[WRENCH], 2)
    shaft_and_push = jacobian.T @ shaft + np.append(angle_rate_map(pose[:3]).T @ moment, push)
    assert relative(left, shaft_and_push - dynamics.bias(pose, rates, parameters)) < 1e-9


# Linearisation and prediction.


@pytest.mark.parametrize("gravity", [True, False])
@pytest.mark.parametrize("t", TIMES)
def test_derivatives_equal_central_differences_of_the_oracle(t, gravity):
    dynamics, tree = all_free(PAPER, gravity), PartitionedTree(PAPER, gravity)
    parameters = [0.01, -0.02, 0.03, 0.01, 0, 0.02, 0.5, 0.01, 0.02, 0.5, 0.1, -0.05, 0.2]
    no_ball_joints, wrench = [0.0, 0.0, 0.1], [0.1, -0.2, 0.1, 1.0, -2.0, 0.5]
    parameters = np.array([*parameters, *no_ball_joints, *wrench])
    pose, rates, accelerations = trajectory(t)
    torque = tree.inverse_dynamics(pose, rates, accelerations, parameters) + 0.1 * ALTERNATING
    state = np.concatenate([pose, rates])
    A, B = central_difference_linearization(tree, state, torque, parameters)
    G = central_difference(lambda p: field(tree.accelerations, torque, p)(state), parameters)
    found = dynamics.derivatives(pose, rates, torque, parameters)
    for value, expected in zip(found, (A, B, G), strict=True):
        assert relative(value, expected) < 1e-6


@pytest.mark.parametrize(
    "free",
    [("coulomb_friction",), ("payload_position_z", "offset_A1", "payload_mass"), PARAMETERS, ()],
)
def test_what_is_free_is_taken_out_of_all_parameters(free):
    """In its order; what the plant does not have changes nothing, and has a column of zeros."""
    rng = np.random.default_rng(1)
    whole, other = random_parameters(rng), random_parameters(rng)
    (pose, rates, _), torque = trajectory(0.4), 0.1 * ALTERNATING
    some, every = StewartDynamics(PAPER, True, whole, free), all_free(PAPER)
    assert np.array_equal(
        some.accelerations(pose, rates, torque), every.accelerations(pose, rates, torque, whole)
    )
    theta, expected = rng.normal(0, 1, len(free)), whole.copy()
    places = [PLANT_PARAMETERS.index(name) if name in PLANT_PARAMETERS else None for name in free]
    for i, place in enumerate(places):
        if place is not None:
            expected[place] = theta[i] = other[place]
    assert np.array_equal(some.complete(theta), expected)
    assert np.array_equal(some.plant_parameters, whole)
    found = some.derivatives(pose, rates, torque, theta)
    of_all = every.derivatives(pose, rates, torque, expected)
    assert relative(found.A, of_all.A) < 1e-12
    assert found.G.shape == (12, len(free))
    for i, place in enumerate(places):
        column = np.zeros(12) if place is None else of_all.G[:, place]
        assert found.G[:, i] == pytest.approx(column, rel=1e-12)
    moved = some.assuming(theta)
    assert np.array_equal(moved.plant_parameters, expected)
    assert moved.free == free
    known = [0.0 if place is None else value for place, value in zip(places, theta, strict=True)]
    assert np.array_equal(moved.parameters, known)


def test_a_point_mass_is_where_it_is_said_to_be():
    """Its weight asks for a moment r x m g more, at rest; turned with the plate."""
    mass, r, pose = 0.7, np.array([0.04, -0.03, 0.1]), trajectory(0.4)[0]
    at_com = all_free(PAPER, True, [*np.zeros(6), mass, 0.0])
    parameters = at_com.plant_parameters.copy()
    parameters[PAYLOAD_POSITION] = r
    torque = at_com.equilibrium_torque(pose, parameters) - at_com.equilibrium_torque(pose)
    moment = np.cross(rotation(pose[:3]) @ r, [0, 0, -9.81 * mass])
    generalised = np.append(angle_rate_map(pose[:3]).T @ moment, np.zeros(3))
    assert at_com.actuation_map(pose) @ torque == pytest.approx(-generalised, abs=1e-12)


def test_poles_under_gravity():
    dynamics, tree, fastest = shared(-1), PartitionedTree(PAPER), []
    for t in TIMES:
        pose = trajectory(t)[0]
        state, torque = np.concatenate([pose, AT_REST]), tree.equilibrium_torque(pose)
        found = dynamics.linearize(pose)
        expected = central_difference_linearization(tree, state, torque)
        assert all(relative(*pair) < 1e-6 for pair in zip(found, expected, strict=True))
        poles, reference = (np.sort(np.linalg.eigvals(m[0]).real) for m in (found, expected))
        assert relative(poles, reference) < 1e-6
        fastest.append(poles[-1])
    assert fastest[0] == pytest.approx(5.0, abs=0.05)
    assert fastest[TIMES.index(1.6)] > 30
    held = dynamics.equilibrium_torque(PAPER.home)
    assert held == pytest.approx(0.983 * ALTERNATING, abs=5e-4)


@pytest.mark.parametrize("index", [-1, 0])
def test_prediction_converges_at_fourth_order(index):
    dynamics, rng = shared(index), np.random.default_rng(5)
    home = dynamics.mechanism.home
    torques = dynamics.equilibrium_torque(home) + rng.normal(0, 0.1, (4, 6))
    durations, parameters = np.array([0.04, 0.05, 0.03, 0.06]), random_parameters(rng) * 0.1
    parameters[COULOMB_SPEED] = 1.0  # far longer than a step
    state = np.concatenate([home, rng.normal(0, 0.1, 6) * size(dynamics.mechanism)])
    exact, now = [], state
    for torque, duration in zip(torques, durations, strict=True):
        now = integrate(field(dynamics.accelerations, torque, parameters), now, duration)[-1]
        exact.append(now)
    substeps = (4, 8, 16, 32)
    found = [dynamics.predict(state, torques, durations, n, parameters) for n in substeps]
    errors = [relative(states, np.array(exact)) for states in found]
    order = -np.polyfit(np.log(substeps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.2)

    at_once = dynamics.predict(state, torques, durations, 3, parameters)
    for torque, duration, expected in zip(torques, durations, at_once, strict=True):
        state = dynamics.predict(state, torque, duration, 3, parameters)[0]
        assert relative(state, expected) < 1e-14


def test_prediction_of_nothing():
    state = np.concatenate([PAPER.home, np.full(6, 0.1)])
    assert shared(-1).predict(state, [], []).shape == (0, 12)
    assert np.array_equal(shared(-1).predict(state, np.ones((2, 6)), 0.0), [state, state])


# Outside the workspace.


@pytest.mark.parametrize("index", range(-1, 6))
def test_continuation_across_the_boundary_is_smooth(index):
    dynamics, rng = shared(index), np.random.default_rng(index + 1)
    mechanism = dynamics.mechanism
    direction = rng.normal(0, 1, 6) * size(mechanism) * ([1.0] * 3 + [0.2] * 3)
    rates, torque = rng.normal(0, 0.3, 6) * size(mechanism), rng.normal(0, 1, 6)

    def furthest(sine):
        """How far along the direction no leg is closer to its dead centre."""
        low, high = 0.0, 0.01
        while off_dead_centre(mechanism, mechanism.home + high * direction) > sine:
            low, high = high, high + 0.01
        while low < (middle := (low + high) / 2) < high:
            inside = off_dead_centre(mechanism, mechanism.home + middle * direction) > sine
            low, high = (middle, high) if inside else (low, middle)
        return low

    held, edge = furthest(DEAD_CENTRE_SINE), furthest(0.0)
    pose = mechanism.home + held * direction
    # Rounding of the model file grows with the inverse square of the sine.
    expected = PartitionedTree(mechanism).accelerations(pose, rates, torque)
    assert relative(dynamics.accelerations(pose, rates, torque), expected) < 1e-8

    def roughness(cells):
        """Largest jump of the slope between cells, which shrinks with the cells unless it kinks."""
        along = np.linspace(2 * held - edge, 2 * edge - held, cells + 1)
        poses = mechanism.home + along[:, None] * direction
        values = np.array([dynamics.accelerations(pose, rates, torque) for pose in poses])
        slopes = np.diff(values, axis=0) / (along[1] - along[0])
        return float(np.linalg.norm(np.diff(slopes, axis=0), axis=1).max())

    assert roughness(800) < 0.3 * roughness(200)


@pytest.mark.parametrize("index", range(-1, 6))
def test_derivatives_stay_finite_far_out_of_reach(index):
    dynamics, rng = shared(index), np.random.default_rng(index + 1)
    for distance in np.repeat([0.1, 0.3, 1, 10, 1e3, 1e6], 100):
        pose = dynamics.mechanism.home + rng.normal(0, 1, 6) * ([1.0] * 3 + [distance] * 3)
        rates, torque = rng.normal(0, 1, (2, 6))
        assert np.all(np.isfinite(dynamics.accelerations(pose, rates, torque)))
        assert np.all(np.isfinite(dynamics.derivatives(pose, rates, torque).A))
    with pytest.raises(UnreachablePoseError, match="out of reach"):
        dynamics.equilibrium_torque(pose)


def test_start_up_needs_no_torch():
    code = """if True:
        import sys, stewart_drake.mechanism.files as files, stewart_drake.dynamics.stewart as plant
        paper = files.load_mechanism("paper")
        plant.StewartDynamics(paper).accelerations(paper.home, [0.0] * 6, [0.0] * 6)
        assert "torch" not in sys.modules"""
    subprocess.run([sys.executable, "-c", code], check=True)
