"""The whole step of a law in C, core/law.c, in the place of `PredictiveLqi.step`.

`serving` chooses. If the core has every part of a law, C steps it; otherwise Python composes the
same kernels. Memory is one flat vector; `CoreMemory` reads its fields by the
names of `law.memory.Memory`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import home_sign
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import periods_of
from stewart_drake.law.channel import Packets, Report, Sent, Wire, report_of, structures
from stewart_drake.law.compiled import Compiled, numbers
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.delay_observer import DelayObserver, compiled_delay, read_delay
from stewart_drake.law.design_models import MultibodyModel
from stewart_drake.law.encoder_observers import DifferencesObserver, EncoderObserver
from stewart_drake.law.encoder_sensing import EncoderSensing, encoders_of
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.gaps import GapObserver
from stewart_drake.law.late import LateObserver
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts, Memory
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.motors import TorqueLimit
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import NoObserver, ParameterObserver
from stewart_drake.law.parameter_filter import compiled_filter, estimate_of
from stewart_drake.law.planner import NoPlanner, Rejoin
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import ArrivalPredictor, NonlinearPredictor
from stewart_drake.law.sensing import Sensing, StateSensing, state_sensor
from stewart_drake.law.servo_preview import ServoPreview
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.geometry import geometry_of
from stewart_drake.scenario.signals import (
    NUM_COORDINATES,
    NUM_LEGS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PLANT_PARAMETERS,
    WEIGHTS,
)
from stewart_drake.types import Array

_OF_TORQUES: Final = {"integral": NUM_COORDINATES, "weights": len(WEIGHTS)}
"""Sizes of fields that a law for servos has not: NaN there."""
CAUSES: Final = Counts._fields
"""Names of the bits of a status."""
_FEEDFORWARDS: Final = {
    NoFeedforward: "STEWART_NO_FEEDFORWARD",
    EquilibriumFeedforward: "STEWART_EQUILIBRIUM",
    InverseDynamicsFeedforward: "STEWART_INVERSE_DYNAMICS",
}


class Part(NamedTuple):
    """An observer as the core has it.

    Attributes:
        name: of its table of functions.
        sensing: C structure of the sensor.
        estimation: C structure of its assumptions, or None.
        belief: what it believes, from a memory of the law.
        sources: of the core that it is made of, see `export.controller.SOURCES`.
    """

    name: str
    sensing: Compiled
    estimation: Compiled | None
    belief: Callable[["CoreMemory"], Belief]
    sources: tuple[str, ...]


_STATE: Final[tuple[str, ...]] = ("instant", "kalman", "sensing")
_ENCODERS: Final[tuple[str, ...]] = ("encoders", "kinematics")
_KNOWN: Final[tuple[str, ...]] = ("observers", "observing.h", "filter", "filter_attempt.h", *_STATE)
_WITHIN: Final[tuple[str, ...]] = (*_KNOWN, *_ENCODERS, "encoder_observers.c", "encoder_filter")
_UNKNOWN: Final[tuple[str, ...]] = (
    *("delay_observer", "delay_observing.h", "delay", "delay_search.c", "arrivals"),
    *_STATE,
)
"""Sources: what all observers need; encoders; observers of the state with a known delay,
of encoders with one, which are read within periods, of the state with an unknown one."""


def _sensor(sensing: Sensing) -> Compiled | None:
    if type(sensing) is StateSensing:
        return state_sensor(sensing)
    return encoders_of(sensing) if type(sensing) is EncoderSensing else None


def _plain(law: PredictiveLqi | ServoPreview) -> Part | None:
    sensing = _sensor(law.sensing)
    if sensing is None:
        return None
    kind, sources = "state", _KNOWN
    if isinstance(law.sensing, EncoderSensing):
        kind, sources = "differences", _WITHIN
    return Part(f"stewart_{kind}_observer", sensing, None, _nothing_estimated, sources)


def _filter(law: PredictiveLqi | ServoPreview) -> Part | None:
    sensing, observer = _sensor(law.sensing), observer_of(law)
    if sensing is None or law.plant.dynamics.free != observer.settings.parameters.names:
        return None
    kind, sources = "filter", _KNOWN
    if isinstance(law.sensing, EncoderSensing):
        if isinstance(observer, GapObserver):
            return None
        kind, sources = "encoder", _WITHIN
    elif isinstance(observer, GapObserver):
        kind, sources = "gap", (*_KNOWN, "gap_observer.c")
    return Part(
        f"stewart_{kind}_observer",
        sensing,
        filter_settings_of(law.plant.dynamics, law.sensing, observer.settings),
        _estimated,
        sources,
    )


def _delay(law: PredictiveLqi | ServoPreview) -> Part | None:
    sensing, observer = _sensor(law.sensing), law.observer
    assert isinstance(observer, DelayObserver)
    if sensing is None or law.plant.dynamics.free != observer.settings.parameters.names:
        return None
    c, period = core(), law.timeline.period
    compiled = compiled_delay(observer, law.sensing, law.plant, period)
    it = c.ffi.new("stewart_delay_settings *")
    it.delay = compiled.it[0]
    it.delay.machine = it.delay.sensing = c.ffi.NULL  # the law's
    it.values, it.most = NUM_STATE, max_schedule_length(observer, period)
    name, sources = "stewart_delay_observer", _UNKNOWN
    if isinstance(law.sensing, EncoderSensing):
        name, it.values = "stewart_encoder_delay_observer", NUM_LEGS
        sources = (*_UNKNOWN, *_ENCODERS, "encoder_delay_observer.c")
    return Part(name, sensing, Compiled(it, (compiled,)), _delay_believed, sources)


def max_schedule_length(observer: DelayObserver, period: float) -> int:
    """Return the most torques that act one after the other until the next one does.

    Changes come a period apart, up to 1.5 times the longest delay where that grows the fastest.
    """
    return math.ceil(1.5 * observer.delay.longest / period) + 4


def _delay_believed(memory: "CoreMemory") -> Belief:
    law, flights = memory.law, len(memory.in_flight)
    nothing = law.observer.start(law.timeline, law.sensing, law.plant)
    sizes = len(memory.field("parameters")), nothing.estimate.outlier.size, flights
    size, m = core().lib.stewart_delay_size(*sizes), sizes[1]
    numbers_ = memory.field("observer")
    believed = replace(nothing, numbers=numbers_[:size], flights=flights)
    read = read_delay(replace(believed, measured=numbers_[size : size + m]))
    return read.at(memory.field("state"))


def filter_settings_of(
    dynamics: StewartDynamics, sensing: Sensing, settings: FilterSettings
) -> Compiled:
    """Return the `stewart_filter_settings` of a filter."""
    c = core()
    compiled = compiled_filter(dynamics, sensing, settings)
    it, prior = c.ffi.new("stewart_filter_settings *"), numbers(settings.parameters.prior)
    it.filter = compiled.it[0]
    it.filter.machine = it.filter.sensing = it.filter.legs = c.ffi.NULL  # the law's
    it.prior = c.at(prior)
    return Compiled(it, (compiled, prior))


def _nothing_estimated(memory: "CoreMemory") -> Belief:
    law = memory.law
    known = law.plant.dynamics.parameters
    nothing = Belief.nothing(law.timeline, law.sensing.size, known).at(memory.field("state"))
    return replace(nothing, measured=memory.field("observer")[-law.sensing.size :])


def _estimated(memory: "CoreMemory") -> Belief:
    law, numbers_ = memory.law, memory.field("observer")
    m, n = law.sensing.size, NUM_STATE + len(memory.field("parameters"))
    size = core().lib.stewart_posterior_size(n, m)
    estimate = estimate_of(numbers_[:size], n, m)
    mean = np.concatenate([memory.field("state"), memory.field("parameters")])
    last = numbers_[size : size + m]
    return Belief(replace(estimate, mean=mean), law.timeline, last, partly=estimate.partly)


OBSERVERS: Final[Mapping[type, Callable[[Any], Part | None]]] = {
    NoObserver: _plain,
    DifferencesObserver: _plain,
    ParameterObserver: _filter,
    EncoderObserver: _filter,
    GapObserver: _filter,
    DelayObserver: _delay,
}
"""What the core has of each kind of observer; None for a sensing that it has not."""


def observer_of(law: PredictiveLqi | ServoPreview) -> Any:
    """Return the observer of a law, of measurements of now."""
    observer: Any = law.observer
    return observer.observer if type(observer) is LateObserver else observer


def part_of(law: PredictiveLqi | ServoPreview) -> Part | None:
    """Return what the core has of the observer of a law, or None."""
    make = OBSERVERS.get(type(observer_of(law)))
    return None if make is None else make(law)


def uncovered(law: PredictiveLqi | ServoPreview) -> str | None:
    """Return the field of a scenario whose part the core has not, or None.

    Parts of one's own count as other kinds of that field.
    """
    covered = {
        "law": type(law) in (PredictiveLqi, ServoPreview) and type(law.plant) is NominalPlant,
        "plant.kind": type(law.plant.dynamics) is StewartDynamics,
        "sensor.kind": _sensor(law.sensing) is not None,
        "controller.estimate": part_of(law) is not None,
        "controller.feedforward": type(law.feedforward) in _FEEDFORWARDS,
        "actuator.kind": type(law.plant.motors) is TorqueLimit,
    }
    if isinstance(law, PredictiveLqi):
        covered |= {
            "controller.delay_steps": type(law.timeline) is Timeline,
            "controller.replan": type(law.planner) in (NoPlanner, Rejoin),
            "controller.prediction": type(law.predictor) is _predictor(law),
            "controller.model": type(law.model) is MultibodyModel,
            "controller.integral": type(law.cost) is QuadraticCost,
            "link.kind": type(law.channel) in (Wire, Packets),
        }
    return next((field for field, yes in covered.items() if not yes), None)


def _predictor(law: PredictiveLqi) -> type:
    """Return the kind of prediction that the core has for the observer of a law."""
    return ArrivalPredictor if isinstance(law.observer, DelayObserver) else NonlinearPredictor


class CompiledLaw:
    """The constants of a law as the core has them.

    Args:
        law: one without an `uncovered` part.

    Attributes:
        law: the same.
        data: `stewart_law *`, or of servos `stewart_servo *`.
        fields: (place, rows, columns) of each field of the memory.
        observer: the observer's part.
        tables: name of each table of functions that the law points to, by its address.
        keep: what else it points to, arrays and C structures.
        sources: of the core, beyond those of every law.
    """

    def __init__(self, law: PredictiveLqi | ServoPreview) -> None:
        c, part = core(), part_of(law)
        assert part is not None
        self.law, self.observer = law, part
        self.tables: dict[int, str] = {}
        self.keep = [one for known in (part.sensing, part.estimation) for one in _flat(known)]
        if isinstance(law, PredictiveLqi):
            self.data = c.ffi.new("stewart_law *")
            self.sources: tuple[str, ...] = ("reference", "law.c", *part.sources)
            self._fill(self.data)
            self._of_torques(law)
            c.lib.stewart_prepare(self.data)
        else:
            self.data = c.ffi.new("stewart_servo *")
            self.sources = ("servo", "kinematics", *part.sources)
            self._fill(self.data.law)
            self.data.law.parts, self.data.periods = law.reports.parts, law.reports.periods
            c.lib.stewart_servo_prepare(self.data)
        layout = self.data.layout
        self.fields = {
            name: (field.at, field.rows, field.columns)
            for name, field in ((n, getattr(layout, n)) for n, _ in c.ffi.typeof(layout).fields)
        }

    def _fill(self, data: Any) -> None:
        """Fill in what both kinds of laws have."""
        c, law, part = core(), self.law, self.observer
        fill_machine(law.plant, data.machine)
        timeline = law.timeline
        data.period, data.steps, data.fraction = timeline.period, timeline.steps, timeline.fraction
        data.measured, data.rows = law.sensing.size, len(law.preview_times)
        data.cost.feedforward = getattr(c.lib, _FEEDFORWARDS[type(law.feedforward)])
        data.observer = c.ffi.addressof(c.lib, part.name)
        self.tables[address_of(data.observer)] = part.name
        data.sensing = part.sensing.it
        if part.estimation is not None:
            data.estimation = part.estimation.it

    def _of_torques(self, law: PredictiveLqi) -> None:
        c, d, cost = core(), self.data, law.cost
        d.cost.errors, d.cost.torques = cost.errors.tolist(), cost.torques.tolist()
        d.cost.integrates = int(cost.integrals is not None)
        d.cost.integrals = (np.zeros(6) if cost.integrals is None else cost.integrals).tolist()
        d.kept, d.silence = law.kept, law.silence
        if isinstance(law.observer, DelayObserver):  # which finds steps and fraction itself
            d.kept, d.steps, d.fraction = law.kept + law.observer.kept(d.period), 0, 0.0
            d.rows = 1 + max_schedule_length(law.observer, d.period) + 6
        if isinstance(law.observer, LateObserver):
            d.longest_wait = law.observer.longest
        if isinstance(law.channel, Packets):
            d.channel = c.ffi.addressof(c.lib, "stewart_network")
            d.packets, *arrays = structures(law.channel)
            self.tables[address_of(d.channel)] = "stewart_network"
            self.keep += [d.packets, *arrays]
            self.sources += ("network.c", "packets.c")
        if isinstance(law.planner, Rejoin):
            self._plans(law.planner)

    def _plans(self, planner: Rejoin) -> None:
        c, d, law = core(), self.data, self.law
        plan, until = c.ffi.new("stewart_replan *"), law.timeline.queue_length
        if isinstance(law.observer, DelayObserver):
            until = max_schedule_length(law.observer, d.period)
        plan.periods, plan.until = periods_of(planner.duration, d.period), until
        plan.size, plan.sign = planner.size.tolist(), home_sign(law.plant.mechanism)
        d.planner, d.planning = c.ffi.addressof(c.lib, "stewart_replanner"), plan
        self.tables[address_of(d.planner)] = "stewart_replanner"
        self.keep.append(plan)
        self.sources += ("replan", "planning")

    @property
    def scratch(self) -> int:
        """Numbers of scratch memory that a step takes at the most."""
        lib = core().lib
        torques = isinstance(self.law, PredictiveLqi)
        count = lib.stewart_step_scratch if torques else lib.stewart_servo_scratch
        return int(count(self.data))

    def start(self, first: Array) -> Array:
        """Return the memory before the first sample.

        Args:
            first: (n, 6) torques in flight, or for servos (18,) the command that was sent last.
        """
        c, memory = core(), np.empty(self.data.memory)
        first = np.ascontiguousarray(first, np.float64)
        if isinstance(self.law, PredictiveLqi):
            c.lib.stewart_start(self.data, c.at(memory), len(first), c.at(first))
        else:
            c.lib.stewart_servo_start(self.data, c.at(memory), c.at(first))
        return memory


def address_of(pointer: Any) -> int:
    """Return the place of a C structure."""
    return int(core().ffi.cast("intptr_t", pointer))


def _flat(kept: Any) -> list[Any]:
    """Return arrays and C structures, and those that they point to."""
    if isinstance(kept, Compiled):
        return [kept.it, *_flat(kept.keeps)]
    if isinstance(kept, Mapping):
        return _flat(tuple(kept.values()))
    if isinstance(kept, tuple):
        return [one for part in kept for one in _flat(part)]
    return [kept] if isinstance(kept, np.ndarray | core().ffi.CData) else []


def fill_machine(plant: NominalPlant, machine: Any) -> None:
    """Fill in a `stewart_machine`."""
    dynamics = plant.dynamics
    machine.geometry = geometry_of(plant.mechanism).tolist()
    machine.parameters = dynamics.plant_parameters.tolist()
    machine.gravity, machine.substeps = dynamics.gravity, plant.substeps
    machine.torque_limit, machine.gentle_torque = plant.motors.limit, plant.gentle_torque
    machine.estimated = len(dynamics.free)
    for i, name in enumerate(dynamics.free):
        machine.place[i] = PLANT_PARAMETERS.index(name) if name in PLANT_PARAMETERS else -1


@dataclass(frozen=True)
class CoreMemory:
    """A memory of the law in C, which reads as a `law.memory.Memory`.

    Attributes:
        data: (n,) all of it.
        compiled: the law.
    """

    data: Array
    compiled: CompiledLaw

    @property
    def law(self) -> Any:
        """The law."""
        return self.compiled.law

    def field(self, name: str) -> Array:
        """Return a field: (columns,) of one row, else (rows, columns)."""
        at, rows, columns = self.compiled.fields[name]
        values = self.data[at : at + rows * columns]
        return values if rows == 1 else values.reshape(rows, columns)

    @property
    def in_flight(self) -> Array:
        """(n, 6) torques as limited, the oldest first."""
        return self.field("in_flight").reshape(-1, NUM_TORQUES)

    def __getattr__(self, name: str) -> Array:
        if name in _OF_TORQUES and name not in self.compiled.fields:
            return np.full(_OF_TORQUES[name], np.nan)
        if name.startswith("_") or name not in self.compiled.fields:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self.field(name)

    @property
    def plan(self) -> Array:
        """(N, 6) torques that were sent last."""
        channel = self.law.channel
        if isinstance(channel, Packets):
            return self.sent.packets[-1, channel.repeats :]
        return self.in_flight[-1:]

    @property
    def sent(self) -> Sent:
        """Memory of the channel."""
        channel = self.law.channel
        if isinstance(channel, Packets):
            return Sent(self.field("channel"), len(channel.in_time))
        return channel.start()

    @property
    def path(self) -> None:
        """There is none."""

    @property
    def silence(self) -> int:
        """Samples that are still to go on without feedback."""
        return int(self.field("silence")[0])

    @cached_property
    def counts(self) -> Counts:
        """By cause."""
        return Counts(*(int(count) for count in self.field("counts")))

    @cached_property
    def belief(self) -> Belief:
        """State of now, parameters, covariance at the last measurement."""
        return self.compiled.observer.belief(self)

    def without_error(self) -> "CoreMemory":
        """Return the same with nothing integrated."""
        after = CoreMemory(self.data.copy(), self.compiled)
        after.field("error")[:] = after.field("integral")[:] = 0.0
        return after


class CoreLqi:
    """`PredictiveLqi.initial_memory` and `step` of a law that is not `uncovered`.

    Args:
        law: the same in Python.
    """

    def __init__(self, law: PredictiveLqi) -> None:
        self._law, self._compiled = law, CompiledLaw(law)
        self._scratch = self._compiled.scratch
        self._late = isinstance(law.observer, LateObserver)

    def initial_memory(self, queue: Array) -> CoreMemory:
        """Return the memory before the first sample; the queue (L, 6) is that of the delay."""
        length = self._law.timeline.queue_length
        if isinstance(self._law.observer, DelayObserver):
            length = self._law.observer.kept(self._law.timeline.period)
        if queue.shape != (length, NUM_TORQUES):
            raise ValueError(f"queue: got shape {queue.shape}; expected {(length, NUM_TORQUES)}")
        return CoreMemory(self._compiled.start(queue), self._compiled)

    def step(
        self,
        memory: CoreMemory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> CoreMemory:
        """Take one sample, as `PredictiveLqi.step` does."""
        law, c = self._law, core()
        if not self._late:
            measurement.require_fresh()
        values, weights = measurement.known(law.sensing.size), _row_major(weights)
        if weights.shape != (len(WEIGHTS),):
            raise ValueError(f"weights: got shape {weights.shape}; expected {(len(WEIGHTS),)}")
        told = None if report is None else report_of(report)
        sample = c.ffi.new("stewart_sample *")
        sample.measurement, sample.age = c.at(values), _age(law, measurement)
        asked = self._asked(sample, motion)
        sample.report = c.ffi.NULL if told is None else told.data
        sample.weights = weights.tolist()
        data, scratch, torque = memory.data.copy(), np.empty(self._scratch), np.empty(NUM_TORQUES)
        c.lib.stewart_step(self._compiled.data, c.at(data), c.at(scratch), sample, c.at(torque))
        asked.require_calm()
        return CoreMemory(data, self._compiled)

    def _asked(self, sample: Any, motion: Motion) -> Compiled:
        """Let a sample ask for the reference; return what it points to.

        Where the delay is known the instants are, too, and all rows are given beforehand.
        """
        law, c = self._law, core()
        if not isinstance(law.observer, DelayObserver) and isinstance(law.planner, NoPlanner):
            rows = _row_major(motion(law.preview_times))
            _check_rows(law, rows)
            sample.reference, sample.about = c.lib.stewart_given_rows, c.at(rows)
            return Compiled(sample, (rows,))
        raised: list[BaseException] = []
        kept = [_callback(motion, raised)]
        sample.reference, sample.about = kept[0], c.ffi.NULL
        if isinstance(motion, KnownMotion):
            kept.append(_callback(motion.goal, raised))
            sample.goal = kept[1]
        return Compiled(sample, tuple(kept), (raised,))


class CoreServo:
    """`ServoPreview.initial_memory` and `step` of a law that is not `uncovered`.

    Args:
        law: the same in Python.
    """

    def __init__(self, law: ServoPreview) -> None:
        self._law, self._compiled = law, CompiledLaw(law)
        self._scratch = self._compiled.scratch

    def initial_memory(self, command: Array) -> CoreMemory:
        """Return the memory before the first sample, with the command (18,) that was sent last."""
        return CoreMemory(self._compiled.start(command), self._compiled)

    def step(
        self, memory: CoreMemory, measurement: Measurement, motion: Motion, report: Array
    ) -> CoreMemory:
        """Take one sample, as `ServoPreview.step` does."""
        law, c = self._law, core()
        values, rows = measurement.known(law.sensing.size), _row_major(motion(law.preview_times))
        _check_rows(law, rows)
        sample, report = c.ffi.new("stewart_sample *"), _row_major(report)
        sample.measurement, sample.age = c.at(values), _age(law, measurement)
        sample.reference, sample.about = c.lib.stewart_given_rows, c.at(rows)
        data, scratch = memory.data.copy(), np.empty(self._scratch)
        command, servo = np.empty(NUM_REFERENCE), self._compiled.data
        given = c.at(data), c.at(scratch), sample, c.at(report), c.at(command)
        c.lib.stewart_servo_step(servo, *given)
        return CoreMemory(data, self._compiled)


def _row_major(values: Array) -> Array:
    return np.ascontiguousarray(values, np.float64)


def _age(law: PredictiveLqi | ServoPreview, measurement: Measurement) -> int:
    return round(measurement.age / law.timeline.period)


def _callback(motion: Motion, raised: list[BaseException]) -> Any:
    """Return a `stewart_preview_function` that asks a motion; errors are kept in `raised`."""
    ffi = core().ffi

    def failed(kind: type, error: BaseException, trace: Any) -> None:
        raised.append(error)

    @ffi.callback("void(void *, int, const double *, double *)", onerror=failed)  # type: ignore[untyped-decorator]
    def look(_: Any, number: int, times: Any, rows: Any) -> None:
        asked = np.frombuffer(ffi.buffer(times, 8 * number))
        found = np.frombuffer(ffi.buffer(rows, 8 * number * NUM_REFERENCE))
        found[:] = np.ravel(motion(asked))

    return look


def _check_rows(law: PredictiveLqi | ServoPreview, rows: Array) -> None:
    """Check a preview.

    Raises:
        ValueError: its shape does not fit.
    """
    shape = (len(law.preview_times), NUM_REFERENCE)
    if rows.shape != shape:
        raise ValueError(f"preview: got shape {rows.shape}; expected {shape}")


AnyMemory = Memory | CoreMemory


class Serving(NamedTuple):
    """A law with the code that steps it."""

    law: Any
    """The law, or the same in C."""
    backend: str
    """`native`, or `python` and why."""


def serving(law: PredictiveLqi | ServoPreview) -> Serving:
    """Return the law in C where the core has all its parts, else the law in Python."""
    field = uncovered(law)
    if field is not None:
        return Serving(law, f"python ({field})")
    return Serving(CoreLqi(law) if isinstance(law, PredictiveLqi) else CoreServo(law), "native")
