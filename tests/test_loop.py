"""The closed loop: its ports, what its log says, how runs begin and end, and that joints hold."""

import functools
import json
import time
import warnings

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.analysis import Simulator
from scipy.integrate import quad_vec

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop import results as metrics
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator, simulate
from stewart_drake.mechanism.kinematics import leg_geometry, rotation
from stewart_drake.mechanism.trajectories import evaluate, make_reference
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import LEGS
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies import delay
from stewart_drake.studies.delay import study_delay
from stewart_drake.studies.study_options import DelayOptions
from tests.mechanisms import PAPER

GRID = 0.02
ON_REFERENCE = ("start=on_reference", "queue=reference")
AMPLITUDE = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])


def scenario(*settings, controller=None, plant="exact"):
    return load_scenario("paper", controller, [f"plant.kind={plant}", *settings])


@functools.cache
def result(*settings, controller=None, plant="exact"):
    return simulate(scenario(*settings, controller=controller, plant=plant), judge_stability=False)


# What is there.


def test_log_is_on_the_metrics_grid_with_named_coordinates():
    run = result("duration=0.93", *ON_REFERENCE)
    expected = [*(GRID * np.arange(47)), 0.93]
    assert run.status == "completed"
    assert run.signals.time.values == pytest.approx(expected, abs=1e-12)
    assert run.signals.time.attrs["units"] == "s"
    assert list(run.signals.coordinate.values) == ["phi", "theta", "psi", "x", "y", "z"]
    assert list(run.signals.leg.values) == list(LEGS)
    for name in ("pose", "rates", "reference", "torque_commanded", "weights", "parameters"):
        assert np.all(np.isfinite(run.signals[name].values))
    reference = make_reference(run.scenario.reference, 1.0)
    poses = [reference.value(t)[:, 0] for t in run.signals.time.values]
    assert np.allclose(run.signals.reference.values, poses, rtol=0, atol=1e-14)
    error = run.signals.pose.values - run.signals.reference.values
    assert np.array_equal(run.signals.error.values, error)


# Who acts when.


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize(
    ("controller", "steps", "fraction"),
    [
        *(("predictor_lqi", *delay) for delay in ((2, 0.0), (1, 0.2), (0, 0.0), (0, 0.6))),
        ("delay_lqi", 1, 0.2),
        ("lqr", 2, 0.0),
    ],
)
def test_applied_torque_is_the_commanded_one_a_delay_ago(steps, fraction, controller, plant):
    """At every logged instant, bit by bit; before that, what was in flight at the start."""
    settings = ("duration=0.6", f"delay.steps={steps}", f"delay.fraction={fraction}", *ON_REFERENCE)
    run = result(*settings, controller=controller, plant=plant)
    commanded, applied = run.signals.torque_commanded.values, run.signals.torque_applied.values
    behind = round((steps + fraction) * 0.1 / GRID)
    assert run.status == "completed"
    assert np.array_equal(applied[behind:], commanded[: len(commanded) - behind])
    assert run.summary["peak_torque"] == np.abs(commanded).max()
    assert run.summary["peak_torque_applied"] == np.abs(applied).max()
    assert len(np.unique(commanded[:, 0])) >= 6
    assert behind == 0 or np.all(applied[0] != 0)


@pytest.mark.parametrize("tiny", [1e-10, 1e-15, 1e-16])
def test_a_delay_that_is_next_to_whole_is_whole(tiny):
    """A release so near to the next event would come before it, or never."""
    settings = ("duration=2.0", *ON_REFERENCE)
    run = simulate(scenario(f"delay.fraction={tiny}", *settings), judge_stability=False)
    believed = ("controller.delay_steps=8", f"controller.delay_fraction={tiny}")
    same = simulate(scenario(*believed, *settings), judge_stability=False)
    for other in (run, same):
        assert other.accumulated_error == result(*settings).accumulated_error
    sc = scenario(*settings)
    sc.delay.fraction = tiny
    assert sc.delay.fraction == 0.0
    sc.delay.fraction = 1e-9
    assert sc.delay.fraction == 1e-9


