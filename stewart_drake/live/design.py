"""The law for a machine at the other end of a link: the scenario's law over the measured link.

A torque acts a fixed time eta after its measurement, as in the scenario: the machine's buffer holds
packets that come sooner. A measurement spends a part of eta on its way back, so that the law sees a
link of round trips with measurements without delay. Repetitions and plans of packets replace
torques that come late or never (theory.md, section 25).
"""

import math
import time as clock
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.law.channel import Packets
from stewart_drake.law.coverage import uncovered_part
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.law.limited import LimitedLqi
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.nominal import TorqueLimit
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import ServoPreview
from stewart_drake.live.contact import Link
from stewart_drake.live.protocol import MOST_HISTORY, MachineFlags, MachineMessage
from stewart_drake.loop.law_design import control_law, first_queue
from stewart_drake.loop.learned import learned_signal
from stewart_drake.loop.peer import MOST_ROWS
from stewart_drake.loop.preparation import Experiment, knowing, prepare
from stewart_drake.loop.servos import commands_in_flight, servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.document import counted
from stewart_drake.scenario.config import DelayConfig, Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.link_config import NetworkConfig, WireConfig
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array

ROOM: Final = 0.25
"""Allowance for a longer round trip, as a share of the measured jitter."""
_COMPUTING: Final = 0.01
"""Time for a step of the law and for waking up, s."""
BUDGET: Final = 0.5
"""Share of a period after which a plan within limits is late, and the last one goes on."""
_TRIED: Final = 5
"""Number of steps whose shortest is reported."""
_PLAN: Final = 16
"""Number of setpoints of a plan for servos."""
_LEAST_LOSS: Final = 0.01
"""Smallest assumed loss of packets: the call takes a few seconds only."""

Learned = Callable[[], LearnedSignal] | None
"""Returns what is added to the torques or setpoints of the law; None: nothing."""


class Design(NamedTuple):
    """Law and settings of a controller before its start."""

    experiment: Experiment  # experiment of the scenario over the measured link
    law: Any  # control law, `PredictiveLqi` or `ServoPreview`
    planned: Trajectory  # its reference from the scenario's start
    queue: Array  # torques (L, 6) in flight at the begin
    repeats: int  # number of torques that a packet repeats
    torque_limit: float  # tighter limit of the scenario and the machine, N m
    # time of a step of the law here, s, and the field of a part in Python, or None
    step: tuple[float, str | None]
    rows: int = 1  # number of setpoints of a plan for servos
    learned: Learned = None

    @property
    def cranks(self) -> bool:
        """Whether setpoints of servos are sent."""
        return isinstance(self.law, ServoPreview)

    @property
    def sends(self) -> bool:
        """Whether plans are sent, to a buffer."""
        return self.rows > 1 if self.cranks else isinstance(self.law.channel, Packets)

    @property
    def horizon(self) -> float:
        """Time ahead of a sample up to which the reference is fixed, s."""
        if self.cranks:
            return float(self.law.preview_times.max())
        # The next torque needs the reference up to the end of the hold after its own. Later torques
        # may still change. Within a hold the reference has no jump of its third derivative.
        return float(self.law.timeline.holds(0, 2)[-1])

    def left_alone(self, machine: MachineMessage) -> str:
        """Return in words what becomes of the plate without a controller."""
        if self.cranks:
            return "the servos hold their last setpoint"
        if MachineFlags.SAFE_HOLDS in machine.flags:
            return "the motors keep their last torque, which holds the plate for a while only"
        if not self.experiment.scenario.plant.gravity:
            return "the motors have no torque"
        return "the motors have no torque: the plate falls unless brakes or a support hold it"


def check_controller(scenario: Scenario) -> None:
    """Refuse a scenario with a tuner, or with servos that need more than a setpoint."""
    accepted = {"tuner.kind": "fixed", "actuator.kind": ("torque", "position_servo")}
    if found := differing(scenario, accepted):
        raise ConfigError(found.problem("for live"))
    if scenario.controller.command == "cranks" and scenario.controller.estimate:
        raise ConfigError(
            f"controller.estimate: got {scenario.controller.estimate} for live with servos, which "
            "report no torques; expected []"
        )


