"""The scripts of benchmarks/ still find what they measure; their figures are no matter of tests."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cloudpickle
import pytest

FOLDER = Path(__file__).parents[1] / "benchmarks"


def script(name, monkeypatch):
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
    if name in ("plants", "speed", "mujoco_model", "reachy_player"):
        pytest.importorskip("mujoco")
    assert script(name, monkeypatch).__doc__


def sent(path):
    """Names of the functions that a script hands to workers."""
    text = path.read_text(encoding="utf-8")
    return set(re.findall(r"\b(?:delayed|in_parallel|grouped)\(\s*([a-zA-Z_]+)[,)]", text))


def test_what_scripts_send_to_workers_can_be_read_there(monkeypatch, tmp_path):
    """A cached function of a script cannot: `identification.py` ended in BrokenProcessPool."""
    scripts = {path.stem: sent(path) for path in FOLDER.glob("[a-z]*.py")}
    scripts = {name: functions for name, functions in scripts.items() if functions}
    assert {"identification", "tracking", "table2"} <= set(scripts)
    code = (
        "import pickle, sys; from pathlib import Path\n"
        "for path in map(Path, sys.argv[1:]):\n"
        "    sys.modules[path.name] = None\n"
        "    pickle.loads(path.read_bytes())\n"
        "    del sys.modules[path.name]"
    )
    for name, functions in scripts.items():
        module = script(name, monkeypatch)
        # As joblib sends what a script defines, which is a __main__ that a worker has not.
        cloudpickle.register_pickle_by_value(module)
        packed = cloudpickle.dumps([vars(module).get(one) for one in functions])
        cloudpickle.unregister_pickle_by_value(module)
        (tmp_path / name).write_bytes(packed)
    command = [sys.executable, "-c", code, *(str(tmp_path / name) for name in scripts)]
    surroundings = os.environ | {"PYTHONPATH": f"{FOLDER.parent}:{FOLDER}"}
    done = subprocess.run(command, env=surroundings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_every_part_of_a_step_and_one_evaluation_are_timed(monkeypatch):
    """The law runs in Python."""
    steps = script("controller_step", monkeypatch)
    for name, value in {"RUNS": 1, "SCENARIOS": {"paper": ["duration=1.5"]}, "REPEATS": 1}.items():
        monkeypatch.setattr(steps, name, value)
    for rows in steps.steps():
        assert len(rows) == 2
        assert all(float(value) > 0 for row in rows for value in row[2:])
    rows = steps.evaluations()
    assert len(rows) == 4 and all(float(value.split()[0]) > 0 for _, value in rows)


def test_the_table_of_claims_has_all_rows_as_they_are_and_their_settings_load(
    monkeypatch, tmp_path
):
    claims = script("claims", monkeypatch)
    made = [row for make in claims.SECTIONS.values() for row in make()]
    assert len({row.name for row in made}) == len(made) > 200
    for row in made:
        claims.scenario_of(row, claims.SEEDS[0], str(tmp_path))
    data, rows = json.loads(claims.DATA.read_text("utf-8")), claims.chosen_rows([])
    assert set(data["rows"]) == set(rows) and set(data["studies"]) == set(claims.STUDIES)
    for name, row in rows.items():
        found = data["rows"][name]
        assert found["settings"] == claims.described(row)
        assert len(found["E_ac"]) == (len(claims.SEEDS) if row.drawn else 1)
        assert found["E_ac"].count(None) == len(found["lost_at"])
    assert "\n".join(claims.page(data)) in claims.DATA.with_suffix(".md").read_text("utf-8")
