"""Setpoints of position servos: the file, the checks, the soft start, the units."""

import re

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.export.setpoints import ServoUnits, load_units, softened
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import data_root
from stewart_drake.law.motion import Preview
from stewart_drake.law.sensing import Measurement
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import compose_servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.signals import POSE, RATES
from tests.screen import too_long

ROBOT = sd.load_mechanism("reachy_mini")
ON = "start=on_reference"


def made(*settings, **options):
    return sd.setpoints("reachy_mini", 50, settings=("duration=2", *settings), **options)


def test_they_are_the_commands_of_the_law():
    """The law of the scenario, without delay and on the reference, for two seconds."""
    scenario = sd.load_scenario("reachy_mini", None, ("delay.steps=0", ON, "duration=2"))
    experiment = prepare(scenario)
    law, motion = compose_servo_law(experiment), experiment.reference
    start = law.command(evaluate(motion, 0.0), law.plant.dynamics.parameters)
    memory, found = law.initial_memory(start), []
    for k in range(100):
        row = evaluate(motion, 0.02 * k + law.preview_times[0])
        nothing = np.full(law.reports.size, np.nan)
        seen = Measurement.of(experiment.start)
        memory = law.step(memory, seen, Preview(law.preview_times, row[None]), nothing)
        found.append(memory.command[POSE])
    assert np.allclose(made(ON).angles, found, rtol=0, atol=1e-12)


def test_plain_setpoints_are_the_crank_angles_of_the_motion():
    plain, motion = made(ON, plain=True), prepare(sd.load_scenario("reachy_mini")).reference
    for k in (0, 40, 99):
        pose = evaluate(motion, 0.02 * k + 0.01)[POSE]
        assert plain.angles[k] == pytest.approx(ROBOT.crank_angles(pose), abs=1e-12)
    compensated = made(ON)
    # Where cranks stand nearly still, the rest is torque over stiffness.
    difference = compensated.angles - plain.angles
    expected = (compensated.torques + 0.1 * compensated.crank_rates) / 10.0
    assert np.allclose(difference, expected, atol=1e-12)


def test_they_begin_in_the_turn_of_model_check():
    """Cranks of paper_clear are at -188 degrees at home."""
    settings = ("mechanism=paper_clear", "duration=2")
    clear, home = sd.load_mechanism("paper_clear"), sd.load_mechanism("paper_clear").home
    assert np.abs(clear.crank_angles(home)).max() > np.pi
    first = sd.setpoints("paper", 50, plain=True, settings=settings).angles[0]
    assert first == pytest.approx(clear.crank_angles(home), abs=0.1)


def test_known_friction_of_ball_joints_is_compensated():
    rubbing = made(ON, "plant.ball_joint_friction=0.05")
    assert np.abs(rubbing.angles - made(ON).angles).max() > 1e-3


def test_a_soft_start_begins_at_rest_where_the_head_is():
    pose = ROBOT.home + [0.0, 0.2, 0.0, 0.0, 0.0, -0.01]
    soft = made(start=pose, plain=True)
    assert soft.blend == 1.0
    assert soft.angles[0] == pytest.approx(ROBOT.crank_angles(pose), abs=1e-4)
    assert np.abs(soft.crank_rates[0]).max() < 0.01
    assert np.allclose(soft.angles[50:], made(ON, plain=True).angles[50:], atol=1e-12)
    low = ROBOT.home + [0.0, 0.4, 0.0, 0.0, 0.0, -0.04]
    assert np.abs(made(start=low, plain=True).crank_rates).max() > 1.8
    assert made("actuator.speed_limit=1.8", start=low, plain=True).blend == 2.0


def test_a_motion_that_begins_at_rest_where_the_head_is_needs_no_soft_start():
    move = "reference={kind: reachy_move, file: look_around}"
    soft, on = (made(move, f"start={start}", plain=True) for start in ("rest", "on_reference"))
    assert soft.blend == 0 and np.array_equal(soft.angles, on.angles)
    assert "no soft start: the motion begins at rest" in str(soft)
    assert "warning: the motion goes on to 6 s, beyond the duration: --set duration=6" in str(soft)
    assert made(move, start=ROBOT.home + [0, 0.1, 0, 0, 0, 0], plain=True).blend == 1.0


