"""The controller's view of its machine: what has come from it, and how long the link takes.

No clock is compared with another one. A measurement carries the instant at which it was taken, a
plan the instants at which its torques shall act, both of the machine's clock; how long a plan may
take is what is left of that. So the way there and the way back count together, as a round trip.
"""

import math
import select
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from stewart_drake.live.endpoint import Address, Endpoint, Session, now
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    ControllerFlags,
    ControllerMessage,
    MachineMessage,
    Refusal,
)
from stewart_drake.loop.peer import Identity
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

_TRIPS: Final = 256
"""Round trips that are remembered."""
_SETTLED: Final = 48
"""Datagrams after which one that has not arrived counts as lost, and is forgotten."""
_PHASES: Final = 128
"""Measurements of which the one that came soonest tells when the next will come."""


@dataclass
class Link:
    """What is known of the way there and back.

    Attributes:
        trips: last round trips, s: from sending a datagram to having its answer, without the time
            that the machine held it.
        sent: datagrams.
        lost: of them, as the machine says.
        missed: measurements that never came, by their numbers.
        came: that did.

    A request without an answer counts as half a datagram lost there and half an answer missed: the
    machine remembers nothing of requests.
    """

    trips: deque[float] = field(default_factory=lambda: deque(maxlen=_TRIPS))
    sent: int = 0
    lost: float = 0
    missed: float = 0
    came: int = 0

    @property
    def typical(self) -> float:
        """Median round trip, s; NaN before there is one."""
        return float(np.median(self.trips)) if self.trips else math.nan

    @property
    def spread(self) -> float:
        """Standard deviation of the round trips, s; NaN before there is one."""
        return float(np.std(self.trips)) if self.trips else math.nan

    @property
    def longest(self) -> float:
        """Of the round trips that are remembered, s; NaN before there is one."""
        return max(self.trips, default=math.nan)

    @property
    def shortest(self) -> float:
        """The same."""
        return min(self.trips, default=math.nan)

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
    """A session with a machine.

    Args:
        endpoint: to be used; whoever made it closes it.
        address: of the machine.
        identity: of the machine that the controller is designed for.

    Attributes:
        link: see `Link`.
        last: newest message of the machine, by its sequence, or None.
        offered: nonce of the newest offer; 0 without one.
        session: see `live.endpoint.Session`.
        heard: ns of the own clock, when something of the machine was last taken.
    """

    def __init__(self, endpoint: Endpoint, address: Address, identity: Identity) -> None:
        self._endpoint, self.identity, self.offered = endpoint, identity, 0
        self.session = Session.drawn(address)
        self.link = Link()
        self.last: MachineMessage | None = None
        self.heard = now()
        self._pending: dict[int, bool] = {}
        self._requests = set[int]()
        self._unanswered, self._first, self._followed = 0.0, 0, 0
        self._phases: deque[float] = deque(maxlen=_PHASES)
        self._newest = 0

    @property
    def refused(self) -> dict[str, int]:
        """Datagrams that were not acted upon, by cause."""
        return {cause.value: n for cause, n in self._endpoint.refused.items()}

    @property
    def unsent(self) -> int:
        """Datagrams that the system did not take."""
        return self._endpoint.unsent

    @property
    def endpoint(self) -> Endpoint:
        """Where datagrams come in."""
        return self._endpoint

    def join(self) -> None:
        """From now on as in the session that the machine has offered."""
        self.session.nonce = self.offered

    def ask(self) -> None:
        """Send a request for a session, or for another look at the machine's offer."""
        head = replace(self.session.head(now()), nonce=self.offered)
        message = ControllerMessage(head, identity=self.identity)
        self._endpoint.send(message, self.session.address)
        if self.offered:  # else the machine may leave it unanswered
            self._pending[head.sequence] = False
            self._requests.add(head.sequence)

    def send(
        self,
        torques: Array | None = None,
        *,
        sampled: int = 0,
        playout: int = 0,
        begin: int = NEVER,
        flags: ControllerFlags = NOTHING,
    ) -> int:
        """Send a datagram of these fields; its sequence."""
        rows = np.empty((0, NUM_TORQUES)) if torques is None else torques
        head = self.session.head(now())
        message = ControllerMessage(head, flags, sampled, playout, begin, rows)
        self._endpoint.send(message, self.session.address)
        self._pending[head.sequence] = False
        return head.sequence

    def has_arrived(self, sequence: int) -> bool:
        """Whether the machine has said that a datagram was there."""
        return self._pending.get(sequence, False)

    def wait(self, until: int) -> Iterator[MachineMessage]:
        """What comes until a time of the own clock, ns; at once if that is past."""
        left = max(0, until - now()) / SECOND
        if select.select([self._endpoint], [], [], left)[0]:
            yield from self.receive()

    def receive(self) -> Iterator[MachineMessage]:
        """What has come, each once, whatever the order."""
        for message, address in self._endpoint.receive():
            assert isinstance(message, MachineMessage)
            time = now()
            newest = self.session.window.tell(message.head.sequence)
            refused = self.session.refusal(message.head, address, time)
            if refused is not None:
                self._endpoint.refuse(refused, newest if refused != Refusal.FOREIGN else "")
                continue
            self.heard = time
            self._note(message, time)
            yield message

    def forget_waiting(self) -> None:
        """Count what came while nobody looked, and no more: how late it was is not the link's."""
        for message, address in self._endpoint.receive():
            assert isinstance(message, MachineMessage)
            if self.session.refusal(message.head, address, now()) is None:
                self.link.came += 1
                self._mark(message)

    def refuse(self, cause: Refusal, detail: str = "") -> None:
        """Count a message that was taken but is of no use."""
        self._endpoint.refuse(cause, detail)

    def _note(self, message: MachineMessage, time: int) -> None:
        head, link = message.head, self.link
        if self.last is None or head.sequence > self.last.head.sequence:
            self.last = message
        link.came += 1
        if message.identity is not None:
            self.offered = head.nonce
        else:
            self._first, self._followed = self._first or head.sequence, self._followed + 1
        gaps = self.session.window.newest - self._first + 1 - self._followed if self._first else 0
        self._phases.append((time - message.sampled / message.rate) / SECOND)
        if head.acknowledged > self._newest:  # else its answer was there before
            self._newest = head.acknowledged
            link.trips.append((time - head.echo - head.held / message.rate) / SECOND)
        self._mark(message)
        for settled in [n for n in self._pending if n <= head.acknowledged - _SETTLED]:
            link.sent += 1
            unanswered = not self._pending.pop(settled)
            asked = settled in self._requests
            self._requests.discard(settled)
            link.lost += 0.5 * unanswered if asked else unanswered
            self._unanswered += 0.5 * unanswered * asked
        link.missed = self._unanswered + max(0, gaps)

    def _mark(self, message: MachineMessage) -> None:
        for i, there in enumerate(message.arrived):
            if there and message.head.acknowledged - i in self._pending:
                self._pending[message.head.acknowledged - i] = True

    @property
    def soonest(self) -> float:
        """s of the own clock at which a measurement of the machine's time 0 would have come."""
        return min(self._phases, default=math.nan)

    def lateness(self, most: float) -> float:
        """By how much the last measurements came later than the soonest, s.

        Those that took longer than `most`, as where this process stood still, do not count.
        """
        late = (phase - self.soonest for phase in self._phases)
        return max((each for each in late if each <= most), default=0.0)

    def due(self, sampled: int, rate: float) -> float:
        """s of the own clock at which a measurement taken at ns of the machine's may come."""
        return self.soonest + sampled / rate / SECOND
