"""Crank angles as measurement: projections, codes, gates, and the filter against brute force."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss, legvander
from scipy.optimize import least_squares

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Estimate
from stewart_drake.law.filter_settings import filter_settings, usual_parameters
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.sensing import EncoderSensing, Measurement, encoders_of, node_times
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import legs_along
from stewart_drake.scenario.calibration import OFFSETS
from stewart_drake.scenario.signals import PARAMETERS, POSE, RATES
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array
from tests.filters import Filter, Period
from tests.mechanisms import PAPER
from tests.oracles import relative

DT = 0.1
MOTION = np.array([0.26, 0.26, 0.26, 0.02, 0.02, 0.08])
RNG = np.random.default_rng(5)
START = np.concatenate([PAPER.home, MOTION * RNG.uniform(-1, 1, 6)])
THETA = np.array([3e-4, -2e-4, 1e-4, 0.0, 2e-4, -3e-4, 0.3, 5e-4])
PUSH = 0.02 * RNG.uniform(-1, 1, 6)
PERIOD = Period(np.array([PUSH, -PUSH]), np.array([0.03, 0.07]), PUSH, 4)
DYNAMICS = StewartDynamics(PAPER, gravity=False)


def sensing(samples, bits=None, offset=0.0):
    quantum = 0.0 if bits is None else 2 * np.pi / 2**bits
    return EncoderSensing(PAPER, samples, quantum, START, MOTION, MOTION, np.full(6, offset))


def settings(free=PARAMETERS):
    parameters = usual_parameters(PAPER.plate.mass, 0.06, None, 0.1, free)
    return filter_settings(2e-4 * np.tile(MOTION, 2), DT, parameters)


def angles_of(state, theta, samples):
    """(N, 6) of the cranks within PERIOD, by many small steps of the dynamics."""
    t, predicted = np.arange(1, samples + 1) * DT / samples, []
    for end in t:
        first = min(end, 0.03)
        held = np.array([first, end - first])
        states = DYNAMICS.predict(state, PERIOD.torques, np.maximum(held, 1e-12), 60, theta)
        predicted.append(PAPER.crank_angles(states[-1, POSE]))
    return np.array(predicted)


# Projections.


def fit(nodes, t):
    """G (M, N) from residuals at t (N,) to values at nodes (M,), both in [-1, 1]."""
    degree = len(nodes) - 1
    return legvander(nodes, degree) @ np.linalg.pinv(legvander(t, degree))


def projection(samples):
    """Shares (M,) of the period where the nodes are, and G (M, N) of all samples."""
    shares = node_times(samples)
    return shares, fit(2 * shares - 1, 2 * np.arange(1, samples + 1) / samples - 1)


def test_the_nodes_of_many_samples_are_gauss_nodes():
    nodes, weights = leggauss(3)
    shares, G = projection(20000)
    assert np.abs(2 * shares - 1 - nodes).max() < 1e-3
    # Independent values of variance 1 / (N w_j), sum of the weights 1.
    assert relative(20000 * G @ G.T, np.diag(2 / weights)) < 1e-3


@pytest.mark.parametrize("samples", [4, 10, 100])
def test_values_at_the_nodes_are_independent_and_hold_a_parabola(samples):
    shares, G = projection(samples)
    t = np.arange(1, samples + 1) / samples
    covariance = G @ G.T
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 1e-12
    assert G @ (1 - 2 * t + 3 * t**2) == pytest.approx(1 - 2 * shares + 3 * shares**2)
    # With weights w_j = 1 / (N var_j) at the nodes means are those of the samples, to degree 5.
    for power in range(6):
        mean = np.sum(shares**power / np.diag(covariance)) / samples
        assert mean == pytest.approx(np.mean(t**power), rel=1e-9)


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_few_samples_are_their_own_nodes(samples):
    shares, G = projection(samples)
    assert pytest.approx(np.eye(samples), abs=1e-14) == G
    assert shares == pytest.approx(np.arange(1, samples + 1) / samples)


# What is measured.


class Reading(NamedTuple):
    """Quantities that the core reads from a measurement near a motion."""

    angles: Array
    """(N, 6) rad, NaN where they are left out."""
    variance: Array
    """(M, 6) rad^2."""
    has_outliers: list[int]
    """(6,) whether samples of a leg stand out of their period."""
    residuals: Array
    """(M, 6) at the nodes."""


def reading(sensing, said, predicted, last, unchanged):
    """Return the reading of 6 N values near the angles (N, 6) of a motion."""
    c, encoders, nodes = core(), encoders_of(sensing), len(node_times(sensing.samples))
    angles, fit = np.empty((sensing.samples, 6)), np.empty((6, nodes, nodes))
    variance, residuals = np.empty((nodes, 6)), np.empty((nodes, 6))
    it = c.ffi.new("stewart_reading *", list(map(c.at, (angles, fit, variance))))
    given = map(c.at, (said.known(sensing.size), predicted, last, unchanged))
    c.lib.stewart_read(encoders.pointer, *given, it, c.scratch(sensing.samples))
    c.lib.stewart_node_residuals(encoders.pointer, it, c.at(predicted), c.at(residuals))
    return Reading(angles, variance, list(it.has_outliers), residuals)


def test_angles_along_a_path_are_those_of_each_pose():
    poses = PAPER.home + 0.3 * MOTION * RNG.uniform(-1, 1, (50, 6))
    expected = np.array([PAPER.crank_angles(pose) for pose in poses])
    assert np.array_equal(legs_along(PAPER, poses).crank_angles, expected)
    away = PAPER.home + [0, 0, 0, 0, 0, 1.0]
    assert np.all(np.isnan(legs_along(PAPER, away[None]).crank_angles))


def test_the_jacobian_is_that_of_what_is_seen():
    one, state = sensing(2, offset=0.3), START.copy()
    h, found = 1e-6, one.through(START, np.eye(12))
    for i in range(12):
        up, down = state.copy(), state.copy()
        up[i] += h
        down[i] -= h
        difference = (one.seen(up) - one.seen(down)) / (2 * h)
        assert found[:, i] == pytest.approx(difference, abs=1e-7)


def test_a_pose_is_as_uncertain_as_its_angles():
    """Against forward kinematics of angles with noise drawn."""
    one = sensing(1, bits=12)
    truth = PAPER.crank_angles(START[POSE])
    drawn = np.array(
        [
            PAPER.forward_kinematics(truth + one.std * RNG.standard_normal(6), START[POSE])
            for _ in range(2000)
        ]
    )
    first = one.start(Measurement.of(truth), START)
    assert first is not None
    assert first.state == pytest.approx(START, abs=1e-9)
    assert relative(np.cov(drawn.T), first.covariance[POSE, POSE]) < 0.1
    assert np.diag(first.covariance)[RATES] == pytest.approx(MOTION**2)


def test_a_start_bears_spikes_and_a_leg_that_is_silent():
    many = sensing(100)
    poses = START[POSE] + np.linspace(-DT, 0, 101)[1:, None] * START[RATES]
    read = legs_along(PAPER, poses).crank_angles
    read[[10, 95, 99], [0, 3, 5]] += 1.0
    read[:, 4] = np.nan
    first = many.start(Measurement.of(read.ravel()), START)
    assert first is not None
    assert first.state[POSE] == pytest.approx(START[POSE], abs=1e-4)
    # The silent leg is where it is thought to be, within the motion; others are exact.
    along = PAPER.jacobian(START[POSE])
    spread = np.sqrt(np.diag(along @ first.covariance[POSE, POSE] @ along.T))
    assert spread[4] == pytest.approx(np.abs(along[4]) @ MOTION, rel=1e-4)
    assert np.delete(spread, 4).max() < 1e-5


def test_angles_that_no_pose_has_start_nothing():
    assert sensing(1).start(Measurement.of(np.array([0.0, 3, 0, 3, 0, 3])), START) is None


def test_a_code_that_stands_still_is_worth_less_and_less():
    ten = sensing(10, bits=12)
    predicted = np.tile(PAPER.crank_angles(START[POSE]), (10, 1))
    codes = ten.quantum * np.round(predicted / ten.quantum)
    codes[5:, 0] += ten.quantum
    codes[2:, 1] += ten.quantum
    codes[7:, 1] += ten.quantum
    said, last = Measurement.of(codes.ravel()), np.tile(codes[0], 10)
    unchanged, c = np.zeros(6), core()
    sensor = c.ffi.new("stewart_sensing *", c.lib.stewart_encoder_sensing(encoders_of(ten).pointer))
    for periods in range(1, 4):
        c.lib.stewart_count_unchanged(sensor, *map(c.at, (said.values, last, unchanged)))
        assert np.array_equal(unchanged, [0, 0, *[periods] * 4])
        variance = reading(ten, said, predicted, last, unchanged).variance[0]
        white = variance[1] * 2  # that of one sample, projected
        assert variance == pytest.approx(white * np.array([1, 0.5, *[(1 + periods) ** 2] * 4]))


def test_samples_that_stand_out_of_their_period_are_left_out():
    ten = sensing(20, bits=14)
    predicted = angles_of(START, THETA, 20)
    t = np.arange(1, 21) / 20
    read = predicted + 3e-4 * t[:, None] ** 2  # what a wrong model leaves
    read[[3, 17], 2] += [0.01, -0.5]
    read[7, 1] = np.nan
    found = reading(
        ten, Measurement.of(read.ravel()), predicted, read.ravel() * np.nan, np.zeros(6)
    )
    assert np.array_equal(np.argwhere(np.isnan(found.angles)), [[3, 2], [7, 1], [17, 2]])
    assert found.has_outliers == [0, 0, 1, 0, 0, 0]
    expected = 3e-4 * node_times(20)[:, None] ** 2
    assert found.residuals == pytest.approx(np.tile(expected, 6), abs=1e-9)


# The filter.


@pytest.mark.parametrize("samples", [1, 10])
@pytest.mark.parametrize("free", [PARAMETERS, (*PARAMETERS, *OFFSETS)])
def test_a_step_is_what_batch_least_squares_finds(samples, free):
    """Minimum of the same sum of squares, found with differences; covariance of its Hessian."""
    offset = np.deg2rad(0.05) if len(free) > len(PARAMETERS) else 0.0
    assumed, encoders = settings(free), sensing(samples)
    dynamics = StewartDynamics(PAPER, gravity=False, free=free)
    n = 12 + len(free)
    first = encoders.start(Measurement.of(encoders.seen(START)), START)
    assert first is not None
    P = np.zeros((n, n))
    P[:12, :12] = first.covariance + np.diag(np.tile((1e-3 * MOTION) ** 2, 2))
    P[12:, 12:] = np.diag((0.02 * assumed.parameters.std) ** 2)
    L = np.linalg.cholesky(P)
    mean = np.concatenate([START, np.zeros(n - 12)])
    mean[19] = assumed.parameters.std[7]  # a friction that is nowhere near its bound
    truth = mean + L @ np.random.default_rng(8).standard_normal(n)
    truth[20:] = offset
    read = angles_of(truth[:12], truth[12:20], samples) + offset
    filtering = Filter(dynamics, encoders, assumed, np.full(6 * samples, np.nan), np.zeros(6))
    found = filtering.advance(Estimate(mean, P), PERIOD, read.ravel())
    assert found.outliers == 0 and found.partly == ()

    shares, G = projection(samples)
    model = (assumed.model_std**2)[POSE]
    early = assumed.timing_std

    def noise(xi):
        """Covariance (6 M, 6 M): projected samples, the model's drift, late torques at nodes."""
        end = DYNAMICS.predict(xi[:12], PERIOD.torques, PERIOD.durations, 20, xi[12:20])[-1]
        pushes = np.array([*PERIOD.torques, PERIOD.following])
        a = [DYNAMICS.accelerations(end[POSE], end[RATES], T, xi[12:20]) for T in pushes]
        changed = np.cumsum(PERIOD.durations)
        late = early * (DT - changed)[:, None] * np.diff(a, axis=0)
        drift = model + 0.01 * np.sum(late**2, axis=0)
        variances, kicks = [], []
        for share, g in zip(shares, G, strict=True):
            held = np.maximum([min(share * DT, 0.03), share * DT - min(share * DT, 0.03)], 1e-12)
            pose = DYNAMICS.predict(xi[:12], PERIOD.torques, held, 20, xi[12:20])[-1, POSE]
            J = PAPER.jacobian(pose)
            variances.append(encoders.std**2 * g @ g + share**2 * J**2 @ drift)
            passed = early * np.maximum(share * DT - changed, 0)
            kicks.append(J @ (passed[:, None] * np.diff(a, axis=0)).T)
        return np.diag(np.ravel(variances)) + 0.99 * (K := np.vstack(kicks)) @ K.T

    # The filter takes the covariance where it linearises; it hardly changes.
    C = np.linalg.cholesky(noise(mean))

    def misfit(xi):
        predicted = angles_of(xi[:12], xi[12:20], samples)
        if len(free) > len(PARAMETERS):
            predicted = predicted + xi[20:]
        beside = (G @ (read - predicted)).ravel()
        return np.concatenate([np.linalg.solve(L, xi - mean), np.linalg.solve(C, beside)])

    scale = np.sqrt(np.diag(P))
    batch = least_squares(
        misfit, mean, x_scale=scale, method="lm", diff_step=1e-5, xtol=1e-12, ftol=1e-12
    )
    Q = np.linalg.inv(batch.jac.T @ batch.jac)
    std = np.sqrt(np.diag(Q))
    assert np.abs((found.mean[12:] - batch.x[12:]) / std[12:]).max() < 0.05
    assert np.sqrt(np.diag(found.covariance))[12:] == pytest.approx(std[12:], rel=0.02)
    end = DYNAMICS.predict(batch.x[:12], PERIOD.torques, PERIOD.durations, 20, batch.x[12:20])[-1]
    stated = np.sqrt(np.diag(found.covariance)[:12])
    assert np.abs((found.mean[:12] - end) / stated).max() < 0.05


