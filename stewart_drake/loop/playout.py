"""The machine's end of a network: packets of torques that wait for their time."""

from typing import Literal

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import NUM_TORQUES, PACKETS
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

_TOGETHER = 1e-9
"""Of a period; a packet that is so little late is in time."""


class PlayoutBuffer(LeafSystem):
    """Plays torques from packets at their times, whatever the packets' own delays.

    Packet k, sent at t = k dt, arrives d_k later or never. Its row c is T_{k-r+c}, which shall act
    from (k - r + c) dt + eta on, for a period, eta = mu dt + eta0. With j = s - mu:

    Update:  at k dt        sent <- [sent without its oldest; packet k],
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
        queue = np.asarray(queue, dtype=np.float64)
        if queue.shape != (delay.queue_length, NUM_TORQUES):
            expected = (delay.queue_length, NUM_TORQUES)
            raise ValueError(f"queue: got shape {queue.shape}; expected {expected}")
        self._period, self._delay, self._queue = period, delay, queue
        self._rows, self._repeats, self._holds = rows, repeats, dry == "hold"
        self._arrivals = period * np.arange(len(times)) + np.asarray(times, dtype=np.float64)
        self._declare_state(history)
        self._commanded = self.DeclareVectorInputPort("commanded", NUM_TORQUES * rows)
        of_applied = {self.discrete_state_ticket(self._applied)}
        self.DeclareVectorOutputPort("torque", NUM_TORQUES, weak(self._output), of_applied)
        state = {self.all_state_ticket()}
        self.DeclareVectorOutputPort("delay", 1, weak(self._eta), {self.nothing_ticket()})
        self.DeclareVectorOutputPort("packets", len(PACKETS), weak(self._count), state)
        size = history * (1 + NUM_TORQUES)
        timed = {*state, self.time_ticket()}
        self.DeclareVectorOutputPort("report", size, weak(self._report), timed)
        update_every(self, period, self._take)
        if delay.fraction > 0:
            early, offset = event_time(period), event_time(delay.fraction * period)
            self.DeclarePeriodicUnrestrictedUpdateEvent(early, offset, weak(self._play_next))

    def _declare_state(self, history: int) -> None:
        delay, queue = self._delay, self._queue
        applied = queue[0] if len(queue) else np.zeros(NUM_TORQUES)
        self._applied = self.DeclareDiscreteState(applied)
        # A packet is of use from when it is sent until its last row was due.
        kept = delay.steps + self._rows + 1
        self._sent = self.DeclareDiscreteState(kept * self._rows * NUM_TORQUES)
        self._taken = self.DeclareDiscreteState(1)
        self._past = self.DeclareDiscreteState(np.tile(applied, history))
        self._counts = self.DeclareDiscreteState(3)  # periods played, dry, begun

    def _take(self, context: Context, state: State) -> None:
        taken, packet = self._number(context), self._commanded.Eval(context)
        sent = context.get_discrete_state(self._sent).value()
        moved = np.concatenate([sent[NUM_TORQUES * self._rows :], packet])
        state.get_mutable_discrete_state(self._sent).SetFromVector(moved)
        state.get_mutable_discrete_state(self._taken).SetFromVector([taken + 1])
        if self._delay.fraction == 0:
            self._play(context, state, moved, taken + 1)

    def _play_next(self, context: Context, state: State) -> None:
        sent = context.get_discrete_state(self._sent).value()
        self._play(context, state, sent, self._number(context))

    def _play(self, context: Context, state: State, sent: Array, taken: int) -> None:
        """Begin the period of the sample before packet `taken`."""
        packets = sent.reshape(-1, self._rows, NUM_TORQUES)
        period, j = taken - 1, taken - 1 - self._delay.steps
        now = (period + self._delay.fraction + _TOGETHER) * self._period
        played, dry, begun = context.get_discrete_state(self._counts).value()
        torque = self._newest(packets, taken, j, now)
        if torque is not None:
            played += 1
        elif j < 0:
            torque = self._queue[j + len(self._queue)]
        else:
            dry += 1
            last = context.get_discrete_state(self._applied).value()
            torque = last if self._holds else np.zeros(NUM_TORQUES)
        past = context.get_discrete_state(self._past).value()
        state.get_mutable_discrete_state(self._past).SetFromVector(
            np.concatenate([torque, past[:-NUM_TORQUES]])
        )
        state.get_mutable_discrete_state(self._applied).SetFromVector(torque)
        state.get_mutable_discrete_state(self._counts).SetFromVector([played, dry, begun + 1])

    def _newest(self, packets: Array, taken: int, j: int, now: float) -> Array | None:
        """T_j as the newest packet has it that is there, or None."""
        last = min(j + self._repeats, taken - 1, len(self._arrivals) - 1)
        for k in range(last, max(j + self._repeats - self._rows, -1), -1):
            if self._arrivals[k] <= now:
                return packets[k - taken][j - k + self._repeats]
        return None

    def _number(self, context: Context) -> int:
        return int(context.get_discrete_state(self._taken).value()[0])

    def _output(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._applied).value())

    def _eta(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._delay.eta(self._period)])

    def _count(self, context: Context, output: BasicVector) -> None:
        taken = self._number(context)
        played, dry, begun = context.get_discrete_state(self._counts).value()
        lost = ~np.isfinite(self._arrivals[:taken])
        # Packets whose first row's time has come: of this period and those before.
        due = max(0, min(int(begun) - self._delay.steps + self._repeats, taken))
        wanted = self._period * (np.arange(due) + self._delay.periods - self._repeats + _TOGETHER)
        arrived = self._arrivals[:due]
        late = np.isfinite(arrived) & (arrived > wanted)
        output.SetFromVector([taken, lost.sum(), late.sum(), played, dry])

    def _report(self, context: Context, output: BasicVector) -> None:
        past = context.get_discrete_state(self._past).value()
        number = len(past) // NUM_TORQUES
        packets = self._number(context) - 1 - np.arange(number)
        here = (packets >= 0) & (packets < len(self._arrivals))
        now = context.get_time() + _TOGETHER * self._period
        flags = here & (self._arrivals[np.where(here, packets, 0)] <= now)
        output.SetFromVector(np.concatenate([flags, past]))
