"""The exact plant without Drake: DOP853 against scipy, energy, order, events, where it ends."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from stewart_drake.dynamics.open_loop import Ended, IntegrationError, NativePlant
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import margin
from stewart_drake.loop.exact import ExactPlant, set_accuracy
from stewart_drake.scenario.signals import POSE, RATES
from tests.mechanisms import PAPER, random_mechanism

HEAVY = StewartDynamics(PAPER, parameters=[*[0.01] * 6, 0.5, 0.02])
HOLD = StewartDynamics(PAPER).equilibrium_torque(PAPER.home)
AT_HOME = np.concatenate([PAPER.home, np.zeros(6)])
PUSH = HOLD + 0.02 * np.abs(HOLD) * [1.0, 0.6, -0.4, 0.8, -0.2, 0.5]


def of_scipy(dynamics, begins, torques, times, rtol):
    """Return states (n, 12) at the times; each torque is a separate problem."""
    states, x = np.full((len(times), 12), np.nan), AT_HOME
    for begin, end, torque in zip(begins, [*begins[1:], times[-1]], torques, strict=True):
        solution = solve_ivp(
            lambda t, y, torque=torque: np.concatenate(
                [y[RATES], dynamics.accelerations(y[POSE], y[RATES], torque)]
            ),
            (begin, end), x, method="DOP853", rtol=rtol, atol=rtol, dense_output=True,
        )  # fmt: skip
        here = (times >= begin) & (times <= end)
        states[here] = solution.sol(times[here]).T
        x = solution.y[:, -1]
    return states


def integrate(dynamics, start, torque, times, accuracy=1e-9, pieces=1):
    """Run under one torque, in pieces of equal length."""
    times = np.array(times, np.float64)
    plant = NativePlant(dynamics, np.array(start), times, accuracy)
    ended = plant.hold(times[-1] / pieces * np.arange(pieces), np.tile(torque, (pieces, 1)))
    return SimpleNamespace(
        times=times[: plant.run.recorded],
        states=plant.states[: plant.run.recorded],
        end=plant.run.time,
        final=plant.final,
        failure=plant.failure(ended),
        steps=plant.run.steps,
    )


def test_states_are_those_of_scipy_at_any_time():
    """Gravity, payload, damping, bias; torques that change between the looks."""
    times = np.sort(np.random.default_rng(1).uniform(0, 0.4, 57))
    begins, torques = [0.0, 0.1234, 0.3], [PUSH, 2 * HOLD - PUSH, HOLD]
    found = NativePlant(HEAVY, AT_HOME, times, 1e-12)
    assert found.hold(begins, torques) == Ended.INSIDE
    expected = of_scipy(HEAVY, begins, torques, times, 1e-13)
    assert found.run.time == times[-1] and found.run.recorded == len(times)
    assert np.abs(expected - AT_HOME).max() > 0.01
    assert np.abs(found.states - expected).max() < 1e-10
    assert np.array_equal(found.final, found.states[-1])


def test_any_machine_is_followed():
    rng = np.random.default_rng(2)
    for _ in range(3):
        mechanism = random_mechanism(rng)
        dynamics = StewartDynamics(mechanism, gravity=3.0)
        start = np.concatenate([mechanism.home, 0.1 * rng.normal(0, 1, 6)])
        torque = dynamics.equilibrium_torque(mechanism.home)
        found = integrate(dynamics, start, torque, [0.05], 1e-12)
        expected = solve_ivp(
            lambda t, y, dynamics=dynamics, torque=torque: dynamics.change(y, torque),
            (0, 0.05), start, rtol=1e-12, atol=1e-13, method="DOP853",
        ).y[:, -1]  # fmt: skip
        assert np.abs(found.final - expected).max() < 1e-11 * max(1.0, np.abs(expected).max())


def test_energy_is_kept():
    """A fall from home and back up, without torque or friction, in adaptive steps."""
    free = StewartDynamics(PAPER, gravity=1.0)
    start = AT_HOME + 0.2 * np.eye(12)[11]
    found = integrate(free, start, np.zeros(6), np.linspace(0, 0.15, 40), 1e-13)
    energies = np.array([free.energy(x[POSE], x[RATES]) for x in found.states])
    speeds = [np.linalg.norm(x[RATES]) for x in found.states]
    assert found.failure is None and np.ptp(speeds) > 0.1
    assert np.ptp(energies) < 1e-12 * energies[0]


@pytest.mark.parametrize(("looks", "order"), [(1, 8), (50, 7)])
def test_order(looks, order):
    """Error of equal steps at their end, and of their polynomials at many instants."""
    errors, numbers, times = [], np.array([12, 16, 24]), np.linspace(0.4, 0.1, looks)[::-1]
    expected = of_scipy(HEAVY, [0.0], [PUSH], times, 1e-13)
    for number in numbers:
        found = integrate(HEAVY, AT_HOME, PUSH, times, 1e-2, number)
        assert found.steps in (number, number + 1)  # the first one may be shorter
        errors.append(np.abs(found.states - expected).max())
    slope = -np.polyfit(np.log(numbers), np.log(errors), 1)[0]
    assert order - 0.5 < slope < 10
    assert errors[-1] > 1e-12  # the slope is not that of rounding


def test_errors_are_of_the_size_of_the_accuracy():
    times = np.linspace(0, 0.4, 9)
    expected = of_scipy(HEAVY, [0.0], [PUSH], times, 1e-13)
    steps = []
    for accuracy in (1e-6, 1e-8, 1e-10):
        found = integrate(HEAVY, AT_HOME, PUSH, times, accuracy)
        assert np.abs(found.states - expected).max() < 30 * accuracy
        steps.append(found.steps)
    assert steps[0] < steps[1] < steps[2] < 12 * steps[0]


def falling():
    """Return a platform that falls out of its workspace with hardly any torque."""
    return StewartDynamics(PAPER), PUSH - HOLD


def test_the_edge_is_found_where_a_tight_solution_crosses_it():
    dynamics, torque = falling()
    found = integrate(dynamics, AT_HOME, torque, np.linspace(0, 2, 101), 1e-11)
    solution = solve_ivp(
        lambda t, y: dynamics.change(y, torque),
        (0, found.end + 1e-3), AT_HOME, method="DOP853", rtol=1e-13, atol=1e-13, dense_output=True,
    ).sol  # fmt: skip
    end = brentq(lambda t: margin(PAPER, solution(t)[POSE]), 0.0, found.end + 1e-4, xtol=1e-14)
    assert 0.05 < found.end < 2 and found.failure is not None
    assert found.end == pytest.approx(end, abs=1e-9)
    assert found.failure.time == found.end
    assert margin(PAPER, found.final[POSE]) <= 0 < margin(PAPER, solution(found.end - 1e-8)[POSE])
    assert found.times[-1] < found.end <= found.times[-1] + 0.02
    assert np.abs(found.states - solution(found.times).T).max() < 1e-9


def test_the_edge_is_where_drake_stops():
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    dynamics, torque = falling()
    found = integrate(dynamics, AT_HOME, torque, [2.0], 1e-12)
    builder = DiagramBuilder()
    plant = builder.AddSystem(ExactPlant(dynamics, AT_HOME))
    source = builder.AddSystem(ConstantVectorSource(torque))
    builder.Connect(source.get_output_port(), plant.GetInputPort("torque"))
    simulator = Simulator(builder.Build())
    set_accuracy(simulator, 1e-12)
    simulator.AdvanceTo(2.0)
    assert simulator.get_context().get_time() == pytest.approx(found.end, abs=1e-8)


def test_a_look_outside_ends_a_run_within_a_step():
    """One long step across the edge and back: only who looks in between sees it."""
    dynamics, torque = falling()
    end = integrate(dynamics, AT_HOME, torque, [2.0], 1e-12).end
    seen = integrate(dynamics, AT_HOME, torque, np.linspace(0, end + 5e-4, 50), 1e-6)
    assert seen.failure is not None
    assert seen.end == pytest.approx(end, abs=1e-5)


def test_several_looks_at_one_instant_and_at_the_start():
    found = integrate(HEAVY, AT_HOME, PUSH, [0.0, 0.0, 0.1, 0.1], 1e-9)
    assert np.array_equal(found.states[0], AT_HOME) and np.array_equal(found.states[1], AT_HOME)
    assert np.array_equal(found.states[2], found.states[3])
    alone = integrate(HEAVY, AT_HOME, PUSH, [0.0], 1e-9)
    assert alone.end == 0 and alone.steps == 0 and np.array_equal(alone.final, AT_HOME)
    assert np.array_equal(alone.times, [0.0]) and np.array_equal(alone.states, [AT_HOME])


def test_torques_beyond_all_bounds_end_in_an_error():
    with pytest.raises(IntegrationError, match="no step is short enough at t = 0 s"):
        integrate(HEAVY, AT_HOME, np.full(6, 1e300), [0.1])


def test_where_there_is_no_number_steps_are_cut_to_a_fifth():
    """Like scipy: at most ln(0.1 / 16 eps) / ln 5 steps of eleven evaluations."""
    plant = NativePlant(HEAVY, AT_HOME, np.array([0.1]), 1e-9)
    assert plant.hold([0.0], np.full(6, np.nan)) == Ended.TOO_SHORT_STEPS
    assert plant.run.evaluations < 30 * 11
