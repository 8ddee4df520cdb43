"""The step of a law in C, core/law.c, where the core has every part of it.

`serving` decides; otherwise Python composes the same kernels in `PredictiveLqi.step`. Memory is one
flat vector, and `CoreMemory` gives its fields the names of `law.memory.Memory`.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import home_sign
from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Packets, Report, Sent, Wire, packets_of, report_of
from stewart_drake.law.compiled import Compiled, address_of, machine_of, resists
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.memory import Counts, Memory
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.nominal import MultibodyModel, NominalPlant, TorqueLimit
from stewart_drake.law.observers import CoreObserver, belief_of, part_of
from stewart_drake.law.planner import NoPlanner, Replan
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import ArrivalPredictor, NonlinearPredictor
from stewart_drake.law.sensing import EncoderSensing, Measurement, StateSensing
from stewart_drake.law.servo_preview import ServoPreview
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import (
    NUM_COORDINATES,
    NUM_REFERENCE,
    NUM_TORQUES,
    WEIGHTS,
)
from stewart_drake.types import Array

_OF_TORQUES: Final = {"integral": NUM_COORDINATES, "weights": len(WEIGHTS)}
"""Sizes of fields that are NaN in a law for servos."""
_FEEDFORWARDS: Final = {
    NoFeedforward: "STEWART_NO_FEEDFORWARD",
    EquilibriumFeedforward: "STEWART_EQUILIBRIUM",
    InverseDynamicsFeedforward: "STEWART_INVERSE_DYNAMICS",
}


def uncovered(law: PredictiveLqi | ServoPreview) -> str | None:
    """Return the scenario field of the first part that the core does not have, or None.

    A user's part counts as another kind of that field.
    """
    covered = {
        "controller.limits": not hasattr(law, "limits"),
        "controller.learned": getattr(law, "learned", None) is None,
        "law": type(law) in (PredictiveLqi, ServoPreview) and type(law.plant) is NominalPlant,
        "plant.kind": type(law.plant.dynamics) is StewartDynamics,
        "sensor.kind": type(law.sensing) in (StateSensing, EncoderSensing),
        "controller.estimate": type(law.observer) is CoreObserver,
        "controller.feedforward": type(law.feedforward) in _FEEDFORWARDS,
        "actuator.kind": type(law.plant.motors) is TorqueLimit,
    }
    if isinstance(law, PredictiveLqi):
        predictor = ArrivalPredictor if law.finds_delay else NonlinearPredictor
        covered |= {
            "controller.delay_steps": type(law.timeline) is Timeline,
            "controller.replan": type(law.planner) in (NoPlanner, Replan),
            "controller.prediction": type(law.predictor) is predictor,
            "controller.model": type(law.model) is MultibodyModel,
            "controller.kind": type(law.cost) is QuadraticCost,
            "link.kind": type(law.channel) in (Wire, Packets),
        }
    return next((field for field, yes in covered.items() if not yes), None)


class CompiledLaw:
    """The constants of a law in the core.

    Args:
        law: without an `uncovered` part.

    Attributes:
        law: the law.
        data: `stewart_law *`, or of servos `stewart_servo *`.
        fields: (place, rows, columns) of each field of the memory.
        tables: name of each table of functions that the law points to, by its address.
        keep: arrays and C structures that it points to.
        sources: of the core, beyond those of every law.
    """

    def __init__(self, law: PredictiveLqi | ServoPreview) -> None:
        c, observer = core(), law.observer
        assert isinstance(observer, CoreObserver)
        part = part_of(observer, law.sensing, law.plant, law.timeline.period)
        self.law, self._part = law, part
        self.tables: dict[int, str] = {}
        self.keep = [one for it in (part.sensor, part.estimation) if it for one in it.pointed()]
        if isinstance(law, PredictiveLqi):
            self.data = c.ffi.new("stewart_law *")
            self.sources: tuple[str, ...] = ("reference", "law.c", *part.sources)
            self._fill(self.data)
            self._of_torques(law)
            c.lib.stewart_prepare(self.data)
        else:
            self.data = c.ffi.new("stewart_servo *")
            self.sources = ("servo", "kinematics.c", *part.sources)
            self._fill(self.data.law)
            self.data.law.parts, self.data.periods = law.reports.parts, law.reports.periods
            if (servo := law.servo) is not None:
                limits = servo.low.tolist(), servo.high.tolist(), servo.most
                self.data.stiff = (servo.stiffness, servo.velocity_gain, *limits)
            c.lib.stewart_servo_prepare(self.data)
        layout = self.data.layout
        self.fields = {
            name: (field.at, field.rows, field.columns)
            for name, field in ((n, getattr(layout, n)) for n, _ in c.ffi.typeof(layout).fields)
        }

    def _fill(self, data: Any) -> None:
        c, law, part, timeline = core(), self.law, self._part, self.law.timeline
        machine = machine_of(law.plant)
        if resists(law.plant.dynamics):
            self.tables[address_of(machine.it.joints)] = "stewart_ball_joints"
            self.sources += ("ball_joints",)
        data.machine = machine.it[0]
        self.keep += machine.pointed()
        data.period, data.steps, data.fraction = timeline.period, timeline.steps, timeline.fraction
        data.measured, data.rows = law.sensing.size, len(law.preview_times)
        data.cost.feedforward = getattr(c.lib, _FEEDFORWARDS[type(law.feedforward)])
        part.fill(data)
        self.tables[address_of(data.observer)] = part.table

    def _of_torques(self, law: PredictiveLqi) -> None:
        c, d, cost = core(), self.data, law.cost
        assert isinstance(cost, QuadraticCost)
        d.cost.errors, d.cost.torques = cost.errors.tolist(), cost.torques.tolist()
        d.cost.integrates = int(cost.integrals is not None)
        d.cost.integrals = (np.zeros(6) if cost.integrals is None else cost.integrals).tolist()
        d.kept, d.silence = law.kept, law.silence
        d.tolerated_timing = 0.0 if math.isinf(law.tolerated_timing) else law.tolerated_timing
        d.longest_wait, observer = law.longest_wait, law.observer
        assert isinstance(observer, CoreObserver)
        if law.finds_delay:  # it finds steps and fraction itself
            d.kept, d.steps, d.fraction = law.kept + observer.kept(d.period), 0, 0.0
            d.rows = 1 + observer.max_schedule_length(d.period) + 6
        if isinstance(law.channel, Packets):
            d.channel = c.ffi.addressof(c.lib, "stewart_network")
            packets = packets_of(law.channel)
            d.packets = packets.it
            self.tables[address_of(d.channel)] = "stewart_network"
            self.keep += packets.pointed()
            self.sources += ("network.c", "packets.c")
        if isinstance(law.planner, Replan):
            self._plans(law.planner)

    def _plans(self, planner: Replan) -> None:
        c, d, law = core(), self.data, self.law
        plan, until = c.ffi.new("stewart_replan *"), law.timeline.queue_length
        if isinstance(law.observer, CoreObserver) and law.observer.delay is not None:
            until = law.observer.max_schedule_length(d.period)
        plan.periods, plan.most = planner.lengths(d.period)
        plan.until = until
        plan.size, plan.sign = planner.size.tolist(), home_sign(law.plant.mechanism)
        plan.sure = planner.sure
        d.planner, d.planning = c.ffi.addressof(c.lib, "stewart_replanner"), plan
        self.tables[address_of(d.planner)] = "stewart_replanner"
        self.keep.append(plan)
        self.sources += ("replan", "planning")

    @cached_property
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


@dataclass(frozen=True)
class CoreMemory:
    """Memory of a law in C, with the names of `law.memory.Memory`."""

    data: Array  # (n,) all fields
    compiled: CompiledLaw  # the law

    @property
    def law(self) -> Any:
        return self.compiled.law

    def field(self, name: str) -> Array:
        """Return a field: (columns,) of one row, else (rows, columns)."""
        at, rows, columns = self.compiled.fields[name]
        values = self.data[at : at + rows * columns]
        return values if rows == 1 else values.reshape(rows, columns)

    @property
    def in_flight(self) -> Array:
        """Torques (n, 6) within the limit, oldest first."""
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
    def silence(self) -> int:
        """Samples that remain without feedback."""
        return int(self.field("silence")[0])

    @cached_property
    def counts(self) -> Counts:
        return Counts(*(int(count) for count in self.field("counts")))

    @cached_property
    def belief(self) -> Belief:
        """State now, with the covariance at the last measurement."""
        law, data = self.law, self.compiled.data
        given = data if isinstance(law, PredictiveLqi) else core().ffi.addressof(data, "law")
        belief = belief_of(law.observer, given, self.field("observer"), law.timeline)
        return belief.at(self.field("state"))

    def without_error(self) -> "CoreMemory":
        after = CoreMemory(self.data.copy(), self.compiled)
        after.field("error")[:] = after.field("integral")[:] = 0.0
        return after


class CoreLqi:
    """`PredictiveLqi.initial_memory` and `step` in C, of a law that is not `uncovered`."""

    def __init__(self, law: PredictiveLqi) -> None:
        self._law, self._compiled = law, CompiledLaw(law)

    def initial_memory(self, queue: Array) -> CoreMemory:
        """Return the memory before the first sample; the queue (L, 6) is that of the delay."""
        length = self._law.queue_length
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
        law.require_age(measurement)
        values, weights = measurement.known(law.sensing.size), _row_major(weights)
        if weights.shape != (len(WEIGHTS),):
            raise ValueError(f"weights: got shape {weights.shape}; expected {(len(WEIGHTS),)}")
        compiled = report_of(report)
        sample = c.ffi.new("stewart_sample *")
        sample.measurement, sample.age = c.at(values), _age(law, measurement)
        asked = self._asked(sample, motion)
        sample.report = compiled.it
        sample.weights = weights.tolist()
        data, scratch, torque = (
            memory.data.copy(),
            np.empty(self._compiled.scratch),
            np.empty(NUM_TORQUES),
        )
        c.lib.stewart_step(self._compiled.data, c.at(data), c.at(scratch), sample, c.at(torque))
        asked.raise_errors()
        return CoreMemory(data, self._compiled)

    def _asked(self, sample: Any, motion: Motion) -> Compiled:
        """Set the reference of a sample; return the objects that it points to.

        With a known delay the instants are known, too, and all rows are given beforehand.
        """
        law, c = self._law, core()
        if not law.moves:
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
    """`ServoPreview.initial_memory` and `step` in C, of a law that is not `uncovered`."""

    def __init__(self, law: ServoPreview) -> None:
        self._law, self._compiled = law, CompiledLaw(law)

    def initial_memory(self, command: Array) -> CoreMemory:
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
        data, scratch = memory.data.copy(), np.empty(self._compiled.scratch)
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

    law: Any  # the law, or the same in C
    backend: str  # `native`, or `python` and why


def serving(law: PredictiveLqi | ServoPreview) -> Serving:
    """Return the law in C where the core has all its parts, else the law in Python."""
    field = uncovered(law)
    if field is not None:
        return Serving(law, f"python ({field})")
    return Serving(CoreLqi(law) if isinstance(law, PredictiveLqi) else CoreServo(law), "native")


@dataclass(frozen=True)
class OuterLqi(PredictiveLqi):
    """`PredictiveLqi` around the free law of the same parts."""

    @cached_property
    def free(self) -> PredictiveLqi:
        """The law without what this one adds."""
        return PredictiveLqi(**self.parts)

    @cached_property
    def _served(self) -> Any:
        return serving(self.free).law


@dataclass(frozen=True)
class OuterMemory:
    """Memory of an `OuterLqi`; other names are those of the free law's memory."""

    free: Any  # memory of the free law

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "free":
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.free, name)
