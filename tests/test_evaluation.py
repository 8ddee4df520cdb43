"""The evaluation of a tuner: its statistics, the candidates, the command."""

import numpy as np
import pytest

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.tuner.network import Network, save_network
from stewart_drake.tuning.data import read_condition, run_condition
from stewart_drake.tuning.evaluation import (
    HINDSIGHT,
    RULE,
    TUNER,
    compare_costs,
    compare_errors,
    evaluate,
    tuners_of,
)
from stewart_drake.tuning.families import (
    FAULTS,
    GAINS,
    PAIRS,
    disturbed_family,
    faulty_family,
)
from stewart_drake.tuning.families import FIXED as GAINS_OF_FAMILIES
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

FIXED = tuple(GAINS_OF_FAMILIES)
NAMES = ("a", "b", TUNER)
SMALL = (
    "plant.kind=exact",
    "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]",
    "duration=1.0",
)


def constant(weights, path):
    """Write a network with a constant answer; return its path."""
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


# ---------------------------------------------------------------- statistics of E_ac


def test_the_candidates_are_one_pair_of_each_ratio():
    assert set(GAINS.values()) <= set(PAIRS)
    ratios = [q / r for q, r in GAINS.values()]
    assert len(ratios) == 7 == len({round(x, 9) for x in ratios})
    assert {round(x, 9) for x in ratios} == {round(q / r, 9) for q, r in PAIRS}


def test_means_are_over_the_scenarios_that_all_complete():
    nan = np.nan
    error = np.array([[1.0, 2, 9, 3], [2, 4, 9, nan], [1, 1, nan, 4]])
    found = compare_errors(NAMES, 2, error, 0)
    assert found["common"] == 2
    assert [found["candidates"][n]["failures"] for n in NAMES] == [0, 1, 1]
    assert [found["candidates"][n]["mean"] for n in NAMES] == [1.5, 3.0, 1.0]
    assert [found["candidates"][n]["worst"] for n in NAMES] == [2.0, 4.0, 1.0]
    assert [found["candidates"][n]["interval"][0] for n in NAMES] == [0.0, 0.0, 1.0], "E_ac >= 0"
    assert found["best_fixed"] == "a"
    assert found["improvement"] == pytest.approx(1 - 1 / 1.5)
    assert found["hindsight"] == 0.0
    error = np.array([[5.0, 5, 5], [1, 1, nan], [4, 4, 4]])
    assert compare_errors(NAMES, 2, error, 0)["best_fixed"] == "a", "before a smaller mean"


def test_the_interval_of_the_improvement_covers_the_truth():
    # A tuner that is 20 % better up to noise: about 95 of 100 intervals hold the 0.2.
    random, inside = np.random.default_rng(1), 0
    for trial in range(100):
        base = random.gamma(4.0, size=60)
        error = np.vstack([base, 2 * base, 0.8 * base * (1 + 0.2 * random.standard_normal(60))])
        low, high = compare_errors(NAMES, 2, error, trial)["improvement_interval"]
        inside += low <= 0.2 <= high
    assert 85 <= inside <= 100


def test_hindsight_bounds_what_any_choice_of_gain_can_do():
    error = np.array([[1.0, 4], [4, 1], [2.5, 2.5]])
    found = compare_errors(NAMES, 2, error, 0)
    assert found["hindsight"] == pytest.approx(1 - 1 / 2.5) and found["improvement"] == 0
    found = compare_errors(NAMES, 2, np.array([[np.nan, 1], [1, np.nan], [1, 1]]), 0)
    assert found["common"] == 0 and np.isnan(found["improvement"])


# ---------------------------------------------------------------- statistics of J


def judged(tuner, fixed):
    J = np.vstack([fixed, tuner, 0.5 * tuner])
    faults = np.array(FAULTS)[np.arange(J.shape[1]) % 4]
    names = (*FIXED, RULE, "net")
    return compare_costs(names, len(FIXED), J, np.ones_like(J, dtype=bool), faults, 0)


def test_a_tuner_that_is_always_a_fifth_below_is_a_fifth_below_for_sure():
    rng = np.random.default_rng(0)
    fixed = np.exp(rng.normal(2, 1, (len(FIXED), 40)))
    fixed[3] = fixed.min(axis=0)
    s = judged(0.8 * fixed[3], fixed)
    assert (s["best_g"], s["best_m"]) == (FIXED[3], FIXED[3])
    assert s["gains"][RULE]["g"] == pytest.approx([0.2] * 3)
    assert s["gains"][RULE]["m"] == pytest.approx([0.2] * 3)
    assert s["gains"]["net"]["rule"] == pytest.approx([0.5] * 3)
    assert s["gains"][HINDSIGHT]["g"] == pytest.approx([0.0] * 3)
    assert s["by_fault"]["noise"]["net"] == pytest.approx([0.6] * 3)


def test_g_is_the_geometric_mean_and_hindsight_has_the_best_of_each():
    rng = np.random.default_rng(1)
    fixed = np.exp(rng.normal(2, 1, (len(FIXED), 30)))
    s = judged(fixed[0], fixed)
    assert s["candidates"][FIXED[4]]["g"] == pytest.approx(float(np.prod(fixed[4]) ** (1 / 30)))
    assert s["candidates"][FIXED[4]]["m"] == pytest.approx(fixed[4].mean())
    assert s["candidates"][HINDSIGHT]["m"] == pytest.approx(fixed.min(axis=0).mean())


