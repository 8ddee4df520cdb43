"""A machine from its log: every equation against an independent computation, then whole logs."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from benchmarks import short_logs
from benchmarks.identification import calm_torque, excitation, find
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.fit import (
    CONVERGED,
    Guess,
    Problem,
    chi2_per_value,
    solve,
    with_half_step,
)
from stewart_drake.identification.identify import identify
from stewart_drake.identification.judgement import (
    named_directions,
    pose_slopes,
    pose_uncertainty,
    unseen,
    workspace_poses,
)
from stewart_drake.identification.logs import ANGLES, NUM_MEASURED, Log, Precision, load_log
from stewart_drake.identification.model import (
    NUM_DYNAMIC,
    NUM_GEOMETRY,
    MachineModel,
    Segment,
    integrate,
    plan_steps,
)
from stewart_drake.identification.plan import fitted_multisine, loss_along, multisine
from stewart_drake.identification.progress import shown_by
from stewart_drake.identification.start import coarse_delay, measured_poses
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.identification.unknowns import (
    DELAY,
    DYNAMIC,
    GEOMETRY,
    NAMES,
    NUM_UNKNOWNS,
    OFFSETS,
    unknowns_of,
)
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.reporting.identification import document, residuals_of
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import BALL_JOINTS
from tests.mechanisms import PAPER, random_mechanism

STILL = np.zeros(6)
PARAMETERS = plant_parameters(
    [3e-3, -2e-3, 1e-3, 4e-3, -3e-3, 2e-3, 0.4, 2e-3, 1e-3, 0.02, 0.01, -0.02, 0.03]
)
"""Bias, payload, friction, and where the payload lies."""
CONSTANTS = PARAMETERS[:NUM_DYNAMIC]  # a log has no wrench
TORQUES = 0.02 * np.array([[1, -2, 1, 0, 2, -1], [-1, 1, 0, 2, -1, 1], [0, 1, -2, 1, 1, 0]])


def some_unknowns(mechanism, **tolerances):
    return unknowns_of(mechanism, Tolerances(**tolerances), 0.23, 0.1, 1.0)


def exact_states(mechanism, parameters, gravity, first, sent, torques, delay, times):
    """States (n, 12) by an adaptive integrator, from one torque's arrival to the next."""
    dynamics = StewartDynamics(mechanism, gravity, parameters)
    found, state, now = [], np.array(first), times[0]
    for time in times:
        while now < time:
            later = sent + delay
            stop = min([time, *later[later > now + 1e-12]])
            acting = torques[max(0, np.searchsorted(later, now + 1e-9, side="right") - 1)]
            path = solve_ivp(
                lambda _, x, T=acting: dynamics.change(x, T),
                (now, stop), state, method="DOP853", rtol=1e-11, atol=1e-13,
            )  # fmt: skip
            state, now = path.y[:, -1], stop
        found.append(state)
    return np.array(found)


# ---------------------------------------------------------------- the model


def slopes(model, state, torque, numbers):
    """Return accelerations (6,) and their derivatives by the state and by the numbers."""
    (plant, _kept), legs = model.plant(numbers), NUM_GEOMETRY * model.free_legs
    found = [np.empty((6, n)) for n in (1, 12, NUM_DYNAMIC + legs)]
    core().call("slopes", plant, model.free_legs, state.copy(), torque.copy(), *found)
    return found[0][:, 0], found[1], found[2]


@pytest.mark.parametrize("seed", range(3))
def test_the_model_is_that_of_the_dynamics(seed):
    rng = np.random.default_rng(seed)
    mechanism = random_mechanism(rng)
    unknowns = some_unknowns(mechanism)
    values = unknowns.mean.copy()
    values[DYNAMIC] = CONSTANTS
    values[GEOMETRY] += 1e-4 * rng.standard_normal(NUM_GEOMETRY)
    machine = unknowns.machine(values)
    model, numbers = MachineModel(mechanism, 9.81), unknowns.numbers(values)
    states = np.tile(np.concatenate([mechanism.home, STILL]), (4, 1))
    states += 0.02 * rng.standard_normal((4, 12))
    torques = rng.standard_normal((4, 6))
    dynamics = StewartDynamics(machine, 9.81, PARAMETERS)
    for x, T in zip(states, torques, strict=True):
        found, *_ = slopes(model, x, T, numbers)
        np.testing.assert_allclose(found, dynamics.accelerations(x[:6], x[6:], T), rtol=1e-9)
    alpha, J, _ = model.crank_angles(states[:, :6], numbers)
    np.testing.assert_allclose(alpha, [machine.crank_angles(x[:6]) for x in states], atol=1e-13)
    np.testing.assert_allclose(J, [machine.jacobian(x[:6]) for x in states], rtol=1e-9, atol=1e-9)


