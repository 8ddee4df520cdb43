"""Position servos: the local loop against closed forms and brute force, the law, the whole loop."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.analysis import Simulator
from pydrake.trajectories import PiecewisePolynomial

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.nominal import TorqueLimit
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import (
    ReportLayout,
    Segment,
    ServoLoop,
    crank_mobility,
    mean_inertia,
    still,
    turned,
)
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import compose_servo_law, servo_loop
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.mechanism.geometry import with_rotors
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.config import ServoActuatorConfig, TorqueActuatorConfig
from stewart_drake.scenario.loading import load_comparison
from stewart_drake.scenario.signals import ACCELERATIONS, POSE, RATES
from stewart_drake.scenario.timing import look_time, servo_ticks
from stewart_drake.studies.compare import CONTROLLERS, SERVOS, shown
from tests.backends import with_own

ON = ("start=on_reference", "queue=reference")
TRUE = np.array([3e-4, -3e-4, 3e-4, -3e-4, 3e-4, -3e-4, 0.4, 3e-4])
UNKNOWN = (
    "plant.torque_bias=[3e-4, -3e-4, 3e-4, -3e-4, 3e-4, -3e-4]",
    "plant.payload_mass=0.4",
    "plant.joint_damping=3e-4",
)
HOLD = ("reference.kind=hold", "reference.offset=[0, 0, 0, 0, 0, 0.38]", "delay.steps=0")
DYNAMICS = sd.StewartDynamics(sd.load_mechanism("paper"), gravity=False)
HOME = DYNAMICS.mechanism.home
LOOP = ServoLoop(0.005, 60.0, 0.7, 1e-3, TorqueLimit())
NOTHING = np.zeros(6)


def scenario(*more, controller="servo_preview", kind="exact"):
    given = ("actuator.kind=servo", f"plant.kind={kind}", *more)
    return sd.load_scenario("paper", controller, given)


@cache
def run(*more, controller="servo_preview", kind="exact"):
    return sd.simulate(scenario(*more, controller=controller, kind=kind))


def crank_rates(pose, rates):
    """Return crank rates by differences of the crank angles."""
    h, angles = 1e-6, DYNAMICS.mechanism.crank_angles
    return (angles(pose + h * rates) - angles(pose - h * rates)) / (2 * h)


# The inertia that motors have to move.


@pytest.mark.parametrize("seed", range(5))
def test_the_energy_of_the_cranks_is_that_of_the_pose_and_rotors_add_theirs_only(seed):
    rng = np.random.default_rng(seed)
    pose, rates = HOME + 0.02 * rng.standard_normal(6), rng.standard_normal(6)
    turning = crank_rates(pose, rates)
    energy = turning @ np.linalg.inv(crank_mobility(DYNAMICS, pose)) @ turning / 2
    assert energy == pytest.approx(DYNAMICS.energy(pose, rates), rel=1e-7)
    heavier = sd.StewartDynamics(with_rotors(DYNAMICS.mechanism, 2e-3), gravity=True)
    lighter = sd.StewartDynamics(DYNAMICS.mechanism, gravity=True)
    added = heavier.energy(pose, rates) - lighter.energy(pose, rates)
    assert added == pytest.approx(np.sum(turning**2) * 2e-3 / 2, rel=1e-6)
    assert np.allclose(heavier.equilibrium_torque(pose), lighter.equilibrium_torque(pose))


def test_a_motor_alone_moves_its_crank_as_the_mean_inertia_says():
    """Crank i under 1 N m of its own motor, from the plate's acceleration and differences."""
    own = [
        crank_rates(HOME, DYNAMICS.accelerations(HOME, NOTHING, unit))[i]
        for i, unit in enumerate(np.eye(6))
    ]
    assert 1 / np.mean(own) == pytest.approx(mean_inertia(DYNAMICS), rel=1e-7)


