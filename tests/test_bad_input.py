"""Every field of every file, wrong in every way: one line that names it, and nothing written.

The cases come from the dataclasses, so that a new field is tested from the start; what its range
is must be added to the tables here, and a test fails until it is.
"""

import copy
import json
from typing import Any

import pytest
from ruamel.yaml import YAML

from stewart_drake.files.resources import data_root
from stewart_drake.mechanism.files import LegSpec, MechanismSpec, load_mechanism
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.loading import load_controller
from stewart_drake.tuner.network import _File as NetworkFile
from stewart_drake.tuner.network import load_network, save_network
from tests.faults import (
    MISSING,
    Fault,
    complaint,
    fields,
    kind_of,
    put,
    refusal,
    tree,
    written,
    wrong_numbers,
    wrong_types,
    yaml_text,
)
from tests.test_network import small_network

ROW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.38]

# Field -> values out of its range, beside those that no number may have.
SCENARIO_RANGES: dict[str, list[float]] = {
    "duration": [0, -1.0],
    "log_period": [0, -1.0, 1e-9],
    "reference.frequency": [0, -1.0],
    "plant.time_step": [0, -0.001, 1e-9, 0.003, 1.0],
    "plant.accuracy": [0, -1e-8, 1e-16, 0.5],
    "plant.payload_mass": [-1.0],
    "plant.joint_damping": [-1.0],
    "plant.coulomb_friction": [-1.0],
    "plant.coulomb_speed": [0, -1.0],
    "delay.steps": [-1, 1001],
    "delay.fraction": [-0.1, 1.0],
    "delay.drift": [-1.0, 11.0],
    "delay.swing": [-0.1, 101.0],
    "delay.swing_frequency": [0, -1.0],
    "delay.jump": [-101.0, 101.0],
    "delay.jump_time": [-1.0],
    "delay.jitter_std": [-0.1, 11.0],
    "delay.seed": [-1, 2**32],
    **{
        f"link.{part}{name}": values
        for part in ("", "return.")
        for name, values in {
            "low": [-0.1, 0.95],
            "high": [-0.1],
            "median": [0, -1.0],
            "sigma": [0, 11.0],
            "loss": [-0.1, 1.0],
            "burst": [0, 1001],
        }.items()
    },
    "link.playout": [-0.1],
    "link.seed": [-1, 2**32],
    "controller.period": [0, -0.1, 1e-9],
    "controller.delay_steps": [-1, 1001],
    "controller.delay_fraction": [-0.1, 1.0],
    "controller.w_Q": [0, -1.0],
    "controller.w_R": [0, -1.0],
    "controller.integral_weight": [0, -1.0],
    "controller.catch_up": [-1.0, 1e-9],
    "controller.packet_torques": [0, 101],
    "controller.packet_repeats": [-1, 101],
    "controller.delay_std": [0, 11.0],
    "controller.delay_max": [0, 11.0],
    "controller.replan": [-0.1, 11.0],
    **{f"controller.prior.{name}": [0, -1.0] for name in ("torque_bias", "payload", "damping")},
    "controller.prior.offsets": [0, -1.0],
    "actuator.torque_limit": [0, -1.0],
    "actuator.bandwidth": [0, -1.0, 1e4],
    "actuator.damping": [0, -0.7, 101.0],
    "actuator.speed_limit": [0, -1.0],
    "actuator.gear_ratio": [0, -1.0, 1e5],
    "actuator.rotor_inertia": [-1e-6, 1e4],
    "sensor.seed": [-1, 2**32],
    "sensor.delay": [-0.1, 101.0],
    "sensor.loss": [-0.1, 1.0],
    "sensor.bits": [3, 33],
    "sensor.samples": [0, 1001],
    "tuner.ratio": [-5.0, 3.0],
    "tuner.slope": [-1.0, 101.0],
    "tuner.knee": [-7.0, 5.0],
}
SCENARIO_LISTS: dict[str, list[Any]] = {
    "reference.amplitude": [0.1] * 6,
    "reference.offset": ROW,
    "reference.times": [0.0, 1.0],
    "reference.poses": [ROW, ROW],
    "plant.torque_bias": [0.0] * 6,
    "plant.payload_position": [0.0] * 3,
    "controller.prior.rates": [1.0] * 6,
    "sensor.noise_std": [0.0] * 12,
    "sensor.offset": [0.0] * 6,
}
FOR_KIND = {
    "reference.times": {"kind": "waypoints", "poses": [ROW, ROW]},
    "reference.poses": {"kind": "waypoints", "times": [0.0, 1.0]},
    "reference.file": {"kind": "csv"},
    "tuner.weights": {"kind": "ann"},
    **{f"tuner.{name}": {"kind": "rule"} for name in ("ratio", "slope", "knee")},
    **{f"sensor.{name}": {"kind": "encoders"} for name in ("bits", "samples", "offset")},
    **{
        f"actuator.{name}": {"kind": "servo"}
        for name in ("bandwidth", "damping", "speed_limit", "gear_ratio", "rotor_inertia")
    },
    **{
        f"link.{name}": {"kind": "network"}
        for name in ("distribution", "return.distribution", "dry", "acknowledged")
    },
    **{name: {"kind": "network"} for name in SCENARIO_RANGES if name.startswith("link.")},
    **{f"link.{name}": {"kind": "network", "low": 0.5, "high": 0.9} for name in ("low", "high")},
    "link.return.low": {"kind": "network", "return": {"low": 0.5, "high": 0.9}},
}
"""What a field needs beside it, so that it means something."""
FITS_NOT = ("reference.times", "too long")
"""Where times and poses do not fit each other it is the poses that are named."""

