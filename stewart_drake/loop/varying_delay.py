"""The delay between computing a torque and feeling it, where it changes from torque to torque."""

from typing import Final

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.delay_chain import Wire
from stewart_drake.loop.sampling import weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.link import SIMULTANEOUS, releases
from stewart_drake.scenario.signals import PACKETS, Carried
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

_ONCE: Final = 1e9
"""s, the period of an event that comes once: longer than any run."""


class VaryingDelay(Wire):
    """Holds torque k back for eta_k, each for a time of its own.

    With T_k the input at t = k dt, which arrives at a_k = k dt + eta_k:

    Initialise: T_{-L}, ..., T_{-1} are under way and arrive at (k + mu) dt + eta0.
    Update:     at k dt        T_k is under way,
                at a_k         applied <- T_k, unless a newer one has arrived before.
    Output:     torque = applied.

    The order of arrival is not kept: a torque that was overtaken never acts
    (`scenario.link.takes_effect`). All arrivals are known beforehand. Each is an event of its own,
    so that an integrator stops there. As in `DelayChain` they come slightly early.

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
        delays = np.asarray(delays, np.float64)
        if delays.ndim != 1 or not len(delays) or not np.all(delays >= 0):
            raise ValueError("delays: got an empty or negative one; expected (n,) of at least 0 s")
        self._delays = np.where(delays > SIMULTANEOUS * period, delays, 0.0)
        longest = self._delays.max(initial=0.0, where=np.isfinite(delays))
        self._lay(period, int(longest / period) + 2, delay, queue, carries)
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort("delay", 1, weak(self._delay), {ticket})
        declare_constant(self, "packets", np.full(len(PACKETS), np.nan))
        numbers, times = releases(period, delays, delay)
        # Where a torque arrives as it is sent, its sample is the event.
        for time in times[(times > 0) & (times != period * numbers)].tolist():
            arrive = weak(self._arrive, time)
            self.DeclarePeriodicUnrestrictedUpdateEvent(_ONCE, event_time(time), arrive)

    def _arrival(self, number: int) -> float:
        return float(number * self._period + self._delays[min(number, len(self._delays) - 1)])

    def _arrive(self, time: float, context: Context, state: State) -> None:
        self._change(self._of(state), time)

    def _delay(self, context: Context, output: BasicVector) -> None:
        sent = max(self._taken(self._of(context)), 1)
        output.SetFromVector([self._delays[min(sent, len(self._delays)) - 1]])


def declare_constant(system: LeafSystem, name: str, value: Array) -> None:
    """Declare an output port (n,) of a system that never changes."""

    def put_out(context: Context, output: BasicVector) -> None:
        output.SetFromVector(value)

    system.DeclareVectorOutputPort(name, len(value), put_out, {system.nothing_ticket()})
