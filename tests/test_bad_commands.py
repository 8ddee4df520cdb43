"""Command lines: what is refused, before anything is computed or written."""

import fcntl
import os
import sys
from pathlib import Path

import pytest

from stewart_drake.cli import main
from tests.faults import refusal, tree, written

EXACT = ("--set", "plant.kind=exact", "--set", "duration=0.1", "--set", "delay.steps=1")

WITH_OUT = {
    "simulate": ["simulate", *EXACT],
    "compare": ["compare", *EXACT],
    "report": ["report", *EXACT],
    "hautus": ["analyze", "hautus", *EXACT],
    "delay": ["analyze", "delay", *EXACT],
    "workspace": ["analyze", "workspace", *EXACT],
    "robustness": ["analyze", "robustness", *EXACT],
    "dataset": ["tune", "dataset"],
    "evaluate": ["tune", "evaluate", "--scenarios", "2"],
    "check": ["model", "check", "paper"],
    "view": ["model", "view", "paper"],
}
"""Every command that writes into a directory."""

BAD_ARGUMENTS = [
    (["simulate", "--nope"], "--nope"),
    (["simulat"], "simulate"),
    (["new"], "DIR: got none in 'new'; expected stewart-drake new [OPTIONS] DIR, folder of the"),
    (["new", "--crank", "9"], "DIR: got none in 'new --crank 9'; expected stewart-drake new ["),
    (["new", "m", "--rod", "9", "mm"], "got 'mm', which is neither argument nor value; expected"),
    (["new", "m", "--rod"], "--rod' requires an argument; see stewart-drake new --help"),
    (["new", "--out", "m"], "No such option: --out; see stewart-drake new --help"),
    (["simulate", "--quite"], "No such option: --quite; did you mean --quiet?"),
    (["machine", "--watchdog", "x"], "--watchdog: got 'x'; expected a number; see stewart-drake"),
    (["machine", "--watchdog=x"], "--watchdog: got 'x'; expected a number"),
    (["analyze", "link", "--runs", "0"], "--runs: got 0; expected at least 1"),
    (["simulate", "paper", "twice"], "twice"),
    (
        ["list", "scenario"],
        "got 'scenario'; expected stewart-drake list alone, to list the shipped",
    ),
    (["simulate", "--set", "plant.kind"], "plant.kind"),
    (
        ["simulate", "paper", "--set", "controller.w_R="],
        "error: --set: controller.w_R: got no value; expected a value, or null for none\n",
    ),
    (["compare", "paper", "--set", "controler.w_R=3"], "error: --set: controler: unknown key; did"),
    (["simulate", "--csv"], "--csv: got it without --out; expected --out DIR to write into"),
    (["simulate", "--replay"], "--replay: got it without --out; expected --out DIR to write into"),
    (["simulate", "--log", "run.txt"], "--log: got 'run.txt'; expected a file that ends in .mcap"),
    (["simulate", "--log", "."], "--log: got '.', a directory; expected a file"),
    (["simulate", "--controller", "lqrr"], "lqr"),
    (["simulate", "./\udcff.yaml"], "UTF-8"),
    (["model", "check"], "MECHANISM"),
    (["analyze", "robustness", "--limit", "nan"], "--limit"),
    (["analyze", "robustness", "--vary", "payload=nan"], "payload"),
    (
        ["analyze", "robustness", "--vary", "gain=5mm"],
        "--vary: gain: got '5mm'; expected a number (gain: +-share of the motors' torque)\n",
    ),
    (
        ["simulate", "--set", "delay.steps=5ms"],
        "delay.steps: got '5ms'; expected a whole number of periods",
    ),
    (["tune", "dataset", "--disturbed", "-1"], "--disturbed"),
    (["tune", "dataset", "--set", "duration=1"], "duration"),
    (["tune", "dataset", "--set", "reference.kind=hold"], "reference"),
    (["tune", "train"], "DATA"),
    (["tune", "train", "nowhere"], "nowhere"),
    (["tune", "train", ".", "--out", "new.txt"], "--out"),
    (["tune", "evaluate", "nope"], "weights"),
    (["tune", "evaluate", "--scenarios", "1"], "--scenarios"),
    (["tune", "evaluate", "--scenarios", "2000000"], "--scenarios: got 2000000; expected at most"),
    (["tune", "dataset", "--disturbed", "2000000"], "--disturbed: got 2000000; expected at most"),
    (["analyze", "link", "--runs", "2000000"], "--runs: got 2000000; expected at most"),
    (["analyze", "robustness", "--runs", "2000000"], "--runs: got 2000000; expected at most"),
    (["tune", "evaluate", "--family", "T", "--controller", "lqi"], "--controller"),
    (["tune", "dataset", "--family", "T", "--draws", "9"], "--draws"),
    (["tune", "dataset", "--family", "T", "--disturbed", "3"], "--disturbed: got 3 with --family"),
    (["tune", "train", "nowhere", "--start", "-1"], "--start: got -1.0 without --regret"),
    (["tune", "train", "nowhere", "--regret", "--labels", "as_run"], "--labels: got as_run with"),
    (["analyze", "robustness", "--also", "lqi", "--also", "lqi"], "--also: got two of one"),
    (["analyze", "robustness", "--beside", "lqi"], "--beside: got an option of 0.2"),
    (["identify", "--plan", "paper", "--mechanism", "paper"], "--mechanism: got paper with --plan"),
    (
        ["identify", "run.nc", "--mechanism", "paper", "--bits", "14"],
        "--bits: got 14 with logs of runs, which contain it",
    ),
    (
        ["layout", "--limit", "reach=20mm"],
        "--limit: got 'reach=20mm'; expected NAME=VALUE, numbers without units",
    ),
    (["layout", "paper", "--goal", "beauty"], "--goal: got beauty"),
    (["layout", "paper", "--set", "plant.mechanism=desktop"], "plant.mechanism: got desktop"),
    (["export", "nowhere.nc"], "nowhere.nc"),
    (["live", "--demo", "--learned", "a.npz"], "--learned: got a.npz without --learn; expected"),
    (["live", "--demo", "--mirror", "x"], "--mirror: got 'x'; expected HOST:PORT"),
    (["export"], "FILE"),
    (["export-c", "."], "scenario: got '.', a folder without scenario.yaml; expected one of desk"),
    (["export-c", "./"], "scenario: got './', a folder without scenario.yaml; expected a file, or"),
    (["export-c", "paper", "--out", ""], "--out: got ''; expected a value"),
]