PAPER = YAML(typ="safe").load((data_root() / "models" / "paper.yaml").read_text())
LEG = {
    "shaft": [0.2, 0.0, 0.01],
    "motor_axis": [1.0, 0.0, 0.0],
    "crank_zero": [0.0, 1.0, 0.0],
    "plate_joint": [0.12, 0.0, 0.0],
    "branch": 1,
}
WITH_LEGS = {k: v for k, v in PAPER.items() if k != "pattern"} | {"legs": [LEG] * 6}
MECHANISM_RANGES: dict[str, list[float]] = {
    "base.mass": [-1.0],
    "plate.mass": [0, -1.0],
    "crank.mass": [0, -1.0],
    "rod.mass": [0, -1.0],
    "crank.center": [-0.1, 1.1],
    "rod.center": [-0.1, 1.1],
    "crank.length": [0, -1.0, 1e-9, 1e4],
    "rod.length": [0, -1.0, 1e-9, 1e4, 0.11],
    "motor.effort_limit": [0, -1.0],
    "pattern.rotation_deg": [361.0],
    "pattern.base_radius": [0, -1.0, 1e-9],
    "pattern.base_separation_deg": [361.0],
    "pattern.plate_radius": [0, -1.0, 1e-9],
    "pattern.plate_separation_deg": [361.0],
    "pattern.plate_offset_deg": [361.0],
    "pattern.shaft_height": [-2000.0],
    "pattern.installation_deg": [361.0],
    "pattern.plate_height": [-2000.0],
}
# Their numbers may be negative: the last ones are wrong in themselves.
MECHANISM_LISTS: dict[str, list[Any]] = {
    "home": ROW,
    "base.inertia": [0.027, 0.027, 0.054],
    "plate.inertia": [0.003, 0.003, 0.006],
    "crank.inertia": [1e-6, 58e-6, 59e-6],
    "rod.inertia": [1e-6, 16e-4, 16e-4],
    "pattern.plate_order": [5, 0, 1, 2, 3, 4],
    "pattern.branches": [-1, 1, -1, 1, -1, 1],
}


def faults(
    type_: type,
    ranges: dict[str, list[float]],
    lists: dict[str, list[Any]],
    skip: tuple[str, ...] = (),
) -> list[Fault]:
    """All of them; a field without an entry in the tables is an error."""
    found: list[Fault] = []
    numbers, rows = set(), set()
    for name, hint, required in fields(type_):
        kind = kind_of(hint)
        if name.startswith(skip):
            continue
        if name in ranges:  # the lengths of links may also be lists
            numbers.add(name)
            found += wrong_types(name, kind._replace(name="number"))
            found += [Fault(name, f"out of range, {value:g}", value) for value in ranges[name]]
        elif kind.name == "numbers":
            rows.add(name)
            found += wrong_types(name, kind)
            found += wrong_numbers(name, lists[name])
        else:
            assert kind.name in ("text", "choice", "truth"), f"{name} has no entry in the tables"
            found += wrong_types(name, kind)
        if required:
            found.append(Fault(name, "missing", MISSING))
    assert numbers == set(ranges) and rows == set(lists), "an entry for a field that is not there"
    return found


