"""The law for servos as a Drake system."""

from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import Context

from stewart_drake.law.measurement import Measurement
from stewart_drake.law.motion import Preview
from stewart_drake.law.servo_preview import ServoMemory, ServoPreview
from stewart_drake.loop.controller import HELD
from stewart_drake.loop.sampling import SteppedLaw
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, NUM_TORQUES, ports_of
from stewart_drake.types import Array


class ServoController(SteppedLaw):
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
        first = law.initial_memory(command)
        self._measurement = self.DeclareVectorInputPort("measurement", law.sensing.size)
        self._preview = self.DeclareVectorInputPort("preview", NUM_REFERENCE)
        self._report = self.DeclareVectorInputPort("report", law.reports.size)
        self._age = self.DeclareVectorInputPort("age", 1)
        self._begin(first, law.timeline.period)
        self._put_out("command", NUM_REFERENCE, lambda m: m.command, now=True)
        self._put_out("estimate", NUM_STATE, lambda m: m.belief.state, now=True)
        self._put_out("torque", NUM_TORQUES, HELD["torque_commanded"])
        for port, signal in ports_of("controller").items():
            part = HELD[signal.name]
            self._put_out(port, len(part(first)), part)

    def _prepared(self, context: Context) -> Callable[[], ServoMemory]:
        age = float(np.asarray(self._age.Eval(context))[0]) if self._age.HasValue(context) else 0.0
        measurement = Measurement.of(np.asarray(self._measurement.Eval(context)), age)
        reference = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        motion, report = Preview(self._law.preview_times, reference), self._report.Eval(context)
        memory = self.sample(context).memory
        return lambda: self._law.step(memory, measurement, motion, np.asarray(report))
