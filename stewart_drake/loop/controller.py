"""The controllers and their reference as Drake systems."""

from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.arguments import fixed, of_kind
from stewart_drake.law.channel import Packets, Report
from stewart_drake.law.counts import Counts
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import KnownMotion, Motion, Preview
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import ServoPreview
from stewart_drake.loop.sampling import Sample, SteppedLaw, declare_constant, weak
from stewart_drake.mechanism.trajectories import evaluate, rows_along
from stewart_drake.scenario.signals import (
    NUM_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PARAMETERS,
    WEIGHTS,
    WRENCHES,
    ports_of,
)
from stewart_drake.types import Array, ArrayLike


class Reference(LeafSystem):
    """The reference at present, and ahead for a controller with preview.

    Output:  reference(t) = [pose; rates; accelerations] of `true_motion`,
             preview(t)   = the same of `planned_motion` at t + each of `preview_times`.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | reference | output | 18 | rad, m and their time derivatives | continuous |
    | preview | output | 18 len(preview_times) | the same | continuous |

    Args:
        true_motion: trajectory (6, 1) for the tracking error.
        planned_motion: trajectory that the controller follows, a smooth way onto the true motion.
        preview_times: (p,) in s from now.
    """

    def __init__(
        self, true_motion: Trajectory, planned_motion: Trajectory, preview_times: Array
    ) -> None:
        super().__init__()
        of_kind("true_motion", true_motion, Trajectory)
        of_kind("planned_motion", planned_motion, Trajectory)
        self._true, self._planned = true_motion, planned_motion
        self._times = fixed("preview_times", preview_times, (np.size(preview_times),))
        time_only = {self.time_ticket()}
        self.DeclareVectorOutputPort("reference", NUM_REFERENCE, weak(self._now), time_only)
        size = NUM_REFERENCE * len(self._times)
        self.DeclareVectorOutputPort("preview", size, weak(self._ahead), time_only)

    def _now(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(evaluate(self._true, context.get_time()))

    def _ahead(self, context: Context, output: BasicVector) -> None:
        times = np.maximum(0.0, context.get_time() + self._times)
        output.SetFromVector(rows_along(self._planned, times).ravel())


HELD_BY_ANY: Final[dict[str, Callable[[Any], Array]]] = {
    "torque_commanded": lambda memory: memory.torque,
    "measurement": lambda memory: memory.measurement,
}
"""Signals of any controller, see `held_by`."""


def held_by(dynamics: StewartDynamics) -> dict[str, Callable[[Memory], Array]]:
    """Return the controller's rows of `scenario.signals.SIGNALS`, as functions of its memory.

    A parameter that is not estimated is recorded with its assumed value, without a deviation; a
    wrench that is not estimated is NaN.
    """
    known = dynamics.plant_parameters[:NUM_PARAMETERS]
    places = {name: place for place, name in enumerate(dynamics.free)}

    def mean(memory: Memory) -> Array:
        return memory.belief.parameters

    def std(memory: Memory) -> Array:
        return memory.belief.estimate.parameter_std

    def recorded(
        part: Callable[[Memory], Array], names: Sequence[str], otherwise: ArrayLike = np.nan
    ) -> Callable[[Memory], Array]:
        place = np.array([places.get(name, -1) for name in names])
        return lambda memory: np.where(place < 0, otherwise, part(memory)[place])

    return HELD_BY_ANY | {
        "integral": lambda memory: memory.integral,
        "weights": lambda memory: memory.weights,
        "state_estimate": lambda memory: memory.belief.state,
        "parameters": recorded(mean, PARAMETERS, known),
        "parameter_std": recorded(std, PARAMETERS),
        "wrench_estimate": recorded(mean, WRENCHES),
        "wrench_std": recorded(std, WRENCHES),
        "delay_estimate": lambda memory: memory.belief.delay,
        "delay_std": lambda memory: np.array([memory.belief.delay_std]),
    }


class _RecordedLaw(SteppedLaw):
    """A law of the core, whose memory is recorded."""

    _age: InputPort | None

    def _record(self, law: PredictiveLqi | ServoPreview, first: Memory) -> None:
        """Begin with a memory, and declare the estimate and what is recorded of the memory."""
        self._begin(first, law.timeline.period)
        self._put_out("estimate", NUM_STATE, lambda m: m.belief.state, now=True)
        held = held_by(law.plant.dynamics)
        for port, signal in ports_of("controller").items():
            part = held[signal.name]
            self._put_out(port, len(part(first)), part)

    def _age_of(self, context: Context) -> float:
        """Return the age of the measurement in s; 0 where the port is missing or unconnected."""
        if self._age is None or not self._age.HasValue(context):
            return 0.0
        return float(np.asarray(self._age.Eval(context))[0])


class DelayLqiController(_RecordedLaw):
    """Predictive LQI with any parts of the law, in C if the core has all of them.

    With m the memory (`law.memory.Memory`) and `step` the law (`law.predictive_lqi.PredictiveLqi`):

    Initialise: m holds the torques in flight at t = 0 and nothing else.
    Update:     every period m <- step(m, measurement, preview, weights); the duration of the step
                is recorded.
    Output:     torque        = step(m, measurement, preview, weights).torque, to be read at the
                samples; the update uses the same step.
                the others    = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12, or 6 N | rad, m, rad/s, m/s | read every period; NaN is lost |
    | preview | input | 18 p | rad, m and time derivatives | read every period |
    | weights | input | 2 | w_Q, w_R | read every period |
    | age | input | 1 | s, whole periods | of the measurement; only if it may be late |
    | report | input | 7 h | as of `PlayoutBuffer`, NaN is lost | only with a channel of packets |
    | plan | output | 6 (r + n) | N m, the packet to be sent | the same; direct feedthrough |
    | torque | output | 6 | N m | direct feedthrough |
    | estimate | output | 12 | rad, m, rad/s, m/s | direct feedthrough; the state for T_k |
    | memory | output | abstract, `Sample` | - | direct feedthrough; after this sample |
    | torque_commanded | output | 6 | N m | held |
    | integral | output | 6 | rad s, m s | held |
    | weights_used | output | 2 | - | held, NaN before the first sample |
    | measurement_used | output | as measurement | the same | held, NaN before the first sample |
    | state_estimate | output | 12 | rad, m, rad/s, m/s | held, NaN before the first sample |
    | parameters | output | 8 | N m, kg, N m s/rad | held; as assumed by the law |
    | parameter_std | output | 8 | the same | held; NaN without estimator |
    | wrench_estimate | output | 6 | N m, N | held; NaN where none is estimated |
    | wrench_std | output | 6 | the same | held; NaN where none is estimated |
    | delay_estimate | output | 1 | s | held; as assumed by the law |
    | delay_std | output | 1 | s | held; NaN without delay estimator |

    Sizes: N samples of the encoders per period; p `preview_times` of the law; a report of h
    periods; packets of n planned torques and r of earlier samples (`law.channel.Packets`).

    Args:
        queue: (L, 6) assumed torques in flight at t = 0 in N m, oldest first.
        motion: the planned motion and the reference, for a law that reads them at any instant;
            otherwise it follows `preview`.
    """

    def __init__(
        self,
        law: PredictiveLqi,
        queue: Array,
        motion: tuple[Trajectory, Trajectory] | None = None,
    ) -> None:
        super().__init__()
        self._law, self._motion = law, motion
        first = law.initial_memory(fixed("queue", queue, (law.queue_length, NUM_TORQUES)))
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._times = law.preview_times
        preview_size = NUM_REFERENCE * len(self._times)
        self._preview = self.DeclareVectorInputPort("preview", preview_size)
        self._weights = self.DeclareVectorInputPort("weights", len(WEIGHTS))
        self._age = self.DeclareVectorInputPort("age", 1) if law.longest_wait else None
        sends = isinstance(law.channel, Packets)
        size = (law.extra_torques + 1) * (1 + NUM_TORQUES)
        self._report = self.DeclareVectorInputPort("report", size) if sends else None
        self._record(law, first)
        self._put_out("torque", NUM_TORQUES, lambda m: m.torque, now=True, held="torque_commanded")
        self.DeclareAbstractOutputPort(
            "memory", lambda: Value(Sample(first)), weak(self._left), {self._step.ticket()}
        )
        if sends:
            size = first.sent.packets[0].size
            self._put_out("plan", size, lambda m: m.sent.packets[-1].ravel(), now=True)

    def memory(self, context: Context) -> Memory:
        """Return the memory of the last sample, such as its `counts`, in this system's context."""
        return self.sample(context).memory

    def _prepared(self, context: Context) -> Callable[[], Memory]:
        age = self._age_of(context)
        measurement = Measurement.of(np.asarray(self._measurement.Eval(context)), age)
        weights = np.asarray(self._weights.Eval(context))
        memory, motion = self.memory(context), self._followed(context)
        report = self._reported(context, age)
        return lambda: self._law.step(memory, measurement, motion, weights, report)

    def _reported(self, context: Context, age: float) -> Report | None:
        if self._report is None or not self._report.HasValue(context):
            return None
        values = np.asarray(self._report.Eval(context))
        number = len(values) // (1 + NUM_TORQUES)
        if np.any(np.isnan(values)):
            return None
        acted = values[number:].reshape(number, NUM_TORQUES)
        return Report(values[:number] > 0, acted, round(age / self._law.timeline.period))

    def _followed(self, context: Context) -> Motion:
        if self._motion is not None:
            return KnownMotion(*self._motion, context.get_time())
        reference = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        return Preview(self._times, reference)

    def _left(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._step.Eval(context))


class ServoController(_RecordedLaw):
    """Controller for servos: sends crank angles ahead of time.

    With m the memory and `step` the law (`law.servos.ServoPreview`):

    Update:  every period m <- step(m, measurement, preview, report), and the time it took
    Output:  command = step(m, measurement, preview, report).command, to be read at the samples;
             the others = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period; NaN is lost |
    | preview | input | 18 | rad, m and time derivatives | read every period |
    | report | input | of `law.servos.ReportLayout` | N m | read every period; NaN is lost |
    | age | input | 1 | s, whole periods | of measurement and report; 0 where unconnected |
    | command | output | 18 | rad, rad/s, N m | direct feedthrough |
    | estimate | output | 12 | rad, m, rad/s, m/s | direct feedthrough |
    | torque | output | 6 | N m, wanted by the servos | held |
    | torque_commanded | output | 6 | the same | held |
    | integral, weights_used | output | 6, 2 | | NaN |
    | the others | output | as of `DelayLqiController` | | held |

    Args:
        command: (18,) sent before t = 0.
    """

    def __init__(self, law: ServoPreview, command: Array) -> None:
        super().__init__()
        self._law = law
        first = law.initial_memory(fixed("command", command, (NUM_REFERENCE,)))
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._preview = self.DeclareVectorInputPort("preview", NUM_REFERENCE)
        self._report = self.DeclareVectorInputPort("report", law.reports.size)
        self._age = self.DeclareVectorInputPort("age", 1)
        self._record(law, first)
        self._put_out("command", NUM_REFERENCE, lambda m: m.command, now=True)
        self._put_out("torque", NUM_TORQUES, lambda m: m.torque)

    def _prepared(self, context: Context) -> Callable[[], Memory]:
        measured = np.asarray(self._measurement.Eval(context))
        measurement = Measurement.of(measured, self._age_of(context))
        reference = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        motion, report = Preview(self._law.preview_times, reference), self._report.Eval(context)
        memory = self.sample(context).memory
        return lambda: self._law.step(memory, measurement, motion, np.asarray(report))


class OwnMemory(NamedTuple):
    """The last sample, with the names of the shipped controller's memory.

    `torque` (6,) without limit, `in_flight` (1, 6) the same within the limit, `measurement` (12,),
    NaN before the first, `counts` of problems that are visible from outside.
    """

    torque: Array
    in_flight: Array
    measurement: Array
    counts: Counts


class SampledController(SteppedLaw):
    """Reads the torque of the user's controller every period and has the ports for the record.

    Update:  every period  s <- [T_k; measurement], T_k the controller's torque, or the last one
             where that is not finite.
    Output:  torque = T_k, to be read at the samples; the others as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period |
    | own_torque | input | 6 | N m | read every period |
    | torque | output | 6 | N m | direct feedthrough |
    | torque_commanded | output | 6 | N m | held |
    | measurement_used | output | 12 | as measurement | held, NaN before the first sample |
    | the others of the shipped controller | output | as of `scenario.signals.SIGNALS` | | NaN |

    Args:
        period: s.
        torque_limit: of each motor, N m, infinite for none.
    """

    def __init__(self, period: float, torque_limit: float) -> None:
        super().__init__()
        self._limit = torque_limit
        nothing = np.zeros(NUM_TORQUES)
        first = OwnMemory(nothing, nothing[None], np.full(NUM_STATE, np.nan), Counts())
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        self._own = self.DeclareVectorInputPort("own_torque", NUM_TORQUES)
        self._begin(first, period)
        self._put_out("torque", NUM_TORQUES, lambda m: m.torque, now=True, held="torque_commanded")
        for port, signal in ports_of("controller").items():
            if part := HELD_BY_ANY.get(signal.name):
                self._put_out(port, signal.size, part)
            else:
                declare_constant(self, port, np.full(signal.size, np.nan))

    def _prepared(self, context: Context) -> Callable[[], OwnMemory]:
        last, measurement = self.sample(context).memory, np.array(self._measurement.Eval(context))

        def step() -> OwnMemory:
            torque, causes = np.array(self._own.Eval(context)), []
            if not np.all(np.isfinite(measurement)):
                causes.append("measurements_missing")
            if not np.all(np.isfinite(torque)):
                causes.append("nonfinite_torque")
                torque = last.torque
            if np.any(np.abs(torque) >= self._limit):
                causes.append("saturated_steps")
            sent = np.clip(torque, -self._limit, self._limit)[None]
            return OwnMemory(torque, sent, measurement, last.counts.plus(*causes))

        return step
