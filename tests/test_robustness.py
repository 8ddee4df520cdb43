"""Monte Carlo: the statistics against their definitions, the draws, and the study as a whole."""

import csv
import functools
import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import jsonable
from stewart_drake.files.yamlio import validate, validate_pairs
from stewart_drake.loop import bulk
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism import kinematics
from stewart_drake.reporting.page import Provenance, html, unbroken
from stewart_drake.reporting.robustness import document
from stewart_drake.scenario.config import PlantConfig
from stewart_drake.studies import robustness, statistics
from stewart_drake.studies.robustness import RobustnessStudy, factor_values, study_robustness, table
from stewart_drake.studies.runs import Outcome
from stewart_drake.studies.statistics import auc_interval, explain
from stewart_drake.studies.study_options import Ranges, RobustnessOptions
from stewart_drake.studies.uncertainty import (
    MACHINE,
    Scales,
    apply_draw,
    draw,
    run_draw,
    scales_of,
)
from tests.mechanisms import PAPER
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

SCALES = Scales(4.0, (0.26, 0.26, 0.26, 0.02, 0.02, 0.08), 0.0133, 0.95, 0.11, 0.1, 0.66)
MOTION = [math.radians(15)] * 3 + [0.02, 0.02, 0.08]
NOTHING = dict.fromkeys(
    ("payload", "torque_bias", "noise", "damping", "delay", "lengths", "anchors"), 0.0
)


def short(**changes):
    """Return the first 0.2 s of the paper's experiment on the exact plant, without failures."""
    scenario = sd.load_scenario(
        "paper", None, ["plant.kind=exact", "start=on_reference", "queue=reference"]
    )
    return replace(scenario, **{"duration": 0.2, **changes})


def changed(scenario, one):
    return apply_draw(MACHINE, scenario, PAPER, one).as_scenario()


def machine(payload, one):
    """Return the paper's machine, of a scenario with a payload in kg, as it was drawn."""
    scenario = short()
    scenario.plant.payload_mass = payload
    return apply_draw(MACHINE, scenario, PAPER, one).machine()


# ---------------------------------------------------------------- statistics


@settings(deadline=None)
@given(st.integers(1, 2000), st.data(), st.floats(0.5, 0.999))
def test_wilson_ends_solve_their_equation(n, data, confidence):
    s = data.draw(st.integers(0, n))
    found = statistics.wilson_interval(s, n, confidence)
    z = scipy.stats.norm.ppf((1 + confidence) / 2)
    assert 0 <= found.low <= found.value == s / n <= found.high <= 1
    for p in (found.low, found.high):
        assert (s / n - p) ** 2 == pytest.approx(z**2 * p * (1 - p) / n, abs=1e-9)


@pytest.mark.parametrize("p", [0.02, 0.3, 0.5, 0.9, 0.99])
def test_wilson_covers_as_often_as_promised(p):
    """Summed over all outcomes of 100 trials, no sampling; Wald's interval has 0.63 at 0.99."""
    n = 100
    chance = scipy.stats.binom.pmf(np.arange(n + 1), n, p)
    intervals = [statistics.wilson_interval(s, n) for s in range(n + 1)]
    covered = sum(c for c, i in zip(chance, intervals, strict=True) if i.low <= p <= i.high)
    assert 0.9 < covered < 0.99


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(-5, 5), st.floats(-1e3, 1e3)), min_size=4, max_size=60))
def test_rank_correlation_is_pearsons_of_the_ranks(pairs):
    x, y = np.array(pairs, dtype=float).T
    found = statistics.rank_correlation(x, y)
    if len(set(x)) == 1 or len(set(y)) == 1:
        assert all(math.isnan(value) for value in found)
        return
    reference = scipy.stats.pearsonr(scipy.stats.rankdata(x), scipy.stats.rankdata(y))
    assert found.rho == pytest.approx(reference.statistic, abs=1e-12)
    if abs(found.rho) < 1 - 1e-9:  # of the ranks, t has n - 2 degrees
        t = found.rho * math.sqrt((len(x) - 2) / (1 - found.rho**2))
        chance = 2 * scipy.stats.t.sf(abs(t), len(x) - 2)
        assert found.p_value == pytest.approx(chance, rel=1e-6, abs=1e-12)
    assert found.low <= found.rho <= found.high
    assert found.rho == pytest.approx(statistics.rank_correlation(np.exp(x), y).rho)


@pytest.mark.parametrize("constant", [np.inf, 6.0])
def test_a_constant_quantity_has_no_rank_correlation(constant):
    assert np.isnan(statistics.rank_correlation(np.full(9, constant), np.arange(9.0)).rho)


