"""The law for servos as a Drake system."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State, ValueProducer

from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import Preview
from stewart_drake.law.servo_preview import ServoMemory, ServoPreview
from stewart_drake.loop.controller import HELD
from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import update_every
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, NUM_TORQUES, ports_of

Array = NDArray[np.float64]


class ServoSample(NamedTuple):
    """What one step of the law left behind."""

    memory: ServoMemory
    seconds: float
    """Time that it took to compute; 0 before the first."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "ServoSample":
        """See `loop.controller.Sample`."""
        return self


class ServoController(LeafSystem):
    """Sends crank angles ahead, in the place of `loop.controller.DelayLqiController`.

    With m the memory and `step` the law (`law.servo_preview.ServoPreview`):

    Update:  every period m <- step(m, measurement, preview, report), and the time it took
    Output:  command = step(m, measurement, preview, report).command, to be taken at the samples;
             the others = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period; NaN is lost |
    | preview | input | 18 | rad, m and time derivatives | read every period |
    | report | input | of `law.servos.ReportLayout` | N m | read every period; NaN is lost |
    | age | input | 1 | s, whole periods | of measurement and report; 0 where unconnected |
    | command | output | 18 | rad, rad/s, N m | direct feedthrough |
    | estimate | output | 12 | rad, m, rad/s, m/s | direct feedthrough |
    | torque | output | 6 | N m, that servos asked for | held |
    | torque_commanded | output | 6 | the same | held |
    | integral, weights_used | output | 6, 2 | | NaN |
    | the others | output | as of `DelayLqiController` | | held |

    Args:
        law: the control law.
        command: (18,) that was sent before t = 0.
    """

    backend = "python (controller.command)"

    def __init__(self, law: ServoPreview, command: Array) -> None:
        super().__init__()
        self._law = law
        first = ServoSample(law.initial_memory(command), 0.0)
        self._memory = self.DeclareAbstractState(Value(first))
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._preview = self.DeclareVectorInputPort("preview", NUM_REFERENCE)
        self._report = self.DeclareVectorInputPort("report", law.reports.size)
        self._age = self.DeclareVectorInputPort("age", 1)
        ticket = self.abstract_state_ticket(self._memory)
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=lambda: Value(first), calc=weak(self._calc_step)),
            {self.all_input_ports_ticket(), ticket},
        )
        self.DeclareVectorOutputPort(
            "command", NUM_REFERENCE, weak(self._command), {self._step.ticket()}
        )
        self.DeclareVectorOutputPort(
            "estimate", NUM_STATE, weak(self._estimate), {self._step.ticket()}
        )
        self.DeclareVectorOutputPort(
            "torque", NUM_TORQUES, weak(self._held, "torque_commanded"), {ticket}
        )
        for port, signal in ports_of("controller").items():
            size = len(HELD[signal.name](first.memory))
            self.DeclareVectorOutputPort(port, size, weak(self._held, signal.name), {ticket})
        update_every(self, law.timeline.period, self._update)

    def sample(self, context: Context) -> ServoSample:
        """What the last step left in a context of this system."""
        value: Any = context.get_abstract_state(int(self._memory))
        return value.get_value()

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        age = float(np.asarray(self._age.Eval(context))[0]) if self._age.HasValue(context) else 0.0
        measurement = Measurement.of(np.asarray(self._measurement.Eval(context)), age)
        reference = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        motion, report = Preview(self._law.preview_times, reference), self._report.Eval(context)
        memory = self.sample(context).memory
        started = time.perf_counter()
        after = self._law.step(memory, measurement, motion, np.asarray(report))
        result.set_value(ServoSample(after, time.perf_counter() - started))

    def _command(self, context: Context, output: BasicVector) -> None:
        sample: Any = self._step.Eval(context)
        output.SetFromVector(sample.memory.command)

    def _estimate(self, context: Context, output: BasicVector) -> None:
        sample: Any = self._step.Eval(context)
        output.SetFromVector(sample.memory.belief.state)

    def _held(self, name: str, context: Context, output: BasicVector) -> None:
        output.SetFromVector(HELD[name](self.sample(context).memory))

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._memory)).set_value(self._step.Eval(context))
