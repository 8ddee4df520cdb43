"""The public interface: names, signatures, representations, functions of the commands."""

import ast
import importlib.metadata
import inspect
import json
import re
import runpy
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from pydrake.systems.framework import LeafSystem
from pydrake.trajectories import FunctionHandleTrajectory

import stewart_drake as sd
from stewart_drake.cli.examples import EXAMPLES
from stewart_drake.files.jsonio import jsonable
from stewart_drake.identification.logs import Precision
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.reporting.analyses import ANALYSES, words_of
from stewart_drake.reporting.document import Document, Picture, Section
from stewart_drake.reporting.page import Provenance
from stewart_drake.reporting.results import ComparisonResult, Figures, Replay
from stewart_drake.studies.study_options import Ranges

pytestmark = pytest.mark.usefixtures("blank_figures")

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = ("plant.kind=exact", "duration=0.1")


def test_only_public_names_are_listed():
    assert sorted(dir(sd)) == sorted(sd.__all__)
    for name in dir(sd):
        assert getattr(sd, name) is not None
    assert sorted(dir(sd)) == sorted(sd.__all__), "more of them after they were used"


def test_help_shows_the_result_of_a_function():
    for function, kind in (
        (sd.simulate, sd.SimulationResult),
        (sd.compare, sd.ComparisonResult),
        (sd.controller_margin, sd.ControllerMargin),
    ):
        assert inspect.signature(function).return_annotation is kind


def test_type_checkers_see_the_public_names():
    """`python .ci/public_names.py` writes the file again."""
    namespace = runpy.run_path(str(ROOT / ".ci" / "public_names.py"))
    written, wanted = (
        ast.parse(text) for text in (namespace["STUB"].read_text(), namespace["text"]())
    )
    assert {ast.unparse(node) for node in written.body} == {ast.unparse(n) for n in wanted.body}


def test_a_name_and_an_option_of_0_2_lead_to_todays():
    for name in ("Answer", "plot", "replay", "table"):
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; it is .* now"):
            getattr(sd, name)
    with pytest.raises(TypeError, match=r"got beside, an option of 0\.2; expected also"):
        sd.analyze_robustness("paper", beside={})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sd.analyze_robustness("paper", workers=0), "workers: got 0; expected"),
        (
            lambda: sd.layout("paper", keep=["crank"], vary={"crank": (0.1, 0.2)}),
            "keep: got crank, which vary varies",
        ),
        (
            lambda: sd.layout("paper", keep="crank", vary={"crank": 0.1}),
            "keep: got crank, which vary varies",
        ),
        (
            lambda: sd.layout("paper", vary={"crank": "long"}),
            "vary.crank: got 'long'; expected a list of numbers",
        ),
        (lambda: sd.layout("paper", vary=3), "vary: got 3; expected a mapping"),
        (lambda: sd.layout("paper", limits={"reach": np.nan}), "limits reach: got nan"),
        (lambda: sd.make_tuner_data("none", draws=10), "draws: got 10 without family"),
        (lambda: sd.make_tuner_data("none", "gravity", family="T"), "scenario: got gravity with"),
        (lambda: sd.evaluate_tuner("none", ["a", "b"]), "networks: got 2 without family"),
        (lambda: sd.evaluate_tuner("none", "nowhere"), "weights: got 'nowhere'"),
        (lambda: sd.run_live("paper", "nowhere"), "machine: got 'nowhere'; expected HOST:PORT"),
        (
            lambda: sd.run_live("paper", "127.0.0.1:9", learn=2, duration=1.0),
            "duration: got 1.0 with learn; expected none",
        ),
        (
            lambda: sd.analyze_delay("paper", settings="delay.steps=3"),
            "settings: got 'delay.steps=3'; expected a list of texts",
        ),
        (lambda: sd.simulate("paper", log="run.txt"), "log: got 'run.txt'; expected a file"),
        (
            lambda: sd.plan_identification("reachy_mini", poses=True),
            "plan: got measured poses or tolerances with position servos",
        ),
        (lambda: sd.shipped("foo"), "kind: got 'foo'; expected one of mechanism, scenario,"),
        (
            lambda: sd.export_c("paper", "/proc/x"),
            "directory: got '/proc/x'; expected a directory that can be written",
        ),
        (lambda: sd.identify([], "paper"), "logs: got none"),
        (
            lambda: sd.identify("x", "paper", tolerances={"length": 1.0}),
            "tolerances: length: unknown key; did you mean lengths?",
        ),
        (
            lambda: sd.identify("x", "paper", precision={"angel": 1.0}),
            "precision: angel: unknown key; did you mean angle?",
        ),
        (lambda: sd.plan_identification("paper", tolerances=3), "tolerances: got 3; expected"),
        (
            lambda: sd.analyze_robustness("paper", ranges={"payload": 2.0}),
            "ranges: payload: got 2.0; expected less than 1",
        ),
        (  # the name of the command line
            lambda: sd.analyze_robustness("paper", vary={"payload": "2kg"}),
            "ranges: payload: got '2kg'; expected a number",
        ),
        (lambda: sd.analyze_robustness("paper", also=["adaptive"]), "controller: got 'adaptive'"),
        (lambda: sd.identify("log.csv", "paper", delay=np.nan), "delay: got nan"),
        (lambda: sd.identify("run.nc", "paper", gravity=False), "gravity: got False with logs of"),
        (lambda: sd.setpoints("reachy_mini", units="u.yaml"), "units: got u.yaml without out"),
        (lambda: sd.linear_models("paper", time="1"), "time: got '1'; expected numbers"),
        (lambda: sd.controller_margin("paper", until=np.nan), "until: got nan; expected"),
    ],
)
def test_an_error_names_the_argument(call, message):
    """Not the option of the command; an argument that would be ignored is refused."""
    with pytest.raises(sd.ConfigError) as refused:
        call()
    assert str(refused.value).startswith(message) and "--" not in str(refused.value)