def test_the_interval_of_the_rank_correlation_covers_the_truth():
    """Pairs from a normal distribution of correlation r have rho = 6/pi asin(r/2)."""
    assert math.isnan(statistics.rank_correlation([1, 2, 3], [1, 2, 3]).rho), "too few pairs"
    rng, r = np.random.default_rng(1), 0.6
    truth, hits, trials = 6 / math.pi * math.asin(r / 2), 0, 2000
    for _ in range(trials):
        x, e = rng.standard_normal((2, 60))
        found = statistics.rank_correlation(x, r * x + math.sqrt(1 - r**2) * e)
        hits += found.low <= truth <= found.high
    assert 0.935 < hits / trials < 0.965


@pytest.mark.slow
@pytest.mark.parametrize("q", [0.5, 0.9])
@pytest.mark.parametrize("n", [20, 200])
def test_quantiles_are_covered(n, q):
    """Uniform numbers, whose q-quantile is q; some are infinite."""
    rng, hits, trials = np.random.default_rng(2), 0, 1500
    for _ in range(trials):
        values = rng.uniform(size=n)
        values[values > 0.95] = np.inf
        found = statistics.quantile_interval(values, q)
        assert found.value == np.sort(values)[math.ceil(n * q - 1e-9) - 1]
        hits += found.low <= q <= found.high
    assert hits / trials > 0.94


def test_small_samples_leave_quantiles_open():
    found = statistics.quantile_interval([1.0, 2.0, 3.0], 0.9)
    assert (found.value, found.high) == (3.0, np.inf)
    assert statistics.quantile_interval([1.0, np.inf], 0.99).value == np.inf


@pytest.mark.parametrize("q", [0.5, 0.75, 0.9, 0.95, 0.99])
def test_the_runs_that_bound_a_quantile(q):
    n = statistics.runs_to_bound(q)
    assert np.isfinite(statistics.quantile_interval(np.arange(float(n)), q).high)
    assert np.isinf(statistics.quantile_interval(np.arange(float(n - 1)), q).high)


@pytest.mark.parametrize(
    ("runs", "expected"),
    [
        (4, "Too few runs to bound E_ac: the median takes 6, 95 % takes 72."),
        (8, "Half of all runs stay below E_ac = 3.00 % s; a bound of 95 % takes 72 runs."),
        (80, "Half of all runs stay below E_ac = 39.0 % s, 95 % below 75.0."),
    ],
)
def test_the_headline_has_the_quantiles_that_the_runs_bound(runs, expected):
    study = made_up(runs)
    study = study._replace(outcomes=[completed(float(k)) for k in range(runs)])
    verdict = document(study).verdict
    assert expected in verdict and "--" not in document(study).plain().replace("--vary", "")


def test_holm_by_hand():
    found = statistics.holm([0.01, 0.04, np.nan, 0.03, 0.005])
    assert found == pytest.approx([0.03, 0.06, np.nan, 0.06, 0.02], nan_ok=True)
    assert statistics.holm([0.6, 0.7]) == pytest.approx([1, 1])


def test_chance_alone_is_rarely_taken_for_an_influence():
    """Ten unrelated quantities at once: at most 5 % of studies see anything, without Holm 40 %."""
    rng, trials, seen, naive = np.random.default_rng(3), 400, 0, 0
    for _ in range(trials):
        y, *factors = rng.standard_normal((11, 40))
        p = [statistics.rank_correlation(x, y).p_value for x in factors]
        naive += min(p) < 0.05
        seen += min(statistics.holm(p)) < 0.05
    assert seen / trials < 0.08
    assert naive / trials > 0.3


# ---------------------------------------------------------------- draws


def test_a_draw_depends_on_seed_and_index_alone():
    scenario, ranges = short(), Ranges()
    forward = [draw(ranges, SCALES, scenario, 3, i) for i in range(5)]
    backward = [draw(ranges, SCALES, scenario, 3, i) for i in reversed(range(5))]
    assert forward == backward[::-1]
    assert len({one["seed"] for one in forward}) == 5
    assert draw(ranges, SCALES, scenario, 4, 0) != forward[0]


@pytest.mark.parametrize("name", [*NOTHING, "torque_limit", "delay_steps"])
def test_a_range_of_its_own_leaves_the_other_draws_alone(name):
    changed = {name: {"torque_limit": None, "delay_steps": 3}.get(name, 0.0)}
    if name == "delay_steps":
        name = "delay"
    for i in range(5):
        one = draw(Ranges(), SCALES, short(), 0, i)
        other = draw(replace(Ranges(), **changed), SCALES, short(), 0, i)
        assert one | {name: other[name]} == other


