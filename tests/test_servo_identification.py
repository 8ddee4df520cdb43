"""Position servos from logs: of Drake's loop, with known statistics, and bad ones."""

import dataclasses
import json
import math

import numpy as np
import pytest
import yaml

import stewart_drake as sd
from stewart_drake import functions
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.functions import _write_servos
from stewart_drake.identification import servo_fit
from stewart_drake.identification.logs import angle_std
from stewart_drake.identification.progress import shown_by
from stewart_drake.identification.servo_fit import (
    NAMES,
    ServoIdentification,
    ServoModel,
    _fitted,
    identify_servos,
    regression,
)
from stewart_drake.identification.servo_logs import ServoLog, read_servo_log, servo_log
from stewart_drake.identification.servo_plan import mixed_motion, plan_servos
from stewart_drake.law.servos import PositionServo, crank_mobility
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.servo_identification import document
from tests.screen import too_long

pytestmark = pytest.mark.usefixtures("blank_figures")

ROBOT = sd.load_mechanism("reachy_mini")
CODE = 2 * math.pi / 2**12
SERVO = {
    "stiffness": 2.54,
    "velocity_gain": 0.02,
    "crank_damping": 0.075,
    "friction": 0.058,
    "armature": 0.0018,
}
DELAY = 0.0453
TRUE = np.array([DELAY, 2.54, 0.095, 0.058, 0.05, 0.0018, 0.0, 0.0])


def rounded(cranks, seed=0):
    phase = np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
    return CODE * (np.round(cranks / CODE - phase) + phase)


@pytest.fixture(scope="module")
def drake_log(tmp_path_factory):
    """Return times, setpoints and measured cranks (n, 6) of a run in Drake's loop."""
    motion = np.vstack(mixed_motion(np.repeat([0.15, 0.004], 3), 9.0, 0.02)[:2])
    motion = np.vstack([motion, np.zeros((20, 6))])
    rows = [",".join(map(str, [0.02 * k, *x])) for k, x in enumerate(ROBOT.home + motion)]
    path = tmp_path_factory.mktemp("motion") / "motion.csv"
    path.write_text("\n".join(["time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]", *rows]))
    settings = (
        *(f"actuator.{name}={value}" for name, value in SERVO.items()),
        *(f"reference={{kind: csv, file: {path}}}", "duration=6", "start=on_reference"),
        *("queue=reference", "delay.steps=2", f"delay.fraction={DELAY / 0.02 - 2:.9g}"),
    )
    sc = sd.load_scenario("reachy_mini", "servo_preview", settings)
    result = sd.simulate(sc, judge_stability=False)
    _, planned, _ = servo_law(prepare(sc))
    times = 0.02 * np.arange(300)
    # A setpoint is for the middle of its hold.
    sent = [ROBOT.crank_angles(evaluate(planned, t + DELAY + 0.01)[:6]) for t in times]
    poses = result.signals.pose.sel(time=times, method="nearest").values
    cranks = np.array([ROBOT.crank_angles(pose) for pose in poses])
    return times, np.array(sent), rounded(cranks)


