"""Arrival times of torques and measurements over a link, infinite for lost ones.

They are drawn before the run from a seed, so that the same scenario gives the same run.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.scenario.config import DelayConfig, Scenario
from stewart_drake.scenario.link_config import ASSUMED_TIMES, PacketsConfig
from stewart_drake.scenario.packets import BACK, SENSOR, packet_times, times_under_way
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array, Flags

SIMULTANEOUS: Final = 1e-9
"""Share of a period; events that are closer count as simultaneous."""
_MOST: Final = 0.99
"""Share of the measurements whose age is stated."""


def number_sent(duration: float, period: float) -> int:
    """Return the number of samples of a run, with those at t = 0 and at its end."""
    return int(duration / period + SIMULTANEOUS) + 1


def delay_at(delay: DelayConfig, period: float, times: Array) -> Array:
    """Return eta(t) in s of torques sent at `times`, before jitter, at least 0.

        eta(t) = (steps + fraction) dt + drift t + swing sin(omega t) + jump [t >= jump_time]

    Before t = 0 the last three terms are zero.
    """
    t = np.maximum(times, 0.0)
    eta = Delay(delay.steps, delay.fraction).eta(period) + delay.drift * t
    eta = eta + delay.swing * np.sin(delay.swing_frequency * t)
    eta = eta + np.where((times >= 0) & (times >= delay.jump_time), delay.jump, 0.0)
    return np.maximum(eta, 0.0)


def torque_delays(scenario: Scenario) -> Array:
    """Return the true delay (n,) of every torque of a run over a wire, jitter included, s.

    With the multibody plant, each torque arrives at the nearest step.
    """
    delay, period = scenario.delay, scenario.controller.period
    sent: Array = np.arange(number_sent(scenario.duration, period), dtype=np.float64) * period
    rng = np.random.Generator(np.random.Philox(key=delay.seed))
    jitter = delay.jitter_std * rng.standard_normal(len(sent))
    eta: Array = np.maximum(delay_at(delay, period, sent) + jitter, 0.0)
    if (step := scenario.plant.step) is not None:
        eta = np.maximum(step * np.round((sent + eta) / step) - sent, 0.0)
    return eta


def takes_effect(arrivals: Array, together: float = 0.0) -> Flags:
    """Return which of (n,) torques ever act: those that arrive before every newer one.

    The motors apply the newest torque that has arrived and ignore those that it has overtaken. Of
    several that arrive within `together`, in s, the newest acts.
    """
    earliest_newer = np.minimum.accumulate(np.append(arrivals, np.inf)[::-1])[::-1][1:]
    return np.isfinite(arrivals) & (arrivals + together < earliest_newer)


def releases(period: float, delays: Array, delay: Delay) -> tuple[NDArray[np.int64], Array]:
    """Return the numbers of the torques that ever act over a wire, and their arrivals in s.

    Torque k >= 0 is sent at k dt and has the delay `delays[k]`. Torques -L to -1 were sent before,
    one a period, with the delay `delay` and its queue length L. A delay below SIMULTANEOUS is 0.
    """
    length = delay.queue_length
    numbers = np.arange(-length, len(delays))
    queued = (numbers[:length] + delay.periods) * period
    own = period * numbers[length:] + np.where(delays > SIMULTANEOUS * period, delays, 0.0)
    arrivals = np.concatenate([queued, own])
    acts = takes_effect(arrivals, SIMULTANEOUS * period)
    return numbers[acts], arrivals[acts]


def forward_times(scenario: Scenario, number: int) -> Array:
    """Return the transit time (number,) of each packet of torques, s; infinite if lost."""
    link = scenario.assumed_link
    return np.zeros(number) if link.kind == "wire" else packet_times(link, number, link.seed)


def sensor_times(scenario: Scenario, number: int) -> Array:
    """Return times (number,) from sample to measurement, s; infinite where it is lost."""
    sensor = scenario.sensor
    losses = PacketsConfig(low=0.0, high=0.0, loss=sensor.loss)
    lost = np.isinf(packet_times(losses, number, sensor.seed, SENSOR))
    return np.where(lost, np.inf, sensor.delay)


def return_times(scenario: Scenario, number: int) -> Array:
    """Return the transit time (number,) of each measurement, s; infinite if it is lost."""
    link = scenario.link
    if link.kind == "wire" or link.back is None:
        return np.zeros(number)
    return packet_times(link.back, number, link.seed, BACK)


def measurement_times(scenario: Scenario) -> Array:
    """Return the age (n,) of each measurement at its arrival, s; infinite where it is lost."""
    n = number_sent(scenario.duration, scenario.controller.period)
    return sensor_times(scenario, n) + return_times(scenario, n)


def oldest(scenario: Scenario, share: float = _MOST) -> float:
    """Return the age in s that this share of the measurements does not exceed."""
    back = scenario.link.back
    way = 0.0 if back is None else float(times_under_way(back).ppf(share))
    return scenario.sensor.delay + way


def oldest_periods(scenario: Scenario) -> int:
    """Return the age `oldest` in whole periods: the law reads measurements once a period."""
    return math.ceil(oldest(scenario) / scenario.controller.period - SIMULTANEOUS)


def link_text(scenario: Scenario, bound: bool = True) -> str | None:
    """Return the assumed network in words, with its play-out bound if asked; None for a wire."""
    link = scenario.assumed_link
    if link.kind == "wire":
        return None
    if link.distribution == "lognormal":
        times = f"{link.median:g} s in the median, sigma {link.sigma:g}"
    else:
        times = f"{link.low:g} to {link.high:g} s"
    if scenario.link.follows_delay:
        delay, period = scenario.delay, scenario.controller.period
        times += (
            f" ({ASSUMED_TIMES[0]:g} to {ASSUMED_TIMES[1]:g} times the delay of "
            f"{Delay(delay.steps, delay.fraction).eta(period):g} s, as link.low and link.high are "
            "null)"
        )
    bursts = f" in bursts of {link.burst}" if link.burst > 1 else ""
    back = "measurements without delay" if link.back is None else "measurements over a network too"
    playout = f", play-out bound {link.playout:g} s" if bound else ""
    if bound and link.back is not None:
        age = scenario.controller.period * oldest_periods(scenario)
        back += (
            f"; torques act {scenario.eta:g} s after they are computed, up to "
            f"{scenario.eta + age:g} s after their measurement"
        )
    return f"network, packets take {times}, {100 * link.loss:g} % lost{bursts}{playout}; {back}"
