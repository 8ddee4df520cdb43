"""What a tuner decides by: numbers made of what the law remembers, by the name of their kind.

Features keep a window of rows, one for each of the last 31 samples, the newest last. A row is made
of two memories of the law, before and after a sample, so that whatever steps the law, in Drake, in
the loop without it, in Python or in C, gives the same numbers.
"""

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from stewart_drake.law.native_law import AnyMemory
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.tuner.density import NUM_INPUTS, WINDOW, Kind, density
from stewart_drake.types import Array


class Features(Protocol):
    """What becomes of memories, and what becomes of that."""

    @property
    def size(self) -> int:
        """Of a row."""

    def row(
        self, last: Array, before: AnyMemory, after: AnyMemory, wanted: Array, ratio: float
    ) -> Array:
        """(size,) of a sample.

        Args:
            last: (size,) of the sample before.
            before: what the law remembered at the sample before.
            after: what it remembers since this one.
            wanted: (12,) pose and rates of the reference at the sample.
            ratio: log10(w_Q / w_R) that was used.
        """

    def values(self, window: Array) -> Array:
        """(18,) of a window (31, size), whose rows are NaN before the first sample."""


@dataclass(frozen=True)
class DensityFeatures:
    """The paper's densities (45), `tuner.density`.

    Attributes:
        kind: of density.
    """

    kind: Kind = "magnitude"

    @property
    def size(self) -> int:
        """12 errors and 6 torques."""
        return NUM_INPUTS

    def row(
        self, last: Array, before: AnyMemory, after: AnyMemory, wanted: Array, ratio: float
    ) -> Array:
        """[y - r; T]; where the state is not measured, its estimate stands for it."""
        measured = after.measurement
        state = measured if len(measured) == NUM_STATE else after.belief.state
        return np.concatenate([state - wanted, after.torque])

    def values(self, window: Array) -> Array:
        """Of the newest sample."""
        return density(window, self.kind)


LOWEST: Final = -6.0
HIGHEST: Final = 4.0
"""Bounds of a logarithm among the features: those of runs that are being lost grow without any."""


def log10_within(value: float) -> float:
    """log10 of a number of at least 0, within the bounds; the lower one for NaN."""
    return min(max(math.log10(value), LOWEST), HIGHEST) if value > 0 else LOWEST


def empty_window(features: Features) -> Array:
    """Before the first sample."""
    return np.full((WINDOW, features.size), np.nan)
