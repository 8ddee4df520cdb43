"""How far a command has got: bars on a terminal, plain lines elsewhere."""

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stewart_drake.reporting import terminal

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(autouse=True)
def often(monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 0.05)


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


def test_quiet_is_quiet(capsys):
    with terminal.count_bar("a", True), terminal.progress_bars(["a"], 1.0, True):
        time.sleep(0.3)
    assert capsys.readouterr().err == ""


def test_a_closed_stderr_costs_nothing():
    script = "with t.count_bar('runs', False) as show:\n    show(0, 3)\n    time.sleep(0.3)\n"
    lines = (
        f"import time\nfrom stewart_drake.reporting import terminal as t\nt.EVERY = 0.05\n{script}"
    )
    shell = f'{sys.executable} -c "$0" 2>&-'
    done = subprocess.run(
        ["bash", "-c", shell, lines + "print('done')"], capture_output=True, cwd=ROOT
    )
    assert (done.returncode, done.stdout) == (0, b"done\n")
