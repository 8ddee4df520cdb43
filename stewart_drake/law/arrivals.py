"""Which torque acts when, for a delay that is any number and may drift.

Seen from an instant 0, with the delay eta that torques arriving then have and its rate r, a torque
that is sent at i dt arrives after eta + r a if it arrives at a, so to first order of r at

    a_i = (i dt + eta) (1 + r).

It acts until the next one arrives. Until the first of the controller's own does, act those that
were sent before t = 0, by whoever and whenever: all that is known of them is what they do in each
period from t = 0 on.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from stewart_drake.law.timeline import Acting, Timeline
from stewart_drake.types import Array

INSTANT = 1e-9
"""s; arrivals closer than this are one."""


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
        return np.append(self._switches(0.0, self.eta, -1), self.eta)

    def queue(self, in_flight: Array) -> Array:
        """All of them: which acts when is for `until_next`."""
        return in_flight

    def until_next(self, queue: Array) -> Acting:
        """What acts from now until the next torque does."""
        return self.within(queue, 0.0, self.eta)

    def last_period(self, in_flight: Array) -> tuple[Acting, Array]:
        """What acted since the last sample, and what acts next."""
        acting = self.within(in_flight, -self.period, 0.0)
        return acting, self.within(in_flight, 0.0, self.period).torques[0]

    def within(self, in_flight: Array, begin: float, end: float, newest: int = -1) -> Acting:
        """What acts between two instants, s from now.

        Args:
            in_flight: (n, 6) torques, the oldest first; all before the last `sent` do not count.
            begin, end: s.
            newest: i of the last one: -1 at a sample that is to compute one, 0 after it.
        """
        starts = np.append(begin, self._switches(begin, end, newest))
        durations = np.diff(np.append(starts, end))
        place = np.searchsorted(self._arrivals(newest), starts + INSTANT, side="right") - 1
        period = np.floor(starts / self.period + INSTANT / self.period).astype(int)
        ours = in_flight[len(in_flight) - self.sent :]
        theirs = self.before[np.clip(period, 0, len(self.before) - 1)]
        if not len(ours):
            return Acting(theirs, durations)
        own = place[:, None] >= 0
        return Acting(np.where(own, ours[np.maximum(place, 0)], theirs), durations)

    def _arrivals(self, newest: int) -> Array:
        """(sent,) s from now, ascending."""
        i = newest - np.arange(self.sent - 1, -1, -1)
        return np.asarray((i * self.period + self.arrival) * (1 + self.rate))

    def _switches(self, begin: float, end: float, newest: int) -> Array:
        """Instants within (begin, end) at which another torque begins to act."""
        arrivals = self._arrivals(newest)
        first = arrivals[0] if len(arrivals) else np.inf
        grid = self.period * np.arange(1, int(min(end, 1e3) / self.period) + 1)
        grid = grid[grid < first - INSTANT]
        at = np.concatenate([grid, arrivals])
        return at[(at > begin + INSTANT) & (at < end - INSTANT)]

    def later(self, kept: int) -> "Arrivals":
        """The same a period later with one more torque sent, of the `kept` that are in flight."""
        before = np.vstack([self.before[1:], self.before[-1:]])
        return replace(self, sent=min(self.sent + 1, kept), before=before)
