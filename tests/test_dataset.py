"""The data set of the tuner: the paper's grid, its rows, its labels."""

import dataclasses
import io

import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_model import delayed_model, linear_model
from stewart_drake.law.riccati import reduced_gain
from stewart_drake.loop.bulk import run_in_bulk, samples_of
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.tuner.network import WINDOW
from stewart_drake.tuner.source import FixedPolicy, densities, ratio_of, weights_of
from stewart_drake.tuning import families
from stewart_drake.tuning.data import (
    LOST,
    WATCHED,
    cost,
    data_hash,
    load_data,
    make_data,
    run_condition,
    watched_run,
)
from stewart_drake.tuning.families import (
    DELAYS,
    DISTURBED,
    FAMILIES,
    FAULTS,
    FREQUENCIES,
    PAIRS,
    RATIOS,
    disturbed_family,
    fault_of,
    faulty_family,
    paper_grid,
    vary,
    with_gain,
)
from stewart_drake.tuning.training import curves_of, labels
from tests.screen import said, summary_in

pytestmark = pytest.mark.usefixtures("blank_figures")

# The paper's own controller costs little, keeps a small motion in the workspace at some delays and
# loses it at others.
SMALL = (
    "plant.kind=exact",
    "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]",
)
NOISE = (f"sensor.noise_std={[1e-5] * 12}", "sensor.seed=3")


def base(*settings, controller="delay_lqi"):
    return load_scenario("paper", controller, (*SMALL, *settings))


