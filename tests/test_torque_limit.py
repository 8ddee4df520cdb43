"""One torque limit: both plants, the law and the record keep to it, wherever it comes from."""

import dataclasses
import functools
import json

import numpy as np
import pytest

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import load_yaml
from stewart_drake.loop.cautions import cautions_before
from stewart_drake.loop.controller_margin import controller_margin
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.loop.preparation import prepare, prepare_unchecked
from stewart_drake.loop.simulation import make_simulator, simulate
from stewart_drake.scenario.loading import load_scenario, scenario_yaml
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.uncertainty import draw, scales_of
from stewart_drake.studies.verdict import scenario_verdict
from tests.mechanisms import PAPER

PLANTS = ["exact", "multibody"]
WEAK = 0.3
"""N m; the paper's experiment asks for 0.66."""
GRID = 0.02


def scenario(*settings, plant="exact"):
    return load_scenario("paper", None, [f"plant.kind={plant}", *settings])


def paper_with(folder, effort):
    """Return the paper's machine with other motors."""
    data = load_yaml(resolve("mechanism", "paper"))
    data["motor"]["effort_limit"] = effort
    path = folder / "machine.yaml"
    path.write_text(json.dumps(data), encoding="utf-8")  # JSON is YAML
    return f"mechanism={path}"


@pytest.fixture(scope="module")
def weak(tmp_path_factory):
    """Return the paper's experiment with motors of 0.3 N m on both plants."""
    motors = paper_with(tmp_path_factory.mktemp("weak"), WEAK)
    return {
        plant: simulate(scenario(motors, plant=plant), judge_stability=False) for plant in PLANTS
    }


def saturated(run):
    return int(run.summary["counts"]["saturated_steps"])


# Both plants.


def test_weak_motors_are_as_weak_on_both_plants(weak):
    """The applied torque is the clipped planned torque of a delay ago."""
    exact, multibody = (weak[plant] for plant in PLANTS)
    assert exact.status == multibody.status == "completed"
    assert saturated(exact) == saturated(multibody) > 0
    behind = round(0.8 / GRID)
    for run in (exact, multibody):
        asked, applied = (run.signals[f"torque_{name}"].values for name in ("commanded", "applied"))
        assert np.array_equal(applied[behind:], np.clip(asked, -WEAK, WEAK)[: len(asked) - behind])
        assert np.abs(applied).max() == run.summary["peak_torque_applied"] == WEAK
        assert run.summary["peak_torque"] == pytest.approx(0.6559, abs=1e-4)
    # Apart by what the engine's steps of 1 ms do.
    apart = exact.signals.torque_applied.values - multibody.signals.torque_applied.values
    assert np.sqrt(np.mean(apart**2)) < 0.01 * WEAK
    # So far apart are the plants from rest without a limit, too: 21.08 and 21.76.
    assert exact.accumulated_error == pytest.approx(multibody.accumulated_error, rel=0.035)
    assert exact.accumulated_error > 22.5  # against 21.1: it was felt


def test_the_engine_itself_does_not_clip():
    """The loop has one place for that; SDFormat keeps the limit for whoever else reads it."""

    def moved(effort):
        plant = MultibodyStewart(dataclasses.replace(PAPER, effort_limit=effort), gravity=False)
        context = plant.CreateDefaultContext()
        plant.set_state(context, np.concatenate([PAPER.home, np.zeros(6)]))
        plant.GetInputPort("torque").FixValue(context, np.full(6, 2.0))
        plant.ExecuteForcedEvents(context)
        return np.array(plant.GetOutputPort("state").Eval(context))

    assert np.array_equal(moved(0.1), moved(None))
    assert np.abs(moved(None)[6:]).max() > 1e-3


@pytest.mark.parametrize("plant", PLANTS)
def test_bias_acts_beyond_the_limit_and_after_it(plant):
    """At the shafts: what the record calls applied, and the bias, on both plants alike."""
    bias = np.array([0.02, -0.02, 0.01, 0.0, 0.0, -0.01])
    settings = (f"plant.torque_bias={bias.tolist()}", "actuator.torque_limit=0.005")
    loop = build_closed_loop(scenario(*settings, "delay.steps=1", plant=plant))
    simulator = make_simulator(loop)
    machine = loop.GetSubsystemByName("plant")
    limited = 0
    for t in (0.05, 0.15, 0.25, 0.35):
        simulator.AdvanceTo(t)
        context = simulator.get_context()
        applied = np.array(loop.GetOutputPort("torque_applied").Eval(context))
        local = machine.GetMyContextFromRoot(context)
        assert np.array_equal(machine.GetInputPort("torque").Eval(local), applied + bias)
        limited += bool(np.abs(applied).max() == 0.005)
    assert limited > 0


# Where it comes from, and what else it does.


