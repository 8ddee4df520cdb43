"""The law in C, core/law.c, in the place of `PredictiveLqi.step`; see there for what it computes.

It has the parts of the default law. Any other law, or one without a compiled library, is stepped in
Python; `serving` is the only place that decides.
"""

import ctypes
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.law_layout import (
    CAUSES,
    CONFIG,
    MAX_KEPT,
    MAX_QUEUE,
    MEMORY,
    address,
    check_sizes,
)
from stewart_drake.core.layout import geometry_of
from stewart_drake.core.library import core_library
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Belief, Estimate
from stewart_drake.law.channel import Report, Sent, Wire
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.delay_observer import DelayObserver
from stewart_drake.law.design_models import MultibodyModel
from stewart_drake.law.feedforward import InverseDynamicsFeedforward
from stewart_drake.law.late import LateObserver
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts, Memory
from stewart_drake.law.motion import Motion
from stewart_drake.law.motors import TorqueLimit
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import NoObserver, ParameterObserver
from stewart_drake.law.parameter_filter import gate
from stewart_drake.law.planner import NoPlanner
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import NonlinearPredictor
from stewart_drake.law.sensing import StateSensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import (
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PARAMETERS,
    WEIGHTS,
)
from stewart_drake.types import Array

_OBSERVERS: Final = (NoObserver, ParameterObserver)


def uncovered(law: PredictiveLqi) -> str | None:
    """The field of a scenario by which the law in C is not this one, or None.

    Parts of one's own count as other kinds of that field.
    """
    observer: Any = law.observer
    if type(observer) is LateObserver:
        observer = observer.observer
    timeline, dynamics, estimated, known = law.timeline, law.plant.dynamics, PARAMETERS, False
    if isinstance(observer, ParameterObserver):
        prior = observer.settings.parameters
        estimated, known = prior.names, prior.correlation is not None or prior.usual is not None
    covered = {
        "law": type(law) is PredictiveLqi and type(law.plant) is NominalPlant,
        "plant.kind": type(dynamics) is StewartDynamics,
        "controller.delay_estimator": not isinstance(observer, DelayObserver),
        "controller.estimate": type(observer) in _OBSERVERS and type(timeline) is Timeline,
        "controller.prior": estimated == PARAMETERS and dynamics.free == PARAMETERS,
        "controller.calibration": not known,
        "controller.replan": type(law.planner) is NoPlanner,
        "controller.prediction": type(law.predictor) is NonlinearPredictor,
        "controller.feedforward": type(law.feedforward) is InverseDynamicsFeedforward,
        "controller.model": type(law.model) is MultibodyModel,
        "controller.integral": type(law.cost) is QuadraticCost and law.cost.integrates,
        "controller.delay_steps": timeline.queue_length <= MAX_QUEUE,
        "sensor.kind": type(law.sensing) is StateSensing,
        "sensor.delay": law.kept <= MAX_KEPT,
        "link.kind": type(law.channel) is Wire,
        "actuator.kind": type(law.plant.motors) is TorqueLimit,
    }
    return next((field for field, yes in covered.items() if not yes), None)


def configuration(law: PredictiveLqi) -> NDArray[np.void]:
    """What the law in C knows, of the type CONFIG, from one that is covered."""
    plant, timeline, cost = law.plant, law.timeline, law.cost
    late = law.observer if isinstance(law.observer, LateObserver) else None
    observer = law.observer if late is None else late.observer
    values: dict[str, Any] = {
        "geometry": geometry_of(plant.mechanism),
        "parameters": plant.dynamics.plant_parameters,
        "gravity": plant.dynamics.gravity,
        "period": timeline.period,
        "fraction": timeline.fraction,
        "torque_limit": plant.motors.limit,
        "gentle_torque": plant.gentle_torque,
        "noise_std": law.sensing.noise_std,
        "error_weights": cost.errors,
        "integral_weights": cost.integrals,
        "torque_weights": cost.torques,
        "gate": gate(law.sensing.size),
        "steps": timeline.steps,
        "kept": law.kept,
        "longest_wait": 0 if late is None else late.longest,
        "substeps": plant.substeps,
        "silence": law.silence,
    }
    if isinstance(law.sensing, StateSensing):
        values["motion"] = law.sensing.motion
    if isinstance(observer, ParameterObserver):
        known, s = observer.settings.parameters, observer.settings
        values |= {"estimates": 1, "prior": known.prior, "std": known.std, "lower": known.lower}
        values |= {"upper": known.upper, "model_std": s.model_std, "timing_std": s.timing_std}
    config = np.zeros((), CONFIG)
    for name, value in values.items():
        config[name] = value
    return config


_PARTS: Final = ("measurement", "error", "integral", "torque", "feedforward", "weights")


