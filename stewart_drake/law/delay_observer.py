"""Estimate of state, parameters and an unknown delay, see core/delay.h and core/delay_search.c."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.arrivals import Arrivals
from stewart_drake.law.belief import Belief, Estimate
from stewart_drake.law.compiled import Compiled, Once, machine_of, numbers
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import told
from stewart_drake.law.parameter_filter import gate
from stewart_drake.law.sensing import Sensing, compiled_sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array


@dataclass(frozen=True)
class DelaySettings:
    """Prior of the delay and of its changes.

    Attributes:
        std: s, of the prior about the delay that is believed in.
        longest: s.
        timing_std: s by which a single torque may come early or late, at the least.
        walk: s per root s, of the delay itself.
        rate_std: s/s, of its rate; 0 for none.
        rate_walk: s/s per root s.
    """

    std: float
    longest: float
    timing_std: float
    walk: float
    rate_std: float
    rate_walk: float


def delay_settings(
    kind: Literal["constant", "drifting"], std: float, longest: float
) -> DelaySettings:
    """Return the settings for a constant delay, or for one whose rate is estimated."""
    if kind == "constant":
        return DelaySettings(std, longest, 2e-4, 0.0, 0.0, 0.0)
    return DelaySettings(std, longest, 2e-4, 3e-4, 0.02, 5e-3)


@dataclass(frozen=True)
class Guess:
    """A hypothesis of the delay.

    Attributes:
        mean: (12 + p + 2,) of state, parameters, eta and its rate.
        root: of its covariance; the rows of eta and its rate are 0 where nothing has arrived.
        low, high: s, between which eta is.
        fits: whether the last measurement was not an outlier.
        outliers: in a row; with those that a torque at another time explains.
        timing: s^2, variance by which single torques come early or late, as it is estimated.
        weight: log of the odds.
    """

    mean: Array
    root: Array
    low: float
    high: float
    fits: bool
    outliers: int
    timing: float
    weight: float

    @property
    def eta(self) -> float:
        """s."""
        return float(self.mean[-2])

    @property
    def std(self) -> float:
        """s, of eta."""
        return float(np.linalg.norm(self.root[-2]))


@dataclass(frozen=True)
class DelayBelief(Belief):
    """A belief with all hypotheses of the delay.

    Attributes:
        numbers: all of it, as `stewart_delay_memory` holds it; of no size before any sample.
        flights: torques in flight that it is made for.
    """

    numbers: Array = field(default_factory=lambda: np.zeros(0))
    flights: int = 0

    @property
    def guesses(self) -> list[Guess]:
        """Hypotheses: that nothing has arrived, then the cells; or the only one; none at first."""
        number = 1 + int(self.memory.cells) if self.memory.known else 0
        return [self.guess_at(place) for place in range(number)]

    @property
    def guess(self) -> Guess:
        """The one that the law goes on with; there is none before the first measurement."""
        return self.guess_at(int(self.memory.best))

    def guess_at(self, place: int) -> Guess:
        """One of the hypotheses."""
        c, p, m = core(), len(self.parameters), len(self.measured)
        n = NUM_STATE + p + 2
        g = c.lib.stewart_delay_guess(p, m, self.flights, self.memory, place)
        mean, root = np.array(c.ffi.unpack(g.numbers, n)), np.zeros((n, n))
        c.lib.stewart_guess_root(g, n, c.at(root))
        told = (g.low, g.high, bool(g.fits), int(g.outliers), g.timing, g.weight)
        return Guess(mean, root, *told)

    @property
    def memory(self) -> Any:
        """`numbers` in C."""
        return core().ffi.cast("stewart_delay_memory *", core().at(self.numbers))


@dataclass(frozen=True)
class DelayObserver:
    """Estimates state, parameters and delay.

    Attributes:
        settings: of state and parameters.
        delay: of the delay.
        believed: s, mean of the prior.
        quiet: whether nothing is fed back before the delay is found.
    """

    settings: FilterSettings
    delay: DelaySettings
    believed: float
    quiet: bool

    def kept(self, period: float) -> int:
        """Torques that have to be kept in flight."""
        return math.ceil(self.delay.longest / period) + 2

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """The delay is what is believed."""
        none = np.zeros((0, NUM_TORQUES))
        first = Arrivals(timeline.period, Delay(0), self.believed, before=none)
        sensing = _of_now(sensing)
        nothing = Belief.nothing(first, sensing.size, self.settings.parameters.prior)
        return DelayBelief(nothing.estimate, first, nothing.measured)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `law.observers.Observer.observe`."""
        assert isinstance(belief, DelayBelief) and isinstance(belief.timeline, Arrivals)
        c, period, flights = core(), belief.timeline.period, len(in_flight)
        delay = compiled_delay(self, sensing, plant, period)
        now, measurement = sensing.now(measurement)
        after = told(belief, measurement, now, plant)
        if after.fault is None and not measurement.complete:
            after = replace(after, fault="measurements_missing")
        y = np.array(measurement.values) if after.fault is None else None
        near, queue = np.array(belief.state), np.ascontiguousarray(in_flight)
        sizes = (len(belief.parameters), now.size, flights)
        after = replace(after, numbers=belief.numbers.copy(), flights=flights)
        if not len(belief.numbers):
            after = replace(after, numbers=np.empty(c.lib.stewart_delay_size(*sizes)))
            c.lib.stewart_delay_start(delay.it, flights, after.memory)
        scratch = c.scratch(c.lib.stewart_delay_scratch(*sizes))
        c.lib.stewart_delay_observe(
            *(delay.it, flights, c.at(queue), c.at(y), c.at(near), after.memory, scratch)
        )
        delay.require_calm()
        return read_delay(after)


