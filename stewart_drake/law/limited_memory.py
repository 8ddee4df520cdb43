"""Memory of a law with limits: that of the law without them, its last plan, and its counts."""

from dataclasses import dataclass, replace
from typing import Any

from stewart_drake.law.horizon import Plan
from stewart_drake.law.memory import Counts
from stewart_drake.law.outer import OuterMemory


@dataclass(frozen=True)
class LimitedMemory(OuterMemory):
    """Memory of `law.limited.LimitedLqi`; other names are those of the free law's memory.

    Attributes:
        free: memory of the law without limits, with the torques that were sent.
        plan: last plan, where the limits did bind at the last sample, else None.
        limited_steps, qp_failures, qp_late: as of `law.memory.Counts`.
    """

    plan: Plan | None = None
    limited_steps: int = 0
    qp_failures: int = 0
    qp_late: int = 0

    @property
    def counts(self) -> Counts:
        """Numbers of survived problems, by cause."""
        counts: Counts = self.free.counts
        return counts._replace(
            limited_steps=self.limited_steps, qp_failures=self.qp_failures, qp_late=self.qp_late
        )

    def following(self, free: Any) -> "LimitedMemory":
        """Return the memory after a sample in which the free law's torque was sent."""
        return replace(self, free=free, plan=None)

    def limited(self, free: Any, plan: Plan | None, cause: str | None) -> "LimitedMemory":
        """Return the memory after a sample with a plan, or without one for a cause."""
        after = replace(self, free=free, plan=plan, limited_steps=self.limited_steps + 1)
        return after if cause is None else replace(after, **{cause: getattr(self, cause) + 1})

    def without_error(self) -> "LimitedMemory":
        """Return the memory with error and integral reset."""
        return replace(self, free=self.free.without_error())
