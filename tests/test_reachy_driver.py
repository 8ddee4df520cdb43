"""The driver of Reachy Mini, against a stand-in for the robot's daemon on loopback."""

import json
import runpy
import threading
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.servo_logs import read_servo_log
from stewart_drake.law.servos import Stiffness
from stewart_drake.live.options import MachineOptions
from stewart_drake.live.protocol import (
    SECOND,
    ControllerFlags,
    ControllerMessage,
    Head,
    MachineFlags,
)
from stewart_drake.live.reachy import Daemon, Positions, RobotMachine, SoftSetpoints, open_chosen
from stewart_drake.live.session import drive, prepare_session
from stewart_drake.loop.peer import Fault
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.scenario.signals import POSE
from tests.live_driver import Clock, Wire, in_a_thread, in_real_time, until

server = pytest.importorskip("websockets.sync.server")

ROBOT = sd.load_mechanism("reachy_mini")
SLEEP = ROBOT.crank_angles(ROBOT.home + [0.0, 0.2, 0.0, 0.0, 0.0, -0.01])
STATUS = {
    "type": "daemon_status",
    "state": "running",
    "simulation_enabled": True,
}


class StandIn:
    """A daemon whose head is at once where the last setpoint was; it sends recorded messages."""

    def __init__(self, port=0):
        self.joints, self.sent = np.append(0.1, SLEEP), []
        self.says = "positions"  # or garbage, nothing
        self.motors, self.follows = "enabled", True
        self._server = server.serve(self._serve, "127.0.0.1", port)
        self.port = self._server.socket.getsockname()[1]
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _serve(self, socket):
        reported = ""
        while not self._closing.is_set():
            if reported != (reported := self.motors):
                backend = {"motor_control_mode": self.motors, "error": None}
                socket.send(json.dumps(STATUS | {"backend_status": backend}))
            if self.says == "positions":
                joints = self.joints.tolist()
                message = {"head_joint_positions": joints, "antennas_joint_positions": [-3.0, 3.0]}
                socket.send(json.dumps({"type": "joint_positions"} | message))
                socket.send(json.dumps({"type": "head_pose", "head_pose": np.eye(4).tolist()}))
            elif self.says == "garbage":
                odd = {"type": "joint_positions", "head_joint_positions": [float("nan")] * 7}
                bare = '{"type": "joint_positions"}'
                for text in ("{", b"\0\1", "[]", bare, json.dumps(odd)):
                    socket.send(text)
            self._take(socket, time.monotonic() + 0.02)

    def _take(self, socket, until):
        while (left := until - time.monotonic()) > 0:
            try:
                message = json.loads(socket.recv(timeout=left))
            except TimeoutError:
                return
            assert message["type"] == "set_head_joints" and len(message["joints"]) == 7
            joints = np.array(message["joints"])
            self.sent.append((time.monotonic(), joints))
            if self.follows:
                self.joints = joints

    def close(self):
        self._closing.set()
        self._server.shutdown()
        self._thread.join()


@pytest.fixture
def daemon():
    made = StandIn()
    yield made
    made.close()


# ---------------------------------------------------------------- setpoints without jumps


def soft(low=-10.0, high=10.0, most=np.inf):
    servo = Stiffness(10.0, 0.1, np.full(6, low), np.full(6, high), most)
    return SoftSetpoints(servo, 0.02, np.zeros(6))


def test_setpoints_start_and_end_softly():
    """Rates and their changes stay those of a soft start and of an exponential stop."""
    made, planned = soft(), 0.4 + 0.3 * np.sin(np.pi * 0.02 * np.arange(200))
    rows = [made.step(np.full(6, w)) for w in planned] + [made.step(None) for _ in range(60)]
    u = np.array(rows)[:, 0]
    assert u[60:200] == pytest.approx(planned[60:], abs=1e-12)
    assert abs(u[0]) < 1e-4
    rates = np.diff(u, prepend=0.0) / 0.02
    assert np.abs(np.diff(rates)).max() < 0.25
    assert abs(rates[-1]) < 1e-5
    assert abs(u[-1] - u[199]) < 0.08 * abs(rates[199]) * 1.2


