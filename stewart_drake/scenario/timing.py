"""Steps, periods and delays that fit each other."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Final, NamedTuple

from stewart_drake.files.errors import ConfigError

METRIC_PERIOD: Final = 0.02
"""Grid of the accumulated error, s, which the steps of a discrete plant have to hit."""
MOST_INSTANTS: Final = 5_000_000
"""Largest number of instants in a log with its own period; each takes 1 kB of memory."""

SERVO_RATE: Final = 1000.0  # least rate at which servos compute their torques, Hz

LEAST_FRACTION: Final = 1e-9
"""Of a period. A delay's part below it is 0: events so close to each other lose their order."""

_EARLY: Final = 1 - 1e-14
_SERVO: Final = 1 - 7e-15
_LOOK: Final = 1 - 5e-15


class Instant(NamedTuple):
    """Time of an observation of a running loop in s, and its users: metric, controller, log."""

    time: float
    on_grid: bool
    sampled: bool
    logged: bool


def instants(end: float, period: float, log_period: float | None) -> Iterator[Instant]:
    """Yield all instants of a run of `end` s with a controller of this period, up to `end`.

    The log has the multiples of `log_period`, or with None the metric's grid and every sample.
    """
    import numpy as np  # which --help, by way of the scenario's fields, does not import

    def multiples(step: float) -> set[float]:
        # Grid and samples that agree but for rounding are one instant.
        return {*np.round(step * np.arange(int(end / step + 1e-9) + 1), 9).tolist()}

    last = {round(end, 9)}
    grid, samples = multiples(METRIC_PERIOD) | last, multiples(period)
    log = grid | samples if log_period is None else multiples(log_period) | last
    for t in sorted(grid | samples | log):
        yield Instant(min(t, end), t in grid, t in samples, t in log)


def event_time(nominal: float) -> float:
    """Return the period or offset of an event before a discrete plant's step of the same instant.

    Drake takes the k-th event at offset + k * period, rounded: 3 * 0.1 is one ulp later than
    300 * 0.001, so that a 1 ms plant would have stepped to t + 1 ms before a controller of 0.1 s
    reads it and sends a torque. Some fifty ulp earlier, at any t, the order is never in doubt.
    """
    return nominal * _EARLY


def servo_time(nominal: float) -> float:
    """Return the same for an event after those of `event_time` and before `look_time`.

    Servos read a command at its arrival, and the plant reads their torque.
    """
    return nominal * _SERVO


def look_time(nominal: float) -> float:
    """Return the time to observe a running loop at t = `nominal`.

    It is after the events of that instant and before a discrete plant's step from it.
    """
    return nominal * _LOOK


def servo_ticks(period: float, time_step: float | None) -> int:
    """Return the number of samples of the servos' local loops in a period of the controller.

    It is the least for a rate of SERVO_RATE. With a discrete plant every sample is at one of its
    steps; one at each step is the most.
    """
    wanted = max(1, math.ceil(period * SERVO_RATE - 1e-9))
    if time_step is None:
        return wanted
    steps = round(period / time_step)
    return next((n for n in range(wanted, steps) if steps % n == 0), steps)


def step_problem(
    step: float,
    period: float,
    fraction: float = 0.0,
    samples: int | None = None,
    playout: float | None = None,
) -> str | None:
    """Return the first number that does not fit a discrete plant, which has events at steps only.

    The metric's grid, the period, the delay's fraction and the play-out bound must be whole numbers
    of steps (to 1e-9, relative), and the period divided by the sensor's samples too. A problem has
    the field to change, its value, and the nearest that fits.
    """
    if not _is_whole(METRIC_PERIOD / step):
        nearest = _nearest_step(step, period)
        return (
            f"plant.time_step: got {step!r}; expected {METRIC_PERIOD} s divided by a whole "
            f"number, nearest {nearest!r}"
        )
    if problem := multiple_problem("controller.period", period, step):
        return problem
    steps = period / step
    if samples is not None and not _is_whole(steps / samples):
        fitting = [n for n in range(1, round(steps) + 1) if round(steps) % n == 0]
        return (
            f"sensor.samples: got {samples}; expected a number that divides the {round(steps)} "
            f"steps of a period, nearest {min(fitting, key=lambda n: abs(n - samples))}"
        )
    if not _is_whole(fraction * steps):
        nearest = min(round(fraction * steps), round(steps) - 1) / round(steps)
        return (
            f"delay.fraction: got {fraction!r}, {fraction * steps:.6g} steps; expected a whole "
            f"number of plant.time_step ({step!r} s) within the period, nearest {nearest!r}"
        )
    return multiple_problem("link.playout", playout, step) if playout else None


def multiple_problem(field: str, value: float, step: float) -> str | None:
    """Return that a field in s is not a multiple of a discrete plant's step, or None."""
    if _is_whole(value / step):
        return None
    nearest = float(f"{max(1, round(value / step)) * step:.12g}")
    return (
        f"{field}: got {value!r}; expected a whole number of plant.time_step ({step!r} s), "
        f"nearest {nearest!r}"
    )


def log_problem(log_period: float | None, duration: float, step: float | None = None) -> str | None:
    """Return the problem with the period of a log, or None.

    A discrete plant is recorded at its own steps of `step` s only.
    """
    if log_period is None:
        return None
    if duration / log_period > MOST_INSTANTS:
        least = duration / MOST_INSTANTS
        return (
            f"log_period: got {log_period!r}; expected at least {least:.4g} s, {MOST_INSTANTS} "
            f"instants in duration {duration!r}, or null"
        )
    problem = step and multiple_problem("log_period", log_period, step)
    return f"{problem}, or null" if problem else None


def _nearest_step(step: float, period: float) -> float:
    """Return the nearest divisor of the metric's grid, if possible one of the period too."""
    parts = max(1, round(METRIC_PERIOD / step))
    nearby = sorted(
        range(max(1, parts - 1000), parts + 1000), key=lambda n: abs(METRIC_PERIOD / n - step)
    )
    fitting = (n for n in nearby if _is_whole(period * n / METRIC_PERIOD))
    return METRIC_PERIOD / next(fitting, parts)


def _is_whole(ratio: float) -> bool:
    # Relative, so that a ratio that rounds to zero counts only if it is zero.
    return abs(ratio - round(ratio)) <= 1e-9 * abs(ratio)


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
