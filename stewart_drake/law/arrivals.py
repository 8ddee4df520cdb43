"""Timeline for a delay of any length that may drift, see core/arrivals.h."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


@dataclass(frozen=True, eq=False)
class Arrivals(Timeline):
    """A timeline whose delay is a number in s; to the design it is one of whole periods.

    The instant from which the next torque acts is where its error is regulated, so that seen from
    there no part of a period is left over.

    Attributes:
        arrival: eta in s, of a torque that arrives now; infinite for none ever.
        rate: of eta, s/s.
        sent: how many of the newest torques in flight are the controller's own.
        before: (b, 6) N m, what acts in each period from now on until the first of those arrives;
            the last for good.
    """

    arrival: float = 0.0
    rate: float = 0.0
    sent: int = 0
    before: Array = field(default_factory=lambda: np.zeros((1, 6)))

    @property
    def eta(self) -> float:
        """Of the torque that is computed now, s."""
        return self.arrival * (1 + self.rate)

    @property
    def first(self) -> float:
        """When the first of the controller's own torques arrives, s from now, of those kept."""
        return float((self.arrival - (self.sent - 1) * self.period) * (1 + self.rate))

    @property
    def samples(self) -> Array:
        """(s,) s from now at which another torque begins to act, up to the next one's."""
        view, at = self.compiled(), np.empty(self._most(self.eta))
        number = core().lib.stewart_switches(view, 0.0, self.eta, -1, core().at(at))
        return np.append(at[:number], self.eta)

    def queue(self, in_flight: Array) -> Array:
        """All of them: which acts when is for `until_next`."""
        return in_flight

    def until_next(self, queue: Array) -> TorqueSchedule:
        """What acts from now until the next torque does."""
        return self.within(queue, 0.0, self.eta)

    def last_period(self, in_flight: Array) -> tuple[TorqueSchedule, Array]:
        """What acted since the last sample, and what acts next."""
        schedule = self.within(in_flight, -self.period, 0.0)
        return schedule, self.within(in_flight, 0.0, self.period).torques[0]

    def within(
        self, in_flight: Array, begin: float, end: float, newest: int = -1
    ) -> TorqueSchedule:
        """What acts between two instants, s from now.

        Args:
            in_flight: (n, 6) torques, the oldest first; all before the last `sent` do not count.
            begin, end: s.
            newest: i of the last one: -1 at a sample that is to compute one, 0 after it.
        """
        queue = np.ascontiguousarray(in_flight)
        durations = np.empty(self._most(end))
        torques, c = np.empty((len(durations), NUM_TORQUES)), core()
        number = c.lib.stewart_within(
            *(self.compiled(), len(queue), c.at(queue), begin, end, newest),
            *(c.at(torques), c.at(durations)),
        )
        return TorqueSchedule(torques[:number], durations[:number])

    def later(self, kept: int) -> "Arrivals":
        """The same a period later with one more torque sent, of the `kept` that are in flight."""
        before = np.vstack([self.before[1:], self.before[-1:]])
        return replace(self, sent=min(self.sent + 1, kept), before=before)

    def compiled(self) -> Any:
        """Return the `stewart_arrivals`; `before` must be contiguous and outlive it."""
        numbers = (self.period, self.arrival, self.rate, self.sent, len(self.before))
        return core().ffi.new("stewart_arrivals *", (*numbers, core().at(self.before)))

    def _most(self, end: float) -> int:
        return int(core().lib.stewart_arrivals_most(self.compiled(), end))