def test_a_short_gap_is_joined_without_a_jump():
    made, planned = soft(), 0.5 * np.sin(np.pi * 0.02 * np.arange(200))
    gap = range(100, 105)
    u = np.array([made.step(None if k in gap else np.full(6, w)) for k, w in enumerate(planned)])
    assert u[116:, 0] == pytest.approx(planned[116:], abs=1e-12)
    assert np.abs(np.diff(u[:, 0])).max() / 0.02 < 4.0


def test_setpoints_keep_range_and_speed():
    made = soft(-0.2, 0.3, 0.01)
    u = np.array([made.step(np.full(6, 1.0)) for _ in range(100)])
    assert u.max() == 0.3
    assert np.diff(u[:, 0]).max() < 0.01 + 1e-12


# ---------------------------------------------------------------- the connection


def test_positions_are_stamped_and_garbage_is_one_line(daemon):
    with closing(Daemon(("127.0.0.1", daemon.port))) as link:
        until(lambda: link.ready and link.simulated)
        assert link.positions[-1].joints == pytest.approx(np.append(0.1, SLEEP))
        assert abs(time.monotonic_ns() - link.positions[-1].stamp) < 1e9
        daemon.says = "garbage"
        until(lambda: not link.ready)
        until(lambda: len(link.lines) == 2)
        odd, lost = link.lines
        assert "sent '{'; expected a message such as joint_positions" in odd
        assert lost.endswith("sent no positions for 0.5 s; the head is held, trying again")
        daemon.says = "positions"
        until(lambda: link.ready)
        until(lambda: "positions come again" in link.lines[-1])


def test_a_daemon_that_stops_is_found_again():
    first = StandIn()
    with closing(Daemon(("127.0.0.1", first.port))) as link:
        until(lambda: link.ready)
        first.close()
        until(lambda: not link.ready)
        time.sleep(1.2)  # more than one attempt
        assert len(link.lines) == 1 and "the head is held, trying again" in link.lines[0]
        second = StandIn(first.port)
        until(lambda: link.ready)
        second.close()


def test_motors_that_are_off_are_reported_and_get_no_setpoints(daemon):
    """Setpoints sent meanwhile would move the head at once when the motors are enabled."""
    daemon.motors = "disabled"
    scenario = sd.load_scenario("reachy_mini", settings=("delay.steps=13",))
    options, said = MachineOptions(reachy=f"127.0.0.1:{daemon.port}", port=0), []
    with open_chosen(scenario, options, said.append) as (machine, _), in_a_thread(machine):
        until(lambda: any("motors disabled: no setpoints are sent" in line for line in said))
        assert not machine._daemon.ready and not daemon.sent
        daemon.motors = "enabled"
        until(lambda: machine._daemon.ready)
        until(lambda: any("motors enabled" in line for line in said))


