"""The delay between computing a torque and feeling it."""

from abc import abstractmethod

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.core.link import FULL, Link
from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.link import SIMULTANEOUS
from stewart_drake.scenario.signals import CARRIED, Carried
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array


class LinkSystem(LeafSystem):
    """A link of core/link.h as a system: its memory is the state, its commands come at samples."""

    def _begin(self, link: Link, period: float, rows: int, delay: Delay, queue: Array) -> None:
        """Declare input, state and samples. `queue` (L, size) is what is under way at t = 0.

        Raises:
            ValueError: a queue of the wrong shape.
        """
        queue, size = np.asarray(queue, np.float64), link.size
        if queue.shape != (delay.queue_length, size):
            raise ValueError(
                f"queue: got shape {queue.shape}; expected {(delay.queue_length, size)}"
            )
        self._link, self._period = link, period
        self._commanded = self.DeclareVectorInputPort("commanded", rows * size)
        memory, first = link.start(), (delay.periods - len(queue)) * period
        if len(queue):
            link.assume(memory, first, queue[0])
            link.begin(memory, first, queue)
        else:
            link.assume(memory, np.nan, np.zeros(size))
        self._memory = self.DeclareDiscreteState(memory)
        update_every(self, period, self._take)

    @abstractmethod
    def _send(self, memory: Array, number: int, command: Array) -> int:
        """Let the link take the command of a sample, and return what it says."""

    def _take(self, context: Context, state: State) -> None:
        # Of what another event of this instant has left: it may be an arrival.
        memory = self._of(state)
        number = self._taken(memory)
        said = self._send(memory, number, self._commanded.Eval(context))
        assert said != FULL, "more commands are under way than there is place for"
        self._change(memory, number * self._period)

    def _change(self, memory: Array, time: float) -> None:
        if self._link.next_change(memory) <= time + SIMULTANEOUS * self._period:
            self._link.change(memory, time)

    def _of(self, state: Context | State) -> Array:
        if isinstance(state, State):
            return np.asarray(state.get_mutable_discrete_state(self._memory).get_mutable_value())
        return np.asarray(state.get_discrete_state(self._memory).value())

    def _taken(self, memory: Array) -> int:
        return int(self._link.number(memory, "taken"))

    def _put_out(self, name: str, columns: slice) -> None:
        """Declare an output of what acts: of [when it began to; command]."""
        size = len(range(*columns.indices(1 + self._link.size)))
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort(name, size, weak(self._output, columns), {ticket})

    def _output(self, columns: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._link.acted(self._of(context))[0, columns])


class Wire(LinkSystem):
    """A link on which every command acts when it arrives."""

    def _lay(self, period: float, kept: int, delay: Delay, queue: Array, carries: Carried) -> None:
        """Declare all, with place for so many commands under way beyond the queue."""
        kept += delay.queue_length
        link = Link(CARRIED[carries], kept, period, wire=True, together=SIMULTANEOUS * period)
        self._begin(link, period, 1, delay, queue)
        self._put_out(carries, slice(1, None))
        if carries == "command":
            self._put_out("arrived", slice(0, 1))

    @abstractmethod
    def _arrival(self, number: int) -> float:
        """Return when the command of a sample arrives, s."""

    def _send(self, memory: Array, number: int, command: Array) -> int:
        now, at = number * self._period, self._arrival(number)
        return self._link.take(memory, now, number + 1, at, command[None])


class DelayChain(Wire):
    """Holds torques back for eta = mu dt + eta0.

    With T_k the input at t = k dt:

    Initialise: queue = [T_{-mu}, ..., T_{-1}], preceded by T_{-mu-1} when eta0 > 0; the oldest
                acts first.
    Update:     at k dt        T_k is under way,
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
        self._delay = Delay(steps, fraction)
        self._lay(period, steps + 2, self._delay, queue, carries)
        if fraction > 0:
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                event_time(period), event_time(fraction * period), weak(self._release)
            )

    def _arrival(self, number: int) -> float:
        return (number + self._delay.periods) * self._period

    def _release(self, context: Context, state: State) -> None:
        memory = self._of(state)
        self._change(memory, (self._taken(memory) - 1 + self._delay.fraction) * self._period)
