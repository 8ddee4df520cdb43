"""The machine's end in front of Reachy Mini's daemon: plans over UDP, setpoints to the robot.

The daemon's WebSocket sends the positions of the joints, without time stamps, and takes setpoints
that act at once. This process stamps positions on arrival, keeps plans until their time, and
sends one setpoint per period. `live` drives it as any other machine.
"""

import asyncio
import json
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError, optional
from stewart_drake.files.yamlio import brief
from stewart_drake.law.servos import Stiffness, rise
from stewart_drake.live.contact import parse_address
from stewart_drake.live.endpoint import Address, Endpoint, now, read_key
from stewart_drake.live.machine import DRIVES, Machine, check_scenario
from stewart_drake.live.options import MachineOptions
from stewart_drake.live.protocol import (
    NEVER,
    SECOND,
    ControllerMessage,
    MachineFlags,
    MachineMessage,
)
from stewart_drake.live.simulated import Motors
from stewart_drake.loop.peer import Fault, Reason
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.loop.servos import known_stiffness
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import ForwardKinematicsError
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.run_log import Background, open_log
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE, POSE
from stewart_drake.types import Array

JOINTS: Final = 1 + NUM_LEGS
"""Joints of the head: the body's yaw, then the cranks."""
SOFT_START: Final = 1.0
"""Time for joining a plan from rest, s."""
_REJOIN: Final = 0.2
"""The same after a gap of at most this length, s."""
_DECAY: Final = 0.08
"""Time constant with which a crank stops where plans end, s."""
_STILL: Final = 1e-4
"""Rate below which a crank is at rest, rad/s."""
STALE: Final = 0.5
"""Time without positions after which the daemon counts as lost, s."""
_RETRY: Final = 0.5
"""Time between two attempts to connect, s."""
_PATIENCE: Final = 5.0
"""Longest wait for the first positions, s."""
_AHEAD: Final = 0.05
"""Longest time for which a position is extrapolated, s."""
_KEPT: Final = 4
"""Number of positions from which rates are computed; they come in bursts."""
_LEAST_SPAN: Final = 0.03
"""Shortest time between the first and the last of them, s."""
_LONGEST: Final = 1 << 20
"""Longest message of the daemon, bytes."""


class Positions(NamedTuple):
    """Positions (7,) of the joints, rad, and when they came, ns of the own clock."""

    stamp: int
    joints: Array


class Daemon:
    """Connection to the daemon, in a separate thread. It reconnects whenever it is lost.

    Attributes:
        positions: the last ones, the newest last.
        simulated: whether the daemon reports that it simulates the robot.
        problem: why the last connection ended; empty before.
        lines: messages to print, each event once.
    """

    def __init__(self, address: Address) -> None:
        self._where = f"{address[0]}:{address[1]}"
        self._url = f"ws://{self._where}/ws/sdk"
        self.positions: deque[Positions] = deque(maxlen=_KEPT)
        self.simulated, self.lines, self.problem = False, deque[str](), ""
        self._reported_loss = self._reported_message = self._closed = False
        self.has_status = False
        self._motors_on, self._setpoint = True, ""
        self._loop, self._wake = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def ready(self) -> bool:
        """Whether positions come, and the motors are on."""
        there = self.positions
        fresh = bool(there) and now() - there[-1].stamp < STALE * SECOND
        return fresh and self._motors_on

    def send(self, joints: Array) -> None:
        """Send a setpoint (7,) in rad; one that is not sent yet is replaced."""
        text = json.dumps({"type": "set_head_joints", "joints": joints.tolist()})

        def replace() -> None:
            self._setpoint = text
            self._wake.set()

        with suppress(RuntimeError):  # closed
            self._loop.call_soon_threadsafe(replace)

    def close(self) -> None:
        self._closed = True
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(lambda: [one.cancel() for one in asyncio.all_tasks()])
        self._thread.join(2.0)

    def _run(self) -> None:
        with suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._work())
        self._loop.close()

    async def _work(self) -> None:
        from websockets.asyncio.client import connect
        from websockets.exceptions import WebSocketException

        while not self._closed:
            try:
                async with connect(
                    self._url, max_size=_LONGEST, open_timeout=2.0, close_timeout=0.2, proxy=None
                ) as socket:
                    self._setpoint, self._reported_message = "", False
                    writer = asyncio.create_task(self._write(socket))
                    try:
                        await self._read(socket)
                    finally:
                        writer.cancel()
            except TimeoutError:
                self._lose(f"sent no positions for {STALE:g} s")
            except (OSError, WebSocketException) as error:
                self._lose(" ".join(str(error).split()) or type(error).__name__)
            await asyncio.sleep(_RETRY)

    def _lose(self, problem: str) -> None:
        self.problem = problem
        self.positions.clear()
        if not self._reported_loss:
            self._reported_loss = True
            self.lines.append(f"daemon at {self._where}: {problem}; the head is held, trying again")

    async def _write(self, socket: Any) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            text, self._setpoint = self._setpoint, ""
            if text:
                await socket.send(text)

    async def _read(self, socket: Any) -> None:
        """Take messages until no positions have come for STALE seconds."""
        last = now()
        while True:
            left = STALE - (now() - last) / SECOND
            if left <= 0:
                raise TimeoutError
            data = await asyncio.wait_for(socket.recv(), left)
            if self._take(data):
                last = now()

    def _take(self, data: str | bytes) -> bool:
        """Take a message; return whether it has positions."""
        try:
            message = json.loads(data)
            kind = message["type"]
            if kind == "daemon_status":
                self._note(message)
            if kind != "joint_positions":
                return False
            joints = np.array(message["head_joint_positions"], np.float64)
            if joints.shape != (JOINTS,) or not np.all(np.abs(joints) < 2 * math.pi):
                raise ValueError
        except (ValueError, KeyError, TypeError, RecursionError):
            if not self._reported_message:
                self._reported_message = True
                self.lines.append(
                    f"daemon at {self._where}: sent {brief(data)}; expected a message such as "
                    f"joint_positions with {JOINTS} angles in rad; ignored"
                )
            return False
        self.positions.append(Positions(now(), joints))
        if self._reported_loss:
            self._reported_loss = False
            self.lines.append(f"daemon at {self._where}: positions come again")
        return True

    def _note(self, status: dict[str, Any]) -> None:
        self.simulated = any(
            status.get(name) is True for name in ("simulation_enabled", "mockup_sim_enabled")
        )
        mode = (status.get("backend_status") or {}).get("motor_control_mode", "enabled")
        if (mode == "enabled") != self._motors_on:
            self._motors_on = mode == "enabled"
            effect = "start live" if self._motors_on else "no setpoints are sent; enable them"
            self.lines.append(f"daemon at {self._where}: motors {mode}: {effect}")
        self.has_status = True


