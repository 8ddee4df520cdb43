"""How far a command has got: bars on a terminal, plain lines elsewhere."""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def said_by(script: str, stderr: int | None = subprocess.PIPE) -> str:
    """What a few lines of Python print to stderr."""
    lines = (
        f"import time\nfrom stewart_drake.reporting import terminal as t\nt.EVERY = 0.05\n{script}"
    )
    done = subprocess.run(
        [sys.executable, "-c", lines], stderr=stderr, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return done.stderr or ""


def test_a_pipe_gets_a_line_now_and_then():
    said = said_by(
        "with t.count_bar('runs', False) as show:\n"
        "    time.sleep(0.12)\n    show(40, 200)\n    time.sleep(0.2)\n"
        "    show(60, 200)\n    time.sleep(0.2)\n"
    )
    lines = said.splitlines()
    assert lines[0] == "runs: preparing, after 0 s"
    assert any(re.fullmatch(r"runs: 40 of 200, after 0 s", line) for line in lines)
    # Twenty in 0.2 to 0.4 s leaves 1.4 to 2.8 s for 140; the forty of an earlier start took none.
    assert re.fullmatch(r"runs: 60 of 200, about [1-9] s left, after \d s", lines[-1]), said
    assert "\r" not in said and "\x1b" not in said


def test_simulations_tell_their_time():
    said = said_by(
        "with t.progress_bars(['lqr', 'lqi'], 20.0, False) as show:\n"
        "    time.sleep(0.12)\n    show['lqr'](1.5, 0.1)\n    time.sleep(0.12)\n"
        "    show['lqi'](2.0, 0.1)\n    time.sleep(0.12)\n"
    )
    lines = said.splitlines()
    assert lines[0] == "lqr, lqi: preparing, after 0 s"
    assert "lqr 1.5 of 20 s, after 0 s" in lines and "lqr 1.5, lqi 2.0 of 20 s" in lines[-1]


def test_quiet_is_quiet():
    for_both = "with t.count_bar('a', True), t.progress_bars(['a'], 1.0, True):\n"
    assert said_by(f"{for_both}    time.sleep(0.3)\n") == ""


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
