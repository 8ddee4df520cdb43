"""The datagrams of a run by the sample that they are for.

Sample k is the instant t0 + k dt of the machine's clock. Its step begins when its measurement has
come, or when that is later than all of the last ones: then it counts as missing, and the model
replaces it. The step is thus as periodic as the link, and never waits for a lost datagram.
"""

import math
import time as clock
from collections.abc import Callable
from typing import Final

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.live.contact import Contact, await_free
from stewart_drake.live.design import ROOM
from stewart_drake.live.endpoint import STALL, now
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    ControllerFlags,
    MachineFlags,
    MachineMessage,
    Refusal,
)
from stewart_drake.live.viewer import End
from stewart_drake.loop.peer import Fault
from stewart_drake.types import Array, Flags

SILENT: Final = 1.0
"""Silence of the machine that is reported, s; at least ten periods."""
PATIENCE: Final = 10.0
"""Silence of the machine after which the run ends, s."""
_LEAD: Final = 0.05
"""Time from the first request of a begin until then, in addition to a round trip, s."""
_REPEATED: Final = 0.05
"""Time between two such requests, s."""
_ANSWER: Final = 10.0
"""Longest wait for the begin, s."""
_SPARE: Final = 0.002
"""Wait for a measurement in addition to the usual one, s."""
_FURTHEST: Final = 4096
"""Largest number of samples by which a measurement may be ahead of the next one."""
KEPT: Final = 64
"""Number of past samples whose messages are kept."""


class Exchange:
    """Measurements that come and torques that go, by the number k of their sample.

    Args:
        contact: session that the machine has offered.
        period: dt, s of the machine's clock.
        size: numbers of a measurement.

    Attributes:
        sent: number of samples whose torques were sent.
        overtaken: number of measurements that came after their step.
    """

    def __init__(self, contact: Contact, period: float, size: int) -> None:
        self.contact, self._period, self._size = contact, period, size
        self._began, self._flags, self._longest = 0, NOTHING, 0.0
        self._came, self._sequences = dict[int, MachineMessage](), dict[int, int]()
        self.sent = self.overtaken = 0

    def begin(self, flags: ControllerFlags) -> bool:
        """Agree on the begin of the run and wait until then; return whether the plate is parked.

        Every datagram of the run has these flags.

        Raises:
            ConfigError: another controller drives the machine.
            TimeoutError: it does not begin.
        """
        contact, self._flags = self.contact, flags
        await_free(contact)
        last = contact.machine
        if MachineFlags.WIRE not in last.flags:  # the design has time for such round trips
            self._longest = (1 + ROOM) * contact.link.jitter / last.rate
        contact.join()
        # The machine's clock, or earlier by the way back.
        here = (clock.monotonic() - contact.due(0, last.rate)) * last.rate
        lead = _LEAD + contact.link.longest / last.rate
        asked, until = round((here + lead * last.rate) * SECOND), now() + round(_ANSWER * SECOND)
        step = round(min(self.real_period, _REPEATED) * SECOND)
        # A plate in motion is parked again if it has left its workspace.
        parked = bool(last.flags & (MachineFlags.PARKED | MachineFlags.RESETS))
        while not (self._began and now() >= self._due(0)):
            if now() > until:
                raise TimeoutError("got one that has not begun when it was asked to")
            contact.send(begin=self._began or asked, flags=flags)
            for message in contact.wait(now() + step):
                if message.head.nonce == contact.session.nonce:
                    parked |= MachineFlags.PARKED in message.flags
                    if message.begin != NEVER:
                        self._began = message.begin
                self._take(message)
        return parked

    def stop(self) -> None:
        """Order the safe torque, in three datagrams."""
        for _ in range(3):
            self.contact.send(flags=ControllerFlags.STOP | self._flags)
            clock.sleep(0.01)

    # -------------------------------------------------------------- time

    @property
    def real_period(self) -> float:
        """Period of the controller, s of the own clock."""
        return self._period / self.contact.machine.rate

    @property
    def jitter(self) -> float:
        """Largest delay of the last measurements after the earliest arrival, s.

        Delays above a period, or above the jitter that the design has room for, do not count.
        """
        return self.contact.lateness(max(self.real_period, self._longest))

    def late(self, k: int) -> float:
        """Return the time since the earliest arrival of the measurement of a sample, s."""
        return (now() - self._due(k)) / SECOND

    def _due(self, k: int) -> int:
        sampled = self._began + round(k * self._period * SECOND)
        return round(self.contact.due(sampled, self.contact.machine.rate) * SECOND)

    # -------------------------------------------------------------- measurements

    def wait(self, k: int) -> MachineMessage | None:
        """Return the message with a sample's measurement, or None once it is too late."""
        for message in self.contact.receive():
            self._take(message)
        usual = self.jitter + _SPARE
        while k not in self._came:
            until = self._due(k) + round(usual * SECOND)
            if now() >= until:
                break
            for message in self.contact.wait(until):
                self._take(message)
        for old in [n for n in self._came if n < k - KEPT]:
            del self._came[old]
        return self._came.get(k)

    def _take(self, message: MachineMessage) -> None:
        """Keep a measurement until its sample."""
        ended = message.reason.fault == Fault.ENDED  # it is of no sample
        if message.begin == NEVER or message.sampled < message.begin or ended:
            return
        values, refuse = message.values, self.contact.endpoint.refuse
        if values is not None and values.size != self._size:
            found = f"a measurement of {values.size} numbers; expected {self._size}"
            refuse(Refusal.MALFORMED, found)
            return
        k = round((message.sampled - message.begin) / message.period)
        if k > self.sent + _FURTHEST:
            refuse(Refusal.MALFORMED)
            return
        if k < self.sent:
            self.overtaken += 1
            refuse(Refusal.LATE)
        self._came.setdefault(k, message)

    # -------------------------------------------------------------- torques

    def send(self, k: int, rows: Array, first: int, eta: int, cranks: bool) -> None:
        """Send the torques, N m, or setpoints, rad, of the step of sample k.

        The first row (6,) is of the sample `first`. A torque acts `eta` ns after its sample.
        """
        P = round(self._period * SECOND)
        self._sequences[k] = self.contact.send(
            rows,
            sampled=self._began + k * P,
            playout=self._began + first * P + eta,
            begin=self._began,
            flags=self._flags,
            cranks=cranks,
        )
        self._sequences.pop(k - 2 * KEPT, None)
        self.sent += 1

    def send_nothing(self) -> None:
        """Send a datagram without torques, which shows presence."""
        self.contact.send(begin=self._began, flags=self._flags)

    def arrived(self, k: int, number: int) -> Flags:
        """Return which of the last datagrams (number,) have arrived, from that of k - 1 back."""
        sequences = [self._sequences.get(k - 1 - i) for i in range(number)]
        return np.array([n is not None and self.contact.has_arrived(n) for n in sequences])


