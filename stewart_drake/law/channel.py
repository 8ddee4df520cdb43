"""Channel to the motors: single torques over a wire, or plans in packets over a network.

Packet k carries the torques of `repeats` earlier samples again, then T_k and the planned torques of
further samples. Which packets arrive in time is not known in advance; of earlier packets it is
known from the last report. The law assumes the torques that the buffer will *most probably* play.
Their average would be worse, since the buffer never plays it.
"""

import sys
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.library import core
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.packets import NO_LOSSES, BurstChain
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array


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
        memory: (1 + n + 6 n rows,) flat, as of core/packets.h; n = 0 without packets.
        rows: of a packet.
    """

    memory: Array
    rows: int = 1

    @property
    def packets(self) -> Array:
        """Last packets (n, rows, 6), the newest last; NaN before the first."""
        kept = (len(self.memory) - 1) // (1 + NUM_TORQUES * self.rows)
        return self.memory[1 + kept :].reshape(kept, self.rows, NUM_TORQUES)


class Channel(Protocol):
    """A kind of channel. Instances are immutable."""

    @property
    def torques(self) -> int:
        """Number N of torques that are planned at each sample."""
        ...

    def start(self) -> Sent:
        """Return the memory before the first sample."""
        ...

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        """Return the updated memory and the most probable torques (n, 6) in flight.

        Args:
            sent: after the last sample.
            in_flight: (n, 6) as assumed then.
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
        return 1

    def start(self) -> Sent:
        return Sent(np.zeros(1))

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        return sent, in_flight

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        return sent


@dataclass(frozen=True)
class Packets:
    """Plans over a network, with a buffer at the machine.

    Attributes:
        torques: N.
        repeats: r, number of earlier torques that a packet carries again.
        in_time: per row, the probability that a packet which is not lost has arrived by the row's
            time.
        arrived_by: the same after 0, 1, ... periods, for all packets that are remembered.
        losses: Markov chain of the packets that are lost.
        holds: whether an empty buffer holds the last torque, or puts out zero.
        told: periods that a report covers. The later arrival of older packets is not reported.
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
        c, channel = core(), structure(self)
        memory = np.empty(c.lib.stewart_packets_memory(channel))
        c.lib.stewart_packets_start(channel, c.at(memory))
        return Sent(memory, len(self.in_time))

    def in_flight(
        self, sent: Sent, in_flight: Array, timeline: Timeline, report: Report | None
    ) -> tuple[Sent, Array]:
        c, channel = core(), structure(self)
        memory, flying = sent.memory.copy(), in_flight.copy()
        told = None if report is None else report_of(report)
        data = c.ffi.NULL if told is None else told.data
        c.lib.stewart_packets_update(
            *(channel, c.at(memory), data, timeline.steps, len(flying), c.at(flying)),
            c.scratch(c.lib.stewart_packets_scratch(channel)),
        )
        return Sent(memory, sent.rows), flying

    def send(self, sent: Sent, plan: Array, in_flight: Array) -> Sent:
        c, memory = core(), sent.memory.copy()
        given = np.array(plan, np.float64), np.array(in_flight, np.float64)
        c.lib.stewart_packets_send(
            structure(self), c.at(memory), c.at(given[0]), len(in_flight), c.at(given[1])
        )
        return Sent(memory, sent.rows)


class ReportData(NamedTuple):
    """A `stewart_report *` with the arrays that it points to."""

    data: Any
    arrived: Array
    acted: Array


def report_of(report: Report) -> ReportData:
    """Return a report for the core."""
    c = core()
    arrived, acted = report.arrived.astype(np.float64), np.array(report.acted, np.float64)
    values = len(arrived), c.at(arrived), len(acted), c.at(acted), report.age
    return ReportData(c.ffi.new("stewart_report *", values), arrived, acted)


def structure(channel: Packets) -> Any:
    """Return the `stewart_packets` of core/packets.h."""
    return structures(channel)[0]


@lru_cache(maxsize=64)
def structures(channel: Packets) -> tuple[Any, ...]:
    """Return the `stewart_packets` with the arrays that it points to."""
    c, kept = core(), len(channel.arrived_by)
    shares = np.array(channel.in_time), np.array(channel.arrived_by)
    values = {
        "torques": channel.torques,
        "repeats": channel.repeats,
        "kept": kept,
        "told": min(channel.told, kept),
        "holds": channel.holds,
        "burst": channel.losses.burst,
        "loss": channel.losses.loss,
        "in_time": c.at(shares[0]),
        "arrived_by": c.at(shares[1]),
    }
    return c.ffi.new("stewart_packets *", values), *shares
