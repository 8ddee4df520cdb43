"""A controller of the user's own, sampled and on record like the shipped one."""

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from stewart_drake.law.memory import Counts
from stewart_drake.loop.controller import HELD
from stewart_drake.loop.sampling import SteppedLaw
from stewart_drake.loop.varying_delay import declare_constant
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, ports_of
from stewart_drake.types import Array

_KNOWN: Final = ("torque_commanded", "measurement")
"""Signals that a controller has whose inside is not known."""


class OwnMemory(NamedTuple):
    """The last sample, in the words of the shipped controller's memory.

    `torque` (6,) as asked for, `in_flight` (1, 6) what the limit let through of it, `measurement`
    (12,) that was read, NaN before the first, `counts` of what is seen from outside.
    """

    torque: Array
    in_flight: Array
    measurement: Array
    counts: Counts


class SampledController(SteppedLaw):
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
        first = OwnMemory(nothing, nothing[None], np.full(NUM_STATE, np.nan), Counts())
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        self._own = self.DeclareVectorInputPort("own_torque", NUM_TORQUES)
        self._begin(first, period)
        self._put_out("torque", NUM_TORQUES, HELD["torque_commanded"], now=True)
        for port, signal in ports_of("controller").items():
            if signal.name in _KNOWN:
                self._put_out(port, signal.size, HELD[signal.name])
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
