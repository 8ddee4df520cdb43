"""The analyses of a whole scenario, from the command line."""

import json
import math
import re
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.dynamics.workspace import measures_at
from stewart_drake.files.resources import resolve
from stewart_drake.loop.preparation import prepare
from stewart_drake.reporting.page import unbroken
from stewart_drake.scenario.reference_config import HoldConfig, SineConfig, WaypointsConfig
from stewart_drake.studies import delay, runs
from stewart_drake.studies.delay import Cell, delay_map, map_delays, scaled_motion
from stewart_drake.studies.runs import run_scenario
from stewart_drake.studies.verdict import delay_verdict
from tests.mechanisms import PAPER
from tests.screen import said, summary_in
from tests.shorter import judge_few_delays

pytestmark = pytest.mark.usefixtures("blank_figures")

TOO_FAR = "reference.amplitude=[0.26, 0.26, 0.26, 0.02, 0.02, 0.2]"


@pytest.fixture(autouse=True)
def _short(monkeypatch):
    """Three delays instead of thirty, and no simulations; those have their own tests."""
    judge_few_delays(monkeypatch)
    cells = [Cell(8, 1.0, "completed", 21.0, math.nan), Cell(0, 1.0, "left_workspace", math.nan, 1)]
    cells += [
        Cell(0, 1.25, "out_of_reach", math.nan, 1),
        Cell(8, 1.25, "solver_failed", math.nan, 1),
    ]
    monkeypatch.setattr(delay, "delay_map", lambda *_: (cells, False))


def analyze(capsys, kind, out, *arguments):
    """Return summary, page, and what is printed, without line breaks."""
    printed = said(capsys, "analyze", kind, *arguments, "--out", out)
    return summary_in(out), (out / "report.html").read_text(), " ".join(printed.split())


def settings(*values):
    return [part for value in values for part in ("--set", value)]


def test_hautus_of_the_paper(tmp_path, capsys):
    summary, page, told = analyze(capsys, "hautus", tmp_path / "out")
    systems = {system["name"]: system for system in summary["systems"]}
    assert len(systems) == 1 + 3 * 3 + 2 * 10
    for system in systems.values():
        assert system["m"] == 6
        assert all(system[name] for name in ("controllable", "stabilizable", "detectable"))
        assert system["stabilizable_margin"] > 1e-6
        assert system["detectable_margin"] is None or system["detectable_margin"] > 1e-6
    assert systems["error model, continuous"]["n"] == 18
    assert systems["minimal chain, mu = 2"]["n"] == 30
    for steps in range(3):
        extra = systems[f"paper's chain, mu = {steps}"]
        assert extra["n"] == 24 + 6 * steps
        assert not extra["observable"]
        assert extra["deficient"] == [
            f"no output shows 6 directions in torque T(k-{steps + 1}), mode 0"
        ]
        assert not extra["drake"]["observable"]
        assert systems[f"minimal chain, mu = {steps}"]["observable"]
    assert "All 30 models are stabilisable and detectable" in told
    assert "This loop" not in told, "its chain of 8 periods is not among these"
    assert "Paper's chain: 3 of 3 models are not observable, such as" in told
    assert unbroken("stewart-drake analyze hautus paper --out") in page
    assert page.count("<img") == 2


