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
from stewart_drake.scenario.signals import NUM_TORQUES

Array = NDArray[np.float64]

SURE: Final = 2.0
"""Times as probable as what was decided is what the law changes its mind for. A change makes it
correct what it thinks has gone wrong, and correct that again if it has not."""


@dataclass(frozen=True)
class Report:
    """What the machine says of packets and torques, with a measurement.

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
    """What a channel remembers.

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
        """What is known of packets, and the torques (n, 6) in flight as they now seem to be.

        Args:
            sent: after the last sample.
            in_flight: as they seemed to be then.
            timeline: the delay from computing a torque to its time.
            report: that came with this sample's measurement, or None.
        """
        ...

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        """With the packet of a plan (N, 6) too; `in_flight` (n, 6) before its first torque."""
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
        """What was sent."""
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
        in_time: per row, the probability that a packet has arrived by the row's time.
        arrived_by: the same by so many periods after it was sent, 0 among them; as many packets are
            remembered.
        holds: whether a dry buffer holds the last torque, or puts out zero.
        told: periods that a report looks back: of older packets that had not arrived by then it
            does not tell whether they have since.
    """

    torques: int
    repeats: int
    in_time: tuple[float, ...]
    arrived_by: tuple[float, ...]
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
        for d in reversed(range(last)):
            if np.isnan(sent.packets[-1 - d, 0, 0]):
                continue  # under way since before the first sample
            torque = self._expected(sent.packets, arrived, d, since)
            if torque is None:
                torque = flying[-2 - d] if self.holds else np.zeros(NUM_TORQUES)
            flying[-1 - d] = torque
        return replace(sent, arrived=arrived, since=since), flying

    def _expected(
        self, packets: Array, arrived: NDArray[np.bool_], d: int, since: int
    ) -> Array | None:
        """What will most probably act as T_{k-1-d}; None for a dry buffer.

        The newest packet that is there decides. With p_i the probability that packet i is, what it
        says acts with p_i prod (1 - p) over the newer ones; repetitions say the same, and add up.
        What was decided counts SURE times.
        """
        kept, left, chances = len(packets), 1.0, list[tuple[float, Array | None]]()
        decided = 0.0
        for row in range(max(0, self.repeats - d), len(self.in_time)):
            i = row + 1 + d - self.repeats  # samples since the packet was sent
            if i > kept or np.isnan(packets[-i, row, 0]):
                break
            here = 1.0 if arrived[-i] else self.in_time[row]
            if since < kept and i > since and not arrived[-i]:
                # Bayes: it had not arrived when the report was made.
                before = self.arrived_by[min(i - since, self.told)]
                here = max(0.0, here - before) / (1 - before) if before < 1 else 0.0
            if row <= self.repeats:
                decided += left * here
                chances = [(SURE * decided, packets[-i, row])]
            else:
                chances.append((left * here, packets[-i, row]))
            left *= 1 - here
        return max([*chances, (left, None)], key=lambda chance: chance[0])[1]

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        """See `Channel.send`."""
        repeated = sent.packets[-1, 1 : self.repeats + 1]
        if np.isnan(sent.packets[-1, 0, 0]):
            repeated = in_flight[len(in_flight) - self.repeats :]
        packet = np.vstack([repeated, plan])
        packets = np.concatenate([sent.packets[1:], packet[None]])
        return replace(sent, packets=packets, arrived=np.append(sent.arrived[1:], False))