def read_delay(belief: DelayBelief) -> DelayBelief:
    """Return the belief with what the law reads of its numbers."""
    memory = belief.memory
    first, others = core().lib.STEWART_DELAY_NUMBERS, max(belief.flights - 1, 1)
    assert isinstance(belief.timeline, Arrivals)
    timeline = replace(
        belief.timeline,
        arrival=memory.eta,
        rate=memory.rate,
        sent=int(memory.sent),
        before=belief.numbers[first : first + NUM_TORQUES * others].reshape(others, NUM_TORQUES),
    )
    estimate = belief.estimate
    if memory.known:
        best = belief.guess
        root, nothing = best.root[:-2, :-2], np.full(len(belief.measured), np.nan)
        estimate = Estimate(best.mean[:-2], root @ root.T, nothing, best.outliers, root=root)
    return replace(
        belief,
        estimate=estimate,
        timeline=timeline,
        fault="measurements_rejected" if memory.rejected else belief.fault,
        feeds_back=bool(memory.feeds_back),
        caution=memory.caution,
        settled=bool(memory.settled),
        found=bool(memory.found),
        delay_mean=memory.mean,
        delay_std=memory.std,
    )


def _of_now(sensing: Sensing) -> Sensing:
    return sensing.now(Measurement.of(np.full(sensing.size, np.nan)))[0]


@Once
def _machine(plant: NominalPlant) -> Compiled:
    """Return the `stewart_machine` of a plant, with its substeps and limits."""
    machine, own = core().ffi.new("stewart_machine *"), machine_of(plant.dynamics)
    machine[0] = own.it[0]
    machine.torque_limit, machine.gentle_torque = plant.motors.limit, plant.gentle_torque
    machine.substeps = plant.substeps
    return Compiled(machine, (own,))


@Once
def compiled_delay(
    observer: DelayObserver, sensing: Sensing, plant: NominalPlant, period: float
) -> Compiled:
    """Return the `stewart_delay` of an observer for a plant and a sensor."""
    c, settings, delay = core(), observer.settings, observer.delay
    now, parameters = _of_now(sensing), settings.parameters
    machine, of_now, it = _machine(plant), compiled_sensing(now), c.ffi.new("stewart_delay *")
    it.machine, it.sensing, it.period = machine.it, of_now.it, period
    arrays = {
        "prior": numbers(parameters.prior),
        "prior_root": numbers(np.linalg.cholesky(parameters.covariance)),
        "std": numbers(parameters.std),
        "usual_std": numbers(parameters.usual_std),
        "lower": numbers(parameters.lower),
        "upper": numbers(parameters.upper),
    }
    for name, array in arrays.items():
        setattr(it, name, c.at(array))
    it.model_std, it.first_timing = list(settings.model_std), settings.timing_std
    it.gate, it.believed, it.quiet = gate(now.size), observer.believed, observer.quiet
    it.delay_std, it.longest, it.timing_std = delay.std, delay.longest, delay.timing_std
    it.walk, it.rate_std, it.rate_walk = delay.walk, delay.rate_std, delay.rate_walk
    return Compiled(it, (machine, of_now, now, arrays), of_now.raised)
