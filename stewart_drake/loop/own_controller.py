"""A controller of the user's own, sampled and on record like the shipped one."""

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.law.memory import Counts
from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import update_every
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, ports_of

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """The last sample, in the words of the shipped controller's memory.

    `torque` (6,) as asked for, `in_flight` (1, 6) what the limit let through of it, `measurement`
    (12,) that was read, NaN before the first, `counts` of what is seen from outside, `seconds` that
    the torque took to compute.
    """

    torque: Array
    in_flight: Array
    measurement: Array
    counts: Counts
    seconds: float


class SampledController(LeafSystem):
    """Reads a controller's torque every period, in the place of `DelayLqiController`.

    Attributes:
        backend: `own`.

    Update:  every period  s <- [T_k; measurement], T_k the torque that the controller puts out
             then, or the last one where that is no number.
    Output:  torque = T_k, to be taken at the samples; the others as of the last sample.

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

    backend = "own"

    def __init__(self, period: float, torque_limit: float) -> None:
        super().__init__()
        self._limit = torque_limit
        nothing = np.zeros(NUM_TORQUES)
        first = Sample(nothing, nothing[None], np.full(NUM_STATE, np.nan), Counts(), 0.0)
        self._last = self.DeclareAbstractState(Value(first))
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        self._own = self.DeclareVectorInputPort("own_torque", NUM_TORQUES)
        ticket = self.abstract_state_ticket(self._last)
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=lambda: Value(first), calc=weak(self._calc_step)),
            {self.all_input_ports_ticket(), ticket},
        )
        self.DeclareVectorOutputPort(
            "torque", NUM_TORQUES, weak(self._torque), {self._step.ticket()}
        )
        known = {"torque_commanded": weak(self._commanded), "measurement_used": weak(self._used)}
        for port, signal in ports_of("controller").items():
            calc, of = known.get(port, _nothing), ticket if port in known else self.nothing_ticket()
            self.DeclareVectorOutputPort(port, signal.size, calc, {of})
        update_every(self, period, self._update)

    def sample(self, context: Context) -> tuple[Sample, float]:
        """The last sample in a context of this system, and the time that it took, s."""
        last = self._sample(context)
        return last, last.seconds

    def _sample(self, context: Context) -> Sample:
        value: Any = context.get_abstract_state(int(self._last))
        return value.get_value()

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        last = self._sample(context)
        # First, so that the time below is the controller's alone.
        measurement = np.array(self._measurement.Eval(context))
        started = time.perf_counter()
        torque = np.array(self._own.Eval(context))
        seconds = time.perf_counter() - started
        causes = []
        if not np.all(np.isfinite(measurement)):
            causes.append("measurements_missing")
        if not np.all(np.isfinite(torque)):
            causes.append("nonfinite_torque")
            torque = last.torque
        if np.any(np.abs(torque) >= self._limit):
            causes.append("saturated_steps")
        sent = np.clip(torque, -self._limit, self._limit)[None]
        counts = last.counts.plus(*causes)
        result.set_value(Sample(torque, sent, measurement, counts, seconds))

    def _torque(self, context: Context, output: BasicVector) -> None:
        step: Any = self._step.Eval(context)
        output.SetFromVector(step.torque)

    def _commanded(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._sample(context).torque)

    def _used(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._sample(context).measurement)

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._last)).set_value(self._step.Eval(context))


def _nothing(context: Context, output: BasicVector) -> None:
    output.SetFromVector(np.full(output.size(), np.nan))