# How it begins.


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize("start", ["rest", "on_reference"])
def test_runs_start_at_rest_or_on_the_reference(start, plant):
    """A simulator that cannot know of a moving start warns."""
    loop = build_closed_loop(scenario(f"start={start}", plant=plant))
    expected = evaluate(make_reference(loop.experiment.scenario.reference, 1.0), 0.0)[:12]
    expected[6:] *= start == "on_reference"
    context = loop.CreateDefaultContext()
    assert loop.GetOutputPort("state").Eval(context) == pytest.approx(expected, abs=1e-9)
    warnings.simplefilter("error")
    Simulator(loop, context).Initialize()
    if plant == "multibody" and start == "on_reference":
        with pytest.warns(UserWarning, match="loop.CreateDefaultContext"):
            Simulator(loop).Initialize()
    else:
        found = loop.GetOutputPort("state").Eval(Simulator(loop).get_context())
        assert found == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("steps", "fraction"), [(3, 0.0), (2, 0.4)])
def test_torques_in_flight_at_the_start(steps, fraction):
    """None, those that hold still, or the reference's averaged over the period that they act in."""
    settings = ("duration=0.4", "plant.gravity=true", "start=on_reference", "controller.catch_up=0")
    settings = (*settings, f"delay.steps={steps}", f"delay.fraction={fraction}")
    dynamics = StewartDynamics(PAPER, gravity=True)
    motion = make_reference(scenario().reference, 10.0)
    eta = (steps + fraction) * 0.1
    waiting = slice(0, round(eta / GRID))

    def nominal(t):
        return dynamics.inverse_dynamics(*np.split(evaluate(motion, t), 3))

    def mean(start, end):
        return quad_vec(nominal, start, end)[0] / (end - start)

    ends = eta - 0.1 * np.arange(steps + (fraction > 0))[::-1]
    for kind in ("zero", "equilibrium", "reference"):
        run = result(*settings, f"queue={kind}")
        applied = run.signals.torque_applied.values[waiting]
        times = run.signals.time.values[waiting]
        for t, torque in zip(times, applied, strict=True):
            end = ends[np.argmax(ends > t + 1e-9)]
            expected = {
                "zero": lambda end: np.zeros(6),
                "equilibrium": lambda end: dynamics.equilibrium_torque(PAPER.home),
                "reference": lambda end: mean(max(0.0, end - 0.1), end),
            }[kind](end)
            assert torque == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_torques_in_flight_hold_the_plate_from_the_first_instant(plant):
    """Under gravity one step of 1 ms without them would leave it falling at 10 mm/s."""
    settings = ("duration=0.3", "plant.gravity=true", "reference.kind=hold", "queue=equilibrium")
    run = result(*settings, "delay.steps=2", plant=plant)
    assert np.abs(run.signals.rates.values).max() < 1e-5
    assert np.abs(run.signals.error.values).max() < 1e-6


# Metrics.


def test_accumulated_error_of_a_signal_made_by_hand():
    """Triangles of two percent of peak to peak over two seconds, and one constant coordinate."""
    time = np.linspace(0, 2, 101)
    triangle = 1 - np.abs(time - 1)
    scale = np.array([0.5, 0.5, 1, 0.04, 0.04, 0.16])
    error = np.outer(triangle, 0.02 * scale * [1, -1, 1, -1, 1, -1])
    assert metrics.accumulated_error(time, error, scale) == pytest.approx(2.0, rel=1e-12)
    assert metrics.peak_error(error, scale) == pytest.approx(np.full(6, 2.0), rel=1e-12)
    one = np.zeros((101, 6))
    one[:, 3] = 0.04
    assert metrics.accumulated_error(time, one, scale) == pytest.approx(2 * 100 / 6, rel=1e-12)


