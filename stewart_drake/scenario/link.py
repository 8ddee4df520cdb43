"""Times at which torques and measurements arrive over a link, and those that are lost.

Everything is drawn beforehand from a seed, so that the same scenario gives the same run.
"""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.scenario.config import (
    ASSUMED_TIMES,
    DelayConfig,
    NetworkConfig,
    PacketsConfig,
    Scenario,
)
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.field_types import MOST_PERIODS
from stewart_drake.types import Array

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
    """Return which of (n,) torques ever act: those that arrive before every newer one.

    The motors take the newest torque that has arrived, whatever comes after it: one that was
    overtaken says what was right for an earlier instant. Of several that arrive within `together`,
    in s, the newest acts.
    """
    earliest_newer = np.minimum.accumulate(np.append(arrivals, np.inf)[::-1])[::-1][1:]
    return np.isfinite(arrivals) & (arrivals + together < earliest_newer)


def releases(period: float, delays: Array, delay: Delay) -> tuple[NDArray[np.int64], Array]:
    """Return the torques that ever act over a wire, and when they begin to, s, in that order.

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
        assert config.low is not None and config.high is not None  # see `Scenario.assumed_link`
        return uniform(config.low, max(config.high - config.low, 1e-12))
    assert config.sigma is not None and config.median is not None  # or it is refused
    return lognorm(s=config.sigma, scale=config.median)


@dataclass(frozen=True)
class BurstChain:
    """Markov chain of lost packets.

    The state a counts the packets since the last burst began, up to `burst`:

        a+ = 0 with probability p, else min(a + 1, burst)

    A packet is lost where a < burst. It is kept where none of the last `burst` packets began one,
    so that 1 - loss = (1 - p)^burst. The chain reads the same backwards in time.

    Attributes:
        loss: share of the packets that are lost.
        burst: number of packets that one burst loses.
    """

    loss: float
    burst: int

    @cached_property
    def begins(self) -> float:
        """Probability p that a burst begins at a packet."""
        return 1 - (1 - self.loss) ** (1 / self.burst)

    @cached_property
    def stationary(self) -> Array:
        """(burst + 1,) probability of each state: p (1 - p)^a, and 1 - loss."""
        shares = self.begins * (1 - self.begins) ** np.arange(self.burst)
        return np.append(shares, 1 - self.loss)

    def after(self, shares: Array) -> Array:
        """Return the weights (burst + 1,) of the states one packet later."""
        later = np.empty_like(shares)
        later[1:] = (1 - self.begins) * shares[:-1]
        later[-1] += (1 - self.begins) * shares[-1]
        later[0] = self.begins * shares.sum()
        return later

    def before(self, values: Array) -> Array:
        """Return the expectation (..., burst + 1) of a function of the next state."""
        longer = np.minimum(np.arange(self.burst + 1) + 1, self.burst)
        return self.begins * values[..., :1] + (1 - self.begins) * values[..., longer]

    def none_in_time(self, late: Array) -> float:
        """Return the probability that of consecutive packets each is lost or late.

        The weights of the states are carried from packet to packet; at each the weight of "kept" is
        multiplied with the probability that this packet is late.

        Args:
            late: (n,) probability that each is late if it is not lost.
        """
        shares = self.stationary.copy()
        shares[-1] *= late[0]
        for share in late[1:]:
            shares = self.after(shares)
            shares[-1] *= share
        return float(shares.sum())


NO_LOSSES: Final = BurstChain(0.0, 1)


def losses(number: int, loss: float, burst: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw which of `number` packets are lost: a `BurstChain` from its stationary state."""
    # Bursts of before the first packet have random numbers of their own.
    earlier = np.random.Generator(rng.bit_generator.jumped()).random(burst - 1)  # type: ignore[attr-defined]
    begins = np.append(earlier, rng.random(number)) < BurstChain(loss, burst).begins
    return np.convolve(begins, np.ones(burst), "valid") > 0.5


def packet_times(config: PacketsConfig, number: int, seed: int, stream: int = _FORWARD) -> Array:
    """(number,) s that each packet is under way; infinite for one that is lost."""
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, 0]))
    # Two streams, so that the time of a packet does not depend on how many are lost.
    times = times_under_way(config).ppf(rng.random(number))
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 1, stream, 0]))
    return np.where(losses(number, config.loss, config.burst, rng), np.inf, times)


def forward_times(scenario: Scenario, number: int) -> Array:
    """(number,) s that each packet of torques is under way; infinite for one that is lost."""
    link = scenario.assumed_link
    assert isinstance(link, NetworkConfig)
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


def in_time(config: PacketsConfig, time: ArrayLike) -> Array:
    """Return F: the probability that a packet which is not lost has arrived after `time` s."""
    return np.asarray(times_under_way(config).cdf(np.asarray(time) + 1e-9))


def torque_missing(config: PacketsConfig, bound: float, repeats: int, period: float) -> float:
    """Return the probability that a torque is not there in time, in none of its 1 + r packets.

    Sent one after the other they have B + r dt, ..., B + dt, B left (theory.md, section 25).
    """
    late = 1 - in_time(config, bound + period * np.arange(repeats + 1))
    return BurstChain(config.loss, config.burst).none_in_time(late)


def usual_bound(config: PacketsConfig, repeats: int, period: float) -> float:
    """Return the least bound in s, in whole periods, at which being late is rarer than being lost.

    A longer one cannot bring back what is lost, and costs delay. A torque is missing with a
    probability q(B) that falls to q(inf), that of losing all its packets (`torque_missing`). Wanted
    is the least B with q(B) <= RARE q(inf), or ALMOST_NONE. Bounds beyond MOST_PERIODS, which no
    delay may have, are not tried.
    """
    all_lost = BurstChain(config.loss, config.burst).none_in_time(np.zeros(repeats + 1))
    enough = max(RARE * all_lost, ALMOST_NONE)

    def there(steps: int) -> bool:
        return torque_missing(config, steps * period, repeats, period) <= enough

    return bisect_left(range(MOST_PERIODS + 1), True, key=there) * period


def link_text(scenario: Scenario) -> str | None:
    """Return the assumed network in a few words, None for a wire."""
    link = scenario.assumed_link
    if not isinstance(link, NetworkConfig):
        return None
    if link.distribution == "lognormal":
        times = f"{link.median:g} s in the median, sigma {link.sigma:g}"
    else:
        times = f"{link.low:g} to {link.high:g} s"
    if isinstance(scenario.link, NetworkConfig) and scenario.link.follows_delay:
        delay, period = scenario.delay, scenario.controller.period
        times += (
            f" ({ASSUMED_TIMES[0]:g} to {ASSUMED_TIMES[1]:g} times the delay of "
            f"{Delay(delay.steps, delay.fraction).eta(period):g} s, as link.low and link.high are "
            "null)"
        )
    bursts = f" in bursts of {link.burst}" if link.burst > 1 else ""
    back = "measurements at once" if link.back is None else "measurements over a network too"
    return (
        f"network, packets take {times}, {100 * link.loss:g} % lost{bursts}, play-out bound "
        f"{link.playout:g} s; {back}"
    )
