"""Every field of a scenario has an effect, is refused, or stands among those without one."""

import dataclasses
import json
import re
import typing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.schema import spelling
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.loop.learned import save_learned
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.scenario.calibration import DELAY, Calibration, save_calibration
from stewart_drake.scenario.config import ESTIMATED, PriorConfig, PushConfig
from stewart_drake.scenario.dependencies import NEEDS
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.compare import shown

DOCS = Path(__file__).parents[1] / "docs" / "reference" / "scenario.md"

SIX = [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]

ON_REFERENCE = "start=on_reference queue=reference"
CASES = {
    "paper": "paper - duration=0.65 delay.steps=2 plant.payload_mass=0.2",
    "paper's plant": "table2 delay_lqi overlay=paper_plant duration=0.9",
    "gravity, hold": "gravity - reference.kind=hold overlay=dirty duration=0.25 queue=equilibrium",
    "desktop, encoders": "desktop - plant.kind=exact sensor.kind=encoders sensor.bits=20 "
    'duration=0.35 plant.push={"wrench":[0,0,0,0,0,1]}',
    "motion_base, rule": "motion_base lqi plant.kind=exact tuner.kind=rule duration=0.2",
    "network, ann": "paper - plant.kind=exact link.kind=network link.low=0.3 link.high=0.6 "
    'link.loss=0.3 link.playout=0.5 link.return={"low":0.0,"high":0.1,"loss":0.1} '
    f"sensor.loss=0.05 tuner.kind=ann duration=1.6 {ON_REFERENCE}",
    "limited": f"paper predictor_mpc plant.kind=exact {ON_REFERENCE} delay.steps=2 "
    "actuator.torque_limit=0.009 duration=0.6",
    "gravity, pd": "gravity pd_gravity plant.kind=exact duration=0.4",
    "servos": "paper servo_feedforward actuator.kind=servo plant.kind=exact delay.steps=2 "
    "duration=0.35",
    "position servos": "paper servo_feedforward actuator.kind=position_servo plant.kind=exact "
    "plant.ball_joint_friction=0.02 delay.steps=2 controller.period=0.04 duration=0.4",
    "adaptive, drifting": "paper adaptive_lqi controller.delay_estimator=drifting delay.steps=3 "
    "controller.delay_steps=2 delay.drift=0.01 delay.swing=0.02 delay.jump=0.02 "
    "delay.jump_time=0.4 delay.jitter_std=0.001 overlay=dirty plant.kind=exact "
    "plant.coulomb_friction=0.0002 duration=1.2",
}
"""Scenario, controller (- is its own) and settings."""
SCENARIOS = {
    name: (words[0], None if words[1] == "-" else words[1], tuple(words[2:]))
    for name, words in ((name, text.split()) for name, text in CASES.items())
}

