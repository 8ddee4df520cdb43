"""The least controller that a machine can be tried with, and a clock that tests turn themselves."""

import functools
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.law.channel import Packets, Report
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.sensing import Measurement
from stewart_drake.live.endpoint import Address, Endpoint, Session
from stewart_drake.live.machine import Machine, Settings
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    ControllerFlags,
    ControllerMessage,
    MachineMessage,
    Refusal,
)
from stewart_drake.loop.law_design import control_law, first_queue
from stewart_drake.loop.peer import identity_of
from stewart_drake.loop.preparation import prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.run_log import RunLog


def in_real_time(test):
    """Repeat a test that fails, at most twice.

    A busy computer may suspend any process for longer than a period, which loses measurements.
    """

    @functools.wraps(test)
    def repeated(*args, **kwargs):
        for _ in range(2):
            try:
                return test(*args, **kwargs)
            except AssertionError:
                pass
        return test(*args, **kwargs)

    return repeated


class Running(NamedTuple):
    """A machine in a thread, its address, and what it says."""

    machine: Machine
    address: Address
    lines: list[str]


@contextmanager
def in_a_thread(machine: Machine) -> Iterator[None]:
    """Run a machine in slices, between which it does not stop."""
    over = threading.Event()
    vars(machine)["stop"] = lambda: None

    def run() -> None:
        while not over.is_set():
            machine.run(machine.time() / SECOND + 0.05)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def until(condition: Callable[[], Any], seconds: float = 10.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@contextmanager
def running_machine(
    scenario: Scenario, kind: type[Machine] = Machine, log: RunLog | None = None, **how: Any
) -> Iterator[Running]:
    """Run the machine of a scenario, with settings."""
    lines: list[str] = []
    endpoint = Endpoint(ControllerMessage, "127.0.0.1", 0)
    with closing(endpoint):
        machine = kind(prepare(scenario), endpoint, Settings(**how), lines.append, log=log)
        with in_a_thread(machine):
            yield Running(machine, endpoint.address, lines)


@dataclass
class Clock:
    """ns, as they are set."""

    time: int = 10 * SECOND

    def __call__(self) -> int:
        return self.time


class Wire:
    """An endpoint that keeps what a machine sends and refuses."""

    def __init__(self) -> None:
        self.said: list[MachineMessage] = []
        self.refused, self.unsent = Counter[Refusal](), 0

    def send(self, message: MachineMessage, to: Address) -> bool:
        self.said.append(message)
        return True

    def refuse(self, cause: Refusal, detail: str = "") -> None:
        self.refused[cause] += 1


class Driver:
    """A law behind a socket, which knows the machine's clock because it is the tests'."""

    def __init__(self, scenario: Scenario, machine: Address, key: bytes | None = None) -> None:
        self.experiment = prepare(scenario)
        self.law, self.planned, _ = control_law(self.experiment)
        self.memory = self.law.initial_memory(first_queue(self.experiment, self.law))
        self.endpoint = Endpoint(MachineMessage, key=key)
        self.session = Session.drawn(machine)
        self.identity = identity_of(scenario)
        self.begin, self.first = NEVER, 0
        self.period = round(scenario.controller.period * SECOND)
        self.got: list[MachineMessage] = []
        self.newest, self.looked_at = -1, 0
        self.torques: list[np.ndarray] = []

    def receive(self, time: int) -> list[MachineMessage]:
        """Return the messages that have arrived; keep the first nonce."""
        found = []
        for message, address in self.endpoint.receive():
            assert isinstance(message, MachineMessage)
            refusal = self.session.refusal(message.head, address, time)
            if refusal is not None:
                self.endpoint.refused[refusal] += 1
                continue
            self.session.nonce = message.head.nonce
            found.append(message)
        self.got += found
        return found

    def say(
        self,
        time: int,
        flags: ControllerFlags = NOTHING,
        sampled: int = 0,
        playout: int = 0,
        torques: np.ndarray | None = None,
    ) -> ControllerMessage:
        """Send a datagram."""
        rows = np.empty((0, 6)) if torques is None else torques
        head = self.session.head(time)
        asks = None if self.session.nonce else self.identity
        message = ControllerMessage(head, flags, sampled, playout, self.begin, rows, asks)
        self.endpoint.send(message, self.session.address)
        return message

    def step(self, time: int, own: int | None = None) -> ControllerMessage:
        """Return the sample due at a time of the machine's clock; `own` is another clock's."""
        own = time if own is None else own
        number = (time - self.begin) // self.period
        self.receive(own)
        least = max(self.begin, self.newest + 1)
        new = [m for m in self.got[self.looked_at :] if m.sampled >= least]
        self.looked_at = len(self.got)
        newest = max(new, key=lambda m: m.sampled, default=None)
        values, age, report = np.full(self.law.sensing.size, np.nan), 0.0, None
        if newest is not None and newest.values is not None:
            self.newest, values = newest.sampled, newest.values
            age = (time - newest.sampled) / SECOND
            report = self.report(newest, round((time - newest.sampled) / self.period))
        motion = KnownMotion(self.planned, self.experiment.reference, time_of(number, self.period))
        c = self.experiment.scenario.controller
        weights = np.array(c.weights)
        measured = Measurement.of(values, age)
        self.memory = self.law.step(self.memory, measured, motion, weights, report)
        self.torques.append(np.array(self.memory.torque))
        playout = time + round(self.law.timeline.eta * SECOND)
        rows = np.array(self.memory.torque)[None]
        if isinstance(self.law.channel, Packets):
            rows = self.memory.sent.packets[-1]
            playout -= self.law.channel.repeats * self.period
        message = self.say(own, sampled=time, playout=playout, torques=rows)
        if number == 0:
            self.first = message.head.sequence
        return message

    def report(self, message: MachineMessage, age: int) -> Report | None:
        """Return the report on the packets sent before the sample of a measurement."""
        if not isinstance(self.law.channel, Packets) or message.acted_from == NEVER:
            return None
        sample = (message.sampled - self.begin) // self.period
        arrived = []
        for i in range(64):
            behind = message.head.acknowledged - (self.first + sample - 1 - i)
            arrived.append(0 <= behind < 64 and bool(message.arrived >> behind & 1))
        return Report(np.array(arrived), message.acted, age)


def time_of(number: int, period: int) -> float:
    """s, as the scenario's own grid has it."""
    return number * (period / SECOND)


@dataclass
class Together:
    """A machine and a driver on one clock, in one process."""

    scenario: Scenario
    settings: Settings = field(default_factory=Settings)
    key: bytes | None = None

    def __post_init__(self) -> None:
        self.clock = Clock()
        self.said: list[str] = []
        self.ear = Endpoint(ControllerMessage, key=self.key)
        self.machine = Machine(
            prepare(self.scenario), self.ear, self.settings, self.said.append, self.clock
        )
        self.zero = self.clock.time
        self.driver = Driver(self.scenario, self.ear.address, self.key)

    def at(self, time: int) -> None:
        """Advance the machine's clock to a time."""
        while True:
            self.machine.poll(self.machine.time())
            upcoming = self.machine.advance(self.machine.time())
            if upcoming > time:
                break
            self.clock.time = self.zero + upcoming
        self.clock.time = self.zero + time
        self.machine.advance(time)

    def greet(self, time: int, begin: int) -> None:
        """Open a session whose run will begin at `begin`."""
        self.at(time)
        for _ in range(50):
            if self.driver.session.nonce:
                break
            self.driver.say(time)
            time += self.driver.period
            self.at(time)
            self.driver.receive(time)
        assert self.driver.session.nonce
        self.driver.begin = begin
        while not self.expects(begin):
            assert time < begin
            self.driver.say(time)
            time += self.driver.period
            self.at(time)

    def expects(self, begin: int) -> bool:
        """Whether the driver's run is about to begin."""
        session = self.machine.session
        driving = session is not None and session.number == self.driver.session.number
        return driving and self.machine.begin == begin

    def drive(self, samples: int) -> list[np.ndarray]:
        """Drive for this number of samples; return the machine's state at each."""
        states = []
        begin, period = self.driver.begin, self.driver.period
        now = self.machine.time()
        for sampled in range(now - now % period + period, begin, period):
            self.at(sampled)
            self.driver.say(sampled)
        for k in range(samples):
            time = begin + k * period
            self.at(time)
            states.append(np.array(self.machine._body.state))
            self.driver.step(time)
        self.at(begin + samples * period)
        return states