def test_its_derivatives_are_those_of_other_machines():
    """Central differences of the dynamics of machines that are built anew for each number."""
    rng = np.random.default_rng(5)
    unknowns = some_unknowns(PAPER)
    values = unknowns.mean.copy()
    values[DYNAMIC] = CONSTANTS
    state = np.concatenate([PAPER.home, STILL]) + 0.05 * rng.standard_normal(12)
    torque = 0.1 * rng.standard_normal(6)
    model = MachineModel(PAPER, 9.81)
    numbers = unknowns.numbers(values)
    _, by_state, by_numbers = slopes(model, state, torque, numbers)
    by_geometry = model.crank_angles(state[None, :6], numbers)[2][0]

    def at(values, state=state):
        machine = unknowns.machine(values)
        dynamics = StewartDynamics(machine, 9.81, values[DYNAMIC])
        a = dynamics.accelerations(state[:6], state[6:], torque)
        return np.concatenate([a, machine.crank_angles(state[:6])])

    def difference(f, size):
        return (f(size) - f(-size)) / (2 * size)

    held = range(BALL_JOINTS.start, BALL_JOINTS.stop)  # a log does not tell them
    for k in sorted({*range(NUM_DYNAMIC + NUM_GEOMETRY)} - {*held}):
        unit = np.eye(NUM_UNKNOWNS)[k]
        slope = difference(lambda h, unit=unit: at(values + h * unit), 1e-6)
        scale = np.abs(slope[:6]).max() + 1e-3
        np.testing.assert_allclose(by_numbers[:, k], slope[:6], atol=1e-5 * scale)
        if k >= NUM_DYNAMIC:
            expected = by_geometry[:, k - NUM_DYNAMIC]
            np.testing.assert_allclose(expected, slope[6:], atol=1e-6 * (1 + np.abs(slope).max()))
    for k in range(12):
        unit = np.eye(12)[k]
        slope = difference(lambda h, unit=unit: at(values, state + h * unit), 1e-6)[:6]
        np.testing.assert_allclose(by_state[:, k], slope, atol=1e-5 * np.abs(slope).max())


def test_the_model_with_drawn_legs_is_the_same():
    rng, unknowns = np.random.default_rng(6), some_unknowns(PAPER)
    state = np.concatenate([PAPER.home, STILL]) + 0.05 * rng.standard_normal(12)
    numbers = unknowns.numbers(unknowns.mean)._replace(parameters=CONSTANTS)
    at = state, 0.1 * rng.standard_normal(6), numbers
    expected, found = (slopes(MachineModel(PAPER, 9.81, free), *at) for free in (True, False))
    dynamic = (*expected[:2], expected[2][:, :NUM_DYNAMIC])
    for one, other in zip(found, dynamic, strict=True):
        np.testing.assert_array_equal(one, other)


# ---------------------------------------------------------------- trajectories


def short_log(times, mechanism=PAPER, delay=0.23, gravity=0.0):
    """Return a log of torques at 0, 0.1, ... s, and the states behind it."""
    first = np.concatenate([mechanism.home, [0.1, -0.1, 0.2, 0.02, -0.01, 0.03]])
    sent = 0.1 * np.arange(8)
    torques = np.vstack([TORQUES, -TORQUES, TORQUES[:2]])
    states = exact_states(mechanism, PARAMETERS, gravity, first, sent, torques, delay, times)
    values = np.full((len(times), NUM_MEASURED), np.nan)
    values[:, ANGLES] = [mechanism.crank_angles(x[:6]) for x in states]
    return Log("short", sent, torques, times, values, Precision().std, gravity), states


