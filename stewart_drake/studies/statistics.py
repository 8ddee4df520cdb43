"""Statistics of a sample of runs: shares, quantiles, correlations, and how failing runs differ.

Nothing is fitted. For one quantity the failing runs are compared with the others by

    AUC = P(a failing run has the larger value) + P(equal) / 2 = U / (k m),

U of Mann and Whitney, k failing and m other runs; 1/2 for a quantity without influence. Plain
counts support it: how many of the failing, and of the others, lie in the outer third of all runs on
that side.

Two quantities may be needed together. Cut at their medians, the runs fall into four corners. A pair
explains failures if in a corner, or in two opposite ones, failing runs are more frequent than
either quantity alone makes them: among the runs on a's side b's side still has more of them, and
among those on b's side a's, each by Fisher's exact test; the p-value is the larger of the two. All
p-values are Holm's, over all questions.
"""

import math
from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import combinations, product
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import brentq

from stewart_drake.types import Array, ArrayLike, Flags

CONFIDENCE: Final = 0.95
_DEVIATIONS: Final = float(stats.norm.ppf((1 + CONFIDENCE) / 2))
"""Half width of an interval in standard deviations."""


class Interval(NamedTuple):
    """An estimate and the ends of its confidence interval."""

    value: float
    low: float
    high: float


class Correlation(NamedTuple):
    """Spearman's rank correlation with its interval and two-sided p-value.

    All are NaN if one of the two never changes, or for fewer than 4 pairs.
    """

    rho: float
    low: float
    high: float
    p_value: float


def wilson_interval(successes: int, trials: int, confidence: float = CONFIDENCE) -> Interval:
    """Return the share of successes in independent trials, with Wilson's score interval.

    Unlike those of s/n -+ z (s/n (1 - s/n) / n)^(1/2) its ends stay in [0, 1], and the coverage is
    close to the nominal one even if all trials succeed.
    """
    share = successes / trials
    ends = stats.binomtest(successes, trials).proportion_ci(confidence, method="wilson")
    # Rounding must not cut the estimate off its own interval.
    return Interval(share, min(share, float(ends.low)), max(share, float(ends.high)))


def least_share(successes: int, trials: int) -> float:
    """Return the lower end of the one-sided Clopper-Pearson interval of a share of successes.

    If all n trials succeed this is (1 - CONFIDENCE)^(1/n), which is also the distribution-free
    bound of Wilks: with this confidence at least this share of all trials has a value no larger
    than the largest of the n. Both statements are wrong together in at most 1 - CONFIDENCE of all
    samples if the second is made only when all trials succeed.
    """
    if successes == 0:
        return 0.0
    return float(stats.beta.ppf(1 - CONFIDENCE, successes, trials - successes + 1))


