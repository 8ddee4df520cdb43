"""Measurements that are older than now, for any observer.

The belief of an observer is of the instant of its last measurement, m periods ago. From there the
model goes on through the torques that have acted since:

    x(t_k) = f(x(t_k - m dt), torques of the last m periods, theta).

A newer measurement moves the observer to its own instant, one period after the other, and the rest
of the way is predicted anew, so that nothing is fed back before it is true.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import Observer
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.types import Array


@dataclass(frozen=True)
class LateBelief(Belief):
    """A belief of now, and the one that it was predicted from.

    Attributes:
        past: of the observer, at the last measurement that it took.
        behind: how many periods ago that was.
    """

    past: Belief | None = None
    behind: int = 0


@dataclass(frozen=True)
class LateObserver:
    """Makes an observer that takes measurements for those of now one that minds their age.

    Attributes:
        observer: that does the estimating.
        longest: periods that it waits for a measurement; then it goes on by the model.
    """

    observer: Observer
    longest: int

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """See `law.observers.Observer.start`."""
        past = self.observer.start(timeline, sensing, plant)
        return LateBelief(**_told(past), fault=past.fault, past=past)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `law.observers.Observer.observe`; the age is a whole number of periods."""
        assert isinstance(belief, LateBelief) and belief.past is not None
        past, behind = belief.past, belief.behind + 1
        age = round(measurement.age / past.timeline.period)
        there = bool(np.any(measurement.valid)) and age >= 0
        wanted = min(age, self.longest) if there else self.longest
        fault: str | None = "measurements_missing" if not there else None
        partly: tuple[str, ...] = ()
        while behind > wanted:
            behind -= 1
            then = in_flight[: len(in_flight) - behind]
            fresh = there and behind == age
            said = replace(measurement, age=0.0) if fresh else _nothing(sensing)
            past = self.observer.observe(past, said, then, sensing, plant)
            fault, partly = (past.fault, past.partly) if fresh else (fault, partly)
        estimate = past.estimate
        if past.has_state and behind:
            schedule = past.timeline.last_periods(in_flight, behind)
            now = plant.predict(past.state, schedule, past.parameters)[-1]
            estimate = past.at(now).estimate
        told = _told(past) | {"estimate": estimate}
        return LateBelief(**told, fault=fault, partly=partly, past=past, behind=behind)


def _told(past: Belief) -> dict[str, Any]:
    """What a belief goes on from."""
    return {name: getattr(past, name) for name in ("estimate", "timeline", "measured")}


def _nothing(sensing: Sensing) -> Measurement:
    return Measurement.of(np.full(sensing.size, np.nan))
