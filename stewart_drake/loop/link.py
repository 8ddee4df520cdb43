"""Links as Drake systems: constant and varying delay, packets, late measurements (core/link.h).

Updates of one instant read the values from before it. A multibody plant's step is such an update.
Those of a link come slightly earlier (`scenario.timing.event_time`), the first at initialisation: a
plant that steps at t feels the torque released at t.
"""

import math
from abc import abstractmethod
from typing import Literal

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.core.link import NO_ROOM, Link
from stewart_drake.files.arguments import fixed, of_kind, one_of, positive, whole
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief
from stewart_drake.loop.sampling import ONCE, declare_constant, update_every, weak
from stewart_drake.scenario.link import SIMULTANEOUS, releases
from stewart_drake.scenario.signals import CARRIED, NUM_TORQUES, PACKETS, Carried
from stewart_drake.scenario.timing import Delay, event_time
from stewart_drake.types import Array


class LinkSystem(LeafSystem):
    """A link with its memory as discrete state, which takes a command at each sample."""

    _at_samples = True
    """Whether commands may begin to act at the samples."""

    def _begin(self, link: Link, period: float, rows: int, delay: Delay, queue: Array) -> None:
        """Declare input, state and samples.

        Args:
            link: the commands in flight, in the core.
            period: dt in s.
            rows: commands that are sent at a sample.
            delay: of the commands sent before t = 0.
            queue: (L, size) commands in flight at t = 0, oldest first.
        """
        queue = fixed("queue", queue, (delay.queue_length, link.size))
        self._link, self._period = link, period
        self._commanded = self.DeclareVectorInputPort("commanded", rows * link.size)
        self._memory = self.DeclareDiscreteState(begun(link, delay, period, queue))
        update_every(self, period, self._take)

    def _release_between(self, delay: Delay) -> None:
        """Let commands act at k dt + eta0 too, if eta0 is above 0."""
        self._delay = delay
        if delay.fraction > 0:
            early, offset = event_time(self._period), event_time(delay.fraction * self._period)
            self.DeclarePeriodicUnrestrictedUpdateEvent(early, offset, weak(self._release))

    def _release(self, context: Context, state: State) -> None:
        memory = self._of(state)
        self._change(memory, (self._taken(memory) - 1 + self._delay.fraction) * self._period)

    @abstractmethod
    def _send(self, memory: Array, number: int, command: Array) -> int:
        """Pass the command of a sample to the link; return the result of `Link.take`."""

    def _take(self, context: Context, state: State) -> None:
        # From `state`, which another event of this instant, an arrival, may have changed.
        memory = self._of(state)
        number = self._taken(memory)
        result = self._send(memory, number, self._commanded.Eval(context))
        assert result != NO_ROOM, "more commands are in flight than the link has places for"
        if self._at_samples:
            self._change(memory, number * self._period)

    def _change(self, memory: Array, time: float) -> None:
        if self._link.next_change(memory) <= time + SIMULTANEOUS * self._period:
            self._link.change(memory, time)

    def _of(self, state: Context | State) -> Array:
        if isinstance(state, State):
            return np.asarray(state.get_mutable_discrete_state(self._memory).get_mutable_value())
        return np.asarray(state.get_discrete_state(self._memory).value())

    def _taken(self, memory: Array) -> int:
        return int(self._link.number(memory, "offered"))

    def _put_out(self, name: str, columns: slice) -> None:
        """Declare an output: columns of [begin of its action; command] that acts."""
        size = len(range(*columns.indices(1 + self._link.size)))
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort(name, size, weak(self._output, columns), {ticket})

    def _output(self, columns: slice, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._link.acted(self._of(context))[0, columns])


def _times(name: str, values: Array, least: int = 0) -> Array:
    """Return times (n,) in s, infinite where nothing arrives; n is at least `least`."""
    times = np.asarray(values, np.float64)
    if times.ndim != 1 or len(times) < least or not np.all(times >= 0):
        raise ConfigError(
            f"{name}: got {brief(values)}; expected (n,) of at least 0 s, n of at least {least}"
        )
    return times