@dataclass(frozen=True)
class NativeMemory:
    """A memory of the law in C, which reads as a `law.memory.Memory`.

    Attributes:
        data: of the type MEMORY.
        timeline: the delay that is believed in.
        length: how many torques are kept in flight.
    """

    data: NDArray[np.void]
    timeline: Timeline
    length: int

    @property
    def in_flight(self) -> Array:
        """(length, 6)."""
        return self._part("in_flight")[: self.length]

    def __getattr__(self, name: str) -> Array:
        """What is called, and is, as in `Memory`."""
        if name not in _PARTS:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return self._part(name)

    @property
    def gain(self) -> Array:
        """(6, g)."""
        order = NUM_REFERENCE + (NUM_TORQUES if self.timeline.fraction > 0 else 0)
        return self._part("gain")[: NUM_TORQUES * order].reshape(NUM_TORQUES, order)

    @property
    def plan(self) -> Array:
        """(1, 6)."""
        return self.in_flight[-1:]

    @property
    def sent(self) -> Sent:
        """Nothing."""
        return Wire().start()

    @property
    def path(self) -> None:
        """There is none."""

    @property
    def silence(self) -> int:
        """Samples."""
        return int(self.data["silence"])

    @cached_property
    def counts(self) -> Counts:
        """By cause."""
        return Counts(**dict(zip(CAUSES, self.data["counts"].tolist(), strict=True)))

    @cached_property
    def belief(self) -> Belief:
        """State of now, parameters, covariance at the last measurement."""
        estimate = Estimate(
            mean=np.concatenate([self._part("state"), self._part("mean")[NUM_STATE:]]),
            covariance=self._part("covariance"),
            outlier=self._part("outlier"),
            outliers=int(self.data["outliers"]),
            unseen=int(self.data["unseen"]),
        )
        return Belief(estimate, self.timeline, self._part("measured"))

    def without_error(self) -> "NativeMemory":
        """The same with nothing integrated."""
        data = self.data.copy()
        data["error"], data["integral"] = 0.0, 0.0
        return NativeMemory(data, self.timeline, self.length)

    def _part(self, name: str) -> Array:
        part: Array = self.data[name]
        return part


class NativeLqi:
    """`PredictiveLqi.initial_memory` and `step` of a law that is not `uncovered`.

    Args:
        law: the same in Python.
        library: the compiled one.
    """

    def __init__(self, law: PredictiveLqi, library: ctypes.CDLL) -> None:
        check_sizes(library)
        self._config, self._law = configuration(law), law
        self._start, self._step = library.law_init, library.law_step
        self._start.restype, self._step.restype = None, ctypes.c_int
        self._length = 1 + law.kept + law.timeline.queue_length
        self._late = isinstance(law.observer, LateObserver)

    def initial_memory(self, queue: Array) -> NativeMemory:
        """See `PredictiveLqi.initial_memory`; the queue (L, 6) is that of the delay."""
        length = self._law.timeline.queue_length
        if queue.shape != (length, NUM_TORQUES):
            raise ValueError(f"queue: got shape {queue.shape}; expected {(length, NUM_TORQUES)}")
        data, queue = np.zeros((), MEMORY), np.ascontiguousarray(queue, dtype=np.float64)
        self._start(_at(self._config), _at(data), _at(queue))
        return NativeMemory(data, self._law.timeline, self._length)

    def step(
        self,
        memory: NativeMemory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> NativeMemory:
        """See `PredictiveLqi.step`."""
        law, age = self._law, 0
        if self._late:
            age = round(measurement.age / law.timeline.period)
        else:
            measurement.require_fresh()
        times = law.preview_times
        values = measurement.values
        if not measurement.complete:
            values = measurement.after(np.full(NUM_STATE, np.nan))
        given = [np.ascontiguousarray(a, np.float64) for a in (values, motion(times), weights)]
        expected = ((NUM_STATE,), (len(times), NUM_REFERENCE), (len(WEIGHTS),))
        for name, array, shape in zip(_INPUTS, given, expected, strict=True):
            if array.shape != shape:
                raise ValueError(f"{name}: got shape {array.shape}; expected {shape}")
        values, preview, weights = given
        data, torque = memory.data.copy(), np.empty(NUM_TORQUES)
        self._step(
            _at(self._config),
            _at(data),
            _at(values),
            age,
            _at(preview),
            _at(weights),
            _at(torque),
        )
        return NativeMemory(data, memory.timeline, memory.length)


_INPUTS: Final = ("measurement", "preview", "weights")


def _at(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(address(array))


class Serving(NamedTuple):
    """What steps a law, and how that is said in a summary."""

    law: PredictiveLqi | NativeLqi
    backend: str
    """`native`, or `python` and why."""


AnyMemory = Memory | NativeMemory


def serving(law: PredictiveLqi) -> Serving:
    """The law in C where there is one and it is this one, else the law in Python."""
    field = uncovered(law)
    if field is not None:
        return Serving(law, f"python ({field})")
    return Serving(NativeLqi(law, core_library()), "native")