def test_cost_and_variation_in_closed_form():
    n, period = 51, 0.1
    error, torque = np.full((n, 6), 2.0), np.outer((-1.0) ** np.arange(n), np.arange(1, 7))
    z = 2.0 * period * np.arange(n)
    errors, torques = 6 * n * 4.0, n * 91.0
    plain = metrics.quadratic_cost(error, torque, period, 3.0, 0.5, False)
    assert plain == pytest.approx(3 * errors + 0.5 * torques, rel=1e-12)
    errors += 6 * (z**2).sum()
    with_integral = metrics.quadratic_cost(error, torque, period, 3.0, 0.5, True)
    assert with_integral == pytest.approx(3 * errors + 0.5 * torques, rel=1e-12)
    assert metrics.total_variation(torque) == pytest.approx(2 * (n - 1) * 3.5, rel=1e-12)


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize("fraction", [0.0, 0.9])
def test_delay_floor_is_what_a_plate_that_cannot_move_collects(plant, fraction):
    """100/2 (1 - cos eta), for 0.8 s 15.165 % s, by trapezoids of 20 ms 15.164."""
    eta = 0.8 + 0.1 * fraction
    run = result(f"duration={eta}", f"delay.fraction={fraction}", plant=plant)
    floor = run.summary["delay_floor"]
    assert floor == pytest.approx(50 * (1 - np.cos(eta)), rel=1e-6)
    assert run.accumulated_error == pytest.approx(floor, rel=GRID**2)


@pytest.mark.parametrize(
    ("settings", "waits"),
    [
        (("queue=zero",), True),
        (("queue=equilibrium",), True),
        (("queue=reference",), False),
        (("queue=equilibrium", "plant.gravity=true"), True),
        (("queue=zero", "plant.gravity=true"), False),
        (ON_REFERENCE, False),
    ],
)
def test_the_floor_is_that_of_a_plate_which_waits(settings, waits, monkeypatch):
    """In the summary of a run and in the analysis of the delay alike; where it falls, none."""
    monkeypatch.setattr(delay, "loop_margins", lambda _: [])  # which take seconds
    sc = scenario("duration=0.3", *settings)
    floor = simulate(sc, judge_stability=False).summary["delay_floor"]
    assert (floor > 1) is waits and (floor == 0) is not waits
    assert study_delay(sc, DelayOptions(simulations=False)).floor_applies is waits


def test_summary_is_what_the_signals_say():
    run = result("duration=1.5", *ON_REFERENCE, "delay.steps=2")
    s, time = run.signals, run.signals.time.values
    error = s.error.values
    area = 100 * np.trapezoid(np.abs(error) / (2 * AMPLITUDE), dx=GRID, axis=0)
    assert run.accumulated_error == pytest.approx(area.mean(), rel=1e-9)
    assert run.summary["peak_error"] == pytest.approx(
        100 * np.abs(error).max(axis=0) / (2 * AMPLITUDE), rel=1e-9
    )
    samples = np.isclose(time / 0.1, np.round(time / 0.1))
    torques = s.torque_commanded.values[samples]
    assert run.summary["peak_torque"] == np.abs(torques).max()
    assert run.summary["rms_torque"] == pytest.approx(np.sqrt(np.mean(torques**2)), rel=1e-9)
    assert run.summary["cost"] == pytest.approx(
        metrics.quadratic_cost(error[samples], torques, 0.1, 1.0, 1.0, True), rel=1e-9
    )
    assert run.summary["failure"] is None
    assert run.failure is None


# Repeatability.


@pytest.mark.parametrize("plant", ["exact", "multibody"])
def test_the_same_seed_gives_the_same_bytes(plant, tmp_path):
    noise = "sensor.noise_std=[" + ", ".join(["1e-4"] * 12) + "]"

    def saved(seed, folder):
        run = simulate(
            scenario("duration=0.5", *ON_REFERENCE, noise, f"sensor.seed={seed}", plant=plant),
            judge_stability=False,
        )
        run.save(tmp_path / folder)
        return (tmp_path / folder / "signals.nc").read_bytes(), run.signals

    one, other = saved(1, "one"), saved(2, "other")
    time.sleep(1.1)  # what is stamped with the time shows
    again = saved(1, "again")
    assert one[0] == again[0]
    assert one[1].identical(again[1])
    assert not np.array_equal(one[1].torque_commanded, other[1].torque_commanded)
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["status"] == "completed"
    read = xr.load_dataset(tmp_path / "one" / "signals.nc")
    assert np.array_equal(read.pose.values, one[1].pose.values)


