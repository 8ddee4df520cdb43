"""Files of 0.1 mean in 0.2 what docs/upgrading.md says of them."""

import dataclasses
import math

import pytest

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.experiment import prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario

ALL_FIELDS = """
mechanism: paper
duration: 10.0
start: rest
queue: zero
reference:
  kind: sine
  amplitude: [0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]
  offset: [0, 0, 0, 0, 0, 0.38]
  frequency: 1.0
  frequency_unit: rad/s
plant: {kind: multibody, gravity: false, time_step: 0.001, accuracy: 1.0e-8, payload_mass: 0.0,
  torque_bias: [0, 0, 0, 0, 0, 0], joint_damping: 0.0}
delay: {steps: 8, fraction: 0.0}
controller: {period: 0.1, integral: true, delay_steps: null, delay_fraction: null,
  prediction: nonlinear, feedforward: inverse_dynamics, model: multibody, torque_map: virtual_work,
  estimator: parameters, w_Q: 1.0, w_R: 1.0, weight_scaling: bryson, catch_up: null}
actuator: {torque_limit: null}
sensor: {noise_std: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], seed: 0}
tuner: {kind: fixed, weights: null}
"""
"""Every field of 0.1 with its default."""


@pytest.fixture
def old(tmp_path):
    def load(text: str) -> Scenario:
        path = tmp_path / "old.yaml"
        path.write_text(text)
        return load_scenario(path)

    return load


def test_a_scenario_of_0_1_is_todays_with_all_that_is_new_at_its_default(old):
    rounded = "reference: {amplitude: [0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]}"
    assert old(ALL_FIELDS) == old(rounded)
    # But for the motion's digits that is the default.
    assert old(ALL_FIELDS).reference.amplitude == pytest.approx(Scenario().reference.amplitude)
    assert dataclasses.replace(old(ALL_FIELDS), reference=Scenario().reference) == Scenario()


@pytest.mark.parametrize("section", ["reference: {kind: hold", "tuner: {kind: fixed"])
def test_fields_of_another_kind_are_read_as_null_and_refused_otherwise(old, section):
    field = "frequency" if "hold" in section else "weights"
    assert old(f"{section}, {field}: null}}")
    with pytest.raises(ConfigError, match=f"{field}.*expected") as refused:
        old(f"{section}, {field}: 2.0}}")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("word", "limit"), [("null", 10.0), ("none", math.inf), ("0.3", 0.3)])
@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_a_limit_of_null_is_the_mechanism_s_and_none_is_none(word, limit, plant):
    assert sd.load_mechanism("paper").effort_limit == 10.0
    settings = [f"plant.kind={plant}", f"actuator.torque_limit={word}"]
    assert prepare(load_scenario("paper", settings=settings)).torque_limit == limit


def test_a_fraction_below_1e_9_is_none():
    assert load_scenario("paper", settings=["delay.fraction=1e-10"]).eta == 8 * 0.1