NUMBERS = {
    -5.0: "tuner.knee",
    -2.0: "tuner.ratio",
    1e-12: "plant.accuracy",
    1e-5: "controller.prior.damping actuator.rotor_inertia",
    1e-4: "controller.prior.torque_bias",
    1e-3: "plant.joint_damping plant.coulomb_friction plant.ball_joint_damping "
    "plant.ball_joint_friction",
    0.002: "plant.time_step actuator.armature",
    0.004: "actuator.torque_limit",
    0.01: "delay.jitter_std controller.prior.payload controller.prior.payload_position tuner.slope",
    0.02: "controller.timing_std actuator.speed_limit",
    0.03: "delay.swing",
    0.05: "log_period delay.drift delay.jump controller.period controller.model_error "
    "controller.prior.offsets actuator.velocity_gain actuator.crank_damping actuator.friction",
    0.1: "plant.push.from plant.push.to controller.delay_std actuator.friction_speed sensor.delay",
    0.2: "delay.jump_time link.low",
    0.3: "duration plant.payload_mass link.median link.sigma",
    0.4: "sensor.loss",
    0.5: "plant.coulomb_speed plant.ball_joint_friction_speed delay.fraction link.loss "
    "controller.delay_fraction",
    0.7: "link.playout controller.catch_up",
    0.8: "link.high",
    1: "delay.steps controller.delay_steps controller.packet_torques controller.replan",
    2: "actuator.damping",
    2.5: "controller.delay_max",
    3: "delay.swing_frequency delay.seed link.seed controller.packet_repeats sensor.seed",
    4: "link.burst sensor.samples",
    5: "controller.w_Q controller.w_R controller.integral_weight actuator.bandwidth "
    "actuator.gear_ratio",
    8: "controller.kd",
    10: "controller.horizon",
    12: "sensor.bits",
    20: "actuator.stiffness",
    60: "controller.kp",
}
OTHER = {name: value for value, names in NUMBERS.items() for name in names.split()} | {
    "compare": {"lqr": {"w_Q": 2.0}},
    "reference.amplitude": [0.05, 0.02, 0.03, 0.004, 0.005, 0.006],
    "reference.offset": [0.0, 0.0, 0.01, 0.0, 0.0, 0.381],
    "reference.frequency": [1.0, 1.3, 1.0, 0.7, 1.0, 2.0],
    "reference.times": [0.0, 1.0],
    "reference.poses": [SIX, SIX],
    "plant.torque_bias": [1e-3, 0.0, 0.0, 0.0, 0.0, 0.0],
    "plant.payload_position": [0.02, 0.0, 0.0],
    "plant.push.wrench": [0.0, 0.0, 0.0, 0.05, 0.0, 0.0],
    "link.return": {"low": 0.1, "high": 0.3},
    "controller.prior.rates": [0.5, 0.1, 0.1, 0.1, 0.1, 0.1],
    "controller.prior.wrench": [1e-4, 1e-3],
    "controller.prior.wrench_walk": [1e-4, 1e-3],
    "actuator.angle_range": [-0.1, 0.1],
    "sensor.noise_std": [1e-4] * 12,
    "sensor.faults": [{"kind": "missing", "from": 0.1, "to": 0.4}],
    "sensor.offset": SIX,
    "tuner.weights": "health_T",
    **dict.fromkeys(
        ("mechanism", "plant.mechanism", "controller.calibration", "controller.learned"), "FILE"
    ),
    "reference.file": "FILE",
}
"""Another legal value of each field that is no word of a list, yes or no."""


def fields_of(scenario):
    """Name, annotation and value of every field, as --set has them; a `kind` is its section's."""

    def walk(owner, above):
        hints = typing.get_type_hints(type(owner))
        for field in dataclasses.fields(owner):
            name = f"{above}{spelling(type(owner), field.name)}"
            value = getattr(owner, field.name)
            if isinstance(value, PriorConfig | PushConfig) or (
                dataclasses.is_dataclass(value) and not above
            ):
                yield from walk(value, f"{name}.")
            else:
                yield name, hints[field.name], value

    return walk(scenario, "")


def other_values(owner_hint, name, value):
    """Other legal values of a field."""
    if name in OTHER:
        return [OTHER[name]]
    if isinstance(value, bool):
        return [not value]
    if name == "controller.estimate":
        some = [*ESTIMATED]
        more = "payload_position", "coulomb", "wrench", "offsets"
        extra = [[*some, one] for one in more]
        return [one for one in ([], *extra, some) if one != value]
    words = getattr(owner_hint, "__args__", ())
    return [word for word in words if word != value]


