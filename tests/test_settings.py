"""Every field of a scenario has an effect, is refused, or stands among those without one."""

import dataclasses
import json
import re
import typing
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.schema import spelling
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.scenario.config import PriorConfig, Scenario
from stewart_drake.scenario.dependencies import NEEDS
from stewart_drake.scenario.known import DELAY, Known, save_known
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.compare import shown

DOCS = Path(__file__).parents[1] / "docs" / "reference" / "scenario.md"

SIX = [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]

SCENARIOS: dict[str, tuple[str, str | None, tuple[str, ...]]] = {
    "paper": ("paper", None, ("duration=1.5",)),
    "paper's plant": ("table2", "delay_lqi", ("overlay=paper_plant", "duration=1.5")),
    "gravity, hold": (
        "gravity",
        None,
        ("reference.kind=hold", "overlay=dirty", "duration=0.5", "queue=equilibrium"),
    ),
    "desktop, encoders": (
        "desktop",
        None,
        ("plant.kind=exact", "sensor.kind=encoders", "sensor.bits=20", "duration=1"),
    ),
    "motion_base, rule": (
        "motion_base",
        "lqi",
        ("plant.kind=exact", "tuner.kind=rule", "duration=0.5"),
    ),
    "network, ann": (
        "paper",
        None,
        (
            "plant.kind=exact",
            "link.kind=network",
            "link.low=0.3",
            "link.high=0.6",
            "link.loss=0.3",
            "link.return={low: 0.0, high: 0.1, loss: 0.1}",
            "sensor.loss=0.05",
            "tuner.kind=ann",
            "duration=2",
            "start=on_reference",
            "queue=reference",
        ),
    ),
    "servos": (
        "paper",
        "servo_feedforward",
        ("actuator.kind=servo", "plant.kind=exact", "duration=1.5"),
    ),
    "adaptive, drifting": (
        "paper",
        "adaptive_lqi",
        (
            "controller.delay_estimator=drifting",
            "controller.delay_steps=6",
            "delay.drift=0.01",
            "delay.swing=0.02",
            "delay.jump=0.02",
            "delay.jump_time=0.5",
            "delay.jitter_std=0.001",
            "overlay=dirty",
            "plant.kind=exact",
            "plant.coulomb_friction=0.0002",
            "duration=3",
        ),
    ),
}
"""Name, controller and settings of each."""