def test_trajectories_are_those_of_an_adaptive_integrator():
    times = np.array([0.25, 0.26, 0.31, 0.33, 0.34, 0.45, 0.53, 0.6])
    log, states = short_log(times)
    segments = [Segment(log, 0.25, np.arange(8)), Segment(log, 0.31, np.arange(2, 5))]
    unknowns = some_unknowns(PAPER)
    values = unknowns.mean.copy()
    values[DYNAMIC] = CONSTANTS
    model, numbers = MachineModel(PAPER, 0.0), unknowns.numbers(values)
    plan = [plan_steps(one, 0.23, 1e-3) for one in segments]
    course = integrate(model, numbers, states[[0, 2]], plan, False)
    np.testing.assert_allclose(course[0][:, 0], states, atol=2e-7)
    np.testing.assert_allclose(course[0][:3, 1], states[2:5], atol=2e-7)
    assert np.isnan(course[0][3:, 1]).all()


@pytest.mark.parametrize("delay", [0.23, 0.2, 0.271])
def test_sensitivities_are_differences_of_trajectories(delay):
    """The delay's equal those of exact ones, unless switches are on samples, at 0.2 s."""
    times = np.arange(0.255, 0.6, 0.02)
    log, states = short_log(times, delay=delay)
    segment = Segment(log, 0.255, np.arange(len(times)))
    unknowns = some_unknowns(PAPER)
    values = unknowns.mean.copy()
    values[DYNAMIC], values[DELAY] = CONSTANTS, delay
    model = MachineModel(PAPER, 0.0)

    def at(values, first=states[0], sensitive=False):
        plan = plan_steps(segment, values[DELAY], 2e-3)
        return integrate(model, unknowns.numbers(values), first[None], [plan], sensitive)

    slopes = at(values, sensitive=True)[1][:, 0]
    column = {DELAY: -1, 0: 12, 6: 18, 7: 19, 8: 20, 11: 23}
    column |= {GEOMETRY.start + k: 12 + NUM_DYNAMIC + k for k in (0, 1, 3, 7, 41, 47)}
    for place, k in column.items():
        h = 1e-5 * np.eye(NUM_UNKNOWNS)[place]
        expected = (at(values + h)[0] - at(values - h)[0])[:, 0] / 2e-5
        scale = np.abs(expected).max()
        np.testing.assert_allclose(
            slopes[:, :, k], expected, atol=2e-4 * scale, err_msg=NAMES[place]
        )
    for k, h in enumerate(1e-5 * np.eye(12)):
        ends = [at(values, states[0] + sign * h)[0][:, 0] for sign in (1, -1)]
        np.testing.assert_allclose(slopes[:, :, k], (ends[0] - ends[1]) / 2e-5, atol=1e-6)
    if delay != 0.2:
        given = PAPER, PARAMETERS, 0.0, states[0], log.sent, log.torques
        later, sooner = (exact_states(*given, delay + h, times) for h in (1e-5, -1e-5))
        expected = (later - sooner) / 2e-5
        np.testing.assert_allclose(slopes[:, :, -1], expected, atol=1e-4 * np.abs(expected).max())


# ---------------------------------------------------------------- the fit


def few_unknowns(spacing=0.02):
    """Two short segments with noise, a sample every 20 ms, and little that is not known."""
    times = np.arange(0.25, 0.9, spacing)
    log, states = short_log(times)
    rng = np.random.default_rng(3)
    log.values[:, ANGLES] += log.std[0] * rng.standard_normal((len(times), 6))
    half = len(times) // 2
    rows = np.arange(half), np.arange(half, len(times))
    segments = [Segment(log, float(times[part[0]]), part) for part in rows]
    unknowns = some_unknowns(PAPER)
    unknowns.mean[DYNAMIC], unknowns.mean[DELAY] = CONSTANTS, 0.23
    std = np.zeros(NUM_UNKNOWNS)
    std[[0, 6, GEOMETRY.start + 1, OFFSETS.start, DELAY]] = 1e-3, 0.1, 2e-4, 1e-3, 0.01
    unknowns = dataclasses.replace(unknowns, std=std)
    first = np.array([states[part[0]] for part in rows])
    start = unknowns.mean.copy()
    start[[0, 6, DELAY]] += 5e-4, -0.05, 0.004
    return Problem(segments, unknowns), Guess(start, first + 1e-4)


