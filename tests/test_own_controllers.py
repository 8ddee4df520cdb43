"""`compare` with controllers of a script, a notebook and a module; jobs that cannot be sent."""

import os
import subprocess
import sys

import pytest
from pydrake.systems.framework import LeafSystem

from stewart_drake.studies.jobs import run_jobs
from tests.test_jobs import ROOT, SETTINGS, contents

CLASS = '''
from pydrake.systems.framework import LeafSystem

import stewart_drake as sd


class Steady(LeafSystem):
    """A controller with one constant torque."""

    def __init__(self, torque=0.0):
        super().__init__()
        self.torque = torque
        self.DeclareVectorInputPort("measurement", 12)
        self.DeclareVectorOutputPort("torque", 6, self.calc)

    def calc(self, context, output):
        output.SetFromVector([self.torque] * 6)


class Broken(Steady):
    def calc(self, context, output):
        raise KeyError("no gain")
'''
COMPARE = """
import pydrake.systems.primitives as blocks

SHORT = ("plant.kind=exact", "duration=0.1")
own = {"class": Steady, "a lambda": lambda: Steady(1e-3)}
results = sd.compare("paper", SHORT, controllers=own)
assert list(results)[5:] == list(own) and len(results) == 7, results
for name, torque in (("class", 0.0), ("a lambda", 1e-3)):
    commanded = results[name].signals.torque_commanded
    assert float(abs(commanded - torque).max()) < 1e-15, name
    assert results[name].summary["own"] == {"controller": "Steady"}
try:
    sd.compare("paper", SHORT, controllers={"broken": Broken})
except KeyError as error:
    assert error.args == ("no gain",) and any("broken" in note for note in error.__notes__)
    print("told")
"""


def run(workers, *arguments, folder):
    """Return the output of another Python process on this number of cores."""
    surroundings = os.environ | {"LOKY_MAX_CPU_COUNT": str(workers), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, env=surroundings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_own_controllers_are_compared(tmp_path):
    """Those of a script, of a notebook and of a module.

    The first ended in "a worker process was killed, perhaps for want of memory". Cells of a
    notebook are executed in __main__, with no file.
    """
    (tmp_path / "parts.py").write_text(CLASS)
    cells = f"for cell in ({CLASS!r}, {COMPARE!r}):\n    exec(cell, globals())\n"
    module = "from parts import Broken, Steady\n" + COMPARE
    (tmp_path / "mine.py").write_text(CLASS + COMPARE + cells + module)
    assert run(2, "mine.py", folder=tmp_path) == 3 * "told\n"


# ---------------------------------------------------------------- jobs that cannot be sent


def system_of_a_script():
    """Return a class that cloudpickle sends by its contents."""
    names = {"__name__": "__main__", "LeafSystem": LeafSystem}
    exec("class Mine(LeafSystem):\n    pass", names)
    made = names["Mine"]
    assert isinstance(made, type)
    return made


class Unreadable:
    def __reduce__(self):
        return refused, ("by whoever reads it",)


class Unwritable:
    def __reduce__(self):
        raise OSError("not for others")


def refused(what):
    raise RuntimeError(what)


def told(number, thing=None):
    return f"{number} {type(thing).__name__} {os.getpid()}".encode()


@pytest.mark.parametrize("workers", [1, 2])
def test_what_no_process_can_read_runs_in_this_one(workers, tmp_path):
    things = [None, system_of_a_script(), Unreadable(), Unwritable(), 4, 5]
    jobs = {f"job{i}": (i, thing) for i, thing in enumerate(things)}
    run_jobs(jobs, told, tmp_path, settings=SETTINGS, workers=workers, suffix=".txt")
    for i, thing in enumerate(things):
        number, name, process = contents(tmp_path)[f"job{i}.txt"].decode().split()
        here = workers == 1 or i in (1, 2, 3)
        assert (number, name) == (str(i), type(thing).__name__)
        assert (int(process) == os.getpid()) == here


class Odd(Exception):
    """One that pickle writes and cannot read."""

    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")


def fails(number, how):
    if how == "odd":
        raise Odd(1, 2)
    if how == "exit":
        raise SystemExit("Drake says no")
    raise ZeroDivisionError("by nothing")


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize(
    ("how", "kind", "message"),
    [
        ("plain", ZeroDivisionError, "by nothing"),
        ("odd", (Odd, RuntimeError), "(Odd: )?1 and 2"),
        ("exit", SystemExit, "Drake says no"),
    ],
)
def test_an_exception_of_a_job_is_reported_as_it_is(how, kind, message, workers, tmp_path):
    """The odd one was taken for a killed worker."""
    jobs = {"first": (0, how), "second": (1, how)}
    with pytest.raises(kind, match=rf"^{message}\nraised by the job (first|second)$"):
        run_jobs(jobs, fails, tmp_path, settings=SETTINGS, workers=workers)
