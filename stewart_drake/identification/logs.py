"""A log of a machine: torques with the times at which they were sent, and what was measured."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE
from stewart_drake.types import Array

ANGLES: Final = slice(0, NUM_LEGS)
"""Of a log's measurements: crank angles,"""
POSE: Final = slice(6, 12)
"""pose of the plate,"""
RATES: Final = slice(12, 18)
"""and its rates."""
NUM_MEASURED: Final = NUM_LEGS + NUM_STATE
KINDS: Final = {"angles": ANGLES, "pose": POSE, "rates": RATES}


@dataclass(frozen=True, eq=False)
class Log:
    """One log.

    Attributes:
        name: of the file.
        sent: (m,) s, when each torque was sent, increasing.
        torques: (m, 6) N m, as far as the motors give them; each acts until the next one does.
        times: (n,) s of the measurements, increasing.
        values: (n, 18) crank angles, pose, rates, in rad, m and per s; NaN where there is none.
        std: (18,) of their errors.
        gravity: m/s^2 along -z.
        delay: s that was believed in, or None.
        before: torques (6,) that act before the first of these does, or None where unknown.
    """

    name: str
    sent: Array
    torques: Array
    times: Array
    values: Array
    std: Array
    gravity: float
    delay: float | None = None
    before: Array | None = None

    def acting(self, times: Array, delay: float) -> Array:
        """Torques (k, 6) that act at so many instants in s; before any arrived, the first one."""
        last = np.searchsorted(self.sent + delay, times, side="right") - 1
        return self.torques[np.maximum(last, 0)]

    def measures(self, kind: slice) -> bool:
        """Whether there is a value of a kind at all."""
        return bool(np.isfinite(self.values[:, kind]).any())
