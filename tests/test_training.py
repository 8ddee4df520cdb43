"""Training of the tuner's network: by labels with Levenberg-Marquardt, and by regret."""

import json
import sys
from typing import get_args

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import least_squares

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.scenario.signals import TUNER_INPUTS
from stewart_drake.tuner.network import load_network, save_network
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning import training
from stewart_drake.tuning.data import data_hash
from stewart_drake.tuning.families import PAIRS, RATIOS
from stewart_drake.tuning.options import Split
from stewart_drake.tuning.training import (
    Curves,
    RegretTrainer,
    TorchModel,
    feature_rows,
    fit,
    initial_theta,
    labelled_rows,
    split_rows,
    summarize,
    train,
    train_by_regret,
    unpack,
)
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

torch = pytest.importorskip("torch")

rng = np.random.default_rng
NUMBERS = ("accumulated_error", "cost", "rms_torque", "peak_torque", "torque_variation")


def toy_data(cells=8, seed=0):
    """Return runs of noise whose best gain shows in how steady the errors are."""
    random = rng(seed)
    runs, rows = [], []
    for cell in range(cells):
        steadiness = cell / (cells - 1)
        for q, r in PAIRS:
            steady = 1.0 + 0.1 * random.standard_normal((100, 18))
            wild = random.standard_normal((100, 18))
            rows.append(steadiness * steady + (1 - steadiness) * wild)
            wanted = np.log(0.1) + steadiness * np.log(100.0)
            runs.append((q, r, cell, 1.0 + (np.log(q / r) - wanted) ** 2))
    samples = np.array(rows)
    samples[3, 40:] = np.nan  # a run that ended early
    q, r, cell, error = (np.array(column, dtype=float) for column in zip(*runs, strict=True))
    error[3] = np.nan
    number = len(runs)
    return xr.Dataset(
        {
            "samples": (("run", "sample", "input"), samples),
            "density": (("run", "sample", "input"), samples),
            "valid": (("run", "sample"), np.isfinite(samples).all(axis=2)),
            "weights": (("run", "weight"), np.column_stack([q, r])),
            "delay_steps": ("run", cell.astype(int)),
            "frequency": ("run", np.ones(number)),
            "disturbance": ("run", np.full(number, -1)),
            "status": ("run", np.where(np.isnan(error), "left_workspace", "completed")),
            "stopped": ("run", np.where(np.isnan(error), 1.0, np.nan)),
            **dict.fromkeys(NUMBERS, ("run", error)),
        },
        {"input": list(TUNER_INPUTS), "run": np.arange(number)},
        {"settings": json.dumps({"data": "toy"})},
    )


@pytest.fixture(scope="module")
def data():
    return toy_data()


@pytest.fixture(scope="module")
def trained(data):
    return train(data, max_rows=1500, evaluations=25)


# ---------------------------------------------------------------- the model


def numpy_outputs(theta, u, hidden):
    W1, b1, W2, b2 = unpack(theta, u.shape[1], hidden)
    return (1 / (1 + np.exp(-(u @ W1.T + b1)))) @ W2.T + b2


def test_outputs_are_those_of_the_formula():
    theta, u = rng(0).standard_normal(212), rng(1).standard_normal((7, 18))
    model = TorchModel(10)
    np.testing.assert_allclose(
        model.outputs(theta, u), numpy_outputs(theta, u, 10), rtol=1e-12, atol=1e-12
    )


def test_the_jacobian_is_that_of_finite_differences():
    theta, u = rng(2).standard_normal(212), rng(3).standard_normal((4, 18))
    model, h = TorchModel(10), 1e-6
    J = model.jacobian(theta, u)
    assert J.shape == (4, 2, 212)
    steps = h * np.eye(212)
    differences = [
        (numpy_outputs(theta + s, u, 10) - numpy_outputs(theta - s, u, 10)) / (2 * h) for s in steps
    ]
    np.testing.assert_allclose(J, np.stack(differences, axis=-1), atol=1e-6)
    assert np.abs(J).max() > 0.1


# ---------------------------------------------------------------- the solver


def oracle(theta, u, y, hidden):
    """Return the minimum and its cost by scipy's dense solver, with differences as a Jacobian."""

    def residual(x):
        return (numpy_outputs(x, u, hidden) - y).ravel()

    found = least_squares(residual, theta, xtol=1e-15, ftol=1e-15, gtol=1e-12)
    return found.x, 2 * found.cost