def quantile_interval(values: ArrayLike, probability: float) -> Interval:
    """Return a quantile of the distribution behind a sample, distribution-free.

    The number of values below the true quantile is binomial, which gives the ordered values that
    enclose it, each tail with at most half of the rest. Infinite values, such as of failed runs,
    are values like all others; NaN is none. If the sample is too small, an end is infinite.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    low, high = _enclosing(len(ordered), probability)
    return Interval(
        float(np.quantile(ordered, probability, method="inverted_cdf")),
        -np.inf if low is None else float(ordered[low]),
        np.inf if high is None else float(ordered[high]),
    )


def runs_to_bound(probability: float) -> int:
    """Return the least number of values for which `quantile_interval` has an upper end.

    The true quantile lies above all n with probability p^n, for a quantile p of 0.5 or more.
    """
    return math.ceil(math.log((1 - CONFIDENCE) / 2) / math.log(probability))


@lru_cache(maxsize=256)
def _enclosing(number: int, probability: float) -> tuple[int | None, int | None]:
    """Return the places in order of the values that enclose a quantile; None where there is none.

    They depend on the size of a sample only, so the sample here is its own order.
    """
    order = np.arange(number)
    ends: Any = stats.quantile_test(order, p=probability).confidence_interval(CONFIDENCE)
    low, high = (None if np.isnan(end) else round(end) for end in (ends.low, ends.high))
    return low, high


def rank_correlation(x: ArrayLike, y: ArrayLike) -> Correlation:
    """Return Spearman's rank correlation of pairs, with interval and p-value.

    The p-value is of Student's distribution; the interval is Fisher's, atanh rho
    -+ z ((1 + rho^2 / 2) / (n - 3))^(1/2), with the variance of Bonett and Wright (2000).
    """
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if len(a) < 4 or np.all(a == a[0]) or np.all(b == b[0]):
        return Correlation(np.nan, np.nan, np.nan, np.nan)
    found = stats.spearmanr(a, b)
    rho = float(np.clip(found.statistic, -1.0, 1.0))
    if abs(rho) > 1 - 1e-12:
        return Correlation(rho, rho, rho, 0.0)
    half = _DEVIATIONS * np.sqrt((1 + rho**2 / 2) / (len(a) - 3))
    low, high = np.tanh(np.arctanh(rho) + np.array([-half, half]))
    return Correlation(rho, float(low), float(high), float(found.pvalue))


def holm(p_values: ArrayLike) -> Array:
    """Return p-values (k,) adjusted for k questions at once, by Holm's step-down rule.

    In rising order p_(i) becomes max over j <= i of min(1, (k - j + 1) p_(j)). A NaN stays and is
    not counted.
    """
    p = np.asarray(p_values, dtype=np.float64)
    asked = np.flatnonzero(np.isfinite(p))
    order = asked[np.argsort(p[asked], kind="stable")]
    adjusted = np.full(p.shape, np.nan)
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, factors * p[order]))
    return adjusted


# ---------------------------------------------------------------- how failing runs differ


SIGNIFICANT: Final = 0.05
"""Adjusted p-value below which a difference counts as found."""


class Separation(NamedTuple):
    """One quantity in the failing runs and in the others."""

    factor: str  # name of the quantity
    larger: bool  # whether failing runs have the larger values, else the smaller ones
    auc: Interval  # probability that a failing run has the larger value
    p: float  # adjusted p-value
    bound: float  # begin of the outer third of all runs on that side
    failing: int  # number of runs in that third
    others: int  # number of runs in that third


class Pair(NamedTuple):
    """Two quantities that together separate failing runs better than each alone."""

    factors: tuple[str, str]  # names of the quantities
    # `large` or `small`, by their medians; of two opposite corners the first
    sides: tuple[str, str]
    opposite: bool  # whether the opposite corner belongs to it
    p: float  # adjusted p-value
    failing: int  # number of runs there
    others: int  # number of runs there


class Explanation(NamedTuple):
    """Differences between failing and other runs, the clearest first.

    `singles` has all quantities, `pairs` only those found, with one region each.
    """

    failing: int
    others: int
    singles: list[Separation]
    pairs: list[Pair]

    @property
    def found(self) -> list[Separation]:
        """Quantities that separate the two beyond chance; of one and its size the clearer one."""
        first: dict[str, Separation] = {}
        for one in self.singles:
            if one.p < SIGNIFICANT:
                first.setdefault(one.factor.strip("|"), one)
        return list(first.values())

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "failing": self.failing,
            "others": self.others,
            "singles": [
                one._asdict() | {"auc": one.auc._asdict(), "found": one.p < SIGNIFICANT}
                for one in self.singles
            ],
            "pairs": [one._asdict() for one in self.pairs],
        }


def explain(values: Mapping[str, Array], failed: Flags) -> Explanation:
    """Compare failing runs with the others, in every quantity (n,) that is not constant."""
    k, m = int(failed.sum()), int((~failed).sum())
    asked = {name: x for name, x in values.items() if np.isfinite(x).all() and np.ptp(x) > 0}
    if not (k and m and asked):
        return Explanation(k, m, [], [])
    singles = _adjusted([_separation(name, x, failed) for name, x in asked.items()])
    singles.sort(key=lambda one: (one.p, -abs(one.auc.value - 0.5)))
    pairs = _adjusted(list(_pairs(asked, failed)))
    # Two opposite corners come before each of them alone.
    best: dict[tuple[str, str], Pair] = {}
    for one in sorted(pairs, key=lambda one: (not one.opposite, one.p)):
        if one.p < SIGNIFICANT:
            best.setdefault(one.factors, one)
    return Explanation(k, m, singles, sorted(best.values(), key=lambda one: one.p))


def _adjusted(found: list[Any]) -> list[Any]:
    p_values = holm([one.p for one in found])
    return [one._replace(p=float(p)) for one, p in zip(found, p_values, strict=True)]


def auc_interval(auc: float, failing: int, others: int) -> Interval:
    """Return the AUC with Newcombe's interval (2006, method 5).

    The ends are those A for which |auc - A| is z deviations, with the variance of Hanley and McNeil
    for that A,

        A (1 - A) (1 + N (1 - A) / (2 - A) + N A / (1 + A)) / (k m),   N = (k + m) / 2 - 1,

    so that like Wilson's they stay in [0, 1], also if the two groups do not overlap.
    """
    z, half = _DEVIATIONS, (failing + others) / 2 - 1

    def beyond(a: float) -> float:
        spread = 1 + half * (1 - a) / (2 - a) + half * a / (1 + a)
        return (auc - a) ** 2 - z**2 * a * (1 - a) * spread / (failing * others)

    # An estimate of 0 or 1 is a root itself: the search begins next to it.
    low = brentq(beyond, 0.0, min(auc, 1 - 1e-12)) if auc > 0 else 0.0
    high = brentq(beyond, max(auc, 1e-12), 1.0) if auc < 1 else 1.0
    return Interval(auc, float(low), float(high))


def _separation(name: str, x: Array, failed: Flags) -> Separation:
    k, m = int(failed.sum()), int((~failed).sum())
    test = stats.mannwhitneyu(x[failed], x[~failed], alternative="two-sided")
    auc = auc_interval(float(test.statistic) / (k * m), k, m)
    larger = auc.value >= 0.5
    bound = float(np.quantile(x, 2 / 3 if larger else 1 / 3))
    outer = x >= bound if larger else x <= bound
    inside = (int(np.sum(outer & failed)), int(np.sum(outer & ~failed)))
    return Separation(name, larger, auc, float(test.pvalue), bound, *inside)


def _pairs(values: Mapping[str, Array], failed: Flags) -> Iterator[Pair]:
    """Yield every pair of different quantities with every corner, and every two opposite ones."""
    words = {True: "large", False: "small"}
    halves = {name: x > np.median(x) for name, x in values.items()}
    for a, b in combinations(halves, 2):
        if a.strip("|") == b.strip("|"):
            continue  # a quantity and its size
        corners = {
            (u, v): (halves[a] == u, halves[b] == v) for u, v in product((True, False), repeat=2)
        }
        # Both are needed: b matters among the runs with a, and a among those with b.
        p = {
            corner: max(_more_often(failed[x], y[x]), _more_often(failed[y], x[y]))
            for corner, (x, y) in corners.items()
        }
        opposite = [((True, u), (False, not u)) for u in (True, False)]
        for region in [*((corner,) for corner in corners), *opposite]:
            there = np.any([np.all(corners[corner], axis=0) for corner in region], axis=0)
            chance, (u, v) = max(p[corner] for corner in region), region[0]
            counts = int(np.sum(there & failed)), int(np.sum(there & ~failed))
            yield Pair((a, b), (words[u], words[v]), len(region) > 1, chance, *counts)


def _more_often(failed: Flags, there: Flags) -> float:
    """Return P(at least this number of failing runs by chance), Fisher's exact test, one-sided."""
    together = int(np.sum(failed & there))
    return float(stats.hypergeom.sf(together - 1, len(failed), int(failed.sum()), int(there.sum())))
