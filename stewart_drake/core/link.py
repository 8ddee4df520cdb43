"""The link of core/link.h: a wire, or a buffer in which commands wait for their times."""

import math
from typing import Any, Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.types import Array

NO_ROOM: Final = 1
"""Result of `Link.take` if the memory is full."""


class Link:
    """State machine of events. Its memory, a vector of numbers, is the caller's.

    Args:
        size: numbers of a command.
        max_waiting: greatest number of waiting commands.
        period: from each command of a plan to the next, in the unit of all times.
        is_wire: whether commands act when they arrive.
        hold_when_dry: whether a dry buffer holds the last command, or puts out zero.
        history: number of past commands in memory.
        time_tolerance: times closer than this are equal.
        limit: greatest absolute value of each number of a command.
    """

    def __init__(
        self,
        size: int,
        max_waiting: int,
        period: float,
        *,
        is_wire: bool,
        hold_when_dry: bool = True,
        history: int = 1,
        time_tolerance: float = 0.0,
        limit: float = math.inf,
    ) -> None:
        c = core()
        self._core, self.size, self.history = c, size, history
        values = (
            *(size, max_waiting, history, is_wire, hold_when_dry),
            *(period, time_tolerance, limit),
        )
        self.data: Any = c.ffi.new("stewart_link *", values)

    def _call(self, name: str, *given: Any) -> Any:
        return self._core.call(f"link_{name}", self.data, *given)

    def start(self) -> Array:
        """Return the memory of an empty link."""
        memory = np.empty(self._call("memory"))
        self._call("start", memory)
        return memory

    def assume(self, memory: Array, time: float, command: Array) -> None:
        """Set the command (size,) that has acted since a time."""
        self._call("assume", memory, time, np.array(command, np.float64))

    def preload(self, memory: Array, first: float, commands: Array) -> None:
        """Queue commands (n, size) for `first`, a period later, and so on."""
        self._call("preload", memory, first, len(commands), np.array(commands, np.float64))

    def take(
        self,
        memory: Array,
        now: float,
        sequence: float,
        first: float,
        commands: Array,
        arrival: float = -math.inf,
    ) -> int:
        """Take a plan (n, size), see core/link.h. Return 0, or the reason for its refusal."""
        given = now, sequence, arrival, first, len(commands), np.array(commands, np.float64)
        return int(self._call("take", memory, *given))

    def next_change(self, memory: Array) -> float:
        """Return when `change` is to be called next, or infinity."""
        return float(self._call("next", memory))

    def change(self, memory: Array, time: float) -> None:
        """Let the command act that is due at a time."""
        self._call("change", memory, time)

    def reset(self, memory: Array, time: float, holds: bool) -> None:
        """Drop waiting commands, and hold the last command or put out zero."""
        self._call("reset", memory, time, holds)

    def acted(self, memory: Array) -> Array:
        """Return a view (h, 1 + size) of past commands, each after its time, the newest first."""
        begin = self._core.lib.STEWART_LINK_COMMANDS
        return memory[begin : begin + self.history * (1 + self.size)].reshape(self.history, -1)

    def number(self, memory: Array, name: str) -> float:
        """Return a number of the memory by its name in core/link.h, for example `offered`."""
        return float(memory[getattr(self._core.lib, f"STEWART_LINK_{name.upper()}")])
