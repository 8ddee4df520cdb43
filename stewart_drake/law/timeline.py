"""Periods, delays and torques in flight: the torques that acted, and those that will act.

The torque computed at t = k dt acts during [t + eta, t + eta + dt), eta = (mu + eta0 / dt) dt. With
eta0 = 0 each period has one torque; with eta0 > 0 it has two, the older one for its first eta0.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.files.arguments import of_kind, positive
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array


class TorqueSchedule(NamedTuple):
    """Torques (n, 6) in N m that act one after the other, for `durations` (n,) s each."""

    torques: Array
    durations: Array


@dataclass(frozen=True)
class Timeline:
    """Clock of the controller, with the assumed delay.

    Attributes:
        period: dt in s.
        delay: eta, in periods.
        parts: torques per period that the machine reports; 0: the law remembers its own.
    """

    period: float
    delay: Delay
    parts: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        positive("period", self.period)
        of_kind("delay", self.delay, Delay)

    @property
    def steps(self) -> int:
        """Whole periods of delay, mu."""
        return self.delay.steps

    @property
    def fraction(self) -> float:
        """Rest of the delay eta0 / dt, in [0, 1)."""
        return self.delay.fraction

    @property
    def eta(self) -> float:
        """Delay of the torque that is computed now, s."""
        return self.delay.eta(self.period)

    @property
    def queue_length(self) -> int:
        """Torques in flight at a sampling instant, L."""
        return self.delay.queue_length

    @property
    def per_period(self) -> int:
        """Torques that act within one period."""
        return 1 if self.fraction == 0 else 2

    @property
    def samples(self) -> Array:
        """Sampling instants (mu,), s from now, up to the last before the next torque acts."""
        return self.period * np.arange(1.0, self.steps + 1)

    def holds(self, first: int, last: int) -> Array:
        """Return when holds `first` to `last` begin, s from now; 0 is that of the next torque."""
        return np.asarray(self.eta + self.period * np.arange(first, last + 1))

    def schedule(self, in_flight: Array) -> TorqueSchedule:
        """Return the schedule of all whole periods that torques (n, 6), oldest first, cover."""
        if self.fraction == 0:
            return TorqueSchedule(in_flight, np.full(len(in_flight), self.period))
        # Each torque acts for the end of one period and the beginning of the next.
        split = np.array([self.fraction, 1 - self.fraction]) * self.period
        torques = np.repeat(in_flight, 2, axis=0)[1:-1]
        return TorqueSchedule(torques, np.tile(split, len(in_flight) - 1))

    def queue(self, in_flight: Array) -> Array:
        """Return the torques (L, 6) that are still to act, of (n > L, 6), oldest first.

        Raises:
            ValueError: fewer torques than the delay takes.
        """
        return self._since(in_flight, 1)[1:]

    def until_next(self, queue: Array) -> TorqueSchedule:
        """Return the schedule from now until the next torque acts, of torques in flight (L, 6)."""
        holds = np.full(len(queue), self.period)
        if self.fraction > 0:
            holds[0] = self.fraction * self.period  # the oldest has acted for the rest of its hold
        return TorqueSchedule(queue, holds)

    def last_periods(self, in_flight: Array, number: int) -> TorqueSchedule:
        """Return the schedule of the last `number` >= 1 periods, of torques (n, 6).

        Raises:
            ValueError: fewer torques than that takes.
        """
        return self.next_periods(self._since(in_flight, number), number)

    def next_periods(self, queue: Array, number: int = 1) -> TorqueSchedule:
        """Return the schedule of the periods that the oldest of torques (n, 6) begin."""
        n = number * self.per_period
        return TorqueSchedule(*(part[:n] for part in self.schedule(queue)))

    def last_period(self, in_flight: Array) -> tuple[TorqueSchedule, Array]:
        """Return the schedule since the last sample, and the torque (6,) that acts next.

        Without a delay it is still to be computed, and with reported torques it depends on the
        servos; the last torque is returned then.

        Args:
            in_flight: (n > L, 6) torques, oldest first; with `parts` the reported ones.
        """
        if self.parts:
            parts = np.full(len(in_flight), self.period / self.parts)
            return TorqueSchedule(in_flight, parts), in_flight[-1]
        since = self._since(in_flight, 1)
        return self.next_periods(since), since[min(1, len(since) - 1)]

    def _since(self, in_flight: Array, periods: int) -> Array:
        """Return the torques (L + n, 6) that act from n = `periods` ago on."""
        longest = len(in_flight) - periods
        if longest < self.queue_length:
            raise ValueError(
                f"delay: {longest} torques are kept in flight; expected at least the "
                f"{self.queue_length} of {self.steps} periods and {self.fraction:g} of one"
            )
        return in_flight[longest - self.queue_length :]


@dataclass(frozen=True, eq=False)
class Arrivals(Timeline):
    """Timeline for a delay of any length that may drift, see core/arrivals.h.

    The error is regulated where the next torque begins to act. Seen from there no part of a period
    is left, so that the design has a delay of whole periods.

    Attributes:
        arrival: eta in s, of a torque that arrives now; infinite if none ever arrives.
        rate: of eta, s/s.
        num_own: number of torques in flight that the controller computed, the newest ones.
        other_torques: (b, 6) N m, in the periods from now on until the first of those arrives;
            the last one continues.
    """

    arrival: float = 0.0
    rate: float = 0.0
    num_own: int = 0
    other_torques: Array = field(default_factory=lambda: np.zeros((1, NUM_TORQUES)))

    @property
    def eta(self) -> float:
        return self.arrival * (1 + self.rate)

    @property
    def samples(self) -> Array:
        """Instants (s,), s from now, at which another torque begins to act, then the next one."""
        view, at = self._compiled(), np.empty(self._most(self.eta))
        number = core().lib.stewart_switch_times(view, 0.0, self.eta, -1, core().at(at))
        return np.append(at[:number], self.eta)

    def queue(self, in_flight: Array) -> Array:
        """Return all torques: `until_next` selects among them."""
        return in_flight

    def until_next(self, queue: Array) -> TorqueSchedule:
        return self.within(queue, 0.0, self.eta)

    def last_period(self, in_flight: Array) -> tuple[TorqueSchedule, Array]:
        schedule = self.within(in_flight, -self.period, 0.0)
        return schedule, self.within(in_flight, 0.0, self.period).torques[0]

    def within(
        self, in_flight: Array, begin: float, end: float, newest: int = -1
    ) -> TorqueSchedule:
        """Return the schedule between two instants, s from now.

        Args:
            in_flight: (n, 6) torques, oldest first; only the last `num_own` are used.
            begin: s, of the first instant.
            end: s, of the last instant.
            newest: sample of the last torque: -1 before this sample's is computed, 0 after it.
        """
        queue = np.ascontiguousarray(in_flight)
        durations = np.empty(self._most(end))
        torques, c = np.empty((len(durations), NUM_TORQUES)), core()
        number = c.lib.stewart_torque_schedule(
            *(self._compiled(), len(queue), c.at(queue), begin, end, newest),
            *(c.at(torques), c.at(durations)),
        )
        return TorqueSchedule(torques[:number], durations[:number])

    def _compiled(self) -> Any:
        """Return the `stewart_arrivals`; `other_torques` must be contiguous and outlive it."""
        numbers = (self.period, self.arrival, self.rate, self.num_own, len(self.other_torques))
        return core().ffi.new("stewart_arrivals *", (*numbers, core().at(self.other_torques)))

    def _most(self, end: float) -> int:
        return int(core().lib.stewart_max_torques(self._compiled(), end))
