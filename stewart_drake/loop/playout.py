"""The machine's end of a network: packets of torques that wait for their time."""

from typing import Literal

import numpy as np
from pydrake.systems.framework import BasicVector, Context, State

from stewart_drake.core.link import Link
from stewart_drake.loop.delay_chain import LinkSystem
from stewart_drake.loop.sampling import weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.link import SIMULTANEOUS
from stewart_drake.scenario.signals import NUM_TORQUES, PACKETS
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array


class PlayoutBuffer(LinkSystem):
    """Plays torques from packets at their times, whatever the packets' own delays.

    Packet k, sent at t = k dt, arrives d_k later or never. Its row c is T_{k-r+c}, which shall act
    from (k - r + c) dt + eta on, for a period, eta = mu dt + eta0. With j = s - mu:

    Update:  at k dt        packet k is under way,
             at s dt + eta0 applied <- T_j of the newest packet with a row for it that has arrived;
                            queue, for j < 0; else what a dry buffer does.
    Output:  torque = applied.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6 rows | N m, T_{k-r} first | read every period |
    | torque | output | 6 | N m | piecewise constant |
    | delay | output | 1 | s, eta | constant |
    | packets | output | 5 | counts, `scenario.signals.PACKETS` | piecewise constant |
    | report | output | history (1 + 6) | which of the last packets have arrived, then the torques
      that acted in the last periods, each the newest first | meant to be read at samples |

    Args:
        period: dt in s.
        times: (n,) d_k in s, infinite for a packet that is lost; further ones are lost.
        delay: mu and eta0.
        queue: (L, 6) torques for j = -L to -1, L = mu, or mu + 1 when eta0 > 0.
        rows: in a packet.
        repeats: r.
        dry: `hold` the last torque or put out `zero`.
        history: how far back a report goes, in periods.

    Raises:
        ValueError: a queue of the wrong shape.
    """

    def __init__(
        self,
        period: float,
        times: Array,
        delay: Delay,
        queue: Array,
        *,
        rows: int = 1,
        repeats: int = 0,
        dry: Literal["hold", "zero"] = "hold",
        history: int = 1,
    ) -> None:
        super().__init__()
        self._delay, self._rows, self._repeats = delay, rows, repeats
        self._arrivals = period * np.arange(len(times)) + np.asarray(times, dtype=np.float64)
        # A packet is of use from when it is sent until its last row was due.
        kept = (delay.steps + rows + 2) * rows + delay.queue_length
        holds, together = dry == "hold", SIMULTANEOUS * period
        given = NUM_TORQUES, kept, period
        link = Link(*given, wire=False, holds=holds, history=history, together=together)
        self._begin(link, period, rows, delay, queue)
        self._put_out("torque", slice(1, None))
        self.DeclareVectorOutputPort("delay", 1, weak(self._eta), {self.nothing_ticket()})
        memory, timed = self.discrete_state_ticket(self._memory), self.time_ticket()
        self.DeclareVectorOutputPort("packets", len(PACKETS), weak(self._count), {memory})
        size = history * (1 + NUM_TORQUES)
        self.DeclareVectorOutputPort("report", size, weak(self._report), {memory, timed})
        if delay.fraction > 0:
            early, offset = event_time(period), event_time(delay.fraction * period)
            self.DeclarePeriodicUnrestrictedUpdateEvent(early, offset, weak(self._play))

    def _send(self, memory: Array, number: int, command: Array) -> int:
        arrival = self._arrivals[number] if number < len(self._arrivals) else np.inf
        first = (number - self._repeats + self._delay.periods) * self._period
        packet = command.reshape(self._rows, NUM_TORQUES)
        now = number * self._period
        return self._link.take(memory, now, number + 1, first, packet, arrival)

    def _change(self, memory: Array, time: float) -> None:
        """Begin a period, with a torque or dry."""
        if self._delay.fraction == 0:
            self._link.change(memory, time)

    def _play(self, context: Context, state: State) -> None:
        memory = self._of(state)
        period = self._taken(memory) - 1 + self._delay.fraction
        self._link.change(memory, period * self._period)

    def _eta(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._delay.eta(self._period)])

    def _count(self, context: Context, output: BasicVector) -> None:
        memory, period = self._of(context), self._period
        taken, last = self._taken(memory), self._link.number(memory, "last")
        begun = 0 if np.isinf(last) else round(last / period - self._delay.fraction) + 1
        lost = ~np.isfinite(self._arrivals[:taken])
        # Packets whose first row's time has come: of this period and those before.
        due = max(0, min(begun - self._delay.steps + self._repeats, taken))
        wanted = period * (np.arange(due) + self._delay.periods - self._repeats + SIMULTANEOUS)
        arrived = self._arrivals[:due]
        late = np.isfinite(arrived) & (arrived > wanted)
        played, dry = (self._link.number(memory, name) for name in ("played", "dry"))
        output.SetFromVector([taken, lost.sum(), late.sum(), played, dry])

    def _report(self, context: Context, output: BasicVector) -> None:
        memory = self._of(context)
        past = self._link.acted(memory)[:, 1:]
        packets = self._taken(memory) - 1 - np.arange(len(past))
        here = (packets >= 0) & (packets < len(self._arrivals))
        now = context.get_time() + SIMULTANEOUS * self._period
        flags = here & (self._arrivals[np.where(here, packets, 0)] <= now)
        output.SetFromVector(np.concatenate([flags, past.ravel()]))
