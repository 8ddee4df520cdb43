"""Figures of the tuner: that they show the real network, the real loop, the weights as set."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest

import stewart_drake as sd
from docs.images.network_figure import network_figure
from stewart_drake.files import resources
from stewart_drake.reporting import figures
from stewart_drake.reporting.figures import comparison_figures, run_figures, weights_figure
from stewart_drake.reporting.terminal import shipped_table
from stewart_drake.tuner.network import save_network
from tests.test_network import small_network


def tuned_scenario(folder, *settings):
    path = folder / "network.json"
    save_network(small_network(), path)
    tuner = ("tuner.kind=ann", f"tuner.weights={path}")
    return sd.load_scenario("paper", settings=["plant.kind=exact", *tuner, *settings])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return sd.simulate(
        tuned_scenario(tmp_path_factory.mktemp("run"), "duration=2.0"), judge_stability=False
    )


# ------------------------------------------------------------------ the network


def test_a_shipped_network_is_listed_with_what_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(resources, "data_root", lambda: tmp_path)
    (tmp_path / "models" / "weights").mkdir(parents=True)
    save_network(small_network(7, density="signed"), tmp_path / "models" / "weights" / "mine.json")
    lines = shipped_table("weights").splitlines()
    assert lines[0].startswith("  mine  A network of 18 densities (signed), 7 hidden neurons")
    assert "from 0.1 to 4" in " ".join(map(str.strip, lines)) and max(map(len, lines)) <= 80


# ------------------------------------------------------------------ the weights


def test_weights_and_their_ratio_are_those_of_the_run(run):
    figure = weights_figure({"one": run, "two": run})
    above, other, below, _ = figure.axes
    weights = run.signals.weights.values
    for line, column in zip(above.lines, weights.T, strict=True):
        np.testing.assert_array_equal(line.get_ydata(), column)
        assert line.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(below.lines[0].get_ydata(), weights[:, 0] / weights[:, 1])
    assert [ax.get_title() for ax in (above, other)] == ["one", "two"]
    assert above.get_ylim() == other.get_ylim()


def test_weights_are_shown_where_a_network_set_them(run, monkeypatch):
    kept = {}
    monkeypatch.setattr(figures, "write_figures", lambda made, _: kept.update(made) or [])
    before = dict(plt.rcParams)
    run_figures(run, "unused")
    network_figure(small_network())
    assert dict(plt.rcParams) == before, "the user's settings were changed"
    assert not plt.get_fignums(), "a window could open"
    assert "weights" in kept
    fixed = dataclasses.replace(run, scenario=sd.load_scenario("paper"))
    for results, shown in (
        ({"lqr": run, "delay_lqi": run}, True),
        ({"lqr": run}, False),
        ({"delay_lqi": fixed}, False),
    ):
        kept.clear()
        comparison_figures(results, "unused")
        assert ("weights" in kept) is shown
