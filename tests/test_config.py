"""Scenarios: defaults, layers, and one line for everything that is wrong with them."""

import copy
import dataclasses
import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve, shipped
from stewart_drake.files.yamlio import load_yaml
from stewart_drake.scenario.config import (
    AnnTunerConfig,
    ControllerConfig,
    DelayConfig,
    PlantConfig,
    Scenario,
    ServoActuatorConfig,
)
from stewart_drake.scenario.dependencies import idle_fields
from stewart_drake.scenario.loading import (
    load_comparison,
    load_compatible,
    load_controller,
    load_scenario,
    scenario_to_dict,
)
from stewart_drake.scenario.reference_config import (
    CsvConfig,
    HoldConfig,
    SineConfig,
    WaypointsConfig,
)
from stewart_drake.scenario.timing import step_problem
from tests.faults import one_line, written
from tests.test_settings import SCENARIOS


def write(folder, text, name="mine.yaml"):
    return written(folder / name, text)


# Defaults and shipped files


def test_the_paper_scenario_spells_all_defaults_out():
    assert load_scenario("paper") == load_scenario("paper", "predictor_lqi") == Scenario()
    data = load_yaml(resolve("scenario", "paper"))
    for section, fields in scenario_to_dict(Scenario()).items():
        if isinstance(fields, dict):
            assert set(fields) <= set(data[section])
        assert section in data


@pytest.mark.parametrize("scenario", shipped("scenario"))
@pytest.mark.parametrize("controller", shipped("controller"))
def test_every_shipped_controller_fits_every_shipped_scenario(scenario, controller):
    servos = load_controller(controller).get("command") == "cranks"
    own = load_scenario(scenario).actuator.kind
    settings = (f"actuator.kind={'servo' if servos else 'torque'}",)
    plain = load_compatible(scenario, settings=settings)
    laid_over = load_scenario(scenario, controller=controller, settings=settings)
    if servos and own == "torque":
        with pytest.raises(ConfigError, match=r"actuator.kind: got .torque. with .* .servo."):
            load_scenario(scenario, controller=controller)
    assert isinstance(laid_over.actuator, ServoActuatorConfig) == servos
    laid_over.actuator = plain.actuator
    assert not idle_fields(laid_over)
    assert laid_over.controller.period == plain.controller.period
    laid_over.controller = plain.controller
    assert laid_over == plain


@pytest.mark.parametrize(
    ("name", "integral", "delay_steps"),
    [("lqr", False, 0), ("lqi", True, 0), ("delay_lqr", False, None), ("delay_lqi", True, None)],
)
def test_the_papers_controllers(name, integral, delay_steps):
    assert load_scenario("paper", controller=name).controller == ControllerConfig(
        integral=integral,
        delay_steps=delay_steps,
        prediction="linear",
        feedforward="none",
        model="paper",
        estimate=[],
        weight_scaling="identity",
        catch_up=0,
        open_loop_start=False,
    )


# Layers


def test_a_file_sets_only_what_it_lists(tmp_path):
    path = write(tmp_path, "delay: {steps: 3}\nplant: {accuracy: 1e-9, gravity: true}\n")
    expected = Scenario(delay=DelayConfig(steps=3), plant=PlantConfig(accuracy=1e-9, gravity=True))
    assert load_scenario(path) == expected
    assert load_scenario(write(tmp_path, "{}")) == Scenario()


def test_settings_beat_the_controller_which_beats_the_scenario(tmp_path):
    path = write(tmp_path, "controller: {period: 0.05, w_Q: 2.0, w_R: 3.0, model: multibody}")
    overlay = write(tmp_path, "w_R: 5.0\nmodel: paper\n", "overlay.yaml")
    scenario = load_scenario(path, overlay, ["controller.model=multibody", "duration=1e1"])
    assert scenario.controller == ControllerConfig(period=0.05, w_Q=2.0, w_R=5.0)
    assert scenario.duration == 10.0


def test_a_setting_is_yaml_and_the_last_one_counts():
    scenario = load_scenario(
        "paper",
        settings=[
            "plant.torque_bias=[1e-3, -1e-3, 0, 0, 0, 0]",
            "actuator.torque_limit=2",
            "actuator.torque_limit=null",
            "plant.gravity=true",
        ],
    )
    assert scenario.plant.torque_bias[:2] == [1e-3, -1e-3]
    assert scenario.actuator.torque_limit is None
    assert scenario.plant.gravity


