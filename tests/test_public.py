"""What somebody meets at a prompt: public names, and objects that say in a line what they are."""

import ast
import inspect
import runpy
from pathlib import Path

import pytest

import stewart_drake as sd
from stewart_drake.loop.experiment import prepare

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
    assert "limit: A run above, in % s" in (sd.analyze_robustness.__doc__ or "")


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


@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
def test_machines_and_what_is_made_of_them_fit_a_line_or_two(name):
    machine = sd.load_mechanism(name)
    assert name in repr(machine) and f"{1e3 * machine.crank_lengths[0]:.4g} mm" in repr(machine)
    assert "gravity 9.81" in repr(sd.StewartDynamics(machine))
    assert repr(machine) in repr(prepare(sd.load_scenario(name)))
    for thing in (machine, sd.StewartDynamics(machine), prepare(sd.load_scenario(name))):
        assert len(repr(thing)) < 400 and "\n" not in repr(thing)


@pytest.mark.slow
def test_commands_have_functions(tmp_path):
    run = sd.simulate(sd.load_scenario("desktop", settings=(*SETTINGS[:1], "duration=3")))
    run.save(tmp_path)
    text = sd.export_csv(tmp_path / "signals.nc", tmp_path / "signals.csv")
    assert text.startswith("time[s],pose_roll[rad]") and (tmp_path / "signals.csv").is_file()
    found = sd.identify(tmp_path / "signals.nc", "desktop")
    found.save(tmp_path / "machine")
    assert {path.name for path in (tmp_path / "machine").iterdir()} == {
        *("calibration.yaml", "mechanism.yaml", "report.html", "summary.json")
    }
    planned = sd.plan_identification("desktop")
    planned.save(tmp_path / "plan")
    assert sd.load_scenario(tmp_path / "plan" / "scenario.yaml").mechanism
    assert any(path.name == "Makefile" for path in sd.export_c("desktop", tmp_path / "board"))
    assert sd.model_sdf("desktop").startswith("<?xml") and sd.check_model("desktop").summary
