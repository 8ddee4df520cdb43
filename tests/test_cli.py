"""The command: what it prints and writes, and how it refuses bad input."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from stewart_drake.cli import main
from stewart_drake.files.resources import KINDS, shipped
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.reporting import terminal
from stewart_drake.reporting.document import number
from stewart_drake.studies.compare import CONTROLLERS, LABELS
from tests.screen import too_long

pytestmark = pytest.mark.usefixtures("blank_figures")

EXACT = ("--set", "plant.kind=exact")
MULTIBODY = ("--set", "plant.kind=multibody")
"""Slow enough to be interrupted: 200 s of it take forty, of the exact plant one or two."""
SHORT = (*EXACT, "--set", "duration=0.5")
RUN_FILES = {
    *(f"{name}.{suffix}" for name in ("states", "errors", "torques") for suffix in ("png", "svg")),
    "signals.nc",
    "summary.json",
}


def command(*arguments):
    return [sys.executable, "-m", "stewart_drake", *arguments]


def files(folder):
    return {path.name for path in folder.iterdir()}


# ---------------------------------------------------------------- bad input


# ---------------------------------------------------------------- simulate and compare


def test_simulate_prints_a_verdict_and_a_table_and_writes_everything(tmp_path, capsys):
    assert main(["simulate", *SHORT, "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert err == ""
    assert lines[0].startswith("this loop is stable: linearised along the reference")
    assert "the delay of 0.8 s can be compensated: under any controller" in " ".join(lines)
    assert not too_long(out)
    for word in ("completed", "E_ac", "floor", "peak error", "torque", "controller step", "wall"):
        assert word in out
    assert files(tmp_path) == RUN_FILES | {"parameters.png", "parameters.svg"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["status"] == "completed"
    with xr.open_dataset(tmp_path / "signals.nc") as signals:
        assert signals.time.values[-1] == 0.5


def test_json_is_all_there_is_on_stdout(capsys):
    assert main(["simulate", "--controller", "lqr", *EXACT, "--json"]) == 0
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert err == ""
    assert summary["status"] == "left_workspace" and summary["accumulated_error"] is None
    assert summary["failure"]["leg"] in range(1, 7) and 0.8 < summary["failure"]["time"] < 2.0


def test_quiet_prints_nothing(capsys):
    assert main(["simulate", "--controller", "lqr", *SHORT, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_compare_prints_table_ii_and_writes_everything(tmp_path, capsys):
    (tmp_path / "summary.json").write_text("of an earlier run")
    duration = ("--set", "duration=1.4")
    assert main(["compare", *EXACT, *duration, "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert err == ""
    assert not too_long(out)
    rows = [next(line for line in lines if line.startswith(f"{n} ")) for n in CONTROLLERS]
    assert all(f"{n} ({LABELS[n]})" in " ".join(out.split()) for n in CONTROLLERS)
    second, third = lines[lines.index(rows[0]) + 1 :][:2]
    assert "left workspace" in rows[0] and "at 1.36 s," in second and "leg 2" in third
    assert [row.split()[1] for row in rows] == ["NaN", "NaN", "225", "80", "-"]
    assert rows[-1].split()[3:7] == ["15.2", "roll", "36", "%"], "floor and worst beside E_ac"
    heads = next(line for line in lines if "asked" in line)
    assert heads.split()[-3:] == ["asked", "acted", "var."] and "(commanded)" in out
    # The LQI asked for a torque that never acted: the plate was gone before it arrived.
    assert [float(x) for x in rows[3].split()[-3:-1]] == [1.7, 0.13]
    torques = {f"torques_{name}" for name in ("delay_lqr", "delay_lqi", "predictor_lqi")}
    assert files(tmp_path) == {
        *(f"{n}.{s}" for n in {"states", "errors", *torques} for s in ("png", "svg")),
        *(f"{name}.nc" for name in CONTROLLERS),
        "summary.json",
    }
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary["controllers"]) == list(CONTROLLERS)
    assert summary["controllers"]["lqr"]["failure"]["leg"] == 2


# ---------------------------------------------------------------- Ctrl-C


WITHOUT_FIGURES = (
    "import sys, pytest; from tests.shorter import leave_blank; from stewart_drake.cli import main;"
    "leave_blank(pytest.MonkeyPatch()); sys.exit(main(sys.argv[1:]))"
)


def interrupted(arguments, wait, group):
    """Exit status and stderr of a command that gets Ctrl-C some time after its first line.

    Without the lines of progress that a busy machine gives it time for.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_FIGURES, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=ROOT,
    )
    assert process.stdout is not None
    assert process.stdout.readline()  # the verdict: it has begun
    time.sleep(wait)
    # A terminal sends it to the whole group, `kill -INT` to one process.
    (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=180)  # figures of all runs, on a busy machine
    said = [line for line in err.splitlines() if not re.search(r", after \d+ s$", line)]
    return process.returncode, "\n".join(said)