@pytest.mark.parametrize("order", [1, -1])
def test_a_new_kind_drops_what_the_file_says_for_the_old_one(order, tmp_path):
    changes = ["reference.kind=csv", f"reference.file={tmp_path}/a.csv"][::order]
    scenario = load_scenario("paper", settings=changes)
    assert scenario.reference == CsvConfig(file=f"{tmp_path}/a.csv")
    hold = load_scenario("paper", settings=["reference.kind=hold"])
    assert hold.reference.offset == [0, 0, 0, 0, 0, 0.38]


def test_settings_are_checked_for_the_kind_that_the_file_has(tmp_path):
    path = write(
        tmp_path,
        "reference: {kind: waypoints, times: [0, 1], poses: [[0, 0, 0, 0, 0, 0.4], "
        "[0, 0, 0, 0, 0, 0.3]]}\ntuner: {kind: ann}\n",
    )
    scenario = load_scenario(path, settings=["reference.times=[0, 2]", "tuner.weights=paper"])
    assert isinstance(scenario.reference, WaypointsConfig)
    assert scenario.reference.times == [0, 2]
    assert scenario.tuner == AnnTunerConfig(weights="paper")
    with pytest.raises(ConfigError, match=r"settings: reference.amplitude.*kind 'waypoints'"):
        load_scenario(path, settings=["reference.amplitude=[0, 0, 0, 0, 0, 0]"])
    # The last kind counts, for settings on either side of it.
    changes = ["reference.kind=csv", "reference.frequency=2", "reference.kind=sine"]
    assert load_scenario(path, settings=changes).reference == SineConfig(frequency=2.0)
    assert load_scenario(path, settings=["reference={kind: hold}"]).reference == HoldConfig()


def test_a_null_for_a_field_of_another_kind_says_nothing(tmp_path):
    path = write(tmp_path, "tuner: {kind: fixed, weights: null}\nreference: {file: null}\n")
    assert load_scenario(path, settings=["reference.times=null"]) == Scenario()
    with pytest.raises(ConfigError, match=r"reference\.fil: unknown key"):
        load_scenario(write(tmp_path, "reference: {fil: null}"))