def test_training_finds_the_minimum_that_a_dense_solver_finds():
    # Noisy targets of a small network: the minimum is far from zero.
    hidden, random = 2, rng(4)
    u = random.standard_normal((300, 3))
    truth = 2 * random.standard_normal(hidden * 3 + hidden + 2 * hidden + 2)
    y = numpy_outputs(truth, u, hidden) + 0.1 * random.standard_normal((300, 2))
    start = truth + 0.1 * random.standard_normal(len(truth))
    expected, least = oracle(start, u, y, hidden)
    found = fit(TorchModel(hidden), start, (u, y), (u[:0], y[:0]), 500)
    assert found.status > 0
    cost = float(np.sum((numpy_outputs(found.x, u, hidden) - y) ** 2))
    assert cost == pytest.approx(least, rel=1e-8) and cost > 1
    answers = numpy_outputs(found.x, u, hidden)
    np.testing.assert_allclose(answers, numpy_outputs(expected, u, hidden), atol=1e-4)
    assert found.curve[-1, 0] == pytest.approx(np.sqrt(cost / y.size))
    assert (np.diff(found.curve[:, 0]) <= 1e-15).all()
    assert np.isnan(found.curve[:, 1]).all(), "there are no test rows here"


def test_the_start_answers_with_the_mean():
    y = rng(5).standard_normal((50, 2))
    theta = initial_theta(18, 10, y, 0)
    np.testing.assert_allclose(numpy_outputs(theta, np.zeros((1, 18)), 10)[0], y.mean(axis=0))


# ---------------------------------------------------------------- from data to network


def test_the_network_is_what_was_trained(trained, data):
    rows = labelled_rows(data, "best_in_cell", "magnitude")
    network = trained.network
    answers = np.log(network(rows.inputs))
    theta = np.concatenate([getattr(network, n).ravel() for n in ("W1", "b1", "W2", "b2")])
    u = (rows.inputs - network.input_mean) / network.input_scale
    np.testing.assert_allclose(TorchModel(10).outputs(theta, u), answers, rtol=0, atol=1e-12)


def test_it_learns_what_there_is_to_learn(trained):
    error = trained.network.card["rms_error"]
    assert error["test"] < 0.9 * error["test_of_a_constant"]
    assert trained.curve[-1, 0] < trained.curve[0, 0]
    correlation = summarize(trained)["correlation"]
    assert correlation["w_Q"] > 0.5 and correlation["w_R"] > 0.5


def test_the_same_seed_gives_the_same_network(trained, data):
    again = train(data, max_rows=1500, evaluations=25)
    other = train(data, max_rows=1500, evaluations=25, seed=1)
    for name in ("input_mean", "input_scale", "W1", "b1", "W2", "b2"):
        np.testing.assert_array_equal(getattr(again.network, name), getattr(trained.network, name))
    assert again.network.card == trained.network.card
    assert not np.array_equal(other.network.W1, trained.network.W1)


def test_the_card_tells_where_it_comes_from(trained, data, tmp_path):
    card = trained.network.card
    assert card["data_sha256"] == data_hash(data)
    assert card["seed"] == 0 and card["labels"] == "best_in_cell" and card["split"] == "run"
    assert "torch" in card["versions"] and card["rows"]["trained_on"] == 1500
    save_network(trained.network, tmp_path / "net.json")
    assert dict(load_network(tmp_path / "net.json").card) == card


def test_labels_as_run_train_the_weights_themselves(data):
    rows = labelled_rows(data, "as_run", "magnitude")  # none after a failure
    assert len(rows.inputs) == data.sizes["run"] * 100 - 60 and (rows.runs == 3).sum() == 40
    assert np.isfinite(rows.inputs).all()
    network = train(data, kind="as_run", max_rows=300, evaluations=3).network
    assert network.output == "weights"
    np.testing.assert_array_equal(network.bounds, [[0.1, 0.1], [4, 4]])
    best = train(data, max_rows=300, evaluations=3).network
    assert best.output == "log_weights"
    np.testing.assert_allclose(best.bounds, [[40**-0.5] * 2, [40**0.5] * 2])


@pytest.mark.parametrize("split", get_args(Split))
def test_splits_keep_together_what_belongs_together(data, split):
    rows = labelled_rows(data, "best_in_cell", "magnitude")
    mask = split_rows(rows, split, rng(0))
    assert mask.mean() == pytest.approx(0.7, abs=0.06)
    group = {"sample": np.arange(len(mask)), "run": rows.runs, "cell": rows.cells}[split]
    assert not set(group[mask]) & set(group[~mask])


def test_data_that_cannot_be_trained_on_are_refused(data, tmp_path):
    dead = data.copy(deep=True)
    dead["accumulated_error"][:] = np.nan
    for call, problem in (
        (lambda: train(dead), "expected more runs that complete"),
        (lambda: train(data, max_rows=100), "100 rows are too few to train the 212 parameters"),
        (lambda: train_by_regret(data, tmp_path), "has no cost curves"),
    ):
        with pytest.raises(ConfigError, match=problem):
            call()


