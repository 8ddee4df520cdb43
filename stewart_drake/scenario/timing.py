"""Which steps, periods and delays fit each other."""

import math
from collections.abc import Iterator
from typing import Final, NamedTuple

METRIC_PERIOD: Final = 0.02
"""s; the grid of the accumulated error, which the steps of a discrete plant have to hit."""
MOST_INSTANTS: Final = 5_000_000
"""In a log of the user's own period; each takes 1 kB of memory."""

SERVO_RATE: Final = 1000.0
"""Hz; how often at least servos compute their torques."""

LEAST_FRACTION: Final = 1e-9
"""Of a period. A delay's part below it is 0: events so close to each other lose their order."""

_EARLY: Final = 1 - 1e-14
_SERVO: Final = 1 - 7e-15
_LOOK: Final = 1 - 5e-15


class Instant(NamedTuple):
    """When to look at a running loop in s, and for whom: the metric, the controller, the log."""

    time: float
    on_grid: bool
    sampled: bool
    logged: bool


def instants(end: float, period: float, log_period: float | None) -> Iterator[Instant]:
    """All instants of a run of `end` s with a controller of this period; the last one is `end`.

    The log has the multiples of `log_period`, or with None the metric's grid and every sample.
    """

    import numpy as np  # which --help, by way of the scenario's fields, goes without

    def multiples(step: float) -> set[float]:
        # Grid and samples that agree but for rounding are one instant.
        return {*np.round(step * np.arange(int(end / step + 1e-9) + 1), 9).tolist()}

    last = {round(end, 9)}
    grid, samples = multiples(METRIC_PERIOD) | last, multiples(period)
    log = grid | samples if log_period is None else multiples(log_period) | last
    for t in sorted(grid | samples | log):
        yield Instant(min(t, end), t in grid, t in samples, t in log)


def event_time(nominal: float) -> float:
    """Period or offset of an event that must precede a discrete plant's step of the same instant.

    Drake takes the k-th event at offset + k * period, rounded: 3 * 0.1 is one ulp later than
    300 * 0.001, so that a 1 ms plant would have stepped to t + 1 ms before a controller of 0.1 s
    reads it and sends a torque. Some fifty ulp earlier, at any t, the order is never in doubt.
    """
    return nominal * _EARLY


def servo_time(nominal: float) -> float:
    """As `event_time`, for an event that follows those and still precedes a look at the loop.

    Servos read at once what has just arrived, and the plant what they make of it.
    """
    return nominal * _SERVO


def look_time(nominal: float) -> float:
    """When to look at a running loop so as to see t = `nominal`.

    After the events of that instant, before a discrete plant's step out of it.
    """
    return nominal * _LOOK


def servo_ticks(period: float, time_step: float | None) -> int:
    """Samples of the servos' local loops in a period of the controller, in s.

    As few as make it at least SERVO_RATE a second; with a discrete plant of this step in s every
    one on a step, which also is the most.
    """
    wanted = max(1, math.ceil(period * SERVO_RATE - 1e-9))
    if time_step is None:
        return wanted
    steps = round(period / time_step)
    return next((n for n in range(wanted, steps) if steps % n == 0), steps)


def step_problem(time_step: float, period: float, fraction: float) -> str | None:
    """What is wrong with the steps of a discrete plant, which sees events on its own steps only.

    Args:
        time_step: of the plant, s.
        period: of the controller, s.
        fraction: of a period, by which the delay exceeds a whole number of periods.

    Returns:
        None where the metric's grid, the period and the fraction are whole numbers of steps (to
        1e-9, relative); else the scenario field to change, its value, and the nearest that fits.
    """
    if not _is_whole(METRIC_PERIOD / time_step):
        nearest = _nearest_step(time_step, period)
        return (
            f"plant.time_step: got {time_step!r}; expected {METRIC_PERIOD} s divided by a whole "
            f"number, nearest {nearest!r}"
        )
    problem, steps = whole_problem("controller.period", period, time_step), period / time_step
    if problem:
        return problem
    delayed = fraction * steps
    if not _is_whole(delayed):
        nearest = min(round(delayed), round(steps) - 1) / round(steps)
        return (
            f"delay.fraction: got {fraction!r}, {delayed:.6g} steps; expected a whole number of "
            f"plant.time_step ({time_step!r} s) within the period, nearest {nearest!r}"
        )
    return None


def samples_problem(samples: int, period: float, time_step: float) -> str | None:
    """What is wrong with samples per period of s for a discrete plant, or None."""
    steps = period / time_step
    if not _is_whole(steps) or _is_whole(steps / samples):
        return None  # the former is told elsewhere
    fitting = [n for n in range(1, round(steps) + 1) if round(steps) % n == 0]
    nearest = min(fitting, key=lambda n: abs(n - samples))
    return (
        f"sensor.samples: got {samples}; expected a number by which a period has whole steps of "
        f"plant.time_step ({time_step!r} s), nearest {nearest}"
    )


def whole_problem(field: str, value: float, time_step: float) -> str | None:
    """What is wrong with a field of the scenario in s that has to fit a discrete plant, or None."""
    if _is_whole(value / time_step):
        return None
    nearest = _tidy(max(1, round(value / time_step)) * time_step)
    return (
        f"{field}: got {value!r}; expected a whole number of plant.time_step ({time_step!r} s), "
        f"nearest {nearest!r}"
    )


def log_problem(
    log_period: float | None, duration: float, time_step: float | None = None
) -> str | None:
    """What is wrong with the period of a log.

    Args:
        log_period: s, or None for the usual instants.
        duration: of the run, s.
        time_step: of a discrete plant, which is seen on its own steps only, or None.

    Returns:
        None, or the scenario field to change, its value, and what fits.
    """
    if log_period is None:
        return None
    if duration / log_period > MOST_INSTANTS:
        least = duration / MOST_INSTANTS
        return (
            f"log_period: got {log_period!r}; expected at least {least:.4g} s, {MOST_INSTANTS} "
            f"instants in duration {duration!r}, or null"
        )
    problem = time_step and whole_problem("log_period", log_period, time_step)
    return f"{problem}, or null" if problem else None


def _nearest_step(time_step: float, period: float) -> float:
    """The nearest step that divides the metric's grid and, if one close by does, the period."""
    parts = max(1, round(METRIC_PERIOD / time_step))
    nearby = sorted(
        range(max(1, parts - 1000), parts + 1000),
        key=lambda n: abs(METRIC_PERIOD / n - time_step),
    )
    fitting = (n for n in nearby if _is_whole(period * n / METRIC_PERIOD))
    return METRIC_PERIOD / next(fitting, parts)


def _is_whole(ratio: float) -> bool:
    # A ratio that rounds to zero is no step at all, unless it is zero.
    return abs(ratio - round(ratio)) <= 1e-9 * abs(ratio)


def _tidy(value: float) -> float:
    """`value` without the last digits that a product of decimals carries."""
    return float(f"{value:.12g}")
