"""What somebody meets at a prompt: public names, and objects that say in a line what they are."""

import ast
import inspect
import runpy
import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import stewart_drake as sd
from stewart_drake.cli.examples import EXAMPLES

pytestmark = pytest.mark.usefixtures("blank_figures")

SETTINGS = ("plant.kind=exact", "duration=0.1")


def test_only_public_names_are_listed():
    assert sorted(dir(sd)) == sorted(sd.__all__)
    for name in dir(sd):
        assert getattr(sd, name) is not None
    assert sorted(dir(sd)) == sorted(sd.__all__), "more of them after they were used"


def test_type_checkers_see_the_public_names():
    """`python .ci/public_names.py` writes the file again."""
    path = Path(__file__).parents[1] / ".ci" / "public_names.py"
    namespace = runpy.run_path(str(path))
    written, wanted = (
        ast.parse(text) for text in (namespace["STUB"].read_text(), namespace["text"]())
    )
    assert {ast.unparse(node) for node in written.body} == {ast.unparse(n) for n in wanted.body}


@pytest.mark.parametrize("name", ["Answer", "plot", "replay", "table"])
def test_a_name_of_0_2_leads_to_todays(name):
    with pytest.raises(AttributeError, match=f"no attribute '{name}'; it is .* now"):
        getattr(sd, name)


def test_an_option_of_0_2_leads_to_todays():
    with pytest.raises(TypeError, match=r"got beside, an option of 0\.2; expected also"):
        sd.analyze_robustness("paper", beside={})


def test_the_signature_of_an_analysis_shows_its_options():
    shown = inspect.signature(sd.analyze_robustness).parameters
    assert list(shown)[:2] == ["scenario", "runs"] and shown["runs"].default == 200
    assert shown["limit"].kind is inspect.Parameter.KEYWORD_ONLY
    assert "limit: E_ac above which a run counts as failed, % s" in (
        sd.analyze_robustness.__doc__ or ""
    )


def test_a_scenario_tells_what_is_not_as_usual():
    assert repr(sd.Scenario()) == "Scenario()"
    scenario = sd.load_scenario("paper", settings=SETTINGS)
    assert repr(scenario) == "Scenario(duration=0.1, plant.kind='exact')"
    long = sd.load_scenario(
        "paper", settings=("sensor.noise_std=[" + "0.00123456789, " * 11 + "0]",)
    )
    assert "sensor.noise_std=[0.00123" in repr(long) and len(repr(long)) < 100


def test_results_tell_how_it_went():
    run = sd.simulate(sd.load_scenario("paper", settings=SETTINGS))
    assert repr(run) == (
        f"SimulationResult(completed, E_ac={run.accumulated_error:.4g}, "
        "Scenario(duration=0.1, plant.kind='exact'))"
    )
    lost = sd.simulate(sd.load_scenario("paper", "delay_lqi", ("plant.kind=exact",)))
    assert lost.failure in repr(lost) and "left_workspace" in repr(lost)


FUNCTIONS = {
    "export": "export_csv",
    "list": "shipped",
    "live": "run_live",
    "machine": "run_machine",
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
    documented = (Path(__file__).parents[1] / "docs" / "python.md").read_text()
    assert f"`sd.{name}`" in documented


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
