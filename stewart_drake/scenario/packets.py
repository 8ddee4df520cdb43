"""Transit times and losses of packets, and the play-out bound that follows.

Everything is drawn beforehand from a seed, so that the same scenario gives the same run.
"""

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from stewart_drake.scenario.field_types import MOST_PERIODS
from stewart_drake.scenario.link_config import PacketsConfig
from stewart_drake.types import Array, ArrayLike, Flags

FORWARD, BACK, SENSOR = range(3)  # streams of random numbers of one seed
RARE: Final = 1.5  # accepted share of missing torques, relative to that without late packets
ALMOST_NONE: Final = 1e-3  # accepted share of late torques where no packet is lost


def times_under_way(config: PacketsConfig) -> Any:
    """Return scipy's distribution of the transit time in s."""
    from scipy.stats import lognorm, uniform  # takes a fifth of a second to import

    if config.distribution == "uniform":
        assert config.low is not None and config.high is not None
        return uniform(config.low, max(config.high - config.low, 1e-12))
    assert config.sigma is not None and config.median is not None
    return lognorm(s=config.sigma, scale=config.median)


@dataclass(frozen=True)
class BurstChain:
    """Markov chain of lost packets.

    The state a counts the packets since the last burst began, up to `burst`:

        a+ = 0 with probability p, else min(a + 1, burst)

    A packet is lost where a < burst. It is kept where none of the last `burst` packets began one,
    so that 1 - loss = (1 - p)^burst. The chain reads the same backwards in time.
    """

    loss: float  # share of the packets that are lost
    burst: int  # number of packets that one burst loses

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
        """Return the distribution (burst + 1,) of the state one packet later."""
        later = np.empty_like(shares)
        later[1:] = (1 - self.begins) * shares[:-1]
        later[-1] += (1 - self.begins) * shares[-1]
        later[0] = self.begins * shares.sum()
        return later

    def probability_none_in_time(self, late: Array) -> float:
        """Return the probability that each of consecutive packets is lost or late.

        `late` (n,) is the probability of that for a packet that is not lost.
        """
        shares = self.stationary.copy()
        shares[-1] *= late[0]
        for share in late[1:]:
            shares = self.after(shares)
            shares[-1] *= share
        return float(shares.sum())


NO_LOSSES: Final = BurstChain(0.0, 1)


def losses(number: int, loss: float, burst: int, rng: np.random.Generator) -> Flags:
    """Draw which of `number` packets are lost: a `BurstChain` that begins outside of a burst.

    The packets before the first one arrived: their torques are in the queue of the start.
    """
    begins = rng.random(number) < BurstChain(loss, burst).begins
    return np.convolve(begins, np.ones(burst))[:number] > 0.5


def packet_times(config: PacketsConfig, number: int, seed: int, stream: int = FORWARD) -> Array:
    """Return the transit time (number,) of each packet in s, infinite for a lost one."""
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, 0]))
    # Two streams, so that the time of a packet does not depend on the losses.
    times = times_under_way(config).ppf(rng.random(number))
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 1, stream, 0]))
    return np.where(losses(number, config.loss, config.burst, rng), np.inf, times)


def in_time(config: PacketsConfig, time: ArrayLike) -> Array:
    """Return F, the probability that a packet has arrived after `time` s unless it is lost."""
    return np.asarray(times_under_way(config).cdf(np.asarray(time) + 1e-9))


def torque_missing(config: PacketsConfig, bound: float, repeats: int, period: float) -> float:
    """Return the probability that none of the 1 + r packets with a torque is in time.

    Sent one after the other, they may take B + r dt, ..., B + dt, B (theory.md, section 25).
    """
    late = 1 - in_time(config, bound + period * np.arange(repeats + 1))
    return BurstChain(config.loss, config.burst).probability_none_in_time(late)


def default_bound(config: PacketsConfig, repeats: int, period: float) -> float:
    """Return the least bound in s, in whole periods, with late packets rarer than lost ones.

    A torque is missing with a probability q(B) that falls to q(inf), that of losing all its packets
    (`torque_missing`). The bound is the least B with q(B) <= RARE q(inf), or ALMOST_NONE, and at
    most MOST_PERIODS. A longer bound costs delay and recovers no loss.
    """
    all_lost = BurstChain(config.loss, config.burst).probability_none_in_time(np.zeros(repeats + 1))
    enough = max(RARE * all_lost, ALMOST_NONE)

    def is_enough(steps: int) -> bool:
        return torque_missing(config, steps * period, repeats, period) <= enough

    return bisect_left(range(MOST_PERIODS + 1), True, key=is_enough) * period