def test_draws_fill_their_ranges():
    scenario, r, n = short(), Ranges(delay_steps=2), 2000
    draws = [draw(r, SCALES, scenario, 0, i) for i in range(n)]
    values = factor_values(draws)
    ends = {
        "payload": (-0.4, 0.4),
        "torque_bias": (0, 20 * 0.0133),
        "noise": (0, 0.1),
        "torque_limit": (0.66, 3 * 0.66),
        "damping": (0, 20 * 0.0133 / 0.95),
        "lengths": (0, 2e-4 * 110),
        "anchors": (0, 2e-4 * 110),
    }
    for name, (low, high) in ends.items():
        uniform = scipy.stats.uniform(low, high - low).cdf
        assert scipy.stats.kstest(values[name], uniform).pvalue > 1e-3, name
    steps, rest = np.divmod(values["delay"] / 100 + 0.5, 1)
    assert np.bincount((steps + 2).astype(int)) == pytest.approx([n / 5] * 5, rel=0.2)
    assert np.abs(rest - 0.5).max() <= 0.01
    # The directions of the bias favour no motor and no sign.
    directions = np.array([one["torque_bias"] for one in draws])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    assert np.abs(directions.mean(axis=0)).max() < 0.04
    assert directions.T @ directions / n == pytest.approx(np.eye(6) / 6, abs=0.02)


def test_friction_and_the_payloads_place_are_drawn_where_they_are_asked_for():
    """All other draws, and the report on them, stay as they are."""
    scenario, asked = short(), Ranges(coulomb=0.1, payload_position=0.3)
    scenario.plant.coulomb_friction, scenario.plant.payload_position = 1e-3, [0.0, 0.0, 0.05]
    draws = [draw(asked, SCALES, scenario, 0, i) for i in range(200)]
    without = [draw(Ranges(), SCALES, scenario, 0, i) for i in range(200)]
    for one, other in zip(draws, without, strict=True):
        assert one | {"coulomb": 0.0, "payload_position": (0.0,) * 3} == other
    values = factor_values(draws)
    assert set(values) - set(factor_values(without)) == {"coulomb", "payload_position"}
    for name, high in (("coulomb", 100 * 0.0133), ("payload_position", 0.3 * 110)):
        assert scipy.stats.kstest(values[name], scipy.stats.uniform(0, high).cdf).pvalue > 1e-3
    plant = changed(scenario, draws[0]).plant
    assert plant.coulomb_friction == 1e-3 + draws[0]["coulomb"]
    x, y, z = draws[0]["payload_position"]
    assert plant.payload_position == [x, y, 0.05 + z]


def test_the_motors_gain_is_drawn_and_multiplies_their_torques():
    """The accelerations are those of the machine as it is under g times the torque."""
    scenario, asked = short(), Ranges(gain=0.2)
    push = {"wrench": [0.1, 0.0, 0.2, 1.0, -2.0, 0.5]}
    loads = {"payload_mass": 0.3, "torque_bias": [0.01, -0.02, 0.0, 0.01, 0.0, 0.03]}
    frictions = ("joint_damping", "coulomb_friction", "ball_joint_damping", "ball_joint_friction")
    plant = validate(PlantConfig, loads | dict.fromkeys(frictions, 0.02) | {"push": push}, "plant")
    scenario.plant = plant
    one = {"gain": draw(asked, SCALES, scenario, 0, 0)["gain"]}
    g = 1 + one["gain"]
    assert 0.8 < g < 1.2 and g != 1
    drawn = apply_draw(MACHINE, scenario, PAPER, one)
    x, torque = np.concatenate([PAPER.home, np.full(6, 0.05)]), np.linspace(-1, 1, 6)

    def accelerations(mechanism, plant, torque):
        dynamics = sd.StewartDynamics(mechanism, True, [*plant.parameters, *plant.push.wrench])
        return dynamics.accelerations(x[:6], x[6:], torque)

    expected = accelerations(PAPER, plant, g * torque)
    found = accelerations(drawn.machine(), drawn.as_scenario().plant, torque)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    scenario.actuator = sd.PositionServoConfig()
    assert draw(asked, SCALES, scenario, 0, 0)["gain"] == 0


def test_a_delay_is_never_negative():
    scenario = short()
    scenario.delay.steps = 1
    ranges = Ranges(delay_steps=5)
    totals = []
    for i in range(60):
        one = draw(ranges, SCALES, scenario, 0, i)
        delay = changed(scenario, one).delay
        totals.append(delay.steps + delay.fraction)
        assert totals[-1] == pytest.approx(1 + one["delay"] / 0.1, abs=1e-9)
    assert min(totals) == 0.0
    assert max(totals) > 5


