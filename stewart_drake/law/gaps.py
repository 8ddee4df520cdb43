"""Measurements that are missing for a while, for an observer that filters.

A filter that goes on without measurements linearises along a way that is only guessed: as long as
little is known of the parameters, its covariance is then worth nothing, and what had been learnt is
lost with it. So the estimate of the last measurement is kept, with what has acted since, and the
next measurement corrects that one, over all n periods at once:

    y_k = h(f(x_{k-n}, T_{k-n} ... T_{k-1}, theta)) + noise,

by the iterations of `law.parameter_filter`, linearised along the way that explains it. With q_p and
q_v what one step of the model may be off in pose and rates, n of them are off by

    q_p^2 n + q_v^2 dt^2 (0^2 + 1^2 + ... + (n - 1)^2)   and   q_v^2 n.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from stewart_drake.law.belief import Belief, Estimate
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import ParameterObserver
from stewart_drake.law.parameter_filter import ParameterFilter, Period
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array

LONGEST = 10
"""Periods of a gap that are worth the time; after more the filter goes on by itself."""
NOTHING = TorqueSchedule(np.empty((0, 6)), np.empty(0))


@dataclass(frozen=True)
class GapBelief(Belief):
    """A belief, and what it was at the last measurement.

    Attributes:
        anchor: the estimate then; None where that was a period ago.
        since: what has acted from then on.
        periods: how many that are.
    """

    anchor: Estimate | None = None
    since: TorqueSchedule = NOTHING
    periods: int = 0


@dataclass(frozen=True)
class GapObserver(ParameterObserver):
    """The filter over state and parameters, which looks back over gaps between measurements."""

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """See `law.observers.Observer.start`."""
        first = super().start(timeline, sensing, plant)
        return GapBelief(**{field.name: getattr(first, field.name) for field in fields(first)})

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `law.observers.Observer.observe`."""
        assert isinstance(belief, GapBelief)
        after = super().observe(belief, measurement, in_flight, sensing, plant)
        assert isinstance(after, GapBelief)
        schedule, following = belief.timeline.last_period(in_flight)
        since = TorqueSchedule(
            *(np.concatenate(pair) for pair in zip(belief.since, schedule, strict=True))
        )
        periods = belief.periods + 1
        gone = replace(after, anchor=None, since=NOTHING, periods=0)
        known, found = belief.estimate, after.estimate
        if not known.uncertain or known.outliers or periods > LONGEST:
            return gone
        anchor = known if belief.anchor is None else belief.anchor
        if found.unseen > known.unseen and not found.outliers:  # nothing was measured
            return replace(after, anchor=anchor, since=since, periods=periods)
        if belief.anchor is None:
            return gone
        period = Period(*since, following, plant.substeps_for(since.torques))
        whole = self._filter(periods, belief.timeline.period, sensing, plant).advance(
            anchor, period, measurement
        )
        return gone if whole.outliers else replace(gone, estimate=whole, fault=None)

    def _filter(self, n: int, dt: float, sensing: Sensing, plant: NominalPlant) -> ParameterFilter:
        """The filter for n periods at a time."""
        settings = self.settings
        variance = n * settings.model_std**2
        drifts = (n - 1) * n * (2 * n - 1) / 6 * dt**2
        variance[POSE] += drifts * settings.model_std[RATES] ** 2
        longer = replace(settings, model_std=np.sqrt(variance))
        return ParameterFilter(plant.dynamics, sensing, longer)
