"""The way back onto a reference after a gap in it, from the preview alone.

A preview ends one period after the hold of the next torque, so that a plan that ends on the
reference (`law.catch_up`) cannot be made from it. Instead the law follows the reference plus an
offset d = [pose; rates], which begins where the plate will be when the next torque begins to act
and is zero after n holds of h seconds. With an acceleration a_i in hold i, constant because torques
are held,

    0 = d_pose + n h d_rates + h^2 sum (n - i - 1/2) a_i,      0 = d_rates + h sum a_i.

The solution with the least sum of a_i^2 is linear in i: with c_i = (n - 1)/2 - i, sum c_i = 0 and
sum c_i^2 = n (n^2 - 1)/12,

    a_i = -d_rates / (n h) - 12 (d_pose + n h d_rates / 2) c_i / (h^2 n (n^2 - 1)).

What is left after the first hold is solved by the rest of these, so that d and n are all there is
to remember.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from stewart_drake.law.catch_up import DEFAULT_CATCH_UP
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, POSE, RATES
from stewart_drake.types import Array


@dataclass(frozen=True)
class ReturnPath:
    """Offset from the reference, from the instant on at which the next torque begins to act.

    Attributes:
        offset: (12,) of pose and rates at that instant.
        holds: number of holds until it is zero.
        samples: number of samples after that until no torque of the way back is in flight.
    """

    offset: Array = field(default_factory=lambda: np.zeros(NUM_STATE))
    holds: int = 0
    samples: int = 0

    @classmethod
    def of(cls, offset: Array, timeline: Timeline) -> "ReturnPath":
        """Return the path that takes DEFAULT_CATCH_UP seconds, or two holds."""
        holds = max(2, math.ceil(DEFAULT_CATCH_UP / timeline.period - 1e-6))
        return cls(offset, holds, timeline.queue_length + 2)

    @property
    def active(self) -> bool:
        """Whether something else is followed than the reference."""
        return self.holds + self.samples > 0

    def after(self, h: float) -> "ReturnPath":
        """Return the rest of it, one hold of `h` s later."""
        if self.holds == 0:
            return ReturnPath(samples=max(self.samples - 1, 0))
        return ReturnPath(self._moved(h, h)[:NUM_STATE], self.holds - 1, self.samples)

    def at(self, time: float, h: float) -> Array:
        """Return the offset (18,) of pose, rates and accelerations `time` s after its beginning."""
        path = self
        while path.holds and time > h:
            path, time = path.after(h), time - h
        return path._moved(time, h) if path.holds else np.zeros(NUM_REFERENCE)

    def _moved(self, time: float, h: float) -> Array:
        n, pose, rates = self.holds, self.offset[POSE], self.offset[RATES]
        a = -rates / (n * h)
        if n > 1:  # c_0 = (n - 1)/2
            a = a - 6 * (pose + n * h / 2 * rates) / (h * h * n * (n + 1))
        return np.concatenate([pose + time * (rates + time / 2 * a), rates + time * a, a])