def test_without_torch_the_message_tells_the_fix(data, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ConfigError, match=r"pip install 'stewart-drake\[train\]'"):
        train(data)


# ---------------------------------------------------------------- by regret


def synthetic(number=60, seed=0):
    """Conditions whose first feature is the ratio at which log J = (r - best)^2 / 2 is least."""
    random = rng(seed)
    best = random.uniform(-3, 1, number)
    features = random.standard_normal((number, len(RATIOS), 8, 18)).astype(np.float32)
    features[..., 0] = best[:, None, None]
    return Curves(np.exp((RATIOS - best[:, None]) ** 2 / 2), features)


def test_the_loss_is_the_regret_between_the_ratios():
    curves = synthetic()
    one = RegretTrainer(curves, 0)
    theta = initial_theta(18, 10, np.array([[0.3, -0.4]]), 5)
    theta += 0.1 * rng(6).standard_normal(len(theta))  # biases too
    rows = feature_rows(curves)
    inputs = (rows.inputs - one.mean) / one.scale
    found = float(
        one.loss(*(torch.tensor(a) for a in (theta, inputs, curves.regret[rows.condition])))
    )
    y = np.log(one.network(theta, {})(rows.inputs))
    ratio = (y[:, 0] - y[:, 1]) / np.log(10)
    within = np.clip(ratio, RATIOS[0], RATIOS[-1])
    regret = [
        np.interp(r, RATIOS, curves.regret[i]) for r, i in zip(within, rows.condition, strict=True)
    ]
    expected = np.mean(regret) + 0.1 * np.mean((ratio - within) ** 2)
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_network_learns_to_lose_little_where_it_was_not_trained():
    curves = synthetic(120)
    one = RegretTrainer(curves, 0)
    network = one.network(one.fit(one.start, [one.rows], 1), {})
    fresh = synthetic(80, seed=1)
    ratio = [ratio_of(w) for w in network(fresh.features[:, 0, 0].astype(float))]
    lost = np.mean([np.interp(r, RATIOS, g) for r, g in zip(ratio, fresh.regret, strict=True)])
    assert lost < 0.1 * fresh.regret.mean(axis=0).min()
    assert network.start == pytest.approx(10 ** (np.array([0.5, -0.5]) * curves.best_ratio))
    assert np.prod(network(np.zeros(18))) == pytest.approx(1.0)


def family_data(curves):
    """Return a data set of these curves."""
    count, ratios, samples, _ = curves.features.shape
    runs = count * ratios
    half = np.tile(RATIOS / 2, count)
    base = scenario_to_dict(load_scenario("paper"))
    settings = {"family": "N2", "scenario": base, "draws": [{}] * count}
    return xr.Dataset(
        {
            "health": (("run", "sample", "input"), curves.features.reshape(runs, samples, 18)),
            "weights": (("run", "weight"), np.column_stack([10**half, 10**-half])),
            "J": ("run", curves.J.ravel()),
        },
        attrs={"settings": json.dumps(settings)},
    )


@pytest.mark.parametrize("start", [None, -1.5])
def test_a_network_begins_where_it_is_asked_to(start, tmp_path, monkeypatch):
    curves = synthetic(30)

    def run(names, *_, **__):
        return {k: {"J": curves.J[int(k)], "health": curves.features[int(k)]} for k in names}

    monkeypatch.setattr(training, "vary", lambda *_: None)
    monkeypatch.setattr(training, "run_jobs", run)
    found = train_by_regret(family_data(curves), tmp_path, start=start)
    expected = curves.best_ratio if start is None else start
    assert ratio_of(found.network.start) == pytest.approx(expected)
    # Of ratios from 10^-4 to 10^2 with w_Q w_R = 1.
    np.testing.assert_allclose(found.network.bounds, [[0.01, 0.1], [10, 100]])


# ---------------------------------------------------------------- the command


@pytest.mark.slow
def test_the_command_writes_network_figures_and_summary(tmp_path, capsys):
    toy_data(cells=3).to_netcdf(tmp_path / "dataset.nc", engine="h5netcdf")
    out = tmp_path / "new" / "net.json"
    said(capsys, "tune", "train", tmp_path, "--out", out, "--split", "cell")
    assert {path.name for path in out.parent.iterdir()} == {
        "net.json",
        "summary.json",
        *(f"{n}.{s}" for n in ("training_curve", "regression") for s in ("png", "svg")),
    }
    assert summary_in(out.parent)["rows"]["trained_on"] <= training.MAX_ROWS
    assert load_network(out).card["split"] == "cell"
