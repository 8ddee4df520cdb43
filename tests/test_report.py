"""The report: whole, true, self-contained, and shown by a real browser without an error."""

import json
import os
import re
import time
from dataclasses import replace

import numpy as np
import pytest

from stewart_drake.cli import main
from stewart_drake.files.yamlio import load_yaml
from stewart_drake.loop.preparation import prepare_unchecked
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.reporting import report as report_document
from stewart_drake.reporting.document import Document
from stewart_drake.reporting.page import Provenance
from stewart_drake.reporting.page import html as html_of
from stewart_drake.reporting.report import ANALYSES, collect, mean_error
from stewart_drake.reporting.results import AnalysisResult
from stewart_drake.reporting.run import run_document
from stewart_drake.scenario.loading import load_scenario, title_of
from stewart_drake.studies.compare import CONTROLLERS, LABELS
from tests.browser import needs_chromium
from tests.screen import said, summary_in
from tests.shorter import judge_few_delays, leave_blank, map_few_poses

EXACT = ("plant.kind=exact",)
SETTINGS = ("--set", "plant.kind=exact", "--set", "duration=2.0")

BLANK = AnalysisResult(None, {}, Document("t", "yes: it is.", [], "good"), Provenance("command"))
"""Stands for an analysis."""

pytestmark = pytest.mark.slow  # one report of all there is, which most of them look at


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Return the folder of a report on two seconds of the paper's scenario."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "summary.json").write_text("of an earlier run")
    with pytest.MonkeyPatch.context() as patch:
        map_few_poses(patch)
        judge_few_delays(patch)
        leave_blank(patch)
        assert main(["report", "paper", *SETTINGS, "--out", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture(scope="module")
def html(report):
    return (report / "report.html").read_text()


@pytest.fixture(scope="module")
def summary(report):
    return json.loads((report / "summary.json").read_text())


# ---------------------------------------------------------------- what it holds


def test_the_summary_agrees_with_the_commands_of_their_own(summary, tmp_path, capsys):
    assert main(["simulate", "paper", *SETTINGS, "--json"]) == 0
    own = json.loads(capsys.readouterr().out)
    for name in ("status", "accumulated_error", "peak_torque", "delay_floor", "cost"):
        assert summary["run"][name] == own[name]
    assert list(summary["controllers"]) == list(CONTROLLERS)
    assert summary["controllers"]["lqr"]["failure"]["leg"] == 2
    assert list(summary["analyses"]) == list(ANALYSES)
    assert main(["analyze", "workspace", "paper", *SETTINGS, "--json"]) == 0
    work = json.loads(capsys.readouterr().out)
    assert summary["analyses"]["workspace"]["largest_factor"] == work["largest_factor"]


def test_verdicts_and_the_comparison_are_those_of_the_summary(html, summary):
    text = " ".join(re.sub(r"<[^>]*>", " ", html).split())
    verdicts = [summary["verdict"], *(summary["analyses"][name]["verdict"] for name in ANALYSES)]
    assert all(verdict[1:].removesuffix(".") in text for verdict in verdicts)
    assert "stewart-drake report paper --set plant.kind=exact" in text
    assert "Table II" not in html, "that is of the paper's duration"
    compared = html.partition("The controllers compared</h2>")[2].partition("</table>")[0]
    rows = re.findall(r"<tr>\s*(.*?)</tr>", compared, re.DOTALL)
    cells = [re.findall(r"<td[^>]*>(.*?)</td>", " ".join(row.split())) for row in rows]
    table = {row[0]: row for row in cells if row}
    mark = {"predictor_lqi": ", this run"}
    shown = [LABELS[name] + mark.get(name, "") for name in CONTROLLERS]
    assert [table[name][-1] for name in CONTROLLERS] == shown
    assert "left workspace at 1.36 s, leg 2" in table["lqr"]
    ours = float(table["predictor_lqi"][1])
    own = summary["controllers"]["predictor_lqi"]["accumulated_error"]
    assert ours == pytest.approx(own, rel=5e-3)


def test_the_scenario_in_it_runs_again(html, tmp_path):
    listing = re.findall(r"<pre>(.*?)</pre>", html, re.DOTALL)[0]
    path = tmp_path / "again.yaml"
    path.write_text(listing)
    assert load_yaml(path)["duration"] == 2.0
    assert load_scenario(path) == load_scenario("paper", settings=(*EXACT, "duration=2.0"))


def test_nothing_in_it_comes_from_elsewhere(html):
    page = re.sub(r'srcdoc="[^"]*"', "", html)  # the replay has a test of its own
    assert not re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page)
    bare = re.sub(r' src="data:[^"]*"', "", page)  # figures, which refer to their own parts
    assert "@import" not in bare and "url(" not in bare
    assert "sandbox=" in html and "<script" not in page


def test_the_mean_error_leaves_out_the_time_in_which_nothing_can_act(summary):
    run = simulate(load_scenario("paper", settings=(*EXACT, "duration=2.0")))
    share = (run.accumulated_error - run.summary["delay_floor"]) / (2.0 - 0.8)
    assert mean_error(run) == pytest.approx(share)


@pytest.mark.parametrize(
    ("amplitude", "moved", "words"),
    [
        (0.03, 1, r"coordinates \(z\)\. Largest error: z \S+ mm \(\d+ % of its motion\) in"),
        (0.0, 6, r"of 1 rad and 1 m, as no .* Largest error: \w+ \d\.\d+ (mm|deg)\."),
    ],
)
def test_still_coordinates_do_not_dilute_the_error(amplitude, moved, words):
    """A still plate has errors in its own units, and one that only rises has that of z."""
    motion = (f"reference.amplitude=[0,0,0,0,0,{amplitude}]", "reference.offset=[0,0,0,0,0,0.37]")
    settings = (*motion, "plant.torque_bias=[1e-4,0,0,0,0,0]")
    run = simulate(load_scenario("paper", None, (*EXACT, "duration=2", *settings)))
    s = run.summary
    left = 2.0 - (0.8 if s["delay_floor"] else 0.0)
    whole = 6 * (s["accumulated_error"] - s["delay_floor"])
    if moved == 1:
        e_z = np.abs(run.signals.error.values[:, 5])
        z_alone = 100 * np.trapezoid(e_z, run.signals.time.values) / (2 * amplitude)
        assert whole > 1.001 * (z_alone - 6 * s["delay_floor"]), "all coordinates are off"
        whole = z_alone - 6 * s["delay_floor"]
    assert mean_error(run) == pytest.approx(whole / moved / left, rel=1e-4)
    text, _ = report_document.verdict(collect_of(run.scenario, run=run))
    assert re.search(words, text)
    still = run_document(run).plain().partition("peak error")[2].split("rms error")[0]
    assert still.count("deg") == still.count("mm") == 3, "an error of each coordinate with its unit"
    assert still.count("%)") == (moved == 1), "that of a moving one in % of its motion too"


def test_a_lost_run_has_the_errors_of_its_part_of_the_motion():
    run = simulate(load_scenario("paper", "lqr", EXACT))
    assert run.status == "left_workspace"
    z = 1e3 * np.abs(run.signals.error.values[:, 5]).max()
    (found,) = re.findall(r"z (\S+) mm \(", run_document(run).plain())
    assert float(found) == pytest.approx(z, rel=0.01)


def test_the_error_of_a_soft_start_is_told_from_the_later_one():
    run = simulate(load_scenario("reachy_mini", None, ("duration=3",)))
    text, _ = report_document.verdict(collect_of(run.scenario, run=run))
    parts = r": z \S+ mm \(35 % of its motion\) in the first half, x \S+ mm \((\S+) %\) in the sec"
    found = re.search(parts, text)
    x, wanted = (np.array(run.signals[name].values[:, 3]) for name in ("pose", "reference"))
    late = np.abs(x - wanted)[run.signals.time.values >= 1.5].max()
    assert float(found[1]) == pytest.approx(100 * late / np.ptp(wanted), rel=0.05)


# ---------------------------------------------------------------- other scenarios


def collect_of(scenario, **changes):
    """Return the parts of a report with one run and no analyses."""
    parts = {"run": changes.get("run") or simulate(scenario), "failure": None}
    parts["scale"] = prepare_unchecked(scenario).scale
    parts["analyses"] = dict.fromkeys(ANALYSES, BLANK)
    return report_document.ReportData(scenario, **(parts | changes))


@pytest.mark.usefixtures("blank_figures")
def test_a_run_that_ends_early_is_reported_at_once(tmp_path):
    """Scenarios of `new` are called by their folder, machines by their name."""
    path = tmp_path / "machine.yaml"
    path.write_text(mechanism_yaml(replace(load_mechanism("paper"), name="ruler")))
    scenario = load_scenario("paper", "lqr", (*EXACT, f"mechanism={path}"))
    page = report_document.document(collect_of(scenario), "mine")
    assert page.tone == "bad" and page.facts["mechanism"] == "ruler"
    assert title_of("b/waves.yaml") == "waves" and title_of("mine/scenario.yaml") == "mine"
    assert re.match(r"The run ended after 1\.\d\d of 10 s: .*leg 2", page.verdict)
    assert "mine" in page.title and "<h1>" in html_of(page, Provenance("command"))


@pytest.mark.parametrize(
    ("settings", "tone", "words"),
    [
        ((), "good", "The plate follows its reference"),
        (("controller.delay_steps=7",), "bad", "Not reliable: the loop is unstable, errors grow"),
        (("sensor.loss=0.2",), "fair", r"Caution: \d+ of 31 samples without a new and usable"),
        (("sensor.loss=0.7",), "bad", r"Not reliable: \d+ of 31 samples without a new and usable"),
        (("actuator.torque_limit=0.008",), "fair", "Caution: a mean error of"),
    ],
)
@pytest.mark.usefixtures("blank_figures")
def test_the_worst_finding_makes_the_verdict(settings, tone, words):
    fixed = ("plant.kind=exact", "start=on_reference", "queue=reference")
    duration = "duration=1.5" if "delay_steps" in str(settings) else "duration=3"
    run = simulate(load_scenario("paper", None, (*fixed, duration, *settings)))
    assert run.status == "completed"
    page = report_document.document(collect_of(run.scenario, run=run), "mine")
    assert page.tone == tone and re.search(words, page.verdict)


def test_links_that_cross_are_in_the_verdict():
    run = simulate(load_scenario("paper", None, (*EXACT, "duration=0.3", "start=on_reference")))
    crossing = {"clearance": {"touching": ["crank 1"], "verdict": "one pair of links crosses"}}
    analyses = dict.fromkeys(ANALYSES, BLANK) | {"workspace": replace(BLANK, summary=crossing)}
    text, tone = report_document.verdict(collect_of(run.scenario, run=run, analyses=analyses))
    assert "Caution: one pair of links crosses" in text and tone == "fair"


@pytest.mark.usefixtures("blank_figures", "few_poses")
def test_a_motion_out_of_reach_gets_a_report_without_runs(tmp_path, capsys, monkeypatch):
    def only_workspace(scenario, scenarios, progress):
        assert not scenarios
        return {}, dict.fromkeys(ANALYSES, report_document._analyse("workspace", scenario))

    monkeypatch.setattr(report_document, "_work", only_workspace)
    amplitude = "reference.amplitude=[0.3, 0.3, 0.3, 0.2, 0.2, 0.3]"
    out = said(capsys, "report", "paper", "--set", amplitude, "--out", tmp_path)
    assert "leaves the workspace at t = 0.29" in " ".join(out.split())
    assert sorted(os.listdir(tmp_path)) == ["report.html", "summary.json"]
    summary = summary_in(tmp_path)
    assert summary["tone"] == "bad" and summary["run"] is None and summary["controllers"] == {}


def test_the_tuners_runs_are_there_where_there_is_a_network(monkeypatch, tmp_path):
    jobs = {}

    def kept(scenario, scenarios, progress):
        jobs.update(scenarios)
        return dict.fromkeys(scenarios), dict.fromkeys(ANALYSES)

    monkeypatch.setattr(report_document, "_work", kept)
    for there in (False, True):
        monkeypatch.setattr(report_document, "has_network", lambda scenario, t=there: t)
        jobs.clear()
        found = collect("paper", ["plant.kind=exact"])
        tuned = {name: sc for name, sc in jobs.items() if name.startswith("tuned-")}
        assert len(tuned) == len(found.tuned) == (3 if there else 0)
        assert all(sc.tuner.kind == "ann" for sc in tuned.values())
    # Its own controller is the shipped predictor: that run stands for both.
    assert set(jobs) - set(tuned) == set(CONTROLLERS)
    mine = tmp_path / "mine.yaml"
    mine.write_text("controller: {feedforward: none}")
    collect(mine)
    assert jobs[report_document._OWN].controller.feedforward == "none"
    own = tmp_path / "own.yaml"
    own.write_text("w_R: 2.0")
    found = collect("paper", EXACT, controller=own)
    assert found.scenario == jobs[report_document._OWN] == load_scenario("paper", own, EXACT)
    assert collect("paper", EXACT, controller="lqi").scenario == jobs["lqi"]
    # One that is asked for is run, beside the comparison, which stays.
    collect(mine, controller="servo_preview")
    assert jobs[report_document._OWN].controller.command == "cranks"


# ---------------------------------------------------------------- in a browser


@needs_chromium
def test_a_browser_shows_it_without_an_error_on_any_screen(report, tab):
    for width, scheme in ((1100, "light"), (380, "dark")):
        tab.open(report / "report.html", width, 900, prefers_color_scheme=scheme)
        tab.wait("[...document.images].every(i => i.complete)")
        assert tab.evaluate("[...document.images].every(i => i.naturalWidth > 100)")
        assert tab.evaluate("document.documentElement.scrollWidth") <= width
        tab.evaluate("document.querySelector('iframe').scrollIntoView()")
        time.sleep(1.0)
        end = time.monotonic() + 30
        while tab.screenshot()[80:560, : width - 40].std() <= 0.03:
            assert time.monotonic() < end, "the replay inside is blank"
            time.sleep(0.2)
        assert tab.errors == [] and tab.requests == []