def follow(encoders, wrong):
    """Estimate, true state and causes after periods near home; `wrong` (n, N, 6) is added."""
    rng, N = np.random.default_rng(1), encoders.samples
    state = np.concatenate([PAPER.home, np.zeros(6)])
    observer = CoreObserver(settings())
    plant, causes = NominalPlant(DYNAMICS, 4, 1.0, TorqueLimit(np.inf)), list[str]()
    belief = observer.start(Timeline(DT, Delay(0)), encoders, plant)
    first = Measurement.of(encoders.seen(state))
    belief = observer.observe(belief, first, np.zeros((1, 6)), encoders, plant)
    for off in wrong:
        back = 3 * (PAPER.home - state[POSE]) - 2 * state[RATES] + MOTION * rng.uniform(-1, 1, 6)
        torque = DYNAMICS.inverse_dynamics(state[POSE], state[RATES], back)
        states = DYNAMICS.predict(state, np.tile(torque, (N, 1)), DT / N, 4)
        state, read = states[-1], legs_along(PAPER, states[:, POSE]).crank_angles
        if encoders.quantum > 0:
            read = encoders.quantum * np.round(read / encoders.quantum)
        said = Measurement.of((read + off).ravel())
        belief = observer.observe(belief, said, torque[None], encoders, plant)
        causes += belief.faults
    return belief.estimate, state, causes


