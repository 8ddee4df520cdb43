"""Results are on disk before anything is drawn; after that, only pictures or text can be lost."""

import json
import os
import subprocess
import sys

import pytest

from stewart_drake.cli import main
from stewart_drake.reporting import (
    figures,
    hautus,
    mechanism,
    replay,
)
from stewart_drake.reporting import report as report_document
from stewart_drake.studies.compare import ADAPTIVE, CONTROLLERS, GRAVITY, LABELS, SERVOS
from tests.shorter import judge_few_delays

pytestmark = pytest.mark.usefixtures("blank_figures")

EXACT = ("--set", "plant.kind=exact", "--set", "duration=0.3", "--set", "delay.steps=1")


def broken(folder):
    """Return a function that fails to draw; the results must be there before it is called."""

    def draw(*_, **__):
        assert (folder / "summary.json").exists()
        raise ZeroDivisionError("no ink\nleft")

    return draw


def names(folder):
    return {path.name for path in folder.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "module", "name", "kept"),
    [
        (("simulate", *EXACT), figures, "draw_run", {"signals.nc"}),
        (("simulate", *EXACT, "--replay"), replay, "replay_html", {"signals.nc", "states.png"}),
        (("compare", *EXACT), figures, "draw_comparison", {f"{name}.nc" for name in CONTROLLERS}),
        (("analyze", "hautus"), hautus, "plant_figure", set()),
        (("model", "check", "paper"), mechanism, "mechanism_figure", set()),
    ],
)
def test_a_failure_while_drawing_costs_the_figures_only(
    arguments, module, name, kept, tmp_path, monkeypatch, capsys
):
    judge_few_delays(monkeypatch)
    monkeypatch.setattr(module, name, broken(tmp_path))
    assert main([*arguments, "--quiet", "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1
    assert err.startswith("warning: ") and "ZeroDivisionError: no ink left" in err
    assert names(tmp_path) >= {"summary.json"} | kept
    assert json.loads((tmp_path / "summary.json").read_text())


def test_a_report_that_cannot_be_drawn_leaves_its_numbers(tmp_path, monkeypatch, capsys):
    found = type("Found", (), {"run": None, "analyses": {}, "comparison": {}})()
    monkeypatch.setattr("stewart_drake.reporting.report.collect", lambda *_: found)
    monkeypatch.setattr(report_document, "report_summary", lambda _: {"all": 1})
    monkeypatch.setattr(report_document, "document", broken(tmp_path))
    assert main(["report", "--quiet", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().err.startswith("warning: report.html could not be drawn")
    assert names(tmp_path) == {"summary.json"}


@pytest.mark.slow
def test_nothing_of_an_earlier_comparison_stays_beside_new_results(tmp_path, monkeypatch):
    assert {*CONTROLLERS, ADAPTIVE, *GRAVITY, *SERVOS} <= set(LABELS)
    for name in LABELS:
        for old in (f"{name}.nc", f"torques_{name}.png", f"delay_{name}.svg", "weights.png"):
            (tmp_path / old).write_text("of an earlier comparison")
    monkeypatch.setattr(figures, "draw_comparison", broken(tmp_path))
    assert main(["compare", *EXACT, "--quiet", "--out", str(tmp_path)]) == 0
    assert names(tmp_path) == {"summary.json", *(f"{name}.nc" for name in CONTROLLERS)}


@pytest.mark.slow
def test_a_closed_stream_costs_its_text_only(tmp_path):
    """Run `simulate` from a shell that also asks for a backend that does not exist."""
    arguments = " ".join(("simulate", *EXACT, "--out", str(tmp_path)))
    line = f'"$0" -m stewart_drake {arguments} <&- >&- 2>&-'
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", line, sys.executable],
        capture_output=True,
        text=True,
        env={**os.environ, "MPLBACKEND": "nonsense"},
        timeout=120,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr
    assert names(tmp_path) >= {"summary.json", "signals.nc", "states.png"}
    assert json.loads((tmp_path / "summary.json").read_text())["status"] == "completed"