OTHER: dict[str, Any] = {
    "mechanism": "FILE",
    "duration": 0.7,
    "log_period": 0.05,
    "compare": {"lqr": {"w_Q": 2.0}},
    "reference.amplitude": [0.05, 0.02, 0.03, 0.004, 0.005, 0.006],
    "reference.offset": [0.0, 0.0, 0.01, 0.0, 0.0, 0.381],
    "reference.frequency": 1.3,
    "plant.time_step": 0.002,
    "plant.accuracy": 1e-5,
    "plant.payload_mass": 0.3,
    "plant.torque_bias": [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0],
    "plant.joint_damping": 1e-3,
    "plant.mechanism": "FILE",
    "plant.coulomb_friction": 1e-3,
    "plant.coulomb_speed": 0.5,
    "plant.payload_position": [0.02, 0.0, 0.0],
    "delay.steps": 1,
    "delay.fraction": 0.5,
    "delay.drift": 0.05,
    "delay.swing": 0.03,
    "delay.swing_frequency": 3.0,
    "delay.jump": 0.05,
    "delay.jump_time": 0.2,
    "delay.jitter_std": 0.01,
    "delay.seed": 3,
    "link.low": 0.2,
    "link.high": 0.8,
    "link.median": 0.3,
    "link.sigma": 0.3,
    "link.loss": 0.5,
    "link.burst": 4,
    "link.playout": 0.4,
    "link.return": {"low": 0.1, "high": 0.3},
    "link.seed": 3,
    "controller.period": 0.05,
    "controller.delay_steps": 1,
    "controller.delay_fraction": 0.5,
    "controller.w_Q": 5.0,
    "controller.w_R": 5.0,
    "controller.integral_weight": 5.0,
    "controller.packet_torques": 2,
    "controller.packet_repeats": 3,
    "controller.catch_up": 0.7,
    "controller.delay_std": 0.1,
    "controller.delay_max": 2.5,
    "controller.rejoin": 0.3,
    "controller.known": "FILE",
    "controller.prior.torque_bias": 1e-4,
    "controller.prior.payload": 0.01,
    "controller.prior.damping": 1e-5,
    "controller.prior.rates": [0.5, 0.1, 0.1, 0.1, 0.1, 0.1],
    "controller.prior.offsets": 0.05,
    "actuator.torque_limit": 0.004,
    "actuator.bandwidth": 5.0,
    "actuator.damping": 2.0,
    "actuator.speed_limit": 0.02,
    "actuator.gear_ratio": 5.0,
    "actuator.rotor_inertia": 1e-5,
    "sensor.noise_std": [1e-4] * 12,
    "sensor.delay": 0.1,
    "sensor.loss": 0.4,
    "sensor.seed": 3,
    "sensor.faults": [{"kind": "missing", "from": 0.1, "to": 0.4}],
    "sensor.bits": 12,
    "sensor.samples": 4,
    "sensor.offset": SIX,
    "tuner.weights": "health_T",
    "tuner.ratio": -2.0,
    "tuner.slope": 5.0,
    "tuner.knee": -5.0,
    "reference.file": "FILE",
    "reference.times": [0.0, 1.0],
    "reference.poses": [SIX, SIX],
}
"""Another legal value of each field that is no word of a list, yes or no."""


def fields_of(scenario: Scenario) -> Iterator[str]:
    """Every field of the scenario's sections, as --set has them; `kind` is each section's own."""

    def walk(owner: Any, above: str) -> Iterator[str]:
        for field in dataclasses.fields(owner):
            name = f"{above}{spelling(type(owner), field.name)}"
            value = getattr(owner, field.name)
            if isinstance(value, PriorConfig) or (dataclasses.is_dataclass(value) and not above):
                yield from walk(value, f"{name}.")
            else:
                yield name

    return walk(scenario, "")


def other_values(owner_hint: Any, name: str, value: Any) -> list[Any]:
    """Other legal values of a field."""
    if name in OTHER:
        return [OTHER[name]]
    if isinstance(value, bool):
        return [not value]
    words = getattr(owner_hint, "__args__", ())
    return [word for word in words if word != value]


def hint_of(scenario: Scenario, name: str) -> Any:
    owner: Any = scenario
    for part in name.split(".")[:-1]:
        owner = getattr(owner, part)
    hints = {spelling(type(owner), n): h for n, h in typing.get_type_hints(type(owner)).items()}
    return hints[name.split(".")[-1]]


def value_of(scenario: Scenario, name: str) -> Any:
    owner: Any = scenario
    for part in name.split("."):
        names = {spelling(type(owner), f.name): f.name for f in dataclasses.fields(owner)}
        owner = getattr(owner, names[part])
    return owner


def setting_of(name: str, value: Any) -> str:
    section, *parts = name.split(".")
    if len(parts) == 2:
        return f"{section}.{parts[0]}={json.dumps({parts[1]: value})}"
    return f"{name}={json.dumps(value)}"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Scenario], str]:
    """What makes a file for a field: another machine, a known one, another motion."""
    folder = tmp_path_factory.mktemp("files")

    def make(name: str, scenario: Scenario) -> str:
        machine = load_mechanism(scenario.mechanism)
        path = folder / f"{machine.name}-{name}"
        if name.endswith("mechanism"):
            heavier = replace(machine, plate=replace(machine.plate, mass=1.1 * machine.plate.mass))
            path = path.with_suffix(".yaml")
            path.write_text(mechanism_yaml(heavier))
        elif name == "controller.known":
            names = ("payload_mass", "joint_damping", DELAY)
            mean = np.array([0.1 * machine.plate.mass, 1e-3, 0.05])
            path = path.with_suffix(".yaml")
            save_known(path, Known(fingerprint(machine), names, mean, 1e-8 * np.eye(3)))
        else:
            given = Path(scenario.reference.file)
            path = path.with_suffix(given.suffix)
            text = given.read_text()
            changed = re.sub(r"0\.35\b", "0.3", text)  # the tour looks less far to the left
            if given.suffix == ".csv":
                head, *rows = text.splitlines()
                cells = ([float(x) for x in row.split(",")] for row in rows)
                smaller = [[t, *(0.5 * x for x in q[:3]), *q[3:]] for t, *q in cells]
                changed = "\n".join([head, *(",".join(map(str, row)) for row in smaller)])
            path.write_text(changed)
        return str(path)

    return make


