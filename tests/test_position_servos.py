"""Servos given by their stiffness, and friction of ball joints, against other calculations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.law.motion import Preview
from stewart_drake.law.sensing import Measurement
from stewart_drake.loop.bulk import ending_of, run_in_bulk
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import commands_in_flight, compose_servo_law, servo_law
from stewart_drake.mechanism import kinematics
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import fingerprint, with_rotors
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.signals import (
    BALL_JOINTS,
    NUM_PLANT_PARAMETERS,
    PARAMETERS,
    PLANT_PARAMETERS,
    POSE,
    RATES,
)
from stewart_drake.studies.compare import shown
from tests.backends import with_own

PAPER = sd.load_mechanism("paper")
SERVO = (
    *("actuator.kind=position_servo", "actuator.stiffness=40", "actuator.armature=0.002"),
    *("plant.kind=exact", "plant.gravity=true", "controller.period=0.02"),
    *("controller.estimate=[]", "delay.steps=2", "delay.fraction=0.25"),
)
C, F, S = 0.2, 0.3, 0.1
"""Damping, friction and its speed of a ball joint."""
WITH_FRICTION = {
    "all": np.ones((2, 6)),
    "cranks": np.array([[1] * 6, [0] * 6]),
    "plate": np.array([[0] * 6, [1] * 6]),
    "one rod with both": np.array([[1] * 6, [0] * 5 + [1]]),
}


def scenario(*more, controller="servo_feedforward"):
    return sd.load_scenario("paper", controller, (*SERVO, *more))


# Friction of ball joints.


def rubbing(joints):
    machine = replace(PAPER, ball_joints=joints)
    values = np.zeros(NUM_PLANT_PARAMETERS)
    values[9], values[BALL_JOINTS] = 0.02, (C, F, S)
    free = sd.StewartDynamics(machine)
    return sd.StewartDynamics(machine, True, values, PLANT_PARAMETERS), free


def potential(joints, pose, rates):
    """Return the least sum of c w^2 / 2 + f s log cosh(w / s) over the spins of the rods."""
    legs, w = kinematics.legs_along(PAPER, pose), kinematics.angle_rate_map(pose[:3]) @ rates[:3]

    def of_joint(velocity):
        turn = np.linalg.norm(velocity)
        share = turn / S
        return C * turn**2 / 2 + F * S * (share + np.log1p(np.exp(-2 * share)) - np.log(2))

    total = 0.0
    for i in range(6):
        rod, length = legs.rod[i], PAPER.rod_lengths[i]
        v_Q = rates[3:] + np.cross(w, legs.p_PQ_W[i])
        crank_rate = rod @ v_Q / (PAPER.crank_lengths[i] * legs.transmission[i])
        v_T = PAPER.crank_lengths[i] * crank_rate * legs.tangent[i]
        turning = np.cross(rod, v_Q - v_T) / length
        at_crank, at_plate = turning - crank_rate * PAPER.R_WS[i, :, 2], w - turning

        def of_spin(z, at_crank=at_crank, at_plate=at_plate, rod=rod, i=i):
            ends = joints[:, i]
            return ends[0] * of_joint(at_crank + z * rod) + ends[1] * of_joint(at_plate - z * rod)

        options = {"bounds": (-40, 40), "method": "bounded", "options": {"xatol": 1e-12}}
        total += minimize_scalar(of_spin, **options).fun
    return total


@pytest.mark.parametrize("which", WITH_FRICTION)
def test_ball_joints_resist_by_the_slope_of_their_least_potential(which):
    """Virtual work: the generalised force is the derivative of the potential by the rates."""
    joints, rng, h = WITH_FRICTION[which], np.random.default_rng(4), 1e-4
    pose, rates = PAPER.home + 0.02 * rng.standard_normal(6), rng.standard_normal(6)
    dynamics, free = rubbing(joints)
    slope = [
        (potential(joints, pose, rates + h * unit) - potential(joints, pose, rates - h * unit))
        / (2 * h)
        for unit in np.eye(6)
    ]
    force = dynamics.bias(pose, rates) - free.bias(pose, rates)
    assert np.abs(force).max() > 0.1
    assert np.allclose(force, slope, rtol=0, atol=1e-6)


@pytest.mark.parametrize("which", ["all", "one rod with both"])
def test_derivatives_with_ball_joints_are_those_of_the_accelerations(which):
    rng, h = np.random.default_rng(5), 1e-6
    pose, rates = PAPER.home + 0.02 * rng.standard_normal(6), rng.standard_normal(6)
    dynamics, _ = rubbing(WITH_FRICTION[which])
    torque, state = rng.standard_normal(6), np.concatenate([pose, rates])
    found = dynamics.derivatives(pose, rates, torque)
    for matrix, units, change in (
        (found.A, np.eye(12), lambda d: dynamics.change(state + d, torque)),
        (
            found.G[:, BALL_JOINTS],
            np.eye(NUM_PLANT_PARAMETERS)[BALL_JOINTS],
            lambda d: dynamics.assuming(dynamics.parameters + d).change(state, torque),
        ),
    ):
        slope = np.array([(change(h * u) - change(-h * u)) / (2 * h) for u in units]).T
        assert np.abs(matrix - slope).max() < 1e-7 * np.abs(slope).max()


def test_a_file_lists_the_ball_joints_with_friction(tmp_path):
    machine = replace(PAPER, ball_joints=WITH_FRICTION["one rod with both"])
    path = tmp_path / "rubbing.yaml"
    path.write_text(mechanism_yaml(machine))
    assert "ball_joints" not in mechanism_yaml(PAPER)
    assert np.array_equal(load_mechanism(path).ball_joints, machine.ball_joints)
    assert fingerprint(load_mechanism(path)) == fingerprint(machine) != fingerprint(PAPER)
    path.write_text(mechanism_yaml(PAPER) + "ball_joints: {crank: [7]}\n")
    with pytest.raises(ConfigError, match=r"ball_joints\.crank.*7.*6"):
        load_mechanism(path)


# The servo.


@pytest.mark.parametrize("controller", ["servo_preview", "servo_feedforward"])
@pytest.mark.parametrize("limit", [None, 0.9])
def test_a_run_is_that_of_the_formula(controller, limit):
    """The same setpoints, held, with torque, friction and armature written out here."""
    more = ("duration=0.3", "plant.accuracy=1e-11", "actuator.velocity_gain=0.2")
    limits = () if limit is None else (f"actuator.torque_limit={limit}",)
    sc = scenario(*more, *limits, controller=controller)
    experiment = prepare(sc)
    law, planned, _ = servo_law(experiment)
    machine = with_rotors(PAPER, 0.002)
    dynamics = sd.StewartDynamics(machine, True)

    def friction(crank_rates):
        return 0.15 * crank_rates + 0.1 * np.tanh(crank_rates / 0.05)

    def setpoint(middle):
        x = evaluate(planned, middle)
        jacobian = machine.jacobian(x[POSE])
        angles, crank_rates = machine.crank_angles(x[POSE]), jacobian @ x[RATES]
        if controller == "servo_preview":
            return angles
        torque = dynamics.inverse_dynamics(x[:6], x[6:12], x[12:]) + friction(crank_rates)
        return angles + (torque + 0.2 * crank_rates) / 40

    def slope(_, state, u):
        angles = machine.crank_angles(state[POSE])
        crank_rates = machine.jacobian(state[POSE]) @ state[RATES]
        error = (u - angles + np.pi) % (2 * np.pi) - np.pi
        torque = 40 * error - 0.2 * crank_rates
        if limit is not None:
            torque = np.clip(torque, -limit, limit)
        return dynamics.change(state, torque - friction(crank_rates))

    first, queue = commands_in_flight(experiment, law, law.timeline.delay)
    flying = [first, *queue]
    begins = [-1.0, *(0.005 + 0.02 * k for k in range(len(queue)))]  # eta0 = 0.005
    commands = [c[POSE] for c in flying] + [setpoint(0.02 * k + 0.045 + 0.01) for k in range(13)]
    begins += [0.02 * k + 0.045 for k in range(13)]
    state = experiment.start
    for u, begin, end in zip(commands, begins, [*begins[1:], 1.0], strict=True):
        if max(begin, 0.0) < min(end, 0.3):
            span = max(begin, 0.0), min(end, 0.3)
            run = solve_ivp(slope, span, state, "DOP853", args=(u,), rtol=1e-11, atol=1e-12)
            state = run.y[:, -1]
    result = sd.simulate(sc, judge_stability=False)
    found = [result.signals[name].values[-1] for name in ("pose", "rates")]
    assert np.abs(np.concatenate(found) - state).max() < 1e-7
    applied = result.signals.torque_applied.values
    if limit is not None:
        assert np.abs(applied).max() <= limit < result.summary["peak_torque"]
        assert result.summary["counts"]["saturated_steps"] > 0


def test_a_compensated_setpoint_follows_the_reference():
    """The hold of the setpoint leaves an error of the second order, all else is known."""
    on = ("start=on_reference", "queue=reference", "duration=1")
    plain = run_in_bulk(scenario(*on, controller="servo_preview")).figures.accumulated_error
    errors = [
        run_in_bulk(scenario(*on, f"controller.period={dt}")).figures.accumulated_error
        for dt in (0.02, 0.01)
    ]
    assert errors[0] < plain / 20
    assert errors[1] < errors[0] / 2.5


@pytest.mark.parametrize(
    "more",
    [
        ("actuator.torque_limit=0.8", "queue=equilibrium"),
        ("delay.jitter_std=0.02", "plant.ball_joint_friction=0.02", "plant.payload_mass=0.5"),
    ],
)
def test_bulk_runs_are_those_of_drake(more):
    sc = scenario("duration=0.4", "plant.accuracy=1e-10", *more)
    native, drake = run_in_bulk(sc), ending_of(sd.simulate(sc, judge_stability=False))
    assert native.loop == "native" and native.status == drake.status
    assert np.allclose(native.figures, drake.figures, rtol=1e-6)
    assert np.allclose(native.samples, drake.samples, atol=1e-5)
    assert native.counts == drake.counts


def test_torques_that_no_report_brought_are_unknown():
    """They counted as zero, or as those of the last report."""
    held, unheard = "queue=equilibrium", "sensor.faults=[{kind: missing, from: 0, to: 9}]"
    results = [
        sd.simulate(scenario("duration=1", held, lost), judge_stability=False).summary
        for lost in ("sensor.loss=0", "sensor.loss=0.5", unheard)
    ]
    whole, half, nothing = (one["rms_torque"] for one in results)
    assert half == pytest.approx(whole, rel=0.05) and np.isnan(nothing)
    assert np.isnan([results[2][name] for name in ("peak_torque", "torque_variation")]).all()
    assert results[2]["peak_torque_applied"] == results[0]["peak_torque_applied"] > 0


def test_estimates_need_the_reports_of_drakes_loop():
    sc = scenario("controller.estimate=[payload]", "duration=0.1")
    assert run_in_bulk(sc).loop == "drake, controller.estimate"


@pytest.mark.parametrize("feedforward", ["none", "equilibrium", "inverse_dynamics"])
def test_commands_are_the_same_with_a_feedforward_in_python(feedforward):
    home = PAPER.crank_angles(PAPER.home)
    ranges = np.column_stack([home - 0.1, home + 0.05])
    limits = ("actuator.speed_limit=3", f"actuator.angle_range={ranges.tolist()}")
    experiment = prepare(scenario(f"controller.feedforward={feedforward}", *limits))
    law = compose_servo_law(experiment)
    assert uncovered_part(law) is None
    rng, mine = np.random.default_rng(6), with_own(law, "feedforward")
    first, _ = commands_in_flight(experiment, law, law.timeline.delay)
    memories = [law.initial_memory(first), mine.initial_memory(first)]
    nothing = np.full(law.reports.size, np.nan)
    for k in range(8):
        row = evaluate(experiment.reference, 0.1 * k)
        row[POSE] += 0.01 * rng.standard_normal(6)
        motion = Preview(law.preview_times, row[None])
        for i, one in enumerate((law, mine)):
            measured = Measurement.of(experiment.start)
            memories[i] = one.step(memories[i], measured, motion, nothing)
        angles = memories[0].command[POSE]
        assert np.allclose(memories[1].command, memories[0].command, rtol=0, atol=1e-12)
        assert np.all((angles >= home - 0.1 - 1e-12) & (angles <= home + 0.05 + 1e-12))


def test_setpoints_change_no_faster_than_the_speed_limit():
    experiment = prepare(scenario("actuator.speed_limit=0.5"))
    law = compose_servo_law(experiment)
    assert law.servo.most == pytest.approx(0.01)
    last = np.array([3.1, -3.1, 0.0, 0.5, 0.5, 0.5])
    wanted = np.array([-3.1, 3.1, 0.005, 0.6, 0.4, 0.5])  # the first two are close by, over pi
    moved = law.servo.limited(wanted, last) - last
    assert np.allclose(moved, [0.01, -0.01, 0.005, 0.01, -0.01, 0.0])


@pytest.mark.slow
def test_torque_reports_find_bias_payload_and_damping():
    noise = "sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,1e-2,1e-2,1e-2,1e-3,1e-3,1e-3]"
    bias = [0.1, -0.1, 0.1, 0.0, 0.0, 0.0]
    result = sd.simulate(
        scenario(
            *("controller.estimate=[torque_bias, payload, damping]", "plant.payload_mass=0.5"),
            *(f"plant.torque_bias={bias}", "start=on_reference", "queue=reference", noise),
            "duration=1.5",
        ),
        judge_stability=False,
    )
    found = dict(zip(PARAMETERS, result.signals.parameters.values[-1], strict=True))
    assert result.summary["counts"]["measurements_rejected"] == 0
    assert found["payload_mass"] == pytest.approx(0.5, abs=0.02)
    assert found["joint_damping"] == pytest.approx(0.15, abs=0.02)  # the actuator's own is known
    assert [found[f"torque_bias_{leg}"] for leg in range(1, 7)] == pytest.approx(bias, abs=0.02)


# Scenario files.


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("plant.coulomb_friction=0.1", r"plant\.coulomb_friction: got 0\.1 .*actuator\.friction"),
        ("plant.joint_damping=0.1", r"plant\.joint_damping: got 0\.1 .*actuator\.crank_damping"),
        ("plant.kind=multibody", r"plant\.kind: got 'multibody' .*expected 'exact'"),
        ("actuator.stiffness=0", r"actuator\.stiffness: got 0"),
        ("actuator.angle_range=[1, 0]", r"actuator\.angle_range: .*low below high"),
        ("actuator.angle_range=[[0, 1]]", r"actuator\.angle_range: .*six"),
        ("link.kind=network", r"link\.kind: got 'network' .* a machine and live"),
    ],
)
def test_what_does_not_go_with_these_servos_is_refused(setting, message):
    with pytest.raises(ConfigError, match=message) as said:
        sd.simulate(scenario(setting))
    assert "\n" not in str(said.value)


def test_ball_joints_need_the_exact_plant():
    with pytest.raises(ConfigError, match=r"plant\.ball_joint_friction: got 0\.1 with plant\.kind"):
        sd.load_scenario("paper", None, ("plant.ball_joint_friction=0.1",))


def test_the_controller_knows_ball_joints_from_a_calibration_only():
    sc = scenario("plant.ball_joint_friction=0.1")
    experiment = prepare(sc)
    assert experiment.true_dynamics().plant_parameters[14] == 0.1
    assert experiment.nominal.plant_parameters[14] == 0
    assert np.allclose(experiment.nominal.plant_parameters[7:10], (0.15, 0.1, 0.05))


def test_rows_of_a_comparison_may_change_these_servos():
    servos = ("actuator.kind=position_servo", "plant.kind=exact", "controller.estimate=[]")
    softer = "compare={softer: {controller: servo_preview, actuator: {stiffness: 5.0}}}"
    rows = shown("paper", (*servos, softer))
    assert rows["softer"].actuator.stiffness == 5.0
    assert {"servo_preview", "servo_feedforward", "softer"} == set(rows), "only what servos can run"
    assert rows["servo_preview"].actuator.stiffness == 10.0