def test_the_scenario_changes_as_drawn_and_the_belief_stays():
    scenario = short()
    scenario.plant.payload_mass, scenario.plant.torque_bias = 0.5, [0.1] * 6
    scenario.sensor.noise_std = [1e-3] * 12
    scenario.sensor.faults = [{"kind": "frozen", "from": 1.0, "to": 1.5}]
    one = {
        **{"payload": 0.25, "torque_bias": (0.01,) * 6, "noise": 0.01, "damping": 0.02},
        **{"delay": -0.03, "seed": 7, "torque_limit": 2.0},
    }
    other = changed(scenario, one)
    assert other.plant.payload_mass == 0.75
    assert other.plant.torque_bias == pytest.approx([0.11] * 6)
    assert other.plant.joint_damping == 0.02
    assert (other.delay.steps, other.delay.fraction) == (7, pytest.approx(0.7))
    assert (other.controller.delay_steps, other.controller.delay_fraction) == (8, 0.0)
    assert other.actuator.torque_limit == 2.0
    assert other.sensor.noise_std == pytest.approx(1e-3 + 0.01 * np.tile(MOTION, 2))
    assert (other.sensor.seed, scenario.sensor.seed) == (7, 0)
    assert other.sensor.faults == scenario.sensor.faults != []
    other.check()


def test_what_the_link_does_is_drawn_too():
    wire = short()
    wire.sensor.loss = 0.5
    one = {"jitter": 0.003, "loss": 0.2, "link_seed": 9}
    other = changed(wire, one)
    assert (other.delay.jitter_std, other.delay.seed) == (0.003, 9)
    assert other.sensor.loss == pytest.approx(1 - 0.5 * 0.8) and other.sensor.seed == 9
    network = sd.load_scenario("paper", None, ["link.kind=network", "link.loss=0.1"])
    lossy = changed(network, {**one, "jitter": 0.0}).link
    assert (lossy.loss, lossy.seed) == (pytest.approx(1 - 0.9 * 0.8), 9)
    same = changed(wire, {"jitter": 0.0, "loss": 0.0, "link_seed": 9})
    assert (same.delay.seed, same.sensor.seed) == (0, 0)
    scales = SCALES._replace(period=0.02)
    draws = [draw(Ranges(jitter=0.5, loss=0.3), scales, wire, 0, i) for i in range(200)]
    jitter, loss = (np.array([one[name] for one in draws]) for name in ("jitter", "loss"))
    assert 0 <= jitter.min() < 1e-3 and 9e-3 < jitter.max() <= 10e-3
    assert 0 <= loss.min() < 0.02 and 0.28 < loss.max() <= 0.3


@pytest.mark.slow
def test_other_controllers_run_the_same_machines(tmp_path, capsys):
    options = ["--runs", "2", "--set", "duration=0.2", "--vary", "delay=1", "--json"]

    def summary(controller, *more):
        words = ["analyze", "robustness", "paper", "--controller", controller, *options, *more]
        assert main(words) == 0
        return json.loads(capsys.readouterr().out)

    both = summary("predictor_lqi", "--also", "adaptive_lqi", "--out", str(tmp_path))
    assert both["beside"]["adaptive_lqi"]["success"]["runs"] == 2
    assert "adaptive_lqi, on the same machines: 2 of 2" in (tmp_path / "report.html").read_text()
    alone = summary("adaptive_lqi")  # with the same draws and the same outcomes
    assert alone["E_ac_of_all"] == both["beside"]["adaptive_lqi"]["E_ac_of_all"]
    assert alone["beside"] == {}


def test_a_scenarios_own_limit_is_kept():
    scenario = short()
    scenario.actuator.torque_limit = 1.0
    scales = SCALES._replace(torque_limit=1.0)
    limits = [draw(Ranges(), scales, scenario, 0, i)["torque_limit"] for i in range(50)]
    assert max(limits) == 1.0 > min(limits) >= 0.66
    none = draw(Ranges(torque_limit=None), SCALES, scenario, 0, 0)
    assert none["torque_limit"] == 1.0


def test_where_nothing_is_commanded_no_limit_is_drawn():
    """At rest without gravity, multiples of the undisturbed run's torque would forbid any."""
    scenario, idle = short(), SCALES._replace(commanded=0.0)
    one = draw(Ranges(), idle, scenario, 0, 0)
    assert one["torque_limit"] is None
    changed(scenario, one).check()
    assert draw(Ranges(), SCALES, scenario, 0, 0) | {"torque_limit": None} == one


def test_multibody_delays_are_whole_steps():
    scenario = short()
    scenario.plant.kind = "multibody"
    for i in range(20):
        one = draw(Ranges(delay=0.05), SCALES, scenario, 0, i)
        changed(scenario, one).check()


def test_ranges_from_settings():
    settings = ["payload=0.2", "torque_limit=null", "delay_steps=1"]
    ranges = validate_pairs(Ranges, settings, "--vary")
    assert ranges == Ranges(payload=0.2, torque_limit=None, delay_steps=1)
    for bad, problem in (
        ("payload", "name=value"),
        ("payload=2.0", "payload: got 2.0"),
        ("paylod=0.1", "did you mean payload"),
        ("torque_limit=[3.0, 1.0]", "lesser one first"),
        ("noise=-1.0", "noise: got -1.0"),
    ):
        with pytest.raises(ConfigError, match=problem) as caught:
            validate_pairs(Ranges, [bad], "--vary")
        assert "\n" not in str(caught.value)


