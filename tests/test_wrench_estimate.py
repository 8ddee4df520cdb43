"""A wrench on the plate as estimated parameters: `wrench` in `controller.estimate`."""

from dataclasses import replace

import numpy as np
import pytest

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.filter_settings import FilterSettings, usual_parameters
from stewart_drake.law.sensing import StateSensing
from stewart_drake.law.startup import reference_torque
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.calibration import CALIBRATED
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import WRENCHES
from tests.filters import Filter, Period
from tests.mechanisms import PAPER
from tests.oracles import central_difference, relative

PERIOD, AMPLITUDE = 0.1, np.array([np.pi / 12] * 3 + [0.02, 0.02, 0.08])
NOISE = 1e-3 * np.tile(AMPLITUDE, 2)
WALK = np.repeat([5e-4, 5e-3], 3)
JUMP = 10 * WALK
PLANT = StewartDynamics(PAPER, gravity=False, free=WRENCHES)
KNOWN = replace(usual_parameters(4.0, 0.02, None, free=WRENCHES), std=WALK, walk=WALK, jump=JUMP)
SETTINGS = FilterSettings(KNOWN, np.full(12, 1e-9), 0.0, np.sqrt(PERIOD) * WALK, None)
ON = ("plant.kind=exact", "start=on_reference", "queue=reference")
ESTIMATED = "controller.estimate=[torque_bias,payload,damping,wrench]"
FORCE = "plant.push={wrench: [0, 0, 0, 0.05, 0, 0], from: 4}"


def filter_of(**changes):
    return Filter(PLANT, StateSensing(NOISE, AMPLITUDE), replace(SETTINGS, **changes))


def held(state):
    """Return a period under the torque that keeps the plate's speed."""
    torque = PLANT.inverse_dynamics(state[:6], state[6:], np.zeros(6))
    return Period(torque[None], np.array([PERIOD]), torque, 2)


def moved(state, period, wrench):
    return PLANT.predict(state, period.torques, period.durations, 4, wrench)[-1]


FIRST = np.concatenate([PAPER.home, 0.2 * AMPLITUDE])


# The filter.


def test_a_prediction_widens_by_the_walk_alone():
    """F P F' + Q with F by differences of the exact plant."""
    wrench, assumed = 2 * WALK, filter_of()
    before = assumed.start(FIRST, wrench)
    after = assumed.advance(before, period := held(FIRST), None)
    F, Q = np.eye(18), np.diag(np.concatenate([SETTINGS.model_std**2, PERIOD * WALK**2]))
    F[:12] = central_difference(
        lambda xi: moved(xi[:12], period, xi[12:]), np.append(FIRST, wrench), 1e-3
    )
    expected = F @ before.covariance @ F.T + Q
    scale = 1 / np.sqrt(np.diag(expected))
    by_scale = np.outer(scale, scale)
    assert relative(by_scale * after.covariance, by_scale * expected) < 1e-3
    assert np.array_equal(after.parameters, wrench)


def test_the_filter_is_as_sure_as_it_should_be_of_a_wrench_that_walks():
    """Mean squared normalised error of 18 states over 40 runs of 12 periods, a chi-squared mean."""
    rng, assumed, found = np.random.default_rng(7), filter_of(), []
    for _ in range(40):
        state, wrench = FIRST, WALK * rng.standard_normal(6)
        estimate = assumed.start(state + NOISE * rng.standard_normal(12), np.zeros(6))
        for _ in range(12):
            period = held(state)
            state = moved(state, period, wrench)
            wrench = wrench + np.sqrt(PERIOD) * WALK * rng.standard_normal(6)
            estimate = assumed.advance(estimate, period, state + NOISE * rng.standard_normal(12))
        off = np.append(state, wrench) - estimate.mean
        found.append(off @ np.linalg.solve(estimate.covariance, off))
    assert abs(np.mean(found) - 18) < 4 * np.sqrt(2 * 18 / len(found))


