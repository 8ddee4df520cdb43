"""The way back onto a reference after a gap in it, from the preview alone.

A preview ends one period after the hold of the next torque, so that a plan that ends on the
reference (`law.catch_up`) cannot be made from it. Instead the law follows the reference plus an
offset d = [pose; rates], which begins where the plate will be when the next torque begins to act
and is zero after some holds, with the least accelerations: see core/reference.h.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE
from stewart_drake.types import Array


@dataclass(frozen=True)
class ReturnPath:
    """Offset from the reference, from the instant on at which the next torque begins to act.

    Attributes:
        offset: (12,) of pose and rates at that instant.
        holds: number of holds until it is zero.
        samples: number of samples after that until no torque of the way back is in flight.
    """

    offset: Array = field(default_factory=lambda: np.zeros(NUM_STATE))
    holds: int = 0
    samples: int = 0

    @classmethod
    def of(cls, offset: Array, timeline: Timeline) -> "ReturnPath":
        """Return the path that takes DEFAULT_CATCH_UP seconds, or two holds."""
        c, way = core(), cls()._in_c()
        given = c.at(np.array(offset, np.float64)), timeline.period, timeline.queue_length
        c.lib.stewart_begin_way_back(*given, way)
        return cls._of(way)

    @property
    def active(self) -> bool:
        """Whether something else is followed than the reference."""
        return self.holds + self.samples > 0

    def after(self, h: float) -> "ReturnPath":
        """Return the rest of it, one hold of `h` s later."""
        way = self._in_c()
        core().lib.stewart_go_on_way_back(way, h)
        return self._of(way)

    def at(self, time: float, h: float) -> Array:
        """Return the offset (18,) of pose, rates and accelerations `time` s after its beginning."""
        c, row = core(), np.zeros(NUM_REFERENCE)
        c.lib.stewart_add_offset(self._in_c()[0], h, time, c.at(row))
        return row

    def _in_c(self) -> Any:
        values = self.offset.tolist(), self.holds, self.samples
        return core().ffi.new("stewart_way_back *", values)

    @classmethod
    def _of(cls, way: Any) -> "ReturnPath":
        return cls(np.array(list(way.offset)), way.holds, way.samples)
