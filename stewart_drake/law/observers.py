"""Observers: state, parameters and delay from measurements and the torques that acted.

The recurrences are tables of functions of core/, see observer.h. `CoreObserver` selects one by the
sensor and by what is to be estimated:

| settings | delay | sensor of the state | encoders |
| --- | --- | --- | --- |
| None | None | the measurement as it comes | forward kinematics and differences |
| given | None | filter of filter.h; with `gaps` one over gaps | encoder_filter.c |
| given | given | delay.h and delay_search.c | the same, of the last sample of a period |
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, Protocol

import numpy as np
from scipy.special import chdtri

from stewart_drake.core.library import core
from stewart_drake.files.arguments import fixed, positive
from stewart_drake.law.belief import Belief, Estimate, Innovations
from stewart_drake.law.compiled import Compiled, Once, machine_of, numbers, raise_first
from stewart_drake.law.counts import Counts
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.sensing import (
    EncoderSensing,
    Measurement,
    Sensing,
    StateSensing,
    described,
    encoders_of,
    state_sensor,
)
from stewart_drake.law.timeline import Arrivals, Timeline
from stewart_drake.scenario.calibration import OFFSETS
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE, NUM_TORQUES
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array

OUTLIER: Final = 1e-6
"""Probability of an outlier under the assumptions of the filter."""
TIMING_STD: Final = 2e-4
"""Least standard deviation of the timing of single torques, s, where the delay is estimated."""


class Observer(Protocol):
    """A kind of observer: belief in, belief out. Instances are immutable."""

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """Return the belief before the first sample, with the assumed delay."""
        ...

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """Take one period, then a measurement at its end.

        Args:
            belief: after the last sample.
            measurement: of this one, as it came.
            in_flight: (n, 6) torques, oldest first, before this sample's torque.
            sensing: model of the sensor.

        Returns:
            The new belief. Its state may be NaN until the first measurement without a fault; the
            law then uses the reference.
        """
        ...


@dataclass(frozen=True)
class DelaySettings:
    """Prior of the delay and of its changes.

    Attributes:
        mean, std: s, of the prior.
        longest: s.
        walk: s per root s, of the delay itself.
        rate_std: s/s, of its rate; 0 for none.
        rate_walk: s/s per root s.
        open_loop_start: whether feedback waits until the delay is found.
        timing_std: s, least standard deviation of the timing of single torques.
    """

    mean: float
    std: float
    longest: float
    walk: float = 0.0
    rate_std: float = 0.0
    rate_walk: float = 0.0
    open_loop_start: bool = False
    timing_std: float = TIMING_STD

    def __post_init__(self) -> None:
        prior = self.mean, self.walk, self.rate_std, self.rate_walk, self.timing_std
        fixed("mean, walk, rate_std, rate_walk, timing_std", prior, (5,), 0.0)
        positive("std", self.std)
        positive("longest", self.longest)

    @classmethod
    def of(
        cls,
        kind: Literal["constant", "drifting"],
        mean: float,
        std: float,
        longest: float,
        open_loop_start: bool,
    ) -> "DelaySettings":
        """Return the prior of a constant delay, or of one with an unknown rate."""
        drift = (0.0, 0.0, 0.0) if kind == "constant" else (3e-4, 0.02, 5e-3)
        return cls(mean, std, longest, *drift, open_loop_start)


@dataclass(frozen=True)
class CoreObserver:
    """Observer of the core.

    Attributes:
        settings: of the filter; None: only the state is estimated.
        delay: prior of an unknown delay; None: the delay is known.
        gaps: whether the filter corrects the estimate before a gap between measurements.
        timing: whether the timing of the torques is learnt without a filter.
    """

    settings: FilterSettings | None = None
    delay: DelaySettings | None = None
    gaps: bool = False
    timing: bool = False

    def extra_torques(self, period: float) -> int:
        """Return the number of torques to keep in flight beyond the assumed delay."""
        return 0 if self.delay is None else math.ceil(self.delay.longest / period) + 2

    def max_schedule_length(self, period: float) -> int:
        """Return the most torques that act until the next one, where the delay is estimated.

        Changes are a period apart, up to 1.5 times the longest delay if that grows the fastest.
        """
        assert self.delay is not None
        return math.ceil(1.5 * self.delay.longest / period) + 4

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        if self.delay is not None:
            other = np.zeros((1, NUM_TORQUES))
            timeline = Arrivals(timeline.period, Delay(0), self.delay.mean, other_torques=other)
        law = self.law(timeline, sensing, plant)
        memory = np.empty(law.pointer.observer.memory(law.pointer))
        law.pointer.observer.start(law.pointer, core().at(memory))
        return belief_of(self, law.pointer, memory, timeline)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        timeline, c = belief.timeline, core()
        law = self.law(timeline, sensing, plant)
        observer, memory = law.pointer.observer, belief.memory.copy()
        if self.delay is None:
            if not timeline.parts:
                timeline.queue(in_flight)  # refuses too few torques
            known = belief.estimate.mean if self.settings else belief.state
            memory[: len(known)] = known  # the caller may have set another state
            last = _last_values(self, law.pointer)
            memory[last : last + sensing.size] = belief.measured
        else:
            if len(in_flight) != 1 + law.pointer.extra_torques:
                raise ValueError(
                    f"in_flight: got {len(in_flight)}; expected {1 + law.pointer.extra_torques}"
                )
            memory[:NUM_STATE] = belief.state
        values, torques = measurement.known(sensing.size), numbers(in_flight)
        given = c.at(memory), len(torques), c.at(torques), c.at(values)
        status = observer.observe(law.pointer, *given, c.scratch(observer.scratch(law.pointer)))
        raise_first(law.raised)
        return belief_of(self, law.pointer, memory, timeline, status)

    def law(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Compiled:
        """Return a `stewart_law` with all that the observer reads of it."""
        clock = timeline.period, timeline.steps, timeline.fraction, timeline.parts
        return _law_of(self, sensing, plant, *clock)


_ENCODERS: Final = {
    "differences": "stewart_encoder_sensing",
    "filter": "stewart_encoder_filter_sensing",
    "delay": "stewart_newest_encoder_sensing",
}
"""Functions of the core that read encoders, by the kind of observer."""


def set_observer(
    law: Any, observer: CoreObserver, sensing: Sensing, plant: NominalPlant, period: float
) -> Compiled:
    """Set observer and sensor of a `stewart_law`; return the sensor and all that these point to."""
    c, within, settings = core(), type(sensing) is EncoderSensing, observer.settings
    if not within and type(sensing) is not StateSensing:
        sensor = described(sensing, plant.mechanism)
        law.own_sensing = sensor.pointer
    else:
        sensor = encoders_of(sensing) if within else state_sensor(sensing)
        law.sensing = sensor.pointer
    kind, estimation = "differences" if within else "timing" if observer.timing else "state", None
    if settings is not None and settings.parameters.names != tuple(plant.dynamics.free):
        free = ", ".join(plant.dynamics.free)
        raise ValueError(f"settings.parameters: got other names than those of the plant: {free}")
    if settings is not None and observer.delay is not None:
        kind, size = "delay", NUM_LEGS if within else sensing.size
        estimation = _delay_settings_of(observer, settings, size, period)
    elif settings is not None:
        kind = "gap" if observer.gaps and not within else "filter"
        estimation = filter_settings_of(settings, sensing.size)
    if estimation is not None:
        law.estimation = estimation.pointer
    law.observer = c.ffi.addressof(c.lib, f"stewart_{kind}_observer")
    read = _ENCODERS[kind] if within else "stewart_state_sensing"
    law.make_sensing = c.ffi.addressof(c.lib, read)
    return Compiled(sensor.pointer, (sensor.keep_alive, estimation), sensor.raised)


@Once
def _law_of(
    observer: CoreObserver,
    sensing: Sensing,
    plant: NominalPlant,
    period: float,
    steps: int,
    fraction: float,
    parts: int,
) -> Compiled:
    law, machine = core().ffi.new("stewart_law *"), machine_of(plant)
    part = set_observer(law, observer, sensing, plant, period)
    law.machine, law.period, law.parts = machine.pointer[0], period, parts
    law.num_values, law.extra_torques = sensing.size, observer.extra_torques(period)
    if observer.delay is None:
        law.steps, law.fraction = steps, fraction
    return Compiled(law, (machine, part), (*machine.raised, *part.raised))


@Once
def filter_settings_of(settings: FilterSettings, size: int) -> Compiled:
    c, known, p = core(), settings.parameters, len(settings.parameters.names)
    free, walk = np.full(NUM_STATE, np.inf), settings.walk_std
    it, prior = c.ffi.new("stewart_filter_settings *"), numbers(known.prior)
    arrays = {
        "prior_root": numbers(np.linalg.cholesky(known.covariance), p, p),
        "usual_std": numbers(known.usual_std, p),
        "walk_std": numbers(np.zeros(p) if walk is None else walk, p),
        "model_std": numbers(settings.model_std, NUM_STATE),
        "wander_std": numbers(settings.wander * known.usual_std, p),
        "lower": numbers([*-free, *known.lower], NUM_STATE + p),
        "upper": numbers([*free, *known.upper], NUM_STATE + p),
    }
    if settings.jump_std is not None:
        arrays["jump_std"] = numbers(settings.jump_std, p)
    # A larger squared normalised innovation is an outlier.
    it.filter.gate, it.filter.timing_std = float(chdtri(size, OUTLIER)), settings.timing_std
    it.prior = c.at(prior)
    it.filter.learns_timing = settings.learns_timing
    it.filter.forgetting = settings.forgetting
    it.filter.offsets = known.names.index(OFFSETS[0]) if OFFSETS[0] in known.names else -1
    for name, array in arrays.items():
        setattr(it.filter, name, c.at(array))
    return Compiled(it, (prior, arrays))


def _delay_settings_of(
    observer: CoreObserver, settings: FilterSettings, size: int, period: float
) -> Compiled:
    c, delay, std = core(), observer.delay, numbers(settings.parameters.std)
    assert delay is not None
    it, assumed = c.ffi.new("stewart_delay_settings *"), filter_settings_of(settings, size)
    it.values, it.most = size, observer.max_schedule_length(period)
    it.delay.filter, it.delay.prior = assumed.pointer.filter, assumed.pointer.prior
    it.delay.std, it.delay.period, it.delay.delay_mean = c.at(std), period, delay.mean
    it.delay.delay_std, it.delay.open_loop_start = delay.std, delay.open_loop_start
    for name in ("longest", "timing_std", "walk", "rate_std", "rate_walk"):
        setattr(it.delay, name, getattr(delay, name))
    return Compiled(it, (std, assumed))


def _last_values(observer: CoreObserver, law: Any) -> int:
    """Return the place of the last values in the memory of an observer of a known delay."""
    size = core().lib.stewart_posterior_size(NUM_STATE + law.machine.estimated, law.num_values)
    return int(size) if observer.settings is not None else NUM_STATE


def belief_of(
    observer: CoreObserver, law: Any, memory: Array, timeline: Timeline, status: int = 0
) -> Belief:
    """Return the belief that the memory of an observer of the core holds.

    Args:
        law: `stewart_law *` with it.
        memory: of the observer, which the belief keeps.
        timeline: the assumed one.
        status: of the last sample, bits of `stewart_status`.
    """
    c, p = core(), law.machine.estimated
    counted = Counts._fields[: c.lib.STEWART_CAUSES]
    faults = tuple(name for i, name in enumerate(counted) if status >> i & 1)
    if observer.delay is not None:
        return _delay_belief(law, memory, timeline, faults)
    n, m, last = NUM_STATE + p, law.num_values, _last_values(observer, law)
    measured, uncertainty = memory[last : last + m], law.observer.uncertainty
    timing = uncertainty(law, c.at(memory), c.ffi.NULL) if uncertainty else 0.0
    if observer.settings is not None:
        mean, root, rest = np.split(memory[:last], [n, n + n * n])
        L, (left_out, *innovations) = root.reshape(n, n), rest[[m + 2, m + 3, m + 4, -1]]
        belief = Belief(
            Estimate(mean, L @ L.T), timeline, measured, faults, timing=timing, memory=memory
        )
        partial = int(left_out).bit_count()
        return replace(belief, partial=partial, innovations=Innovations(*map(float, innovations)))
    theta, std = np.empty(p), np.empty(p)
    law.observer.parameters(law, *map(c.at, (memory, theta, std)))
    belief = Belief.nothing(timeline, m, theta).at(memory[:NUM_STATE])
    return replace(belief, measured=measured, faults=faults, timing=timing, memory=memory)


def _delay_belief(law: Any, memory: Array, timeline: Timeline, faults: tuple[str, ...]) -> Belief:
    c, p, num_in_flight = core(), law.machine.estimated, 1 + law.extra_torques
    settings = c.ffi.cast("stewart_delay_settings *", law.estimation)
    m, n, first = settings.values, NUM_STATE + p + 2, NUM_STATE + c.lib.STEWART_DELAY_NUMBERS
    it = c.ffi.cast("stewart_delay_memory *", c.at(memory[NUM_STATE:]))
    state, last = memory[:NUM_STATE], memory[-m:]
    belief = Belief.nothing(timeline, m, np.array(c.ffi.unpack(settings.delay.prior, p)))
    if it.known:
        best = c.lib.stewart_delay_hypothesis(p, m, num_in_flight, it, int(it.best))
        L = np.zeros((n, n))
        c.lib.stewart_unpack_root(n, best.numbers + n, c.at(L))
        mean, root = np.array(c.ffi.unpack(best.numbers, n))[:-2], L[:-2, :-2]
        seen = Innovations(best.chi2, best.chi2_values)
        belief = replace(belief, estimate=Estimate(mean, root @ root.T), innovations=seen)
    others = max(num_in_flight - 1, 1)
    before = memory[first : first + NUM_TORQUES * others].reshape(others, NUM_TORQUES)
    sent = max(0, int(it.num_own))  # -1 before the first sample
    return replace(
        belief.at(state),
        timeline=Arrivals(timeline.period, Delay(0), it.eta, it.rate, sent, before),
        measured=last,
        faults=faults,
        feeds_back=bool(it.feeds_back),
        caution=it.caution,
        settled=bool(it.settled),
        found=bool(it.found),
        timing=law.observer.uncertainty(law, c.at(memory), c.ffi.NULL),
        delay_mean=it.mean,
        delay_std=it.std,
        memory=memory,
    )
