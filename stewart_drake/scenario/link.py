"""What a link does to what is sent over it: when each torque arrives, or that it does not.

Everything is drawn beforehand from a seed, so that the same scenario gives the same run.
"""

import numpy as np
from numpy.typing import NDArray

from stewart_drake.scenario.config import DelayConfig, Scenario
from stewart_drake.scenario.delay import Delay

Array = NDArray[np.float64]


def number_sent(duration: float, period: float) -> int:
    """Samples of a run, the one at t = 0 and one at its end among them."""
    return int(duration / period + 1e-9) + 1


def delay_at(delay: DelayConfig, period: float, times: Array) -> Array:
    """eta(t) in s of what is sent at `times`, before jitter, at least 0.

        eta(t) = (steps + fraction) dt + drift t + swing sin(omega t) + jump [t >= jump_time]

    Before t = 0 it was what it is without the last three.
    """
    began = np.maximum(times, 0.0)
    eta = Delay(delay.steps, delay.fraction).eta(period) + delay.drift * began
    eta = eta + delay.swing * np.sin(delay.swing_frequency * began)
    eta = eta + np.where((times >= 0) & (times >= delay.jump_time), delay.jump, 0.0)
    return np.maximum(eta, 0.0)


def torque_delays(scenario: Scenario) -> Array:
    """(n,) s, the true delay of every torque of a run over a wire, the jitter in it.

    The multibody plant feels torques at its own steps, so that they arrive at the nearest one.
    """
    delay, period = scenario.delay, scenario.controller.period
    sent = period * np.arange(number_sent(scenario.duration, period))
    rng = np.random.Generator(np.random.Philox(key=delay.seed))
    jitter = delay.jitter_std * rng.standard_normal(len(sent))
    eta = np.maximum(delay_at(delay, period, sent) + jitter, 0.0)
    if scenario.plant.kind == "multibody":
        step = scenario.plant.time_step
        eta = np.maximum(step * np.round((sent + eta) / step) - sent, 0.0)
    return eta


def acting(arrivals: Array, together: float = 0.0) -> NDArray[np.bool_]:
    """Which of (n,) torques ever act: those that arrive before every newer one.

    The motors take the newest torque that has arrived, whatever comes after it: one that was
    overtaken says what was right for an earlier instant. Of several that arrive within `together`,
    in s, the newest acts.
    """
    earliest_newer = np.minimum.accumulate(np.append(arrivals, np.inf)[::-1])[::-1][1:]
    return np.isfinite(arrivals) & (arrivals + together < earliest_newer)