def begun(link: Link, delay: Delay, period: float, queue: Array) -> Array:
    """Return the memory of a link with a queue (L, size) in flight at t = 0, oldest first."""
    memory, first = link.start(), (delay.periods - len(queue)) * period
    link.assume(memory, *((first, queue[0]) if len(queue) else (np.nan, np.zeros(link.size))))
    link.preload(memory, first, queue)
    return memory


def wire_of(
    size: int, period: float, times: Array, queue: int = 0, limit: float = math.inf
) -> Link:
    """Return a wire for commands (size,) with transit times in s, and a queue at t = 0."""
    longest = times.max(initial=0.0, where=np.isfinite(times))
    places, tolerance = queue + int(longest / period) + 2, SIMULTANEOUS * period
    return Link(size, places, period, is_wire=True, time_tolerance=tolerance, limit=limit)


def buffer_of(
    period: float, delay: Delay, rows: int, dry: str, history: int, limit: float = math.inf
) -> Link:
    """Return a buffer for packets of `rows` torques; see `PlayoutBuffer`."""
    places = (delay.steps + rows + 2) * rows  # a packet counts until its last row was due
    return Link(
        NUM_TORQUES,
        places + delay.queue_length,
        period,
        is_wire=False,
        hold_when_dry=dry == "hold",
        history=history,
        time_tolerance=SIMULTANEOUS * period,
        limit=limit,
    )


class Wire(LinkSystem):
    """A link on which every command acts when it arrives."""

    def _lay(
        self, period: float, times: Array, delay: Delay, queue: Array, carries: Carried
    ) -> None:
        """Declare ports and state, for transit times in s."""
        one_of("carries", carries, list(CARRIED))
        link = wire_of(CARRIED[carries], period, times, delay.queue_length)
        self._begin(link, period, 1, delay, queue)
        self._put_out(carries, slice(1, None))
        if carries == "command":
            self._put_out("arrived", slice(0, 1))

    @abstractmethod
    def _arrival(self, number: int) -> float:
        """Return the arrival of the command of a sample, s."""

    def _send(self, memory: Array, number: int, command: Array) -> int:
        now, at = number * self._period, self._arrival(number)
        return self._link.take(memory, now, number + 1, at, command[None])


class DelayChain(Wire):
    """Delays torques by eta = mu dt + eta0.

    With T_k the input at t = k dt:

    Initialise: queue = [T_{-mu}, ..., T_{-1}], preceded by T_{-mu-1} when eta0 > 0; the oldest
                acts first.
    Update:     at k dt        T_k is in flight,
                at k dt + eta0 applied <- T_{k-mu}.
    Output:     torque = applied, hence T_k during [(k + mu) dt + eta0, (k + 1 + mu) dt + eta0).

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6, or n | N m | read every period |
    | torque, or `carries` | output | the same | N m | piecewise constant |
    | arrived | output | 1, with commands | s, arrival of the command; NaN before the first | same |

    Args:
        period: dt in s.
        steps: mu.
        fraction: eta0 / dt, in [0, 1).
        queue: (L, n) torques in flight at t = 0, oldest first, L = mu, or mu + 1 when eta0 > 0;
            zeros if None.
        carries: torques of six motors, or commands to servos.

    Raises:
        ValueError: a queue of the wrong shape.
    """

    def __init__(
        self,
        period: float,
        steps: int,
        fraction: float = 0.0,
        queue: Array | None = None,
        carries: Carried = "torque",
    ) -> None:
        super().__init__()
        period, delay = positive("period", period), Delay(steps, fraction)
        if queue is None:
            one_of("carries", carries, list(CARRIED))
            queue = np.zeros((delay.queue_length, CARRIED[carries]))
        self._lay(period, np.array([delay.eta(period)]), delay, queue, carries)
        self._release_between(delay)

    def _arrival(self, number: int) -> float:
        return (number + self._delay.periods) * self._period


