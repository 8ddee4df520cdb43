"""The tuner against every fixed gain: the statistics, the candidates, the command."""

import json

import numpy as np
import pytest
from scipy import stats

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.reporting.tuner_document import evaluation_document
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.tuner.network import Network, save_network
from stewart_drake.tuning.evaluation import GAINS, TUNER, Evaluation, compare, evaluate
from stewart_drake.tuning.grid import PAIRS

NAMES = ("a", "b", TUNER)
SMALL = (
    "plant.kind=exact",
    "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]",
    "duration=1.0",
)


def constant(weights, path):
    """A network that answers the same whatever it is asked."""
    network = Network(
        input_mean=np.zeros(18),
        input_scale=np.ones(18),
        W1=np.zeros((2, 18)),
        b1=np.zeros(2),
        W2=np.zeros((2, 2)),
        b2=np.log(weights),
        bounds=np.array([[1e-3, 1e-3], [1e3, 1e3]]),
        output="log_weights",
    )
    save_network(network, path)
    return path


# ---------------------------------------------------------------- candidates and statistics


def test_the_candidates_are_one_pair_of_each_ratio():
    assert set(GAINS.values()) <= set(PAIRS)
    ratios = [q / r for q, r in GAINS.values()]
    assert len(ratios) == 7 == len({round(x, 9) for x in ratios})
    assert {round(x, 9) for x in ratios} == {round(q / r, 9) for q, r in PAIRS}


def test_means_are_over_the_scenarios_that_all_complete():
    nan = np.nan
    error = np.array([[1.0, 2, 9, 3], [2, 4, 9, nan], [1, 1, nan, 4]])
    found = compare(NAMES, error, 0)
    assert found["common"] == 2
    assert [found["candidates"][n]["failures"] for n in NAMES] == [0, 1, 1]
    assert [found["candidates"][n]["mean"] for n in NAMES] == [1.5, 3.0, 1.0]
    assert [found["candidates"][n]["worst"] for n in NAMES] == [2.0, 4.0, 1.0]
    assert found["best_fixed"] == "a"
    assert found["improvement"] == pytest.approx(1 - 1 / 1.5)
    assert found["hindsight"] == 0.0


def test_few_failures_come_before_a_small_mean():
    error = np.array([[5.0, 5, 5], [1, 1, np.nan], [4, 4, 4]])
    assert compare(NAMES, error, 0)["best_fixed"] == "a"


def test_the_interval_of_the_mean_is_students():
    error = np.vstack([np.random.default_rng(0).gamma(2.0, size=(3, 25))])
    low, high = compare(NAMES, error, 0)["candidates"]["b"]["interval"]
    expected = stats.ttest_1samp(error[1], 0).confidence_interval(0.95)
    assert (low, high) == pytest.approx((expected.low, expected.high))


def test_the_interval_of_the_improvement_covers_the_truth():
    # A tuner that is 20 % better up to noise: about 95 of 100 intervals hold the 0.2.
    random, inside = np.random.default_rng(1), 0
    for trial in range(100):
        base = random.gamma(4.0, size=60)
        error = np.vstack([base, 2 * base, 0.8 * base * (1 + 0.2 * random.standard_normal(60))])
        low, high = compare(NAMES, error, trial)["improvement_interval"]
        inside += low <= 0.2 <= high
    assert 85 <= inside <= 100


def test_hindsight_bounds_what_any_choice_of_gain_can_do():
    error = np.array([[1.0, 4], [4, 1], [2.5, 2.5]])
    found = compare(NAMES, error, 0)
    assert found["hindsight"] == pytest.approx(1 - 1 / 2.5) and found["improvement"] == 0


def test_without_common_scenarios_there_is_no_mean():
    found = compare(NAMES, np.array([[np.nan, 1], [1, np.nan], [1, 1]]), 0)
    assert found["common"] == 0 and np.isnan(found["improvement"])
    table = evaluation_document(Evaluation(NAMES, np.full((3, 2), np.nan), found)).plain()
    assert "0 of 2 scenarios" in table


# ---------------------------------------------------------------- runs


def test_a_constant_tuner_is_its_fixed_gain(tmp_path):
    # The scenario's own weights at the first sample, the network's from then on: the same ones.
    scenario = load_scenario("paper", "delay_lqi", SMALL)
    path = constant((1.0, 1.0), tmp_path / "constant.json")
    result = evaluate(scenario, path, tmp_path / "out", scenarios=2, workers=1)
    assert result.candidates == (*GAINS, TUNER) and result.error.shape == (8, 2)
    own = next(i for i, (q, r) in enumerate(GAINS.values()) if q == r)
    np.testing.assert_allclose(result.error[-1], result.error[own], rtol=1e-6)
    assert result.summary["fallbacks"] == 0

    other = constant((4.0, 0.1), tmp_path / "other.json")
    seen = []
    again = evaluate(
        scenario,
        other,
        tmp_path / "out",
        scenarios=2,
        workers=1,
        progress=lambda *n: seen.append(n),
    )
    np.testing.assert_array_equal(again.error[:-1], result.error[:-1])
    assert seen[0] == (14, 16), "the fixed gains are not run again"
    assert seen[-1] == (16, 16)
    assert not np.array_equal(again.error[-1], result.error[-1])


def test_one_scenario_is_too_few(tmp_path):
    with pytest.raises(ConfigError, match="--scenarios"):
        evaluate(load_scenario("paper"), None, tmp_path, scenarios=1)


def test_the_command_prints_a_table_and_writes_a_summary(tmp_path, capsys):
    path = constant((1.0, 1.0), tmp_path / "net.json")
    arguments = ["tune", "evaluate", str(path), "--controller", "delay_lqi", "--scenarios", "2"]
    arguments += [part for setting in SMALL for part in ("--set", setting)]
    assert main([*arguments, "--workers", "1", "--out", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert err == "" and all(len(line) <= 80 for line in out.splitlines()[:-1])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert set(summary["candidates"]) == {*GAINS, TUNER}
    assert len(summary["scenarios"]) == 2
    assert main([*arguments, "--seed", "1", "--out", str(tmp_path / "out")]) == 2
    assert "belongs to other settings" in capsys.readouterr().err
