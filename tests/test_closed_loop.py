"""The closed loop as a whole, through `simulate`: the bounds that the product promises."""

import re

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.dynamics.workspace import measures_at
from stewart_drake.files.resources import data_root
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.scenario.signals import LEGS
from stewart_drake.scenario.timing import look_time

EXACT = "plant.kind=exact"
ON_REFERENCE = ("start=on_reference", "queue=reference")
BIAS = "plant.torque_bias=[3e-4,-3e-4,3e-4,-3e-4,3e-4,-3e-4]"


def run(*settings, controller=None):
    """Return the paper's scenario with settings."""
    return sd.simulate(
        sd.load_scenario("paper", controller=controller, settings=settings), judge_stability=False
    )


@pytest.mark.parametrize(
    "settings",
    [(*ON_REFERENCE, "duration=6.3"), ("plant.time_step=0.0005", "duration=2.0")],
    ids=["on the reference", "from rest, 0.5 ms"],
)
def test_joints_stay_closed_through_a_multibody_run(settings):
    """The engine's gap is of second order in its step: 2.5e-6 m from rest at 1 ms.

    On the reference for one period of its motion.
    """
    loop = build_closed_loop(sd.load_scenario("paper", settings=settings))
    end = loop.experiment.scenario.duration
    simulator = make_simulator(loop)
    tree = loop.GetSubsystemByName("plant").tree
    worst = 0.0
    for t in np.arange(0.02, end + 0.01, 0.02):
        simulator.AdvanceTo(look_time(t))
        context = tree.GetMyContextFromRoot(simulator.get_context())
        for leg in LEGS:
            ends = (
                tree.GetFrameByName(f"{name}_{leg}").CalcPoseInWorld(context).translation()
                for name in ("rod_end", "plate_joint")
            )
            worst = max(worst, float(np.linalg.norm(next(ends) - next(ends))))
    assert simulator.get_context().get_time() == pytest.approx(end)
    assert worst < 1e-6


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_torques_arrive_after_the_delay_and_not_before(plant):
    result = run(f"plant.kind={plant}", "duration=1.6")
    time = result.signals.time.values
    commanded = result.signals["torque_commanded"].values
    for t, torque in zip(time, result.signals["torque_applied"].values, strict=True):
        sent = np.flatnonzero(time <= t - 0.8 + 1e-9)
        expected = commanded[sent[-1]] if len(sent) else np.zeros(6)
        np.testing.assert_array_equal(torque, expected)


@pytest.mark.parametrize(
    ("controller", "start", "seconds"),
    [
        ("delay_lqr", (), 1.73),
        ("delay_lqi", (), 1.46),
        ("delay_lqr", ON_REFERENCE, 1.23),
        ("delay_lqi", ON_REFERENCE, 1.20),
    ],
)
def test_the_tuner_does_not_save_the_faithful_controllers(controller, start, seconds):
    """The paper's figures were reached with a tuner."""
    result = run(*start, "tuner.kind=ann", "duration=2.0", controller=controller)
    assert result.status == "left_workspace" and result.stopped is not None
    assert result.stopped.time == pytest.approx(seconds, abs=0.0051)


@pytest.mark.slow
def test_a_catch_up_in_long_periods_is_predicted():
    """Its torques move the plate far in a step: one Runge-Kutta step each is too coarse."""
    found = run(EXACT, "controller.period=0.15", "duration=9.75")
    assert found.summary["counts"]["measurements_rejected"] == 0
    assert found.accumulated_error < 47.5  # 50.9 with the measurement rejected


def test_theory_tells_what_corrected_holds_reach():
    """Rows "corrected" of section 12, four of their columns; tolerance a is w_R = (a/0.03)^2."""
    text = (data_root() / "docs" / "theory.md").read_text(encoding="utf-8")
    cells = [row.split("|")[2:-1] for row in text.splitlines() if row.startswith("| corrected |")]
    tolerances, periods = ([float(cell) for cell in row] for row in cells)
    for column, tolerance in ((3, 0.3), (5, 3.0), (6, 10.0)):
        result = run(EXACT, *ON_REFERENCE, f"controller.w_R={(tolerance / 0.03) ** 2}")
        assert result.accumulated_error == pytest.approx(tolerances[column], abs=5.1e-4)
    slow = run(EXACT, *ON_REFERENCE, "controller.period=0.2", "delay.steps=4")
    assert slow.accumulated_error == pytest.approx(periods[0], abs=5.1e-4)


def test_nonlinear_prediction_previews_the_reference():
    """The figures of docs/theory.md, section 11: no feedforward, true dynamics."""
    law = (EXACT, *ON_REFERENCE, "controller.model=multibody")
    small = ",".join(f"{0.05 * a}" for a in [np.pi / 12] * 3 + [0.02, 0.02, 0.08])
    gentle = (*law, "controller.w_Q=2.5", f"reference.amplitude=[{small}]")
    full = (*law, "controller.w_Q=10", "controller.prediction=nonlinear")
    linear = run(*gentle, controller="delay_lqr")
    nonlinear = run(*gentle, "controller.prediction=nonlinear", controller="delay_lqr")
    assert linear.accumulated_error == pytest.approx(227.8, rel=2e-3)
    assert nonlinear.accumulated_error == pytest.approx(41.7, rel=2e-3)
    assert run(*full, controller="delay_lqr").accumulated_error == pytest.approx(20.2, rel=5e-3)
    assert run(*full, controller="delay_lqi").accumulated_error == pytest.approx(13.7, rel=5e-3)
    lost = run(*law, "controller.w_Q=10", controller="delay_lqr")
    assert lost.status == "left_workspace"