class SoftSetpoints:
    """Setpoints without jumps, from plans that begin, end and begin again.

    With h coasting to rest from where plans ended, w the planned setpoint, and g the quintic of a
    soft start over T,

        u = h + g(s / T) (w - h),   g(s) = 10 s^3 - 15 s^4 + 6 s^5,

    within range and speed of the servos. T is SOFT_START, or less after a short gap. At first the
    cranks rest at `angles` (6,), rad.
    """

    def __init__(self, servo: Stiffness, period: float, angles: Array) -> None:
        self._servo, self._period = servo, period
        self.u = self._held = np.array(angles)
        self.rate = self._coasting = np.zeros(NUM_LEGS)
        self._since, self._gap = 0.0, math.inf

    def step(self, wanted: Array | None) -> Array:
        """Return the next setpoint (6,) for the planned one, None where there is none; rad."""
        if wanted is None:
            if self._since > 0:
                self._held, self._coasting, self._since, self._gap = self.u, self.rate, 0.0, 0.0
            self._gap += self._period
        self._coasting = self._coasting * math.exp(-self._period / _DECAY)
        self._held = next_one = self._held + self._coasting * self._period
        if wanted is not None:
            self._since += self._period
            share = self._since / (_REJOIN if self._gap <= _REJOIN else SOFT_START)
            next_one = self._held + rise(share) * (wanted - self._held)
        before, self.u = self.u, self._servo.limited(next_one, self.u)
        self.rate = (self.u - before) / self._period
        return self.u


class Robot:
    """The robot as a machine's plant and sensor, a `live.simulated.Body`."""

    def __init__(self, daemon: Daemon, mechanism: Mechanism, measures_state: bool) -> None:
        self._daemon, self._mechanism, self._measures_state = daemon, mechanism, measures_state
        self.time, self._pose = 0.0, mechanism.home

    @property
    def state(self) -> Array:
        """Pose and rates (12,) of the last positions, extrapolated to now; NaN without any."""
        there = list(self._daemon.positions)
        nothing = np.full(NUM_STATE, np.nan)
        if not there or not self._daemon.ready:
            return nothing
        times = np.array([one.stamp - there[-1].stamp for one in there]) / SECOND
        angles, rates = there[-1].joints[1:], np.zeros(NUM_LEGS)
        if times[0] <= -_LEAST_SPAN:  # the line through all of them, at the newest
            rates, angles = np.polyfit(times, [one.joints[1:] for one in there], 1)
        age = min((now() - there[-1].stamp) / SECOND, _AHEAD)
        try:
            self._pose = self._mechanism.forward_kinematics(angles + age * rates, self._pose)
        except ForwardKinematicsError:
            self._pose = self._mechanism.home
            return nothing
        return np.append(self._pose, np.linalg.solve(self._mechanism.jacobian(self._pose), rates))

    def advance(self, time: float, torque: Array) -> Failure | None:
        self.time = time
        return None

    def measurement(self) -> Array:
        state = self.state
        if self._measures_state:
            return state
        if not np.all(np.isfinite(state)):
            return np.full(NUM_LEGS, np.nan)
        return self._mechanism.crank_angles(state[POSE])


