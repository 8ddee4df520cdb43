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
from stewart_drake.studies.compare import CONTROLLERS, LABELS
from tests.screen import said, summary_in

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


# ---------------------------------------------------------------- simulate and compare


def test_simulate_prints_a_verdict_and_a_table_and_writes_everything(tmp_path, capsys):
    out = said(capsys, "simulate", *SHORT, "--out", tmp_path)
    lines = out.splitlines()
    assert lines[0].startswith("this loop is stable: linearised along the reference")
    assert "the delay of 0.8 s (8 periods) can be compensated: under any controller" in " ".join(
        lines
    )
    errors = "E_ac", "floor", "peak error", "rms error"
    for word in ("completed", *errors, "torque", "controller step", "wall"):
        assert word in out
    assert files(tmp_path) == RUN_FILES | {"parameters.png", "parameters.svg"}
    assert summary_in(tmp_path)["status"] == "completed"
    with xr.open_dataset(tmp_path / "signals.nc") as signals:
        assert signals.time.values[-1] == 0.5


def test_json_is_all_there_is_on_stdout_and_quiet_prints_nothing(capsys):
    assert main(["simulate", "--controller", "lqr", *EXACT, "--json"]) == 0
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert err == ""
    assert summary["status"] == "left_workspace" and summary["accumulated_error"] is None
    assert summary["failure"]["leg"] in range(1, 7) and 0.8 < summary["failure"]["time"] < 2.0
    assert main(["simulate", "--controller", "lqr", *SHORT, "--quiet"]) == 0
    assert capsys.readouterr() == ("", "")


def test_compare_prints_table_ii_and_writes_everything(tmp_path, capsys):
    (tmp_path / "summary.json").write_text("of an earlier run")
    out = said(capsys, "compare", *EXACT, "--out", tmp_path)
    lines = out.splitlines()
    rows = [next(line for line in lines if line.startswith(f"{n} ")) for n in CONTROLLERS]
    assert all(f"{n} {LABELS[n]}" in " ".join(out.split()) for n in CONTROLLERS)
    second, third = lines[lines.index(rows[0]) + 1 :][:2]
    assert "left workspace" in rows[0] and "at 1.36 s," in second and "leg 2" in third
    assert [row.split()[1] for row in rows] == ["NaN", "NaN", "225", "80", "-"]
    assert rows[-1].split()[3:7] == ["15.2", "roll", "36", "%"], "floor and worst beside E_ac"
    heads = next(line for line in lines if "applied var." in line)
    assert heads.split()[-3:] == ["sent", "applied", "var."] and "Sent, applied" in out
    # The LQI asked for a torque that never acted: the plate was gone before it arrived.
    assert [float(x) for x in rows[3].split()[-3:-1]] == [1.7, 0.13]
    torques = {f"torques_{name}" for name in CONTROLLERS}
    assert files(tmp_path) == {
        *(f"{n}.{s}" for n in {"states", "errors", *torques} for s in ("png", "svg")),
        *(f"{name}.nc" for name in CONTROLLERS),
        "summary.json",
    }
    summary = summary_in(tmp_path)["controllers"]
    assert list(summary) == list(CONTROLLERS) and summary["lqr"]["failure"]["leg"] == 2


# ---------------------------------------------------------------- Ctrl-C


WITHOUT_FIGURES = (
    "import sys, pytest; from tests.shorter import leave_blank; from stewart_drake import __main__;"
    "leave_blank(pytest.MonkeyPatch()); sys.exit(__main__.run())"
)


def interrupted(arguments, wait, group, code=WITHOUT_FIGURES, number=signal.SIGINT):
    """Exit status and stderr of a command that gets a signal some time after its first line.

    Without the lines of progress that a busy machine gives it time for.
    """
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=ROOT,
    )
    assert process.stdout is not None
    assert process.stdout.readline()  # the verdict: it has begun
    time.sleep(wait)
    # A terminal and `timeout` send it to the whole group, `kill -INT` to one process.
    (os.killpg if group else os.kill)(process.pid, number)
    _, err = process.communicate(timeout=180)  # figures of all runs, on a busy machine
    assert "Traceback" not in err
    kept = [line for line in err.splitlines() if not re.search(r", after \d+ s$", line)]
    return process.returncode, "\n".join(kept)


ENDINGS = pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)]
)


@pytest.mark.slow
@ENDINGS
def test_ctrl_c_in_simulate_keeps_what_was_computed(tmp_path, number, status):
    settings = ("--set", "controller.period=0.02", "--set", "delay.steps=4")
    arguments = ["simulate", "paper", *MULTIBODY, "--set", "duration=200", *settings]
    arguments += ["--out", str(tmp_path)]
    assert interrupted(arguments, wait=3.0, group=False, number=number) == (status, "")
    assert files(tmp_path) >= RUN_FILES
    summary = summary_in(tmp_path)
    assert summary["status"] == summary["failure"]["reason"] == "interrupted"
    with xr.open_dataset(tmp_path / "signals.nc") as signals:
        assert 0 < signals.sizes["time"] < 10_001
        assert np.isfinite(signals.pose.values).all()


