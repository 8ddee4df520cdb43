"""`plant.kind: paper`: the paper's torque map frozen at home, taken for the machine."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

import stewart_drake as sd
from stewart_drake.dynamics.frozen_map import Band, FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.scenario.config import PlantConfig
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.scenario.signals import PLANT_PARAMETERS, POSE, RATES
from tests.mechanisms import PAPER, random_mechanism
from tests.test_printed_law import AMPLITUDE, error

FULL = "overlay=paper_plant"


@pytest.fixture(params=["paper", "random"])
def plant(request):
    machine = PAPER if request.param == "paper" else random_mechanism(np.random.default_rng(4))
    bias = [1e-3, -2e-3, 0.0, 5e-3, 0.0, -1e-3, 0.0, 0.0]
    return FrozenDynamics(machine, gravity=False, parameters=bias, free=PLANT_PARAMETERS)


def somewhere(seed):
    """Pose, far beyond anybody's reach, rates and torque."""
    rng = np.random.default_rng(seed)
    return 9 * rng.standard_normal(6), rng.standard_normal(6), 0.1 * rng.standard_normal(6)


def test_accelerations_are_the_map_at_home_wherever_the_plate_is(plant):
    pose, rates, torque = somewhere(0)
    B = torque_map(plant.mechanism, plant.mechanism.home)
    expected = B @ (torque + plant.plant_parameters[:6])
    a = plant.accelerations(pose, rates, torque)
    np.testing.assert_allclose(a, expected, rtol=1e-12)
    np.testing.assert_allclose(plant.inverse_dynamics(pose, rates, a), torque, rtol=1e-9)
    rows = np.concatenate([pose, rates, a])[None]
    np.testing.assert_allclose(plant.torques_along(rows), torque[None], rtol=1e-9)
    change = plant.change(np.concatenate([pose, rates]), torque)
    np.testing.assert_array_equal(change, [*rates, *a])
    plant.require_reach(pose)
    np.testing.assert_array_equal(plant.massless_map(pose), B)


def test_derivatives_are_differences_of_accelerations(plant):
    pose, rates, torque = somewhere(1)
    found = plant.derivatives(pose, rates, torque)
    h = 1e-3  # the equations are linear
    for k, row in enumerate(np.eye(6)):
        by_torque = plant.accelerations(pose, rates, torque + h * row)
        by_torque = (by_torque - plant.accelerations(pose, rates, torque)) / h
        np.testing.assert_allclose(found.B[RATES, k], by_torque, rtol=1e-8, atol=1e-8)
    for k, name in enumerate(PLANT_PARAMETERS):
        if name == "coulomb_speed":
            continue
        at = plant.plant_parameters + h * np.eye(len(PLANT_PARAMETERS))[k]
        change = plant.accelerations(pose, rates, torque, at)
        change = (change - plant.accelerations(pose, rates, torque)) / h
        np.testing.assert_allclose(found.G[RATES, k], change, rtol=1e-8, atol=1e-8)
    assert np.array_equal(found.A[POSE, RATES], np.eye(6)) and not found.A[RATES].any()


def test_predictions_are_parabolas(plant):
    pose, rates, _ = somewhere(2)
    torques = 0.1 * np.random.default_rng(3).standard_normal((4, 6))
    holds = np.array([0.1, 0.3, 0.05, 0.2])
    found = plant.predict(np.concatenate([pose, rates]), torques, holds, substeps=3)
    for k, state in enumerate(found):
        a = plant.accelerations(pose, rates, torques[k])
        pose, rates = pose + holds[k] * rates + holds[k] ** 2 / 2 * a, rates + holds[k] * a
        np.testing.assert_allclose(state, [*pose, *rates], rtol=1e-12, atol=1e-12)


