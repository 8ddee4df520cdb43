"""The tutorial, done from its first line to its last in an empty folder, as its reader does it."""

import json
import re
from pathlib import Path

import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.studies import delay_limits
from tests import test_docs

TUTORIAL = test_docs.ROOT / "docs" / "tutorial.md"
FENCE = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
"""Language, name under which the reader is told to save it, text."""


def test_the_names_of_saved_files_are_told_in_the_text():
    text = TUTORIAL.read_text(encoding="utf-8")
    names = [name for _, name, _ in FENCE.findall(text) if name]
    assert len(names) == 4 and all(f"*{name}*" in text for name in names)


def test_everything_in_it_works(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # Its simulations over delay and amplitude have tests of their own, and take a while.
    monkeypatch.setattr(delay_limits, "delay_map", lambda *_: ([], False))
    told = {}
    for language, name, text in FENCE.findall(TUTORIAL.read_text(encoding="utf-8")):
        if name:
            Path(name).write_text(text, encoding="utf-8")
        elif language == "python":
            exec(compile(text, str(TUTORIAL), "exec"), {"__name__": "__main__"})
            capsys.readouterr()
        elif language == "sh":
            for arguments in test_docs.command_lines(test_docs.Block(TUTORIAL, 0, "sh", text)):
                assert main(arguments) == 0, arguments
                out, err = capsys.readouterr()
                assert err == "" and all(len(line) <= 80 for line in out.splitlines()), arguments
                told[" ".join(arguments)] = out
    check_what_it_says(told)


def check_what_it_says(told: dict[str, str]) -> None:
    """What the text promises of the results."""
    run = json.loads(Path("out/waves/summary.json").read_text())
    assert run["status"] == "completed" and run["accumulated_error"] < 0.01
    for file in ("signals.csv", "signals.nc", "replay.html", "states.png"):
        assert (Path("out/waves") / file).stat().st_size > 1000
    for file in ("out/bench/mechanism.png", "out/delay/report.html", "out/report/report.html"):
        assert Path(file).stat().st_size > 10_000
    lost, half, full = (
        json.loads(Path(f"out/{name}/summary.json").read_text())
        for name in ("lost", "half", "full")
    )
    assert [run["status"] for run in (lost, half, full)] == [
        "left_workspace",
        "completed",
        "completed",
    ]
    for name, error in {"first": 2e-4, "second": 5e-5}.items():
        found = json.loads(Path(f"out/{name}/summary.json").read_text())
        assert abs(found["delay_s"] - 0.93) < error and found["intervals"]
    assert full["accumulated_error"] < 10
    with xr.open_dataset("out/desktop/signals.nc") as signals:
        assert signals.time.values[-1] == pytest.approx(2.0)
    assert "completed" in told["simulate waves.yaml --set plant.payload_mass=0.4"]
    for words in ("--set delay.steps=5 --set controller.delay_steps=4", "--controller lqi"):
        out = told[f"simulate waves.yaml {words}"]
        assert "left workspace at" in out and re.search(r"leg \d", out)
    slow = (
        "simulate waves.yaml --set delay.fraction=0.1 --set controller.delay_steps=4 "
        "--set controller.w_R=1000"
    )
    assert "completed" in told[slow]
    usual = slow.split()[:-2]
    assert main([*usual, "--out", "out/usual", "--quiet"]) == 0
    assert json.loads(Path("out/usual/summary.json").read_text())["status"] == "left_workspace"
    shown = FENCE.findall(TUTORIAL.read_text(encoding="utf-8"))
    sample = next(text for language, _, text in shown if language == "text")
    real = told["simulate waves.yaml --out out/waves --csv --replay"]
    assert real.startswith(sample), "the output that the text shows"