class Watch:
    """Reports changes of the machine's state, and ends a run without it."""

    def __init__(self, exchange: Exchange, period: float, say: Callable[[str], None]) -> None:
        self._exchange, self._period, self._say = exchange, period, say
        self._flags, self._silent_since, self._stalled = MachineFlags(0), 0, False
        self.safe: str | None = None  # why the safe torque acts

    def ended(self, k: int, message: MachineMessage | None) -> End | None:
        """Report changes until sample k, given its message; return the end of the run, or None."""
        self._report_stall(k)
        contact = self._exchange.contact
        silent = (now() - contact.heard) / SECOND
        if silent > max(SILENT, 10 * self._period):
            if not self._silent_since:
                self._silent_since = contact.heard
                self.report(k, f"the machine has been silent for {silent:.1f} s; waiting")
            if silent > PATIENCE:
                return self.end("lost_machine", k, f"the machine was silent for {PATIENCE:g} s")
        elif self._silent_since:
            gone = (contact.heard - self._silent_since) / SECOND
            self._silent_since = 0
            self.report(k, f"the machine is heard again, after {gone:.1f} s")
        if contact.machine.reason.fault == Fault.ENDED:
            return self.end("lost_machine", k, contact.machine.why)
        if message is None:  # a lagging machine sends its fault with measurements that are late
            last = contact.machine
            if last.begin == NEVER or MachineFlags.LEFT not in last.flags:
                return None
            message = last
        before, self._flags = self._flags, message.flags
        if MachineFlags.LEFT in message.flags:
            return self.end("left_workspace", k, message.why, message.reason.leg or None)
        self.safe = message.why if MachineFlags.SAFE in message.flags else None
        held = "holds its cranks" if message.cranks else "is at its safe torque"
        if MachineFlags.SAFE in message.flags & ~before:
            self.report(k, f"the machine {held}: {self.safe}")
        if MachineFlags.SAFE in before & ~message.flags:
            self.report(k, f"{'setpoints' if message.cranks else 'torques'} act again")
        return None

    def _report_stall(self, k: int) -> None:
        """Report once that this process is late by more than the jitter of the link."""
        lag = self._exchange.late(k) - self._exchange.jitter
        stalled = lag > STALL / SECOND
        if stalled and not self._stalled:
            went_on = "the machine went on by its buffer"
            self.report(k, f"this process did not run for {lag:.1f} s; {went_on}")
        self._stalled = stalled

    def report(self, k: int, text: str) -> None:
        self._say(f"at {k * self._period:.1f} s: {text}")

    def end(self, status: str, k: int, reason: str, leg: int | None = None) -> End:
        return End(status, Failure(k * self._period, leg, math.nan, reason))
