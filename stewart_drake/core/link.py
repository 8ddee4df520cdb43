"""The link of core/link.h: a wire, or a buffer in which commands wait for their times."""

import math
from typing import Any, Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.types import Array

NO_ROOM: Final = 1
"""Result of `Link.take` if the memory is full."""


class Link:
    """Functions of a link. Its state is a vector of numbers, `memory`, that the caller keeps.

    Args:
        size: numbers of a command.
        max_waiting: greatest number of waiting commands.
        period: time between the commands of a plan, in any unit, which is that of all times here.
        is_wire: whether it is a wire, on which commands act when they arrive, or a buffer.
        hold_when_dry: whether a buffer without a command for its period (dry) holds the last one,
            or puts out zero.
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
        self.data: Any = c.ffi.new(
            "stewart_link *",
            {
                "size": size,
                "max_waiting": max_waiting,
                "history": history,
                "is_wire": is_wire,
                "hold_when_dry": hold_when_dry,
                "period": period,
                "time_tolerance": time_tolerance,
                "limit": limit,
            },
        )

    def _call(self, name: str, *arguments: Any) -> Any:
        return self._core.call(f"link_{name}", self.data, *arguments)

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
        rows = np.array(commands, np.float64)
        return int(self._call("take", memory, now, sequence, arrival, first, len(rows), rows))

    def next_change(self, memory: Array) -> float:
        """Return when `change` is to be called next, or infinity."""
        return float(self._call("next", memory))

    def change(self, memory: Array, time: float) -> None:
        """Let the newest command that is due at a time act; a buffer without one goes dry."""
        self._call("change", memory, time)

    def reset(self, memory: Array, time: float, holds: bool, keeps: bool = False) -> None:
        """Hold the last command or put out zero; drop the waiting commands unless `keeps`."""
        self._call("reset", memory, time, holds, keeps)

    def acted(self, memory: Array) -> Array:
        """Return a view (h, 1 + size) of past commands, each after its time, the newest first."""
        begin = self._core.lib.STEWART_LINK_COMMANDS
        return memory[begin : begin + self.history * (1 + self.size)].reshape(self.history, -1)

    def number(self, memory: Array, name: str) -> float:
        """Return a number of the memory; `offered` is STEWART_LINK_OFFERED of core/link.h."""
        return float(memory[getattr(self._core.lib, f"STEWART_LINK_{name.upper()}")])