def test_limits_come_from_the_scenario_else_from_the_machine(tmp_path):
    path = tmp_path / "again.yaml"
    for text, expected in {"null": 10.0, "none": np.inf, "0.5": 0.5, "20": 20.0}.items():
        sc = scenario(f"actuator.torque_limit={text}")
        assert prepare_unchecked(sc).torque_limit == expected, text
        path.write_text(scenario_yaml(sc), encoding="utf-8")
        assert load_scenario(path) == sc
    stronger = dataclasses.replace(PAPER, effort_limit=12.0)
    assert prepare_unchecked(scenario(), stronger).torque_limit == 12.0
    unlimited = dataclasses.replace(PAPER, effort_limit=None)
    assert prepare_unchecked(scenario(), unlimited).torque_limit == np.inf
    assert prepare_unchecked(scenario("actuator.torque_limit=3"), stronger).torque_limit == 3.0


def test_a_limit_of_the_machine_alone_plans_nothing():
    """The way onto the reference takes 0.3 s; only a number that was asked for changes it, and only
    that one bounds what the estimator may believe in."""

    @functools.cache
    def built(*settings):
        loop = build_closed_loop(scenario(*settings))
        law = loop.GetSubsystemByName("controller")._law
        return loop.catch_up, law.observer.settings.parameters

    catch_up, prior = built()
    free, same = built("actuator.torque_limit=none")
    asked, narrower = built("actuator.torque_limit=5")
    assert catch_up == free == pytest.approx(0.3) and asked > 0.5
    assert np.array_equal(prior.upper, same.upper)
    assert narrower.upper[0] == 5.0 < prior.upper[0]


@pytest.mark.parametrize("queue", ["equilibrium", "reference"])
def test_torques_in_flight_at_the_start_keep_it_too(tmp_path, queue):
    """Motors too weak to hold the plate, which falls: nothing stronger ever acts."""
    motors = paper_with(tmp_path, 0.9)
    held = StewartDynamics(PAPER).equilibrium_torque(PAPER.home)
    assert np.abs(held).max() > 0.9
    settings = ("plant.gravity=true", f"queue={queue}", "start=on_reference", "duration=1")
    run = simulate(scenario(motors, *settings), judge_stability=False)
    assert np.abs(run.signals.torque_applied.values).max() == 0.9
    loop = build_closed_loop(run.scenario)
    controller = loop.GetSubsystemByName("controller")
    memory = controller.memory(controller.GetMyContextFromRoot(loop.CreateDefaultContext()))
    assert np.abs(memory.in_flight).max() == 0.9


def test_drawn_limits_are_never_above_the_motors(tmp_path):
    """0.66 N m are commanded, so that limits of up to 1.97 would be drawn."""
    sc = scenario(paper_with(tmp_path, 0.8))
    scales = scales_of(prepare_unchecked(sc), 0.6559)
    limits = [draw(Ranges(), scales, sc, 0, i)["torque_limit"] for i in range(50)]
    assert max(limits) == 0.8 > min(limits) > 0.6559
    assert draw(Ranges(torque_limit=None), scales, sc, 0, 0)["torque_limit"] is None
    sc.actuator.torque_limit = "none"
    scales = scales_of(prepare_unchecked(sc), 0.6559)
    limits = [draw(Ranges(), scales, sc, 0, i)["torque_limit"] for i in range(50)]
    assert 0.8 < max(limits) < 3 * 0.6559


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            ["actuator.torque_limit=0.0001"],
            ["the motion takes up to 13.3 mN m, the motors give 0.1 (actuator.torque_limit)"],
        ),
        (["actuator.torque_limit=0.0134"], []),
        (["actuator.torque_limit=none"], []),
        (["plant.payload_mass=4", "actuator.torque_limit=0.0134"], ["the motion takes up to"]),
        (["actuator.kind=servo", "controller.command=cranks", "actuator.torque_limit=0.001"], []),
    ],
)
def test_motors_too_weak_for_the_motion_are_warned_of(settings, said):
    found = cautions_before(prepare(scenario(*settings)), None)
    assert len(found) == len(said) and all(map(str.startswith, found, said))


def test_motors_that_cannot_hold_the_plate_qualify_the_verdict():
    weak = prepare(load_scenario("gravity", settings=("actuator.torque_limit=0.02",)))
    (said,) = cautions_before(weak, None)
    assert "give 0.02 (actuator.torque_limit) and cannot hold the plate at home, which" in said
    verdict = scenario_verdict(weak, controller_margin(weak))
    assert verdict.startswith("if the motors give enough torque, which they do not, this loop is")
    strong = prepare(load_scenario("gravity"))
    assert scenario_verdict(strong, controller_margin(strong)).startswith("this loop is stable")


def test_motors_at_their_limit_for_a_second():
    """The catch-up from rest does not know the limit; the plate is caught in the end."""
    small = "reference.amplitude=[0.01, 0.01, 0.01, 0.001, 0.001, 0.004]"
    sc = scenario("duration=8", "delay.steps=2", small, "controller.replan=0")
    free = simulate(sc, judge_stability=False)
    sc.actuator.torque_limit = limit = free.summary["peak_torque"] / 3
    sc.controller.catch_up = 0.3
    run = simulate(sc, judge_stability=False)
    assert run.summary["counts"]["saturated_steps"] >= 10
    assert run.summary["peak_torque_applied"] == limit < run.summary["peak_torque"]
    assert run.status == "completed"
    late = np.abs(run.signals.error.sel(time=slice(7, None)).values).mean(axis=0)
    assert (late / np.ptp(run.signals.reference.values, axis=0)).mean() < 1e-3