@pytest.mark.parametrize(
    ("name", "words", "expected"),
    [
        ("reachy_mini", ("--reachy", "127.0.0.1:9"), "got 127.0.0.1:9, which sent no positions"),
        ("reachy_mini", ("--reachy", "nowhere"), "--reachy: got 'nowhere'; expected HOST:PORT"),
        ("reachy_mini", ("--ahead", "0.1"), "--ahead: got 0.1 s without --reachy; expected both"),
        ("paper", ("--reachy", "127.0.0.1:9"), "actuator.kind: got 'torque' with --reachy"),
    ],
)
def test_a_wrong_command_is_one_line(name, words, expected, capsys):
    assert main(["machine", name, *words, "--port", "0"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and expected in said
    assert "trying again" not in said  # the command has ended


class Lost:
    """A daemon without positions."""

    ready, simulated, lines, positions = False, False, (), ()

    def send(self, joints):
        raise AssertionError("a setpoint for a lost daemon")


def test_without_a_daemon_the_drives_have_failed_and_plans_are_not_taken():
    experiment, clock, said = prepare(sd.load_scenario("reachy_mini")), Clock(), []
    options = MachineOptions(reachy="127.0.0.1:9", port=0)
    machine = RobotMachine(experiment, Wire(), options, Lost(), said.append, clock=clock)
    machine._running, machine.begin = True, 0
    machine.advance(SECOND)
    assert machine.reason.fault == Fault.DRIVE
    assert MachineFlags.SAFE in machine._flags() and MachineFlags.SIMULATION not in machine._flags()
    rows = ControllerMessage(
        Head(1, 1, 1, 0, 1, 0, 0), begin=0, torques=np.ones((1, 6)), cranks=True
    )
    machine._obey(rows, SECOND)
    machine.advance(2 * SECOND)
    assert machine._motors.played == 0
    assert np.all(np.isnan(machine._body.measurement()))


class There(Lost):
    """A daemon whose head stays at home; it keeps setpoints with their time."""

    ready, simulated = True, True

    def __init__(self, clock):
        self._clock, self.sent = clock, []
        home = np.append(0.0, ROBOT.crank_angles(ROBOT.home))
        self.positions = [Positions(clock.time, home)]

    def send(self, joints):
        self.sent.append((self._clock.time, joints[1:]))


@pytest.mark.parametrize("ahead", [0.0, 0.03])
def test_setpoints_go_ahead_by_the_delay_of_the_robot(ahead):
    """And they are reported for the time that they are meant for."""
    clock, wire = Clock(), Wire()
    daemon, zero = There(clock), clock.time
    options = MachineOptions(reachy="127.0.0.1:9", port=0, ahead=ahead)
    experiment = prepare(sd.load_scenario("reachy_mini"))
    machine = RobotMachine(experiment, wire, options, daemon, lambda line: None, clock=clock)
    machine.offers.nonce = lambda *_: 9
    P, home = machine.period, ROBOT.crank_angles(ROBOT.home)

    def planned(time):
        return home + 0.05 * time / SECOND

    for k in range(100):
        sampled, playout = k * P, (k + 13) * P
        rows = np.array([planned(playout + i * P) for i in range(16)])
        numbers = (sampled, playout, P, rows)
        head = Head(7, 9, k + 1, 0, 1, 0, 0)
        message = ControllerMessage(head, ControllerFlags(0), *numbers, cranks=True)
        machine._arrive(message, ("127.0.0.1", 50000), sampled)
        for step in range(4):
            clock.time = zero + sampled + step * P // 4
            machine.advance(sampled + step * P // 4)
    sent = daemon.sent[-20:]
    for time_, angles in sent:
        meant = time_ - zero + round(ahead * SECOND)
        assert meant % P == 0
        assert angles == pytest.approx(planned(meant), abs=1e-9)
    last = wire.said[-1]
    assert last.acted[0] == pytest.approx(planned(last.acted_from), abs=1e-12)


# ---------------------------------------------------------------- setpoints of a file


@pytest.mark.slow
@in_real_time
def test_a_file_of_setpoints_is_sent_and_logged(daemon, tmp_path, capsys):
    send = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))["main"]
    file, log = tmp_path / "setpoints.csv", tmp_path / "log.csv"
    chosen = ("duration=5", "reference.frequency=3")
    made = sd.setpoints("reachy_mini", 50, file, plain=True, settings=chosen)
    send([str(file), "--reachy", f"127.0.0.1:{daemon.port}", "--log", str(log)])
    assert "sent 250 setpoints" in capsys.readouterr().out
    joints = np.array([one for _, one in daemon.sent])
    assert np.all(joints[:, 0] == 0.1)  # the body keeps its yaw
    assert np.abs(np.diff(joints[:, 1:], axis=0, prepend=[SLEEP])).max() < 0.05
    assert joints[-250:, 1:] == pytest.approx(made.angles, abs=1e-8)
    logged = read_servo_log(log, ROBOT)
    assert logged.times == pytest.approx(made.times, abs=0.015)
    assert logged.setpoints == pytest.approx(made.angles, abs=1e-8)
    assert logged.cranks[1:] == pytest.approx(logged.setpoints[:-1], abs=0.05)


@pytest.mark.parametrize(
    "rows",
    ["", "0,a,0,0,0,0,0", "0,0,0,0,0,0", "0,nan,0,0,0,0,0", "0,0.9,0,0,0.9,0,0",
     "0,0,0,0,0,0,0\n0.02,0,0,0,0.17,0,0", "0,0,0,0,0,0,0\n0,0,0,0,0,0,0"],
)  # fmt: skip
def test_a_file_beyond_the_limits_is_not_sent(rows, tmp_path):
    send = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))
    servo = sd.load_scenario("reachy_mini").actuator
    assert np.array_equal(send["RANGES"], servo.angle_range)
    assert send["SPEED_LIMIT"] == servo.speed_limit
    file = tmp_path / "setpoints.csv"
    file.write_text(f"{','.join(send['HEADER'][:7])}\n{rows}")
    with pytest.raises(SystemExit, match=r"setpoints\.csv.* expected"):
        send["main"]([str(file), "--reachy", "127.0.0.1:9", "--log", str(tmp_path / "l")])


