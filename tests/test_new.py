"""new: a machine, a scenario and a first look from a few measurements."""

import json

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main, model
from stewart_drake.mechanism.kinematics import leg_geometry
from tests.screen import too_long

MEASURED = {
    "base-radius": 0.2,
    "shaft-distance": 0.13,
    "plate-radius": 0.11,
    "joint-distance": 0.06,
    "crank": 0.05,
    "rod": 0.26,
    "plate-mass": 2.5,
    "crank-mass": 0.06,
    "rod-mass": 0.05,
}


def flags(**other):
    given = MEASURED | {name.replace("_", "-"): value for name, value in other.items()}
    return [f"--{name}={value}" for name, value in given.items() if value is not None]


def made(folder, **other):
    assert main(["new", str(folder), *flags(**other), "--quiet"]) == 0
    return sd.load_mechanism(folder / "machine.yaml")


@pytest.mark.parametrize("cranks", ["apart", "together"])
def test_the_machine_is_as_it_was_measured(cranks, tmp_path):
    machine = made(tmp_path / "mine", cranks=cranks, upright=80, shaft_height=0.03)
    assert machine.name == "mine"
    shafts, joints = machine.p_WS, machine.p_PQ
    np.testing.assert_allclose(np.linalg.norm(shafts[:, :2], axis=1), 0.2, rtol=1e-9)
    np.testing.assert_allclose(shafts[:, 2], 0.03)
    apart = np.linalg.norm(shafts[::2] - shafts[1::2], axis=1)
    np.testing.assert_allclose(apart, 0.13, rtol=1e-5)
    between = np.linalg.norm(joints[:, None] - joints, axis=2)
    np.testing.assert_allclose(np.sort(between, axis=1)[:, 1], 0.06, rtol=1e-5)
    legs = leg_geometry(machine, machine.home)
    tips = shafts + 0.05 * legs.crank
    beside = np.linalg.norm(tips[::2] - tips[1::2], axis=1)
    assert np.all(beside > apart + 0.05 if cranks == "apart" else beside < apart - 0.05)


def test_no_other_height_gives_the_rods_a_better_push(tmp_path):
    machine = made(tmp_path)

    def push(z):
        pose = np.array([0, 0, 0, 0, 0, z])
        return float(np.abs(leg_geometry(machine, pose).transmission).min())

    others = [push(z) for z in np.linspace(machine.home[5] - 0.04, machine.home[5] + 0.04, 81)]
    assert push(machine.home[5]) >= max(others) - 1e-4


def test_what_it_proposes_runs(tmp_path, capsys):
    assert main(["new", str(tmp_path), *flags(torque_limit=2.0, delay=0.05)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("yes: ") and not too_long(said)
    assert "(estimated: uniform disc)" in said and "the motors have 2" in said
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["inertia_estimated"] == ["base", "plate", "crank", "rod"]
    scenario = sd.load_scenario(tmp_path / "scenario.yaml")
    assert scenario.true_delay.eta(scenario.controller.period) == pytest.approx(0.05)
    result = sd.simulate(scenario)
    assert result.status == "completed" and result.summary["accumulated_error"] < 0.1
    assert summary["peak_torque"] == pytest.approx(result.summary["peak_torque"], rel=0.05)


def test_what_is_wrong_is_said_in_a_line_and_nothing_is_left(tmp_path, capsys):
    for other, words in (
        ({"rod": 260}, "--rod: got 260 m; expected metres, 0.26 for 260 mm"),
        ({"rod": 0.06}, "reach the plate"),
        ({"crank": 0.3}, "--rod: got 0.26 m with cranks of 0.3 m; expected a rod longer"),
        ({"rod": float("nan")}, "--rod: got nan; expected a finite number"),
        ({"crank_mass": -1}, "--crank-mass: got -1.0; expected greater than 0"),
        ({"shaft_distance": 0.35}, "--shaft-distance: got 0.35 m on a circle of radius 0.2 m"),
        ({"delay": -1}, "--delay: got -1.0; expected greater than or equal to 0"),
        ({"torque_limit": 0}, "--torque-limit: got 0.0; expected greater than 0"),
        ({"rod": None, "plate_mass": None}, "got no --rod, --plate-mass;"),
        ({"plate_mass": 2500}, "plate-mass: got 2500 kg; expected kilograms, 2.5 for 2500 g"),
        ({"cranks": "up"}, "--cranks"),
    ):
        assert main(["new", str(tmp_path / "mine"), *flags(**other)]) == 2
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
        assert not (tmp_path / "mine").exists()
    made(tmp_path)
    before = (tmp_path / "machine.yaml").read_bytes()
    assert main(["new", str(tmp_path), *flags(rod=0.3)]) == 2
    assert "machine.yaml: already exists" in capsys.readouterr().err
    # Before anything is asked for.
    assert main(["new", str(tmp_path)]) == 2
    assert "machine.yaml: already exists" in capsys.readouterr().err
    assert (tmp_path / "machine.yaml").read_bytes() == before


def test_what_is_missing_is_asked_for_and_millimetres_are_noticed(tmp_path, monkeypatch):
    answers, agreed = iter([270.0, 260.0, 2.5]), list[str]()

    def agree(text, **_):
        agreed.append(text)
        return len(agreed) > 1  # no: it is asked for again

    monkeypatch.setattr(model.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(model.typer, "prompt", lambda *_, **__: next(answers))
    monkeypatch.setattr(model.typer, "confirm", agree)
    assert main(["new", str(tmp_path), *flags(rod=None, plate_mass=None)]) == 0
    assert agreed == ["270 m? 0.27 m for 270 mm", "260 m? 0.26 m for 260 mm"]
    assert sd.load_mechanism(tmp_path / "machine.yaml").rod_lengths[0] == 0.26