def test_both_plants_have_the_rotors():
    """Falling from rest without any torque to speak of, heavier cranks fall more slowly."""
    soft = ("plant.gravity=true", "actuator.bandwidth=0.01", "duration=0.1", *HOLD)
    fallen = {}
    for kind in ("exact", "multibody"):
        for inertia in (0.0, 0.02):
            more = (*soft, f"actuator.rotor_inertia={inertia / 25}", "actuator.gear_ratio=5")
            fallen[kind, inertia] = 0.38 - run(*more, kind=kind).signals.pose.values[-1, 5]
    assert fallen["exact", 0.02] < 0.7 * fallen["exact", 0.0]
    for inertia in (0.0, 0.02):  # the engine's steps are of first order: 1 % in a hundred of them
        assert fallen["multibody", inertia] == pytest.approx(fallen["exact", inertia], rel=0.02)


# The local loop.


@pytest.mark.parametrize(("damping", "least"), [(0.7, 1.0), (0.7, 0.1), (2.0, 0.04), (0.1, 3.0)])
def test_the_highest_bandwidth_is_where_the_sampled_loop_becomes_unstable(damping, least):
    loop = replace(LOOP, damping=damping)
    highest = loop.highest_bandwidth(loop.inertia * np.array([5.0, least]))
    h = loop.period

    def radius(w, exact):
        p, q = w**2 / least, 2 * damping * w / least
        change = np.array([-p, -q])
        second = np.array([0.0, 1.0]) + h * change
        first = np.array([1.0, h]) + h**2 / 2 * change if exact else [1.0, 0.0] + h * second
        return float(np.abs(np.linalg.eigvals(np.array([first, second]))).max())

    below, above = (
        [radius(share * highest, exact) for exact in (False, True)] for share in (0.999, 1.001)
    )
    assert max(below) < 1 < max(above)


def test_the_speed_limit_makes_the_setpoint_late_and_never_faster():
    loop = replace(LOOP, speed_limit=2.0)
    followed, last = [], NOTHING
    for k in range(200):
        angle = 1.0 if k < 100 else 1.0 - 0.5 * (k - 100) * loop.period
        wanted = np.concatenate([np.full(6, angle), np.full(6, 0.0 if k < 100 else -0.5)])
        setpoint = loop.limited(wanted, last)
        last = setpoint[POSE]
        followed.append(setpoint)
    moved = np.diff([x[0] for x in followed]) / loop.period
    assert np.abs(moved).max() <= 2.0 + 1e-9 and np.abs(np.array(followed)[:, RATES]).max() <= 2.0
    assert followed[99][0] == pytest.approx(0.2)  # 2 rad/s for 0.1 s
    assert np.array_equal(replace(loop, speed_limit=np.inf).limited(wanted, last), wanted)


def test_whole_turns_do_not_count():
    setpoint = np.concatenate([np.full(6, 3.1), NOTHING])
    crank = np.concatenate([np.full(6, -3.1), NOTHING])
    short = LOOP.inertia * LOOP.bandwidth**2 * (6.2 - 2 * np.pi)
    assert np.allclose(LOOP.torque(setpoint, NOTHING, crank), short)


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_turned_is_the_same_angle_close_by(angle, near):
    found = turned(np.array([angle]), np.array([near]))[0]
    assert abs(found - near) <= np.pi + 1e-9
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * angle))


# From command to command.


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_the_setpoint_is_smooth_whenever_commands_arrive(seed):
    """Angles, rates and torques go on where they were, early and late arrivals among them."""
    rng = np.random.default_rng(seed)
    segment, now, coast = still(rng.standard_normal(18), 0.0), 0.0, 0.1
    for _ in range(8):
        now += rng.uniform(0.01, 0.3)
        command = rng.uniform(-1.0, 1.0, 18)
        after = segment.then(command, now, now + 0.1, coast)
        before, begun = segment.at(now, coast), after.at(now, coast)
        assert np.allclose(begun, before, atol=1e-12)
        reached = after.at(now + 0.1, coast)
        assert np.allclose(reached[RATES], command[RATES])
        assert np.allclose(reached[ACCELERATIONS], command[ACCELERATIONS])
        assert np.allclose(np.exp(1j * reached[POSE]), np.exp(1j * command[POSE]))
        h = 1e-6
        near = [after.at(now + 0.04 + i * h, coast) for i in (-1, 0, 1)]
        slope = (near[2][POSE] - near[0][POSE]) / (2 * h)
        assert np.allclose(slope, near[1][RATES], atol=1e-4)
        segment = after


