"""A report that is stopped in the middle, by Ctrl-C or kill -9, leaves no half file."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from stewart_drake.cli import main

SETTINGS = ("--set", "plant.kind=exact", "--set", "duration=2.0")


def started(code, folder):
    return subprocess.Popen(
        [sys.executable, "-c", code, str(folder)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        cwd=Path(__file__).parents[1],
    )


@pytest.mark.slow
def test_ctrl_c_ends_it_with_nothing_written(tmp_path):
    code = (
        "import sys, stewart_drake.loop.simulation; from stewart_drake.cli import main;"
        "print('ready', file=sys.stderr, flush=True);"
        f"sys.exit(main(['report', *{SETTINGS!r}, '--out', sys.argv[1]]))"
    )
    process = started(code, tmp_path)
    assert process.stderr is not None and process.stderr.readline() == "ready\n"
    time.sleep(2.0)
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    assert os.listdir(tmp_path) == []


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
