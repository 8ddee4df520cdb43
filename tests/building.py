"""`make` in exported folders. Objects are compiled once a session: most exports share most of them.

Workers of pytest-xdist inherit the folder of the objects from the process that starts them.
"""

import atexit
import os
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from stewart_drake.core import build

SANITIZED = ["-O1", "-g1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
"""Options of `make check` in an exported folder."""

if "STEWART_OBJECTS" not in os.environ:
    os.environ["STEWART_OBJECTS"] = tempfile.mkdtemp(prefix="objects")
    atexit.register(shutil.rmtree, os.environ["STEWART_OBJECTS"], ignore_errors=True)


def c_compiler():
    """Return the command of the C compiler; skip the test where it or `make` is missing."""
    found = build.compiler()
    if found is None or shutil.which("make") is None:
        pytest.skip("there is no C compiler, or no make")
    return found


def keeping_objects():
    """Return variables of the environment for a compiler that compiles no object again."""
    kept = shlex.quote(str(Path(__file__).with_name("cached_cc.sh")))
    return {"REAL_CC": " ".join(c_compiler()), "CC": kept}


def make(folder, *arguments, fails=False):
    """Return what `make` prints; it must succeed, or fail. Runs are replayed twice."""
    surroundings = os.environ | keeping_objects() | {"CFLAGS": "-O2 -DREPEATS=2"}
    command = ["make", "-s", *arguments]
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True)
    assert (done.returncode != 0) == fails, done.stdout + done.stderr
    return done.stdout
