"""The controller's contact with its machine: finding it, what has come, how long the link takes.

No two clocks are compared. A measurement carries the time at which it was taken and a plan the
times at which its torques act, both of the machine's clock. The way there and the way back
therefore count together, as a round trip.
"""

import contextlib
import math
import select
import socket
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.live.endpoint import Address, Endpoint, Session, is_loopback, now
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    VERSION,
    ControllerFlags,
    ControllerMessage,
    MachineFlags,
    MachineMessage,
    Refusal,
)
from stewart_drake.loop.peer import Identity
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

_TRIPS: Final = 256
"""Number of round trips that are kept."""
_SETTLED: Final = 48
"""Number of datagrams after which an unanswered one counts as lost."""
_PHASES: Final = 128
"""Number of measurements from which the next arrival is predicted."""
_REQUEST_PERIOD: Final = SECOND // 50
"""Time between two requests for a session, ns."""
_PATIENCE: Final = 5.0
"""Longest wait for an answer, s."""
_ENOUGH_TRIPS: Final = 100
"""Number of round trips that suffice for a design."""
_LONGEST_CALL: Final = 5.0
"""Longest wait for that number, s."""


@dataclass
class Link:
    """Statistics of the link, there and back.

    A request without an answer counts as half a datagram lost there and half an answer lost on the
    way back: the machine keeps no state of requests.
    """

    # last round trips, s, without the time for which the machine held a datagram
    trips: deque[float] = field(default_factory=lambda: deque(maxlen=_TRIPS))
    sent: int = 0  # number of datagrams whose fate is known
    lost: float = 0  # number of them that did not arrive
    packets_lost: int = 0  # number of those with torques that did not arrive
    missed: float = 0  # number of measurements that did not come, by their sequence
    came: int = 0  # number of measurements that came

    @property
    def typical(self) -> float:
        """Median round trip, s; NaN without any."""
        return float(np.median(self.trips)) if self.trips else math.nan

    @property
    def spread(self) -> float:
        """Standard deviation of the round trips, s; NaN without any."""
        return float(np.std(self.trips)) if self.trips else math.nan

    @property
    def longest(self) -> float:
        """Longest round trip, s; NaN without any."""
        return max(self.trips, default=math.nan)

    @property
    def shortest(self) -> float:
        """Shortest round trip, s; NaN without any."""
        return min(self.trips, default=math.nan)

    @property
    def usual(self) -> float:
        """Round trip that 95 % do not exceed, s; NaN without any."""
        return float(np.quantile(self.trips, 0.95)) if self.trips else math.nan

    @property
    def jitter(self) -> float:
        """Difference of the longest and the shortest round trip, s."""
        return self.longest - self.shortest

    @property
    def loss_there(self) -> float:
        """Share of the datagrams that did not arrive."""
        return self.lost / max(self.sent, 1)

    @property
    def loss_back(self) -> float:
        """Share of the measurements that did not come."""
        return self.missed / max(self.missed + self.came, 1)


