"""The delay between a torque and its effect as a value, true or assumed."""

from dataclasses import dataclass
from numbers import Integral, Real

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.timing import LEAST_FRACTION


@dataclass(frozen=True)
class Delay:
    """A delay eta = (steps + fraction) dt of a loop that is sampled every dt."""

    steps: int  # mu, whole periods
    fraction: float = 0.0  # eta0 / dt, further part of a period, in [0, 1)

    def __post_init__(self) -> None:
        numbers = isinstance(self.steps, Integral) and isinstance(self.fraction, Real)
        if not (numbers and self.steps >= 0 and 0 <= self.fraction < 1):
            raise ConfigError(
                f"delay: got {self.steps!r} steps and a fraction of {self.fraction!r}; expected "
                "whole steps of at least 0, and a fraction of a step from 0 to below 1"
            )

    @classmethod
    def of(cls, eta: float, period: float) -> "Delay":
        """Return a delay of eta s; less than LEAST_FRACTION beyond a whole period is none."""
        periods = max(0.0, eta / period)
        steps = int(periods + LEAST_FRACTION)
        fraction = periods - steps
        return cls(steps, fraction if fraction > LEAST_FRACTION else 0.0)

    @property
    def periods(self) -> float:
        """The whole delay in periods."""
        return self.steps + self.fraction

    def eta(self, period: float) -> float:
        """Return the whole delay in s, for a period in s."""
        return self.periods * period

    @property
    def queue_length(self) -> int:
        """Number of earlier torques in flight or at the plant: mu, one more for eta0 > 0."""
        return self.steps + (1 if self.fraction > 0 else 0)
