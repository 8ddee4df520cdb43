"""Learned torques and setpoints in a live run, with soft starts.

As in `law.learned`, l is added to the torques or setpoints of the law. For the instant t of the
motion that is, with c the mean of l for torques and 0 for setpoints,

    c + g(s) (l(t) - c),   g(s) = 10 s^3 - 15 s^4 + 6 s^5.

s goes from 0 to 1 within a second on the motion, and back by hand or on the way to rest.
"""

from typing import Any, Final

import numpy as np

from stewart_drake.law.learned import LearnedMemory
from stewart_drake.law.servos import rise
from stewart_drake.live.design import Design
from stewart_drake.live.exchange import KEPT
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

_SOFT_START: Final = 1.0
"""Time in which what was learned comes in or goes out, s."""


class LearnedSetpoints:
    """Learned part of the setpoints of a plan, by what was learned at present."""

    def __init__(self, design: Design) -> None:
        assert design.learned is not None
        self.learned, self._share = design.learned, 0.0
        self._period = design.experiment.scenario.controller.period

    def plan(self, t: float, rows: int, by_hand: bool) -> Array:
        """Return the part for a plan from the instant t of the motion on, (rows, 6), rad."""
        return self.shares(rows, by_hand) * self.learned()(self.times(t, rows))

    def times(self, t: float, rows: int) -> Array:
        return t + self._period * np.arange(rows, dtype=np.float64)

    def shares(self, rows: int, by_hand: bool) -> Array:
        """Return g(s) of this sample and those after it, (rows, 1); to be called once a sample."""
        change = (-1 if by_hand else 1) * self._period / _SOFT_START
        share: Array = self._share + change * np.arange(rows, dtype=np.float64)
        self._share = float(np.clip(self._share + change, 0, 1))
        return rise(share)[:, None]


class LearnedTorques(LearnedSetpoints):
    """Learned torques of a run, added to those of the law."""

    def __init__(self, design: Design) -> None:
        super().__init__(design)
        self._design, self._added = design, dict[int, Array]()
        self.saturated = 0  # number of samples whose sum was beyond the limit

    def packet(self, k: int, memory: Any, rows: Array, by_hand: bool) -> Array:
        """Return the torques (n, 6) to send at sample k, and give the law its part of them.

        `rows` (n, 6) of the law begin with repeated torques. Those in its memory after the sample
        are limited so that the sum is.
        """
        repeats, signal = self._design.repeats, self.learned()
        middle = k * self._period + self._design.law.timeline.eta + self._period / 2
        number, mean = len(rows) - repeats, signal.coefficients[0]
        learned = mean + self.shares(number, by_hand) * (signal(self.times(middle, number)) - mean)
        earlier = [self.added(n) for n in range(k - repeats, k)]
        self._added[k] = learned[0]
        self._added.pop(k - 2 * KEPT, None)
        asked = rows + np.vstack([*earlier, learned])
        asked[repeats] = memory.torque + learned[0]
        sent: Array = self._design.law.plant.motors.saturate(asked)
        self.saturated += bool(np.any(sent[repeats] != asked[repeats]))
        rows[repeats:] = sent[repeats:] - learned  # the limit is on the sum
        memory.in_flight[-1] = rows[repeats]
        return sent

    def added(self, k: int) -> Array:
        """Return what was added to the torque of a sample, (6,) N m."""
        return self._added.get(k, np.zeros(NUM_TORQUES))

    def as_sent(self, k: int, memory: Any) -> LearnedMemory:
        """Return the memory of the law after sample k with the torque as it was sent."""
        torque = memory.torque + self._added[k]
        return LearnedMemory(memory, memory.in_flight, torque, k, self.saturated)
