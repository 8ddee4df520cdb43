"""What is measured, y = h(x) + noise: how to begin from it, and what of it is no use.

The law and its observers know a sensor by `Sensing` alone. Which measurements are no use shows by
what they say themselves and by what was said before. One that is *missing* says so. One that is
*frozen* repeats what was measured before, bit for bit, which is a fault only where it cannot be so:

- noise that doubles can tell apart never comes twice: with noise a value that repeats is frozen;
- without noise the poses q and rates v have to agree. Between two samples a smooth motion goes

      q_k - q_{k-1} = dt/2 (v_{k-1} + v_k) + O(dt^3),

  so a pose that repeats is frozen if its own rates say that it has moved on. A plate at rest
  repeats pose and rates and is not frozen.

A pose that the machine cannot have is *rejected*. What needs a model of the motion, an outlier or a
sensor that froze while the plate was at rest, is for the filter to find (`law.parameter_filter`).
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from stewart_drake.law.measurement import Measurement
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.types import Array

MOVED = 1e-3
"""Share of the motion that a pose has to go within a period to have moved."""
NOISY = 2.0**20
"""Noise has so many units in the last place: by chance it repeats once in a million values."""
SIGMAS = 6.0
"""Standard deviations by which rates may be off without saying that anything moved."""
_STEEPEST = np.pi / 2
"""rad; beyond this pitch another roll and yaw describe the same pose."""


class FirstState(NamedTuple):
    """What one measurement alone tells of the state."""

    state: Array
    """(12,)."""
    covariance: Array
    """(12, 12)."""


class Sensing(Protocol):
    """A kind of sensor. Instances are immutable."""

    @property
    def size(self) -> int:
        """m, the number of values."""
        ...

    @property
    def noise_std(self) -> Array:
        """(m,) standard deviations of the values."""
        ...

    def seen(self, state: Array) -> Array:
        """h(x), the values (m,) of a state (12,) without noise."""
        ...

    def through(self, state: Array, changes: Array) -> Array:
        """H X (m, ...), H = dh/dx at a state (12,), of changes X (12, ...) of the state."""
        ...

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """What is wrong with a measurement, as the name of a count, or None.

        Args:
            measurement: of m values.
            last: (m,) what each value was before; NaN for nothing.
            period: s since the sample before.
            mechanism: as the controller knows it.

        Raises:
            ValueError: a shape that does not fit.
        """
        ...

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """The state from a measurement without a fault alone, or None where it tells of none.

        Args:
            measurement: of m values.
            near: (12,) where the plate is thought to be, for a sensor that cannot do without; None
                is as at the beginning.
        """
        ...

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """For how many periods things have stood still, for a sensor that minds it.

        Args:
            measurement: of m values.
            last: (m,) what each value was before; NaN for nothing.
            still: what this said before; of no size before any.
        """
        ...

    def now(self, measurement: Measurement) -> "tuple[Sensing, Measurement]":
        """What of a measurement is of its own instant, not of the period before, and its sensing.

        For an observer that compares it with the state at the sample alone.
        """
        ...


@dataclass(frozen=True)
class StateSensing:
    """Pose and rates themselves: h(x) = x.

    Attributes:
        noise_std: (12,) rad, m and per s.
        motion: (6,) how far each coordinate is expected to move, rad and m.
        anywhere: whether poses out of the machine's reach are believed.
    """

    noise_std: Array
    motion: Array
    anywhere: bool = False

    @property
    def size(self) -> int:
        """The number of states."""
        return NUM_STATE

    def seen(self, state: Array) -> Array:
        """The state."""
        return state

    def through(self, state: Array, changes: Array) -> Array:
        """The changes themselves."""
        return changes

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """See `Sensing.fault`; one value that is lost loses the others."""
        if not measurement.complete:
            return "measurements_missing"
        values = measurement.values
        repeats = values == last
        noisy = self.noise_std > NOISY * np.spacing(np.abs(values))
        moved = period / 2 * np.abs(values[RATES] + last[RATES])
        perhaps = MOVED * self.motion + SIGMAS * period * self.noise_std[RATES]
        stuck = repeats[POSE] & (moved > perhaps)
        if np.any(repeats & noisy) or np.any(stuck):
            return "measurements_frozen"
        pose = values[POSE]
        if self.anywhere:
            return None
        if abs(pose[1]) >= _STEEPEST or not np.all(mechanism.reach_margins(pose) >= 0):
            return "measurements_rejected"
        return None

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState:
        """The measurement, as uncertain as its noise."""
        return FirstState(measurement.values, np.diag(self.noise_std**2))

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """Nothing that matters."""
        return still

    def now(self, measurement: Measurement) -> tuple[Sensing, Measurement]:
        """All of it."""
        return self, measurement