def test_the_fit_is_that_of_a_general_solver():
    """scipy's, on the residuals alone, without the structure of segments."""
    problem, guess = few_unknowns()
    evaluator, free = problem, problem.unknowns.free

    def residuals(z):
        values = guess.values.copy()
        values[free] = z[: len(free)]
        r = evaluator.residuals(Guess(values, z[len(free) :].reshape(-1, 12)))
        return np.concatenate([r.measured.ravel(), r.prior])

    start = np.concatenate([guess.values[free], guess.first.ravel()])
    scale = np.concatenate([problem.unknowns.std[free], np.full(24, 1e-3)])
    other = least_squares(residuals, start, x_scale=scale, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve(problem, guess)
    spread = np.linalg.inv(other.jac.T @ other.jac)[: len(free), : len(free)]
    std = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(
        found.guess.values[free] / std, other.x[: len(free)] / std, atol=0.02
    )
    np.testing.assert_allclose(
        found.covariance / np.outer(std, std), spread / np.outer(std, std), atol=2e-3
    )
    assert found.residuals.chi2 == pytest.approx(2 * other.cost, abs=2 * CONVERGED)
    true = problem.unknowns.mean.copy()
    away = (found.guess.values - true)[free] / np.sqrt(np.diag(found.covariance))
    assert np.abs(away).max() < 4
    assert 0.7 < chi2_per_value(found.residuals, problem)["all"] < 1.3


def test_a_log_under_no_tolerance_leaves_nothing_to_find():
    problem, guess = few_unknowns()
    known = dataclasses.replace(problem.unknowns, std=np.zeros(NUM_UNKNOWNS))
    found = solve(dataclasses.replace(problem, unknowns=known), guess)
    assert found.covariance.shape == (0, 0)
    np.testing.assert_array_equal(found.guess.values, guess.values)


# ---------------------------------------------------------------- what is seen


def test_moving_the_base_or_turning_the_plate_s_frame_is_no_news_to_encoders():
    """The four directions are gauges: poses that follow show the same crank angles, and more."""
    unknowns = some_unknowns(PAPER)
    model, poses = MachineModel(PAPER, 0.0), np.array([[0.1, -0.05, 0.2, 0.01, 0.02, 0.39]])
    directions = named_directions(PAPER)
    turned = "how the plate's frame is turned about its z"
    for name in (*(f"where the base stands along {axis}" for axis in "xyz"), turned):
        alpha = []
        for size in (1e-6, -1e-6):
            values = unknowns.mean + size * directions[name]
            numbers, pose = unknowns.numbers(values), poses[0].copy()
            if "base" in name:
                pose[3 + "xyz".index(name[-1])] += size
            else:
                pose[2] -= size  # exact only without roll and pitch: psi turns about z of W
                pose[:2] = 0
            alpha.append(model.crank_angles(pose[None], numbers)[0])
        np.testing.assert_allclose(alpha[0], alpha[1], atol=1e-11)


def test_unseen_directions_are_named():
    unknowns = some_unknowns(PAPER)
    free = unknowns.free
    assert unseen(unknowns, np.diag(1e-6 * unknowns.std[free] ** 2)) == (0, [])
    count, names = unseen(unknowns, np.diag(unknowns.std[free] ** 2))
    assert count == len(free)
    assert "where the base stands along x" in names and "payload mass" in names
    # The log sees all but the base's place along y and the scale of the payload.
    direction = named_directions(PAPER)["where the base stands along y"][free] / unknowns.std[free]
    direction /= np.linalg.norm(direction)
    payload = (free == 6).astype(float)
    kept = np.outer(direction, direction) + np.outer(payload, payload) + 1e-6 * np.eye(len(free))
    spread = kept * np.outer(unknowns.std[free], unknowns.std[free])
    count, names = unseen(unknowns, spread)
    assert count == 2 and sorted(names) == ["payload mass", "where the base stands along y"]


def test_pose_uncertainty_is_that_of_drawn_machines():
    """Forward kinematics of machines drawn from the covariance, at one pose."""
    unknowns, rng = some_unknowns(PAPER, offsets=1e-3), np.random.default_rng(2)
    pose = workspace_poses(PAPER, PAPER.home)[5]
    angles = PAPER.crank_angles(pose)
    slopes = pose_slopes(unknowns, unknowns.numbers(unknowns.mean), pose[None])[0]
    P = np.diag(np.concatenate([unknowns.std[GEOMETRY], unknowns.std[OFFSETS]]) ** 2)
    std = np.sqrt(np.diag(slopes @ P @ slopes.T))
    away = []
    for _ in range(400):
        values = unknowns.mean + unknowns.std * rng.standard_normal(NUM_UNKNOWNS)
        machine = unknowns.machine(values)
        away.append(machine.forward_kinematics(angles - values[OFFSETS], pose) - pose)
    np.testing.assert_allclose(np.std(away, axis=0), std, rtol=0.15)
    spread = np.diag(unknowns.std[unknowns.free] ** 2)
    whole = pose_uncertainty(unknowns, unknowns.mean, spread, PAPER.home)
    assert whole.angle[0] <= whole.angle[1] and whole.position_change[0] < whole.position[0]


def test_pose_uncertainty_is_taken_over_the_workspace_of_the_machine_found():
    """Poses near the end of the drawn machine's workspace may be out of reach of another one."""
    unknowns, rng = some_unknowns(PAPER, offsets=1e-3), np.random.default_rng(0)
    values, legs = unknowns.mean.copy(), np.zeros((6, 8))
    legs[:, :2] = -6e-3  # cranks and rods are shorter
    values[GEOMETRY] += legs.ravel() + 1e-4 * rng.standard_normal(48)
    spread = np.diag(unknowns.std[unknowns.free] ** 2)
    found = pose_uncertainty(unknowns, values, spread, PAPER.home)
    assert found is not None and np.all(np.isfinite(found))
    far = PAPER.home + np.array([0, 0, 0, 0, 0, 1.0])
    assert pose_uncertainty(unknowns, values, spread, far) is None


# ---------------------------------------------------------------- where to begin


def sine_log(truth, parameters, delay, duration=6.0, seed=0):
    """Open loop along a multisine: torques that would follow it, as far as they do; 14 bit.

    Torques are those of the true machine with true parameters, sent early by the true delay, and
    noise.
    """
    rng = np.random.default_rng(seed)
    times, poses = multisine(truth.home, np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.03]), duration)
    rates = np.gradient(poses, times, axis=0, edge_order=2)
    accelerations = np.gradient(rates, times, axis=0, edge_order=2)
    dynamics = StewartDynamics(truth, 0.0, parameters)
    sent = 0.1 * np.arange(round(duration / 0.1) + 1) - delay
    torques = []
    for start in sent + delay:
        k = min(np.searchsorted(times, start + 0.05), len(times) - 1)
        torques.append(dynamics.inverse_dynamics(poses[k], rates[k], accelerations[k]))
    torques = np.array(torques) + 2e-3 * rng.standard_normal((len(sent), 6))
    first = np.concatenate([poses[0], STILL])
    states = exact_states(truth, parameters, 0.0, first, sent, torques, delay, times)
    step = 2 * np.pi / 2**14
    angles = np.array([truth.crank_angles(x[:6]) for x in states])
    values = np.full((len(times), NUM_MEASURED), np.nan)
    values[:, ANGLES] = step * np.round(angles / step)
    return Log("sine", sent, torques, times, values, Precision().std, 0.0, 0.8)