def test_what_is_no_file_of_setpoints_in_rad_is_not_sent(tmp_path):
    read = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))["read"]
    file, missing = tmp_path / "setpoints.csv", tmp_path / "none.csv"
    for content in (b"\xff\xfe\x91", b"t" + b",a[grad]" * 6 + b"\n0,0,0,0,0,0,0\n"):
        file.write_bytes(content)
        with pytest.raises(SystemExit, match=r"setpoints\.csv: got .* expected"):
            read(file)
    with pytest.raises(SystemExit, match=r"none\.csv: got .*No such file"):
        read(missing)


def test_a_robot_is_not_moved_without_consent(daemon, tmp_path, monkeypatch):
    monkeypatch.setitem(STATUS, "simulation_enabled", False)
    send = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))["main"]
    file = tmp_path / "setpoints.csv"
    sd.setpoints("reachy_mini", 50, file)
    log = tmp_path / "log.csv"
    log.write_text("of an earlier run")
    with pytest.raises(SystemExit, match="--arm: not given"):
        send([str(file), "--reachy", f"127.0.0.1:{daemon.port}", "--log", str(log)])
    assert not daemon.sent and log.read_text() == "of an earlier run"


@pytest.mark.parametrize(
    ("motors", "follows", "expected"),
    [("disabled", True, "motors disabled: nothing is sent"), ("enabled", False, "did not follow")],
)
def test_a_head_that_does_not_follow_gets_no_motion(daemon, tmp_path, motors, follows, expected):
    daemon.motors, daemon.follows = motors, follows
    daemon.joints = daemon.joints + 0.3
    send = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))["main"]
    file, log = tmp_path / "setpoints.csv", str(tmp_path / "l")
    sd.setpoints("reachy_mini", 50, file)
    with pytest.raises(SystemExit, match=expected):
        send([str(file), "--reachy", f"127.0.0.1:{daemon.port}", "--log", log, "--arm"])


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"type": "joint_positions"}'])
def test_unusable_messages_do_not_reach_the_motors(text):
    sender = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))
    positions = {"type": "joint_positions", "head_joint_positions": [0.1, *[0.5] * 6]}
    unusable = ([float("nan")] * 7, [0.1] * 6, [0.1, *[9.0] * 6], [None] * 7)
    bad = [json.dumps(positions | {"head_joint_positions": joints}) for joints in unusable]
    robot = sender["Robot"](Replies([json.dumps(positions), text, *bad]))
    robot.listen(time.monotonic() + 0.02)
    assert robot.yaw == 0.1 and robot.cranks == [0.5] * 6