def test_without_a_further_command_the_cranks_coast_for_a_period_and_stop():
    stop = np.concatenate([np.ones(6), np.full(6, 2.0), np.full(6, 3.0)])
    segment = Segment(0.0, 0.1, np.zeros(18), stop)
    assert np.allclose(segment.at(0.15, 0.1)[POSE], 1.1)
    late = segment.at(5.0, 0.1)
    assert np.allclose(late[POSE], 1.2) and not late[RATES].any()
    assert np.allclose(late[ACCELERATIONS], 3.0)


@given(
    steps=st.integers(1, 400),
    time_step=st.sampled_from([1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3]),
)
def test_servos_tick_on_steps_and_samples(steps, time_step):
    period = steps * time_step
    ticks = servo_ticks(period, time_step)
    assert steps % ticks == 0
    assert period / ticks <= max(1e-3, time_step) * (1 + 1e-9)
    fewer = [n for n in range(1, ticks) if steps % n == 0]
    assert all(period / n > 1e-3 * (1 + 1e-9) for n in fewer)
    assert servo_ticks(period, None) == max(1, int(np.ceil(1000 * period - 1e-9)))


def loops_at(*more, until, **which):
    """Yield a loop that has run until each time, its context, and what the servos remember."""
    loop = build_closed_loop(scenario(*more, **which))
    simulator = make_simulator(loop)
    simulator.Initialize()
    servos = loop.GetSubsystemByName("servos")
    for time in until:
        simulator.AdvanceTo(look_time(time))
        context = simulator.get_context()
        yield loop, context, servos.sample(servos.GetMyContextFromRoot(context)).memory


@pytest.mark.parametrize("kind", ["exact", "multibody"])
@pytest.mark.parametrize("delay", [(0, 0.0), (3, 0.0), (2, 0.5)])
def test_the_setpoint_is_the_reference_at_every_sample(delay, kind):
    """The period after its arrival a command is reached: no sooner, no later, on both plants."""
    steps, fraction = delay
    more = (f"delay.steps={steps}", f"delay.fraction={fraction}", *ON)
    times = [0.1 * (5 + fraction), 0.1 * (6 + fraction)]  # commands are reached at eta + k dt
    times.append(times[-1] + 0.05)
    loops = loops_at(*more, until=times, kind=kind)
    for now in times[:2]:
        loop, _, servos = next(loops)
        wanted = evaluate(loop.experiment.reference, now)
        angles = DYNAMICS.mechanism.crank_angles(wanted[POSE])
        assert np.abs(servos.setpoint[POSE] - angles).max() < 1e-9
        rates = crank_rates(wanted[POSE], wanted[RATES])
        assert np.abs(servos.setpoint[RATES] - rates).max() < 1e-7
    # In between, the cubic is as good as its theory: h^4 / 384 of the fourth derivative.
    loop, _, servos = next(loops)
    angles = DYNAMICS.mechanism.crank_angles(loop.experiment.reference.value(times[2])[:, 0])
    assert np.abs(servos.setpoint[POSE] - angles).max() < 0.1**4 / 384 * 5


# On the machine.


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_a_constant_bias_leaves_itself_over_the_stiffness(kind):
    """The torque of each servo then is the bias with another sign: J w^2 e = -b, motor by motor."""
    bias = np.array([3e-3, -1e-3, 2e-3, 0.0, -2e-3, 1e-3])
    more = (f"plant.torque_bias={bias.tolist()}", "duration=2", "start=on_reference", *HOLD)
    result = run(*more, kind=kind)
    angles = DYNAMICS.mechanism.crank_angles
    error = angles(HOME) - angles(result.signals.pose.values[-1])
    stiffness = mean_inertia(DYNAMICS) * (2 * np.pi * 10) ** 2
    assert np.abs(error * stiffness + bias).max() < 1e-3 * np.abs(bias).max()
    assert np.abs(result.signals.torque_applied.values[-1] + bias).max() < 1e-6