def test_paths_start_where_they_were_written(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    path = write(
        tmp_path,
        "mechanism: ./m.yaml\nreference: {kind: csv, file: a.csv}\n"
        "tuner: {kind: ann, weights: w.json}\n",
    )
    scenario = load_scenario(path)
    assert scenario.mechanism == str(tmp_path / "m.yaml")
    assert scenario.reference.file == str(tmp_path / "a.csv")
    assert scenario.tuner.weights == str(tmp_path / "w.json")
    moved = load_scenario(path, settings=["reference.file=a.csv", "tuner.weights=paper"])
    assert moved.reference.file == str(tmp_path / "elsewhere" / "a.csv")
    assert moved.tuner.weights == "paper"


# What is refused: (YAML text, what the one line must hold)

BAD_FILES = {
    "empty": ("", ["is empty", "a YAML mapping"]),
    "a list": ("- 1\n", ["[1]", "a YAML mapping"]),
    "duplicate key": ("delay: {steps: 1}\nduration: 1\nduration: 2\n", ["line 3", "duration"]),
    "two documents": ("duration: 1\n---\nduration: 2\n", ["line 2", "document"]),
    "alias": ("duration: &a 1\nsensor: {seed: *a}\n", ["line 1", "anchors"]),
    "python tag": ("duration: !!python/object/apply:os.getcwd []\n", ["line 1", "tags"]),
    "odd key": ("? [1, 2]\n: 3\n", ["line 1", "a key must be a word"]),
    "merge key": ("<<: {duration: 1}\n", ["line 1", "a key must be a word"]),
    "deep": ("[" * 5000, ["depth"]),
    "many digits": ("duration: " + "9" * 5000, ["YAML"]),
    "unknown section": ("contoller: {period: 1}", ["contoller: unknown key", "controller"]),
    "key that begins with a dot": ("{.o: {}}", [".o: unknown key"]),
    "unknown field": ("controller: {perod: 1}", ["controller.perod", "controller.period"]),
    "nothing near": ("zzz: 1", ["zzz", "mechanism", "tuner"]),
    "empty section": ("delay:\n", ["delay: got None", "a mapping of fields"]),
    "overflow": ("controller: {w_Q: 1e999}", ["controller.w_Q: got inf", "finite"]),
    "yes for a boolean": ("plant: {gravity: yes}", ["plant.gravity: got 'yes'", "true or false"]),
    "float for an integer": ("delay: {steps: 8.5}", ["delay.steps: got 8.5", "a whole number"]),
    "five numbers": (
        "reference: {offset: [0, 0, 0, 0, 0]}",
        ["reference.offset", "6 numbers, not 5"],
    ),
    "text in a list": ("reference: {offset: [0, 0, 0, a, 0, 0]}", ["reference.offset[3]", "'a'"]),
    "indentation": (
        "controller:\n    period: 0.1\n  w_Q: 1\n",
        ["line 3: the indentation does not fit the lines above"],
    ),
    "two colons": ("duration: 3: 4\n", ["line 1: mapping values are not allowed here"]),
    "no mechanism": ("mechanism: ''", ["mechanism: got ''"]),
}


def test_a_setting_below_a_sections_field_keeps_the_other_fields(tmp_path):
    path = write(tmp_path, "plant: {push: {wrench: [0, 0, 0, 1, 0, 0], from: 2, to: 3}}")
    push = load_scenario(path, settings=("plant.push.to=4", "plant.push.from=1")).plant.push
    assert (push.wrench[3], push.start, push.to) == (1, 1, 4)
    new = "plant.push={wrench: [0, 0, 0, 2, 0, 0]}"
    push = load_scenario(path, settings=(new, "plant.push.to=4")).plant.push
    assert (push.wrench[3], push.start, push.to) == (2, 0, 4)


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_file_is_refused_in_one_line(case, tmp_path):
    text, parts = BAD_FILES[case]
    path = write(tmp_path, text)
    one_line(lambda: load_scenario(path), *parts, start=f"{path}: ")


NETWORK, SIX = "link.kind=network", "[0, 0, 0, 0, 0, 0]"
WRENCH = "controller.estimate=[torque_bias,payload,damping,wrench]"
REFUSED = [
    ("duration", "got 'duration'; expected section.field=value"),
    ("=1", "got '=1'; expected section.field=value"),
    ("plant..mass=1", "got 'plant..mass=1'; expected section.field=value"),
    ("a.b.c=1", "settings: a: unknown key; expected one of mechanism"),
    ("plant.push.wrensh=1", "plant.push.wrensh: unknown key; did you mean plant.push.wrench?"),
    ("plant.gravity.x=1", "plant.gravity: got {'x': 1}; expected true or false"),
    ("duration=", "duration: got no value; expected a value, or null for none"),
    ("duration=[1", "duration: line 1"),
    ("controller.perid=1", "controller.perid: unknown key; did you mean controller.period?"),
    ("controller.tolerance=1", "tolerance: unknown key; did you mean controller.w_R?"),
    ("controller.damper=1", "controller.damper: unknown key; expected one of kind, kp"),
    ("controller=5", "controller: got 5; expected a mapping of fields: kind, kp, kd, period, "),
    ("plant.push=1", "plant.push: got 1; expected a mapping of fields: wrench, from, to"),
    ("controller.period=0.1s", "controller.period: got '0.1s'; expected a number, in s"),
    ("delay.steps=80ms", "got '80ms'; expected a whole number of periods, from 0 to 1000"),
    ("delay.fraction=10ms", "got '10ms'; expected a share of a period, from 0 to below 1"),
    ("controller.delay_steps=80ms", "got '80ms'; expected a whole number of periods, from 0 to"),
    ("reference.frequency=1Hz", "got '1Hz'; expected a number above 0 and of at most 1e4, or six"),
    ("controller.period=100", "controller.period: got 100; expected at most 10 s; 20 ms is 0.02"),
    ("actuator.torque_limit=6Nm", "got '6Nm'; expected a number above 0 and of at most 1e6 N m"),
    ("plant.payload_mass=20 g", "plant.payload_mass: got '20 g'; expected a number, in kg"),
    (
        "controller.kind=predictor_lqi",
        "got 'predictor_lqi'; expected 'lqi' or 'pd'; predictor_lqi is a shipped controller: --con",
    ),
    ("controller.kind=lqg", "controller.kind: got 'lqg'; expected 'lqi' or 'pd'"),
    ("duration.x=5", "duration: got {'x': 5}"),
    (
        "reference={kind: square}",
        "reference.kind: got 'square'; expected 'sine', 'hold', 'waypoints'",
    ),
    (
        "reference={kind: waypoints, pose: []}",
        "reference.pose: unknown key; did you mean reference.p",
    ),
    ("reference={kind: csv}", "reference.file: got None; expected the CSV file"),
    ("reference={kind: waypoints, times: [0, 1]}", "reference.poses: got None; expected times and"),
    ("reference={kind: waypoints, times: [0, 1], file: a.yaml}", "reference.file: got both a file"),
    (
        f"reference={{kind: waypoints, times: [0], poses: [{SIX}]}}",
        f"times: got [0]; expected at least 2 items, not 1; reference.poses: got [{SIX}]; expected",
    ),
    (
        f"reference={{kind: waypoints, times: [0, 1, 2], poses: [{SIX}, {SIX}]}}",
        "reference.poses: got 2 poses; expected 3",
    ),
    ("sensor.noise_std=[0, 0, 0, 0, 0, -1, 0, 0, 0, 0, 0, 0]", "sensor.noise_std[5]: got -1"),
    ("reference={kind: hold, offset: [0, 1.6, 0, 0, 0, 0.38]}", "the pitch reaches 1.6 rad"),
    (
        "reference={amplitude: [0, 1, 0, 0, 0, 0], offset: [0, -0.6, 0, 0, 0, 0.38]}",
        "reference.amplitude: the pitch reaches 1.6 rad; expected |offset| + |amplitude| below pi/",
    ),
    (
        "reference.amplitude=[15, 15, 15, 20, 20, 80]",
        "the pitch reaches 15 rad; expected |offset| + |amplitude| below pi/2, where roll and yaw "
        "stay distinct (are these degrees and mm?)",
    ),
    (
        "reference={kind: hold, offset: [15, 0, 0, 0, 0, 0.38]}",
        "reference.offset: the roll reaches 15 rad; expected |offset| + |amplitude| below 2 pi (a",
    ),
    (
        "controller.delay_fraction=0.5",
        "controller.delay_fraction: got 0.5 with controller.delay_ste",
    ),
    ("controller.torque_map=printed", "controller.torque_map: got 'printed' with controller.model"),
    ("delay.fraction=0.123", "delay.fraction: got 0.123, 12.3 steps; expected a whole number of"),
    ("link.loss=0.1", "link.loss: got 0.1, which kind 'wire' does not use; expected link.kind=net"),
    ("reference.kind=hold", "reference.file=a.csv", "expected reference.kind=waypoints or csv or"),
    (
        *(NETWORK, "controller.delay_estimator=constant"),
        "controller.delay_estimator: got 'constant' with link.kind 'network'; expected 'none', as",
    ),
    ("controller.period=0.1234567", "with settings: controller.period: got 0.1234567; expected a"),
    (NETWORK, "delay.steps=0", "link.low: got null with a delay that is 0; expected link.low and"),
    (NETWORK, "delay.drift=0.01", "link.low: got null with a delay that is not constant; expected"),
    (NETWORK, "link.low=0.5", "link.high: got null with distribution 'uniform'; expected a number"),
    (NETWORK, "delay.jitter_std=0.001", "link.low: got null with a delay that is not constant"),
    (NETWORK, "link.high=0.5", "link.low: got null with distribution 'uniform'; expected a number"),
    (NETWORK, "link.return={loss: 0.1}", "link.return.low: got null with distribution 'uniform'"),
    (NETWORK, "link.median=0.6", "link.median: got 0.6 with distribution 'uniform'; expected null"),
    (
        *(NETWORK, "link.distribution=lognormal", "link.median=1", "link.sigma=0.2"),
        *("link.low=0.5", "link.low: got 0.5 with distribution 'lognormal'; expected null"),
    ),
    (NETWORK, "controller.delay_steps=6", "controller.delay_steps: got 6 with link.kind 'network'"),
    (NETWORK, "link.low=0.9", "link.high=0.5", "link.low: got 0.9 s; expected at most high, 0.5"),
    (NETWORK, "link.distribution=lognormal", "link.median: got null"),
    (NETWORK, "link.return={low: 2, high: 1}", "link.return.low: got 2 s; expected at most high"),
    ("plant.kind=paper", "plant.gravity=true", "plant.gravity: got true with plant.kind 'paper'"),
    ("plant.kind=paper", "sensor.kind=encoders", "sensor.kind: got 'encoders'"),
    ("plant.kind=multibody", "log_period=0.0015", "whole number of plant.time_step"),
    ("plant.kind=exact", "duration=1000", "log_period=1e-4", "at least 0.0002 s"),
    (
        "controller.estimate=[torque_bias,payload,damping,offsets]",
        "sensor.kind: got 'state' with controller.estimate ['torque_bias'",
    ),
    (
        *("sensor.kind=encoders", "sensor.faults=[{kind: frozen, from: 0, to: 1, share: 0.5}]"),
        "share with kind missing or spike only",
    ),
    ("sensor.kind=encoders", "sensor.samples=7", "sensor.samples: got 7"),
    ("actuator.torque_limit=nonsense", "'nonsense'; expected a number above 0 and of at most 1e6"),
    ("compare={lqr: {w_Q: -1}}", "compare.lqr: w_Q"),
    ("compare={lqr: 3}", "compare"),
    ("plant.push={from: 4, to: 4}", "plant.push.to: got 4 s; expected more than plant.push.from"),
    (
        *("plant.push={wrench: [0, 0, 0, 1, 0, 0]}", "plant.kind=paper"),
        "plant.push.wrench: got [0.0, 0.0, 0.0, 1.0, 0.0, 0.0] with plant.kind 'paper'",
    ),
    ("plant.kind=paper", WRENCH, "plant.kind: got 'paper' with controller.estimate"),
    (
        "controller.prior={wrench: [1, 1]}",
        "controller.prior.wrench: got [1.0, 1.0] with controller.estimate ['torque_bias',",
    ),
    *(
        (f"sensor.faults=[{text}]", f"sensor.faults[0]{said}")
        for text, said in (
            ("{kind: gone, from: 1, to: 4}", ".kind: got 'gone'"),
            ("{kind: frozen, from: 1, to: 4, leg: 7}", ".leg: got 7"),
            (
                "{kind: frozen, frm: 1, to: 4}",
                ".frm: unknown key; did you mean sensor.faults[0].fr",
            ),
            (
                "{kind: frozen, start: 1, to: 4}",
                ".start: unknown key; did you mean sensor.faults[0].from",
            ),
            ("{kind: spike, from: 1, to: 4, size: 0}", ".size: got 0"),
            ("{kind: frozen, to: 4}", ".from: is missing"),
        )
    ),
    ("sensor.faults=[{kind: frozen, from: 5, to: 4}]", "'to': 4}; expected `to` after `from`"),
    ("sensor.faults=[{kind: frozen, from: 5, to: 5}]", "'to': 5}; expected `to` after `from`"),
    ("sensor.faults=[{kind: frozen, from: 1, to: 4, leg: 3}]", "'leg': 3}; expected leg null"),
    (
        "sensor.faults=[{kind: missing, from: 1, to: 4, size: 3}]",
        "'size': 3}; expected size with kind spike only",
    ),
]
"""Settings of `paper` that are refused, alone or together, and what the one line says of them."""


@pytest.mark.parametrize("row", REFUSED, ids=lambda row: " ".join(row[:-1])[:60])
def test_bad_settings_are_refused_in_one_line(row):
    *settings, said = row
    one_line(lambda: load_scenario("paper", settings=settings), said)


@pytest.mark.parametrize("settings", ["plant.kind=exact", {"plant.kind": "exact"}, [{"a": 1}]])
def test_settings_that_are_no_list_of_texts_are_refused(settings):
    for load in (
        lambda: load_scenario("paper", settings=settings),
        lambda: load_comparison("paper", ["lqi"], settings),
        lambda: sd.compare("paper", settings),
    ):
        got = f"settings: got {settings!r};"
        one_line(load, "expected a list of texts, such as", start=got)


def test_a_file_may_end_in_yml_and_begin_with_a_byte_order_mark(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.yml").write_bytes(b"\xef\xbb\xbfduration: 3\n")
    assert load_scenario("own.yml").duration == 3


# Changes in memory


def test_an_assignment_is_checked():
    scenario = Scenario()
    scenario.duration, scenario.reference = 5.0, HoldConfig()
    scenario.check()
    for owner, name, bad in (
        *((scenario, "duration", value) for value in (-1.0, float("nan"), "5")),
        (scenario.plant, "mass", 1.0),
        (scenario.reference, "kind", "sine"),
        (scenario, "tuner", HoldConfig()),
    ):
        with pytest.raises(ConfigError):
            setattr(owner, name, bad)
    assert scenario.duration == 5.0 and not hasattr(scenario.reference, "amplitude")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PlantConfig(kind="exakt"), "kind: got 'exakt'; expected 'multibody', 'exact' or"),
        (lambda: PlantConfig(gravty=True), "gravty: unknown key; did you mean gravity?"),
    ],
    ids=["by name", "unknown"],
)
def test_a_wrong_argument_in_python_is_one_line(make, message):
    one_line(make, start=f"PlantConfig: {message}")