class Contact:
    """A session with a machine that the controller is designed for; the caller closes its socket.

    Attributes:
        last: newest message of the machine by its sequence, or None.
        offered: nonce of the newest offer; 0 without one.
        heard: own clock when the last message was accepted, ns.
    """

    def __init__(
        self, endpoint: Endpoint[MachineMessage], address: Address, identity: Identity
    ) -> None:
        self.endpoint, self.identity, self.offered = endpoint, identity, 0
        self.session, self.link = Session.drawn(address), Link()
        self.last: MachineMessage | None = None
        self.heard = now()
        self._pending: dict[int, bool] = {}
        self._requests, self._packets = set[int](), set[int]()
        self._unanswered, self._first, self._followed = 0.0, 0, 0
        self._phases: deque[float] = deque(maxlen=_PHASES)
        self._age, self._least_age = 0, NEVER
        self._newest = 0
        self._before = 0, 0  # periods played and dry in earlier sessions

    @property
    def refused(self) -> dict[str, int]:
        return {cause.value: n for cause, n in self.endpoint.refused.items()}

    @property
    def machine(self) -> MachineMessage:
        """Newest message of a machine that has answered."""
        assert self.last is not None
        return self.last

    @property
    def where(self) -> str:
        """Name of the machine in messages."""
        host, port = self.session.address
        return f"machine at {host}:{port}"

    def join(self) -> None:
        """Use the session that the machine has offered."""
        self.session.nonce = self.offered

    def ask(self) -> bool:
        """Request a session and listen for a request period; return whether a message came."""
        head = replace(self.session.head(now()), nonce=self.offered)
        self.endpoint.send(ControllerMessage(head, identity=self.identity), self.session.address)
        if self.offered:  # otherwise the machine may leave it unanswered
            self._pending[head.sequence] = False
            self._requests.add(head.sequence)
        until, came = now() + _REQUEST_PERIOD, False
        while now() < until:
            for _ in self.wait(until):
                came = True
        self._check_identity()
        return came

    def send(
        self,
        torques: Array | None = None,
        *,
        sampled: int = 0,
        playout: int = 0,
        begin: int = NEVER,
        flags: ControllerFlags = NOTHING,
        cranks: bool = False,
    ) -> int:
        """Send a datagram of these fields; return its sequence."""
        rows = np.empty((0, NUM_TORQUES)) if torques is None else torques
        head = self.session.head(now())
        message = ControllerMessage(head, flags, sampled, playout, begin, rows, cranks=cranks)
        self.endpoint.send(message, self.session.address)
        self._pending[head.sequence] = False
        if torques is not None:
            self._packets.add(head.sequence)
        return head.sequence

    def has_arrived(self, sequence: int) -> bool:
        return self._pending.get(sequence, False)

    def wait(self, until: int) -> Iterator[MachineMessage]:
        """Wait for messages until a time of the own clock, ns, and yield them."""
        left = max(0, until - now()) / SECOND
        if select.select([self.endpoint], [], [], left)[0]:
            yield from self.receive()

    def receive(self) -> Iterator[MachineMessage]:
        """Yield each message that has come, once, in the order of arrival."""
        for message, address in self.endpoint.receive():
            time, newest = now(), self.session.window.newest
            refused = self.session.refusal(message.head, address, time)
            if refused is not None:
                sequences = f"sequence {message.head.sequence} after {newest}"
                self.endpoint.refuse(refused, sequences if refused != Refusal.FOREIGN else "")
                continue
            self.heard = time
            self._note(message, time)
            yield message

    def forget_waiting(self) -> None:
        """Count the messages that have waited in the socket, without their round trips."""
        for message, address in self.endpoint.receive():
            if self.session.refusal(message.head, address, now()) is None:
                self.link.came += 1
                self._acknowledge(message)

    def _note(self, message: MachineMessage, time: int) -> None:
        head, link = message.head, self.link
        if self.last is None or head.sequence > self.last.head.sequence:
            self.last = message
        link.came += 1
        if message.identity is not None:
            self.offered = head.nonce
        else:
            if not self._first:
                self._first, self._before = head.sequence, (message.played, message.dry)
            self._followed += 1
            self._age = head.time - message.sampled
            self._least_age = min(self._least_age, self._age)
        gaps = self.session.window.newest - self._first + 1 - self._followed if self._first else 0
        self._phases.append((time - message.sampled / message.rate) / SECOND)
        if head.acknowledged > self._newest:  # the first answer to a datagram
            self._newest = head.acknowledged
            link.trips.append((message.rate * (time - head.echo) - head.held) / SECOND)
        self._acknowledge(message)
        for settled in [n for n in self._pending if n <= head.acknowledged - _SETTLED]:
            link.sent += 1
            unanswered = not self._pending.pop(settled)
            asked = settled in self._requests
            self._requests.discard(settled)
            link.lost += 0.5 * unanswered if asked else unanswered
            self._unanswered += 0.5 * unanswered * asked
            link.packets_lost += unanswered and settled in self._packets
            self._packets.discard(settled)
        link.missed = self._unanswered + max(0, gaps)

    def _acknowledge(self, message: MachineMessage) -> None:
        for sequence in self._pending:
            behind = message.head.acknowledged - sequence
            if 0 <= behind < 64 and message.arrived >> behind & 1:
                self._pending[sequence] = True

    def periods(self, message: MachineMessage) -> tuple[int, int]:
        """Return how many periods of this session had a row of a plan, and had none (dry)."""
        played, dry = self._before
        return message.played - played, message.dry - dry

    def due(self, sampled: int, rate: float) -> float:
        """Return the earliest arrival of a measurement taken at `sampled`, s of the own clock."""
        return min(self._phases, default=math.nan) + sampled / rate / SECOND

    def lateness(self, longest: float) -> float:
        """Return the largest delay of the last measurements after the earliest arrival, s.

        Delays above `longest`, such as those of a suspended process, do not count.
        """
        soonest = min(self._phases, default=math.nan)
        return max((p - soonest for p in self._phases if p - soonest <= longest), default=0.0)

    def late_by(self) -> str:
        """Return in words by how much the last measurement was late, and why.

        A simulation that lags delays a measurement twice: before and after it counts as sent.
        """
        late = self._phases[-1] - min(self._phases)
        sent = (self._age - self._least_age) / self.machine.rate / SECOND
        why = "on the way back"
        if sent > late / 4:
            why = f"as the machine lags by {1e3 * sent:.0f} ms"
        return f"the last by {1e3 * late:.0f} ms, {why}"

    def _check_identity(self) -> None:
        offered = None if self.last is None else self.last.identity
        differs = None if offered is None else offered.differing(self.identity)
        if differs is not None:
            raise ConfigError(
                f"{self.where} has {differs[0]}; the controller is designed for {differs[1]}: "
                "expected the same at both ends"
            )