@pytest.mark.parametrize("mode", range(6))
def test_each_mode_follows_as_a_second_order_system(mode):
    """Plate over setpoint (w^2 + 2 d w s) / (s^2 m/J + 2 d w s + w^2), for small motions."""
    damping = 0.3 if mode in (1, 3) else 0.7  # mode 5 would be near resonance
    inertias, shapes = np.linalg.eigh(np.linalg.inv(crank_mobility(DYNAMICS, HOME)))
    to_cranks = np.column_stack([crank_rates(HOME, unit) for unit in np.eye(6)])
    shape = np.linalg.solve(to_cranks, shapes[:, mode])
    omega, size = 12.0, 2e-4
    times = np.arange(0.0, 3.7, 0.01)
    poses = HOME + size * np.outer(np.sin(omega * times), shape)
    slopes = size * omega * np.outer(np.cos(omega * times), shape)
    motion = PiecewisePolynomial.CubicHermite(times, poses.T, slopes.T)
    more = ("controller.period=0.02", "delay.steps=2", *ON, "duration=3.2", "actuator.bandwidth=5")
    result = sd.simulate(scenario(*more, f"actuator.damping={damping}"), reference=motion)
    late = result.signals.time.values > 2.0
    t = result.signals.time.values[late]
    moved = (result.signals.pose.values[late] - HOME) @ to_cranks.T @ shapes[:, mode] / size
    waves = np.column_stack([np.sin(omega * t), np.cos(omega * t)])
    real, imaginary = np.linalg.lstsq(waves, moved)[0]
    w, s = 2 * np.pi * 5, 1j * omega
    ratio = inertias[mode] / mean_inertia(DYNAMICS)
    follows = (w**2 + 2 * damping * w * s) / (ratio * s**2 + 2 * damping * w * s + w**2)
    # What is held for 1 ms acts half of that late.
    assert real + 1j * imaginary == pytest.approx(follows, abs=0.003 + 0.03 * abs(follows - 1))


def test_the_torque_limit_clips_and_is_counted():
    free, limited = run("duration=2"), run("duration=2", "actuator.torque_limit=0.1")
    assert np.abs(free.signals.torque_applied.values).max() > 0.2
    assert np.abs(limited.signals.torque_applied.values).max() <= 0.1
    assert limited.summary["peak_torque"] > 0.1 >= limited.summary["peak_torque_applied"]
    assert limited.summary["counts"]["saturated_steps"] > 0
    assert free.summary["counts"]["saturated_steps"] == 0


@pytest.mark.slow
def test_a_speed_limit_that_the_motion_exceeds_makes_it_late():
    slow = run(*ON, "duration=3", "actuator.speed_limit=0.3")
    assert slow.status == "completed"
    assert slow.accumulated_error > 10 * run(*ON, "duration=3").accumulated_error


# Reports, and what is made of them.


