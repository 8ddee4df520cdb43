"""Periods, delays and torques in flight: what acted when, and what will.

The torque computed at t = k dt acts during [t + eta, t + eta + dt), eta = (mu + eta0 / dt) dt. With
eta0 = 0 each period has one torque; with eta0 > 0 it has two, the older one for its first eta0.
Nobody else does arithmetic with them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stewart_drake.scenario.delay import Delay
from stewart_drake.types import Array


class TorqueSchedule(NamedTuple):
    """Torques (n, 6) in N m that act one after the other, for `durations` (n,) s each."""

    torques: Array
    durations: Array


@dataclass(frozen=True)
class Timeline:
    """The controller's clock and the delay that it believes in.

    Attributes:
        period: dt in s.
        delay: eta, in periods.
    """

    period: float
    delay: Delay

    @property
    def steps(self) -> int:
        """mu, whole periods of delay."""
        return self.delay.steps

    @property
    def fraction(self) -> float:
        """eta0 / dt, in [0, 1)."""
        return self.delay.fraction

    @property
    def eta(self) -> float:
        """The whole delay, s."""
        return self.delay.eta(self.period)

    @property
    def queue_length(self) -> int:
        """Torques in flight at a sampling instant."""
        return self.delay.queue_length

    @property
    def per_period(self) -> int:
        """Torques that act within one period."""
        return 1 if self.fraction == 0 else 2

    @property
    def samples(self) -> Array:
        """(mu,) samples from now, s, up to the last before the next torque begins to act."""
        return self.period * np.arange(1.0, self.steps + 1)

    def holds(self, first: int, last: int) -> Array:
        """Beginnings, s from now, of the holds `first` to `last`; 0 is that of the next torque."""
        return np.asarray(self.eta + self.period * np.arange(first, last + 1))

    def schedule(self, in_flight: Array) -> TorqueSchedule:
        """What acts in all whole periods that torques (n, 6), the oldest first, cover."""
        if self.fraction == 0:
            return TorqueSchedule(in_flight, np.full(len(in_flight), self.period))
        # Each torque acts for the end of one period and the beginning of the next.
        split = np.array([self.fraction, 1 - self.fraction]) * self.period
        torques = np.repeat(in_flight, 2, axis=0)[1:-1]
        return TorqueSchedule(torques, np.tile(split, len(in_flight) - 1))

    def queue(self, in_flight: Array) -> Array:
        """(L, 6) of torques (n > L, 6), the oldest first, those that are still to act.

        Raises:
            ValueError: fewer torques than the delay takes.
        """
        return self._since_last_sample(in_flight)[1:]

    def _since_last_sample(self, in_flight: Array) -> Array:
        """(L + 1, 6), what acted in the last period too."""
        longest = len(in_flight) - 1
        if longest < self.queue_length:
            raise ValueError(
                f"delay: {longest} torques are kept in flight; expected at least the "
                f"{self.queue_length} of {self.steps} periods and {self.fraction:g} of one"
            )
        return in_flight[longest - self.queue_length :]

    def until_next(self, queue: Array) -> TorqueSchedule:
        """What acts from now until the next torque does, of torques in flight (L, 6)."""
        holds = np.full(len(queue), self.period)
        if self.fraction > 0:
            holds[0] = self.fraction * self.period  # the oldest has acted for the rest of its hold
        return TorqueSchedule(queue, holds)

    def last_periods(self, in_flight: Array, number: int) -> TorqueSchedule:
        """What acted in the last `number` >= 1 periods, of torques (n, 6), the oldest first.

        Raises:
            ValueError: fewer torques than that takes.
        """
        longest = len(in_flight) - number
        if longest < self.queue_length:
            raise ValueError(
                f"delay: {len(in_flight)} torques are kept; expected at least "
                f"{self.queue_length + number}"
            )
        torques, durations = self.schedule(in_flight[longest - self.queue_length :])
        n = number * self.per_period
        return TorqueSchedule(torques[:n], durations[:n])

    def next_period(self, queue: Array) -> TorqueSchedule:
        """What acts in the period in which the oldest of torques (n, 6) begins it."""
        torques, durations = self.schedule(queue)
        n = self.per_period
        return TorqueSchedule(torques[:n], durations[:n])

    def last_period(self, in_flight: Array) -> tuple[TorqueSchedule, Array]:
        """What acted since the last sample, and the torque (6,) that acts next.

        Without a delay that one is still to be computed: no change is known.

        Args:
            in_flight: (n > L, 6) torques, the oldest first.
        """
        torques, durations = self.schedule(self._since_last_sample(in_flight))
        n = self.per_period
        return TorqueSchedule(torques[:n], durations[:n]), torques[min(n, len(torques) - 1)]
