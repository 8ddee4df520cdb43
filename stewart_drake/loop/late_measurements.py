"""The way of measurements to the controller: they come late, overtake one another, and get lost."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import update_every
from stewart_drake.scenario.link import newest_measurements
from stewart_drake.types import Array


class LateMeasurements(LeafSystem):
    """Hands on, at each sample, the newest measurement that has arrived since the one before.

    With y_j what is measured at j dt, which takes tau_j, and n_k the newest j with
    j dt + tau_j <= k dt:

    Update:  at k dt  taken <- [taken without its oldest; y_k].
    Output:  measurement = y_{n_k}, age = (k - n_k) dt, where n_k is newer than n_{k-1}; else all
             NaN and age = 0. One that was overtaken is dropped.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measured | input | size | as measured | read every period |
    | measurement | output | size | the same | meant to be read at samples |
    | age | output | 1 | s | the same |

    Args:
        period: dt in s.
        times: (n,) tau_j in s, infinite for one that is lost; further ones are lost.
        size: of the measurement.
    """

    def __init__(self, period: float, times: Array, size: int) -> None:
        super().__init__()
        self._period, self._size = period, size
        self._given = newest_measurements(np.asarray(times, dtype=np.float64), period)
        ages = np.where(self._given >= 0, np.arange(len(self._given)) - self._given, 0)
        self._kept = max(1, int(ages.max(initial=0)))
        self._taken = self.DeclareDiscreteState(np.full(self._kept * size, np.nan))
        self._measured = self.DeclareVectorInputPort("measured", size)
        self.DeclareVectorOutputPort("measurement", size, weak(self._measurement))
        self.DeclareVectorOutputPort("age", 1, weak(self._age), {self.time_ticket()})
        update_every(self, period, self._take)

    def _take(self, context: Context, state: State) -> None:
        taken = context.get_discrete_state(self._taken).value()
        moved = np.concatenate([taken[self._size :], self._measured.Eval(context)])
        state.get_mutable_discrete_state(self._taken).SetFromVector(moved)

    def _periods(self, context: Context) -> int | None:
        """How old what is handed on is, in samples; None for nothing."""
        k = round(context.get_time() / self._period)
        if k >= len(self._given) or self._given[k] < 0:
            return None
        return int(k - self._given[k])

    def _measurement(self, context: Context, output: BasicVector) -> None:
        periods = self._periods(context)
        if periods is None:
            output.SetFromVector(np.full(self._size, np.nan))
        elif periods == 0:
            output.SetFromVector(self._measured.Eval(context))
        else:
            taken = context.get_discrete_state(self._taken).value()
            output.SetFromVector(taken.reshape(-1, self._size)[-periods])

    def _age(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._period * (self._periods(context) or 0)])