def test_options_are_taken_as_names_and_mappings():
    """As on the command line, where nobody imports their classes."""
    found = sd.analyze_robustness(
        "paper", 1, ranges={"payload": 0.2}, also=["adaptive_lqi"], workers=1
    )
    assert found.study.ranges == Ranges(payload=0.2)
    assert list(found.study.also) == ["adaptive_lqi"]
    given, named = (
        sd.plan_identification("paper", tolerances=one, precision=other).summary
        for one, other in (
            (Tolerances(lengths=1e-4), Precision(1e-3)),
            ({"lengths": 1e-4}, {"angle": 1e-3}),
        )
    )
    assert given == named


def test_scenarios_and_results_tell_what_is_not_as_usual():
    long = sd.load_scenario(
        "paper", settings=("sensor.noise_std=[" + "0.0012345678, " * 11 + "0]",)
    )
    assert "sensor.noise_std=[0.00123" in repr(long) and len(repr(long)) < 100
    run = sd.simulate(sd.load_scenario("paper", settings=SETTINGS))
    assert repr(run) == (
        f"SimulationResult(completed, E_ac={run.accumulated_error:.4g}, "
        "Scenario(duration=0.1, plant.kind='exact'))"
    )
    lost = sd.simulate(sd.load_scenario("paper", "delay_lqi", ("plant.kind=exact",)))
    assert lost.failure in repr(lost) and "left_workspace" in repr(lost)
    assert str(lost) == lost.table() and "left workspace at" in str(lost)


