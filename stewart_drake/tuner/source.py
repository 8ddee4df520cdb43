"""Where the weights of a sample come from while the controller runs, state in and state out.

Weights move along the ratio r = log10(w_Q / w_R), on which alone the gain depends, with
w_Q w_R = 1. From one sample to the next r falls by FALL at the most and rises by RISE: caution is
needed at once, and is given up slowly. A network that says where it begins (`Network.start`) is
limited so; one of the paper's kind moves each weight by a factor, `tuner.source.tune`.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np

from stewart_drake.law.core_law import AnyMemory
from stewart_drake.tuner.features import PEAK, Features, empty_window
from stewart_drake.tuner.network import Network
from stewart_drake.types import Array

MAX_FACTOR: Final = 1.5
"""By which w_Q and w_R change at most from one sample to the next, up or down."""
FALL: Final = 0.35
RISE: Final = 0.15
"""Decades of w_Q / w_R per sample."""
LEAST: Final = -4.0
MOST: Final = 2.0
"""Ratios, log10(w_Q / w_R), that are thought of."""


class Decision(NamedTuple):
    """The weights of a sample.

    Attributes:
        weights: (2,) w_Q and w_R, finite and above zero.
        fell_back: whether who decides had to be passed over.
    """

    weights: Array
    fell_back: bool


class Policy(Protocol):
    """From features to weights."""

    @property
    def first(self) -> Array:
        """(2,) weights of the first sample."""

    def decide(self, values: Array, last: Array) -> Decision:
        """The weights of a sample, from features (18,) and the weights (2,) of the one before."""


def ratio_of(weights: Array) -> float:
    """log10(w_Q / w_R)."""
    return float(np.log10(weights[0] / weights[1]))


def weights_of(ratio: float) -> Array:
    """(2,) w_Q and w_R of a ratio, w_Q w_R = 1."""
    return np.array([10 ** (ratio / 2), 10 ** (-ratio / 2)])


def towards(ratio: float, last: Array) -> Array:
    """Weights (2,) as near a ratio as one sample allows."""
    now = ratio_of(last)
    return weights_of(min(max(ratio, now - FALL), now + RISE))


def tune(
    network: Network, densities: Array, last: Array, fixed: Array, factor: float = MAX_FACTOR
) -> tuple[Array, bool]:
    """The weights of the next sample: clipped to the network's bounds, then limited in rate.

    Weights are scales, so the rate is a factor: last / factor <= w <= last * factor. The gain,
    which depends on w_Q / w_R, sees at most its square.

    Args:
        network: what decides.
        densities: (18,).
        last: (2,) weights of the last sample; NaN before the first, which takes `fixed`.
        fixed: (2,) weights to go back to, at the same rate, where the network's are not finite.
        factor: above 1.

    Returns:
        w_Q and w_R (2,), finite and above zero, and whether the network had to be passed over.
    """
    if not np.all(np.isfinite(last)):
        return fixed, False
    raw = network(densities)
    usable = bool(np.all(np.isfinite(raw)))
    goal = np.clip(raw, *network.bounds) if usable else fixed
    return np.clip(goal, last / factor, last * factor), not usable


@dataclass(frozen=True)
class PaperPolicy:
    """A network as the paper has it, see `tuner.source.tune`.

    Attributes:
        network: what decides.
        first: (2,) weights at the start, and to go back to.
    """

    network: Network
    first: Array

    def decide(self, values: Array, last: Array) -> Decision:
        """See `Policy`."""
        return Decision(*tune(self.network, values, last, self.first))


@dataclass(frozen=True)
class RatioPolicy:
    """A network that begins somewhere, and goes back there where it fails.

    Attributes:
        network: one with a start.
    """

    network: Network

    @property
    def first(self) -> Array:
        """(2,)."""
        start = self.network.start
        assert start is not None
        return start

    def decide(self, values: Array, last: Array) -> Decision:
        """See `Policy`."""
        raw = self.network(values)
        usable = bool(np.all(np.isfinite(raw)))
        goal = np.clip(raw, *self.network.bounds) if usable else self.first
        return Decision(towards(ratio_of(goal), last), not usable)


@dataclass(frozen=True)
class Rule:
    """Two lines: a constant ratio while predictions hold, less and less where they do not,

        r = ratio - slope max(0, x - knee),

    x = log10(nu + 0.1), nu the largest innovation of the last 31 samples over its floor (root mean
    square of the twelve values), the feature `surprise_peak` of `tuner.features`.

    Attributes:
        ratio, slope, knee: see above.
    """

    ratio: float
    slope: float
    knee: float

    @property
    def first(self) -> Array:
        """(2,)."""
        return weights_of(self.ratio)

    def decide(self, values: Array, last: Array) -> Decision:
        """See `Policy`."""
        ratio = self.ratio - self.slope * max(0.0, float(values[PEAK]) - self.knee)
        usable = bool(np.isfinite(ratio))
        goal = min(max(ratio, LEAST), MOST) if usable else self.ratio
        return Decision(towards(goal, last), not usable)


class TunerMemory(NamedTuple):
    """What a tuner carries from one sample to the next.

    Attributes:
        window: of its features.
        law: what the law remembers.
        weights: (2,) of the last sample.
        fallbacks: samples at which who decides was passed over.
    """

    window: Array
    law: AnyMemory
    weights: Array
    fallbacks: int


@dataclass(frozen=True)
class WeightsSource:
    """A tuner: features and a policy.

    Attributes:
        features: what it decides by.
        policy: what decides.
    """

    features: Features
    policy: Policy

    def start(self, law: AnyMemory) -> TunerMemory:
        """Before the first sample of a law."""
        return TunerMemory(empty_window(self.features), law, self.policy.first, 0)

    def decide(self, memory: TunerMemory) -> Decision:
        """The weights of the next sample, from data up to the last one."""
        if np.isnan(memory.window[-1]).all():  # nothing is known before the first
            return Decision(self.policy.first, False)
        return self.policy.decide(self.features.values(memory.window), memory.weights)

    def observe(
        self, memory: TunerMemory, decision: Decision, after: AnyMemory, wanted: Array
    ) -> TunerMemory:
        """After a sample.

        Args:
            memory: before it.
            decision: about it.
            after: what the law remembers since.
            wanted: (12,) pose and rates of the reference there.
        """
        window, ratio = memory.window, ratio_of(decision.weights)
        row = self.features.row(window[-1], memory.law, after, wanted, ratio)
        return TunerMemory(
            np.vstack([window[1:], row]),
            after,
            decision.weights,
            memory.fallbacks + decision.fell_back,
        )