STOPPED = "stopped before the end; files that were written are kept"


@pytest.mark.slow
def test_ctrl_c_in_report_writes_nothing(tmp_path):
    code = (
        "import sys, stewart_drake.loop.simulation; from stewart_drake.cli import main;"
        "print('ready', flush=True); sys.exit(main(sys.argv[1:]))"
    )
    arguments = ["report", *EXACT, "--set", "duration=2.0", "--out", str(tmp_path)]
    assert interrupted(arguments, wait=2.0, group=True, code=code) == (130, STOPPED)
    assert not files(tmp_path)


def test_ctrl_c_that_a_command_does_not_report_is_reported(monkeypatch, capsys):
    def interrupted(kind):
        raise KeyboardInterrupt

    monkeypatch.setattr("stewart_drake.reporting.terminal.shipped_table", interrupted)
    assert main(["list"]) == 130
    assert capsys.readouterr().err == f"{STOPPED}\n"


def test_after_the_command_a_signal_ends_the_process_without_a_traceback():
    code = """
import signal, sys
from stewart_drake.__main__ import run

sys.argv[1:] = ["--version"]
run()
assert signal.getsignal(signal.SIGINT) == signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_ctrl_c_while_drake_is_loaded_is_one_as_well(monkeypatch):
    """A C++ module whose loading is interrupted says so by an ImportError."""
    stop = KeyboardInterrupt()

    def loading(kind):
        raise ImportError("initialization failed") from stop

    monkeypatch.setattr("stewart_drake.reporting.terminal.shipped_table", loading)
    assert main(["list"]) == 130
    inner = ImportError("initialization failed")
    inner.__cause__, stop = stop, inner  # a module that was loading another
    assert main(["list"]) == 130
    inner.__cause__ = None
    with pytest.raises(ImportError):
        main(["list"])
    stop = None
    with pytest.raises(ImportError):
        main(["list"])


@pytest.mark.slow
@ENDINGS
def test_ctrl_c_in_compare_reaches_the_processes_in_an_orderly_way(tmp_path, number, status):
    # Early, when they are still importing: there a signal of their own would break them.
    arguments = ["compare", "paper", *MULTIBODY, "--set", "duration=40", "--out", str(tmp_path)]
    assert interrupted(arguments, wait=1.0, group=True, number=number) == (status, "")
    for name, run in summary_in(tmp_path)["controllers"].items():
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


def test_an_interrupt_while_the_command_is_imported_shows_no_traceback():
    code = """
import os, signal, sys
from stewart_drake.__main__ import run

class Interrupt:
    def find_spec(self, name, *_):
        if name == "stewart_drake.cli.common":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
run()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


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
    out = said(capsys, "list")
    for kind in KINDS:
        for name in shipped(kind):
            assert any(line.split()[:1] == [name] for line in out.splitlines())
    # Networks of other inputs or faults are not described alike.
    assert "trained on faults N2" in out and "trained on faults T" in out
    assert out.count("18 densities") == 1
    assert "LQR that ignores the delay" in out


def test_model_sdf_is_the_models(tmp_path, capsys):
    text = to_sdformat(load_mechanism("paper"))
    assert main(["model", "sdf", "paper"]) == 0
    assert capsys.readouterr().out == text
    path = tmp_path / "new" / "paper.sdf"
    assert "paper.sdf" in said(capsys, "model", "sdf", "paper", "--out", path)
    assert path.read_text() == text


def test_a_reader_that_leaves_early_is_no_error():
    reader = f"{' '.join(map(repr, command('model', 'sdf', 'paper')))} | head -1"
    done = subprocess.run(["bash", "-o", "pipefail", "-c", reader], capture_output=True, text=True)
    assert done.stdout.startswith("<?xml") and done.stderr == ""


def test_colours_only_where_they_are_wanted(monkeypatch, capsys):
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
    err = capsys.readouterr().err
    lines = err.splitlines()
    assert lines[0] == "runs: preparing, after 0 s"
    assert any(re.fullmatch(r"runs: 40 of 200, after 0 s", line) for line in lines)
    # Twenty in 0.2 to 0.4 s leaves 1.4 to 2.8 s for 140; the forty of an earlier start took none.
    assert re.fullmatch(r"runs: 60 of 200, about [1-9] s left, after \d s", lines[-1]), err
    assert "\r" not in err and "\x1b" not in err


@pytest.mark.usefixtures("often")
def test_the_time_left_follows_runs_that_become_slower(capsys):
    with terminal.count_bar("runs", False) as show:
        for done in range(9):  # of a fast controller; the second one takes 0.5 s a run
            show(done, 16)
        time.sleep(1.2)
    last = capsys.readouterr().err.splitlines()[-1]
    assert re.fullmatch(r"runs: 8 of 16, about [2-4] s left, after \d s", last), last


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