def test_delay_of_the_paper(tmp_path, capsys):
    summary, page, told = analyze(capsys, "delay", tmp_path / "out")
    assert summary["error_floor"] == pytest.approx(50 * (1 - math.cos(0.8)), rel=1e-6)
    assert summary["error_floor_applies"]
    verdict = delay_verdict(prepare(sd.load_scenario("paper")))
    fastest = max(summary["poses"], key=lambda point: point["fastest_pole"])
    assert (fastest["t"], fastest["fastest_pole"]) == (verdict.time, verdict.pole)
    assert fastest["amplification"] == pytest.approx(math.exp(0.8 * fastest["fastest_pole"]))
    assert summary["beatable"] == "yes"
    assert summary["controller_margin"]["stable"]
    assert [m["mu"] for m in summary["loop"]] == [8]
    for limit in summary["largest_delay"]:
        growth = math.exp(limit["delay"] * fastest["fastest_pole"])
        assert growth == pytest.approx(limit["amplification"])
    assert "can be compensated" in told and "a larger controller.w_R widens it." in told
    assert "0.19 % of the delay" in told
    assert "1 (here) 1.72 1.51" in told and "1000 35.5 32.8" in told, "which w_R"
    for part in ("1.64 ms longer", "21.0", "left 1.00", "no reach 1.00"):
        assert part in told
    assert page.count("<img") == 3


def test_delay_under_gravity(tmp_path, capsys):
    summary, _, told = analyze(capsys, "delay", tmp_path, *settings("plant.gravity=true"))
    assert summary["beatable"] == "no"
    assert "The delay of 0.8 s (8 periods) cannot be compensated: under any controller," in told
    assert not summary["error_floor_applies"], "it starts from rest, and falls"
    assert "A plate at rest until the first torque acts has 15.2 % s; this one moves." in told
    checks = summary["growth_checks"]
    assert len(checks) == 5
    for check in checks:
        assert check["expected"] > 10
        assert check["simulated"] == pytest.approx(check["expected"], rel=0.05)


@pytest.mark.parametrize("kind", ["hautus", "delay"])
@pytest.mark.parametrize("gravity", ["plant.gravity=true", "plant.gravity=false"])
def test_a_motion_out_of_reach_gets_a_verdict(kind, gravity, tmp_path, capsys):
    summary, page, told = analyze(capsys, kind, tmp_path, *settings(TOO_FAR, gravity))
    opening = "The reference cannot be followed: leg 2 reached the end of its reach at t = 0.54 s"
    assert summary["obstacles"][0].startswith(opening)
    assert opening in page and told.startswith(opening)
    if kind == "delay":
        assert max(point["t"] for point in summary["poses"]) < 0.54
    else:
        assert len(summary["skipped"]) == 12


def with_home(folder, coordinate, value):
    """Return the setting of the paper's machine, assembled with another coordinate of its home."""
    home = np.where(np.arange(6) == coordinate, value, PAPER.home).tolist()
    path = folder / "mine.yaml"
    path.write_text(
        re.sub(r"home: \[.*\]", f"home: {home}", resolve("mechanism", "paper").read_text())
    )
    return f"mechanism={path}"


@pytest.mark.parametrize("gravity", ["plant.gravity=true", "plant.gravity=false"])
def test_a_singular_home_pose_gets_a_verdict(gravity, tmp_path, capsys):
    """The rods of the paper's machine cannot hold it against one motion."""

    def rolled(angle):
        return np.concatenate([[angle], PAPER.home[1:]])

    roll = brentq(lambda a: measures_at(PAPER, rolled(a)).parallel, -1.39, -1.42, xtol=1e-15)
    mechanism = with_home(tmp_path, 0, roll)
    summary, _, told = analyze(capsys, "hautus", tmp_path, *settings(mechanism, gravity))
    assert told.startswith("At the home pose: parallel singularity")
    assert "No controller can be designed for" in told
    by_name = {system["name"]: system for system in summary["systems"]}
    model = by_name["error model, continuous"]
    assert not model["stabilizable"]
    (words,) = model["deficient"]
    assert words.startswith("no torque reaches 1 direction in rate error")
    summary, *_ = analyze(capsys, "delay", tmp_path / "delay", *settings(mechanism, gravity))
    assert summary["obstacles"]
    assert "parallel singularity" in summary["loop_problem"]
    assert summary["poses"] == []