def test_a_report_has_means_and_limits_of_each_period():
    rng, layout = np.random.default_rng(3), ReportLayout(parts=4, periods=3)
    torques = rng.standard_normal((3 * 4 * 5, 6))
    torques[25, 2] = 7.0  # in the second period
    report = layout.written(torques, np.arange(6.0), TorqueLimit(6.5))
    assert report.shape == (layout.size,)
    means = np.array([torques[5 * i : 5 * i + 5].mean(axis=0) for i in range(12)])
    rows = report[:-6].reshape(3, layout.width)
    assert np.allclose(rows[:, :-1].reshape(-1, 6), means)
    assert rows[:, -1].tolist() == [0, 1, 0]
    assert np.array_equal(report[-6:], np.arange(6.0))


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_the_machine_reports_what_has_acted(kind):
    loop = build_closed_loop(scenario("delay.steps=2", kind=kind))
    simulator, servos = make_simulator(loop), loop.GetSubsystemByName("servos")
    simulator.Initialize()
    context = simulator.get_context()
    acted = []
    for k in range(400):  # each torque while it acts
        acted.append(loop.GetOutputPort("torque_applied").Eval(context))
        simulator.AdvanceTo(look_time((k + 1) * 1e-3) if k < 399 else 0.4 * (1 - 9e-15))
    own = servos.GetMyContextFromRoot(context)
    layout = servos.reports
    report = servos.GetOutputPort("report").Eval(own)
    said = report[:-6].reshape(layout.periods, layout.width)[-2:, :-1].reshape(-1, 6)
    means = np.array(acted[200:]).reshape(len(said), -1, 6).mean(axis=1)
    assert np.abs(means).max() == 0 or np.allclose(said, means, rtol=1e-12, atol=1e-15)
    assert len(said) == 2 * layout.parts


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_the_parameters_are_found_from_the_reports(kind):
    result = run(*ON, *UNKNOWN, "duration=4", controller="servo_feedforward", kind=kind)
    found = result.signals.parameters.values[-1]
    # An engine's steps look like disturbances of some 1e-4 N m.
    assert np.abs((found - TRUE) / TRUE).max() < (0.01 if kind == "exact" else 0.5)


@pytest.mark.slow
def test_lost_and_late_measurements_cost_little():
    sensor = ("sensor.loss=0.3", "sensor.delay=0.25", "sensor.seed=5")
    more = (*ON, *UNKNOWN, "duration=6")
    result = run(*more, *sensor, controller="servo_feedforward")
    assert np.allclose(result.signals.parameters.values[-1], TRUE, rtol=0.02)
    assert result.summary["counts"]["measurements_missing"] > 10
    clean = run(*more, controller="servo_feedforward")
    assert result.accumulated_error < 4 * clean.accumulated_error < 0.05


AT_REST = np.concatenate([HOME, np.zeros(6)])


def law_and_memory():
    law = compose_servo_law(prepare(scenario(controller="servo_feedforward")))
    command = law.command(np.append(AT_REST, NOTHING), law.plant.dynamics.parameters)
    return law, law.initial_memory(command)


def at_home(times):
    return np.tile(np.append(AT_REST, NOTHING), (len(times), 1))


def test_where_too_many_reports_are_lost_the_observer_begins_anew():
    law, memory = law_and_memory()
    quiet, nothing = np.zeros(law.reports.size), np.full(law.reports.size, np.nan)
    for _ in range(3):
        memory = law.step(memory, Measurement.of(AT_REST), at_home, quiet)
    known = memory.belief.estimate.parameter_std
    for _ in range(law.reports.periods + 2):
        memory = law.step(memory, Measurement.of(np.full(12, np.nan)), at_home, nothing)
    assert memory.counts.measurements_missing == law.reports.periods + 2
    memory = law.step(memory, Measurement.of(AT_REST), at_home, quiet)
    prior = law.observer.settings.parameters.std
    assert np.all(memory.belief.estimate.parameter_std == prior) and np.any(known < prior)
    assert np.allclose(memory.belief.state, AT_REST) and memory.lag == 0


def test_counts_stop_while_single_precision_still_counts():
    law, memory = law_and_memory()
    memory.field("counts")[:] = 1e6
    saturated = np.ones(law.reports.size)
    for measured in (np.full(12, np.nan), AT_REST):
        memory = law.step(memory, Measurement.of(measured), at_home, saturated)
        assert max(memory.counts) == 10**6