# ---------------------------------------------------------------- another machine than believed


def test_the_true_machine_is_off_by_what_was_drawn():
    rng = np.random.default_rng(0)
    one = {
        "lengths": tuple(1e-4 * rng.standard_normal(12)),
        "anchors": tuple(1e-4 * rng.standard_normal(36)),
        "payload": -0.3,
    }
    truth = machine(0.1, one)
    assert truth.crank_lengths - PAPER.crank_lengths == pytest.approx(one["lengths"][:6])
    assert truth.rod_lengths - PAPER.rod_lengths == pytest.approx(one["lengths"][6:])
    assert np.ravel(truth.p_WS - PAPER.p_WS) == pytest.approx(one["anchors"][:18])
    assert np.ravel(truth.p_PQ - PAPER.p_PQ) == pytest.approx(one["anchors"][18:])
    assert truth.plate.mass == pytest.approx(4.0 - 0.2)
    assert machine(0.1, {"payload": -0.1, "lengths": (0.0,) * 12}) is PAPER


def test_lacking_mass_is_a_negative_payload():
    rng = np.random.default_rng(0)
    light = sd.StewartDynamics(machine(0.0, {"payload": -0.3}))
    nominal, theta = sd.StewartDynamics(PAPER), np.zeros(8)
    theta[6] = -0.3
    pose, rates, torque = PAPER.home + 0.01 * rng.standard_normal(6), *rng.standard_normal((2, 6))
    assert light.accelerations(pose, rates, torque) == pytest.approx(
        nominal.accelerations(pose, rates, torque, theta), rel=1e-10
    )


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_the_loop_simulates_the_true_machine(kind):
    """Only the torques in flight act for 0.4 s; they move a plate ten times as heavy less."""
    scenario = short(start="rest", queue="reference", duration=0.4)
    scenario.plant.kind = kind
    scenario.delay.steps, scenario.controller.catch_up = 8, 0.0
    heavy = replace(PAPER, plate=replace(PAPER.plate, mass=40.0, inertia=10 * PAPER.plate.inertia))
    legs = replace(PAPER, crank_lengths=1.01 * PAPER.crank_lengths)
    moved = {}
    for name, truth in (("same", None), ("heavy", heavy), ("legs", legs)):
        result = simulate(scenario, true_mechanism=truth, judge_stability=False)
        moved[name] = result.signals.pose.values
    way = {name: np.abs(pose[-1] - pose[0]).max() for name, pose in moved.items()}
    assert 0.05 < way["heavy"] / way["same"] < 0.2
    assert np.abs(moved["legs"] - moved["same"]).max() > 1e-3 * way["same"]
    experiment = prepare(scenario, heavy)
    assert experiment.nominal.mechanism == PAPER
    assert experiment.truth == heavy


def test_the_true_machine_decides_where_the_workspace_ends():
    """Rods so short that the machine can only just be assembled cannot follow the reference."""
    scenario = sd.load_scenario("paper", None, ["plant.kind=exact"])
    lack = float(kinematics.reach_margins(PAPER, PAPER.home).min())
    for share, at_start in ((0.99999, True), (0.8, False)):
        one = {"lengths": (0.0,) * 6 + (-share * lack,) * 6}
        found = json.loads(run_draw(scenario, one))["outcome"]
        assert found["status"] == "left_workspace"
        assert found["error"] is None
        assert found["leg"] in range(1, 7)
        assert (found["time"] == 0) == at_start
    one = {"lengths": (0.0,) * 6 + (-1.1 * lack,) * 6}
    found = json.loads(run_draw(scenario, one))["outcome"]
    assert found["status"] == "not_assembled"
    assert "out of reach" in found["reason"]


@pytest.mark.parametrize(
    ("one", "problem"),
    [
        (None, "controller.catch_up: got 1 s"),  # what cannot be prepared
        ({"torque_bias": (2e3,) * 6}, "plant.torque_bias[0]: got 2000.0"),
        ({"delay": 100.0}, "delay.steps: got 1008"),
    ],
)
def test_a_draw_beyond_all_scenarios_is_an_outcome(one, problem, monkeypatch):
    def refuse(*_, **__):
        raise ConfigError(problem)

    first_steps = "preparation_of", "prepare_unchecked"  # of the two loops
    for name in first_steps if one is None else ():
        monkeypatch.setattr(bulk, name, refuse)
    found = json.loads(run_draw(short(), one or {}))["outcome"]
    assert found["status"] == "refused" and problem in found["reason"]


# ---------------------------------------------------------------- the study


