"""Measurement of one instant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stewart_drake.types import Array


@dataclass(frozen=True)
class Measurement:
    """Values of one sample; some may be missing.

    Attributes:
        values: (m,) in the units of the sensing; meaningless where not valid.
        valid: (m,) which of them are there.
        age: s since they were taken.
    """

    values: Array
    valid: NDArray[np.bool_]
    age: float = 0.0

    @classmethod
    def of(cls, values: Array, age: float = 0.0) -> "Measurement":
        """Return a measurement from values (m,), with missing ones that are not finite."""
        values = np.array(values, np.float64)
        return cls(values, np.isfinite(values), age)

    @property
    def complete(self) -> bool:
        """Whether every value is there."""
        return bool(np.all(self.valid))

    def known(self, size: int) -> Array:
        """Return the values (size,), NaN for the missing ones.

        Raises:
            ValueError: another number of values.
        """
        values = np.where(self.valid, self.values, np.nan)
        if values.shape != (size,):
            raise ValueError(f"measurement: got shape {values.shape}; expected {(size,)}")
        return values

    def missing(self) -> "Measurement":
        """Return a measurement of the same size without any value."""
        return Measurement(self.values, np.zeros_like(self.valid))
