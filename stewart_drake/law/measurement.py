"""What a sensor says at one instant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stewart_drake.types import Array


@dataclass(frozen=True)
class Measurement:
    """Values of one sample; what is lost is marked, not left to a number to tell.

    Attributes:
        values: (m,) in the units of the sensing; means nothing where it is not valid.
        valid: (m,) which of them are there.
        age: s since they were taken.
    """

    values: Array
    valid: NDArray[np.bool_]
    age: float = 0.0

    @classmethod
    def of(cls, values: Array, age: float = 0.0) -> "Measurement":
        """From values (m,) of which those that are lost are no finite numbers."""
        values = np.array(values, np.float64)
        return cls(values, np.isfinite(values), age)

    @property
    def complete(self) -> bool:
        """Whether every value is there."""
        return bool(np.all(self.valid))

    def after(self, last: Array) -> Array:
        """(m,) the last value of each that was there; `last` (m,) is that before."""
        return np.where(self.valid, self.values, last)

    def known(self, size: int) -> Array:
        """Return the values (size,), NaN in the place of those that are lost.

        Raises:
            ValueError: another number of values.
        """
        values = np.where(self.valid, self.values, np.nan)
        if values.shape != (size,):
            raise ValueError(f"measurement: got shape {values.shape}; expected {(size,)}")
        return values

    def require_fresh(self) -> None:
        """For who takes the values for those of now.

        Raises:
            ValueError: they are older.
        """
        if self.age != 0:
            raise ValueError(f"measurement: got an age of {self.age} s; expected 0")
