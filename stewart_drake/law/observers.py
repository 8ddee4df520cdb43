"""Where the plate is, and what it is: from measurements and from the torques that acted."""

from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.parameter_filter import ParameterFilter, Period
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.types import Array

AnyBelief = TypeVar("AnyBelief", bound=Belief)


class Observer(Protocol):
    """A kind of observer: belief in, belief out. Instances are immutable."""

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """What is believed before the first sample, with the delay that is assumed then."""
        ...

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """One period, then a measurement at its end.

        Args:
            belief: after the last sample.
            measurement: of this one, as it came.
            in_flight: (n, 6) as of `memory.Memory`, before this sample's torque.
            sensing: what is measured.
            plant: as it is known.

        Returns:
            The new belief, its `measured` and its `fault` too. Its state may be NaN only as long as
            there was no measurement without a fault; the law then takes the reference's.
        """
        ...


@dataclass(frozen=True)
class NoObserver:
    """Takes the measurement as it is, and goes on by the model where it has a fault."""

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """The parameters are what is known of the plant, for good."""
        return Belief.nothing(timeline, sensing.size, plant.dynamics.parameters)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `Observer.observe`."""
        after = told(belief, measurement, sensing, plant)
        first = sensing.start(measurement, belief.state) if after.fault is None else None
        if first is not None:
            return after.at(first.state)
        return after.at(moved(belief, in_flight, plant)) if belief.has_state else after


@dataclass(frozen=True)
class ParameterObserver:
    """The filter of `law.parameter_filter` over state and parameters.

    Attributes:
        settings: what it assumes.
    """

    settings: FilterSettings

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """The parameters are those of the prior, until the first measurement."""
        return Belief.nothing(timeline, sensing.size, self.settings.parameters.prior)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `Observer.observe`."""
        after = told(belief, measurement, sensing, plant)
        ekf = self.filter(belief.measured, after.still, sensing, plant)
        usable = measurement if after.fault is None else None
        if not belief.estimate.uncertain:
            first = None if usable is None else ekf.start(usable, belief.parameters, belief.state)
            if first is not None:
                return replace(after, estimate=first, partly=first.partly)
            return after.at(moved(belief, in_flight, plant)) if belief.has_state else after
        schedule, following = belief.timeline.last_period(in_flight)
        period = Period(*schedule, following, plant.substeps_for(schedule.torques))
        estimate, fault = ekf.advance(belief.estimate, period, usable), after.fault
        if estimate.outliers > 0:
            fault = "measurements_rejected"
            # Such a one said so before: it is no second witness.
            if np.array_equal(measurement.values, belief.measured):
                fault, estimate = "measurements_frozen", replace(estimate, outliers=0)
        return replace(after, estimate=estimate, fault=fault, partly=estimate.partly)

    def filter(
        self, last: Array, still: Array, sensing: Sensing, plant: NominalPlant
    ) -> ParameterFilter:
        """The filter of a sample.

        Args:
            last: (m,) what was measured before.
            still: as of `Sensing.stood`.
            sensing: what is measured.
            plant: as it is known.
        """
        return ParameterFilter(plant.dynamics, sensing, self.settings)


def told(
    belief: AnyBelief, measurement: Measurement, sensing: Sensing, plant: NominalPlant
) -> AnyBelief:
    """The belief with what was measured, and what is wrong with that, and nothing made of it."""
    measurement.require_fresh()
    period = belief.timeline.period
    fault = sensing.fault(measurement, belief.measured, period, plant.mechanism)
    still = sensing.stood(measurement, belief.measured, belief.still)
    measured = measurement.after(belief.measured)
    return replace(belief, measured=measured, fault=fault, partly=(), still=still)


def moved(belief: Belief, in_flight: Array, plant: NominalPlant) -> Array:
    """The state (12,) a period later, by the model alone."""
    schedule, _ = belief.timeline.last_period(in_flight)
    return plant.predict(belief.state, schedule)[-1]