def test_a_printed_result_begins_with_its_conclusion(tmp_path):
    """Also results of functions that are neither runs nor analyses."""
    made = sd.new(
        tmp_path,
        "small",
        base_radius=0.2,
        shaft_distance=0.13,
        plate_radius=0.11,
        joint_distance=0.06,
        crank=0.05,
        rod=0.26,
        plate_mass=2.5,
        crank_mass=0.06,
        rod_mass=0.05,
    )
    for found, opening in (
        (sd.controller_margin("paper", until=1.0), "This loop is stable: linearised along"),
        (sd.check_model("paper"), "yes: it stands at home"),
        (made, "yes: it stands at home"),
        (sd.setpoints("reachy_mini"), "limits kept; the motion needs"),
    ):
        assert str(found) == found.table() and str(found).startswith(opening)
        assert max(map(len, str(found).splitlines())) <= 80 and "array" not in repr(found)
    assert "prediction errors grow" in " ".join(str(made).split())


FUNCTIONS = {
    "export": "export_csv",
    "list": "shipped",
    "live": "run_live",
    "machine": "run_machine",
    "replay": "replay_log",
    "model check": "check_model",
    "model sdf": "model_sdf",
    "model view": "view_model",
    "tune dataset": "make_tuner_data",
    "tune evaluate": "evaluate_tuner",
    "tune train": "train_tuner",
}
"""By command, where the name is not that of the command."""


@pytest.mark.parametrize("words", [words for words in EXAMPLES if words])
def test_every_command_has_a_function(words):
    name = FUNCTIONS.get(words, words.replace(" ", "_").replace("-", "_"))
    assert name in sd.__all__
    assert re.search(rf"`sd\.{name}[`(]", (ROOT / "docs" / "python.md").read_text())


@pytest.mark.slow
def test_a_machine_and_a_live_run_from_python():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    way = "low: 0.1, high: 0.12, loss: 0"
    network = f"link={{kind: network, {way}, return: {{{way}}}}}"
    machine = sd.load_scenario("paper", settings=("plant.kind=exact", network))
    assert sd.run_machine(machine, duration=0.1, port=0, safe="hold")["runs"] == 0
    with ThreadPoolExecutor(1) as pool:
        serving = pool.submit(sd.run_machine, machine, port=port, duration=10.0)
        run = sd.run_live("paper", f"127.0.0.1:{port}", duration=1.0, accept_jitter=True)
        assert run.summary["live"]["samples"] > 5 and run.table()
        assert serving.result(20)["runs"] == 1


def test_the_package_has_version_and_types_and_imports_neither_torch_nor_drake():
    assert sd.__version__ == importlib.metadata.version("stewart-drake")
    assert (Path(sd.__file__).parent / "py.typed").is_file()
    code = "import sys, stewart_drake; sys.exit(bool({'torch', 'pydrake'} & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr or "torch or pydrake was imported"


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


def test_replays_of_a_comparison_name_their_controllers(run, tmp_path):
    compared = ComparisonResult({"mine": run, "theirs": run})
    for name, path in compared.replay(tmp_path / "new").items():
        text = path.read_text()
        assert path.name == f"{name}.html" and f"<title>{name}</title>" in text
        assert f"<b>{name}</b>" in text
    with pytest.raises(sd.ConfigError, match=r"directory: got .*film\.html; expected a folder"):
        compared.replay(tmp_path / "film.html")
    assert not (tmp_path / "film.html").exists()


def test_figures_of_one_name_are_numbered(tmp_path):
    pictures = [Picture(plt.figure, "", name) for name in ("residuals", "states", "residuals")]
    made = Document("", "", [Section("", *pictures)])
    figures = sd.AnalysisResult(None, {}, made, Provenance("")).plot(tmp_path)
    assert list(figures) == ["residuals", "states", "residuals_2"]
    assert {path.stem for path in tmp_path.iterdir()} == set(figures)


