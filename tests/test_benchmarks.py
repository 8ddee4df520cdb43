"""The scripts of benchmarks/ still find what they measure; their figures are no matter of tests."""

import importlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cloudpickle
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


def sent(path: Path) -> set[str]:
    """Names of the functions that a script hands to `delayed`."""
    return set(re.findall(r"\bdelayed\(([a-zA-Z_]+)\)", path.read_text(encoding="utf-8")))


def test_what_scripts_send_to_workers_can_be_read_there(monkeypatch, tmp_path):
    """A cached function of a script cannot: `identification.py` ended in BrokenProcessPool."""
    scripts = {path.stem: sent(path) for path in FOLDER.glob("[a-z]*.py")}
    scripts = {name: functions for name, functions in scripts.items() if functions}
    assert {"identification", "tracking", "table2"} <= set(scripts)
    code = (
        "import pickle, sys; from pathlib import Path; packed = Path(sys.argv[1]).read_bytes()\n"
        "sys.modules[Path(sys.argv[1]).name] = None; pickle.loads(packed)"
    )
    for name, functions in scripts.items():
        module = script(name, monkeypatch)
        # As joblib sends what a script defines, which is a __main__ that a worker has not.
        cloudpickle.register_pickle_by_value(module)
        packed = cloudpickle.dumps([vars(module).get(one) for one in functions])
        cloudpickle.unregister_pickle_by_value(module)
        (tmp_path / name).write_bytes(packed)
        command = [sys.executable, "-c", code, str(tmp_path / name)]
        surroundings = os.environ | {"PYTHONPATH": f"{FOLDER.parent}:{FOLDER}"}
        done = subprocess.run(command, env=surroundings, capture_output=True, text=True)
        assert done.returncode == 0, f"{name}: {done.stderr}"


def test_every_script_shares_one_place_for_its_page_and_one_way_to_be_quick():
    """`make bench QUICK=1` runs all of them at the least size, and overwrites no result."""
    for path in FOLDER.glob("[a-z]*.py"):
        text = path.read_text(encoding="utf-8")
        assert "RESULTS =" not in text, f"{path.name}: takes RESULTS of _page.py"
        for name in ("SEEDS", "MACHINES", "KILLS", "RUNS"):
            assert f'environ.get("{name}"' not in text, f"{path.name}: takes size() of _page.py"


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


def test_every_claim_has_a_name_and_settings_that_load(monkeypatch, tmp_path):
    claims = script("claims", monkeypatch)
    rows = [row for make in claims.SECTIONS.values() for row in make()]
    assert len({row.name for row in rows}) == len(rows) > 200
    for row in rows:
        claims.scenario_of(row, claims.SEEDS[0], str(tmp_path))


def test_the_table_of_claims_has_all_rows_as_they_are(monkeypatch):
    claims = script("claims", monkeypatch)
    data, rows = json.loads(claims.DATA.read_text("utf-8")), claims.chosen_rows([])
    assert set(data["rows"]) == set(rows) and set(data["studies"]) == set(claims.STUDIES)
    for name, row in rows.items():
        found = data["rows"][name]
        assert found["settings"] == claims.described(row)
        assert len(found["E_ac"]) == (len(claims.SEEDS) if row.drawn else 1)
        assert found["E_ac"].count(None) == len(found["lost_at"])
    assert "\n".join(claims.page(data)) in claims.DATA.with_suffix(".md").read_text("utf-8")


def test_a_bias_of_the_claims_has_random_signs(monkeypatch, tmp_path):
    claims = script("claims", monkeypatch)
    row = claims.chosen_rows(["bias-noise"])["bias-noise"]
    scenarios = [claims.scenario_of(row, seed, str(tmp_path)) for seed in claims.SEEDS]
    biases = {tuple(scenario.plant.torque_bias) for scenario in scenarios}
    assert len(biases) > 10 and all(abs(b) == 3e-4 for bias in biases for b in bias)
    assert len({scenario.sensor.seed for scenario in scenarios}) == len(claims.SEEDS) == 20


def test_a_row_counts_lost_runs(monkeypatch):
    claims = script("claims", monkeypatch)
    found = {"E_ac": [1.0, None, 3.0], "lost_at": [1.234]}
    assert claims.numbers(found) == ["3", "3", "2", "1.4", "3", "1, from 1.23 s on"]
    found = {"E_ac": [None, None, 3.0], "lost_at": [2.0, 1.5]}
    assert claims.numbers(found) == ["3", "lost", "3", "-", "3", "2, from 1.50 s on"]


def test_a_push_of_the_claims_moves_the_plate(monkeypatch):
    claims = script("claims", monkeypatch)
    short = (*claims.ON, "duration=1.5")
    calm = claims.Row("calm", "", short)
    pushed = claims.Row("pushed", "", short, force=0.05, span=(0.5, 9.0))
    (clean, _), (moved, _) = claims.run(calm, 0), claims.run(pushed, 0)
    assert moved > 10 * clean