def setting_of(name, value):
    section, *parts = name.split(".")
    if len(parts) == 2 and parts[0] == "push":  # of a push that acts
        pushed = {"wrench": [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]}
        return f"{section}.push={json.dumps(pushed | {parts[1]: value})}"
    if len(parts) == 2:
        return f"{section}.{parts[0]}={json.dumps({parts[1]: value})}"
    return f"{name}={json.dumps(value)}"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a function that writes a file for a field: a machine, a calibration, a motion."""
    folder = tmp_path_factory.mktemp("files")

    def make(name, scenario):
        machine = load_mechanism(scenario.mechanism)
        path = folder / f"{machine.name}-{name}"
        if name.endswith("mechanism"):
            heavier = replace(machine, plate=replace(machine.plate, mass=1.1 * machine.plate.mass))
            path = path.with_suffix(".yaml")
            path.write_text(mechanism_yaml(heavier))
        elif name == "controller.calibration":
            names = ("payload_mass", "joint_damping", DELAY)
            mean = np.array([0.1 * machine.plate.mass, 1e-3, 0.05])
            path = path.with_suffix(".yaml")
            save_calibration(path, Calibration(fingerprint(machine), names, mean, 1e-8 * np.eye(3)))
        elif name == "controller.learned":
            path = path.with_suffix(".npz")
            experiment = prepare(load_scenario("paper"))
            save_learned(path, LearnedSignal(2 * np.pi, np.full((17, 6), 1e-4)), experiment)
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


NO_EFFECT = {
    "compare": lambda sc: True,
    "plant.time_step": lambda sc: sc.plant.kind != "multibody",
    "plant.accuracy": lambda sc: sc.plant.kind != "exact" or sc.actuator.kind == "servo",
    "controller.model": lambda sc: sc.plant.kind == "paper",
    "plant.payload_position": lambda sc: sc.plant.payload_mass == 0,
    "plant.coulomb_speed": lambda sc: sc.plant.coulomb_friction == 0,
    "plant.push.from": lambda sc: not any(sc.plant.push.wrench),
    "plant.push.to": lambda sc: not any(sc.plant.push.wrench),
    "plant.ball_joint_friction_speed": lambda sc: sc.plant.ball_joint_friction == 0,
    "actuator.friction_speed": lambda sc: sc.actuator.friction == 0,
    "actuator.gear_ratio": lambda sc: sc.actuator.rotor_inertia == 0,
    "delay.swing_frequency": lambda sc: sc.delay.swing == 0 or sc.link.kind == "network",
    "delay.jump_time": lambda sc: sc.delay.jump == 0 or sc.link.kind == "network",
    "delay.seed": lambda sc: sc.delay.jitter_std == 0 or sc.link.kind == "network",
    "sensor.seed": lambda sc: sc.sensor.kind == "state" and not any(sc.sensor.noise_std),
    "controller.prediction": lambda sc: sc.controller.delay_steps == 0,
    "controller.packet_torques": lambda sc: sc.link.kind == "wire",
    "controller.packet_repeats": lambda sc: sc.link.kind == "wire",
    "controller.open_loop_start": lambda sc: sc.start == "on_reference" or _cranks(sc),
    # The desktop platform keeps far from its limit.
    "controller.limits": lambda sc: sc.actuator.torque_limit is None or sc.mechanism == "desktop",
    "controller.integral": lambda sc: _cranks(sc) or sc.controller.kind == "pd",
} | {
    f"delay.{name}": lambda sc: sc.link.kind == "network"
    for name in ("steps", "fraction", "drift", "swing", "jump", "jitter_std")
}
"""Fields that are accepted without an effect, as the docs list them, and when."""


def _cranks(scenario):
    return scenario.controller.command == "cranks"


class Differs(Exception):
    """The pose error is another than that of the unchanged scenario: the run may end."""


def outcome(name, value, chosen, before, errors):
    """`effective`, `refused` or `none`; `errors` are those of the unchanged scenario."""
    scenario, controller, settings = chosen

    def compare(time, error):
        if error != errors.get(time):
            raise Differs

    try:
        result = simulate(
            load_scenario(scenario, controller, (*settings, setting_of(name, value))),
            judge_stability=False,
            progress=compare,
        )
    except Differs:
        return "effective"
    except ConfigError as error:
        assert "\n" not in str(error) and name.split(".")[0] in str(error), error
        return "refused"
    now = result.signals
    same = now.sizes == before.sizes and all(
        np.array_equal(now[one].values, before[one].values, equal_nan=True)
        for one in before.data_vars
    )
    return "none" if same else "effective"


# ---------------------------------------------------------------- what is refused, and where


REFUSED = {
    "controller.estimate=[]": [
        "controller.prior={payload: 0.1}",
        *("controller.prior={torque_bias: 0.1}", "controller.prior={damping: 0.1}"),
        *("controller.prior={wrench: [1, 1]}", "controller.prior={wrench_walk: [1, 1]}"),
    ],
    "controller.delay_estimator=none": [
        *("controller.delay_std=0.1", "controller.delay_max=2.0"),
    ],
    "tuner.kind=rule": ["controller.w_Q=2.0", "controller.w_R=2.0"],
    "controller.limits=ignore": ["controller.horizon=10"],
    "controller.kind=pd": ["controller.w_R=2.0", "controller.integral_weight=2.0"],
    "controller.kind=lqi": ["controller.kp=2.0", "controller.kd=2.0"],
    "controller.integral=false": ["controller.integral_weight=2.0"],
    "sensor.kind=state": ["controller.prior={rates: [1, 1, 1, 1, 1, 1]}"],
    "controller.estimate=[torque_bias,payload,damping]": ["controller.prior={offsets: 0.1}"],
    "start=on_reference": ["controller.catch_up=1.0"],
}


@pytest.mark.parametrize("beside", REFUSED)
def test_a_setting_without_an_effect_is_refused_in_one_line(beside):
    assert load_scenario("paper", None, (beside,))
    for setting in REFUSED[beside]:
        with pytest.raises(
            ConfigError, match=r"^settings: [\w.]+: got .* with .*; expected"
        ) as said:
            load_scenario("paper", None, (beside, setting))
        name = setting.split("=")[0].split(".")[-1]
        assert name in str(said.value) and beside.split("=")[0] in str(said.value)


def test_every_row_of_the_table_names_fields_that_exist():
    scenarios = [load_scenario(*chosen) for chosen in SCENARIOS.values()]
    known = {name for scenario in scenarios for name, *_ in fields_of(scenario)}
    assert {name for row in NEEDS for name in (*row.fields, row.other)} <= known


def test_a_field_of_the_file_may_be_made_useless_by_what_is_laid_over_it(tmp_path):
    mine, asked = tmp_path / "mine.yaml", "controller: {prior: {payload: 0.1}, w_Q: 3.0}\n"
    mine.write_text(asked)
    assert load_scenario(mine).controller.prior.payload == 0.1
    assert load_scenario(mine, "delay_lqr").controller.prior.payload is None
    assert load_scenario(mine, None, ("tuner.kind=rule",)).controller.w_Q == 1.0
    assert load_scenario(mine, "delay_lqr").controller.w_Q == 3.0
    with pytest.raises(ConfigError, match=r"^settings: controller\.prior\.payload"):
        load_scenario(mine, "delay_lqr", ("controller.prior={payload: 0.1}",))
    mine.write_text(asked.replace("{", "{estimate: [], ", 1))
    with pytest.raises(ConfigError, match=r"mine\.yaml: controller\.prior\.payload: got 0\.1"):
        load_scenario(mine)
    assert load_scenario(mine, "predictor_lqi").controller.prior.payload  # which uses it


def test_a_controller_file_is_to_fit_by_itself(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("estimate: []\nprior: {payload: 0.1}\n")
    with pytest.raises(ConfigError, match=r"own\.yaml: controller\.prior\.payload: got 0\.1"):
        load_scenario("paper", own)
    own.write_text("catch_up: 0.5\n")
    assert load_scenario("table2", own).controller.catch_up is None  # it begins on the reference


def test_a_comparison_refuses_what_no_row_uses(tmp_path):
    rows = shown("paper", ("controller.prior={payload: 0.1}",))
    assert rows["predictor_lqi"].controller.prior.payload == 0.1
    assert rows["delay_lqi"].controller.prior.payload is None
    late = ("controller.delay_steps=7", "controller.replan=0.3")
    assert shown("paper", late)["adaptive_lqi"].controller.replan == 0.3
    for settings in (
        ("controller.horizon=10",),
        ("controller.estimate=[]", "controller.prior={payload: 0.1}"),
    ):
        with pytest.raises(ConfigError, match=r"^settings: controller"):
            shown("paper", settings)
    mine = tmp_path / "mine.yaml"
    mine.write_text("compare: {delay_lqr: {integral_weight: 3.0}}\n")
    with pytest.raises(ConfigError, match=r"compare\.delay_lqr: controller\.integral_weight"):
        shown(mine)


def test_what_is_accepted_without_an_effect_stands_in_the_docs():
    rows = [line for line in DOCS.read_text().splitlines() if line.startswith("| `")]
    fields = {".".join(name.split(".")[:2]) for name in NO_EFFECT if name[:6] != "delay."}
    told = {word for row in rows for word in re.findall(r"`([\w.]+)", row.split("|")[1])}
    assert "delay" in told and fields <= told


@pytest.mark.slow
@pytest.mark.parametrize("called", SCENARIOS)
def test_every_field_has_an_effect_or_is_refused_or_documented(called, files):
    chosen = SCENARIOS[called]
    scenario = load_scenario(*chosen)
    errors, wrong = {}, {}
    before = simulate(scenario, judge_stability=False, progress=errors.__setitem__).signals
    assert np.all(np.isfinite([*errors.values()]))  # NaN would differ from itself
    for name, hint, value in fields_of(scenario):
        if name.endswith(".kind") and name != "plant.kind":
            continue  # each is another class, whose fields are refused beside it
        if name in NO_EFFECT and NO_EFFECT[name](scenario):
            continue
        values = other_values(hint, name, value)
        assert values, f"{name}: no other value"
        values = [files(name, scenario) if one == "FILE" else one for one in values]
        found = set[str]()
        for one in values:
            if "effective" not in found:
                found.add(outcome(name, one, chosen, before, errors))
        if "effective" not in found and found != {"refused"}:
            wrong[name] = found
    assert not wrong