@pytest.mark.slow
def test_intervals_cover_what_they_should(monkeypatch):
    """200 samples of 60 conditions, log J off by -0.1 +- 0.3: 95 % of intervals hold the truth."""
    monkeypatch.setattr("stewart_drake.tuning.evaluation.RESAMPLES", 2000)
    rng, held = np.random.default_rng(5), 0
    fixed = np.full((len(FIXED), 60), 1e6)
    for _ in range(200):
        fixed[0] = np.exp(rng.normal(1, 1, 60))
        less = np.exp(rng.normal(-0.1, 0.3, 60))
        _, low, high = judged(fixed[0] * less, fixed)["gains"][RULE]["g"]
        held += low <= 1 - np.exp(-0.1) <= high
    assert 0.9 <= held / 200 <= 0.99


# ---------------------------------------------------------------- runs


@pytest.mark.parametrize("name", ["fixed", "hindsight", "rule", "-1.0"])
def test_a_network_is_not_called_as_another_candidate(name, tmp_path):
    path = tmp_path / f"{name}.json"
    path.write_bytes(resolve("weights", "health_T").read_bytes())
    with pytest.raises(ConfigError, match=f"got '{name}', the name of another candidate"):
        tuners_of(faulty_family("T", 0, 0, "evaluation"), [str(path)])


def test_a_file_of_too_few_runs_is_damaged(tmp_path):
    path = tmp_path / "0000.npz"
    path.write_bytes(run_condition(faulty_family("T", 0, 0, "evaluation", ("duration=0.5",)).base))
    assert len(read_condition(path)["J"]) == 1
    with pytest.raises(ConfigError, match=r"0000\.npz: "):
        read_condition(path, runs=len(FIXED))


def test_a_constant_tuner_is_its_fixed_gain(tmp_path):
    # The scenario's own weights at the first sample, the network's from then on: the same ones.
    family = disturbed_family(load_scenario("paper", "delay_lqi", SMALL), 2, 0, "evaluation")
    path = constant((1.0, 1.0), tmp_path / "constant.json")
    result = evaluate(family, [path], tmp_path / "out", workers=1)
    assert result.names == (*GAINS, TUNER) and result.error.shape == result.cost.shape == (8, 2)
    own = next(i for i, (q, r) in enumerate(GAINS.values()) if q == r)
    np.testing.assert_allclose(result.error[-1], result.error[own], rtol=1e-6)
    assert result.summary["fallbacks"] == {TUNER: 0}

    other = constant((4.0, 0.1), tmp_path / "other.json")
    seen = []
    again = evaluate(
        family, [other], tmp_path / "out", workers=1, progress=lambda *n: seen.append(n)
    )
    np.testing.assert_array_equal(again.error[:-1], result.error[:-1])
    assert seen[0] == (2, 4), "the fixed gains are not run again"
    assert seen[-1] == (4, 4)
    assert not np.array_equal(again.error[-1], result.error[-1])
    with pytest.raises(ConfigError, match="WEIGHTS: got 2 without --family"):
        evaluate(family, [path, other], tmp_path / "out")


# ---------------------------------------------------------------- the command


def test_the_command_prints_a_table_and_writes_a_summary(tmp_path, capsys):
    path = constant((1.0, 1.0), tmp_path / "net.json")
    arguments = ["tune", "evaluate", str(path), "--controller", "delay_lqi", "--scenarios", "2"]
    arguments += [part for setting in SMALL for part in ("--set", setting)]
    out = said(capsys, *arguments, "--workers", "1", "--out", tmp_path / "out")
    assert "of 2 conditions that all complete" in " ".join(out.split())
    summary = summary_in(tmp_path / "out")
    assert set(summary["candidates"]) == {*GAINS, TUNER, HINDSIGHT}
    assert len(summary["scenarios"]) == 2
    assert main([*arguments, "--seed", "1", "--out", str(tmp_path / "out")]) == 2
    assert "belongs to other settings" in capsys.readouterr().err
    assert main([*arguments, "--scenarios", "1"]) == 2
    assert "--scenarios" in capsys.readouterr().err


@pytest.mark.slow
def test_data_training_and_evaluation_by_commands(tmp_path):
    pytest.importorskip("torch")
    short = ["--set", "duration=1", "--workers", "1", "--quiet"]
    data, net = tmp_path / "data", tmp_path / "nets" / "mine.json"
    words = ["tune", "dataset", "--family", "N2", "--draws", "10", "--out", str(data)]
    assert main([*words, *short]) == 0
    train = ["tune", "train", str(data), "--regret", "--out", str(net), "--quiet", "--workers", "1"]
    assert main(train) == 0
    out = tmp_path / "evaluation"
    words = ["tune", "evaluate", str(net), "--family", "N2", "--scenarios", "4", "--out", str(out)]
    assert main([*words, *short]) == 0
    summary = summary_in(out)
    assert set(summary["gains"]) == {RULE, "mine", HINDSIGHT}
    assert summary["conditions"] == 4
    assert set(summary["nominal"]["mine"]) == {"on_reference", "from_rest"}
    page = (out / "worth.html").read_text()
    assert all(word in page for word in ("mine", "hindsight", "Weights over time", "Price"))