class RobotMachine(Machine):
    """A machine whose motors are those of the robot behind a daemon."""

    def __init__(
        self,
        experiment: Experiment,
        endpoint: Endpoint[ControllerMessage],
        options: MachineOptions,
        daemon: Daemon,
        say: Callable[[str], None] = print,
        **kwargs: Any,
    ) -> None:
        scenario = experiment.scenario
        servo = known_stiffness(scenario)
        assert servo is not None
        self._ahead = round(options.ahead * SECOND)
        self._daemon, self._servo, self._yaw = daemon, servo, 0.0
        self._soft: SoftSetpoints | None = None
        robot = Robot(daemon, experiment.mechanism, scenario.sensor.measures_state)
        settings = options.model_copy(update={"restart": "motion", "safe": "hold", "rate": 1.0})
        body = (lambda: robot), "the robot"
        super().__init__(experiment, endpoint, settings, say, body=body, **kwargs)
        self._queue = np.empty((0, NUM_LEGS))
        self._at(-self._ahead % self.period, DRIVES, self._drive)

    def _new_motors(self) -> Motors:
        return Motors(math.inf, self.period, cranks=True)

    def _flags(self) -> MachineFlags:
        flags = super()._flags()
        return flags if self._daemon.simulated else flags & ~MachineFlags.SIMULATION

    def _obey(self, message: ControllerMessage, time: int) -> None:
        if not len(message.torques):
            super()._obey(message, time)
        elif self._daemon.ready:
            super()._obey(replace(message, playout=message.playout - self._ahead), time)

    def _message(self, *args: Any) -> MachineMessage:
        """Report setpoints by the times for which they are meant."""
        message = super()._message(*args)
        if message.acted_from == NEVER:
            return message
        return replace(message, acted_from=message.acted_from + self._ahead)

    def _drive(self, time: int) -> None:
        """Send the setpoint of a period."""
        self._at(time + self.period, DRIVES, self._drive)
        while self._daemon.lines:
            self._report(time, self._daemon.lines.popleft())
        if not self._daemon.ready:
            self._soft = None
            if self._running and self.reason.fault != Fault.DRIVE:
                self._go_safe(time)
                self._fail(Reason(Fault.DRIVE), time)
            return
        playing = self._running and not self._safe and self._motors.fed
        if self._soft is None:
            if not playing:
                return
            joints = self._daemon.positions[-1].joints
            self._yaw = joints[0]
            self._soft = SoftSetpoints(self._servo, self.period / SECOND, joints[1:])
        setpoint = self._soft.step(self._motors.torque if playing else None)
        self._daemon.send(np.append(self._yaw, setpoint))
        if not playing and np.abs(self._soft.rate).max() < _STILL:
            self._soft = None  # the daemon holds the last setpoint


@contextmanager
def open_chosen(
    scenario: Scenario, options: MachineOptions, say: Callable[[str], None] = print
) -> Iterator[tuple[Machine, Address]]:
    """Yield the robot behind `options.reachy`, or a simulated machine, and where it listens.

    Raises:
        ConfigError: a scenario that the protocol does not cover, or an address in use. For a robot
            also other motors than position servos, more samples than the daemon sends, no package
            websockets, or no daemon that sends positions and its status.
    """
    check_scenario(scenario)
    if options.reachy:
        _check_robot(scenario)
    elif options.ahead:
        raise ConfigError(f"--ahead: got {options.ahead:g} s without --reachy; expected both")
    experiment = prepare(scenario)
    with ExitStack() as opened:
        endpoint = Endpoint(ControllerMessage, options.host, options.port, read_key(options.key))
        opened.callback(endpoint.close)
        log = None
        if options.log is not None:
            log = Background(open_log(options.log, scenario, False), str(options.log), say)
            opened.callback(log.close)
        how: Any = {"say": say, "log": log}
        if options.reachy:
            daemon = Daemon(parse_address(options.reachy, "--reachy"))
            opened.callback(daemon.close)
            _await_positions(daemon, options.reachy)
            machine: Machine = RobotMachine(experiment, endpoint, options, daemon, **how)
        else:
            machine = Machine(experiment, endpoint, options, **how)
        yield machine, endpoint.address


def _check_robot(scenario: Scenario) -> None:
    wanted = {"actuator.kind": "position_servo", "sensor.samples": (None, 1)}
    if found := differing(scenario, wanted):
        raise ConfigError(found.problem("with --reachy"))
    optional(
        "websockets",
        "--reachy: needs the package websockets; expected pip install 'stewart_drake[reachy]'",
    )


def _await_positions(daemon: Daemon, where: str) -> None:
    began, waiting = now(), threading.Event()
    while not (daemon.positions and daemon.has_status):
        if now() - began > _PATIENCE * SECOND:
            said = f" ({daemon.problem})" if daemon.problem else ""
            lacks = "status" if daemon.positions else "positions"
            raise ConfigError(
                f"--reachy: got {where}, which sent no {lacks} for {_PATIENCE:g} s{said}; "
                "expected the daemon of the robot, usually at port 8000"
            )
        waiting.wait(0.05)  # its status comes once a second
