"""Which torque acts when: what a machine makes of plans. Times are ns of its clock."""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

from stewart_drake.core.link import Link
from stewart_drake.live.protocol import MOST_HISTORY, NEVER, Refusal
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

MOST_KEPT: Final = 1 << 12
"""Torques that wait at the most; a plan that brings more is refused."""
_REFUSALS: Final = (None, Refusal.MALFORMED, Refusal.LATE)


class Plan(NamedTuple):
    """Torques of a datagram.

    Attributes:
        sequence: of the datagram; 0 of what was in flight before any.
        sampled: ns, for when they were computed.
        sample: number of that, from the run's begin on.
        playout: ns, when the first row shall act.
        torques: (n, 6) N m.
    """

    sequence: int
    sampled: int
    sample: int
    playout: int
    torques: Array


class Motors:
    """What lies between the datagrams and the shafts: a link of core/link.h.

    In a buffer row i of a plan is for the period that begins at playout + i dt. Over a wire only
    the first row counts, and acts when it arrives.

    Args:
        limit: of each motor, N m.
        period: dt, ns.
        holds: whether a dry buffer holds the last torque, or puts out zero.
        delay_of: ns that the torque of sample k is under way on a wire; None is a buffer.
    """

    def __init__(
        self,
        limit: float,
        period: int,
        holds: bool = True,
        delay_of: Callable[[int], int] | None = None,
    ) -> None:
        self.holds, self.is_wire, self._delay_of = holds, delay_of is not None, delay_of
        given, history = (NUM_TORQUES, MOST_KEPT, period), MOST_HISTORY
        self._link = Link(*given, wire=self.is_wire, holds=holds, history=history, limit=limit)
        self._memory, self._begun = self._link.start(), False

    @property
    def torque(self) -> Array:
        """(6,) N m, what acts now."""
        return self._link.acted(self._memory)[0, 1:].copy()

    @property
    def acted(self) -> list[tuple[int, Array]]:
        """When the last torques began to act, and these, the newest first."""
        rows = self._link.acted(self._memory)[: int(self._number("acted"))]
        return [(int(row[0]), row[1:].copy()) for row in rows]

    @property
    def played(self) -> int:
        """Periods in which a torque of a plan acted."""
        return int(self._number("played"))

    @property
    def dry(self) -> int:
        """Periods for which there was none."""
        return int(self._number("dry"))

    @property
    def fed(self) -> bool:
        """Whether what acts now is of a plan."""
        return self._number("fed") > 0

    def _number(self, name: str) -> float:
        return self._link.number(self._memory, name)

    def begin(self, queue: Plan) -> None:
        """From now on torques act, first those that are in flight."""
        self._begun = True
        self._link.begin(self._memory, queue.playout, queue.torques)

    def take(self, plan: Plan, time: int) -> Refusal | None:
        """Take a plan that has arrived. Return why it is of no use, or None."""
        first = plan.playout
        if self._delay_of is not None:
            first = max(time, plan.sampled + self._delay_of(plan.sample))
        return _REFUSALS[self._link.take(self._memory, time, plan.sequence, first, plan.torques)]

    @property
    def next_change(self) -> int:
        """When `change` is to be called next, or NEVER."""
        there = self._link.next_change(self._memory) if self._begun else math.inf
        return NEVER if math.isinf(there) else int(there)

    def change(self, time: int) -> None:
        """What acts from `next_change` on."""
        self._link.change(self._memory, time)

    def safe(self, time: int, holds: bool) -> None:
        """Forget what waits; the torque that acts, or zero, until a plan brings others."""
        self._link.safe(self._memory, time, holds)