def test_check_sees_changes_that_assignment_does_not():
    scenario = Scenario()
    scenario.check()
    scenario.plant.torque_bias[2] = float("nan")
    with pytest.raises(ConfigError, match=r"^scenario: plant.torque_bias\[2\]: got nan"):
        scenario.check()
    scenario.plant.torque_bias[2] = np.float64(0.5)
    scenario.controller.period = 0.1005
    with pytest.raises(ConfigError, match=r"^mine: controller\.period: got 0\.1005"):
        scenario.check("mine")
    scenario.plant.kind = "exact"
    scenario.check()


def test_a_scenario_can_be_copied_and_sent_to_another_process():
    scenario = load_scenario("gravity")
    assert pickle.loads(pickle.dumps(scenario)) == scenario
    twin = copy.deepcopy(scenario)
    twin.delay.steps = 1
    assert scenario.delay.steps == 16
    assert dataclasses.replace(scenario, duration=3.0).duration == 3.0


# Properties


WHOLE = SCENARIOS | {name: (name,) for name in shipped("scenario")}


@pytest.mark.parametrize("name", WHOLE)
def test_a_scenario_survives_json_and_yaml(name, tmp_path):
    scenario = load_scenario(*WHOLE[name])
    path = tmp_path / "again.yaml"
    YAML(typ="safe").dump(json.loads(json.dumps(scenario_to_dict(scenario))), path)
    assert load_scenario(path) == scenario


