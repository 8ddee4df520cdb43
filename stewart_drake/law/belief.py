"""What an observer believes: state, parameters, their covariance, delay, what it rejected."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array

THETA = slice(NUM_STATE, None)


@dataclass(frozen=True)
class Estimate:
    """What is known of [state; p parameters].

    Attributes:
        mean: (12 + p,); a state of NaN before there is any.
        covariance: (12 + p, 12 + p); NaN where nothing is estimated.
        outlier: (m,) the last outlier, NaN without one.
        outliers: how many in a row, up to the last measurement, bear each other out.
        unseen: periods since a measurement was last used.
        partly: why values of that were left out, as names of counts.
        root: (12 + p, 12 + p) L with L L' the covariance; NaN where no filter has made one.
    """

    mean: Array
    covariance: Array
    outlier: Array
    outliers: int = 0
    unseen: int = 0
    partly: tuple[str, ...] = ()
    root: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.root is None:
            object.__setattr__(self, "root", np.full_like(self.covariance, np.nan))

    @property
    def state(self) -> Array:
        """(12,)."""
        return self.mean[:NUM_STATE]

    @property
    def parameters(self) -> Array:
        """(p,)."""
        return self.mean[THETA]

    @property
    def parameter_std(self) -> Array:
        """(p,); NaN where nothing is estimated."""
        return np.sqrt(np.diag(self.covariance)[THETA])

    @property
    def uncertain(self) -> bool:
        """Whether there is a covariance."""
        return not np.isnan(self.covariance[0, 0])


@dataclass(frozen=True)
class Belief:
    """What an observer hands to the law, and gets back at the next sample.

    Attributes:
        estimate: of state and parameters.
        timeline: the delay that it believes in.
        measured: (m,) last value of each measured quantity that was there; NaN before any.
        fault: why the model stood in for the last measurement, as the name of a count, or None.
        partly: why it did so for some of its values, the same.
        still: as of `law.sensing.Sensing.stood`.
        feeds_back: whether it is good enough to act on; else the feedforward goes on alone.
        caution: how many times as much torques weigh as they should.
        settled: whether the delay is known.
        found: whether it has just been found, or is another than before.
        delay_mean, delay_std: s, of the delay; NaN where it is not estimated.
    """

    estimate: Estimate
    timeline: Timeline
    measured: Array
    fault: str | None = None
    partly: tuple[str, ...] = ()
    still: Array = field(default_factory=lambda: np.zeros(0))
    feeds_back: bool = True
    caution: float = 1.0
    settled: bool = True
    found: bool = False
    delay_mean: float = math.nan
    delay_std: float = math.nan

    @classmethod
    def nothing(cls, timeline: Timeline, size: int, parameters: Array) -> "Belief":
        """Before any of m = `size` values were measured, with parameters (p,) for a guess."""
        mean = np.concatenate([np.full(NUM_STATE, np.nan), parameters])
        unknown = np.full((len(mean), len(mean)), np.nan)
        return cls(Estimate(mean, unknown, np.full(size, np.nan)), timeline, np.full(size, np.nan))

    @property
    def state(self) -> Array:
        """(12,); NaN before there is any."""
        return self.estimate.state

    @property
    def parameters(self) -> Array:
        """(p,)."""
        return self.estimate.parameters

    @property
    def delay(self) -> Array:
        """(1,) s, as it is estimated, else as it is believed."""
        return np.array([self.timeline.eta if math.isnan(self.delay_mean) else self.delay_mean])

    @property
    def has_state(self) -> bool:
        """Whether there is a state to go on with."""
        return bool(np.all(np.isfinite(self.state)))

    def assuming(self, parameters: Array) -> "Belief":
        """The same with other parameters (p,)."""
        mean = np.concatenate([self.state, parameters])
        return replace(self, estimate=replace(self.estimate, mean=mean))

    def at(self, state: Array) -> "Belief":
        """The same in another state (12,)."""
        mean = np.concatenate([state, self.parameters])
        return replace(self, estimate=replace(self.estimate, mean=mean))