def as_csv(path, times, setpoints, cranks):
    names = [f"{name}_{leg}[rad]" for name in ("setpoint", "crank") for leg in range(1, 7)]
    rows = np.column_stack([times, setpoints, cranks])
    lines = [",".join(["time[s]", *names]), *(",".join(f"{x:.9g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.slow
def test_servos_of_a_run_in_drake_are_found(drake_log, tmp_path, capsys):
    path = as_csv(tmp_path / "log.csv", *drake_log)
    out = tmp_path / "out"
    out.mkdir()
    earlier = out / "found.yaml"  # of a log of torques, whose machine goes as well
    earlier.write_text("mechanism: mechanism.yaml")
    words = ["identify", str(path), "--mechanism", "reachy_mini", "--velocity-gain", "0.02"]
    assert main([*words, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert not too_long(said)
    assert "mass of 0.280 kg is taken as known" in " ".join(said.split())
    assert not earlier.exists()
    summary = json.loads((out / "summary.json").read_text())
    found = summary["parameters"]
    value = np.array([found[name]["value"] for name in NAMES])
    assert abs(value[0] - DELAY) < 3e-3
    assert value[1] == pytest.approx(2.54, rel=0.05)
    assert value[0] + value[2] / value[1] == pytest.approx(DELAY + 0.095 / 2.54, abs=1e-3)
    assert value[3] / value[1] == pytest.approx(0.058 / 2.54, rel=0.05)
    assert not any(value[6:])
    widths = np.array([found[name]["interval"] for name in NAMES[:6]], dtype=float)
    assert np.all(np.abs(value - TRUE)[:6] < 2 * widths)
    sc = sd.load_scenario("reachy_mini", None, (f"overlay={out / 'servos.yaml'}",))
    assert sc.actuator.stiffness == pytest.approx(value[1], rel=1e-5)
    assert sc.actuator.velocity_gain == 0.02
    assert sc.actuator.crank_damping == pytest.approx(value[2] - 0.02, abs=1e-5)
    over = ("delay.steps=13", f"overlay={out / 'servos.yaml'}")
    assert sd.load_scenario("reachy_mini", None, over).eta == 0.26


@pytest.mark.slow
def test_servos_are_found_from_the_log_of_a_simulation(tmp_path, capsys):
    log, out = tmp_path / "log.csv", tmp_path / "out"
    assert main(["simulate", "reachy_mini", "--log", str(log), "--quiet"]) == 0
    plate = sd.read_log(log).pose.values
    cranks = read_servo_log(log, ROBOT).cranks
    assert np.allclose(cranks[7], ROBOT.crank_angles(plate[7]), atol=1e-12)
    known = ["--mechanism", "reachy_mini", "--bits", "14", "--out", str(out)]
    assert main(["identify", str(log), *known]) == 0
    found = json.loads((out / "summary.json").read_text())["parameters"]
    assert found["stiffness"]["value"] == pytest.approx(10, rel=0.01)
    assert found["delay"]["value"] == pytest.approx(0.04, abs=1e-3)
    assert yaml.safe_load((out / "servos.yaml").read_text())["actuator"]["velocity_gain"] == 0.1
    capsys.readouterr()
    head, *rows = log.read_text().splitlines()
    log.write_text("\n".join([head, *rows[::2]]))
    assert main(["identify", str(log), "--mechanism", "reachy_mini"]) == 2
    assert "got a step of 0.04 s, longer than the controller's 0.02 s" in capsys.readouterr().err
    log.write_text("\n".join([head, *(row.rsplit(",", 12)[0] + "," * 12 for row in rows)]))
    assert main(["identify", str(log), "--mechanism", "reachy_mini"]) == 2
    assert "as a log of `machine`; expected" in capsys.readouterr().err


def test_a_log_is_read_before_its_velocity_gain_is_refused(tmp_path, capsys):
    words = ["--mechanism", "reachy_mini", "--velocity-gain", "0.1"]
    assert main(["identify", str(tmp_path / "missing.csv"), *words]) == 2
    assert "missing.csv: cannot be read (No such file" in capsys.readouterr().err
    settings = ("duration=0.5",)
    sd.simulate(sd.load_scenario("reachy_mini", settings=settings)).save(tmp_path / "run")
    assert main(["identify", str(tmp_path / "run"), *words]) == 2
    said = capsys.readouterr().err
    assert "servos are found from CSV" in " ".join(said.split()) and "velocity" not in said


def test_the_regression_is_a_start(drake_log):
    times, setpoints, cranks = drake_log
    log = servo_log("log", times, setpoints, cranks, ROBOT)
    theta = regression(ServoModel(log, ROBOT, 0.8), ball_joints=False)
    assert theta[1] == pytest.approx(2.54, rel=0.1)
    assert theta[0] + theta[2] / theta[1] == pytest.approx(DELAY + 0.095 / 2.54, abs=0.01)


@pytest.mark.slow
def test_friction_of_ball_joints_is_found():
    """The log is of the same equations with friction; its numbers are unknown to the fit."""
    true = TRUE.copy()
    true[6:] = 0.0127, 0.015
    log, said = log_of(mixed(5.0), true), list[str]()
    with shown_by(said.append):
        found = identify_servos(log, ROBOT, angle_std(12))
    assert said[:2] == ["servos", "servos, iteration 1 of at most 20"]
    assert "friction of the ball joints" in said
    assert found.theta[6:] == pytest.approx(true[6:], rel=0.1)
    assert found.residual < 1.1 * angle_std(12)


def log_of(model, theta, change=None):
    """Return the log of a model with these numbers; `change` (n, 6) is added to the cranks."""
    states = model.states(theta)
    cranks = np.array([ROBOT.crank_angles(x[:6]) for x in states])
    times, setpoints = model.log.times, model.log.setpoints
    measured = rounded(cranks if change is None else cranks + change)
    return servo_log("log", times, setpoints, measured, ROBOT)


def fits_of(log):
    """Return the first fit of `identify`, to all samples alike, and the one that it gives."""
    fits = []

    def kept(*arguments):
        fits.append(_fitted(*arguments))
        return fits[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(servo_fit, "_fitted", kept)
        found = identify_servos(log, ROBOT, angle_std(12))
    np.testing.assert_array_equal(fits[0].free, range(6))
    return fits[0], found


def mixed(duration):
    """Return the model of a log in s without measurements."""
    motion = ROBOT.home + np.vstack(mixed_motion(np.repeat([0.2, 0.005], 3), duration, 0.02))
    setpoints = np.array([ROBOT.crank_angles(pose) for pose in motion])
    times = 0.02 * np.arange(len(setpoints))
    given = ServoLog("log", times, setpoints, setpoints, ROBOT.home[None])
    return ServoModel(given, ROBOT, 0.8)


@pytest.mark.slow
def test_cranks_that_stick_do_not_move_the_delay():
    """Slow cranks stay behind by two codes, which no friction of the fit explains."""
    model = mixed(5.0)
    rates = np.array([ROBOT.jacobian(x[:6]) @ x[6:] for x in model.states(TRUE)])
    stuck = -2 * CODE * np.sign(rates) * np.exp(-np.abs(rates) / 0.1)
    plain, found = fits_of(log_of(model, TRUE, stuck))
    error, before = found.theta[0] - DELAY, plain.theta[0] - DELAY
    assert abs(error) < min(abs(before) / 2, found.intervals[0], 1e-3)


def with_soft_friction(model, late, lead):
    """Return the cranks (n, 6) at the times of a log under F clip((a' + lead a'') / s, -1, 1).

    MuJoCo has such friction: it changes its sign before a crank does. Steps have 1 ms.
    """
    log, h = model.log, 1e-3
    smooth = TRUE.copy()
    smooth[3] = 0.0
    dynamics, servo = model._dynamics(smooth), PositionServo(TRUE[1], 0.0, 0.8)
    geometry, slope = ROBOT.numbers, TRUE[3] / TRUE[4]
    pose, rates, friction, cranks = log.poses[0].copy(), np.zeros(6), np.zeros(6), []
    for k in range(round(log.times[-1] / h) + 1):
        if k % 20 == 0:
            cranks.append(ROBOT.crank_angles(pose))
        row = max(0, math.floor((k * h - late) / 0.02 + 1e-9))
        state = np.concatenate([pose, rates])
        torque = servo.torques(geometry, log.setpoints[row], state)[1]
        J, G = ROBOT.jacobian(pose), crank_mobility(dynamics, pose)
        free = J @ (rates + lead * dynamics.accelerations(pose, rates, torque))
        for _ in range(10):  # of Gauss and Seidel
            for i in range(6):
                others = lead * (G[i] @ friction - G[i, i] * friction[i])
                whole = slope * (free[i] - others) / (1 + slope * lead * G[i, i])
                friction[i] = min(max(whole, -TRUE[3]), TRUE[3])
        change = h * dynamics.accelerations(pose, rates, torque - friction)
        pose, rates = pose + h * (rates + change / 2), rates + change
    return np.array(cranks)


@pytest.mark.slow
def test_friction_that_reverses_early_does_not_move_the_delay():
    model, late = mixed(9.0), 0.045
    cranks = rounded(with_soft_friction(model, late, lead=0.02))
    plain, found = fits_of(servo_log("log", model.log.times, model.log.setpoints, cranks, ROBOT))
    error, before = found.theta[0] - late, plain.theta[0] - late
    assert before > 1.2e-3
    assert abs(error) < min(before / 3, found.intervals[0])
    assert found.intervals[0] < 2e-3


def with_known_statistics(rng, number, blocks):
    """Return a linear fit under errors correlated over 0.3 s, and its error in every unknown."""
    t = 0.02 * np.arange(number)
    noise = np.zeros((number, 6))
    for k in range(1, number):
        noise[k] = 0.94 * noise[k - 1] + rng.standard_normal(6)
    shapes = [np.sin(w * t[:, None] + rng.uniform(0, 6, 6)) for w in (0.9, 1.7, 3.1)]
    jacobian = np.stack(shapes, axis=2)
    flat = jacobian.reshape(-1, 3)
    error = -np.linalg.lstsq(flat, noise.ravel())[0]
    times = np.linspace(0.0, 0.5 + 3.0 * blocks, number)
    log = ServoLog("log", times, *np.full((3, number, 6), [[[0.1]], [[0.0]], [[0.0]]]))
    theta = np.ones(8)
    residuals = (noise.ravel() + flat @ error).reshape(number, 6)
    fit = ServoIdentification(
        ServoModel(log, ROBOT, 1.0),
        theta,
        residuals,
        residuals,
        jacobian,
        np.arange(1, 4),
        rounding=1e-3,
        ball_joints_tried=False,
        iterations=1,
    )
    return fit, error


@pytest.mark.parametrize("blocks", [4, 8])
def test_intervals_cover_the_truth_under_correlated_errors(blocks):
    rng, inside, white = np.random.default_rng(1), 0, 0
    for _ in range(200):
        fit, error = with_known_statistics(rng, 150 * blocks, blocks)
        width = np.array([fit.interval(unit) for unit in np.eye(8)[1:4]])
        inside += np.sum(np.abs(error) < width)
        J = fit.jacobian.reshape(-1, 3)
        naive = fit.residual * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
        white += np.sum(np.abs(error) < 1.96 * naive)
    assert 0.93 < inside / 600 <= 0.995
    assert white / 600 < 0.6  # the covariance alone


def test_a_plan_keeps_the_limits():
    settings = ("actuator.speed_limit=4", "actuator.torque_limit=0.6")
    experiment = prepare(sd.load_scenario("reachy_mini", None, settings))
    plan = plan_servos(experiment, angle_std(12), duration=6.0)
    low, high = np.array(experiment.scenario.actuator.angle_range).T
    setpoints = plan.log.setpoints
    assert np.all((low <= setpoints) & (setpoints <= high))
    assert np.abs(np.diff(setpoints, axis=0)).max() <= 4 * 0.02 + 1e-12
    assert plan.peak_torque <= 0.6 and plan.peak_speed <= 4
    assert np.isfinite(plan.expected.intervals[:6]).all()
    lines = plan.csv.splitlines()
    assert lines[0].startswith("time[s],setpoint_1[rad],") and len(lines) == 301


# Bad logs.


def small(folder, change):
    """Write a small log with changed lines."""
    t = 0.02 * np.arange(250)
    cranks = np.tile(ROBOT.crank_angles(ROBOT.home), (250, 1))
    path = as_csv(folder / "log.csv", t, cranks + 0.01 * np.sin(t)[:, None], cranks)
    path.write_text("\n".join(change(path.read_text().splitlines())))
    return path


def header(old, new):
    return lambda x: [x[0].replace(old, new), *x[1:]]


def off_the_machine(row):
    return ",".join([*row.split(",")[:7], *["1.4"] * 6])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:100], r"got 1\.96 s; expected at least 4 s"),
        (lambda x: [*x[:3], *x[2:]], r"row 4, column time\[s\]: got 0\.02 s after 0\.02 s"),
        (lambda x: [*x[:9], *x[40:]], r"row 10, column time.*at most 0\.1 s"),
        (header("crank_6", "crank_7"), r"row 1: got an unknown column"),
        (header("crank_6[rad]", "crank_6[V]"), r"expected crank_6 in rad or deg"),
        (
            lambda x: [*x[:5], off_the_machine(x[5]), *x[6:]],
            r"row 6: got crank angles .* without a pose; expected those of this mechanism",
        ),
        (lambda x: [*x[:5], x[5].replace("0.08", "nan"), *x[6:]], r"row 6.*finite number"),
    ],
)
def test_a_bad_log_is_refused_with_its_place(tmp_path, change, message):
    with pytest.raises(ConfigError, match=message) as said:
        read_servo_log(small(tmp_path, change), ROBOT)
    assert "\n" not in str(said.value)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--delay", "0.1"], "expected one log, whose delay is found"),
        ([], "got setpoints that hardly change; expected a motion"),
    ],
)
def test_bad_requests_are_one_line(tmp_path, capsys, more, message):
    path = small(
        tmp_path,
        lambda x: [x[0], *(",".join([row.split(",")[0], *x[1].split(",")[1:]]) for row in x[1:])],
    )
    assert main(["identify", str(path), "--mechanism", "reachy_mini", *more]) == 2
    said = capsys.readouterr().err
    assert message in " ".join(said.split())