@pytest.mark.parametrize(
    ("arguments", "said"), BAD_ARGUMENTS, ids=[" ".join(a)[:60] for a, _ in BAD_ARGUMENTS]
)
def test_a_bad_command_line(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert said in refusal(arguments, capsys)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize("command", WITH_OUT)
def test_a_place_that_cannot_be_written_is_refused_at_once(command, tmp_path, capsys):
    written(tmp_path / "file", "mine")
    os.symlink("loop", tmp_path / "loop")
    os.symlink("nowhere/at/all", tmp_path / "dangling")
    places = ["file", "file/below", "loop", "dangling", "n" * 300]
    # The kernel's own folders are closed to root as well.
    places = [str(tmp_path / place) for place in places] + ["/proc/new", "/dev/null"]
    before = tree(tmp_path)
    for place in places:
        said = refusal([*WITH_OUT[command], "--quiet", "--out", place], capsys)
        assert "--out: got " in said
    assert tree(tmp_path) == before


def test_the_option_or_argument_that_cannot_be_written_is_named(capsys):
    for given, name in (
        (("simulate", "paper", "--log", "/proc/new/log.csv"), "--log"),
        (("new", "/proc/new"), "DIR"),
    ):
        assert refusal([*given], capsys).startswith(f"error: {name}: got '/proc/new'; expected")


@pytest.mark.parametrize("command", WITH_OUT)
def test_bad_input_leaves_the_results_of_an_earlier_run_alone(command, tmp_path, capsys):
    """Neither a folder that is there nor one that is not is touched."""
    bad = written(tmp_path / "bad.yaml", "duration: -1\n")
    (tmp_path / "old").mkdir()
    for name in ("summary.json", "report.html", "signals.nc", "dataset.nc"):
        written(tmp_path / "old" / name, "of an earlier run")
    arguments = WITH_OUT[command]
    if command in ("check", "view"):
        arguments = ["model", command, str(bad)]
    elif command == "evaluate":
        arguments = [*arguments, "--scenario", str(bad)]
    else:
        number = 2 if arguments[0] in ("analyze", "tune") else 1
        arguments = [*arguments[:number], str(bad), *arguments[number:]]
    arguments = [word for word in arguments if word not in EXACT]
    before = tree(tmp_path)
    for place in ("old", "new/below"):
        assert "bad.yaml" in refusal([*arguments, "--out", str(tmp_path / place)], capsys)
    assert tree(tmp_path) == before


def test_two_commands_do_not_write_into_one_directory(tmp_path, capsys):
    written(tmp_path / "summary.json", "of the other")
    before = tree(tmp_path)
    other = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(other, fcntl.LOCK_EX)
        for command in ("simulate", "workspace", "dataset"):
            arguments = [*WITH_OUT[command], "--quiet", "--out", str(tmp_path)]
            assert main(arguments) == 2
            err = capsys.readouterr().err
            assert "where another command is writing; wait for it to end" in err
            assert err.count("\n") == 1
            assert tree(tmp_path) == before
    finally:
        os.close(other)
    assert main(["model", "check", "paper", "--quiet", "--out", str(tmp_path)]) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
def test_standard_output_that_is_full_is_one_line(capsys, monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert main(["model", "sdf", "paper"]) == 2
        monkeypatch.undo()
        full.close = lambda: None
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "No space left on device (standard output" in said