def off_drawing(seed, size=2e-4):
    rng = np.random.default_rng(seed)

    def off(value):
        return value + size * rng.standard_normal(value.shape)

    return dataclasses.replace(
        PAPER,
        crank_lengths=off(PAPER.crank_lengths),
        rod_lengths=off(PAPER.rod_lengths),
        p_WS=off(PAPER.p_WS),
        p_PQ=off(PAPER.p_PQ),
    )


def truth_of(machine, parameters, delay):
    values = np.zeros(NUM_UNKNOWNS)
    legs = [machine.crank_lengths, machine.rod_lengths, machine.p_PQ, machine.p_WS]
    values[DYNAMIC], values[GEOMETRY] = parameters[:NUM_DYNAMIC], np.column_stack(legs).ravel()
    values[DELAY] = delay
    return values


@pytest.fixture(scope="module")
def log_and_truth():
    machine, parameters = off_drawing(1), PARAMETERS.copy()
    parameters[:6] *= 0.1
    parameters[8] = 3e-4
    return sine_log(machine, parameters, 0.93), truth_of(machine, parameters, 0.93)


@pytest.mark.parametrize("believed", [0.4, 0.8, 1.3])
def test_a_delay_to_begin_with_is_found_from_far_away(log_and_truth, believed):
    log, _ = log_and_truth
    poses = measured_poses(log, PAPER)
    assert coarse_delay(log, poses, PAPER, believed, 0.3) == pytest.approx(0.93, abs=0.06)