def shrink(patch):
    """Return a grid of two delays, one frequency and three pairs."""
    patch.setattr(families, "DELAYS", (0, 3))
    patch.setattr(families, "FREQUENCIES", (2.0,))
    patch.setattr(families, "PAIRS", ((0.1, 4.0), (1.0, 1.0), (4.0, 0.1)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        make_data(paper_grid(base()), path, workers=1)
    return path


@pytest.fixture(scope="module")
def data(folder):
    return load_data(folder)


# ---------------------------------------------------------------- the grid


def test_the_papers_grid_has_180_runs_and_18000_rows():
    family = paper_grid(base())
    assert len(family.conditions) * len(family.gains) == 9 * len(DELAYS) * len(FREQUENCIES) == 180
    assert 180 * family.samples == 18_000
    assert tuple(family.gains.values()) == PAIRS
    for one in family.conditions.values():
        sc = one.scenario
        assert sc.delay.steps == one.delay_steps in (0, 5, 10, 20, 30)
        assert sc.reference.frequency == one.frequency in (0.5, 2, 4, 6)
        assert sc.reference.frequency_unit == "rad/s"
    assert len({(c.delay_steps, c.frequency) for c in family.conditions.values()}) == 20


def test_nine_pairs_are_seven_gains():
    dynamics = StewartDynamics(load_mechanism("paper"), gravity=False)
    model = linear_model(*dynamics.linearize(load_mechanism("paper").home))
    delayed = delayed_model(model, 0.1, 8, integral=True)
    gains = [reduced_gain(delayed, q * np.eye(12), r * np.eye(6)) for q, r in PAIRS]
    distinct = []
    for K in gains:
        if not any(np.allclose(K, other, rtol=1e-6, atol=1e-9) for other in distinct):
            distinct.append(K)
    assert len(PAIRS) == 9 and len(distinct) == 7


# ---------------------------------------------------------------- the rows


def test_rows_are_the_densities_that_the_loop_records():
    scenario = base("delay.steps=1", *NOISE, controller="predictor_lqi")
    result = simulate(scenario, judge_stability=False)
    own = densities(samples_of(result)[:100])
    recorded = result.signals.density.values[::5][:100]
    # The loop reads its sample 5e-15 of the time earlier, and an error is a small difference.
    np.testing.assert_allclose(own, recorded, rtol=1e-8, atol=1e-10)  # of densities around 1


def test_a_run_that_ends_early_keeps_its_rows_empty_and_marked(data):
    assert data.sizes == {"run": 6, "sample": 100, "input": 18, "weight": 2}
    failed = data.status.values == "left_workspace"
    assert 0 < failed.sum() < 6, "the grid of this test has both"
    for i in np.flatnonzero(failed):
        valid = data.valid.values[i]
        known = np.arange(100) * 0.1 < float(data.stopped[i])
        np.testing.assert_array_equal(valid, known)
        assert np.isnan(data.density.values[i][~valid]).all()
        assert np.isnan(data.samples.values[i][~valid]).all()
        assert np.isnan(data.accumulated_error[i])
    for i in np.flatnonzero(~failed):
        assert data.valid.values[i].all()
        assert np.isfinite(data.density.values[i]).all()
        assert data.accumulated_error[i] > 0
    rho = data.density.values[data.valid.values]
    assert (rho >= 0).all() and (rho <= WINDOW).all()


def test_a_resumed_data_set_has_the_same_bytes(folder, monkeypatch):
    shrink(monkeypatch)
    before = (folder / "dataset.nc").read_bytes()
    runs = sorted((folder / "conditions").glob("*.npz"))
    assert len(runs) == 2
    kept = {path: path.read_bytes() for path in runs}
    runs[0].unlink()
    (folder / "dataset.nc").unlink()
    make_data(paper_grid(base()), folder, workers=2)
    assert (folder / "dataset.nc").read_bytes() == before
    assert {path: path.read_bytes() for path in runs} == kept


def test_a_missing_or_foreign_file_is_refused(tmp_path):
    file, foreign = tmp_path / "dataset.nc", xr.Dataset({"x": ("run", [1.0])})
    for put, problem in (
        (lambda: None, "tune dataset"),
        (lambda: (tmp_path / "curves").mkdir(), "run the same `tune dataset` again"),
        (lambda: file.write_text("text"), "cannot be read"),
        (lambda: foreign.to_netcdf(file, engine="h5netcdf"), "is not a data set"),
    ):
        put()
        with pytest.raises(ConfigError, match=problem):
            load_data(tmp_path)


def test_the_hash_sees_every_value(data):
    assert data_hash(data) == data_hash(data.copy(deep=True))
    for name in ("samples", "weights", "accumulated_error"):
        changed = data.copy(deep=True)
        changed[name].values.flat[0] += 1e-12 + 1e-15 * abs(changed[name].values.flat[0])
        assert data_hash(changed) != data_hash(data)


# ---------------------------------------------------------------- labels


def made_up(error, weights=PAIRS):
    """Return a data set of one cell with these errors."""
    n = len(error)
    return xr.Dataset(
        {
            "weights": (("run", "weight"), np.array(weights)),
            "accumulated_error": ("run", np.array(error, dtype=float)),
            "rms_torque": ("run", np.linspace(1.0, 2.0, n)),
            "delay_steps": ("run", np.full(n, 3)),
            "frequency": ("run", np.full(n, 2.0)),
            "disturbance": ("run", np.full(n, -1)),
        }
    )


def test_the_best_in_a_cell_labels_all_its_runs():
    for kind in ("best_in_cell", "best_in_cell_torque"):
        assert np.isnan(labels(made_up([np.nan] * 9), kind)).all(), "without a survivor"
    error = np.arange(9.0, 0.0, -1.0)
    error[5] = 0.1  # (1, 4)
    expected = np.tile([0.5, 2.0], (9, 1))
    np.testing.assert_allclose(labels(made_up(error), "best_in_cell"), expected)
    error[5] = np.nan
    best = np.tile([1.0, 1.0], (9, 1))  # (4, 4), as the ratio 1
    np.testing.assert_allclose(labels(made_up(error), "best_in_cell"), best)


def test_torque_can_outweigh_the_error():
    error = np.linspace(1.1, 1.0, 9)  # least at the end, where the torque is twice the least
    assert np.allclose(labels(made_up(error), "best_in_cell")[0], [1.0, 1.0])
    assert np.allclose(labels(made_up(error), "best_in_cell_torque")[0], [1.0, 1.0])
    found = labels(made_up(error[::-1], PAIRS[::-1]), "best_in_cell_torque")[0]
    assert np.allclose(found, [1.0, 1.0])
    error = np.array([2.0] * 4 + [1.0] + [0.99] * 4)
    for kind, best in (("best_in_cell_torque", PAIRS[4]), ("best_in_cell", PAIRS[5])):
        ratio = np.divide(*labels(made_up(error), kind)[0])
        assert ratio == pytest.approx(np.divide(*best))


# ---------------------------------------------------------------- drawn conditions


def drawn(family, number, seed, purpose="training"):
    """Draws of any drawn family."""
    if family in FAMILIES:
        return faulty_family(family, number, seed, purpose).draws
    return disturbed_family(base(), number, seed, purpose).draws


@pytest.mark.parametrize("family", ["disturbed", *FAMILIES])
def test_draws_stay_when_more_are_asked_for_and_purposes_share_none(family):
    some, others = drawn(family, 6, 5), drawn(family, 6, 5, "evaluation")
    assert drawn(family, 3, 5) == some[:3]
    assert not {one["seed"] for one in some} & {one["seed"] for one in others}
    assert drawn(family, 3, 6) != some[:3]


def test_a_disturbance_does_what_it_says():
    scenario = base()
    family = disturbed_family(scenario, 20, 0, "training")
    one = next(d for d in family.draws if d["noise"] and d["payload_mass"])
    sc = vary(DISTURBED, scenario, one)
    assert sc.delay.steps == one["delay_steps"]
    assert sc.reference.frequency == one["frequency"]
    assert sc.reference.amplitude == pytest.approx(
        [one["amplitude"] * a for a in scenario.reference.amplitude]
    )
    assert sc.plant.payload_mass == one["payload_mass"]
    expected = one["noise"] * np.tile(sc.reference.amplitude, 2)
    np.testing.assert_allclose(sc.sensor.noise_std, expected, rtol=1e-3)
    shuffled = dict(sorted(one.items()))
    assert vary(DISTURBED, scenario, shuffled) == sc, "a file need not keep the order"
    assert scenario.plant.payload_mass == 0, "the scenario itself stays as it was"
    assert len(family.gains) == 9


@pytest.mark.parametrize("name", FAMILIES)
def test_a_draw_has_one_fault_within_its_range(name):
    family, about = faulty_family(name, 200, 1, "training"), FAMILIES[name]
    shares = [sum(fault_of(one) == fault for one in family.draws) / 200 for fault in FAULTS]
    assert all(0.15 < share < 0.35 for share in shares)
    offsets = [one["fault"][0] for one in family.draws]
    assert min(offsets) < -0.9 * about.offset[1] and max(offsets) > 0.9 * about.offset[1]
    for one, condition in zip(family.draws[:40], family.conditions.values(), strict=False):
        found, kind = condition.scenario, fault_of(one)
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
        noise = found.sensor.noise_std[5] / found.reference.amplitude[5]
        assert (noise > 1e-3) == (kind == "noise")


# ---------------------------------------------------------------- runs and their cost


def faulty(name, *settings):
    """Return the base of a family with faults."""
    return faulty_family(name, 0, 0, "training", settings).base


def test_a_run_begins_at_rest_at_the_reference_s_first_pose():
    """At t = 0 only the rates differ."""
    scenario = base("delay.steps=8", "reference.frequency=2")
    with np.load(io.BytesIO(run_condition(scenario, ((1.0, 1.0),))), allow_pickle=False) as file:
        first = file["samples"][0, 0]
    assert np.abs(first[:6]).max() == 0 and np.abs(first[6:12]).min() > 0


def at_ratio(scenario, ratio):
    return with_gain(scenario, *weights_of(ratio).tolist())


def test_the_cost_of_a_run_is_its_error_and_a_lost_plate_counts_by_when_it_was_lost():
    whole = run_in_bulk(faulty("N2", "duration=2"))
    assert cost(whole, 2.0) == pytest.approx(whole.figures.accumulated_error)
    lost = at_ratio(faulty("N2", "delay.fraction=0.5", "controller.delay_steps=8"), 1.0)
    ending = run_in_bulk(lost)
    assert ending.stopped is not None
    short = dataclasses.replace(lost, duration=0.02 * int(ending.stopped.time / 0.02))
    until = run_in_bulk(short).figures.accumulated_error
    expected = until + LOST * (lost.duration - ending.stopped.time)
    assert cost(ending, lost.duration) == pytest.approx(expected, rel=1e-2)


def test_a_run_that_is_watched_is_the_same():
    one = at_ratio(faulty("T", "duration=2"), -1.5)
    plain, (seen, _) = run_in_bulk(one), watched_run(one, FixedPolicy(weights_of(-1.5)), 20)
    assert cost(seen, 2.0) == cost(plain, 2.0)
    assert ratio_of(plain.weights[3]) == pytest.approx(-1.5)


@pytest.mark.slow
def test_data_of_a_family_go_on_where_they_stopped(tmp_path):
    family = faulty_family("N2", 10, 3, "training", ("duration=1",))
    first = make_data(family, tmp_path, workers=1)
    gone = tmp_path / "conditions" / "00004.npz"
    kept = gone.read_bytes()
    gone.write_bytes(b"damaged")
    again = make_data(family, tmp_path, workers=1)
    assert first.identical(again) and gone.read_bytes() == kept
    read = load_data(tmp_path)
    curves = curves_of(read)
    assert curves.J.shape == (10, len(RATIOS))
    assert np.array_equal(curves.J.ravel(), first.J)
    seen = np.isfinite(curves.features).all(axis=-1)
    assert seen[:, ::WATCHED, ::2].any()
    assert not seen[:, 1::WATCHED].any()


# ---------------------------------------------------------------- the command


def test_the_command_writes_a_data_set_of_disturbed_runs(tmp_path, capsys, monkeypatch):
    arguments = ["tune", "dataset", "paper", "--controller", "delay_lqi", "--disturbed", "1"]
    monkeypatch.setattr(families, "PAIRS", ((1.0, 1.0),))
    arguments += [part for setting in SMALL for part in ("--set", setting)]
    assert "1 run, 100 rows" in said(capsys, *arguments, "--workers", "1", "--out", tmp_path)
    summary = summary_in(tmp_path)
    assert summary["runs"] == 1 and summary["rows"] == 100
    assert summary["data_sha256"] == data_hash(load_data(tmp_path))
    assert len(summary["draws"]) == 1
    assert main([*arguments, "--seed", "1", "--out", str(tmp_path)]) == 2
    assert "belongs to other settings" in capsys.readouterr().err