class VaryingDelay(Wire):
    """Delays torque k by eta_k.

    With T_k the input at t = k dt, which arrives at a_k = k dt + eta_k:

    Initialise: T_{-L}, ..., T_{-1} are in flight and arrive at (k + mu) dt + eta0.
    Update:     at k dt        T_k is in flight,
                at a_k         applied <- T_k, unless a newer one has arrived before.
    Output:     torque = applied.

    A torque that was overtaken never acts (`scenario.link.takes_effect`). All arrivals are known
    beforehand. Each is a separate event, so that an integrator stops there.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6, or n | N m | read every period |
    | torque, or `carries` | output | the same | N m | piecewise constant |
    | arrived | output | 1, with commands | s, arrival of the command; NaN before the first | same |
    | delay | output | 1 | s, of the newest torque | held |
    | packets | output | 5 | 1, NaN: without packets | constant |

    Args:
        period: dt in s.
        delays: (n,) eta_k of T_0 to T_{n-1}, s; the last one holds for all later torques.
        delay: mu and eta0 / dt, of the torques sent before t = 0, such as
            `sd.systems.Delay(steps=5, fraction=0.5)`.
        queue: (L, n) torques in flight at t = 0, oldest first, L = mu, or mu + 1 when eta0 > 0.
        carries: as of `DelayChain`.

    Raises:
        ValueError: a queue of the wrong shape, a delay that is negative or NaN.
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
        of_kind("delay", delay, Delay)
        period, delays = positive("period", period), _times("delays", delays, 1)
        self._delays = np.where(delays > SIMULTANEOUS * period, delays, 0.0)
        self._lay(period, self._delays, delay, queue, carries)
        ticket = self.discrete_state_ticket(self._memory)
        self.DeclareVectorOutputPort("delay", 1, weak(self._newest_delay), {ticket})
        declare_constant(self, "packets", np.full(len(PACKETS), np.nan))
        numbers, times = releases(period, delays, delay)
        # The sample itself is the event of a torque that arrives as it is sent.
        for time in times[(times > 0) & (times != period * numbers)].tolist():
            arrive = weak(self._arrive, time)
            self.DeclarePeriodicUnrestrictedUpdateEvent(ONCE, event_time(time), arrive)

    def _arrival(self, number: int) -> float:
        return float(number * self._period + self._delays[min(number, len(self._delays) - 1)])

    def _arrive(self, time: float, context: Context, state: State) -> None:
        self._change(self._of(state), time)

    def _newest_delay(self, context: Context, output: BasicVector) -> None:
        sent = max(self._taken(self._of(context)), 1)
        output.SetFromVector([self._delays[min(sent, len(self._delays)) - 1]])


class PlayoutBuffer(LinkSystem):
    """Plays torques from packets at fixed times, independent of the packets' delays.

    Packet k, sent at t = k dt, arrives d_k later or never. Its row c is T_{k-r+c}, which acts from
    (k - r + c) dt + eta on, for a period, eta = mu dt + eta0. With j = s - mu:

    Update:  at k dt        packet k is in flight,
             at s dt + eta0 applied <- T_j of the newest packet with a row for it that has arrived;
                            queue, for j < 0; else the last torque or zero, see `dry`.
    Output:  torque = applied.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | commanded | input | 6 rows | N m, T_{k-r} first | read every period |
    | torque | output | 6 | N m | piecewise constant |
    | delay | output | 1 | s, eta | constant |
    | packets | output | 5 | counts, `scenario.signals.PACKETS` | piecewise constant |
    | report | output | history (1 + 6) | arrival of each of the last packets, 1 or 0, then the
      torques of the last periods, the newest first | to be read at samples |

    Args:
        period: dt in s.
        times: (n,) d_k in s, infinite for a lost packet; further ones are lost.
        delay: mu and eta0 / dt, as of `VaryingDelay`.
        queue: (L, 6) torques for j = -L to -1, L = mu, or mu + 1 when eta0 > 0.
        rows: torques in a packet.
        repeats: r, how many of them are of earlier samples.
        dry: output where no packet has a torque: `hold` the last one, or `zero`.
        history: periods in a report.

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
        of_kind("delay", delay, Delay)
        period, times = positive("period", period), _times("times", times)
        self._rows = whole("rows", rows, 1)
        self._repeats, history = whole("repeats", repeats, 0), whole("history", history, 1)
        one_of("dry", dry, ("hold", "zero"))
        self._arrivals = period * np.arange(len(times)) + times
        self._begin(buffer_of(period, delay, rows, dry, history), period, rows, delay, queue)
        self._put_out("torque", slice(1, None))
        declare_constant(self, "delay", np.array([delay.eta(period)]))
        memory, timed = self.discrete_state_ticket(self._memory), self.time_ticket()
        self.DeclareVectorOutputPort("packets", len(PACKETS), weak(self._count), {memory})
        size = history * (1 + NUM_TORQUES)
        self.DeclareVectorOutputPort("report", size, weak(self._report), {memory, timed})
        self._at_samples = delay.fraction == 0
        self._release_between(delay)

    def _send(self, memory: Array, number: int, command: Array) -> int:
        arrival = self._arrivals[number] if number < len(self._arrivals) else np.inf
        first = (number - self._repeats + self._delay.periods) * self._period
        packet = command.reshape(self._rows, NUM_TORQUES)
        now = number * self._period
        return self._link.take(memory, now, number + 1, first, packet, arrival)

    def _change(self, memory: Array, time: float) -> None:
        self._link.change(memory, time)  # every period begins, with a torque or dry

    def _count(self, context: Context, output: BasicVector) -> None:
        memory, period = self._of(context), self._period
        taken, last = self._taken(memory), self._link.number(memory, "last")
        begun = 0 if np.isinf(last) else round(last / period - self._delay.fraction) + 1
        lost = ~np.isfinite(self._arrivals[:taken])
        # Packets with a first row that is due in this period or before.
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