def test_a_log_of_motors_that_are_off_is_refused_at_once():
    """Without this the fit searches for minutes."""
    times, cranks = 0.02 * np.arange(300), np.tile(ROBOT.crank_angles(ROBOT.home), (300, 1))
    log = servo_log("off", times, cranks + 0.2 * np.sin(times)[:, None], cranks, ROBOT)
    with pytest.raises(ConfigError, match="off: got crank angles that hardly change; expected"):
        identify_servos(log, ROBOT, angle_std(12))


# Logs of another sign, unit or machine.


ALL = set(range(1, 7))


def flipped(*legs):
    def change(setpoints, cranks):
        return setpoints, np.where(np.isin(range(1, 7), legs), 2 * cranks[0] - cranks, cranks)

    return change


def unrelated(setpoints, cranks):
    return setpoints, cranks[0] + np.random.default_rng(0).normal(0, 0.02, cranks.shape)


def small_in_degrees(setpoints, cranks):
    """Degrees of less than a turn."""
    small = (x[0] + (x - x[0]) / 20 for x in (setpoints, np.degrees(cranks)))
    return tuple(small)


@pytest.mark.parametrize(
    ("change", "words", "legs"),
    [
        (flipped(2), "move against their setpoints", {2}),
        (flipped(*ALL), "move against their setpoints", ALL),
        (lambda u, a: (u, a * np.where(np.arange(6) == 3, -1, 1)), "move against", {4}),
        (unrelated, "do not follow their setpoints", ALL),
        (lambda u, a: (u, np.degrees(a)), "more than a turn in rad: crank_1", ALL - {3}),
        (lambda u, a: (np.degrees(u), np.degrees(a)), "a turn in rad: setpoint_1", ALL - {3}),
        (lambda u, a: (np.degrees(u), a), "more than a turn in rad: setpoint_1", set()),
        (small_in_degrees, "motions of cranks over those of their setpoints: ", ALL),
    ],
)
def test_cranks_of_another_sign_or_unit_are_named(drake_log, change, words, legs):
    times, setpoints, cranks = drake_log
    with pytest.raises(ConfigError, match=words) as said:
        servo_log("log.csv", times, *change(setpoints, cranks), ROBOT)
    text = str(said.value)
    assert text.startswith("log.csv: got ") and "; expected " in text and "\n" not in text
    assert {leg for leg in ALL if f"crank_{leg} " in text} == legs


