"""Families of conditions, their cost curves, training by regret, and what a tuner is worth."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.scenario.config import Scenario
from stewart_drake.studies.families import (
    FAMILIES,
    FAULTS,
    base_of,
    condition,
    draw_family,
    fault_of,
)
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.curves import (
    LOST,
    RATIOS,
    WATCHED,
    Curves,
    Watched,
    at_ratio,
    cost,
    load_curves,
    make_curves,
    watched_run,
)
from stewart_drake.tuning.levenberg import initial_theta
from stewart_drake.tuning.regret import _Trainer, best_ratio, rows_of, train_by_regret
from stewart_drake.tuning.worth import (
    FIXED,
    HINDSIGHT,
    RULE,
    compared,
    read_told,
    tuned_run,
    tuners_of,
)
from stewart_drake.types import Array

# ------------------------------------------------------------------------- conditions


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_stay_when_more_are_asked_for_and_purposes_share_none(family: str) -> None:
    some = draw_family(family, 4, 7, "training")
    assert draw_family(family, 9, 7, "training")[:4] == some
    assert not any(one in draw_family(family, 9, 7, "evaluation") for one in some)
    assert not any(one in draw_family(family, 9, 8, "training") for one in some)


@pytest.mark.parametrize("family", FAMILIES)
def test_a_draw_has_one_fault_within_its_range(family: str) -> None:
    base, about = base_of(family), FAMILIES[family]
    draws = draw_family(family, 200, 1, "training")
    shares = [sum(fault_of(one) == fault for one in draws) / 200 for fault in FAULTS]
    assert all(0.15 < share < 0.35 for share in shares)
    for one in draws[:40]:
        found, kind = condition(base, one), fault_of(one)
        off = found.eta - one["delay_steps"] * 0.1
        assert found.controller.delay_steps == one["delay_steps"]
        assert found.controller.delay_fraction == 0
        if kind == "offset":
            assert about.offset[0] - 1e-9 <= abs(off) <= about.offset[1] + 1e-9
        else:
            assert off == pytest.approx(0, abs=1e-12)
        assert (found.delay.jitter_std > 0) == (kind == "jitter")
        assert found.delay.jitter_std <= about.jitter[1]
        assert (found.plant.coulomb_friction > 0) == (kind == "friction")
        assert isinstance(found, Scenario)
        noise = found.sensor.noise_std[5] / found.reference.amplitude[5]  # type: ignore[union-attr]
        assert (noise > 1e-3) == (kind == "noise")


def test_offsets_go_both_ways() -> None:
    offsets = [one["fault"][0] for one in draw_family("N2", 60, 2, "training")]
    assert min(offsets) < -5e-3
    assert max(offsets) > 5e-3


# ------------------------------------------------------------------------- their cost


def test_the_cost_of_a_completed_run_is_its_error() -> None:
    one = dataclasses.replace(base_of("N2"), duration=2.0)
    ending = run_in_bulk(one)
    assert cost(ending, 2.0) == pytest.approx(ending.figures.accumulated_error)


def test_a_lost_plate_counts_by_when_it_was_lost() -> None:
    lost = base_of("N2", ("delay.fraction=0.5", "controller.delay_steps=8"))
    ending = run_in_bulk(at_ratio(lost, 1.0))
    assert ending.stopped is not None
    short = dataclasses.replace(
        at_ratio(lost, 1.0), duration=0.02 * int(ending.stopped.time / 0.02)
    )
    until = run_in_bulk(short).figures.accumulated_error
    expected = until + LOST * (lost.duration - ending.stopped.time)
    assert cost(ending, lost.duration) == pytest.approx(expected, rel=1e-2)


def test_who_looks_on_changes_nothing() -> None:
    one = at_ratio(dataclasses.replace(base_of("T"), duration=2.0), -1.5)
    plain, seen = run_in_bulk(one), watched_run(one, Watched(-1.5))
    assert seen["cost"] == cost(plain, 2.0)
    assert ratio_of(plain.weights[3]) == pytest.approx(-1.5)


@pytest.mark.slow
def test_data_go_on_where_they_stopped(tmp_path: Path) -> None:
    settings = ("duration=1",)
    first = make_curves("N2", tmp_path, number=10, seed=3, settings=settings, workers=1)
    assert first.cost.shape == (10, len(RATIOS))
    gone = tmp_path / "curves" / "00004.npz"
    kept = gone.read_bytes()
    gone.write_bytes(b"damaged")
    again = make_curves("N2", tmp_path, number=10, seed=3, settings=settings, workers=1)
    assert np.array_equal(first.cost, again.cost)
    assert len(gone.read_bytes()) == len(kept)
    read = load_curves(tmp_path)
    assert np.array_equal(read.cost, first.cost)
    assert read.draws == first.draws
    assert read.base == base_of("N2", settings)
    seen = np.isfinite(read.features["health"]).all(axis=-1)
    assert seen[:, ::WATCHED, ::2].any()
    assert not seen[:, 1::WATCHED].any()
    gone.unlink()
    with pytest.raises(ConfigError, match="conditions are missing"):
        load_curves(tmp_path)


# ------------------------------------------------------------------------- training


def synthetic(number: int = 60, seed: int = 0) -> Curves:
    """Conditions whose first feature is the ratio at which log J = (r - best)^2 / 2 is least."""
    rng = np.random.default_rng(seed)
    best = rng.uniform(-3, 1, number)
    features = rng.standard_normal((number, len(RATIOS), 8, 18)).astype(np.float32)
    features[..., 0] = best[:, None, None]
    J = np.exp((RATIOS - best[:, None]) ** 2 / 2)
    draws = [{"number": i} for i in range(number)]
    return Curves("N2", base_of("N2"), draws, J, J > 0, {"health": features})  # type: ignore[arg-type]


def trainer(curves: Curves, seed: int = 0) -> _Trainer:
    pytest.importorskip("torch")
    return _Trainer(curves, "health", seed, lambda line: None)


def test_the_loss_is_the_regret_between_the_ratios() -> None:
    torch = pytest.importorskip("torch")
    curves = synthetic()
    one = trainer(curves)
    theta = initial_theta(18, 10, np.array([[0.3, -0.4]]), 5)
    rows = rows_of(curves, "health")
    inputs = (rows.inputs - one.mean) / one.scale
    found = float(
        one._loss(*(torch.tensor(a) for a in (theta, inputs, curves.regret[rows.condition])))
    )
    y = np.log(one.network(theta)(rows.inputs))
    ratio = (y[:, 0] - y[:, 1]) / np.log(10)
    within = np.clip(ratio, RATIOS[0], RATIOS[-1])
    regret = [
        np.interp(r, RATIOS, curves.regret[i]) for r, i in zip(within, rows.condition, strict=True)
    ]
    expected = np.mean(regret) + 0.1 * np.mean((ratio - within) ** 2)
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_a_network_learns_to_lose_little_where_it_was_not_trained() -> None:
    curves = synthetic(120)
    one = trainer(curves)
    network = one.network(one.fit(one.start, [one.rows], 1))
    fresh = synthetic(80, seed=1)
    ratio = [ratio_of(w) for w in network(fresh.features["health"][:, 0, 0].astype(float))]
    lost = np.mean([np.interp(r, RATIOS, g) for r, g in zip(ratio, fresh.regret, strict=True)])
    assert lost < 0.1 * fresh.regret.mean(axis=0).min()
    assert network.start == pytest.approx(10 ** (np.array([0.5, -0.5]) * best_ratio(curves)))
    assert np.prod(network(np.zeros(18))) == pytest.approx(1.0)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_network() -> None:
    curves = synthetic(30)
    found = [(one := trainer(curves, seed)).fit(one.start, [one.rows], 1) for seed in (4, 4, 5)]
    assert np.array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


@pytest.mark.parametrize("start", [None, -1.5])
def test_a_network_begins_where_it_is_asked_to(start: float | None, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    curves = synthetic(30)
    named = dataclasses.replace(curves, features={"densities": curves.features["health"]})
    found = train_by_regret(named, tmp_path, features="densities", start=start)
    assert found.network.start is not None
    assert ratio_of(found.network.start) == pytest.approx(
        best_ratio(curves) if start is None else start
    )


# ------------------------------------------------------------------------- worth


@pytest.mark.parametrize("name", ["fixed", "hindsight", "rule", "-1.0"])
def test_a_network_is_not_called_as_another_candidate(name: str, tmp_path: Path) -> None:
    path = tmp_path / f"{name}.json"
    path.write_bytes(resolve("weights", "health_T").read_bytes())
    with pytest.raises(ConfigError, match=f"got '{name}', which another candidate is called"):
        tuners_of([str(path)])


def test_a_file_of_too_few_runs_is_damaged(tmp_path: Path) -> None:
    path = tmp_path / "0000.json"
    path.write_bytes(tuned_run(base_of("T", ("duration=0.5",))))
    assert len(read_told(path).cost) == 1
    with pytest.raises(ConfigError, match="cost: got 1 runs; expected 13"):
        read_told(path, runs=len(RATIOS))


def judged(tuner: Array, fixed: Array) -> dict:  # type: ignore[type-arg]
    J = np.vstack([fixed, tuner, 0.5 * tuner])
    faults = np.array(FAULTS)[np.arange(J.shape[1]) % 4]
    return compared((*FIXED, RULE, "net"), J, np.ones_like(J, dtype=bool), faults, 0)


def test_a_tuner_that_is_always_a_fifth_below_is_a_fifth_below_for_sure() -> None:
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


def test_g_is_the_geometric_mean_and_hindsight_has_the_best_of_each() -> None:
    rng = np.random.default_rng(1)
    fixed = np.exp(rng.normal(2, 1, (len(FIXED), 30)))
    s = judged(fixed[0], fixed)
    assert s["candidates"][FIXED[4]]["g"] == pytest.approx(float(np.prod(fixed[4]) ** (1 / 30)))
    assert s["candidates"][FIXED[4]]["m"] == pytest.approx(fixed[4].mean())
    assert s["candidates"][HINDSIGHT]["m"] == pytest.approx(fixed.min(axis=0).mean())


@pytest.mark.slow
def test_intervals_cover_what_they_should() -> None:
    """Of 200 samples of 60 conditions with log J off by -0.1 +- 0.3, 95 % hold the truth."""
    rng, held = np.random.default_rng(5), 0
    fixed = np.full((len(FIXED), 60), 1e6)
    for _ in range(200):
        fixed[0] = np.exp(rng.normal(1, 1, 60))
        less = np.exp(rng.normal(-0.1, 0.3, 60))
        _, low, high = judged(fixed[0] * less, fixed)["gains"][RULE]["g"]
        held += low <= 1 - np.exp(-0.1) <= high
    assert 0.9 <= held / 200 <= 0.99


@pytest.mark.slow
def test_data_training_and_worth_by_commands(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    short = ["--set", "duration=1", "--workers", "1", "--quiet"]
    data, net = tmp_path / "data", tmp_path / "nets" / "mine.json"
    words = ["tune", "dataset", "--family", "N2", "--draws", "10", "--out", str(data)]
    assert main([*words, *short]) == 0
    train = ["tune", "train", str(data), "--regret", "--out", str(net), "--quiet", "--workers", "1"]
    assert main(train) == 0
    out = tmp_path / "worth"
    words = ["tune", "evaluate", str(net), "--family", "N2", "--scenarios", "4", "--out", str(out)]
    assert main([*words, *short]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert set(summary["gains"]) == {RULE, "mine", HINDSIGHT}
    assert summary["conditions"] == 4
    assert set(summary["nominal"]["mine"]) == {"on_reference", "from_rest"}
    page = (out / "worth.html").read_text()
    assert all(word in page for word in ("mine", "hindsight", "Weights over time", "Price"))