@pytest.mark.slow
def test_ctrl_c_in_simulate_keeps_what_was_computed(tmp_path):
    settings = ("--set", "controller.period=0.02", "--set", "delay.steps=4")
    arguments = ["simulate", "paper", *MULTIBODY, "--set", "duration=200", *settings]
    arguments += ["--out", str(tmp_path)]
    assert interrupted(arguments, wait=3.0, group=False) == (130, "")
    assert files(tmp_path) >= RUN_FILES
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["status"] == "interrupted"
    assert summary["failure"]["reason"] == "interrupted"
    with xr.open_dataset(tmp_path / "signals.nc") as signals:
        assert 0 < signals.sizes["time"] < 10_001
        assert np.isfinite(signals.pose.values).all()


@pytest.mark.slow
def test_ctrl_c_in_compare_reaches_the_processes_in_an_orderly_way(tmp_path):
    # Early, when they are still importing: there a signal of their own would break them.
    arguments = ["compare", "paper", *MULTIBODY, "--set", "duration=40", "--out", str(tmp_path)]
    assert interrupted(arguments, wait=1.0, group=True) == (130, "")
    summary = json.loads((tmp_path / "summary.json").read_text())["controllers"]
    for name, run in summary.items():
        assert run["status"] in ("interrupted", "left_workspace")
        assert f"{name}.nc" in files(tmp_path)
    assert not [name for name in files(tmp_path) if name.endswith(".part")]


# ---------------------------------------------------------------- the rest


