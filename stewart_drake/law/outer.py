"""Bases of the laws that step the free predictive law and change the torque that it sends."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from stewart_drake.law.core_law import serving
from stewart_drake.law.predictive_lqi import PredictiveLqi


@dataclass(frozen=True)
class OuterLqi(PredictiveLqi):
    """`PredictiveLqi` around the free law of the same parts."""

    @cached_property
    def free(self) -> PredictiveLqi:
        """The law without what this one adds."""
        return PredictiveLqi(**self.parts)

    @cached_property
    def _served(self) -> Any:
        return serving(self.free).law


@dataclass(frozen=True)
class OuterMemory:
    """Memory of an `OuterLqi`; other names are those of the free law's memory.

    Attributes:
        free: memory of the free law.
    """

    free: Any

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "free":
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.free, name)