@pytest.mark.slow
@pytest.mark.usefixtures("few_poses")
def test_analyses_are_answers_that_can_be_printed_shown_and_saved(tmp_path):
    found = sd.analyze_workspace(sd.load_scenario("paper"))
    assert isinstance(found, sd.AnalysisResult) and "\n" in str(found)
    assert found.verdict in repr(found) and len(repr(found)) < 500
    assert found._repr_html_().startswith("<iframe srcdoc=") and "&lt;html" in found._repr_html_()
    found.save(tmp_path / "new")
    assert {path.name for path in (tmp_path / "new").iterdir()} == {"report.html", "summary.json"}
    saved = json.loads((tmp_path / "new" / "summary.json").read_text())
    assert saved == jsonable(found.summary)
    tables = found.to_pandas()
    assert list(tables) == ["legs", "travel", "sections", "motors"]
    assert list(tables["motors"].leg) == [1, 2, 3, 4, 5, 6]


def test_a_network_is_analysed():
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
    loaded = sd.load_scenario("paper", settings=SHORT)
    chosen = sd.compare(loaded, controllers=["lqi", {"nothing": Still}])
    assert list(chosen) == ["lqi", "nothing"]


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("controllers", lambda: {"adaptive_lqi": Still}, "got 'adaptive_lqi' for a system"),
        ("controllers", lambda: {"x": "lqi"}, "shipped controllers by name in a list"),
        ("disturbance", Push, "got an instance, which serves one run"),
        (
            "reference",
            lambda: FunctionHandleTrajectory(lambda t: np.zeros((6, 1)), 6, 1),
            "cannot be sent to other processes",
        ),
    ],
)
def test_what_compare_cannot_run_is_reported_in_one_line(name, make, message):
    with pytest.raises(sd.ConfigError) as refused:
        sd.compare("paper", SHORT, **{name: make()})
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_the_signature_of_an_analysis_shows_its_options():
    shown = inspect.signature(sd.analyze_robustness).parameters
    assert list(shown)[:2] == ["scenario", "runs"] and shown["runs"].default == 200
    assert shown["limit"].kind is inspect.Parameter.KEYWORD_ONLY
    assert "limit: E_ac above which a run counts as failed, % s" in (
        sd.analyze_robustness.__doc__ or ""
    )


@pytest.mark.parametrize("name", ANALYSES)
def test_an_analysis_takes_settings_like_its_command(name):
    call = getattr(sd, "_".join(words_of(name)))
    shown = inspect.signature(call).parameters
    assert shown["settings"].kind is inspect.Parameter.KEYWORD_ONLY
    assert ("controller" in shown) == ANALYSES[name].controller
    with pytest.raises(sd.ConfigError, match=r"^settings: .*delay\.step: unknown key"):
        call("paper", settings=["delay.step=3"])
    with pytest.raises(TypeError, match=rf"^{call.__name__}: got .*; expected settings="):
        call("paper", ["delay.steps=3"])
    with pytest.raises(TypeError, match=rf"^{call.__name__}: got an unexpected .* 'setting'"):
        call("paper", setting=["delay.steps=3"])


def test_an_analysis_is_of_the_scenario_with_its_settings():
    settings = ["delay.steps=3"]
    found = sd.analyze_delay(
        "paper", settings=iter(settings), controller="delay_lqr", simulations=False
    )
    scenario = sd.load_scenario("paper", "delay_lqr", settings)
    assert found.summary == sd.analyze_delay(scenario, simulations=False).summary
    assert list(found.plot()) == ["growth", "loop"]
    command = "sd.analyze_delay('paper', settings=['delay.steps=3'], controller='delay_lqr', "
    assert found.made.command.startswith(command)


def test_the_signature_of_a_section_shows_types_without_their_ranges():
    for name in dir(sd):
        if name.endswith("Config") and inspect.isclass(getattr(sd, name)):
            assert "FieldInfo" not in str(inspect.signature(getattr(sd, name))), name
    shown = str(inspect.signature(sd.DelayConfig))
    assert shown.startswith("(steps: int = 8, fraction: float = 0.0, drift: float = 0.0")


def test_help_names_arrays_instead_of_the_unions_behind_them():
    assert str(inspect.signature(sd.StewartDynamics.mass_matrix)).startswith(
        "(self, pose: ArrayLike"
    )