KEYS = st.sampled_from(
    ["duration", "delay", "steps", "reference", "kind", "offset", "controller", "period", "x"]
)
YAML_LIKE = st.text(
    alphabet="abdeurtions:0123456789.[]{}-,&*!<>|%?#'\"\\\n\t ~\0\u2028é", max_size=60
)


@settings(max_examples=200, deadline=None)
@given(setting=YAML_LIKE | st.builds("{}={}".format, KEYS, YAML_LIKE))
def test_any_setting_is_taken_or_is_refused(setting):
    try:
        assert isinstance(load_scenario("gravity", settings=[setting]), Scenario)
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1


@given(
    time_step=st.floats(1e-6, 0.02),
    period=st.sampled_from([0.1, 0.05, 0.01, 0.02, 0.003, 0.25]),
)
def test_the_step_that_a_message_suggests_is_accepted(time_step, period):
    problem = step_problem(time_step, period, 0.0)
    if problem and problem.startswith("plant.time_step"):
        suggested = float(problem.rpartition("nearest ")[2])
        assert step_problem(suggested, period, 0.0) is None


@given(
    steps=st.integers(1, 400),
    period=st.floats(1e-4, 10),
    fraction=st.floats(0, 1, exclude_max=True),
)
def test_the_period_and_fraction_that_messages_suggest_are_accepted(steps, period, fraction):
    time_step = 0.02 / steps
    problem = step_problem(time_step, period, 0.0)
    if problem:
        assert problem.startswith("controller.period")
        period = float(problem.rpartition("nearest ")[2])
        assert step_problem(time_step, period, 0.0) is None
    problem = step_problem(time_step, period, fraction)
    if problem:
        assert problem.startswith("delay.fraction")
        suggested = float(problem.rpartition("nearest ")[2])
        assert 0 <= suggested < 1
        assert abs(suggested - fraction) <= time_step / period
        assert step_problem(time_step, period, suggested) is None


def test_a_line_names_every_fault_of_a_file(tmp_path, capsys):
    path = tmp_path / "mine.yaml"
    path.write_text("{duration: -1, foo: 3, plant: {gravity: 7}, sensor: {noise_std: [0]}}")
    assert main(["simulate", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith("got [0]; expected 12 numbers, not 1\n")
    assert all(f" {name}: " in said for name in ("foo", "duration", "plant.gravity"))
    settings = ["controller={w_Q: 0, w_R: 0, period: 0, integral: 0, kp: a, kd: a, estimate: 0}"]
    assert main(["simulate", "--set", *settings]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith("; and 2 more\n")