def test_a_robot_with_unknown_motors_is_not_moved():
    sender = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))
    sender["check"].__globals__["PATIENCE"] = 0.1
    positions = {"type": "joint_positions", "head_joint_positions": [0.1, *[0.5] * 6]}
    with pytest.raises(SystemExit, match="no status"):
        sender["check"](sender["Robot"](Replies([json.dumps(positions)] * 200)), True)


@pytest.mark.slow
def test_a_robot_with_unknown_motors_is_not_driven(daemon, monkeypatch):
    monkeypatch.setitem(STATUS, "type", "other")
    options = MachineOptions(reachy=f"127.0.0.1:{daemon.port}", port=0)
    opened = open_chosen(sd.load_scenario("reachy_mini"), options, [].append)
    with pytest.raises(ConfigError, match="sent no status for 5 s"), opened:
        pass


@pytest.mark.parametrize("address", ["127.0.0.1:x", "127.0.0.1:9"])
def test_an_address_without_a_daemon_is_named(address, tmp_path):
    send = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))["main"]
    file = tmp_path / "setpoints.csv"
    sd.setpoints("reachy_mini", 50, file, settings=("duration=1",))
    with pytest.raises(SystemExit, match=r"daemon at .*; expected .*HOST:PORT"):
        send([str(file), "--reachy", address, "--log", str(tmp_path / "l")])


class Replies:
    """A socket with these messages, then none."""

    def __init__(self, texts):
        self.texts = list(texts)

    def recv(self, timeout):
        if self.texts:
            time.sleep(0.002)
            return self.texts.pop(0)
        time.sleep(timeout)
        raise TimeoutError


@in_real_time
def test_after_a_pause_the_rows_follow_later(daemon):
    """None of those missed is sent at once: the head would jump."""
    sender = runpy.run_path(str(Path(__file__).parents[1] / "analysis/reachy_send.py"))
    rows = [[1e3 + 0.02 * k, *[0.01 * k] * 6] for k in range(50)]
    with sender["connect"](f"ws://127.0.0.1:{daemon.port}/ws/sdk", proxy=None) as socket:
        robot = sender["Robot"](socket)
        sender["check"](robot, False)
        logged = []
        for seconds, (goal, *_) in robot.play(rows):
            logged.append(seconds)
            if goal == 0.2:
                daemon.says = "nothing"
                threading.Timer(0.35, setattr, (daemon, "says", "positions")).start()
    times = np.array([time_ for time_, _ in daemon.sent])
    assert len(times) == 50 and np.diff(times).max() > 0.2 and logged[-1] > 0.98 + 0.2
    assert max(np.sum((times >= t) & (times < t + 0.01)) for t in times) <= 3


# ---------------------------------------------------------------- a whole run


@pytest.mark.slow
@in_real_time
def test_live_moves_the_head(daemon):
    scenario = sd.load_scenario("reachy_mini", settings=("delay.steps=13",))
    options = MachineOptions(reachy=f"127.0.0.1:{daemon.port}", port=0)
    with open_chosen(scenario, options, [].append) as (running, address), in_a_thread(running):
        ready = prepare_session(scenario, address)
        result = drive(ready, 4.0, accept_jitter=True, say=lambda line: None)
        began = (running._started + running.begin) / 1e9
    assert result.status == "completed" and result.summary["live"]["taken_over"]
    times, joints = (np.array(part) for part in zip(*daemon.sent, strict=True))
    assert np.abs(joints[0, 1:] - SLEEP).max() < 0.02  # it begins where the head is
    assert np.all(joints[:, 0] == 0.1)  # the body keeps its yaw
    assert np.abs(np.diff(joints[:, 1:], axis=0)).max() < 0.1
    experiment = prepare(scenario)
    law, reference = servo_law(experiment)[0], experiment.reference
    none = law.plant.dynamics.parameters
    at = (times - began > 2.5) & (times - began < 3.9)
    assert at.sum() > 40
    for time_, row in zip(times[at][::5], joints[at][::5], strict=True):
        wanted = law.command(evaluate(reference, time_ - began + 0.01), none)[POSE]
        assert row[1:] == pytest.approx(wanted, abs=0.05)