def section_of(fault: Fault) -> str:
    return fault.field.partition(".")[0]


# Sections that hold six alike have tests of their own.
# Lists of mappings have them too, see tests/test_sensor_faults.py, and lists of words, see
# tests/test_upgrading.py.
SCENARIO_FAULTS = faults(
    Scenario,
    SCENARIO_RANGES,
    SCENARIO_LISTS,
    skip=("sensor.faults", "compare", "controller.estimate"),
)
# A name may have any form that is not empty; null means a default.
MECHANISM_FAULTS = faults(MechanismSpec, MECHANISM_RANGES, MECHANISM_LISTS, skip=("legs",))
NETWORK_LISTS: dict[str, list[Any]] = {
    f"{name}": getattr(small_network(), name).tolist()
    for name in ("input_mean", "input_scale", "W1", "b1", "W2", "b2", "bounds")
}


@pytest.mark.parametrize("section", sorted({section_of(fault) for fault in SCENARIO_FAULTS}))
def test_a_scenario_with_a_wrong_field(section, tmp_path, capsys):
    for fault in (fault for fault in SCENARIO_FAULTS if section_of(fault) == section):
        document = {section: FOR_KIND[fault.field]} if fault.field in FOR_KIND else {}
        path = written(tmp_path / "mine.yaml", yaml_text(put(document, fault.field, fault.value)))
        before = tree(tmp_path)
        said = refusal(["simulate", str(path), "--out", str(tmp_path / "out")], capsys)
        assert fault.field in said or fault[:2] == FITS_NOT, (fault, said)
        assert "mine.yaml" in said or "reference.poses" in said, (fault, said)
        assert tree(tmp_path) == before, fault


CONTROLLER_FAULTS = [
    Fault(fault.field.removeprefix("controller."), fault.kind, fault.value)
    for fault in SCENARIO_FAULTS
    if fault.field.startswith("controller.")
    and not fault.field.endswith("period")
    # A blend too short is noticed where the controller meets its scenario.
    and fault[::2] != ("controller.catch_up", 1e-9)
]


def test_a_controller_file_with_a_wrong_field(tmp_path, capsys):
    assert {fault.field for fault in CONTROLLER_FAULTS} == {
        name for name, _, _ in fields(ControllerConfig)
    } - {"period", "estimate"}
    for fault in CONTROLLER_FAULTS:
        path = written(tmp_path / "mine.yaml", yaml_text({fault.field: fault.value}))
        assert fault.field in complaint(load_controller, path), fault
    refusal(["simulate", "--controller", str(path)], capsys)


def test_a_setting_of_a_wrong_field(capsys):
    for fault in SCENARIO_FAULTS[::7]:
        setting = f"{fault.field}={yaml_text(fault.value)}"
        others = [
            word
            for name, value in FOR_KIND.get(fault.field, {}).items()
            for word in ("--set", f"{section_of(fault)}.{name}={yaml_text(value)}")
        ]
        said = refusal(["simulate", *others, "--set", setting], capsys)
        named = fault.field in said or (fault[:2] == FITS_NOT and "reference.poses" in said)
        assert named, (fault, said)


@pytest.mark.parametrize("section", sorted({section_of(fault) for fault in MECHANISM_FAULTS}))
def test_a_mechanism_with_a_wrong_field(section, tmp_path, capsys):
    for fault in (fault for fault in MECHANISM_FAULTS if section_of(fault) == section):
        path = written(tmp_path / "mine.yaml", yaml_text(put(PAPER, fault.field, fault.value)))
        before = tree(tmp_path)
        said = refusal(["model", "check", str(path), "--out", str(tmp_path / "out")], capsys)
        assert fault.field in said and "mine.yaml" in said, (fault, said)
        assert tree(tmp_path) == before, fault


