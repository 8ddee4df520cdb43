"""Channel to the motors: single torques over a wire, or plans in packets over a network.

The law assumes the torques that the buffer will most probably play, see core/packets.h.
"""

import sys
from dataclasses import dataclass
from typing import Protocol

from stewart_drake.core.library import core
from stewart_drake.law.compiled import Compiled, Once, numbers
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.packets import NO_LOSSES, BurstChain
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array, Flags


@dataclass(frozen=True)
class Report:
    """Report of the machine on packets and torques, sent with a measurement.

    Attributes:
        arrived: (n,) whether the packet sent i + 1 samples before the report's has arrived.
        acted: (n, 6) torque that acted i + 1 periods before the report's sample.
        age: periods since the report's sample.
    """

    arrived: Flags
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
        number = (len(self.memory) - 1) // (1 + NUM_TORQUES * self.rows)
        return self.memory[1 + number :].reshape(number, self.rows, NUM_TORQUES)


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

    torques = 1  # not annotated: no field


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
        report_periods: number that a report covers. A later arrival of older packets is not
            reported.
    """

    torques: int
    repeats: int
    in_time: tuple[float, ...]
    arrived_by: tuple[float, ...]
    losses: BurstChain = NO_LOSSES
    holds: bool = True
    report_periods: int = sys.maxsize

    def __post_init__(self) -> None:
        if len(self.in_time) != self.repeats + self.torques:
            raise ValueError(
                f"in_time: got {len(self.in_time)} values; expected {self.repeats + self.torques}, "
                "one per row of a packet"
            )


def report_of(report: Report | None) -> Compiled:
    """Return the `stewart_report *`, NULL for None."""
    c = core()
    if report is None:
        return Compiled(c.ffi.NULL)
    arrived, acted = numbers(report.arrived), numbers(report.acted)
    values = len(arrived), c.at(arrived), len(acted), c.at(acted), report.age
    return Compiled(c.ffi.new("stewart_report *", values), (arrived, acted))


@Once
def packets_of(channel: Packets) -> Compiled:
    c, num_packets = core(), len(channel.arrived_by)
    shares = numbers(channel.in_time), numbers(channel.arrived_by)
    values = {
        "torques": channel.torques,
        "repeats": channel.repeats,
        "num_packets": num_packets,
        "report_periods": min(channel.report_periods, num_packets),
        "holds": channel.holds,
        "burst": channel.losses.burst,
        "loss": channel.losses.loss,
        "in_time": c.at(shares[0]),
        "arrived_by": c.at(shares[1]),
    }
    return Compiled(c.ffi.new("stewart_packets *", values), shares)