@pytest.mark.parametrize("late", [0.0, 0.2])
@pytest.mark.parametrize("ball_joints", [0.0, 1.0])
def test_weak_servos_with_joints_that_stick_follow_their_setpoints(ball_joints, late):
    """Joints as shipped leave a fifth of the motion."""
    true = TRUE + [late, 0, 0, 0, 0, 0, 0.127 * ball_joints, 0.15 * ball_joints]
    assert log_of(mixed(5.0), true).name == "log"


def test_servos_that_are_too_stiff_take_no_minutes():
    model = mixed(5.0)
    assert model.states(np.array([0.0, 1e4, 1e3, 1e2, 2e-3, 0.0, 0.0, 0.0])) is None
    assert model.steps[-1] <= 25_000


@pytest.mark.slow
def test_a_fit_that_finds_nothing_ends(drake_log):
    """Cranks that move half as far as any servo moves them."""
    times, setpoints, cranks = drake_log
    halved = cranks[0] + (cranks - cranks[0]) / 2
    found = identify_servos(servo_log("log", times, setpoints, halved, ROBOT), ROBOT, angle_std(12))
    assert not found.right
    # Each of two fits may begin an iteration of nine integrations before it ends.
    assert sum(found.model.steps) < 6 * (120_000 + 2 * 9 * 5_000)


def test_ctrl_c_ends_it_with_a_line(drake_log, tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(functions, "identify_servos", interrupted)
    path = as_csv(tmp_path / "log.csv", *drake_log)
    assert main(["identify", str(path), "--mechanism", "reachy_mini"]) == 130
    assert capsys.readouterr().err == "stopped; nothing was written\n"


def test_a_log_that_no_servo_explains_has_neither_intervals_nor_an_overlay(tmp_path):
    rng = np.random.default_rng(0)
    fit, _ = with_known_statistics(rng, 600, 4)
    wrong = dataclasses.replace(fit, residuals=10 + fit.residuals)
    assert not wrong.right and np.isnan(wrong.intervals).all()
    told = " ".join(document(wrong).plain().split())
    assert "Do not use the values" in told and "Next Check units" in told
    assert yaml.safe_dump(wrong.overlay)
    old = tmp_path / "servos.yaml"
    old.write_text("actuator: {stiffness: 1}")  # of an earlier log
    assert _write_servos(wrong, tmp_path) == [] and not old.exists()