@pytest.mark.parametrize(
    ("changes", "loop"),
    [({}, "native"), ({"plant": PlantConfig(kind="multibody")}, "drake, plant.kind")],
)
def test_the_summary_counts_runs_by_what_ran_them(tmp_path, changes, loop):
    study = study_robustness(short(**changes), tmp_path, RobustnessOptions(runs=2, workers=1))
    assert study.summary["loops"] == {loop: 2}
    words = {"native": "compiled code", "drake, plant.kind": "Drake, because of plant.kind"}
    assert document(study).facts["simulated by"] == f"{words[loop]} (2 runs)"


def test_the_text_says_around_what_the_torque_limit_is_drawn():
    told = " ".join(document(made_up(20)).plain().split())
    assert re.search(r"Drawn errors: lengths up to \S+ mm \(rms\), delay up to \S+ ms; mach", told)
    assert "from 1 to 3 times the largest torque of the undisturbed run, 0.660 N m" in told


def test_position_servos_get_no_joint_damping():
    """They have their own friction, and a scenario with both is refused."""
    scenario = sd.load_scenario("reachy_mini")
    draws = [draw(Ranges(), SCALES, scenario, 0, index) for index in range(5)]
    assert [one["damping"] for one in draws] == [0.0] * 5
    machine = sd.load_mechanism("reachy_mini")
    assert all(apply_draw(MACHINE, scenario, machine, one).as_scenario() for one in draws)


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file() and p.name[0] != "."}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robustness") / "whole"
    return folder, study_robustness(short(), folder, RobustnessOptions(runs=4, workers=1))


def told(outcomes):
    """To the last digit; as text, since NaN is not equal to itself."""
    return [repr(outcome) for outcome in outcomes]


@pytest.mark.slow
def test_a_resumed_study_equals_an_uninterrupted_one(tmp_path, whole):
    folder, study = whole
    first = study_robustness(short(), tmp_path, RobustnessOptions(runs=2, workers=1))
    assert told(first.outcomes) == told(study.outcomes[:2])
    (tmp_path / "runs" / "run000000.json").unlink()
    resumed = study_robustness(short(), tmp_path, RobustnessOptions(runs=4, workers=2))
    assert contents(tmp_path) == contents(folder)
    assert jsonable(resumed.summary) == jsonable(study.summary)
    with pytest.raises(ConfigError, match="belongs to other settings"):
        study_robustness(short(), tmp_path, RobustnessOptions(runs=4, seed=1))


def test_nothing_drawn_changes_nothing(tmp_path):
    ranges = Ranges(**NOTHING, torque_limit=None)
    study = study_robustness(short(), tmp_path, RobustnessOptions(ranges=ranges, runs=2, workers=1))
    assert told(study.outcomes) == told([study.undisturbed] * 2)
    assert study.undisturbed.error == bulk.run_in_bulk(short()).figures.accumulated_error
    drake = simulate(short(), judge_stability=False).accumulated_error
    assert study.undisturbed.error == pytest.approx(drake, rel=1e-6)
    assert all(math.isnan(one.error.rho) for one in study.influences())
    document(study).plain()
    html(document(study), Provenance("command"))


def test_scales_of_the_paper():
    scales = scales_of(prepare(short(duration=10.0)), 0.7)
    assert scales.motion == pytest.approx(MOTION)
    assert (scales.plate_mass, scales.crank, scales.commanded) == (4.0, 0.11, 0.7)
    assert 0.5 < scales.speed < 2


# ---------------------------------------------------------------- what is told of it


LOST = Outcome("left_workspace", "leg 3 reached the end of its reach", 3, 2.0, peak_torque=1.0)


def completed(error):
    return Outcome("completed", error=error, peak_torque=1.0)


@functools.cache
def made_up(n=400, limit=None):
    """E_ac grows with the noise, the delay and nothing else; late delays fail."""
    scenario = short()
    draws = [draw(Ranges(), SCALES, scenario, 1, i) for i in range(n)]
    outcomes = [
        LOST
        if one["delay"] > 8e-4
        else completed(math.exp(5e3 * one["noise"] + 3e3 * abs(one["delay"])))
        for one in draws
    ]
    study = prepare(scenario), Ranges(), SCALES, 0, limit, completed(1.0), draws, outcomes
    return RobustnessStudy(*study)


def test_influences_are_found():
    study = made_up()
    found = {one.factor: one for one in study.influences()}
    assert study.influences()[0].factor == "noise"
    assert found["noise"].error.rho > 0.8
    assert found["|delay|"].error_p < 0.05
    assert found["delay"].failure.rho > 0.4
    assert found["delay"].failure_p < 1e-6
    for name in ("payload", "torque_bias", "damping", "lengths", "anchors", "torque_limit"):
        assert found[name].error_p > 0.05
        assert found[name].failure_p > 0.05
    told = document(study).plain().replace("\n  ", " ")
    assert "Significant for completing: delay error." in told
    assert "of completed runs: noise of the sensor, delay error." in told


