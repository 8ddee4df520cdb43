"""Fields of scenarios and mechanisms out of their ranges, and numbers in other units."""

import pytest
from ruamel.yaml import YAML

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root
from stewart_drake.files.schema import dotted_names
from stewart_drake.mechanism.files import MechanismSpec, load_mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from tests.faults import complaint, put, written, yaml_text

SCENARIO_RANGES = {
    "duration": [0, -1.0],
    "log_period": [0, -1.0, 1e-9],
    "reference.frequency": [0, -1.0, [1.0] * 5, [1.0] * 7, [1.0] * 5 + [0.0]],
    "plant.time_step": [0, -0.001, 1e-9, 0.003, 1.0],
    "plant.accuracy": [0, -1e-8, 1e-16, 0.5],
    "plant.payload_mass": [-1.0],
    "plant.joint_damping": [-1.0],
    "plant.coulomb_friction": [-1.0],
    "plant.coulomb_speed": [0, -1.0],
    "plant.ball_joint_damping": [-1.0],
    "plant.ball_joint_friction": [-1.0],
    "plant.ball_joint_friction_speed": [0, -1.0],
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
    "controller.kp": [0, -1.0],
    "controller.kd": [0, -1.0],
    "controller.w_Q": [0, -1.0],
    "controller.w_R": [0, -1.0],
    "controller.integral_weight": [0, -1.0],
    "controller.catch_up": [-1.0, 1e-9],
    "controller.packet_torques": [0, 101],
    "controller.packet_repeats": [-1, 101],
    "controller.delay_std": [0, 11.0],
    "controller.delay_max": [0, 11.0],
    "controller.replan": [-0.1, 11.0],
    "controller.model_error": [0, -1.0],
    "controller.timing_std": [-1e-3],
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


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("reference.amplitude=[15, 15, 15, 0.02, 0.02, 0.08]", "15 rad"),  # degrees
        ("controller.period=100", "controller.period"),  # milliseconds
        ("plant.time_step=1", "plant.time_step"),
    ],
)
def test_another_unit_is_noticed(setting, said):
    with pytest.raises(ConfigError, match=said):
        load_scenario("paper", settings=[setting])