def test_a_command_is_finite_whatever_the_reference_is():
    law, memory = law_and_memory()
    state, report = Measurement.of(AT_REST), np.full(law.reports.size, np.nan)
    cases = (-1, np.nan, "references_missing"), (0, np.nan, "references_missing")
    cases += (-1, 1e308, "nonfinite_torque"), (5, 5.0, "unreachable")
    for one in (law, with_own(law, "observer", "feedforward")):
        before = one.initial_memory(memory.command)
        for place, wrong, cause in cases:

            def motion(times, place=place, wrong=wrong):
                x = at_home(times)
                x[:, place] = wrong
                return x

            after = one.step(before, state, motion, report)
            assert getattr(after.counts, cause) == sum(after.counts) == 1
            assert np.array_equal(after.command[POSE], before.command[POSE])
            assert not after.command[RATES].any()


def test_a_measurement_that_servos_repeat_is_missing():
    law, memory = law_and_memory()
    for one in (law, with_own(law, "observer", "feedforward")):
        after = one.initial_memory(memory.command)
        for age, missing in ((0, 0), (1, 1), (1, 1)):  # of samples 0, 0 and 1
            given = Measurement.of(AT_REST, age * law.timeline.period)
            after = one.step(after, given, at_home, np.zeros(law.reports.size))
            assert after.counts.measurements_missing == missing


def test_servos_do_not_follow_what_is_no_number():
    loop, context, before = next(loops_at(*ON, until=[0.35]))
    servos = loop.GetSubsystemByName("servos")
    own = servos.GetMyContextFromRoot(context)
    inputs = {name: servos.GetInputPort(name).Eval(own) for name in ("command", "arrived", "state")}
    alone = servos.CreateDefaultContext()
    alone.SetTime(0.36)
    alone.SetAbstractState(0, own.get_abstract_state(0).get_value())
    inputs |= {"command": np.full(18, np.nan), "arrived": np.array([0.36])}
    for name, value in inputs.items():
        servos.GetInputPort(name).FixValue(alone, value)
    simulator = Simulator(servos, alone)
    simulator.get_mutable_integrator().set_maximum_step_size(1e-3)
    simulator.AdvanceTo(0.365)
    after = servos.sample(alone).memory
    assert after.segment.end == before.segment.end and np.all(np.isfinite(after.torque))
    assert np.all(np.isfinite(after.setpoint)) and after.arrived == before.arrived


# The figures.


@pytest.mark.parametrize(
    ("controller", "more", "most"),
    [
        ("servo_preview", ON, 0.3),
        ("servo_preview", (*ON, *UNKNOWN), 0.33),
        ("servo_preview", (), 28.0),
        ("servo_preview", (*ON, "plant.gravity=true"), 16.0),
        ("servo_feedforward", ON, 0.005),
        ("servo_feedforward", (*ON, *UNKNOWN, "controller.estimate=[]"), 0.05),
        ("servo_feedforward", (*ON, "plant.gravity=true", "controller.estimate=[]"), 0.02),
        ("servo_feedforward", (*ON, *UNKNOWN, "plant.gravity=true"), 0.2),
    ],
)
@pytest.mark.slow
def test_what_servos_reach_across_the_paper_s_delay(controller, more, most):
    """E_ac in % s; torques across the delay reach 0.03, 1.1, 21, nothing at all under gravity."""
    result = run(*more, controller=controller)
    assert result.status == "completed" and result.summary["warnings"] == []
    assert result.accumulated_error <= most


def test_the_engine_agrees_with_the_exact_plant():
    exact, engine = (run(*ON, "duration=1.2", kind=kind) for kind in ("exact", "multibody"))
    assert engine.accumulated_error == pytest.approx(exact.accumulated_error, rel=0.1)


def test_another_machine_than_the_one_that_is_known():
    """Cranks are where they should be; the plate is where a machine with these cranks has it."""
    known = DYNAMICS.mechanism
    longer = replace(known, rod_lengths=known.rod_lengths * 1.002)
    more = (*HOLD, "duration=1", "start=on_reference")
    result = sd.simulate(scenario(*more), true_mechanism=longer)
    expected = longer.forward_kinematics(known.crank_angles(HOME))
    assert np.allclose(result.signals.pose.values[-1], expected, atol=1e-6)
    assert abs(expected[5] - HOME[5]) > 5e-4


