"""A push on the plate: `plant.push` in every simulated plant."""

import dataclasses

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import stewart_drake as sd
from stewart_drake.dynamics.open_loop import NativePlant
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.simulated import DrakeBody, NativeBody
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import PlantConfig, PushConfig
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.scenario.signals import NUM_CONSTANTS

PAPER: Mechanism = sd.load_mechanism("paper")
WRENCH = [0.004, -0.003, 0.002, 0.05, 0.03, -0.1]
PUSH = f"plant.push={{wrench: {WRENCH}, from: 0.123, to: 0.31}}"
SHORT = ("plant.kind=exact", "start=on_reference", "queue=reference", "delay.steps=2")
TORQUE = np.array([0.004, -0.002, 0.006, 0.002, -0.004, 0.002])
UNTIL = 0.45


def short(*settings):
    return load_scenario("paper", settings=(*SHORT, f"duration={UNTIL}", *settings))


def pushed_by_hand(start):
    """Integrate the plant under TORQUE in three pieces, the second under WRENCH."""
    time = 0.0
    for until, wrench in ((0.123, np.zeros(6)), (0.31, WRENCH), (UNTIL, np.zeros(6))):
        constants = sd.StewartDynamics(PAPER).plant_parameters[:NUM_CONSTANTS]
        dynamics = sd.StewartDynamics(PAPER, False, np.concatenate([constants, wrench]))
        plant = NativePlant(dynamics, start, np.array([until - time]), 1e-12)
        plant.hold([0.0], [TORQUE])
        start = plant.final
        time = until
    return start


def moved(body, until=UNTIL):
    for time in np.append(np.arange(0.1, until, 0.05), until):
        assert body.advance(time, TORQUE) is None
    return body.state


def test_a_machine_in_real_time_is_pushed_between_the_two_times():
    """By DOP853 and by Drake, also in the middle of a period."""
    experiment = prepare(short(PUSH, "plant.accuracy=1e-10"))
    expected = pushed_by_hand(experiment.start)
    away = np.abs(expected - moved(NativeBody(prepare(short())))).max()
    assert away > 1e-3
    for body in (NativeBody(experiment), DrakeBody(experiment)):
        np.testing.assert_allclose(moved(body), expected, atol=1e-7 * away)


@pytest.mark.parametrize("kind", ["paper", "exact", "multibody"])
def test_a_machine_by_drake_says_why_the_plate_left(kind):
    body = DrakeBody(prepare(short(f"plant.kind={kind}")))
    left = None
    for time in np.arange(0.01, 2, 0.01):
        left = body.advance(time, np.array([5, -3, 2, 1, 0, 4]))
        if left is not None:
            break
    assert left is not None
    assert ("peak to peak" in left.reason) == (kind == "paper")


def test_the_multibody_engine_converges_to_it_with_its_step():
    expected, errors = pushed_by_hand(prepare(short()).start), []
    for step in (1e-3, 5e-4):
        experiment = prepare(short(PUSH, "plant.kind=multibody", f"plant.time_step={step}"))
        errors.append(np.abs(moved(DrakeBody(experiment)) - expected).max())
    assert errors[0] / errors[1] == pytest.approx(2, rel=0.15)


@pytest.mark.parametrize("push", [PUSH, f"plant.push={{wrench: {WRENCH}}}"])
def test_bulk_runs_are_pushed_as_the_diagram_is(push):
    scenario = short(push, "duration=1.0")
    found, expected = run_in_bulk(scenario), simulate(scenario, judge_stability=False)
    assert found.loop == "native"
    error = expected.summary["accumulated_error"]
    assert found.figures.accumulated_error == pytest.approx(error, rel=1e-6)
    still = run_in_bulk(short("duration=1.0")).figures.accumulated_error
    assert error > 2 * still


class Gust(LeafSystem):
    """A constant wrench."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("wrench", 6, self.calc, {self.nothing_ticket()})

    def calc(self, context, output):
        output.SetFromVector(WRENCH)


def test_it_adds_to_the_wrench_of_a_disturbance():
    twice = [2 * value for value in WRENCH]
    both = simulate(
        short(f"plant.push={{wrench: {WRENCH}}}"), disturbance=Gust, judge_stability=False
    )
    one = simulate(short(f"plant.push={{wrench: {twice}}}"), judge_stability=False)
    np.testing.assert_allclose(both.signals.pose, one.signals.pose, atol=1e-10)


def test_a_push_is_written_as_it_is_read():
    scenario = short(PUSH)
    assert scenario_to_dict(scenario)["plant"]["push"] == {
        "wrench": WRENCH,
        "from": 0.123,
        "to": 0.31,
    }
    assert scenario.plant.push == PushConfig(WRENCH, 0.123, 0.31)
    assert scenario.plant.push.at(0.123) == WRENCH and scenario.plant.push.at(0.31) == [0.0] * 6


def test_a_platform_in_a_diagram_of_one_s_own_has_its_input_instead():
    config = dataclasses.replace(PlantConfig(), push=PushConfig(WRENCH))
    with pytest.raises(ConfigError, match=r"plant\.push\.wrench: .*the platform's input wrench"):
        sd.AddStewartPlatform(DiagramBuilder(), PAPER, config)