LEG_LISTS = {"shaft", "motor_axis", "crank_zero", "plate_joint"}
LEG_FAULTS = [
    fault
    for name, hint, _ in fields(LegSpec)
    for fault in (
        *wrong_types(name, kind_of(hint)),
        *(wrong_numbers(name, LEG[name]) if name in LEG_LISTS else ()),
        Fault(name, "missing", MISSING),
    )
]


def test_a_mechanism_with_a_wrong_leg(tmp_path, capsys):
    assert {name for name, _, _ in fields(LegSpec)} == set(LEG)
    for fault in LEG_FAULTS:
        document = copy.deepcopy(WITH_LEGS)
        document["legs"][3] = put(LEG, fault.field, fault.value)
        path = written(tmp_path / "mine.yaml", yaml_text(document))
        assert f"legs[3].{fault.field}" in complaint(load_mechanism, path), fault
    refusal(["model", "sdf", str(path)], capsys)


def network_faults() -> list[Fault]:
    found: list[Fault] = []
    for name, hint, _ in fields(NetworkFile):
        found += wrong_types(name, kind_of(hint)) if name != "card" else [Fault(name, "text", "a")]
        found += wrong_numbers(name, NETWORK_LISTS[name]) if name in NETWORK_LISTS else []
        if name not in ("features", "start"):  # which files of 0.1 have not
            found.append(Fault(name, "missing", MISSING))
    # Any number that is finite may be in a network; what comes out of it is checked as it runs.
    return [fault for fault in found if "1e+300" not in str(fault.value)]


def test_a_network_with_a_wrong_field(tmp_path, capsys):
    save_network(small_network(), tmp_path / "good.json")
    good = json.loads((tmp_path / "good.json").read_text())
    for fault in network_faults():
        path = written(tmp_path / "mine.json", json.dumps(put(good, fault.field, fault.value)))
        said = complaint(load_network, path)
        # What JSON does not have is refused before anybody knows the field, and it takes two
        # fields to see that shapes do not fit.
        others = ("is not readable as JSON", "got shape")
        assert any(words in said for words in (fault.field, *others)), fault
    refusal(["simulate", "--set", "tuner.kind=ann", "--set", f"tuner.weights={path}"], capsys)


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ({"plat": {}}, "plat: unknown key; did you mean plant?"),
        ({"plant": {"gravty": True}}, "plant.gravty: unknown key; did you mean plant.gravity?"),
        ({"controller": {"w_q": 3.0}}, "controller.w_q: unknown key; did you mean controller.w_Q?"),
        ({"controller": {"W_R": 3.0}}, "did you mean controller.w_R?"),
        ({"controller": {"delay_stp": 3}}, "did you mean controller.delay_std?"),
        ({"plant": None}, "plant: got None"),
        ({"plant": [1]}, "plant: got [1]"),
        ({"plant": 3}, "plant: got 3"),
        ({"x" * 500: 1}, "unknown key; expected one of mechanism"),
    ],
)
def test_unknown_keys_and_sections_that_are_none(document, said, tmp_path, capsys):
    path = written(tmp_path / "mine.yaml", yaml_text(document))
    assert said in refusal(["simulate", str(path)], capsys)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("reference.amplitude=[15, 15, 15, 0.02, 0.02, 0.08]", "15 rad"),  # degrees
        ("reference.offset=[0, 0, 0, 0, 0, 380]", "reference: leg 1"),  # millimetres
        ("reference.amplitude=[0, 0, 0, 20, 20, 80]", "reference"),
        ("controller.period=100", "controller.period"),  # milliseconds
        ("plant.time_step=1", "plant.time_step"),
    ],
)
def test_another_unit_is_noticed(setting, said, capsys):
    assert said in refusal(["simulate", "--set", setting], capsys)


def test_a_mechanism_in_millimetres_or_grams_is_noticed(tmp_path, capsys):
    for edits, said in [
        ({"home": [0, 0, 0, 0, 0, 380]}, "home"),
        ({"crank.length": 110.0}, "rod.length"),
        ({"pattern.base_radius": 220.0}, "out of reach"),
        ({"home": [0, 15, 0, 0, 0, 0.38]}, "home: got a pitch of 15 rad"),
    ]:
        document = PAPER
        for name, value in edits.items():
            document = put(document, name, value)
        path = written(tmp_path / "mine.yaml", yaml_text(document))
        assert said in refusal(["model", "check", str(path)], capsys)
