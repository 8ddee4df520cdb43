"""The comparison of controllers, and the verdict on the delay."""

import json
import math
import re
from dataclasses import replace

import joblib
import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root, shipped
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.reporting.results import ComparisonResult
from stewart_drake.reporting.run import _shared_warnings, comparison_document
from stewart_drake.scenario.loading import load_comparison, load_compatible, load_scenario
from stewart_drake.studies.compare import (
    ADAPTIVE,
    CONTROLLERS,
    GRAVITY,
    LABELS,
    SERVOS,
    compare,
    shown,
)
from stewart_drake.studies.verdict import Verdict, delay_verdict
from tests.screen import summary_in

SHORT = ("plant.kind=exact", "duration=1.0")


@pytest.fixture(scope="module")
def results():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joblib, "cpu_count", lambda: 2)
        return compare("paper", SHORT)


def test_every_shipped_controller_takes_part():
    everyone = (*CONTROLLERS, ADAPTIVE, "predictor_mpc", *GRAVITY, *SERVOS)
    assert sorted(everyone) == shipped("controller")
    assert tuple(LABELS) == everyone


def test_the_order_is_kept_and_each_run_is_that_of_its_controller_alone(results):
    assert tuple(results) == CONTROLLERS
    for name, result in results.items():
        assert result.scenario == load_scenario("paper", name, SHORT)
        assert result.status == "completed"
    alone = simulate(load_scenario("paper", "delay_lqi", SHORT), judge_stability=False)
    xr.testing.assert_identical(alone.signals, results["delay_lqi"].signals)


def test_a_warning_names_its_controllers_by_one_word_each(results):
    about = {name: ["one"] * (name != "lqr") + ["all"] for name in ("lqr", "lqi", "delay_lqi")}
    runs = {
        name: replace(results["lqr"], summary={"warnings": texts}) for name, texts in about.items()
    }
    assert _shared_warnings(runs, []) == ["all runs: all", "lqi, delay_lqi: one"]
    assert _shared_warnings(runs, ["all", "one"]) == ["lqi, delay_lqi: one"]


def test_a_lost_run_of_a_stable_loop_is_explained(results):
    """The lost ones of the paper's comparison have unstable loops."""
    why = "Stable means that small errors about the reference fade."
    assert why not in ComparisonResult(results).table()
    lost = replace(results["predictor_lqi"], status="left_workspace")
    assert why in ComparisonResult(results | {"predictor_lqi": lost}).table()


def test_controllers_of_torques_beside_servos_are_explained():
    settings = ("plant.kind=exact", "duration=0.1")
    for chosen, said in ((("servo_preview",), False), (("predictor_lqi", "servo_preview"), True)):
        runs = compare("reachy_mini", settings, controllers=chosen)
        text = " ".join(comparison_document(runs).plain().split())
        assert ("torques are shown on the same machine with plain motors" in text) == said


def test_saved_files_are_complete(results, tmp_path):
    folder = tmp_path / "new" / "folder"
    ComparisonResult(results).save(folder)
    signals = {f"{name}.nc" for name in CONTROLLERS}
    assert {path.name for path in folder.iterdir()} == signals | {"summary.json"}
    summary = summary_in(folder)["controllers"]
    assert list(summary) == list(CONTROLLERS)
    assert summary["lqr"]["accumulated_error"] == results["lqr"].accumulated_error
    with xr.open_dataset(folder / "lqr.nc") as read:
        np.testing.assert_array_equal(read.pose, results["lqr"].signals.pose)


def test_one_core_needs_no_processes_and_ctrl_c_keeps_what_there_is():
    seen = []

    def press(name, time, error):
        seen.append((name, time, error))
        if name == "predictor_lqi":
            raise KeyboardInterrupt

    # Drake's multibody steps: the exact plant would be there before anybody looks.
    results = compare("paper", ("plant.kind=multibody", "duration=2"), press)
    assert tuple(results) == CONTROLLERS
    assert results["lqr"].status == "left_workspace"
    assert results["predictor_lqi"].status == "interrupted"
    assert results["predictor_lqi"].signals.sizes["time"] > 1
    assert all(0 < time < 2 and error >= 0 for _, time, error in seen)


def test_a_refused_controller_is_named():
    # Under gravity the plate has fallen out of its workspace before the first torque arrives.
    settings = (*SHORT, "plant.gravity=true", "controller.catch_up=0.3")
    with pytest.raises(ConfigError, match=r"delay_lqr: controller\.catch_up"):
        compare("paper", settings)


# ---------------------------------------------------------------- chosen controllers


@pytest.fixture
def own_file(tmp_path):
    text = (data_root() / "diagrams/controllers/predictor_lqi.yaml").read_text("utf-8")
    path = tmp_path / "mine.yaml"
    path.write_text(text + "w_R: 7.0\n", "utf-8")
    return path


def test_chosen_controllers_run_in_their_order_and_no_others(own_file):
    results = compare("paper", SHORT, controllers=[own_file, "lqi"])
    assert tuple(results) == ("mine", "lqi")
    assert results["mine"].scenario == load_scenario("paper", own_file, SHORT)
    assert results["mine"].scenario.controller.w_R == 7.0
    alone = simulate(load_scenario("paper", "lqi", SHORT), judge_stability=False)
    xr.testing.assert_identical(alone.signals, results["lqi"].signals)