NO_EFFECT: dict[str, Callable[[Scenario], bool]] = {
    "compare": lambda sc: True,
    "plant.time_step": lambda sc: sc.plant.kind != "multibody",
    "plant.accuracy": lambda sc: sc.plant.kind == "multibody",
    "plant.payload_position": lambda sc: sc.plant.payload_mass == 0,
    "plant.coulomb_speed": lambda sc: sc.plant.coulomb_friction == 0,
    "delay.swing_frequency": lambda sc: sc.delay.swing == 0 or sc.link.kind == "network",
    "delay.jump_time": lambda sc: sc.delay.jump == 0 or sc.link.kind == "network",
    "delay.seed": lambda sc: sc.delay.jitter_std == 0 or sc.link.kind == "network",
    "sensor.seed": lambda sc: sc.sensor.kind == "state" and not any(sc.sensor.noise_std),
    "controller.prediction": lambda sc: sc.controller.delay_steps == 0,
    "controller.packet_torques": lambda sc: sc.link.kind == "wire",
    "controller.packet_repeats": lambda sc: sc.link.kind == "wire",
    "controller.quiet_start": lambda sc: sc.start == "on_reference" or _cranks(sc),
    "controller.integral": lambda sc: _cranks(sc),
} | {
    f"delay.{name}": lambda sc: sc.link.kind == "network"
    for name in ("steps", "fraction", "drift", "swing", "jump", "jitter_std")
}
"""Fields that are accepted without an effect, as the docs list them, and when."""


def _cranks(scenario: Scenario) -> bool:
    return scenario.controller.command == "cranks"


def outcome(name: str, value: Any, chosen: tuple[Any, ...], before: Any) -> str:
    """`effective`, `refused` or `none`."""
    scenario, controller, settings = chosen
    try:
        result = simulate(
            load_scenario(scenario, controller, (*settings, setting_of(name, value))), margin=False
        )
    except ConfigError as error:
        assert "\n" not in str(error) and name.split(".")[-1] in str(error), error
        return "refused"
    now = result.signals
    same = now.sizes == before.sizes and all(
        np.array_equal(now[one].values, before[one].values, equal_nan=True)
        for one in before.data_vars
    )
    return "none" if same else "effective"


@pytest.mark.slow
@pytest.mark.parametrize("called", SCENARIOS)
def test_every_field_has_an_effect_or_is_refused_or_documented(called: str, files) -> None:
    chosen = SCENARIOS[called]
    scenario = load_scenario(*chosen)
    before, wrong = simulate(scenario, margin=False).signals, {}
    for name in fields_of(scenario):
        if name.endswith(".kind") and name != "plant.kind":
            continue  # each is another class, whose fields are refused beside it
        value = value_of(scenario, name)
        values = other_values(hint_of(scenario, name), name, value)
        assert values, f"{name}: no other value"
        values = [files(name, scenario) if one == "FILE" else one for one in values]
        found = {outcome(name, one, chosen, before) for one in values}
        documented = name in NO_EFFECT and NO_EFFECT[name](scenario)
        if "effective" not in found and found != {"refused"} and not documented:
            wrong[name] = found
    assert not wrong
