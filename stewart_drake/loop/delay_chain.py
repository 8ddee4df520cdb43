"""The delay between computing a torque and feeling it."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteStateIndex, LeafSystem, State

from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import CARRIED, Carried
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array


class Arrived(LeafSystem):
    """What has come over a wire, and when, as outputs; for what decides when that is."""

    def _begin(self, carries: Carried, applied: Array, arrived: float) -> None:
        """Declare the input, and the outputs with what acts at first and when that arrived, s."""
        self._size = CARRIED[carries]
        self._commanded = self.DeclareVectorInputPort("commanded", self._size)
        self._applied = self.DeclareDiscreteState(applied)
        self._arrived = self.DeclareDiscreteState([arrived])
        self._put_out(carries, self._size, self._applied)
        if carries == "command":
            self._put_out("arrived", 1, self._arrived)

    def _apply(self, torque: Array, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._applied).SetFromVector(torque)
        state.get_mutable_discrete_state(self._arrived).SetFromVector([context.get_time()])

    def _put_out(self, name: str, size: int, index: DiscreteStateIndex) -> None:
        ticket = self.discrete_state_ticket(index)
        self.DeclareVectorOutputPort(name, size, weak(self._output, index), {ticket})

    def _output(self, index: DiscreteStateIndex, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(index).value())


class DelayChain(Arrived):
    """Holds torques back for eta = mu dt + eta0.

    With T_k the input at t = k dt:

    Initialise: queue = [T_{-mu}, ..., T_{-1}], preceded by T_{-mu-1} when eta0 > 0; the oldest
                acts first.
    Update:     at k dt        queue <- [queue without its oldest; T_k], T_k joining at the end,
                at k dt + eta0 applied <- T_{k-mu}.
    Output:     torque = applied, hence T_k during [(k + mu) dt + eta0, (k + 1 + mu) dt + eta0).

    Updates of one instant all read what was there before, and a multibody plant's step is one of
    them. So these come slightly earlier (`scenario.timing.event_time`), the first at
    initialisation: a plant
    that steps at t feels the torque released at t.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6, or n | N m | read every period |
    | torque, or `carries` | output | the same | N m | piecewise constant |
    | arrived | output | 1, with commands | s, when that arrived; NaN for nothing yet | the same |

    Args:
        period: dt in s.
        steps: mu.
        fraction: eta0 / dt, in [0, 1).
        queue: (L, n) torques in flight at t = 0, oldest first, L = mu, or mu + 1 when eta0 > 0.
        carries: what it delays: torques, of six motors, or commands to servos.

    Raises:
        ValueError: a queue of the wrong shape.
    """

    def __init__(
        self, period: float, steps: int, fraction: float, queue: Array, carries: Carried = "torque"
    ) -> None:
        super().__init__()
        length, size = Delay(steps, fraction).queue_length, CARRIED[carries]
        queue = np.asarray(queue, dtype=np.float64)
        if queue.shape != (length, size):
            raise ValueError(f"queue: got shape {queue.shape}; expected {(length, size)}")
        # `line` is [applied; waiting ...]: T_{k-mu} ... T_k after the update at k dt, with the
        # applied torque kept apart because it changes eta0 later than the rest.
        self._fraction = fraction
        waiting = queue[1:] if fraction > 0 else queue
        began = (fraction - 1) * period if fraction > 0 else 0.0
        if length > 0:
            self._begin(carries, queue[0], began)
        else:
            self._begin(carries, np.zeros(size), np.nan)
        self._waiting = self.DeclareDiscreteState(np.vstack([np.zeros(size), waiting]).ravel())
        update_every(self, period, self._take)
        if fraction > 0:
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                event_time(period), event_time(fraction * period), weak(self._release)
            )

    def _take(self, context: Context, state: State) -> None:
        waiting = context.get_discrete_state(self._waiting).value()
        moved = np.concatenate([waiting[self._size :], self._commanded.Eval(context)])
        state.get_mutable_discrete_state(self._waiting).SetFromVector(moved)
        if self._fraction == 0:
            self._apply(moved[: self._size], context, state)

    def _release(self, context: Context, state: State) -> None:
        waiting = context.get_discrete_state(self._waiting).value()
        self._apply(waiting[: self._size], context, state)
