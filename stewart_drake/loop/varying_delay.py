"""The delay between computing a torque and feeling it, where it changes from torque to torque."""

from typing import Final

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.delay_chain import Arrived
from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.link import TOGETHER, releases
from stewart_drake.scenario.signals import CARRIED, PACKETS, Carried
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

_ONCE: Final = 1e9
"""s, the period of an event that comes once: longer than any run."""


class VaryingDelay(Arrived):
    """Holds torque k back for eta_k, each for a time of its own.

    With T_k the input at t = k dt, which arrives at a_k = k dt + eta_k:

    Initialise: T_{-L}, ..., T_{-1} are under way and arrive at (k + mu) dt + eta0.
    Update:     at k dt        sent <- [sent without its oldest; T_k],
                at a_k         applied <- T_k, unless a newer one has arrived before.
    Output:     torque = applied.

    The order of arrival is not kept: a torque that was overtaken never acts
    (`scenario.link.acting`). What acts when is known beforehand, and each arrival is an event of
    its own, so that an integrator stops there. As in `DelayChain` they come slightly early.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6, or n | N m | read every period |
    | torque, or `carries` | output | the same | N m | piecewise constant |
    | arrived | output | 1, with commands | s, when that arrived; NaN for nothing yet | the same |
    | delay | output | 1 | s, of the torque sent last | held |
    | packets | output | 5 | 1, NaN: nothing is sent in packets | constant |

    Args:
        period: dt in s.
        delays: (n,) eta_k of T_0 to T_{n-1}, s; the last of them stays.
        delay: mu and eta0, those of the torques sent before t = 0.
        queue: (L, n) torques in flight at t = 0, oldest first, L = mu, or mu + 1 when eta0 > 0.
        carries: as of `DelayChain`.

    Raises:
        ValueError: a queue of the wrong shape, a delay that is negative or no number.
    """

    def __init__(
        self,
        period: float,
        delays: Array,
        delay: Delay,
        queue: Array,
        carries: Carried = "torque",
    ) -> None:
        super().__init__()
        queue, delays = np.asarray(queue, np.float64), np.asarray(delays, np.float64)
        length, size = delay.queue_length, CARRIED[carries]
        if queue.shape != (length, size):
            raise ValueError(f"queue: got shape {queue.shape}; expected {(length, size)}")
        if delays.ndim != 1 or not len(delays) or not np.all(delays >= 0):
            raise ValueError("delays: got an empty or negative one; expected (n,) of at least 0 s")
        self._delays = np.where(delays > TOGETHER * period, delays, 0.0)
        self._numbers, times = releases(period, delays, delay)
        self._at_once = set(self._numbers[times == period * self._numbers].tolist())
        # Sent by the time each of them acts, and one more where both fall on a sample.
        sent_by_then = np.floor(times / period + TOGETHER) + 1
        kept = int(np.max(sent_by_then - self._numbers, initial=1)) + 1
        sent = np.zeros((max(kept, length + 1), size))
        sent[len(sent) - length :] = queue
        at_first = (times <= 0) & (self._numbers < 0)
        first = self._numbers[at_first]
        if len(first):
            self._begin(carries, queue[first[-1] + length], times[at_first][-1])
        else:
            self._begin(carries, np.zeros(size), np.nan)
        self._sent = self.DeclareDiscreteState(sent.ravel())
        self._taken = self.DeclareDiscreteState(1)
        taken_ticket = self.discrete_state_ticket(self._taken)
        self.DeclareVectorOutputPort("delay", 1, weak(self._delay), {taken_ticket})
        declare_constant(self, "packets", np.full(len(PACKETS), np.nan))
        update_every(self, period, self._take)
        for number, time in zip(self._numbers.tolist(), times.tolist(), strict=True):
            if time > 0 and number not in self._at_once:
                arrive = weak(self._arrive, number)
                self.DeclarePeriodicUnrestrictedUpdateEvent(_ONCE, event_time(time), arrive)

    def _take(self, context: Context, state: State) -> None:
        number = int(context.get_discrete_state(self._taken).value()[0])
        sent = context.get_discrete_state(self._sent).value()
        torque = self._commanded.Eval(context)
        moved = np.concatenate([sent[self._size :], torque])
        state.get_mutable_discrete_state(self._sent).SetFromVector(moved)
        state.get_mutable_discrete_state(self._taken).SetFromVector([number + 1])
        if number in self._at_once:
            self._apply(torque, context, state)

    def _arrive(self, number: int, context: Context, state: State) -> None:
        taken = int(context.get_discrete_state(self._taken).value()[0])
        sent = context.get_discrete_state(self._sent).value().reshape(-1, self._size)
        self._apply(sent[number - taken], context, state)

    def _delay(self, context: Context, output: BasicVector) -> None:
        taken = int(context.get_discrete_state(self._taken).value()[0])
        output.SetFromVector([self._delays[min(max(taken, 1), len(self._delays)) - 1]])


def declare_constant(system: LeafSystem, name: str, value: Array) -> None:
    """Declare an output port (n,) of a system that never changes."""

    def put_out(context: Context, output: BasicVector) -> None:
        output.SetFromVector(value)

    system.DeclareVectorOutputPort(name, len(value), put_out, {system.nothing_ticket()})
