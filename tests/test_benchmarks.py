"""The scripts of benchmarks/ still find what they measure; their figures are no matter of tests."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module(name)


@pytest.fixture(autouse=True)
def only_here():
    """Modules of such general names do not stay."""
    before = set(sys.modules)
    yield
    for name in {path.stem for path in FOLDER.glob("*.py")} - before:
        sys.modules.pop(name, None)


@pytest.mark.parametrize("name", [path.stem for path in sorted(FOLDER.glob("[a-z]*.py"))])
def test_a_script_finds_what_it_imports(name, monkeypatch):
    if name in ("plants", "speed", "mujoco_model"):
        pytest.importorskip("mujoco")
    assert script(name, monkeypatch).__doc__


def test_every_part_of_a_step_is_timed(monkeypatch):
    """By the law in Python; of the two ways to observe, each estimator has one."""
    steps = script("controller_step", monkeypatch)
    monkeypatch.setattr(steps, "RUNS", 1)
    monkeypatch.setattr(steps, "SCENARIOS", {"paper": ["duration=1.5"]})
    for rows, blanks in zip(steps.steps(), (0, 1), strict=True):
        assert len(rows) == 2
        for row in rows:
            assert row.count("") == blanks
            assert all(float(value) > 0 for value in row[2:] if value)


def test_one_evaluation_is_timed(monkeypatch):
    steps = script("controller_step", monkeypatch)
    monkeypatch.setattr(steps, "REPEATS", 1)
    rows = steps.evaluations()
    assert len(rows) == 4 and all(float(value.split()[0]) > 0 for _, value in rows)