# Scenarios.


def test_compare_gives_every_controller_the_motors_that_it_is_for():
    limit = ("actuator.kind=servo", "actuator.bandwidth=5", "actuator.torque_limit=0.5")
    rows = shown("paper", limit)
    assert tuple(rows) == (*CONTROLLERS, *SERVOS)
    for name, row in rows.items():
        kind = ServoActuatorConfig if name in SERVOS else TorqueActuatorConfig
        assert isinstance(row.actuator, kind) and row.actuator.torque_limit == 0.5
    assert rows["servo_preview"].actuator == ServoActuatorConfig(bandwidth=5, torque_limit=0.5)
    assert tuple(shown("paper")) == CONTROLLERS


def test_a_row_may_have_servos_of_its_own():
    row = "{stiff: {controller: servo_preview, actuator: {bandwidth: 20}, catch_up: 1.0}}"
    rows = load_comparison("paper", CONTROLLERS, [f"compare={row}", "actuator.torque_limit=2"])
    assert rows["stiff"].actuator == ServoActuatorConfig(bandwidth=20, torque_limit=2)
    assert rows["stiff"].controller.catch_up == 1.0
    wrong = "compare={stiff: {controller: servo_preview, actuator: {bandwith: 20}}}"
    with pytest.raises(ConfigError, match=r"compare.stiff.*bandwith: unknown key"):
        load_comparison("paper", CONTROLLERS, [wrong])


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("controller.command=torque",), "controller.command: got 'torque' with actuator.kind"),
        (("link.kind=network",), "link.kind: got 'network' with actuator.kind 'servo'"),
        (("tuner.kind=ann",), "tuner.kind: got 'ann' with controller.command 'cranks'"),
        (
            ("controller.delay_estimator=constant", "controller.estimate=[payload]"),
            "controller.delay_estimator: got 'constant' with controller.command",
        ),
    ],
)
def test_what_does_not_go_with_servos_is_refused(more, said):
    with pytest.raises(ConfigError, match=said):
        scenario(*more)


def test_loops_that_would_be_unstable_are_refused():
    with pytest.raises(ConfigError, match=r"actuator.bandwidth: got 40 Hz; expected less than 3\d"):
        build_closed_loop(scenario("actuator.bandwidth=40"))
    loop = servo_loop(prepare(scenario("actuator.bandwidth=30")))
    assert loop.period == pytest.approx(1e-3)
    assert loop.inertia == pytest.approx(mean_inertia(DYNAMICS))


def test_systems_for_torques_are_refused_and_laws_may_be_changed():
    system = SimpleNamespace()
    for role in ("controller", "link"):
        experiment = prepare(scenario())
        own = experiment.own._replace(systems={role: system})
        with pytest.raises(ConfigError, match=f"got 'servo' with a {role} of your own"):
            sd.build_closed_loop(experiment._replace(own=own))
    with pytest.raises(ConfigError, match="expected 'torque', for a law that closes"):
        compose_law(prepare(scenario()))
    changed = sd.simulate(scenario(*ON, "duration=1"), modify_law=lambda law: replace(law))
    assert changed.summary["own"] == {"law": "<lambda>"}
    with pytest.raises(ConfigError, match="expected a ServoPreview"):
        sd.simulate(scenario(), modify_law=lambda law: law.timeline)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_encoders_do_where_the_state_is_not_measured(kind):
    """A payload that nobody told is found through the delay, from crank angles alone."""
    encoders = ("sensor.kind=encoders", "sensor.bits=14", "sensor.samples=20")
    given = (*ON, *encoders, "plant.payload_mass=0.4", "duration=3")
    result = run(*given, controller="servo_feedforward", kind=kind)
    assert result.status == "completed" and result.accumulated_error < 0.05
    assert result.signals.measurement.shape[1] == 120
    density = result.signals.density.values[-1]
    assert np.all(np.isfinite(density))  # which reads the estimate
