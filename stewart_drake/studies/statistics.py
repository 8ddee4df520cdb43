"""What a sample of runs tells of all runs: intervals of shares and quantiles, rank correlation."""

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from stewart_drake.types import Array

CONFIDENCE: Final = 0.95
"""Of every interval, unless something else is asked for."""


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval."""

    value: float
    low: float
    high: float


class Correlation(NamedTuple):
    """A rank correlation; all NaN where one of the two never changes or there are under 4 pairs."""

    rho: float
    """Spearman's, -1 to 1."""
    low: float
    high: float
    p_value: float
    """Two-sided, that |rho| is at least so large by chance."""


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Share of successes in independent trials, and Wilson's score interval.

    Unlike s/n -+ z (s/n (1 - s/n) / n)^(1/2) its ends stay in [0, 1] and cover the truth about as
    often as promised even where all trials succeed.

    Raises:
        ValueError: no trials, or successes beyond 0 ... trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"got {successes} of {trials}; expected 0 to all of at least one trial")
    share = successes / trials
    ends = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    # Rounding must not cut the estimate off its own interval.
    return Interval(share, min(share, float(ends.low)), max(share, float(ends.high)))


def least_share(successes: int, trials: int, confidence: float = CONFIDENCE) -> float:
    """Return the lower end of the one-sided Clopper-Pearson interval of a share of successes.

    Where all n trials succeed this is (1 - confidence)^(1/n), which is also the distribution-free
    bound of Wilks: with this confidence at least so large a share of all trials has a value no
    larger than the largest of the n. Both statements are wrong together in at most 1 - confidence
    of all samples if the second is made only where all trials succeed.
    """
    if successes == 0:
        return 0.0
    return float(stats.beta.ppf(1 - confidence, successes, trials - successes + 1))


def quantile_interval(
    values: ArrayLike, probability: float, confidence: float = CONFIDENCE
) -> Interval:
    """A quantile of the distribution behind a sample, whatever that is.

    The number of values below the true quantile is binomial, which tells the ordered values that
    enclose it, each tail with at most half of what is left over. Infinite values, such as of runs
    that failed, are values like all others. Where the sample is too small, an end is infinite.

    Args:
        values: (n,) without NaN.
        probability: above 0, below 1.
        confidence: of the interval.
    """
    x = np.asarray(values, dtype=np.float64)
    if len(x) == 0 or np.isnan(x).any():
        raise ValueError(f"got {len(x)} values, or NaN among them; expected at least one, none NaN")
    ends: Any = stats.quantile_test(x, p=probability).confidence_interval(confidence)
    return Interval(
        float(np.quantile(x, probability, method="inverted_cdf")),
        -np.inf if np.isnan(ends.low) else float(ends.low),
        np.inf if np.isnan(ends.high) else float(ends.high),
    )


def rank_correlation(x: ArrayLike, y: ArrayLike, confidence: float = CONFIDENCE) -> Correlation:
    """Spearman's rank correlation of pairs, with interval and p-value.

    The p-value is of Student's distribution; the interval is Fisher's, atanh rho
    -+ z ((1 + rho^2 / 2) / (n - 3))^(1/2), with the variance of Bonett and Wright (2000).

    Args:
        x, y: (n,) each, without NaN.
        confidence: of the interval.
    """
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if len(a) < 4 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return Correlation(np.nan, np.nan, np.nan, np.nan)
    found = stats.spearmanr(a, b)
    rho = float(np.clip(found.statistic, -1.0, 1.0))
    if abs(rho) > 1 - 1e-12:
        return Correlation(rho, rho, rho, 0.0)
    z = stats.norm.ppf((1 + confidence) / 2)
    half = z * np.sqrt((1 + rho**2 / 2) / (len(a) - 3))
    low, high = np.tanh(np.arctanh(rho) + np.array([-half, half]))
    return Correlation(rho, float(low), float(high), float(found.pvalue))


def holm(p_values: ArrayLike) -> Array:
    """P-values (k,) as they stand when k questions are asked at once: Holm's step-down rule.

    In rising order p_(i) becomes max over j <= i of min(1, (k - j + 1) p_(j)). A NaN, where nothing
    could be asked, stays and is not counted.
    """
    p = np.asarray(p_values, dtype=np.float64)
    asked = np.flatnonzero(np.isfinite(p))
    order = asked[np.argsort(p[asked], kind="stable")]
    adjusted = np.full(p.shape, np.nan)
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, factors * p[order]))
    return adjusted