def with_failures(failing, n=300):
    """Return a made-up study in which the draws of `failing` fail; E_ac follows the noise."""
    study = made_up(n)
    rng = np.random.default_rng(7)
    outcomes = [
        LOST if failing(one, rng.uniform()) else completed(math.exp(5e3 * one["noise"]))
        for one in study.draws
    ]
    return study._replace(outcomes=outcomes)


def told_of(study):
    return " ".join(document(study).plain().split())


@pytest.mark.slow
def test_one_cause_of_failing_is_found_and_counted():
    bias = factor_values(made_up(300).draws)["torque_bias"]
    high = float(np.quantile(bias, 0.6))
    study = with_failures(
        lambda one, luck: (
            1e3 * np.sqrt(np.mean(np.square(one["torque_bias"]))) > high and luck < 0.7
        )
    )
    found = study.explanation
    (cause,) = found.found
    assert cause.factor == "torque_bias" and cause.larger
    assert found.pairs == []
    # The counts, from the draws themselves.
    failed, outer = study.failed, bias >= np.quantile(bias, 2 / 3)
    assert (found.failing, found.others) == (failed.sum(), (~failed).sum())
    assert (cause.failing, cause.others) == (sum(outer & failed), sum(outer & ~failed))
    wins = bias[failed][:, None] > bias[~failed]
    assert cause.auc.value == pytest.approx(wins.mean())
    assert 0.75 < cause.auc.low < cause.auc.value < cause.auc.high < 1
    told = told_of(study)
    assert "Significant for completing: torque bias (rms)." in told
    assert "Significant for E_ac of completed runs: noise of the sensor." in told
    counts = (
        f"for {cause.failing} of the {found.failing} against {cause.others} of the {found.others}"
    )
    assert counts in told
    page = html(document(study), Provenance("command"))
    assert counts in " ".join(page.split())
    plain = json.loads(json.dumps(jsonable(study.summary)))["explanation"]
    assert plain["singles"][0]["factor"] == "torque_bias" and plain["singles"][0]["found"]
    assert not any(one["found"] for one in plain["singles"][1:])


@pytest.mark.parametrize("opposite", [False, True])
def test_two_causes_that_only_work_together_are_found_as_a_pair(opposite):
    """Late and heavy; or as well early and light, so that no quantity alone tells anything."""
    plain = made_up(600)
    late, heavy = (np.median(factor_values(plain.draws)[name]) for name in ("delay", "payload"))

    def failing(one, luck):
        a, b = 1e3 * one["delay"] > late, one["payload"] > heavy
        return bool(luck < 0.5 and (a == b if opposite else a and b))

    study = with_failures(failing, 600)
    best = study.explanation.pairs[0]
    assert set(best.factors) == {"delay", "payload"}
    assert best.opposite is opposite and best.sides[0] == best.sides[1]
    assert best.failing == study.failed.sum()
    told = told_of(study)
    assert "Two together: large payload with large delay error" in told
    assert ("or just the opposite" in told) is opposite
    if opposite:
        assert study.explanation.found == []
        assert "No single quantity separates" in told
        assert "No single quantity is significant for completing." in told


def test_no_cause_is_named_from_a_few_failures():
    noise = sorted(one["noise"] for one in made_up(20).draws)[-4]
    study = with_failures(lambda one, luck: one["noise"] >= noise, 20)
    told = told_of(study)
    assert "Too few failures (4) to name a cause." in told and "4 of 20 runs failed" in told
    assert "Significant for completing" not in told and study.explanation.found


@pytest.mark.slow
def test_failures_by_chance_are_explained_by_nothing():
    """But for the one in twenty that chance is allowed, for single quantities and for pairs."""
    rng, values = np.random.default_rng(5), factor_values(made_up(300).draws)
    by_chance = [explain(values, rng.uniform(size=300) < 0.27) for _ in range(40)]
    assert sum(bool(one.found) for one in by_chance) <= 5
    assert sum(bool(one.pairs) for one in by_chance) <= 5
    study = with_failures(lambda one, luck: luck < 0.27)
    found = study.explanation
    assert (found.found, found.pairs) == ([], [])
    told = told_of(study)
    total = f"the {found.failing} failing runs from the other {found.others}"
    assert f"No single quantity separates {total}. Nor does a pair of them." in told
    assert "Significant for completing" not in told


def test_the_auc_interval_covers_the_truth():
    """AUC of two shifted normal samples is Phi(d / sqrt 2); 5 % of the intervals miss it."""
    rng, shift = np.random.default_rng(4), 1.0
    truth = scipy.stats.norm.cdf(shift / np.sqrt(2))
    misses = 0
    for _ in range(400):
        a, b = rng.normal(shift, 1, 30), rng.normal(0, 1, 90)
        one = auc_interval(float((a[:, None] > b).mean()), 30, 90)
        misses += not one.low < truth < one.high
    assert misses / 400 == pytest.approx(0.05, abs=0.03)
    clear = auc_interval(1.0, 5, 20)
    assert 0.5 < clear.low < 1 == clear.high


