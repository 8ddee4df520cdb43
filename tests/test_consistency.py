"""Whether the estimator's stated uncertainty is right, and the two settings of its noise."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import stewart_drake as sd
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import TOLERATED, Innovations
from stewart_drake.law.filter_settings import (
    FilterSettings,
    acceleration_noise,
    usual_model_error,
    usual_parameters,
)
from stewart_drake.law.sensing import StateSensing
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.cautions import overconfidence
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.loading import load_scenario
from tests.filters import Filter, Period
from tests.mechanisms import PAPER
from tests.oracles import central_difference

SCALE = np.array([0.5, 0.5, 0.5, 0.04, 0.04, 0.16])
NOISE = 1e-3 * np.tile(SCALE, 2)
ON = ("plant.kind=exact", "start=on_reference", "queue=reference", "duration=6")
NOISY = (*ON, f"sensor.noise_std={NOISE.tolist()}")
BIASED = "plant.torque_bias=[3e-4, -3e-4, -3e-4, 3e-4, -3e-4, 3e-4]"


# The test.


@pytest.mark.parametrize(("values", "factor"), [(60, 1.0), (1200, 1.0), (1200, 1.5), (1200, 0.6)])
def test_the_verdict_is_that_of_a_chi_square(values, factor):
    """Squares with `factor` times the stated variance, drawn; at most 1 % of false verdicts."""
    rng = np.random.default_rng(values)
    drawn = [factor * rng.chisquare(values) for _ in range(1000)]
    verdicts = [Innovations(squares, values).verdict for squares in drawn]
    right = {1.0: "consistent", 1.5: "overconfident", 0.6: "cautious"}[factor]
    assert verdicts.count(right) >= 990


def test_constants_that_change_are_overconfident():
    assert Innovations(1200.0, 1200.0, 0.1 * 1200).verdict == "overconfident"
    assert Innovations(1200.0, 1200.0, 0.01 * 1200).verdict == "consistent"


def test_too_few_measurements_have_no_verdict():
    assert Innovations().verdict is None and np.isnan(Innovations().ratio)
    assert Innovations(100.0, 12.0).verdict is None


def test_the_sum_is_that_of_the_filter_in_covariances():
    """nu' (J P J' + R)^-1 nu by differences and dense matrices, over two measurements."""
    plant, dt = StewartDynamics(PAPER, gravity=False), 0.1
    parameters = usual_parameters(4.0, 0.02, None)
    settings = FilterSettings(parameters, 1e-4 * np.tile(SCALE, 2), 0.0)
    assumed = Filter(plant, StateSensing(NOISE, SCALE), settings)
    state = np.concatenate([PAPER.home, 0.2 * SCALE])
    torque = plant.inverse_dynamics(state[:6], state[6:], np.zeros(6))
    period = Period(torque[None], np.array([dt]), torque, 2)
    theta, rng = np.zeros(8), np.random.default_rng(3)
    estimate = assumed.start(state + NOISE * rng.standard_normal(12), theta)
    assert estimate.squares == estimate.values == 0
    expected = 0.0
    for number in (1, 2):

        def end(xi):
            return plant.predict(xi[:12], period.torques, period.durations, 4, xi[12:])[-1]

        y = end(estimate.mean) + 0.3 * NOISE * rng.standard_normal(12)
        H = central_difference(end, estimate.mean, 1e-4)
        S = H @ estimate.covariance @ H.T + np.diag(NOISE**2 + settings.model_std**2)
        nu = y - end(estimate.mean)
        expected += nu @ np.linalg.solve(S, nu)
        estimate = assumed.advance(estimate, period, y)
        assert estimate.values == 12 * number
        assert estimate.squares == pytest.approx(expected, rel=0.01)
    left = assumed.advance(estimate, period, None)
    assert (left.squares, left.values) == (estimate.squares, estimate.values)
    odd = assumed.advance(estimate, period, y + 100 * NOISE)
    assert odd.outliers == 1 and (odd.squares, odd.values) == (estimate.squares, estimate.values)


# In the loop.


def verdict_of(*settings, controller="predictor_lqi"):
    summary = sd.simulate(
        load_scenario("paper", controller, settings), judge_stability=False
    ).summary
    return summary["estimator_consistency"], summary["warnings"]


@pytest.mark.parametrize("controller", ["predictor_lqi", "adaptive_lqi"])
def test_what_the_estimator_knows_of_is_not_overconfident(controller):
    found, warnings = verdict_of(*NOISY, BIASED, controller=controller)
    assert found["verdict"] == "consistent" and 0.75 < found["nis_ratio"] < 1.1
    assert not any("overconfident" in text for text in warnings)


@pytest.mark.parametrize(
    "cause",
    [
        ["plant.coulomb_friction=1e-4"],
        ["plant.payload_mass=0.3", "plant.payload_position=[0.005, 0, 0]"],
        ["controller.delay_steps=7", "controller.delay_fraction=0.98"],
    ],
    ids=["friction", "payload off the centre", "delay 2 ms wrong"],
)
def test_what_it_cannot_explain_is_told(cause):
    found, warnings = verdict_of(*NOISY, BIASED, *cause)
    assert found["verdict"] == "overconfident"
    [text] = [text for text in warnings if "overconfident" in text]
    ratio = found["nis_ratio"]
    off = f"the squares of its prediction errors are {ratio:.3g} times those that it states"
    changed = "parameters that it takes as constant had to change"
    assert f"and {off if ratio > TOLERATED else changed}" in text
    assert "controller.model_error" in text


def test_the_advice_names_no_cause_that_is_estimated_already():
    summary = {
        "estimator_consistency": {"verdict": "overconfident", "nis_ratio": 1.0},
        "delay": {"estimated_s": 0.8, "true_s": 0.8},
        "controller_margin": None,
    }
    scenario = load_scenario("paper", settings=("controller.estimate=[damping,coulomb]",))
    [text] = overconfidence(scenario, summary)
    assert ", or with payload_position or wrench in controller.estimate, or" in text


def test_a_quiet_sensor_is_assumed_to_be_worse_than_it_is():
    found, _ = verdict_of(*ON)
    assert found["verdict"] == "cautious" and found["nis_ratio"] < 0.1


@pytest.mark.parametrize("controller", ["lqi", "delay_lqi"])
def test_without_an_estimator_there_is_nothing_to_judge(controller):
    found, _ = verdict_of("duration=1", controller=controller)
    assert np.isnan(found["nis_ratio"]) and found["verdict"] is None


# The noise.


def test_the_noise_of_accelerations_is_that_of_simulated_paths():
    """White acceleration noise of intensity sigma, integrated in fine steps over two periods."""
    rng, sigma, runs, fine = np.random.default_rng(1), 0.3, 4000, 200
    for dt in (0.01, 0.1):
        h = dt / fine
        pushes = sigma * np.sqrt(h) * rng.standard_normal((runs, fine))
        rates = np.cumsum(pushes, axis=1)
        poses = np.sum(rates, axis=1) * h
        stated = acceleration_noise(sigma, np.ones(6), dt)
        assert poses.std() == pytest.approx(stated[0], rel=0.05)
        assert rates[:, -1].std() == pytest.approx(stated[6], rel=0.05)


def test_one_number_serves_all_periods():
    """Ten periods of 10 ms add up to one of 100 ms, in the default and in a number of one's own."""
    F = np.eye(12) + np.eye(12, k=6) * 0.01
    for law in (
        lambda dt: acceleration_noise(0.02, SCALE, dt),
        lambda dt: usual_model_error(SCALE, dt),
    ):
        short, long, P = law(0.01), law(0.1), np.zeros((12, 12))
        for _ in range(10):
            P = F @ P @ F.T + np.diag(short**2)
        std = np.sqrt(np.diag(P))
        assert std[6:] == pytest.approx(long[6:], rel=1e-9)  # rates
        assert np.all(std[:6] < 1.2 * np.maximum(long[:6], 0.1 * long[6:]))