def test_the_plate_gets_the_power_of_the_motors(plant):
    """dE/dt = torque' (crank rates), by a difference of energies, the bias being a torque too."""
    pose, rates, torque = somewhere(5)
    h = 1e-6
    v = rates + h * plant.accelerations(pose, rates, torque)
    gained = (plant.energy(pose, v) - plant.energy(pose, rates)) / h
    cranks = plant.actuation_map(pose).T @ rates
    whole = torque + plant.plant_parameters[:6]
    assert gained == pytest.approx(float(whole @ cranks), rel=1e-4)
    if plant.mechanism is PAPER:  # at home, of the machine itself too: legs without mass do no work
        true = StewartDynamics(PAPER, gravity=False)
        np.testing.assert_allclose(plant.actuation_map(pose), true.actuation_map(PAPER.home))


def test_the_band_is_ten_peak_to_peaks_about_the_moving_reference():
    experiment = prepare(sd.load_scenario("table2", settings=[FULL]))
    band = experiment.limits
    assert isinstance(band, Band)
    np.testing.assert_allclose(band.width, 20 * AMPLITUDE)
    there = experiment.reference.value(1.3)[:, 0]
    for k in range(6):
        aside = np.eye(6)[k] * 20 * AMPLITUDE[k]
        assert band.margin(1.3, there + 0.999 * aside) == pytest.approx(0.001)
        assert band.diagnose(1.3, there - 0.999 * aside) is None
        left = band.diagnose(1.3, there - 1.001 * aside)
        assert left is not None and left.time == 1.3 and "ten times" in left.reason


@pytest.mark.parametrize(
    ("row", "integral", "share"),
    [
        ("delay_lqr", False, 1.0),
        ("delay_lqi", True, 1.0),
        ("delay_lqi_sum", True, 100.0),
        ("delay_lqi_200", True, 200.0),
    ],
)
def test_the_loop_is_the_one_that_is_written_out_by_hand(row, integral, share):
    scenario = load_comparison("table2", ("delay_lqr", "delay_lqi"), [FULL])[row]
    result = sd.simulate(scenario, judge_stability=False)
    assert result.status == "completed" and not any(result.summary["counts"].values())
    by_hand = error(2.3, integral=integral, share=share)
    assert result.accumulated_error == pytest.approx(by_hand, rel=2e-4)


def test_what_does_not_know_of_the_delay_passes_the_band():
    scenario = load_comparison("table2", ("lqr",), [FULL])["lqr"]
    result = sd.simulate(scenario, judge_stability=False)
    assert result.status == "left_workspace" and result.stopped is not None
    assert "ten times" in result.stopped.reason and result.stopped.leg is None
    error = np.abs(result.signals.error.values[-1]) / (2 * AMPLITUDE)
    assert 8 < error.max() < 10  # the last record is up to 20 ms before


def test_it_has_no_limits_but_one_that_is_asked_for():
    experiment = prepare(sd.load_scenario("table2", settings=[FULL]))
    assert experiment.torque_limit == np.inf
    limited = sd.load_scenario("table2", settings=[FULL, "actuator.torque_limit=0.5"])
    assert prepare(limited).torque_limit == 0.5
    assert uncovered_part(compose_law(experiment)) == "plant.kind"


def test_the_controllers_of_this_package_follow_there_too():
    settings = (FULL, "plant.torque_bias=[1e-3,0,0,0,0,-1e-3]")
    result = sd.simulate(
        sd.load_scenario("table2", "predictor_lqi", settings), judge_stability=True
    )
    assert result.status == "completed"
    assert 0.5 < result.accumulated_error < 25
    margin = result.summary["controller_margin"]
    assert margin is not None and margin["stable"]
    found = result.signals.parameters.values[-1]
    np.testing.assert_allclose(found[:6], [1e-3, 0, 0, 0, 0, -1e-3], atol=1e-4)


def test_it_is_no_machine_for_a_diagram():
    with pytest.raises(sd.ConfigError, match=r"plant\.kind: got 'paper'"):
        sd.AddStewartPlatform(DiagramBuilder(), "paper", PlantConfig(kind="paper"))
