"""What a link does to what is sent over it: when each torque arrives, or that it does not.

Everything is drawn beforehand from a seed, so that the same scenario gives the same run.
"""

from bisect import bisect_left
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.scenario.config import (
    ControllerConfig,
    DelayConfig,
    NetworkConfig,
    PacketsConfig,
    Scenario,
)
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.field_types import MOST_PERIODS

Array = NDArray[np.float64]
_FORWARD, _BACK, _SENSOR = range(3)
"""Streams of random numbers of one seed."""
RARE: Final = 1.5
"""Torques that are missing, by those that would be with no packet late."""
TOGETHER: Final = 1e-9
"""Of a period; what is so close to each other has no order."""
ALMOST_NONE: Final = 1e-3
"""Share of torques that may be late where no packet is lost."""


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
    sent: Array = np.arange(number_sent(scenario.duration, period), dtype=np.float64) * period
    rng = np.random.Generator(np.random.Philox(key=delay.seed))
    jitter = delay.jitter_std * rng.standard_normal(len(sent))
    eta: Array = np.maximum(delay_at(delay, period, sent) + jitter, 0.0)
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


def releases(period: float, delays: Array, delay: Delay) -> tuple[NDArray[np.int64], Array]:
    """Which torques ever act over a wire, and when they begin to, s, in the order in which they do.

    Torque k >= 0 is sent at k dt and waits for `delays[k]`; torques -L to -1 were sent before, each
    a period after the other, and wait for `delay`, of which L is the length of the queue.

    Args:
        period: dt in s.
        delays: (n,) s; what is less than 1e-9 of a period is 0.
        delay: of those sent before t = 0.
    """
    length = delay.queue_length
    waits = np.where(delays > TOGETHER * period, delays, 0.0)
    numbers = np.arange(-length, len(delays))
    earlier = (numbers[:length] + delay.periods) * period
    arrivals = np.concatenate([earlier, period * numbers[length:] + waits])
    acts = acting(arrivals, TOGETHER * period)
    return numbers[acts], arrivals[acts]


def times_under_way(config: PacketsConfig) -> Any:
    """The distribution of the time in s that a packet takes, as scipy has it."""
    from scipy.stats import lognorm, uniform  # a fifth of a second, which others need not wait

    if config.distribution == "uniform":
        return uniform(config.low, max(config.high - config.low, 1e-12))
    assert config.sigma is not None and config.median is not None  # or it is refused
    return lognorm(s=config.sigma, scale=config.median)


def losses(number: int, loss: float, burst: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which of `number` packets are lost.

    A burst loses that many in a row. Where one begins with probability p, independently of others,
    a packet is kept if none of the last `burst` began one: 1 - loss = (1 - p)^burst.
    """
    begins = rng.random(number) < 1 - (1 - loss) ** (1 / burst)
    return np.convolve(begins, np.ones(burst))[:number] > 0


def packet_times(config: PacketsConfig, number: int, seed: int, stream: int = _FORWARD) -> Array:
    """(number,) s that each packet is under way; infinite for one that is lost."""
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, 0]))
    # Two streams, so that the time of a packet does not depend on how many are lost.
    times = times_under_way(config).ppf(rng.random(number))
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 1, stream, 0]))
    return np.where(losses(number, config.loss, config.burst, rng), np.inf, times)


def forward_times(link: NetworkConfig, number: int) -> Array:
    """(number,) s that each packet of torques is under way; infinite for one that is lost."""
    return packet_times(link, number, link.seed)


def sensor_times(scenario: Scenario, number: int) -> Array:
    """(number,) s from each sample until the machine has what was measured; infinite for never."""
    sc = scenario.sensor
    none_late = PacketsConfig(low=0.0, high=0.0, loss=sc.loss)
    lost = packet_times(none_late, number, sc.seed, _SENSOR)
    return sc.delay + np.where(np.isfinite(lost), 0.0, np.inf)


def return_times(scenario: Scenario, number: int) -> Array:
    """(number,) s that each measurement is under way to the controller; infinite for never."""
    link = scenario.link
    if not isinstance(link, NetworkConfig) or link.back is None:
        return np.zeros(number)
    return packet_times(link.back, number, link.seed, _BACK)


def measurement_times(scenario: Scenario) -> Array:
    """(n,) s from each sample until the controller has what was measured; infinite for never."""
    n = number_sent(scenario.duration, scenario.controller.period)
    return sensor_times(scenario, n) + return_times(scenario, n)


def newest_measurements(times: Array, period: float) -> NDArray[np.int64]:
    """(n,) which measurement the controller gets at each of n samples, -1 for none.

    It is the newest that has arrived by then, and none where that was given before: measurements
    that were overtaken are dropped.
    """
    n = len(times)
    # In samples; the tolerance is that of times which are whole numbers of periods.
    ready = np.arange(n) + np.ceil(times / period - 1e-9)
    newest = np.full(n, -1)
    there = np.flatnonzero(ready < n)
    np.maximum.at(newest, ready[there].astype(int), there)
    so_far = np.maximum.accumulate(newest)
    return np.where(newest > np.append(-1, so_far[:-1]), newest, -1)


def in_time(config: PacketsConfig, time: float) -> float:
    """Probability that a packet has arrived so many s after it was sent."""
    return float((1 - config.loss) * times_under_way(config).cdf(time + 1e-9))


def torque_missing(config: PacketsConfig, bound: float, repeats: int, period: float) -> float:
    """Probability that a torque is not there in time, in its own packet or a repetition."""
    chances = [1 - in_time(config, bound + i * period) for i in range(repeats + 1)]
    return float(np.prod(chances))


def usual_bound(config: PacketsConfig, repeats: int, period: float) -> float:
    """The least bound in s, in whole periods, at which being late is rarer than being lost.

    A longer one cannot bring back what is lost, and costs delay. With the bound B and r repetitions
    a torque is missing with q(B) = prod_i [1 - (1 - loss) F(B + i dt)], i = 0 to r, which falls to
    loss^(r+1); wanted is the least B with q(B) <= RARE loss^(r+1), or ALMOST_NONE. Beyond
    MOST_PERIODS, which no delay may have, it is not looked for.
    """
    enough = max(RARE * config.loss ** (repeats + 1), ALMOST_NONE)

    def there(steps: int) -> bool:
        return torque_missing(config, steps * period, repeats, period) <= enough

    return bisect_left(range(MOST_PERIODS + 1), True, key=there) * period


def network_delay(link: NetworkConfig, controller: ControllerConfig) -> Delay:
    """From computing a torque to its time: the bound, and the periods for repetitions."""
    period, repeats = controller.period, controller.packet_repeats
    bound = usual_bound(link, repeats, period) if link.playout is None else link.playout
    return Delay.of(bound + repeats * period, period)