def test_rates_follow_from_exact_angles():
    estimate, state, causes = follow(sensing(1), np.zeros((30, 1, 6)))
    assert estimate.state == pytest.approx(state, abs=2e-5)
    assert causes == []


@pytest.mark.parametrize("samples", [1, 20])
def test_a_leg_that_lies_is_left_out_and_the_others_go_on(samples):
    encoders, wrong = sensing(samples, bits=16), np.zeros((30, samples, 6))
    wrong[10:20, :, 3] = 0.05
    estimate, state, causes = follow(encoders, wrong)
    assert causes == ["measurements_rejected"] * 10
    stated = np.sqrt(np.diag(estimate.covariance)[:12])
    assert np.all(np.abs(estimate.state - state) < 4 * stated)


def test_more_than_half_of_the_legs_are_an_outlier():
    encoders, wrong = sensing(5, bits=16), np.zeros((30, 5, 6))
    wrong[15, :, :4] = 0.05
    assert follow(encoders, wrong)[2] == ["measurements_rejected"]


@pytest.mark.parametrize(("share", "rejected"), [(0.5, 0), (3.0, 1)])
def test_what_is_left_out_is_beyond_the_gate(share, rejected):
    """Once the state is known S is little more than the variance of the code."""
    encoders, wrong = sensing(1, bits=12), np.zeros((30, 1, 6))
    wrong[29, 0, 2] = share * np.sqrt(core().lib.STEWART_LEG_GATE) * encoders.std
    assert follow(encoders, wrong)[2] == ["measurements_rejected"] * rejected


