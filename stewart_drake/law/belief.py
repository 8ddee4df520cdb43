"""Result of an observer: state, parameters, their covariance, and the delay."""

import math
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple

import numpy as np

from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array

THETA = slice(NUM_STATE, None)
TOLERATED: Final = 1.1
"""Factor on the ratio up to which an estimator counts as consistent."""
CHANGING: Final = 0.05
"""Share of the measurements at which parameters change by chance."""
CHANCE: Final = 3.0
"""Standard deviations of the ratio that chance explains."""


@dataclass(frozen=True)
class Estimate:
    """Mean and covariance of [state; p parameters].

    Attributes:
        mean: (12 + p,); a state of NaN before the first measurement.
        covariance: (12 + p, 12 + p); NaN where nothing is estimated.
    """

    mean: Array
    covariance: Array

    @property
    def state(self) -> Array:
        """Pose and rates (12,)."""
        return self.mean[:NUM_STATE]

    @property
    def parameters(self) -> Array:
        """Parameters (p,) of the plant and the sensor."""
        return self.mean[THETA]

    @property
    def parameter_std(self) -> Array:
        """Standard deviations (p,); NaN where nothing is estimated."""
        return np.sqrt(np.diag(self.covariance)[THETA])

    @property
    def covariance_root(self) -> Array:
        """A root L (12 + p, 12 + p) of the covariance, L L'."""
        return root_of(self.covariance)

    @property
    def uncertain(self) -> bool:
        """Whether there is a covariance."""
        return not np.isnan(self.covariance[0, 0])


def root_of(covariance: Array) -> Array:
    """Return a root L (n, n) of a covariance that may be singular, L L'."""
    w, V = np.linalg.eigh(covariance)
    return np.asarray(V * np.sqrt(np.maximum(w, 0.0)))


class Innovations(NamedTuple):
    """Consistency of the stated uncertainty with the measurements.

    An innovation nu is a measurement minus its prediction, S its stated covariance. If both state
    and covariance are right, nu' S^-1 nu of n values has the mean n: the normalised innovation
    squared (Bar-Shalom, Li, Kirubarajan, Estimation with Applications, section 5.4).

    Attributes:
        chi2: sum of nu' S^-1 nu over the measurements that were used.
        num_values: number of values in them.
        changed_values: number of values at which parameters had to change, see core/noise.h.
    """

    chi2: float = 0.0
    num_values: float = 0.0
    changed_values: float = 0.0

    @property
    def ratio(self) -> float:
        """chi^2 per value, 1 where the stated uncertainty is right; NaN without measurements."""
        return self.chi2 / self.num_values if self.num_values else math.nan

    @property
    def verdict(self) -> Literal["consistent", "cautious", "overconfident"] | None:
        """Result of the test, None with too few measurements.

        The ratio is below 1 / TOLERATED (`cautious`) or above TOLERATED (`overconfident`) by more
        than chance explains: its standard deviation is sqrt(2 / num_values). Parameters that were
        assumed to be constant and had to change are `overconfident` too.
        """
        chance = CHANCE * math.sqrt(2 / self.num_values) if self.num_values else math.inf
        if not chance < 1:
            return None
        if self.changed_values > CHANGING * self.num_values:
            return "overconfident"
        if self.ratio > TOLERATED * (1 + chance):
            return "overconfident"
        return "cautious" if self.ratio < (1 - chance) / TOLERATED else "consistent"


@dataclass(frozen=True)
class Belief:
    """Estimate after a sample, which the observer gets back at the next one.

    Attributes:
        estimate: of state and parameters.
        timeline: clock with the estimated delay.
        measured: (m,) last valid value of each measured quantity; NaN before the first.
        faults: causes for which the model replaced the last measurement or a part of it, as
            names of counts.
        partial: number of these that concern single values only.
        feeds_back: whether the estimate may be fed back; otherwise the feedforward acts alone.
        caution: factor on the weight of torques.
        settled: whether the delay is known.
        found: whether the delay was found, or changed, at this sample.
        delay_mean, delay_std: s, of the delay; NaN where it is not estimated.
        timing: s, standard deviation of the timing of single torques; 0 where it is not learnt.
        innovations: since the estimator's last start.
        memory: numbers of an observer of the core.
    """

    estimate: Estimate
    timeline: Timeline
    measured: Array
    faults: tuple[str, ...] = ()
    partial: int = 0
    feeds_back: bool = True
    caution: float = 1.0
    settled: bool = True
    found: bool = False
    delay_mean: float = math.nan
    delay_std: float = math.nan
    timing: float = 0.0
    innovations: Innovations = field(default_factory=Innovations)
    memory: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def nothing(cls, timeline: Timeline, size: int, parameters: Array) -> "Belief":
        """Return the belief before the first of `size` values, with parameters (p,)."""
        mean = np.concatenate([np.full(NUM_STATE, np.nan), parameters])
        unknown = np.full((len(mean), len(mean)), np.nan)
        return cls(Estimate(mean, unknown), timeline, np.full(size, np.nan))

    @property
    def state(self) -> Array:
        """State (12,); NaN before the first measurement."""
        return self.estimate.state

    @property
    def parameters(self) -> Array:
        return self.estimate.parameters

    @property
    def delay(self) -> Array:
        """Delay (1,) in s: the estimate, or the assumed one."""
        return np.array([self.timeline.eta if math.isnan(self.delay_mean) else self.delay_mean])

    @property
    def has_state(self) -> bool:
        """Whether the state is finite."""
        return bool(np.all(np.isfinite(self.state)))

    def assuming(self, parameters: Array) -> "Belief":
        """Return the belief with other parameters (p,)."""
        mean = np.concatenate([self.state, parameters])
        return replace(self, estimate=replace(self.estimate, mean=mean))

    def at(self, state: Array) -> "Belief":
        """Return the belief in another state (12,)."""
        mean = np.concatenate([state, self.parameters])
        return replace(self, estimate=replace(self.estimate, mean=mean))
