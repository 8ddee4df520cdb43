"""Health features of the law's memory; the rule, networks of both kinds, limits."""

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.bulk import ending_of, run_in_bulk
from stewart_drake.loop.simulation import simulate
from stewart_drake.loop.tuner import RULES, health_of, weights_source
from stewart_drake.tuner.network import WINDOW, Network, load_network, save_network
from stewart_drake.tuner.source import (
    NAMES,
    DensityFeatures,
    FixedPolicy,
    RatioPolicy,
    Rule,
    WeightsSource,
    ratio_of,
    weights_of,
)
from stewart_drake.tuning.data import watched_run
from stewart_drake.tuning.families import FAMILIES, SAMPLES

LOWEST, HIGHEST = -6.0, 4.0
"""Bounds of a feature."""
FALL, RISE = 0.35, 0.15
"""Decades of w_Q / w_R per sample."""
LEAST, MOST = -4.0, 2.0
"""Bounds of log10(w_Q / w_R)."""
ROW = (
    *("error", "feedback", "change", "surprise", "missed", "late", "late_weight", "early"),
    *("early_weight", "ratio", "doubt"),
)
"""A row of the window; the torque that acted last follows."""

FOLLOWS = ("plant.kind=exact", "start=on_reference", "queue=reference")
BLIND = (*FOLLOWS, "controller.estimate=[]")


def scenario(*settings):
    return sd.load_scenario("paper", settings=settings)


def seen(one, ratio=-2.0):
    """(k, 18) features of a run with a fixed ratio, NaN at every second sample."""
    policy = FixedPolicy(weights_of(ratio))
    return np.asarray(watched_run(one, policy, round(10 * one.duration))[1])


def feature(values, name):
    return np.asarray(values[:, NAMES.index(name)])


def health():
    made = []

    def make(experiment, law):
        features, policy = health_of(experiment, law), FixedPolicy(np.ones(2))
        made.append(WeightsSource(law.plant, features, policy))
        return made[-1]

    run_in_bulk(scenario("duration=0.2", *BLIND), tuner=make)
    return made[0]


def window(**columns):
    """One of rows in which everything is 0 but these."""
    rows = {name: np.zeros(WINDOW) for name in ROW}
    rows |= {name: np.broadcast_to(value, WINDOW) for name, value in columns.items()}
    return np.column_stack([*rows.values(), np.zeros((WINDOW, 6))])


# ------------------------------------------------------------------------- the features


@pytest.mark.parametrize(
    ("periods", "name", "rel"),
    [
        *((8 + late, "timing_31", 0.15) for late in (0.02, 0.08, 0.25)),
        (7.9, "timing_bound", 0.3),  # early
    ],
)
def test_the_timing_error_is_found(periods, name, rel):
    """A delay that is not the one believed shows as what it is in ms, from the loop alone."""
    delay = (f"delay.steps={periods // 1:g}", f"delay.fraction={periods % 1:g}")
    values = seen(scenario(*delay, "controller.delay_steps=8", *BLIND, "duration=6"), -4.0)
    found = 10 ** feature(values, name)[30::2]
    assert np.median(found) == pytest.approx(100 * abs(periods - 8), rel=rel)


def test_where_all_is_as_believed_nothing_surprises():
    values = seen(scenario("duration=5", *BLIND), 0.0)[::2]
    assert np.all(10 ** feature(values, "surprise_peak") < 0.2)
    assert np.all(10 ** feature(values, "timing_31") < 0.2)
    assert np.all(feature(values, "ratio") == 0.0)


def test_noise_that_is_known_surprises_as_much_as_it_should():
    """The innovation's floor is its standard deviation: sqrt(2) of the noise, where that rules."""
    noise = [f"{1e-2 * a:g}" for a in (0.26, 0.26, 0.26, 0.02, 0.02, 0.08) * 2]
    one = scenario(f"sensor.noise_std=[{','.join(noise)}]", "duration=8", *BLIND)
    surprise = 10 ** feature(seen(one, -3.0), "surprise_15")[30::2] - 0.1
    assert 0.7 < np.median(surprise) < 1.2


def test_timing_is_the_moment_estimate_of_its_derivation():
    """nu = -tau kappa + noise of unit size: n = -tau d + sqrt(d) e, simulated."""
    rng, tau, values, found = np.random.default_rng(3), 0.012, health().values, []
    for _ in range(400):
        d = rng.uniform(1e4, 1e5, WINDOW)
        n = -tau * d + np.sqrt(d) * rng.standard_normal(WINDOW)
        found.append(10 ** values(window(late=n, late_weight=d))[0] - 0.05)
    assert np.mean(found) == pytest.approx(1e3 * tau, rel=0.02)


