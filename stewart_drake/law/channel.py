"""How torques get to the motors: one by one over a wire, or as plans in packets.

Packet k has the torques of `repeats` earlier samples, word for word, then T_k and what would follow
it if all went as predicted. Which packets are there when their torques are due is not known in
advance, and of those before only as of the last report. The law goes on what the buffer will *most
probably* play: averaging over what it might play is worse, as it will never play the average.
"""

import sys
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.packets import NO_LOSSES, BurstChain
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

SURE: Final = 2.0
"""Times as probable as what was decided is what the law changes its mind for. A change makes it
correct what it thinks has gone wrong, and correct that again if it has not."""
_LEAST: Final = 1e-9
"""Probability of a packet that is later than any, so that no report is impossible."""


@dataclass(frozen=True)
class Report:
    """Report of the machine on packets and torques, sent with a measurement.

    Attributes:
        arrived: (n,) whether the packet sent i + 1 samples before the report's has arrived.
        acted: (n, 6) torque that acted i + 1 periods before the report's sample.
        age: periods since the report's sample.
    """

    arrived: NDArray[np.bool_]
    acted: Array
    age: int = 0


@dataclass(frozen=True)
class Sent:
    """Memory of a channel.

    Attributes:
        packets: (n, rows, 6) last packets, the newest last; NaN before there were any.
        arrived: (n,) whether each is known to have arrived.
        since: periods since the last report; as many as packets where there was none.
    """

    packets: Array
    arrived: NDArray[np.bool_]
    since: int = 0


class Channel(Protocol):
    """A kind of channel. Instances are immutable."""

    @property
    def torques(self) -> int:
        """N, how many torques are planned at each sample."""
        ...

    def start(self) -> Sent:
        """Before the first sample."""
        ...

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        """Return the updated memory and the most probable torques (n, 6) in flight.

        Args:
            sent: after the last sample.
            in_flight: as they seemed to be then.
            timeline: the delay from computing a torque to its time.
            report: that came with this sample's measurement, or None.
        """
        ...

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        """Return the memory with the packet of a plan (N, 6); `in_flight` (n, 6) before it."""
        ...


@dataclass(frozen=True)
class Wire:
    """Every torque arrives, after the delay."""

    @property
    def torques(self) -> int:
        """One."""
        return 1

    def start(self) -> Sent:
        """Nothing is to be remembered."""
        return Sent(np.empty((0, 1, NUM_TORQUES)), np.empty(0, dtype=bool))

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        """Return what was sent."""
        return sent, in_flight

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        """Nothing is to be remembered."""
        return sent


