"""The control law as a Drake system."""

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.channel import Packets, Report
from stewart_drake.law.core_law import AnyMemory, serving
from stewart_drake.law.late import LateObserver
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import KnownMotion, Motion, Preview
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.sampling import Sample, SteppedLaw, weak
from stewart_drake.scenario.signals import (
    NUM_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PARAMETERS,
    WEIGHTS,
    ports_of,
)
from stewart_drake.types import Array

HELD: Final[dict[str, Callable[[AnyMemory], Array]]] = {
    "torque_commanded": lambda memory: memory.torque,
    "integral": lambda memory: memory.integral,
    "weights": lambda memory: memory.weights,
    "measurement": lambda memory: memory.measurement,
    "state_estimate": lambda memory: memory.belief.state,
    "parameters": lambda memory: memory.belief.parameters,
    "parameter_std": lambda memory: memory.belief.estimate.parameter_std,
    "delay_estimate": lambda memory: memory.belief.delay,
    "delay_std": lambda memory: np.array([memory.belief.delay_std]),
}
"""Signal of the table `scenario.signals.SIGNALS` -> what the controller's memory has of it."""


def held_by(dynamics: StewartDynamics) -> dict[str, Callable[[AnyMemory], Array]]:
    """Return HELD for the law of a plant, with its parameters at their places in the record.

    A parameter that is not estimated is recorded as it is known, without a standard deviation.
    """
    place = np.array([_place(name, dynamics.free) for name in PARAMETERS])
    known, unknown = dynamics.plant_parameters[:NUM_PARAMETERS], np.full(NUM_PARAMETERS, np.nan)

    def recorded(signal: str, otherwise: Array) -> Callable[[AnyMemory], Array]:
        return lambda memory: np.where(place < 0, otherwise, HELD[signal](memory)[place])

    own = {"parameters": known, "parameter_std": unknown}
    return HELD | {signal: recorded(signal, otherwise) for signal, otherwise in own.items()}


def _place(name: str, names: Sequence[str]) -> int:
    return names.index(name) if name in names else -1


def reported(kept: int) -> int:
    """Periods that a report tells of, for a law that keeps so many torques beyond its delay."""
    return kept + 1


class DelayLqiController(SteppedLaw):
    """Predictive LQI, whatever parts its law is made of; in C if the core has all of them.

    With m the memory (`law.memory.Memory`) and `step` the law (`law.predictive_lqi.PredictiveLqi`):

    Initialise: m holds the torques in flight at t = 0 and nothing else.
    Update:     every period m <- step(m, measurement, preview, weights), and the time it took
    Output:     torque        = step(m, measurement, preview, weights).torque, to be taken at the
                samples, where the update happens too: one step serves both.
                the others    = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12, or 6 N | rad, m, rad/s, m/s | read every period; NaN is lost |
    | preview | input | 18 p | rad, m and time derivatives | read every period |
    | weights | input | 2 | w_Q, w_R | read every period |
    | age | input | 1 | s, whole periods | of the measurement; only with a `LateObserver` |
    | report | input | 7 h | as of `PlayoutBuffer`, NaN is lost | only with a channel of packets |
    | plan | output | 6 (r + N) | N m, the packet to be sent | the same; direct feedthrough |
    | torque | output | 6 | N m | direct feedthrough |
    | estimate | output | 12 | rad, m, rad/s, m/s | direct feedthrough; what T_k rests on |
    | memory | output | abstract, `Sample` | - | direct feedthrough; what this sample leaves |
    | torque_commanded | output | 6 | N m | held |
    | integral | output | 6 | rad s, m s | held |
    | weights_used | output | 2 | - | held, NaN before the first sample |
    | measurement_used | output | as measurement | the same | held, NaN before the first sample |
    | state_estimate | output | 12 | rad, m, rad/s, m/s | held, NaN before the first sample |
    | parameters | output | 8 | N m, kg, N m s/rad | held; as the law believes |
    | parameter_std | output | 8 | the same | held; NaN without estimator |
    | delay_estimate | output | 1 | s | held; as the law believes |
    | delay_std | output | 1 | s | held; NaN without delay estimator |

    Args:
        law: the control law.
        queue: (L, 6) torques in flight at t = 0 in N m, oldest first, as the controller believes.
        motion: what it follows, and the reference, for a law that asks for other instants of it
            than it did at the start; without it what it follows is `preview`.
    """

    def __init__(
        self,
        law: PredictiveLqi,
        queue: Array,
        motion: tuple[Trajectory, Trajectory] | None = None,
    ) -> None:
        super().__init__()
        self._law, self._motion = law, motion
        self._served = serving(law).law
        first = self._served.initial_memory(queue)
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._times = law.preview_times
        preview_size = NUM_REFERENCE * len(self._times)
        self._preview = self.DeclareVectorInputPort("preview", preview_size)
        self._weights = self.DeclareVectorInputPort("weights", len(WEIGHTS))
        late = isinstance(law.observer, LateObserver)
        self._age = self.DeclareVectorInputPort("age", 1) if late else None
        sends = isinstance(law.channel, Packets)
        size = reported(law.kept) * (1 + NUM_TORQUES)
        self._report = self.DeclareVectorInputPort("report", size) if sends else None
        self._begin(first, law.timeline.period)
        self._put_out("torque", NUM_TORQUES, lambda m: m.torque, now=True)
        self._put_out("estimate", NUM_STATE, lambda m: m.belief.state, now=True)
        self.DeclareAbstractOutputPort(
            "memory", lambda: Value(Sample(first, 0.0)), weak(self._left), {self._step.ticket()}
        )
        if sends:
            size = first.sent.packets[0].size
            self._put_out("plan", size, lambda m: m.sent.packets[-1].ravel(), now=True)
        held = held_by(law.plant.dynamics)
        for port, signal in ports_of("controller").items():
            part = held[signal.name]  # whose size is the law's: what it senses
            self._put_out(port, len(part(first)), part)

    def memory(self, context: Context) -> AnyMemory:
        """The memory in a context of this system."""
        return self.sample(context).memory

    def _prepared(self, context: Context) -> Callable[[], AnyMemory]:
        age = 0.0
        if self._age is not None:
            age = float(np.asarray(self._age.Eval(context))[0])
        measurement = Measurement.of(np.asarray(self._measurement.Eval(context)), age)
        weights = np.asarray(self._weights.Eval(context))
        memory, motion = self.memory(context), self._followed(context)
        report = self._reported(context, age)
        return lambda: self._served.step(memory, measurement, motion, weights, report)

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