def test_failures_are_counted_and_never_dropped():
    study = made_up()
    failures = sum(one["delay"] > 8e-4 for one in study.draws)
    assert 0 < failures < 400
    assert study.success.value == 1 - failures / 400
    assert study.reasons == {"a leg reached the end of its reach": failures}
    assert study.quantile(0.99).value == np.inf
    assert study.summary["failures_by_leg"] == {"3": failures}
    assert jsonable(study.summary)["E_ac_of_all"]["0.99"]["value"] is None
    assert study.summary["E_ac_of_completed"]["0.99"]["value"] < np.inf
    lines = list(csv.DictReader(table(study).splitlines()))
    assert len(lines) == 400
    assert sum(row["E_ac [% s]"] == "" for row in lines) == failures
    assert float(lines[5]["noise [%]"]) == 100 * study.draws[5]["noise"]
    strict = made_up(limit=5.0)
    assert strict.reasons["completed with E_ac above 5 % s"] == np.sum(study.errors > 5)
    assert strict.success.value < study.success.value


@pytest.mark.slow
def test_tables_and_pages_of_extreme_studies():
    lost = Outcome("not_assembled", "home", time=0.0)
    uniform = [with_failures(lambda one, luck, fails=fails: fails, 20) for fails in (True, False)]
    for study in (
        made_up(1),
        made_up(400, limit=3.0),
        made_up(20)._replace(outcomes=[lost] * 20),
        *uniform,
    ):
        text = document(study).plain()
        assert max(map(len, text.splitlines())) <= 80
        if study.failed.all() or not study.failed.any():  # nothing to explain
            assert study.explanation.singles == [] and "who fails" not in text
        page = html(document(study), Provenance("command"))
        assert page.count("<img") == (4 if study.failed.any() else 3)
        json.dumps(jsonable(study.summary), allow_nan=False)


@pytest.mark.slow
def test_the_command(tmp_path, capsys):
    out = tmp_path / "out"
    words = ["analyze", "robustness", "paper", "--runs", "3", "--seed", "5", "--out", str(out)]
    words += ["--set", "duration=0.2", "--vary", "delay=0", "--vary", "noise=0.002"]
    said(capsys, *words)
    summary = summary_in(out)
    assert summary["runs"] == 3 and summary["ranges"]["noise"] == 0.002
    assert summary["scenario"]["plant"]["kind"] == "exact"
    command = unbroken(
        "stewart-drake analyze robustness paper --set duration=0.2 --vary delay=0 --vary"
    )
    assert command in (out / "report.html").read_text()
    assert {p.name for p in out.iterdir() if p.name[0] != "."} == {
        "summary.json", "report.html", "runs.csv", "runs",
    }  # fmt: skip
    assert main([*words, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == summary
    assert main([*words[:-1], "noise=0.001"]) == 2
    assert "belongs to other settings" in capsys.readouterr().err


def test_nothing_is_drawn_where_the_undisturbed_run_fails(tmp_path, capsys):
    """All runs were drawn, for a page of dashes."""
    words = ["analyze", "robustness", "paper", "--set", "duration=1", "--out", str(tmp_path)]
    assert main([*words, "--runs", "50", "--set", "plant.gravity=true"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: robustness: the undisturbed run fails at 0.") and "reach" in err
    assert err.count("\n") == 1
    files = {path.name for path in tmp_path.rglob("*.*") if path.is_file()}
    assert files == {"manifest.json", "undisturbed.json", ".lock"}


def test_another_controller_that_fails_undisturbed_is_named(tmp_path):
    lost = replace(short(), plant=replace(short().plant, gravity=True), duration=1.0)
    with pytest.raises(ConfigError, match="robustness with heavy: the undisturbed run fails"):
        study_robustness(
            short(), tmp_path, RobustnessOptions(runs=3, workers=1, also={"heavy": lost})
        )
    assert not list(tmp_path.glob("*/run0*.json"))


def test_ctrl_c(tmp_path, monkeypatch, capsys):
    one = robustness.run_jobs

    def interrupted(jobs, *args, progress=None, **options):
        if progress is None:  # undisturbed
            return one(jobs, *args, **options)
        progress(0, 12)
        raise KeyboardInterrupt

    monkeypatch.setattr(robustness, "run_jobs", interrupted)
    assert main(["analyze", "robustness", "--out", str(tmp_path)]) == 130
    assert "stopped; 0 of 12 finished; finished runs are kept" in capsys.readouterr().err
    assert main(["analyze", "robustness"]) == 130
    assert "nothing is kept without --out" in capsys.readouterr().err