def test_a_process_says_the_same(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("duration: 2021-05-30")
    done = subprocess.run(command("simulate", str(path)), capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {path}: duration: got '2021-05-30'; expected a number\n"


def test_help_comes_without_drake():
    code = (
        "import sys; from stewart_drake.cli import main; main(['--help']);"
        "sys.exit(any(name in sys.modules for name in ('pydrake', 'numpy', 'matplotlib')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in ("simulate", "compare", "list", "model"):
        assert name in done.stdout


def test_version_and_no_arguments(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("stewart-drake ")
    assert main([]) == 0
    assert capsys.readouterr().out.startswith("Usage: stewart-drake")


def test_list_describes_everything_shipped(capsys):
    assert main(["list"]) == 0
    out = capsys.readouterr().out
    assert not too_long(out)
    for kind in KINDS:
        for name in shipped(kind):
            assert any(line.split()[:1] == [name] for line in out.splitlines())
    assert "LQR that ignores the delay" in out


def test_model_sdf_is_the_models(tmp_path, capsys):
    text = to_sdformat(load_mechanism("paper"))
    assert main(["model", "sdf", "paper"]) == 0
    assert capsys.readouterr().out == text
    assert main(["model", "sdf", "paper", "--out", str(tmp_path / "new" / "paper.sdf")]) == 0
    assert "paper.sdf" in capsys.readouterr().out
    assert (tmp_path / "new" / "paper.sdf").read_text() == text


def test_a_reader_that_leaves_early_is_no_error():
    reader = f"{' '.join(map(repr, command('model', 'sdf', 'paper')))} | head -1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", reader], capture_output=True, text=True)
    assert done.stdout.startswith("<?xml") and done.stderr == ""


def test_colours_only_where_they_are_wanted(monkeypatch, capsys):
    from stewart_drake.reporting import terminal

    monkeypatch.setattr(terminal.sys.stdout, "isatty", lambda: True, raising=False)
    for no_color, expected in (("", True), ("1", False)):
        monkeypatch.setenv("NO_COLOR", no_color)
        terminal.echo("status completed")
        assert ("\x1b[32m" in capsys.readouterr().out) is expected


@pytest.mark.slow
def test_meshcat_replays_an_exact_run_and_leaves_a_file(tmp_path, capsys):
    settings = ("--set", "duration=0.2", "--quiet", "--meshcat", "--out", str(tmp_path))
    assert main(["simulate", *EXACT, *settings]) == 0
    assert (tmp_path / "replay.html").stat().st_size > 500_000  # the viewer itself is inside


ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 0.05)


@pytest.mark.usefixtures("often")
def test_a_pipe_gets_a_line_now_and_then(capsys):
    with terminal.count_bar("runs", False) as show:
        time.sleep(0.12)
        show(40, 200)
        time.sleep(0.2)
        show(60, 200)
        time.sleep(0.2)
    said = capsys.readouterr().err
    lines = said.splitlines()
    assert lines[0] == "runs: preparing, after 0 s"
    assert any(re.fullmatch(r"runs: 40 of 200, after 0 s", line) for line in lines)
    # Twenty in 0.2 to 0.4 s leaves 1.4 to 2.8 s for 140; the forty of an earlier start took none.
    assert re.fullmatch(r"runs: 60 of 200, about [1-9] s left, after \d s", lines[-1]), said
    assert "\r" not in said and "\x1b" not in said


def test_a_number_that_is_rounded_up_keeps_its_digits():
    assert [number(x) for x in (9.996, 99.96, -9.994, 0.0)] == ["10.0", "100", "-9.99", "0"]


def test_lines_of_progress_differ_for_ten_minutes():
    said = [terminal._duration(time) for time in (9.6, 61, 599, 601, 5400)]
    assert said == ["10 s", "1 min 1 s", "9 min 59 s", "10 min", "1.5 h"]


@pytest.mark.usefixtures("often")
def test_a_phase_is_shown(capsys):
    with terminal.phase_bar("identify", False) as show:
        time.sleep(0.12)
        show("start 2 of at most 4")
        time.sleep(0.12)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "identify: computing, after 0 s"
    assert lines[-1] == "identify: start 2 of at most 4, after 0 s"


@pytest.mark.usefixtures("often")
def test_simulations_tell_their_time(capsys):
    with terminal.progress_bars(["lqr", "lqi"], 20.0, False) as show:
        time.sleep(0.12)
        show["lqr"](1.5, 0.1)
        time.sleep(0.12)
        show["lqi"](2.0, 0.1)
        time.sleep(0.12)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "lqr, lqi: preparing, after 0 s"
    assert "lqr 1.5 of 20 s, after 0 s" in lines and "lqr 1.5, lqi 2.0 of 20 s" in lines[-1]


@pytest.mark.usefixtures("often")
def test_lines_of_many_runs_fit_a_terminal(capsys):
    names = [f"controller_{k}" for k in range(9)]
    with terminal.progress_bars(names, 2.0, False) as show:
        for name in names:
            show[name](1.5, 0.1)
        time.sleep(0.12)
    said = capsys.readouterr().err
    assert "controller_8 1.5 of 2 s" in " ".join(said.split())
    assert max(map(len, said.splitlines())) <= 80


@pytest.mark.usefixtures("often")
def test_quiet_is_quiet(capsys):
    with terminal.count_bar("a", True), terminal.progress_bars(["a"], 1.0, True):
        time.sleep(0.3)
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("often")
def test_a_closed_stderr_costs_nothing():
    script = "with t.count_bar('runs', False) as show:\n    show(0, 3)\n    time.sleep(0.3)\n"
    lines = (
        f"import time\nfrom stewart_drake.reporting import terminal as t\nt.EVERY = 0.05\n{script}"
    )
    shell = f'"{sys.executable}" -c "$0" 2>&-'
    done = subprocess.run(
        ["bash", "-c", shell, lines + "print('done')"], capture_output=True, cwd=ROOT
    )
    assert (done.returncode, done.stdout) == (0, b"done\n")