# ---------------------------------------------------------------- finding a machine


def parse_address(text: str, option: str = "--machine") -> Address:
    """Return the address of HOST:PORT, which an option names."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"{option}: got {text!r}; expected HOST:PORT, such as 127.0.0.1:47000")
    with contextlib.suppress(OSError, UnicodeError):
        return socket.gethostbyname(host), int(port)
    raise ConfigError(f"{option}: got {text!r}; expected the name or address of a host")


def open_endpoint(address: Address, key: bytes | None) -> Endpoint[MachineMessage]:
    """Return a socket for a controller of the machine at an address."""
    if key is None and not is_loopback(address[0]):
        raise ConfigError(
            f"--machine: got {address[0]} without a key; expected a loopback address, or --key FILE"
        )
    host = "127.0.0.1" if is_loopback(address[0]) else "0.0.0.0"
    return Endpoint(MachineMessage, host, 0, key)


def call(contact: Contact) -> MachineMessage:
    """Request a session until the machine offers one and the link is known; return its offer."""
    began, first, where = now(), 0, contact.where
    while True:
        came = contact.ask()
        first = first or (now() if came else 0)
        for other in contact.endpoint.versions:
            if other.address == contact.session.address:
                raise ConfigError(
                    f"--machine: {where} speaks protocol version {other.version}; expected "
                    f"{VERSION}, of the same release on both sides"
                )
        if not first and now() - began > _PATIENCE * SECOND:
            silent = _refusals(contact) or ", or a machine with another key"
            raise ConfigError(
                f"--machine: got {where.removeprefix('machine at ')}, where nothing "
                f"answers{silent}; expected a machine of protocol version {VERSION} "
                "with the same --key, such as stewart-drake machine SCENARIO --port PORT"
            )
        known = len(contact.link.trips) >= _ENOUGH_TRIPS or now() - first > _LONGEST_CALL * SECOND
        if first and known and contact.last is not None:
            return contact.last


def await_free(contact: Contact) -> None:
    """Wait for a new offer of a machine that no other controller drives."""
    contact.forget_waiting()
    began, where = now(), contact.where
    patience = max(_PATIENCE * SECOND, 2 * contact.machine.watchdog)
    while now() - began <= patience:
        if contact.ask() and MachineFlags.BUSY not in contact.machine.flags:
            return
    silent = (now() - contact.heard) / SECOND
    if silent < patience / SECOND:
        raise ConfigError(
            f"{where} is in use by another controller (retry "
            f"{contact.machine.watchdog / SECOND:g} s after it stops)"
        )
    if contact.endpoint.refusal:
        raise ConfigError(
            f"{where} sent nothing for {silent:.1f} s{_refusals(contact)}; the last was "
            f"{contact.endpoint.refusal}"
        )
    raise ConfigError(f"{where} was silent for {silent:.1f} s; start it and live again")


def _refusals(contact: Contact) -> str:
    refused = ", ".join(f"{n} of cause {cause}" for cause, n in contact.refused.items())
    return f" that could be taken ({refused} refused)" if refused else ""