def test_features_are_root_mean_squares_over_their_samples():
    squares = np.arange(1.0, WINDOW + 1) ** 2
    values = health().values(window(error=squares, feedback=squares))
    for name, number, least in (("error_10", 10, 1e-3), ("feedback_4", 4, 1e-4)):
        expected = np.log10(np.sqrt(np.mean(squares[-number:])) + least)
        assert values[NAMES.index(name)] == pytest.approx(expected, abs=1e-12)
    growth = np.sqrt(squares[-5:].mean()) / np.sqrt(squares[-15:-5].mean())
    assert values[-1] == pytest.approx(np.log10(growth), abs=1e-5)


def test_what_is_lost_is_finite_and_bounded():
    """Also of a run that is being lost, where signals grow without limit."""
    one = scenario(
        *("delay.fraction=0.5", "controller.delay_steps=8", "controller.replan=0", *FOLLOWS)
    )
    ending, found = watched_run(one, FixedPolicy(weights_of(1.0)), SAMPLES)
    values = found[np.isfinite(found).all(axis=1)]
    assert ending.stopped is not None
    assert len(values) > 5
    assert np.all((values >= LOWEST) & (values <= HIGHEST))


def test_a_missed_measurement_is_left_out():
    features = health()
    some = window(surprise=4.0)
    some[-1] = np.nan
    values = features.values(some)
    assert np.isfinite(values).all()
    assert values[NAMES.index("surprise_3")] == pytest.approx(np.log10(2.1))


# ------------------------------------------------------------------------- who decides


def decide(policy, values, last):
    return WeightsSource(None, DensityFeatures(), policy).decide_by(values, last)


@pytest.mark.parametrize("goal", [-4.0, -1.0, 0.1, 2.0])
def test_weights_go_towards_a_ratio_and_fall_faster_than_they_rise(goal):
    found = ratio_of(decide(Rule(goal, 0.0, 0.0), np.zeros(18), weights_of(0.0)).weights)
    assert found == pytest.approx(min(max(goal, -FALL), RISE))


def test_the_rule_is_two_lines():
    rule, values = Rule(-1.0, 2.0, 0.5), np.zeros(18)
    for x, ratio in ((0.2, -1.0), (0.5, -1.0), (0.6, -1.2), (9.0, LEAST)):
        values[NAMES.index("surprise_peak")] = x
        decision = decide(rule, values, weights_of(ratio))
        assert ratio_of(decision.weights) == pytest.approx(ratio)
        assert not decision.fell_back
    assert rule.first == pytest.approx(weights_of(-1.0))


def network(start=None, features="health", **changed):
    rng = np.random.default_rng(5)
    given = {
        "input_mean": np.zeros(18),
        "input_scale": np.ones(18),
        "W1": rng.standard_normal((10, 18)),
        "b1": np.zeros(10),
        "W2": rng.standard_normal((2, 10)),
        "b2": np.zeros(2),
        "bounds": np.array([weights_of(LEAST)[0], weights_of(MOST)[1], *weights_of(MOST)[:1],
                            weights_of(LEAST)[1]]).reshape(2, 2),
    }  # fmt: skip
    given |= changed
    return Network(**given, output="log_weights", features=features, start=start)


def test_weights_stay_in_bounds_and_move_as_fast_as_they_may():
    policy = RatioPolicy(network(weights_of(-1.0)))
    rng, last = np.random.default_rng(1), weights_of(-1.0)
    for _ in range(300):
        decision = decide(policy, rng.normal(0, 100, 18), last)
        moved = ratio_of(decision.weights) - ratio_of(last)
        assert -FALL - 1e-9 <= moved <= RISE + 1e-9
        assert LEAST - 1e-9 <= ratio_of(decision.weights) <= MOST + 1e-9
        assert np.prod(decision.weights) == pytest.approx(1.0)
        last = decision.weights


def test_what_fails_leads_back_to_the_start_and_is_counted():
    policy = RatioPolicy(network(weights_of(-2.0)))
    decision = decide(policy, np.full(18, np.nan), weights_of(0.0))
    assert decision.fell_back
    assert ratio_of(decision.weights) == pytest.approx(-FALL)


