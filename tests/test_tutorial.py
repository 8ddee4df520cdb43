"""The tutorial, done from its first line to its last in an empty folder, as its reader does it.

The section on the machine that is not its drawing needs nothing of the others, and is a test of its
own, which another worker can take.
"""

import json
import re
from pathlib import Path

import pytest

from stewart_drake.cli import main
from stewart_drake.core.build import system_compiler
from stewart_drake.reporting import report
from stewart_drake.studies import delay
from tests import test_docs
from tests.building import keeping_objects
from tests.shorter import judge_few_delays, leave_blank, map_few_poses
from tests.test_report import BLANK

TUTORIAL = test_docs.ROOT / "docs" / "tutorial.md"
TEXT = TUTORIAL.read_text(encoding="utf-8")
FENCE = re.compile(r"^```(\w+) ?(\S*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
"""Language, name under which the reader is told to save it, text."""
BEFORE, _, _REST = TEXT.partition("\n## 6. ")
IDENTIFICATION, _, _AFTER = _REST.partition("\n## ")
SLOW = (
    "simulate waves.yaml --set delay.fraction=0.25 --set controller.delay_steps=4 "
    "--set controller.w_R=1000"
)
OTHERS = f"{BEFORE}\n## {_AFTER}"


@pytest.fixture
def do(tmp_path, monkeypatch, capsys):
    """Run a part of it in an empty folder; return what each command printed."""
    monkeypatch.chdir(tmp_path)
    # Its simulations over delay and amplitude have tests of their own, and take a while.
    monkeypatch.setattr(delay, "delay_map", lambda *_: ([], False))
    judge_few_delays(monkeypatch)
    map_few_poses(monkeypatch)
    # Commands before it print these analyses.
    monkeypatch.setattr(report, "_analyse", lambda name, scenario: BLANK)
    if system_compiler() is not None:
        for name, value in keeping_objects().items():
            monkeypatch.setenv(name, value)

    def done(part):
        told = {}
        for language, name, text in FENCE.findall(part):
            if name:
                Path(name).write_text(text, encoding="utf-8")
            elif language == "python":
                exec(compile(text, str(TUTORIAL), "exec"), {"__name__": "__main__"})
                capsys.readouterr()
            elif language == "sh":
                for arguments in test_docs.command_lines(test_docs.Block(TUTORIAL, 0, "sh", text)):
                    with pytest.MonkeyPatch.context() as patch:
                        if not {"out/bench", "out/waves"} & {*arguments}:
                            leave_blank(patch)
                        assert main([*arguments, *more(arguments)]) == 0, arguments
                    out, err = capsys.readouterr()
                    assert err == "", arguments
                    assert [line for line in out.splitlines() if len(line) > 80] == [], arguments
                    told[" ".join(arguments)] = out
        return told

    return done


def more(arguments):
    """Return words that a test adds to a command of the text."""
    if "out/half" in arguments:  # as much of it as the second fit needs
        return ["--set", "duration=4"]
    if {"out/report", "out/board"} & {*arguments}:
        return ["--set", "duration=3"]
    return ["--out", "out/slow"] if " ".join(arguments) == SLOW else []


def summary(name):
    return json.loads(Path(f"out/{name}/summary.json").read_text())


@pytest.mark.slow
def test_a_machine_and_a_motion_of_one_s_own(do, monkeypatch):
    told = do(OTHERS)
    leave_blank(monkeypatch)
    run = summary("waves")
    assert run["status"] == "completed" and run["accumulated_error"] < 0.01
    for file in ("signals.csv", "signals.nc", "replay.html", "states.png"):
        assert (Path("out/waves") / file).stat().st_size > 1000
    for file in ("out/bench/mechanism.png", "out/delay/report.html", "out/report/report.html"):
        assert Path(file).stat().st_size > 10_000
    own = [summary(f"own_{steps}") for steps in (0, 4)]
    assert own[0]["status"] == "completed" and own[0]["accumulated_error"] < 1
    assert own[1]["status"] == "left_workspace"
    assert "completed" in told["simulate waves.yaml --set plant.payload_mass=0.4"]
    for words in ("--set delay.steps=5 --set controller.delay_steps=4", "--controller lqr_gravity"):
        out = told[f"simulate waves.yaml {words}"]
        assert "left workspace at" in out and re.search(r"leg \d", out)
    assert main(f"simulate waves.yaml {words} --set delay.steps=0 --out out/prompt".split()) == 0
    assert summary("prompt")["status"] == "completed"
    assert "completed" in told[SLOW]
    given = SLOW.split()
    for name, words in {
        "usual": given[:-2],
        "fast": [*given[:-1], "controller.w_R=1", "--set", "controller.replan=0"],
    }.items():
        assert main([*words, "--out", f"out/{name}", "--quiet"]) == 0
    assert summary("slow")["accumulated_error"] == pytest.approx(0.39, abs=5e-3)
    assert {summary(name)["status"] for name in ("usual", "fast")} == {"left_workspace"}
    assert summary("usual")["warnings"]
    sample = next(text for language, _, text in FENCE.findall(TEXT) if language == "text")
    real = told["simulate waves.yaml --out out/waves --csv --replay"]
    assert real.startswith(sample), "the output that the text shows"


@pytest.mark.slow
def test_from_a_lost_run_to_full_amplitude(do):
    do(IDENTIFICATION)
    lost, half, full = (summary(name) for name in ("lost", "half", "full"))
    assert [run["status"] for run in (lost, half, full)] == [
        "left_workspace",
        "completed",
        "completed",
    ]
    for name, error in {"first": 2e-4, "second": 5e-5}.items():
        found = summary(name)
        assert abs(found["delay_s"] - 0.93) < error and found["intervals"]
    assert full["accumulated_error"] < 10