def test_a_machine_is_found_from_encoders_of_14_bit(log_and_truth):
    log, true = log_and_truth
    found = identify([log], PAPER, Tolerances(offsets=0.0))
    free, std = found.unknowns.free, np.sqrt(np.diag(found.fit.covariance))
    away = (found.fit.guess.values - true)[free]
    assert found.right and 0.9 < found.chi2["all"] < 1.1
    assert abs(found.values[DELAY] - 0.93) < 1e-4
    assert 0.85 < np.mean(np.abs(away) < 1.96 * std) <= 1
    # The joint test: the error weighs as much as its covariance says.
    assert 0.5 < away @ np.linalg.solve(found.fit.covariance, away) / len(free) < 1.6
    assert {f"where the base stands along {axis}" for axis in "xyz"} <= set(found.unseen[1])
    told = document(found).plain()
    assert "Weak" not in told and "overlay=DIR/found.yaml" in told
    less = dataclasses.replace(found.unknowns, std=np.minimum(found.unknowns.std, 1.5 * found.std))
    told = document(dataclasses.replace(found, unknowns=less)).plain()
    assert "Weak, hardly better known than before: torque bias 1, torque" in " ".join(told.split())
    assert "negative payload" not in told and "more than noise explains" not in told
    measured = 1.15 * found.fit.residuals.measured
    fit = found.fit._replace(residuals=found.fit.residuals._replace(measured=measured))
    told = " ".join(document(dataclasses.replace(found, fit=fit)).plain().split())
    assert "is more than noise explains: true errors may be several of the stated" in told
    less, payload = found.fit.guess.values.copy(), NAMES.index("payload_mass")
    less[payload] = -0.4
    fit = found.fit._replace(guess=found.fit.guess._replace(values=less))
    told = " ".join(document(dataclasses.replace(found, fit=fit)).plain().split())
    assert "a negative payload: the plate is lighter than the mechanism file says" in told
    assert "set its plate.mass to 3.6 kg and identify again" in told
    for name, size in {"torque_bias_1": 1e-4, "payload_mass": 0.02, "joint_damping": 1e-4}.items():
        assert abs(found.values[NAMES.index(name)] - true[NAMES.index(name)]) < size


@pytest.mark.slow
def test_the_fit_ends_at_the_minimum_of_a_curved_valley(tmp_path):
    """With gravity, payload and cranks are hardly distinguished, and damped steps gain little."""
    settings = ["plant.payload_mass=0.1", "sensor.kind=encoders", "duration=3", "plant.kind=exact"]
    scenario = load_scenario("gravity", settings=settings)
    simulate(scenario, judge_stability=False).save(tmp_path)
    mechanism = load_mechanism(scenario.mechanism)
    fit = identify([load_log(tmp_path / "signals.nc", mechanism, Precision())], mechanism).fit
    _, normal = fit.problem.normal(fit.guess)
    assert normal.promised(normal.step(0.0)) < CONVERGED


@pytest.mark.slow
def test_a_drawing_that_is_trusted_too_much_is_refused(log_and_truth):
    log, _ = log_and_truth
    found = identify([log], PAPER, Tolerances(lengths=0.0, joints=0.0, offsets=0.0))
    summary = found.summary
    assert not found.right and found.chi2["all"] > 1.5
    assert np.isnan(summary["delay_std_s"]) and summary["pose_uncertainty"] is None
    told = " ".join(document(found).plain().split())
    assert "Do not use the values" in told and "Next Check units, zeros and signs" in told
    assert all(np.isnan(one["std"]) for one in summary["parameters"].values())
    assert abs(summary["delay_s"] - 0.93) < 1e-3  # the delay stands all the same