def test_the_soft_start_has_the_rates_of_its_pose():
    rng, h, start = np.random.default_rng(2), 1e-6, np.zeros(6)
    amplitude = rng.standard_normal(6)

    def at(t):
        sine, cosine = np.sin(2 * t), np.cos(2 * t)
        wanted = np.concatenate([amplitude * x for x in (sine, 2 * cosine, -4 * sine)])
        return softened(wanted, start, t, 1.5)

    for t in (0.3, 1.2, 1.49, 2.0):
        slope = (at(t + h) - at(t - h)) / (2 * h)
        assert slope[:12] == pytest.approx(at(t)[6:], abs=1e-6)
    assert not at(0.0)[RATES].any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (("actuator.torque_limit=0.2",), r"motor 4 needs a torque of .* N m \(t = 1\.98 s\)"),
        (("actuator.speed_limit=0.5",), r"motor \d needs a speed .* at most 0\.5 rad/s"),
        (("actuator.angle_range=[-0.6, 1.0]",), r"motor \d needs a setpoint of .* -0\.6 to 1 rad"),
        (("reference.amplitude=[0.9, 0, 0, 0, 0, 0]",), r"leg \d reached the end .* at t"),
        (("actuator.kind=torque", "controller.command=torque"), "actuator.kind: got 'torque'"),
    ],
)
def test_a_broken_limit_is_refused_with_time_and_motor(settings, message):
    with pytest.raises(ConfigError, match=message) as said:
        made(*settings)
    assert "\n" not in str(said.value)


@pytest.mark.parametrize("rate", [0, -50, 0.1, 1e6, float("nan")])
def test_a_rate_out_of_range_is_refused(rate):
    with pytest.raises(ConfigError, match="rate: got"):
        sd.setpoints("reachy_mini", rate)


BESIDE = [0, 0, 0, 0.2, 0, 0.23]


@pytest.mark.parametrize("pose", [[0, 0, 0], [np.nan] * 6, [0, 0, 0, 0, 0, 1.0], BESIDE])
def test_a_pose_that_the_head_cannot_have_is_refused(pose):
    with pytest.raises(ConfigError, match="start: got"):
        made(start=pose)


def test_units_are_those_of_the_servos(tmp_path):
    angles = np.array([[np.pi / 2, -np.pi / 4, 0.0, 1.0, 0.1, np.pi]])
    ticks = ServoUnits(unit="ticks", offset=2048.0, sign=[1, -1, 1, 1, 1, 1])
    assert ticks.converted(angles)[0].tolist() == [3072, 2560, 2048, 2700, 2113, 4096]
    degrees = ServoUnits(unit="deg", offset=[1.0, 0, 0, 0, 0, 0])
    assert degrees.converted(angles)[0, :2] == pytest.approx([91.0, -45.0])
    path = tmp_path / "units.yaml"
    path.write_text("unit: ticks\nticks_per_turn: 16384\noffset: 2048.0\n")
    assert load_units(path) == ServoUnits("ticks", 16384.0, 2048.0)
    turns = "unit: deg\nticks_per_turn: 4096"
    for wrong in (
        "unit: turns",
        "sign: 2",
        "offset: [1.0, 2.0]",
        "ticks: 3",
        "sign: .nan",
        turns,
        "unit: ticks",
    ):
        path.write_text(wrong + "\n")
        with pytest.raises(ConfigError, match=r"^[^\n]*units\.yaml: [^\n]*$") as said:
            load_units(path)
        assert str(said.value).count("; expected") <= 1  # one complaint about one field


def test_a_motion_shorter_than_its_soft_start_is_refused():
    with pytest.raises(ConfigError, match=r"duration: got 0\.9 s; expected at least 1 s"):
        made("duration=0.9")
    assert made("duration=0.9", ON).blend == 0


@pytest.mark.parametrize(("duration", "said"), [(3, True), (2, False), (1.5, False)])
def test_the_command_says_where_a_shorter_motion_ends(duration, said, tmp_path, capsys):
    poses = [ROBOT.home.tolist(), (ROBOT.home + [0, 0.1, 0, 0, 0, 0]).tolist()]
    motion = f"reference={{kind: waypoints, times: [0, 2], poses: {poses}}}"
    settings = ["--set", motion, "--set", f"duration={duration}"]
    assert main(["setpoints", "--out", str(tmp_path / "a.csv"), *settings]) == 0
    line = f"\nthe motion ends at 2 s: its last pose is held up to {duration} s\n"
    assert (line in capsys.readouterr().out) == said