def settings_of(*settings, name="paper", controller="predictor_lqi"):
    scenario = load_scenario(name, controller, ("plant.kind=exact", *settings))
    return compose_law(prepare(scenario)).observer.settings


def test_the_settings_reach_the_filter():
    scale = prepare(load_scenario("paper")).motion_scale
    own = settings_of("controller.model_error=0.01", "controller.timing_std=0.002")
    assert np.array_equal(own.model_std, acceleration_noise(0.01, scale, 0.1))
    assert own.timing_std == 0.002
    assert not own.learns_timing
    usual = settings_of()
    assert np.allclose(usual.model_std, 2e-4 * np.tile(scale, 2), rtol=1e-12)
    assert usual.timing_std == pytest.approx(6e-4) and usual.learns_timing
    encoders = settings_of("sensor.kind=encoders")
    assert encoders.timing_std == pytest.approx(6e-4) and encoders.learns_timing


def test_the_default_goes_with_the_plant_and_the_sensor():
    """Only the errors of an exact plant and of a sensor that does not round are white."""
    short = settings_of("controller.period=0.01", "delay.steps=80")
    long = settings_of()
    assert np.allclose(short.model_std[6:], np.sqrt(0.1) * long.model_std[6:])
    assert np.allclose(short.model_std[:6], 0.1**1.5 * long.model_std[:6])
    for other in ("plant.kind=multibody", "sensor.kind=encoders"):
        found = settings_of("controller.period=0.01", "delay.steps=80", other)
        assert np.allclose(found.model_std, long.model_std)
    assert np.allclose(usual_model_error(SCALE, 0.1), 2e-4 * np.tile(SCALE, 2))