@pytest.mark.slow
def test_an_end_that_no_machine_explains_is_left_out():
    log = sine_log(off_drawing(1), PARAMETERS, 0.93, duration=8.0)
    values, late = log.values.copy(), log.times > 2.1
    values[late] = values[late][::-1]
    log = dataclasses.replace(log, values=values)
    found = identify([log], PAPER, Tolerances(delay=0.02), delay=0.92)
    told = " ".join(document(found).plain().split())
    assert found.right and abs(found.values[DELAY] - 0.93) < 1e-3
    assert found.summary["fitted_until_s"] == [pytest.approx(2.0, abs=0.05)]
    assert "sine: left out 2 to 8 s: the search found no machine that explains the whole" in told
    prior = np.where(found.unknowns.free == OFFSETS.start + 2, 5.0, 0.0)
    fit = found.fit._replace(residuals=found.fit.residuals._replace(prior=prior))
    told = " ".join(document(dataclasses.replace(found, fit=fit)).plain().split())
    assert "encoder zeros more than 8 mrad (four tolerances) off: leg 3" in told
    assert "is the drawing right?" not in told


@pytest.mark.slow
def test_two_logs_tell_more_than_one(log_and_truth):
    log, true = log_and_truth
    half = len(log.times) // 4
    parts = [
        dataclasses.replace(log, times=log.times[rows], values=log.values[rows])
        for rows in (slice(None, half), slice(half, 2 * half))
    ]  # of one name
    both = identify(parts, PAPER, Tolerances(offsets=0.0))
    one = identify(parts[1:], PAPER, Tolerances(offsets=0.0))
    assert both.std[DELAY] < one.std[DELAY]
    assert abs(both.values[DELAY] - true[DELAY]) < 4 * both.std[DELAY]


# ---------------------------------------------------------------- short logs of lost runs


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=() if k in (2, 5) else pytest.mark.soak, id=str(case))
        for k, case in enumerate(short_logs.CASES)
    ],
)
def test_the_delay_is_found_in_a_short_log_of_a_lost_run(case):
    """Some 1.5 s with unknown payload and biases; the delay is at most 0.9 s.

    Each machine, delay and noise once, as a soak test all combinations, by
    `benchmarks/short_logs.py` with ten logs each.
    """
    found = short_logs.find(*case, 3000)
    assert found.refusal == "" and abs(found.late) < 1e-3 and abs(found.late) < 4 * found.std


@pytest.fixture(scope="module")
def short_run_log(tmp_path_factory):
    """Return the first 1.2 s of a log with a delay of 0.8 s and noise; the queue was empty."""
    folder = tmp_path_factory.mktemp("short")
    short_logs.short_run("paper", 0.8, 1e-3, 4000).save(folder)
    return up_to(load_log(folder / "signals.nc", PAPER, Precision()), 1.2)


def up_to(log, end):
    kept = log.times <= end + 1e-9
    return dataclasses.replace(log, times=log.times[kept], values=log.values[kept])


@pytest.mark.slow
def test_a_log_that_ends_before_its_torques_act_is_refused(short_run_log):
    message = (
        r"got a log of 0\.9 s.* expected one delay.* at least 1\.9 s \(.* of motion\)\. If the"
    )
    said = list[str]()
    with pytest.raises(ConfigError, match=message), shown_by(said.append):
        identify([up_to(short_run_log, 0.9)], PAPER)
    assert said[:2] == ["delay 1 of 19", "delay 1 of 19, iteration 1 of at most 4"]


def test_a_log_without_gravity_read_as_one_with_it_is_refused(tmp_path):
    settings = ("plant.kind=exact", "duration=3")
    simulate(load_scenario("paper", settings=settings), judge_stability=False).save(tmp_path)
    log = load_log(tmp_path / "signals.nc", PAPER, Precision())
    with pytest.raises(ConfigError, match="under these torques with gravity; expected"):
        identify([dataclasses.replace(log, gravity=9.81)], PAPER)


def test_the_residuals_of_a_short_log_are_drawn(short_run_log):
    """Its fit leaves out samples, and knows torques before it."""
    found = identify([short_run_log], PAPER)
    times, residuals = residuals_of(found, found.logs[0])
    assert len(times) > 10 and set(times) <= set(short_run_log.times)
    assert 0.7 < np.nanstd(residuals) < 1.1


