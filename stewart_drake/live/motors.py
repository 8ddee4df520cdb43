"""Which torque acts when: what a machine makes of plans. Times are ns of its clock."""

import heapq
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Final, NamedTuple, Protocol

import numpy as np

from stewart_drake.live.protocol import MOST_HISTORY, NEVER, Refusal
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

MOST_KEPT: Final = 1 << 16
"""Torques that wait at the most; a plan that brings more is refused."""
_ZERO: Final = np.zeros(NUM_TORQUES)
_ZERO.flags.writeable = False


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


class Motors(Protocol):
    """What lies between the datagrams and the shafts."""

    torque: Array
    """(6,) N m, what acts now."""
    played: int
    """Periods in which a torque of a plan acted."""
    dry: int
    """Periods for which there was none."""
    fed: bool
    """Whether what acts now is of a plan."""
    acted: "deque[tuple[int, Array]]"
    """When the last torques began to act, the newest first."""

    @property
    def holds(self) -> bool:
        """Whether the last torque goes on where there is no next one."""
        ...

    @property
    def is_wire(self) -> bool:
        """Whether torques act when they arrive, whatever their play-out times."""
        ...

    def begin(self, queue: Plan) -> None:
        """From now on torques act, first those that are in flight."""
        ...

    def take(self, plan: Plan, time: int) -> Refusal | None:
        """A plan that has arrived; why it is of no use, or None."""
        ...

    @property
    def next_change(self) -> int:
        """When `change` is to be called next, or NEVER."""
        ...

    def change(self, time: int) -> None:
        """What acts from `next_change` on."""
        ...

    def safe(self, time: int, holds: bool) -> None:
        """Forget what waits; the torque that acts, or zero, until a plan brings others."""
        ...


@dataclass
class _Shafts:
    """What both kinds of motors have: the limit, what acts, and what has acted."""

    limit: float

    def __post_init__(self) -> None:
        self.torque: Array = _ZERO
        self.played, self.dry, self.fed = 0, 0, False
        self.acted: deque[tuple[int, Array]] = deque(maxlen=MOST_HISTORY)

    def _act(self, torque: Array, time: int) -> None:
        self.torque = torque
        self.acted.appendleft((time, torque))

    def _limited(self, torque: Array) -> Array:
        return np.clip(torque, -self.limit, self.limit)


@dataclass
class PlayoutMotors(_Shafts):
    """Torques wait for their play-out times, as in `loop.playout.PlayoutBuffer`.

    Row i of a plan is for the period that begins at playout + i dt. Of several for an instant the
    one of the newest plan acts. At the end of a period without a next one the buffer is dry.

    Attributes:
        limit: of each motor, N m.
        period: dt, ns.
        holds: whether a dry buffer holds the last torque, or puts out zero.
    """

    period: int
    holds: bool = True
    is_wire: ClassVar[bool] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._rows: dict[int, tuple[int, Array]] = {}
        self._times: list[int] = []
        self._last = -1
        self._begun = self._counts = False

    def begin(self, queue: Plan) -> None:
        """See `Motors`."""
        self._begun, self._last = True, queue.playout - 1
        self._keep(queue)

    def take(self, plan: Plan, time: int) -> Refusal | None:
        """See `Motors`."""
        if len(self._rows) + len(plan.torques) > MOST_KEPT:
            return Refusal.MALFORMED
        if not len(plan.torques):
            return None
        last = plan.playout + (len(plan.torques) - 1) * self.period
        if last < time or last <= self._last:
            return Refusal.LATE
        self._keep(plan)
        return None

    def _keep(self, plan: Plan) -> None:
        for i, torque in enumerate(plan.torques):
            at = plan.playout + i * self.period
            if at <= self._last:
                continue
            if at not in self._rows:
                heapq.heappush(self._times, at)
            elif self._rows[at][0] > plan.sequence:
                continue
            self._rows[at] = plan.sequence, self._limited(torque)

    @property
    def next_change(self) -> int:
        """See `Motors`."""
        if not self._begun:
            return NEVER
        there = self._times[0] if self._times else NEVER
        return min(there, self._last + self.period) if self._counts else there

    def change(self, time: int) -> None:
        """See `Motors`."""
        self._last, self._counts = time, True
        if self._times and self._times[0] <= time:
            sequence, torque = self._rows.pop(heapq.heappop(self._times))
            self.fed = sequence > 0
            self.played += self.fed
        else:
            self.dry, self.fed = self.dry + 1, False
            torque = self.torque if self.holds else _ZERO
        self._act(torque, time)

    def safe(self, time: int, holds: bool) -> None:
        """See `Motors`."""
        self._rows.clear()
        self._times.clear()
        self._counts = self.fed = False
        self._last = max(self._last, time)
        self._act(self.torque if holds else _ZERO, time)


@dataclass
class WireMotors(_Shafts):
    """Every torque acts when it arrives, `delay_of` its sample later, until a newer one does.

    Attributes:
        limit: of each motor, N m.
        period: ns, of the scenario's samples.
        delay_of: ns that the torque of sample k is under way.
    """

    period: int
    delay_of: Callable[[int], int]
    holds: ClassVar[bool] = True
    is_wire: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._arriving: list[tuple[int, int, tuple[float, ...]]] = []
        self._newest, self._begun = -MOST_KEPT, False

    def begin(self, queue: Plan) -> None:
        """See `Motors`."""
        self._begun = True
        for i, torque in enumerate(queue.torques):
            at = queue.playout + i * self.period
            sequence = i - len(queue.torques) + 1  # before those of any plan
            heapq.heappush(self._arriving, (at, sequence, tuple(torque)))

    def take(self, plan: Plan, time: int) -> Refusal | None:
        """See `Motors`; only the first row counts: a wire has no buffer."""
        if len(self._arriving) >= MOST_KEPT:
            return Refusal.MALFORMED
        if not len(plan.torques):
            return None
        if plan.sequence < self._newest:
            return Refusal.LATE
        at = max(time, plan.sampled + self.delay_of(plan.sample))
        heapq.heappush(self._arriving, (at, plan.sequence, tuple(plan.torques[0])))
        return None

    @property
    def next_change(self) -> int:
        """See `Motors`."""
        return self._arriving[0][0] if self._begun and self._arriving else NEVER

    def change(self, time: int) -> None:
        """See `Motors`."""
        _, sequence, torque = heapq.heappop(self._arriving)
        if sequence < self._newest:  # it was overtaken
            return
        self._newest, self.fed = sequence, sequence > 0
        self.played += self.fed
        self._act(self._limited(np.array(torque)), time)

    def safe(self, time: int, holds: bool) -> None:
        """See `Motors`."""
        self._arriving.clear()
        self.fed, self._newest = False, -MOST_KEPT  # a new session counts anew
        self._act(self.torque if holds else _ZERO, time)
