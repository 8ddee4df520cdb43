"""What the commands do, from Python and in a notebook."""

import importlib.metadata
import json
from pathlib import Path

import joblib
import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem
from pydrake.trajectories import FunctionHandleTrajectory

import stewart_drake as sd
from stewart_drake.files.jsonio import jsonable
from stewart_drake.reporting.results import Figures, Replay

pytestmark = pytest.mark.usefixtures("blank_figures")

ROOT = Path(__file__).resolve().parents[1]
SHORT = ("plant.kind=exact", "duration=0.3")


@pytest.fixture(scope="module")
def run():
    return sd.simulate(sd.load_scenario("paper", settings=SHORT))


class Still(LeafSystem):
    """No torque at all."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("measurement", 12)
        self.DeclareVectorOutputPort("torque", 6, lambda _, output: output.SetFromVector([0.0] * 6))


class Push(LeafSystem):
    """Down, all the time."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort(
            "wrench", 6, lambda _, output: output.SetFromVector([0.0] * 5 + [-1.0])
        )


def test_version_and_types_are_told():
    assert sd.__version__ == importlib.metadata.version("stewart-drake")
    assert (Path(sd.__file__).parent / "py.typed").is_file()


def test_figures_of_a_run(run, tmp_path):
    figures = run.plot(tmp_path / "new")
    assert {"states", "errors", "torques"} <= set(figures)
    assert {path.stem for path in (tmp_path / "new").iterdir()} == set(figures)
    assert isinstance(figures, Figures) and "states" in repr(figures)
    assert figures._repr_html_().count('<img src="data:image/svg+xml,') == len(figures)


def test_replay_as_a_file_in_a_notebook_or_in_meshcat(run, tmp_path):
    path = run.replay(tmp_path / "new" / "film.html", title="a film")
    text = path.read_text()
    assert "a film" in text
    shown = run.replay()
    assert isinstance(shown, Replay) and "MB" in repr(shown)
    assert shown._repr_html_().startswith("<iframe srcdoc=")

    from pydrake.geometry import Meshcat, MeshcatParams

    meshcat = Meshcat(MeshcatParams(host="localhost"))
    assert run.replay(meshcat=meshcat) is meshcat
    assert "/reference/ring" in meshcat.StaticHtml() or meshcat.HasPath("/reference/ring")


@pytest.mark.slow
def test_analyses_are_answers_that_can_be_printed_shown_and_saved(tmp_path):
    found = sd.analyze_workspace(sd.load_scenario("paper"))
    assert isinstance(found, sd.AnalysisResult) and "\n" in str(found)
    assert found.verdict in repr(found) and len(repr(found)) < 500
    assert found._repr_html_().startswith("<iframe srcdoc=") and "&lt;html" in found._repr_html_()
    found.save(tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"report.html", "summary.json"}
    saved = json.loads((tmp_path / "new" / "summary.json").read_text())
    assert saved == jsonable(found.summary)


def test_a_network_is_analysed(monkeypatch):
    monkeypatch.setattr(joblib, "cpu_count", lambda: 1)
    settings = (*SHORT, "link.kind=network")
    found = sd.analyze_link(sd.load_scenario("paper", settings=settings), runs=1)
    assert "A bound of" in found.verdict and found.study.runs == 1
    with pytest.raises(sd.ConfigError, match=r"link.kind: got 'wire'; expected 'network'"):
        sd.analyze_link("paper")


@pytest.mark.slow
def test_compare_takes_own_controllers_and_disturbances(tmp_path):
    results = sd.compare("paper", SHORT, controllers={"nothing": Still}, disturbance=Push)
    assert list(results)[-1] == "nothing" and len(results) == 6
    own = results["nothing"].summary["own"]
    assert own == {"controller": "Still", "disturbance": "Push"}
    assert results["lqr"].summary["own"] == {"disturbance": "Push"}
    assert float(np.abs(results["nothing"].signals.torque_applied).max()) == 0
    # Pushed down from rest by 1 N for 0.3 s.
    assert float(results["nothing"].signals.rates.sel(coordinate="z")[-1]) < -0.01
    table = results.table()
    assert "nothing" in table and max(map(len, table.splitlines())) <= 80
    assert "torques_nothing" in results.plot()
    assert "nothing: completed" in repr(results)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"controllers": {"lqr": Still}}, "got 'lqr', a shipped one"),
        ({"controllers": {"adaptive_lqi": Still}}, "got 'adaptive_lqi', a shipped one"),
        ({"disturbance": "made"}, "got an instance, which serves one run"),
        ({"reference": "handle"}, "cannot be sent to other processes"),
    ],
)
def test_what_compare_cannot_run_is_told_in_one_line(given, message):
    if given.get("disturbance"):
        given = {"disturbance": Push()}
    if given.get("reference"):
        given = {"reference": FunctionHandleTrajectory(lambda t: np.zeros((6, 1)), 6, 1)}
    with pytest.raises(sd.ConfigError) as refused:
        sd.compare("paper", SHORT, **given)
    assert message in str(refused.value) and "\n" not in str(refused.value)