# Without a filter.


def test_differences_are_poses_and_their_changes():
    encoders = sensing(2)
    plant = NominalPlant(DYNAMICS, 4, 1.0, TorqueLimit(np.inf))
    observer, torque = CoreObserver(), np.zeros((1, 6))
    belief = observer.start(Timeline(DT, Delay(0)), encoders, plant)
    poses = [START[POSE], START[POSE] + 0.03 * MOTION, START[POSE] - 0.01 * MOTION]
    for before, pose in zip([None, *poses], poses, strict=False):
        read = np.tile(PAPER.crank_angles(pose), 2)
        belief = observer.observe(belief, Measurement.of(read), torque, encoders, plant)
        assert belief.state[POSE] == pytest.approx(pose, abs=1e-9)
        if before is not None:
            assert belief.state[RATES] == pytest.approx((pose - before) / DT, abs=1e-7)
    read[-1] = np.nan
    alone = observer.observe(belief, Measurement.of(read), torque, encoders, plant)
    assert alone.faults == ("measurements_missing",)
    expected = DYNAMICS.predict(belief.state, torque, DT, 4)[-1]
    assert alone.state == pytest.approx(expected)


def test_known_offsets_are_taken_off():
    at = PAPER.crank_angles(START[POSE]) + 0.01
    first = sensing(1, offset=0.01).start(Measurement.of(at), START)
    assert first is not None
    assert first.state == pytest.approx(START, abs=1e-9)
    assert sensing(1, offset=0.01).seen(START) == pytest.approx(at)