# ---------------------------------------------------------------- excitation and files


def test_a_multisine_rests_at_both_ends_and_stays_inside():
    times, poses, share = fitted_multisine(
        PAPER, PAPER.home, np.array([0.5, 0.5, 0.5, 0.05, 0.05, 0.2]), 20.0
    )
    assert share < 1 and times[-1] == pytest.approx(20.0)
    np.testing.assert_allclose(poses[[0, 1, -2, -1]], np.tile(PAPER.home, (4, 1)), atol=1e-6)
    assert min(PAPER.reach_margins(pose).min() for pose in poses) > 0
    moved = (poses - PAPER.home)[100:-100]
    assert np.linalg.cond(moved / moved.std(axis=0)) < 10  # no two coordinates move alike
    with pytest.raises(ConfigError, match="too large for the workspace even at 5 %"):
        fitted_multisine(PAPER, PAPER.home, np.full(6, 100.0), 2.0)


def test_a_motion_that_the_loop_loses_is_shown():
    peak = [0.13, 0.13, 0.13, 0.01, 0.01, 0.04]
    times, poses = multisine(PAPER.home, np.array(peak), 20.0)
    for limit, word in (("none", None), (0.012, "end of its reach")):
        scenario = load_scenario("paper", settings=(f"actuator.torque_limit={limit}",))
        lost = loss_along(scenario, times, poses)
        assert lost is None if word is None else word in str(lost)


def test_a_mechanism_s_file_is_read_back(tmp_path):
    machine = off_drawing(4)
    path = tmp_path / "machine.yaml"
    path.write_text(mechanism_yaml(machine))
    read = load_mechanism(path)
    for field in ("p_WS", "p_PQ", "crank_lengths", "rod_lengths", "home", "branches"):
        np.testing.assert_array_equal(getattr(read, field), getattr(machine, field))
    np.testing.assert_allclose(read.R_WS, machine.R_WS, atol=1e-15)
    assert (read.plate.mass, read.rod.center) == (machine.plate.mass, machine.rod.center)
    assert read.effort_limit == machine.effort_limit


@pytest.mark.parametrize(("spacing", "friction"), [(0.02, 2e-3), (0.01, 2e-2)])
def test_steps_are_halved_until_they_do_not_matter(spacing, friction):
    """Coulomb friction that turns round within 20 ms, also where samples are denser than steps."""
    problem, guess = few_unknowns(spacing)
    values = guess.values.copy()
    values[8] = friction
    guess = Guess(values, guess.first)
    halved = with_half_step(problem, guess)
    assert halved is not None and halved.longest_step == pytest.approx(spacing / 2)
    while (more := with_half_step(halved, guess)) is not None:
        halved = more
    one, exact = (
        dataclasses.replace(problem, longest_step=h).residuals(guess).measured
        for h in (halved.longest_step, 2e-4)
    )
    assert np.sqrt(np.mean((one - exact) ** 2)) < 0.05
    values = guess.values.copy()
    values[8] = 0.0
    assert with_half_step(problem, Guess(values, guess.first)) is None


# ---------------------------------------------------------------- many machines


@pytest.mark.soak
@pytest.mark.parametrize("poses", [False, True], ids=["encoders", "pose"])
def test_fifty_machines_are_found(tmp_path, poses):
    """Machines of the robustness study, 14 bit at 50 Hz, 20 s, a delay that is 130 ms off."""
    motion = excitation(tmp_path)
    calm = calm_torque(motion)
    found = [find("ranges", seed, motion, calm, poses) for seed in range(50)]
    assert max(abs(one.late) for one in found) < 1e-4
    assert all(0.9 < one.chi2 < 1.1 for one in found)
    assert max(one.seconds for one in found) < 30
    assert 0.90 < np.nanmean([one.inside for one in found]) < 0.99
    if poses:
        ends = np.array([one.next_runs for one in found])
        assert np.all(np.isfinite(ends[:, :2]))
        on_reference, from_rest = np.mean(ends[:, 0], axis=0)
        assert on_reference < 0.15
        assert from_rest < np.mean(ends[:, 1, 1]) + 0.2
