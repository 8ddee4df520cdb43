"""Fields of scenarios and mechanisms out of their ranges."""

import pytest
from ruamel.yaml import YAML

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root
from stewart_drake.files.schema import dotted_names
from stewart_drake.mechanism.files import MechanismSpec, load_mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from tests.faults import complaint, put, written, yaml_text

REFUSED = {
    (0, -1.0): """
        duration log_period reference.frequency plant.time_step plant.accuracy plant.coulomb_speed
        plant.ball_joint_friction_speed delay.swing_frequency controller.period controller.kp
        controller.kd controller.w_Q controller.w_R controller.integral_weight controller.delay_std
        controller.packet_torques controller.delay_max controller.model_error
        controller.prior.torque_bias controller.prior.payload controller.prior.damping
        controller.prior.offsets actuator.torque_limit actuator.bandwidth actuator.damping
        actuator.speed_limit actuator.gear_ratio sensor.samples link.median link.sigma link.burst
        link.return.median link.return.sigma link.return.burst""",
    (-0.001, -1): """
        plant.payload_mass plant.joint_damping plant.coulomb_friction plant.ball_joint_damping
        plant.ball_joint_friction delay.steps delay.fraction delay.swing delay.jump_time
        delay.jitter_std delay.seed link.low link.high link.loss link.playout link.seed
        link.return.low link.return.high link.return.loss controller.delay_steps
        controller.delay_fraction controller.catch_up controller.packet_repeats controller.replan
        controller.timing_std actuator.rotor_inertia sensor.seed sensor.delay sensor.loss""",
    (1,): "delay.fraction link.loss link.return.loss controller.delay_fraction sensor.loss",
    (11,): """
        delay.drift delay.jitter_std link.sigma link.return.sigma controller.delay_std
        controller.delay_max controller.replan""",
    (101,): """
        delay.swing delay.jump controller.packet_torques controller.packet_repeats actuator.damping
        sensor.delay tuner.slope""",
    (1001,): "delay.steps link.burst link.return.burst controller.delay_steps sensor.samples",
    (1e4,): "actuator.bandwidth actuator.rotor_inertia",
    (1e5,): "actuator.gear_ratio",
    (2**32,): "delay.seed link.seed sensor.seed",
    (1e-9,): "log_period plant.time_step controller.period controller.catch_up",
    (-1.0,): "delay.drift tuner.slope",
    (0.003, 1.0): "plant.time_step",
    (1e-16, 0.5): "plant.accuracy",
    (-101.0,): "delay.jump",
    (0.95,): "link.low link.return.low",
    (3, 33): "sensor.bits",
    (-5.0, 3.0): "tuner.ratio",
    (-7.0, 5.0): "tuner.knee",
}
"""Fields of a scenario by numbers that they refuse."""
SCENARIO_RANGES = {
    field: [
        value for values, names in REFUSED.items() if field in names.split() for value in values
    ]
    for field in " ".join(REFUSED.values()).split()
}
SCENARIO_RANGES["reference.frequency"] += [[1.0] * 5, [1.0] * 7, [1.0] * 5 + [0.0]]
KINDS = {
    **{f"tuner.{name}": {"kind": "rule"} for name in ("ratio", "slope", "knee")},
    **{f"sensor.{name}": {"kind": "encoders"} for name in ("bits", "samples")},
    **{
        f"actuator.{name}": {"kind": "servo"}
        for name in ("bandwidth", "damping", "speed_limit", "gear_ratio", "rotor_inertia")
    },
    **{name: {"kind": "network"} for name in SCENARIO_RANGES if name.startswith("link.")},
    **{f"link.{name}": {"kind": "network", "low": 0.5, "high": 0.9} for name in ("low", "high")},
    "link.return.low": {"kind": "network", "return": {"low": 0.5, "high": 0.9}},
}
"""Fields that a section needs in addition to the wrong one."""

PAPER = YAML(typ="safe").load((data_root() / "models" / "paper.yaml").read_text())
MECHANISM_RANGES = {
    "base.mass": [-1.0],
    **{f"{body}.mass": [0, -1.0] for body in ("plate", "crank", "rod")},
    **{f"{link}.center": [-0.1, 1.1] for link in ("crank", "rod")},
    "crank.length": [0, -1.0, 1e-9, 1e4],
    "rod.length": [0, -1.0, 1e-9, 1e4, 0.11],
    "motor.effort_limit": [0, -1.0],
    **{f"pattern.{end}_radius": [0, -1.0, 1e-9] for end in ("base", "plate")},
    **{
        f"pattern.{angle}_deg": [361.0]
        for angle in ("rotation", "base_separation", "plate_separation", "plate_offset")
    },
    "pattern.installation_deg": [361.0],
    **{f"pattern.{height}_height": [-2000.0] for height in ("shaft", "plate")},
}


@pytest.mark.parametrize("field", SCENARIO_RANGES)
def test_a_number_out_of_its_range_is_refused_by_name(field, tmp_path):
    section = field.partition(".")[0]
    for value in (*SCENARIO_RANGES[field], 1e300, 10**400, float("nan"), True, "much", [1.0]):
        document = put({section: KINDS[field]} if field in KINDS else {}, field, value)
        path = written(tmp_path / "mine.yaml", yaml_text(document))
        assert field in complaint(load_scenario, path), value


@pytest.mark.parametrize("field", MECHANISM_RANGES)
def test_a_number_of_a_mechanism_out_of_its_range_is_refused_by_name(field, tmp_path):
    for value in (*MECHANISM_RANGES[field], 1e300, float("nan"), None, "much"):
        if value is None and field == "motor.effort_limit":
            continue
        path = written(tmp_path / "mine.yaml", yaml_text(put(PAPER, field, value)))
        assert field in complaint(load_mechanism, path), value


def test_every_field_with_a_range_is_there():
    assert set(SCENARIO_RANGES) <= set(dict(dotted_names(Scenario)))
    assert set(MECHANISM_RANGES) <= set(dict(dotted_names(MechanismSpec)))


def test_the_file_of_a_machine_is_no_scenario_and_the_other_way_round(tmp_path):
    """Each message says what the file is, and what the other names."""
    root = data_root()
    with pytest.raises(ConfigError, match=r"paper\.yaml: got a mechanism; expected a scenario"):
        load_scenario(root / "models" / "paper.yaml")
    with pytest.raises(ConfigError, match=r"paper\.yaml: got a scenario; expected a mech.*: paper"):
        load_mechanism(root / "diagrams" / "scenarios" / "paper.yaml")