class LateMeasurements(LeafSystem):
    """Passes on, at each sample, the newest measurement that has arrived since the one before.

    With y_j measured at j dt, of transit time tau_j, and n_k the newest j with
    j dt + tau_j <= k dt:

    Update:  at k dt  y_k is in flight.
    Output:  measurement = y_{n_k}, age = (k - n_k) dt, where n_k is newer than n_{k-1}; else all
             NaN and age = 0. A measurement that was overtaken is dropped.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measured | input | size | as measured | read every period |
    | measurement | output | size | the same | to be read at samples |
    | age | output | 1 | s | the same |

    Args:
        period: dt in s.
        times: (n,) tau_j in s, infinite for a lost one; further ones are lost.
    """

    def __init__(self, period: float, times: Array, size: int) -> None:
        super().__init__()
        self._times, self._period = _times("times", times), positive("period", period)
        self._link = wire_of(whole("size", size, 1), period, self._times)
        self._memory = self.DeclareDiscreteState(self._link.start())
        self._measured = self.DeclareVectorInputPort("measured", size)
        self.DeclareVectorOutputPort("measurement", size, weak(self._measurement))
        self.DeclareVectorOutputPort("age", 1, weak(self._age))
        update_every(self, period, self._take)

    def _now(self, context: Context) -> Array:
        """Return the memory of the link with the present measurement, whether taken or not."""
        memory = np.array(context.get_discrete_state(self._memory).value())
        k = round(context.get_time() / self._period)
        if self._link.number(memory, "offered") == k:
            waits = self._times[k] if k < len(self._times) else np.inf
            now, y = k * self._period, np.asarray(self._measured.Eval(context))
            self._link.take(memory, now, k + 1, now + waits, y[None])
            if self._link.next_change(memory) <= now + SIMULTANEOUS * self._period:
                self._link.change(memory, now)
        return memory

    def _take(self, context: Context, state: State) -> None:
        state.get_mutable_discrete_state(self._memory).SetFromVector(self._now(context))

    def _given(self, memory: Array) -> Array | None:
        """Return the measurement that arrived in the last period, or None."""
        arrived, begun = self._link.acted(memory)[0], self._link.number(memory, "offered") - 2
        there = self._link.number(memory, "acted") > 0
        new = arrived[0] > (begun + SIMULTANEOUS) * self._period
        return arrived[1:] if there and new else None

    def _measurement(self, context: Context, output: BasicVector) -> None:
        given = self._given(self._now(context))
        output.SetFromVector(np.full(self._link.size, np.nan) if given is None else given)

    def _age(self, context: Context, output: BasicVector) -> None:
        memory = self._now(context)
        behind = self._link.number(memory, "offered") - self._link.number(memory, "newest")
        output.SetFromVector([0.0 if self._given(memory) is None else behind * self._period])
