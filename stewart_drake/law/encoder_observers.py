"""What to make of encoders, with a filter and without."""

from dataclasses import dataclass, replace

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.encoder_filter import EncoderFilter
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import NoObserver, ParameterObserver, moved, told
from stewart_drake.law.sensing import Sensing
from stewart_drake.scenario.signals import POSE
from stewart_drake.types import Array


@dataclass(frozen=True)
class EncoderObserver(ParameterObserver):
    """The filter of `law.encoder_filter` over state and parameters."""

    def filter(
        self, last: Array, still: Array, sensing: Sensing, plant: NominalPlant
    ) -> EncoderFilter:
        """See `ParameterObserver.filter`."""
        return EncoderFilter(plant.dynamics, sensing, self.settings, last, still)


@dataclass(frozen=True)
class DifferencesObserver(NoObserver):
    """What there is without a filter: q_k by forward kinematics, v_k = (q_k - q_{k-1}) / dt.

    The rates are those of half a period ago, and quantisation comes divided by the period. Where a
    leg is silent, or no pose has the angles, it goes on by the model. The first rates are those
    that the sensing expects.
    """

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `law.observers.Observer.observe`."""
        after = told(belief, measurement, sensing, plant)
        of_now, now = sensing.now(measurement)
        first = of_now.start(now, belief.state) if now.complete else None
        if first is None:
            cause = "measurements_rejected" if now.complete else "measurements_missing"
            after = replace(after, fault=cause)
            return after.at(moved(belief, in_flight, plant)) if belief.has_state else after
        if not belief.has_state:
            return after.at(first.state)
        pose = first.state[POSE]
        rates = (pose - belief.state[POSE]) / belief.timeline.period
        return after.at(np.concatenate([pose, rates]))