@dataclass(frozen=True)
class Packets:
    """Plans over a network, with a buffer at the machine.

    Attributes:
        torques: N.
        repeats: r, how many earlier torques a packet says again.
        in_time: per row, the probability that a packet which is not lost has arrived by the row's
            time.
        arrived_by: the same after 0, 1, ... periods; its length is the number of packets that are
            remembered.
        losses: Markov chain of the packets that are lost.
        holds: whether a dry buffer holds the last torque, or puts out zero.
        told: periods that a report looks back: of older packets that had not arrived by then it
            does not tell whether they have since.
    """

    torques: int
    repeats: int
    in_time: tuple[float, ...]
    arrived_by: tuple[float, ...]
    losses: BurstChain = NO_LOSSES
    holds: bool = True
    told: int = sys.maxsize

    def __post_init__(self) -> None:
        if len(self.in_time) != self.repeats + self.torques:
            raise ValueError(
                f"in_time: got {len(self.in_time)} values; expected {self.repeats + self.torques}, "
                "one per row of a packet"
            )

    def start(self) -> Sent:
        """See `Channel.start`."""
        kept, rows = len(self.arrived_by), len(self.in_time)
        packets = np.full((kept, rows, NUM_TORQUES), np.nan)
        return Sent(packets, np.zeros(kept, dtype=bool), kept)

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        """See `Channel.in_flight`.

        T_{k-1-d} begins to act mu - 1 - d periods and eta0 from now. With a report that is m
        periods old, all that began before it is known, d >= m + mu; the others are `_expected`.
        """
        kept, flying, arrived = len(sent.packets), in_flight.copy(), sent.arrived.copy()
        since = min(sent.since + 1, kept) if report is None else min(report.age, kept)
        if report is not None:
            for i, there in enumerate(report.arrived[: kept - since], start=1):
                arrived[-i - since] |= there
            acted = report.acted[: max(0, len(flying) - since - timeline.steps)]
            for d, torque in enumerate(acted, start=since + timeline.steps):
                flying[-1 - d] = torque
        last = min(since + timeline.steps, kept, len(flying) - 1)
        known = kept - int(np.isnan(sent.packets[:, 0, 0]).sum())
        chances = self._chances(arrived[kept - known :], since, last)
        for d in reversed(range(min(last, known))):  # others are from before the first sample
            torque = self._expected(sent.packets, chances[d], d)
            if torque is None:
                torque = flying[-2 - d] if self.holds else np.zeros(NUM_TORQUES)
            flying[-1 - d] = torque
        return replace(sent, arrived=arrived, since=since), flying

    def _chances(self, arrived: NDArray[np.bool_], since: int, last: int) -> Array:
        """Return the probabilities (last, n + 1) of the sources of T_{k-1-d}, d = 0 to last - 1.

        Column i < n: the packet sent i + 1 samples ago is in time and no newer one is; column n: no
        packet is. The losses are the hidden states of a Markov chain, so that this is its
        forward-backward algorithm. With the evidence E_i on packet i (arrived, or not by the last
        report), older packets give P(state of i | E of older ones) and c_i = P(E_i | the same), the
        newer ones, backwards, P(E and not in time for all newer ones | state of i).

        Args:
            arrived: (n,) whether each packet is known to have arrived, the newest last.
            since: periods since the last report.
            last: number of torques.
        """
        rows, chain, there = len(self.in_time), self.losses, arrived[::-1]
        # An arrived packet ends all bursts: newer packets do not depend on older ones.
        relevant = max(0, min(last + self.torques, len(there)) - 1)
        n = next((i + 1 for i in range(relevant, len(there)) if there[i]), len(there))
        there, ago = there[:n], np.arange(1, n + 1)
        # If it is not lost: the probability that it had not arrived by the report ...
        told = np.minimum(np.maximum(ago - since, 0), self.told)
        reported = (ago > since) & ~there & (since < len(self.arrived_by))
        absent = np.where(reported, 1 - np.take(self.arrived_by, told), 1.0)
        # ... and that it is not in time, where it has a row for this torque.
        row = ago - 1 - np.arange(last)[:, None] + self.repeats
        due = np.where(there, 1.0, np.take(self.in_time, np.clip(row, 0, rows - 1)))
        late = np.where((row >= 0) & (row < rows), 1 - due, absent)
        absent = np.maximum(absent, _LEAST)
        late = np.clip(late, np.where(there, 0.0, _LEAST), absent)

        state, before, evidence = chain.stationary, np.empty(n), np.empty(n)
        for i in reversed(range(n)):
            before[i] = state[-1]
            state = state * ~there[i]
            state[-1] = absent[i] * before[i]
            evidence[i] = state.sum()
            state = chain.after(state / evidence[i])
        newer, chances = np.ones((last, chain.burst + 1)), np.empty((last, n + 1))
        for i in range(n):
            chances[:, i] = newer[:, -1]
            newer = newer * (~there[i] / evidence[i])
            newer[:, -1] = late[:, i] / evidence[i] * chances[:, i]
            if i < n - 1:
                newer = chain.before(newer)
        chances[:, :n] *= before * (absent - late) / evidence
        chances[:, n] = newer @ chain.stationary
        return chances

    def _expected(self, packets: Array, chances: Array, d: int) -> Array | None:
        """Return what most probably acts as T_{k-1-d}; None for a dry buffer.

        Repetitions say the same, so that their probabilities add up. What was decided counts SURE
        times.
        """
        n, r = len(chances) - 1, self.repeats
        decided = SURE * chances[max(0, d - r) : d + 1].sum()
        best = [(decided, packets[-1 - d, r]), (chances[n], None)]
        plans = range(d + 1, min(d + self.torques, n))
        best[1:1] = [(chances[i], packets[-1 - i, r + i - d]) for i in plans]
        return max(best, key=lambda chance: chance[0])[1]

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        """See `Channel.send`."""
        repeated = sent.packets[-1, 1 : self.repeats + 1]
        if np.isnan(sent.packets[-1, 0, 0]):
            repeated = in_flight[len(in_flight) - self.repeats :]
        packet = np.vstack([repeated, plan])
        packets = np.concatenate([sent.packets[1:], packet[None]])
        return replace(sent, packets=packets, arrived=np.append(sent.arrived[1:], False))