def test_the_papers_law_lacks_the_legs_and_the_reference():
    """The table of docs/paper.md."""
    text = (data_root() / "docs" / "paper.md").read_text(encoding="utf-8")
    legs, torque = "controller.model=multibody", "controller.feedforward=inverse_dynamics"
    told = {"as printed": (), "`controller.model": (legs,), "`controller.feedforward": (torque,)}
    for row, settings in told.items():
        lost = run(EXACT, *ON_REFERENCE, *settings, controller="delay_lqi")
        line = next(line for line in text.splitlines() if line.startswith(f"| {row}"))
        growth, time = re.search(r"([\d.]+) fold \| lost at ([\d.]+) s", line).groups()
        assert lost.stopped.time == pytest.approx(float(time), abs=0.0101)
        margin = sd.controller_margin(lost.scenario)
        assert margin.radius == pytest.approx(float(growth), abs=0.0051)
    both = run(EXACT, *ON_REFERENCE, legs, torque, controller="delay_lqi")
    assert f"| both | stable | {both.accumulated_error:.3f} |" in text
    small = ",".join(f"{0.05 * a}" for a in [np.pi / 12] * 3 + [0.02, 0.02, 0.08])
    tiny = run(EXACT, *ON_REFERENCE, f"reference.amplitude=[{small}]", controller="delay_lqi")
    assert tiny.status == "left_workspace"


def test_the_floor_from_rest_is_the_area_above_one_minus_cosine():
    """Integral of |sin t| / 2 * 100 over 0.8 s, and over the whole of a shorter run."""
    for duration in (1.0, 0.5):
        floor = run(EXACT, f"duration={duration}").summary["delay_floor"]
        assert floor == pytest.approx(50 * (1 - np.cos(min(0.8, duration))), rel=1e-6)


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_a_run_that_leaves_the_workspace_says_when_and_which_leg(plant):
    result = run(f"plant.kind={plant}", controller="lqr")
    assert result.status == "left_workspace"
    assert np.isnan(result.accumulated_error)
    stopped = result.stopped
    assert stopped is not None and stopped.leg is not None
    assert 1.2 < stopped.time < 1.6
    assert result.failure is not None and f"leg {stopped.leg}" in result.failure
    sines = measures_at(sd.load_mechanism("paper"), result.signals.pose.values[-1]).sines
    assert np.argmin(sines) == stopped.leg - 1  # nearest to its dead centre in the last log row
    assert result.signals.time.values[-1] <= stopped.time


def test_the_predictor_beats_the_delay():
    """The floor from rest is 15.16; the paper reports 80."""
    exact = run(EXACT)
    assert exact.accumulated_error <= 22 and exact.summary["peak_torque"] <= 1.0
    assert run(EXACT, *ON_REFERENCE).accumulated_error <= 0.08


@pytest.mark.slow
def test_the_predictor_beats_the_delay_on_the_multibody_plant():
    assert run().accumulated_error <= 22.5
    assert run(*ON_REFERENCE).accumulated_error <= 0.5


@pytest.mark.parametrize(
    ("unknown", "bound"),
    [
        ((BIAS,), 0.3),
        (("plant.payload_mass=0.4",), 0.6),
        (("plant.joint_damping=1e-3",), 3.0),
        ((BIAS, "plant.payload_mass=0.4", "plant.joint_damping=3e-4"), 1.5),
    ],
)
def test_an_unknown_plant_is_found(unknown, bound):
    result = run(EXACT, *ON_REFERENCE, *unknown)
    assert result.accumulated_error <= bound
    if len(unknown) == 3:
        truth = np.array([3e-4, -3e-4] * 3 + [0.4, 3e-4])
        found = result.signals.parameters.values[-1]
        np.testing.assert_allclose(found, truth, rtol=0.01)


@pytest.mark.parametrize("late", [-1.5e-3, -1e-3, 1e-3, 1.5e-3])
def test_a_delay_a_little_off_is_survived_from_rest(late):
    """The catch-up's large torques come at other times than the estimator believes (in s)."""
    periods = 8 + late / 0.1
    steps = int(periods)
    result = run(
        EXACT,
        f"delay.steps={steps}",
        f"delay.fraction={periods - steps}",
        "controller.delay_steps=8",
        "controller.delay_fraction=0.0",
    )
    assert result.accumulated_error < 24
    assert np.abs(result.signals.parameters.values[-1]).max() < 1e-2


def test_a_plan_without_torques_in_flight_sends_no_impossible_torques():
    """The first hold of a plan has the change of the one before, which the plan does not have."""
    moved = "start=on_reference", "reference.frequency=6", "duration=3"
    result = run(EXACT, *moved, "delay.steps=0")
    assert result.status == "completed"
    assert abs(result.signals.torque_commanded).max() < 1


def test_full_amplitude_under_gravity_on_the_exact_plant():
    scenario = sd.load_scenario("gravity", settings=(EXACT, "duration=3.0"))
    assert sd.simulate(scenario, judge_stability=False).accumulated_error <= 0.05


def test_a_tuner_that_does_not_exist_is_refused():
    with pytest.raises(sd.ConfigError, match=r"tuner\.weights: got 'nobody'"):
        run("tuner.kind=ann", "tuner.weights=nobody")