def test_a_home_pose_at_a_dead_centre_gets_a_verdict(tmp_path, capsys):
    height = brentq(
        lambda z: PAPER.reach_margins(np.concatenate([PAPER.home[:5], [z]])).min() - 1e-12, 0.4, 0.6
    )
    summary, *_ = analyze(capsys, "hautus", tmp_path, *settings(with_home(tmp_path, 5, height)))
    assert "leg 1 reached the end of its reach" in summary["obstacles"][0]
    assert {system["family"] for system in summary["systems"]} == {"plant"}
    assert len(summary["skipped"]) == 3


def test_json_and_quiet(capsys):
    assert main(["analyze", "delay", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["error_floor"] > 15
    assert main(["analyze", "delay", "--quiet"]) == 0
    assert capsys.readouterr().out == ""


# ------------------------------------------------------------------ the map


def test_cells_are_simulations(monkeypatch):
    """One run completes, one leaves the workspace, one begins out of reach."""
    monkeypatch.setattr(delay, "FACTORS", (0.5, 1.25))
    monkeypatch.setattr(delay, "map_delays", lambda _: [0, 8])
    settings = ("duration=1.1", "controller.estimate=[]")
    seen, scenario = [], sd.load_scenario("paper", settings=settings)
    cells, interrupted = delay_map(scenario, lambda done, all_: seen.append((done, all_)))
    assert not interrupted
    assert [(cell.steps, cell.factor) for cell in cells] == [*product((0, 8), (0.5, 1.25))]
    assert [cell.status for cell in cells] == ["completed", "out_of_reach"] * 2
    assert seen[-1] == (2, 2)
    half = "reference.amplitude=[0.1308996939, 0.1308996939, 0.1308996939, 0.01, 0.01, 0.04]"
    alone = sd.load_scenario("paper", settings=(*settings, "plant.kind=exact", half))
    error = sd.simulate(alone, judge_stability=False).accumulated_error
    assert cells[2].error == pytest.approx(error, rel=1e-9)
    assert cells[1].time == pytest.approx(1.04)
    assert math.isnan(cells[1].error)


def test_ctrl_c_keeps_the_cells_that_are_there(monkeypatch):
    def interrupted_jobs(jobs, function, folder, **_):
        key = next(iter(jobs))
        (Path(folder) / f"{key}.json").write_bytes(function(*jobs[key]))
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "run_jobs", interrupted_jobs)
    scenario = sd.load_scenario("paper", settings=("duration=0.2", "controller.estimate=[]"))
    cells, interrupted = delay_map(scenario)
    assert interrupted
    assert cells[0].status == "completed"
    assert {cell.status for cell in cells[1:]} == {"not_run"}


def test_a_run_that_leaves_the_workspace_says_when():
    scenario = sd.load_scenario(
        "paper", "delay_lqi", ("plant.kind=exact", "duration=3.0", "controller.catch_up=0")
    )
    outcome = json.loads(run_scenario(scenario))["outcome"]
    assert outcome["status"] == "left_workspace"
    assert outcome["error"] is None
    assert 1 < outcome["time"] < 2


def test_motions_are_scaled_about_their_start():
    sine = scaled_motion(SineConfig(), 0.5)
    assert sine is not None
    assert sine.amplitude == pytest.approx(np.array(SineConfig().amplitude) / 2)
    way = WaypointsConfig(times=[0.0, 1.0], poses=[[0, 0, 0, 0, 0, 0.4], [0, 0, 0.2, 0, 0, 0.3]])
    half = scaled_motion(way, 0.5)
    assert half is not None
    assert half.poses == [
        pytest.approx([0, 0, 0, 0, 0, 0.4]),
        pytest.approx([0, 0, 0.1, 0, 0, 0.35]),
    ]
    assert scaled_motion(HoldConfig(), 0.5) is None
    assert scaled_motion(HoldConfig(), 1.0) is not None


def test_delays_of_the_map_lie_around_the_own_one():
    assert map_delays(8) == [0, 4, 8, 12, 16]
    assert map_delays(0) == [0, 1, 2, 4]
    assert map_delays(1) == [0, 1, 2, 4]