@pytest.mark.parametrize("tuner", ["rule", "network"])
def test_drakes_loop_and_the_one_in_c_have_the_same_weights(tuner, tmp_path):
    save_network(network(weights_of(-1.0)), tmp_path / "n.json")
    kind = {
        "rule": ("tuner.kind=rule", "tuner.knee=-1", "tuner.ratio=1"),
        "network": ("tuner.kind=ann", f"tuner.weights={tmp_path / 'n.json'}"),
    }[tuner]
    one = scenario(*FOLLOWS, *kind, "duration=2", "delay.fraction=0.1", "plant.accuracy=1e-12",
                   "controller.delay_steps=8")  # fmt: skip
    found, expected = run_in_bulk(one), ending_of(simulate(one, judge_stability=False))
    assert found.weights[: len(expected.weights)] == pytest.approx(expected.weights, rel=1e-5)
    assert len(np.unique(found.weights[:, 0])) > 3
    assert found.error_so_far == pytest.approx(expected.error_so_far, rel=1e-5)


def test_a_failing_network_is_counted_in_both_loops(tmp_path):
    # A mean that no input can be subtracted from without an overflow.
    broken = network(weights_of(-1.0), W2=np.full((2, 10), 1e308))
    save_network(broken, tmp_path / "n.json")
    one = scenario(*FOLLOWS, "tuner.kind=ann", f"tuner.weights={tmp_path / 'n.json'}", "duration=1")
    found, expected = run_in_bulk(one), ending_of(simulate(one, judge_stability=False))
    assert found.counts["tuner_fallbacks"] == expected.counts["tuner_fallbacks"] > 5
    assert found.weights[:, 0] == pytest.approx(weights_of(-1.0)[0])


def test_the_first_weights_know_of_no_sample():
    noisy = "sensor.noise_std=[.01,.01,.01,.001,.001,.001,.01,.01,.01,.001,.001,.001]"
    kind = ("tuner.kind=rule", "tuner.knee=-1", "tuner.ratio=1", "duration=1", *FOLLOWS)
    runs = [run_in_bulk(scenario(noisy, f"sensor.seed={seed}", *kind)).weights for seed in (1, 2)]
    assert np.array_equal(runs[0][:1], runs[1][:1])
    assert ratio_of(runs[0][0]) == pytest.approx(1.0)
    assert not np.array_equal(runs[0], runs[1])


# ------------------------------------------------------------------------- files and borders


def test_a_file_says_features_and_start(tmp_path):
    save_network(network(weights_of(-2.0)), tmp_path / "n.json")
    found = load_network(tmp_path / "n.json")
    assert found.features == "health"
    assert np.array_equal(found.start, weights_of(-2.0))


def test_a_start_outside_the_bounds_is_refused():
    with pytest.raises(ConfigError, match=r"start: got .*; expected \(w_Q, w_R\) within bounds"):
        network(np.array([1e3, 1e-3]))


@pytest.mark.parametrize("settings", [("sensor.kind=encoders",), ("sensor.delay=0.1",)])
def test_predictions_take_a_state_that_is_measured(settings):
    with pytest.raises(ConfigError, match=r"tuner.kind: got 'rule'.*expected 'fixed'"):
        simulate(scenario("plant.kind=exact", "tuner.kind=rule", *settings))


def test_what_the_rule_is_depends_on_the_estimator():
    assert set(RULES) == {False, True}
    made = []

    def make(experiment, law):
        made.append(weights_source(experiment, law))
        return made[-1]

    for follows in (FOLLOWS, BLIND):
        run_in_bulk(scenario(*follows, "tuner.kind=rule", "duration=0.2"), tuner=make)
    assert [one.policy for one in made] == [RULES[True], RULES[False]]


@pytest.mark.parametrize(("family", "bound"), [("T", 0.05), ("N2", 0.04)])
def test_shipped_networks_cost_little_where_nothing_is_wrong(family, bound):
    found = load_network(f"health_{family}")
    assert found.features == "health"
    assert found.card["family"] == family
    kind = ("tuner.kind=ann", f"tuner.weights=health_{family}", *FAMILIES[family].settings)
    assert run_in_bulk(scenario(*kind)).figures.accumulated_error < bound
    rest = run_in_bulk(scenario(*kind, "start=rest", "queue=zero"))
    assert rest.figures.accumulated_error < 21.2
    assert rest.counts["tuner_fallbacks"] == 0
    ratios = [ratio_of(w) for w in rest.weights]
    assert min(ratios) >= LEAST - 1e-9
    assert max(ratios) <= MOST + 1e-9


def test_a_tuner_saves_a_plate_that_fixed_weights_lose():
    late = scenario("delay.fraction=0.2", "controller.delay_steps=8", *BLIND, "controller.w_R=1")
    assert run_in_bulk(late).status == "left_workspace"
    for kind in (("tuner.kind=rule",), ("tuner.kind=ann", "tuner.weights=health_N2")):
        one = scenario("delay.fraction=0.2", "controller.delay_steps=8", *BLIND, *kind)
        assert run_in_bulk(one).status == "completed"
