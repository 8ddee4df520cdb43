"""What a sample of runs tells of all runs: intervals of shares and quantiles, rank correlation."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, ndtri, stdtr
from scipy.stats import rankdata

Array = NDArray[np.float64]

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

    The ends are the shares p for which |s/n - p| = z (p (1 - p) / n)^(1/2), the roots of a
    quadratic. Unlike s/n -+ z (s/n (1 - s/n) / n)^(1/2) they stay in [0, 1] and cover the truth
    about as often as promised even where all trials succeed.

    Raises:
        ValueError: no trials, or successes beyond 0 ... trials.
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"got {successes} of {trials}; expected 0 to all of at least one trial")
    z, share = float(ndtri((1 + confidence) / 2)), successes / trials
    # n p^2 - 2 n share p + n share^2 = z^2 (p - p^2), solved for p.
    middle = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * np.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2)) / (1 + z**2 / trials)
    # Rounding must not cut the estimate off its own interval.
    low, high = min(share, middle - half), max(share, middle + half)
    return Interval(share, max(0.0, float(low)), min(1.0, float(high)))


def quantile_interval(
    values: ArrayLike, probability: float, confidence: float = CONFIDENCE
) -> Interval:
    """A quantile of the distribution behind a sample, whatever that is.

    The number of values below the true quantile is binomial, K ~ B(n, p), so that the ordered
    values x_(l), x_(u) enclose it with the probability P(l <= K < u): l and u are taken so that
    each tail has half of what is left over. Infinite values, such as of runs that failed, are
    values like all others. Where the sample is too small, an end is infinite.

    Args:
        values: (n,) without NaN.
        probability: above 0, below 1.
        confidence: of the interval.

    Raises:
        ValueError: no values, or NaN among them.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    n = len(ordered)
    if n == 0 or np.isnan(ordered).any():
        raise ValueError(f"got {n} values, or NaN among them; expected at least one, none NaN")
    below = bdtr(np.arange(n + 1), n, probability)  # P(K <= k)
    tail = (1 - confidence) / 2
    # The rank l is the largest with P(K <= l - 1) <= tail; u the least with P(K >= u) <= tail.
    lower = int(np.searchsorted(below, tail, side="right"))
    upper = int(np.searchsorted(below, 1 - tail, side="left")) + 1
    bounded = np.concatenate([[-np.inf], ordered, [np.inf]])
    rank = max(1, int(np.ceil(n * probability - 1e-9)))
    return Interval(float(ordered[rank - 1]), float(bounded[lower]), float(bounded[upper]))


def rank_correlation(x: ArrayLike, y: ArrayLike, confidence: float = CONFIDENCE) -> Correlation:
    """Spearman's rank correlation of pairs, with interval and p-value.

    rho is Pearson's correlation of the ranks, ties sharing their mean rank. Under independence
    t = rho ((n - 2) / (1 - rho^2))^(1/2) follows Student's distribution of n - 2 degrees; the
    interval is Fisher's, atanh rho -+ z ((1 + rho^2 / 2) / (n - 3))^(1/2), with the variance of
    Bonett and Wright (2000).

    Args:
        x, y: (n,) each, without NaN.
        confidence: of the interval.
    """
    pair = [np.asarray(values, dtype=np.float64) for values in (x, y)]
    n = len(pair[0])
    # The mean rank is (n + 1) / 2, ties or not.
    a, b = (rankdata(values) - (n + 1) / 2 for values in pair)
    length = float(np.sqrt((a @ a) * (b @ b)))
    if n < 4 or length == 0:
        return Correlation(np.nan, np.nan, np.nan, np.nan)
    rho = float(np.clip(a @ b / length, -1.0, 1.0))
    if abs(rho) > 1 - 1e-12:
        return Correlation(rho, rho, rho, 0.0)
    t = rho * np.sqrt((n - 2) / (1 - rho**2))
    half = float(ndtri((1 + confidence) / 2)) * np.sqrt((1 + rho**2 / 2) / (n - 3))
    low, high = np.tanh(np.arctanh(rho) + np.array([-half, half]))
    return Correlation(rho, float(low), float(high), float(2 * stdtr(n - 2, -abs(t))))


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