@pytest.mark.parametrize("seed", [71, 72, 73])
def test_a_learnt_timing_keeps_the_plate_across_a_delay_with_gravity(seed):
    """0.16 s at full size. Torques that are assumed to be 0.1 ms early or late lose the plate."""
    noisy = f"sensor.noise_std={(NOISE / 2).tolist()}", f"sensor.seed={seed}", "duration=3"
    exact, given = "plant.kind=exact", ("controller.timing_std=1e-4", "controller.replan=0")
    lost = run_in_bulk(load_scenario("gravity", "predictor_lqi", (exact, *noisy, *given)))
    kept = run_in_bulk(load_scenario("gravity", "predictor_lqi", (exact, *noisy)))
    assert lost.status == "left_workspace"
    assert kept.status == "completed" and kept.error_so_far < 0.3


@pytest.mark.parametrize(
    ("times", "wide", "low", "high"), [(9, 1, 7, 11), (1, 1, 0.5, 1.5), (0, 5, 0, 0.3)]
)
def test_late_torques_are_told_from_a_wrong_model_by_the_direction(times, wide, low, high):
    """Innovations (12) drawn with variances wide^2 (1 + times k k'); a wide one is a push."""
    c, rng, kick = core(), np.random.default_rng(4), 3.0 * np.eye(12)[7]
    noise, found = c.ffi.new("stewart_noise *"), []
    c.lib.stewart_noise_start(noise)
    nothing = np.zeros(12 * 13), np.zeros(1)
    for _ in range(600):
        drawn = wide * rng.standard_normal(12) * np.sqrt(1 + times * kick**2)
        stated = 1 + noise.timing * kick**2
        given = 12, c.at(drawn), c.at(stated)
        c.lib.stewart_noise_learn(*given, 1, *map(c.at, nothing), 1, c.at(kick), 0.98, noise)
        found.append(noise.timing)
    assert low <= np.mean(found[100:]) <= high


@pytest.mark.parametrize("samples", [1, 5])
def test_encoders_learn_that_parameters_wander(samples):
    """Coulomb friction, which no parameter explains: with constants the error exceeds 1.3 % s."""
    settings = "plant.coulomb_friction=10", "sensor.kind=encoders", "sensor.bits=20"
    more = f"sensor.samples={samples}", "sensor.loss=0.1", "duration=4"
    found = run_in_bulk(load_scenario("motion_base", "predictor_lqi", (*ON, *settings, *more)))
    assert found.status == "completed" and found.error_so_far < 0.8


@pytest.mark.parametrize("controller", ["predictor_lqi", "adaptive_lqi"])
def test_a_jitter_far_above_the_assumed_one_does_not_move_the_parameters(controller):
    """10 ms, 17 times what the filter starts with; six seeds."""
    jitter = (*ON, "duration=10", "delay.jitter_std=0.01")
    runs = [
        run_in_bulk(load_scenario("paper", controller, (*jitter, f"delay.seed={seed}")))
        for seed in range(40, 46)
    ]
    assert all(run.status == "completed" for run in runs)
    assert np.median([run.error_so_far for run in runs]) < 3


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_late_torque_by_mistake_is_soon_corrected(seed):
    """Coulomb friction, first taken for a late torque; E_ac exceeds 10 if it stays so."""
    half = np.array([np.pi / 24] * 3 + [0.01, 0.01, 0.04]).tolist()
    motion = f"reference.amplitude={half}", "controller.period=0.02", "delay.steps=5"
    sensor = f"sensor.noise_std={(NOISE / 10).tolist()}", f"sensor.seed={seed}"
    settings = *ON, *motion, *sensor, "plant.coulomb_friction=0.01", "duration=4"
    found = run_in_bulk(load_scenario("gravity", "predictor_lqi", settings))
    assert found.status == "completed" and found.error_so_far < 6


# The timing of torques without an estimator.


def timing_of(*settings):
    """Return the standard deviation of the torques' instants that is known at each sample, s."""
    known = *ON, "controller.estimate=[]", "duration=8"
    found, loop = (
        [],
        sd.build_closed_loop(load_scenario("paper", "predictor_lqi", (*known, *settings))),
    )
    simulator = Simulator(loop, loop.CreateDefaultContext())
    controller = loop.GetSubsystemByName("controller")
    for k in range(1, 80):
        simulator.AdvanceTo(0.1 * k + 0.05)
        context = controller.GetMyContextFromRoot(simulator.get_context())
        found.append(controller.memory(context).belief.timing)
    return np.array(found)


def test_a_jitter_is_learnt_without_an_estimator():
    """Root mean square over the second half of runs with six seeds."""
    late = [timing_of("delay.jitter_std=0.003", f"delay.seed={seed}")[40:] for seed in range(6)]
    assert np.sqrt(np.mean(np.square(late))) == pytest.approx(0.003, rel=0.3)


@pytest.mark.parametrize(
    ("cause", "most"),
    [((), 2e-4), ((f"plant.torque_bias={[3e-4, -3e-4] * 3}",), 2e-4), (NOISY[-1:], 0.0)],
)
def test_neither_noise_nor_what_is_constant_is_jitter(cause, most):
    assert timing_of(*cause).max() <= most