def test_a_row_of_the_scenario_can_be_chosen():
    rows = shown("table2", controllers=["delay_lqi_sum", "delay_lqr"])
    assert tuple(rows) == ("delay_lqi_sum", "delay_lqr")
    assert rows["delay_lqi_sum"] == shown("table2")["delay_lqi_sum"]


def test_the_command_compares_the_chosen_controllers(own_file, capsys):
    settings = [word for one in SHORT for word in ("--set", one)]
    chosen = ["--controllers", f"delay_lqi, {own_file}"]
    assert main(["compare", "paper", *settings, *chosen, "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["controllers"]) == ["delay_lqi", "mine"]


@pytest.mark.parametrize("how", ["field", "section", "overlay"])
def test_a_controller_that_assumes_no_delay_keeps_none(how, tmp_path):
    file = tmp_path / "late.yaml"
    file.write_text("controller: {delay_steps: 5}")
    settings = {
        "field": "controller.delay_steps=5",
        "section": "controller={delay_steps: 5}",
        "overlay": f"overlay={file}",
    }
    rows = load_comparison("paper", ("lqr", "delay_lqr"), [settings[how], "controller.w_Q=2"])
    assert [row.controller.delay_steps for row in rows.values()][:2] == [0, 5]
    assert {row.controller.w_Q for row in rows.values()} == {2}


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (["lqi", "lqi"], "controllers: got 'lqi' twice; expected different names"),
        (["nothing"], "controller: got 'nothing'; expected one of adaptive_lqi, "),
        (["a/lqi.yaml"], "controllers: got 'a/lqi.yaml', named as a shipped controller"),
        ([], "controllers: got \\[\\]; expected a list of names, files, or mappings"),
        ({}, "controllers: got {}; expected a list of names"),
        ([{}], "controllers: got .{}.; expected a list of names"),
        ("lqi", "controllers: got 'lqi'; expected a list"),
        ([7], "controllers: got 7; expected a list"),
    ],
)
def test_controllers_that_cannot_be_compared_are_refused_in_one_line(chosen, message):
    with pytest.raises(ConfigError, match=message):
        compare("paper", SHORT, controllers=chosen)


@pytest.mark.parametrize("name", ["paper", "table2", "gravity", "reachy_mini"])
def test_a_scenario_is_compared_as_its_file(name):
    assert shown(load_scenario(name)) == shown(name)
    settings = ["duration=0.3"]
    found = load_compatible(load_scenario(name), "lqr", settings)
    assert found == load_compatible(name, "lqr", settings)


# ---------------------------------------------------------------- the verdict


def verdict(*settings, scenario="paper"):
    return delay_verdict(prepare(load_scenario(scenario, settings=settings)))


def test_the_papers_delay_is_beatable_without_gravity_and_not_with_it():
    at_rest = verdict("reference.kind=hold")
    assert at_rest.pole == 0 and at_rest.amplification == 1, "a counterbalanced plate"
    assert "can be compensated: under any controller" in str(at_rest)
    assert verdict().beatable == "yes"
    hopeless = verdict("plant.gravity=true")
    assert hopeless.beatable == "no"
    assert hopeless.pole > 30 and hopeless.amplification > 1e10
    assert hopeless.amplification == pytest.approx(math.exp(hopeless.pole * 0.8))

    at_home = verdict("plant.gravity=true", "reference.kind=hold")
    assert at_home.pole == pytest.approx(5.0, abs=0.1) and at_home.beatable == "hardly"
    assert "prediction errors grow by a factor of 55 over it" in str(at_home)


def test_the_true_delay_counts_with_its_fraction_and_beyond_all_numbers():
    settings = ("delay.steps=3", "delay.fraction=0.5", "controller.delay_steps=0")
    assert verdict(*settings).eta == pytest.approx(0.35)
    text = str(Verdict(eta=1000.0, pole=5.0, time=2.0))
    assert "cannot be compensated" in text and "a factor of 3.0e2171" in text


# ---------------------------------------------------------------- rows of a file's `compare`


def test_a_rows_own_controller_starts_from_the_files_folder(tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("w_Q: 7.0\n")
    (tmp_path / "other").mkdir()
    file = tmp_path / "scenario.yaml"
    file.write_text("compare: {own: {controller: ./mine.yaml}}\n")
    monkeypatch.chdir(tmp_path / "other")
    assert load_comparison(file, ["lqi"])["own"].controller.w_Q == 7


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("{actuator: 5}", "actuator: got 5; expected a mapping of fields"),
        ("{actuator: {torque_limit: -1}}", "actuator.torque_limit: got -1; expected a number"),
        ("{controller: [./a.yaml]}", "controller: got ['./a.yaml']; expected text"),
    ],
)
def test_a_bad_row_is_refused_in_one_line(row, message, tmp_path):
    file = tmp_path / "scenario.yaml"
    file.write_text(f"compare: {{lqi: {row}}}\n")
    with pytest.raises(ConfigError, match=re.escape(message)) as caught:
        load_comparison(file, ["lqi"])
    assert len(str(caught.value).splitlines()) == 1
    with pytest.raises(ConfigError, match=re.escape("compare.lqi: " + message)):
        load_scenario(file)
    file.write_text("compare: {a/b: {controller: lqi}}\n")
    with pytest.raises(ConfigError, match=r"compare\.a/b: names a file of signals"):
        load_scenario(file)