def test_a_file_that_cannot_be_written_is_one_line(tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("x")
    for wanted in (log / "a.csv", tmp_path):
        with pytest.raises(ConfigError, match=r"^out: got [^\n]*can be written [^\n]*$"):
            made(ON, out=wanted)


def test_the_command_writes_the_file(tmp_path, capsys):
    out, units = tmp_path / "made/setpoints.csv", tmp_path / "units.yaml"
    units.write_text("unit: deg\n")
    common = ["setpoints", "reachy_mini", "--out", str(out), "--set", "duration=1"]
    assert main(common) == 0
    assert "50 compensated setpoints at 50 Hz" in capsys.readouterr().out
    header, *rows = out.read_text().splitlines()
    assert header == "time[s]," + ",".join(f"setpoint_{leg}[rad]" for leg in range(1, 7))
    table = np.array([[float(x) for x in row.split(",")] for row in rows])
    again = sd.setpoints("reachy_mini", settings=("duration=1",))
    assert np.allclose(table, np.column_stack([again.times, again.angles]), atol=1e-8)
    home = ",".join(map(str, ROBOT.home))
    assert main([*common, "--rate", "100", "--plain", "--from", home, "--units", str(units)]) == 0
    header, *rows = out.read_text().splitlines()
    assert "setpoint_6[deg]" in header and len(rows) == 100
    kept, missing = out.read_text(), str(tmp_path / "none.yaml")
    for option, wrong in (("--from", "0,0,0,0,0,1"), ("--rate", "0"), ("--units", missing)):
        assert main([*common, option, wrong]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and (option == "--units" or f"error: {option}: got" in said)
    assert main([*common, "--set", ON, "--set", "actuator.speed_limit=0.5"]) == 2
    assert re.fullmatch(r"error: motor \d needs a speed .*\n", capsys.readouterr().err)
    assert out.read_text() == kept


@pytest.mark.parametrize(("duration", "says"), [(1.0, True), (6.0, False)])
def test_a_move_that_is_cut_in_motion_says_so(duration, says):
    """A move of 6 s that ends at rest, whole and cut."""
    file = data_root() / "diagrams" / "moves" / "look_around.json"
    move = f"reference={{kind: reachy_move, file: {file}}}"
    scenario = sd.load_scenario("reachy_mini", settings=(move, f"duration={duration}"))
    said = str(sd.setpoints(scenario))
    assert ("the last setpoint is in motion" in said) == says
    assert ("the motion goes on to 6 s, beyond the duration" in said) == says


@pytest.mark.parametrize("soft_end", [False, True])
def test_a_first_setpoint_in_motion_is_said(soft_end):
    assert "the first setpoint is in motion (1 rad/s)" in str(made(ON, soft_end=soft_end))
    assert "the first" not in str(made(soft_end=soft_end))


def test_setpoints_too_rare_for_the_torque_are_said():
    said = str(sd.setpoints("reachy_mini", 5))
    assert "  more than their 0.8 N m: raise --rate" in said and not too_long(said)
    assert "raise" not in str(made())


@pytest.mark.parametrize(
    ("pose", "hint"),
    [([10, 0, 0, 0, 0, 0.2], "degrees"), ([10, 0, 0, 0, 0, 230], "degrees and mm"),
     ([0, 0, 0, 0, 0, 230], "mm"), ([0, 0, 0, 0, 0, 0.4], "")],
)  # fmt: skip
def test_a_pose_out_of_reach_gets_that_of_home(pose, hint):
    end = f" (are these {hint}?)" if hint else ""
    words = f"as home 0,0,0,2.469e-05,-0.0008951,0.2327{end}"
    with pytest.raises(ConfigError, match=re.escape(words) + "$"):
        made(start=pose)


@pytest.mark.parametrize("start", ["on_reference", "rest"])
def test_a_soft_end_comes_to_rest(start):
    """The motion is that without it until the last second, and consistent with its rates."""
    settings, rate = (f"start={start}",), 200.0
    soft = sd.setpoints("reachy_mini", rate, soft_end=True, settings=settings)
    plain = sd.setpoints("reachy_mini", rate, settings=settings)
    before = soft.times < 7 - 1 / rate
    assert np.abs(soft.angles[before] - plain.angles[before]).max() < 1e-12
    assert np.abs(soft.crank_rates[-1]).max() < 1e-5 < 0.1 < np.abs(plain.crank_rates[-1]).max()
    slopes = np.gradient(soft.cranks, 1 / rate, axis=0)[2:-2]
    assert np.abs(slopes - soft.crank_rates[2:-2]).max() < 1e-3  # h^2 / 6 of the third derivative


def test_the_torque_of_a_held_setpoint():
    """The motion leads the angle of a setpoint by half of its period at most."""
    made = sd.setpoints("reachy_mini", 50.0)
    stiffness = sd.load_scenario("reachy_mini").actuator.stiffness
    step = stiffness * np.abs(np.diff(made.angles, axis=0)).max() / 2
    assert step == pytest.approx((made.steps - np.abs(made.torques)).max(), rel=0.1)
    assert f"up to {made.steps.max():.3g} N m where they change" in str(made)