def as_seen(scenario: Scenario, link: Link, machine: MachineMessage) -> Scenario:
    """Return the scenario with the measured link.

    Its delay, or the bound of its network, is the time from a measurement to its torque. A network
    without a bound gets that of the measured link.
    """
    loss = max(scenario.sensor.loss, link.loss_back)
    sensor = replace(scenario.sensor, delay=0.0, loss=loss, faults=[])
    seen = replace(scenario, sensor=sensor, plant=replace(scenario.plant, kind="exact"))
    if MachineFlags.WIRE in machine.flags:  # it delays torques as the scenario does
        if scenario.link.kind == "network":
            raise ConfigError(
                "link.kind: got 'network' for a machine that simulates a wire; expected 'wire', or "
                "a machine started with --set link.kind=network"
            )
        return seen
    c = scenario.controller
    if c.delay_estimator != "none":
        raise ConfigError(
            f"controller.delay_estimator: got {c.delay_estimator!r}; expected 'none' for a machine "
            "that keeps to the play-out times of torques"
        )
    longest = link.longest + ROOM * link.jitter + _COMPUTING * machine.rate
    network = NetworkConfig(
        low=link.shortest,
        high=longest,
        loss=max(link.loss_there, _LEAST_LOSS),
        burst=scenario.link.burst,
        dry="hold" if MachineFlags.HOLDS in machine.flags else "zero",
    )
    chosen = scenario.link.kind == "wire" or scenario.link.playout is not None
    eta, period = (scenario if chosen else replace(scenario, link=network)).eta, c.period
    least = math.ceil(longest / period)
    if not chosen:  # the default bound may be shorter than the longest trip
        eta = max(eta, least * period)
    elif eta < longest:
        if scenario.link.kind == "wire":
            repeats = 0 if c.command == "cranks" else c.packet_repeats
            got, enough = f"delay.steps: got {eta:g} s", f"delay.steps={least + repeats}"
        else:
            enough = f"link.playout={least * period:g}"
            got = f"link.playout: got {scenario.link.playout:g} s"
            if c.packet_repeats:
                got += f", with {counted(c.packet_repeats, 'repetitions')} {eta:g} s,"
        raise ConfigError(
            f"{got} from a measurement to its torque; the link takes "
            f"{link.shortest:.3g} to {longest:.3g} s there and back and loses "
            f"{100 * link.loss_there:.2g} and {100 * link.loss_back:.2g} %: expected at least "
            f"--set {enough}"
        )
    if c.command == "cranks":
        delay = DelayConfig(steps=round(eta / period))
        return replace(seen, link=WireConfig(), delay=delay)
    repeats = max(0, min(c.packet_repeats, math.floor((eta - longest) / period + 1e-9)))
    network = replace(network, playout=round(eta - repeats * period, 9))
    torques = min(c.packet_torques, MOST_ROWS - repeats)
    controller = replace(
        c, delay_steps=None, delay_fraction=None, packet_repeats=repeats, packet_torques=torques
    )
    return replace(seen, link=network, controller=controller)


def always(signal: LearnedSignal | None) -> Learned:
    return None if signal is None else lambda: signal


def read_learned(scenario: Scenario) -> tuple[Scenario, Learned]:
    """Return a scenario without `controller.learned`, and what is in that file."""
    if scenario.controller.learned is None:
        return scenario, None
    without = replace(scenario, controller=replace(scenario.controller, learned=None))
    return without, always(learned_signal(knowing(prepare(scenario))))


def design(scenario: Scenario, machine: MachineMessage, learned: Learned = None) -> Design:
    """Return the law for a scenario over the measured link, see `as_seen`."""
    experiment = prepare(scenario)
    if scenario.controller.command == "cranks":
        return _of_cranks(experiment, machine, learned)
    law, planned, _ = control_law(experiment)
    limit = min(law.plant.motors.limit, machine.torque_limit)
    law = replace(law, plant=replace(law.plant, motors=TorqueLimit(limit)))
    if isinstance(law, LimitedLqi):
        law = replace(law, limits=replace(law.limits, budget=BUDGET * scenario.controller.period))
    repeats = scenario.controller.packet_repeats if scenario.link.kind == "network" else 0
    queue = first_queue(experiment, law)
    assert law.extra_torques < MOST_HISTORY
    took = _step_times(replace(law, open_loop_samples=0), planned, queue, _TRIED, np.ones(2))
    step = min(took), uncovered_part(law)
    return Design(experiment, law, planned, queue, repeats, limit, step, learned=learned)


def _of_cranks(experiment: Experiment, machine: MachineMessage, learned: Learned) -> Design:
    """Return the law for servos; its queue is the command (18,) before the first sample.

    Nothing is estimated, so that the law takes the numbers of the scenario's plant, as the command
    `setpoints` does.
    """
    experiment = knowing(experiment)
    law, planned, _ = servo_law(experiment)
    limit = min(experiment.torque_limit, machine.torque_limit)
    first, _ = commands_in_flight(experiment, law, experiment.scenario.true_delay)
    rows = 1 if MachineFlags.WIRE in machine.flags else _PLAN
    took = _step_times(law, planned, first, rows, np.full(law.reports.size, np.nan))
    step = sum(took), uncovered_part(law)
    return Design(experiment, law, planned, first, 0, limit, step, rows, learned)


def _step_times(
    law: Any, motion: Trajectory, first: Array, number: int, given: Array
) -> list[float]:
    """Return the times of steps, s of this thread.

    `first` is the queue or command before the first sample; weights or report are `given`.
    """
    memory, took = law.initial_memory(first), list[float]()
    measured = Measurement.of(law.sensing.seen(evaluate(motion, 0.0)[:NUM_STATE]))
    for _ in range(number):
        started = clock.thread_time()
        memory = law.step(memory, measured, KnownMotion(motion, motion, 0.0), given)
        took.append(clock.thread_time() - started)
    return took
