"""What the law knows of the motors: a limit of their torque, which stands behind it in the loop."""

import math
from dataclasses import dataclass

import numpy as np

from stewart_drake.types import Array


@dataclass(frozen=True)
class TorqueLimit:
    """The limit of each motor in N m, infinite for none."""

    limit: float = math.inf

    def let_through(self, torques: Array) -> Array:
        """What the limit leaves of torques (..., 6) that were asked for."""
        return np.clip(torques, -self.limit, self.limit)

    def reached(self, torques: Array) -> bool:
        """Whether any of the torques (..., 6) is at the limit, or beyond."""
        return bool(np.any(np.abs(torques) >= self.limit))
