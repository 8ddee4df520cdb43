"""Whether a machine's reports of what has acted fit what was sent."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from stewart_drake.types import Array

_ROWS: Final = 8
"""Rows in a row that must be off by a period before it is said."""
_KEPT: Final = 64
"""Periods for which the torques that were sent are remembered."""


class ReportCheck:
    """Compares rows of `acted` with the torques that were sent for their periods.

    Args:
        limit: of each motor at the machine, N m.
    """

    def __init__(self, limit: float) -> None:
        self._limit = limit
        self._sent: dict[int, list[Array]] = {}
        self._off: dict[int, int] = {-1: 0, 1: 0}
        self._looked_at = -1

    def sent(self, first: int, rows: Array) -> None:
        """Note torques (n, 6) for the periods from `first` on."""
        for i, row in enumerate(np.clip(rows, -self._limit, self._limit)):
            self._sent.setdefault(first + i, []).append(row)
        for old in [n for n in self._sent if n < first - _KEPT]:
            del self._sent[old]

    def problem(self, acted: Mapping[int, Array]) -> str | None:
        """Say that torques were reported a period too early or too late, or return None.

        Args:
            acted: (6,) torques by the number of their period.
        """
        for number in sorted(n for n in acted if n > self._looked_at):
            self._looked_at = number
            here = self._was_sent(number, acted[number])
            for shift in self._off:
                off = not here and self._was_sent(number + shift, acted[number])
                self._off[shift] = self._off[shift] + 1 if off else 0
        for shift, rows in self._off.items():
            if rows >= _ROWS:
                early, after = ("early", "after") if shift > 0 else ("late", "before")
                return (
                    f"acted_from in the machine's datagrams is one period {early}: its last {_ROWS}"
                    f" rows of torques were sent for the period {after}"
                )
        return None

    def _was_sent(self, number: int, torque: Array) -> bool:
        return any(np.array_equal(row, torque) for row in self._sent.get(number, []))