def test_ctrl_c_keeps_what_there_is():
    seen = []

    def interrupt(time, error):
        seen.append(time)
        assert error >= 0
        if time > 0.31:
            raise KeyboardInterrupt

    run = simulate(
        scenario("duration=2.0", *ON_REFERENCE), progress=interrupt, judge_stability=False
    )
    assert run.status == "interrupted"
    assert run.signals.time.values == pytest.approx(GRID * np.arange(17), abs=1e-12)
    assert np.isnan(run.accumulated_error)
    assert seen == pytest.approx(GRID * np.arange(17), abs=1e-12)


@pytest.mark.parametrize("error", [RuntimeError, ValueError])
def test_what_progress_raises_reaches_the_caller(error):
    """It is the caller's own, not a solver that has failed."""
    mine = error("mine")

    def progress(time, error):
        if time > 0.05:
            raise mine

    with pytest.raises(error) as caught:
        simulate(scenario("duration=0.2", *ON_REFERENCE), progress=progress, judge_stability=False)
    assert caught.value is mine


# How it ends early.


@pytest.mark.parametrize("plant", ["exact", "multibody"])
@pytest.mark.parametrize("controller", ["lqr", "lqi"])
def test_leaving_the_workspace_ends_the_run_with_time_leg_and_margin(controller, plant):
    """And that leg is at its dead centre: rod and crank lie in one plane with the motor axis."""
    settings = ("duration=3.0", "delay.steps=8")
    run = result(*settings, controller=controller, plant=plant)
    assert run.status == "left_workspace"
    assert np.isnan(run.accumulated_error)
    stopped = run.stopped
    assert stopped is not None
    assert stopped.leg in LEGS
    assert 0.8 < stopped.time < 3.0
    assert f"leg {stopped.leg}" in run.failure
    assert f"t = {stopped.time:.3f} s" in run.failure
    assert run.summary["failure"]["leg"] == stopped.leg
    assert run.signals.time.values[-1] <= stopped.time
    assert np.all(np.isfinite(run.signals.pose.values))

    loop = build_closed_loop(scenario(*settings, controller=controller, plant=plant))
    simulator = make_simulator(loop)
    simulator.AdvanceTo(3.0)
    context = simulator.get_context()
    assert context.get_time() == pytest.approx(stopped.time, abs=2e-3)
    pose = loop.GetOutputPort("state").Eval(context)[:6]
    sines = np.abs(transmissions(loop, context, pose))
    assert sines[stopped.leg - 1] == sines.min()
    assert sines.min() < 0.02
    assert abs(stopped.margin) < 1e-3


def transmissions(loop, context, pose):
    """Rod along the crank tip's tangent (6,): from the simulated cranks, or from the pose."""
    plant = loop.GetSubsystemByName("plant")
    if not plant.HasOutputPort("crank_angles"):
        return leg_geometry(PAPER, pose).transmission
    angles = plant.GetOutputPort("crank_angles").Eval(plant.GetMyContextFromRoot(context))
    x, y = PAPER.R_WS[:, :, 0], PAPER.R_WS[:, :, 1]
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    tips = PAPER.p_WS + PAPER.crank_lengths[:, None] * (cos * x + sin * y)
    rods = pose[3:] + PAPER.p_PQ @ rotation(pose[:3]).T - tips
    tangents = cos * y - sin * x
    return np.sum(rods * tangents, axis=1) / np.linalg.norm(rods, axis=1)


# What holds together.


@given(
    steps=st.integers(0, 1000),
    parts=st.integers(0, 15),
    period=st.sampled_from([0.5, 0.25, 0.0625]),
)
def test_torques_in_flight_are_those_that_still_have_to_act(steps, parts, period):
    # Sixteenths and powers of two: every instant is exact.
    delay = Delay(steps, parts / 16)
    eta = delay.eta(period)
    assert eta == sum([period] * steps) + parts / 16 * period
    # The torque of sample -k acts for one period from eta - k dt on. In flight at 0 are those of
    # earlier samples that still act then, or will.
    waiting = [k for k in range(1, steps + 3) if eta - k * period + period > 0]
    assert delay.queue_length == len(waiting)


@pytest.mark.parametrize("wrong", [(-1, 0.0), (2, -0.1), (2, 1.0)])
def test_what_is_no_delay_is_refused(wrong):
    with pytest.raises(ConfigError, match="a fraction of a step from 0 to below 1"):
        Delay(*wrong)