@pytest.mark.parametrize("size", [0.05, 0.5, 5.0])
def test_a_sudden_push_is_found_within_a_period(size):
    """At any size; without jumps it is an outlier."""
    wrench, period = np.array([0, 0, 0, size, 0, 0]), held(FIRST)
    after = moved(FIRST, period, wrench)
    for jump, found in ((JUMP, True), (None, False)):
        sure = replace(KNOWN, std=1e-3 * WALK)
        assumed = filter_of(parameters=sure, walk_std=1e-3 * WALK, jump_std=jump)
        estimate = assumed.advance(assumed.start(FIRST, np.zeros(6)), period, after)
        assert (estimate.outliers == 0) == found
        off = np.abs(estimate.parameters - wrench)
        assert np.all(off <= 4 * np.sqrt(np.diag(estimate.covariance)[12:])) == found


@pytest.mark.parametrize("place", range(12))
def test_a_spike_is_no_push(place):
    """Pose and rates contradict each other."""
    assumed, period = filter_of(jump_std=JUMP), held(FIRST)
    spiked = moved(FIRST, period, np.zeros(6))
    spiked[place] += 0.3 * np.tile(AMPLITUDE, 2)[place]
    estimate = assumed.advance(assumed.start(FIRST, np.zeros(6)), period, spiked)
    assert estimate.outliers == 1 and not estimate.parameters.any()


# The prior.


def test_its_prior_is_of_the_motion_and_can_be_set():
    scenario = load_scenario("paper", settings=(*ON, ESTIMATED))
    experiment = prepare(scenario)
    tau = reference_torque(experiment.nominal, experiment.reference, scenario.duration)
    scale = np.repeat([tau, tau / 0.11], 3)
    known = compose_law(experiment).observer.settings.parameters
    assert known.names[8:] == WRENCHES
    np.testing.assert_allclose(known.jump[8:], 0.4 * scale)
    np.testing.assert_allclose([known.std[8:], known.walk[8:]], [2e-4 * scale] * 2)
    assert not known.walk[:8].any() and not known.jump[:8].any()
    scenario.controller.prior.wrench, scenario.controller.prior.wrench_walk = [1e-3, 0.1], [1, 2]
    known = compose_law(prepare(scenario)).observer.settings.parameters
    np.testing.assert_allclose(known.jump[8:], [1e-3] * 3 + [0.1] * 3)
    np.testing.assert_allclose(known.std[8:], known.jump[8:])  # also at the start
    np.testing.assert_allclose(known.walk[8:], [1] * 3 + [2] * 3)


def test_a_wrench_is_no_constant_of_a_machine():
    assert set(WRENCHES).isdisjoint(CALIBRATED)


# The loop.


def error_of(*settings, controller=None):
    found = run_in_bulk(load_scenario("paper", controller, (*ON, *settings)))
    return found.figures.accumulated_error if found.status == "completed" else np.inf


@pytest.mark.parametrize("controller", [None, "adaptive_lqi"])
def test_a_push_is_borne_across_the_delay(controller):
    """0.05 N along x from 4 s on, full size: 2.14, delay estimated 1.56; without lost, 19.5."""
    assert error_of(FORCE, ESTIMATED, controller=controller) < 2.5
    without = () if controller else ("controller.replan=0",)
    assert error_of(FORCE, *without, controller=controller) > 15
    assert error_of(ESTIMATED, controller=controller) < 0.1


def test_the_estimate_is_the_push():
    """In Drake's loop, of a push and its end."""
    push = "plant.push={wrench: [0.001, 0, 0, 0.05, -0.02, 0.03], from: 1.05, to: 2}"
    scenario = load_scenario("paper", settings=(*ON, push, ESTIMATED, "duration=3"))
    run = simulate(scenario, judge_stability=False)
    signals = run.signals.sel(time=[1.0, 1.8, 2.9], method="nearest")
    expected = np.array([np.zeros(6), scenario.plant.push.wrench, np.zeros(6)])
    tolerance = 0.02 * np.repeat([1e-3, 0.05], 3)
    assert np.all(np.abs(signals.wrench_estimate.values - expected) < tolerance)
    assert np.all(signals.wrench_std.values > 0)
    error = error_of(push, ESTIMATED, "duration=3")
    assert run.summary["accumulated_error"] == pytest.approx(error, rel=1e-4)
