"""Files of 0.1 and 0.2 mean what docs/upgrading.md says of them."""

import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.scenario.run_log import with_new_names

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
  w_Q: 1.0, w_R: 1.0, weight_scaling: bryson, catch_up: null}
actuator: {torque_limit: null}
sensor: {noise_std: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], seed: 0}
tuner: {kind: fixed, weights: null}
"""
"""Every field of 0.1 with its default, but for `controller.estimator`, which has another name."""


def test_a_scenario_of_0_1_is_todays_with_all_that_is_new_at_its_default(tmp_path):
    """But for the motion's digits; and a fraction below 1e-9 is none."""
    (tmp_path / "old.yaml").write_text(ALL_FIELDS)
    old, today = (
        load_scenario(tmp_path / "old.yaml"),
        Scenario(controller=ControllerConfig(w_R=1.0)),
    )
    assert old.reference.amplitude == pytest.approx(today.reference.amplitude)
    old.reference.amplitude = today.reference.amplitude
    assert old == today
    assert load_scenario("paper", settings=["delay.fraction=1e-10"]).eta == 8 * 0.1


@pytest.mark.parametrize("name", ControllerConfig.renamed)
def test_an_old_name_that_a_person_writes_is_refused_with_the_new_one(tmp_path, name):
    scenario, controller, row = (tmp_path / f"{file}.yaml" for file in ("scenario", "law", "row"))
    scenario.write_text(f"controller: {{{name}: 1}}\n")
    controller.write_text(f"{name}: 1\n")
    row.write_text(f"compare: {{lqr: {{{name}: 1}}}}\n")
    for given in (
        {"name_or_path": scenario},
        {"name_or_path": "paper", "controller": controller},
        {"name_or_path": row},
        {"name_or_path": "paper", "settings": [f"controller.{name}=1"]},
    ):
        with pytest.raises(
            ConfigError, match=rf"{name}: .*called .*{ControllerConfig.renamed[name]} since"
        ) as e:
            load_scenario(**given)
        assert "\n" not in str(e.value)
    with pytest.raises(ConfigError, match=r"expected one of kind, .*, learned$"):
        load_scenario("paper", settings=["controller.xyz=1"])  # the table itself is no field


@pytest.mark.parametrize("start", [True, False])
def test_a_scenario_that_0_2_wrote_is_read_under_the_new_names(start):
    today = scenario_to_dict(Scenario())
    today["controller"] |= {"open_loop_start": start, "replan": 0.3}
    then = today | {"controller": dict(today["controller"])}
    for old, new in (("quiet_start", "open_loop_start"), ("rejoin", "replan")):
        then["controller"][old] = then["controller"].pop(new)
    assert with_new_names(then) == today == with_new_names(today)


@pytest.mark.parametrize(
    ("old", "estimate"),
    [
        ({"estimator": "none"}, []),
        ({"estimator": "parameters"}, ["torque_bias", "payload", "damping"]),
        (
            {"estimator": "parameters", "estimate_coulomb": True, "estimate_offsets": True},
            ["torque_bias", "payload", "damping", "coulomb", "offsets"],
        ),
    ],
)
def test_an_estimator_of_0_2_is_read_as_the_list_of_what_it_finds(old, estimate):
    assert with_new_names({"controller": old})["controller"] == {"estimate": estimate}
    settings = ["sensor.kind=encoders", f"controller.estimate={estimate[::-1]}"]
    read = load_scenario("paper", settings=settings)
    assert read.controller.estimate == estimate


def test_any_part_of_the_estimates_is_accepted_and_nothing_else():
    for some in ("[payload]", "[coulomb]", "[damping, torque_bias]"):
        load_scenario("paper", settings=[f"controller.estimate={some}"])
    for wrong in ("[torque_bias, payload, damping, payload]", "[speed]", "null", "5", "[5]"):
        with pytest.raises(ConfigError, match=r"controller\.estimate(\[0\])?: got .*; expected"):
            load_scenario("paper", settings=[f"controller.estimate={wrong}"])
