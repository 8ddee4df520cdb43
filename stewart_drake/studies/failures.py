"""How failing runs differ from the others: counts and rank tests, one by one and in pairs.

Nothing is fitted. For one quantity the failing runs are compared with the others by

    AUC = P(a failing run has the larger value) + P(equal) / 2 = U / (k m),

U of Mann and Whitney, k failing and m other runs; 1/2 where the quantity says nothing. And in plain
counts: how many of the failing, and of the others, lie in the third of all runs on that side.

Two quantities may have to come together. Cut at their medians, the runs fall into four corners. A
pair is said to explain where in a corner, or in two opposite ones, the failing runs are more
frequent than either quantity alone makes them: with a on its side b's side still has more of them,
and with b on its side a's, each by Fisher's exact test; the p-value is the larger of the two. All
p-values are Holm's, over everything that was asked.
"""

from collections.abc import Iterator, Mapping
from itertools import combinations, product
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import ndtri
from scipy.stats import hypergeom, mannwhitneyu

from stewart_drake.studies.statistics import CONFIDENCE, Interval, holm
from stewart_drake.types import Array

Flags = NDArray[np.bool_]

SIGNIFICANT: Final = 0.05
"""Adjusted p-value below which a difference counts as found."""


class Separation(NamedTuple):
    """One quantity in the failing runs and in the others."""

    factor: str
    larger: bool
    """Whether failing runs have the larger values, else the smaller ones."""
    auc: Interval
    """Probability that a failing run has the larger value."""
    p: float
    """Adjusted."""
    bound: float
    """Where the outer third of all runs on that side begins."""
    failing: int
    """Failing runs in that third."""
    others: int
    """Other runs in it."""


class Pair(NamedTuple):
    """Two quantities that together tell more than each alone."""

    factors: tuple[str, str]
    sides: tuple[str, str]
    """`large` or `small`, by their medians; of two opposite corners the first."""
    opposite: bool
    """Whether the opposite corner belongs to it: both large or both small, or just not so."""
    p: float
    """Adjusted."""
    failing: int
    """Failing runs there."""
    others: int
    """Other runs there."""


class Explanation(NamedTuple):
    """What sets the failing runs apart; the lists hold everything asked, the most telling first."""

    failing: int
    others: int
    singles: list[Separation]
    pairs: list[Pair]
    """Only those found, one region of each."""

    @property
    def found(self) -> list[Separation]:
        """Quantities that separate the two beyond chance; of one and its size the more telling."""
        first: dict[str, Separation] = {}
        for one in self.singles:
            if one.p < SIGNIFICANT:
                first.setdefault(one.factor.strip("|"), one)
        return list(first.values())

    @property
    def summary(self) -> dict[str, Any]:
        """Plain data."""
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
    """Compare failing runs with the others.

    Args:
        values: (n,) of every quantity; one that never changes is left out.
        failed: (n,).
    """
    k, m = int(failed.sum()), int((~failed).sum())
    asked = {name: x for name, x in values.items() if np.isfinite(x).all() and np.ptp(x) > 0}
    if not (k and m and asked):
        return Explanation(k, m, [], [])
    singles = [_separation(name, x, failed) for name, x in asked.items()]
    adjusted = holm([one.p for one in singles])
    singles = [one._replace(p=float(p)) for one, p in zip(singles, adjusted, strict=True)]
    singles.sort(key=lambda one: (one.p, -abs(one.auc.value - 0.5)))
    pairs = list(_pairs(asked, failed))
    adjusted = holm([one.p for one in pairs])
    pairs = [one._replace(p=float(p)) for one, p in zip(pairs, adjusted, strict=True)]
    # Where both opposite corners are found, they say more than the one of the two.
    best: dict[tuple[str, str], Pair] = {}
    for one in sorted(pairs, key=lambda one: (not one.opposite, one.p)):
        if one.p < SIGNIFICANT:
            best.setdefault(one.factors, one)
    return Explanation(k, m, singles, sorted(best.values(), key=lambda one: one.p))


def auc_interval(auc: float, failing: int, others: int, confidence: float = CONFIDENCE) -> Interval:
    """AUC with Newcombe's interval (2006, method 5).

    The ends are the A for which |auc - A| is z deviations, with the variance that Hanley and McNeil
    give such an A,

        A (1 - A) (1 + N (1 - A) / (2 - A) + N A / (1 + A)) / (k m),   N = (k + m) / 2 - 1,

    so that like Wilson's they stay in [0, 1] and tell something where the two are quite apart.
    """
    z, half = float(ndtri((1 + confidence) / 2)), (failing + others) / 2 - 1

    def beyond(a: float) -> float:
        spread = 1 + half * (1 - a) / (2 - a) + half * a / (1 + a)
        return (auc - a) ** 2 - z**2 * a * (1 - a) * spread / (failing * others)

    # The estimate itself is a root where it is an end of [0, 1]: just beside it begins the search.
    low = brentq(beyond, 0.0, min(auc, 1 - 1e-12)) if auc > 0 else 0.0
    high = brentq(beyond, max(auc, 1e-12), 1.0) if auc < 1 else 1.0
    return Interval(auc, float(low), float(high))


def _separation(name: str, x: Array, failed: Flags) -> Separation:
    k, m = int(failed.sum()), int((~failed).sum())
    test = mannwhitneyu(x[failed], x[~failed], alternative="two-sided")
    auc = auc_interval(float(test.statistic) / (k * m), k, m)
    larger = auc.value >= 0.5
    bound = float(np.quantile(x, 2 / 3 if larger else 1 / 3))
    outer = x >= bound if larger else x <= bound
    inside = (int(np.sum(outer & failed)), int(np.sum(outer & ~failed)))
    return Separation(name, larger, auc, float(test.pvalue), bound, *inside)


def _pairs(values: Mapping[str, Array], failed: Flags) -> Iterator[Pair]:
    """Every pair of different quantities with every corner, and every two opposite ones."""
    words = {True: "large", False: "small"}
    halves = {name: x > np.median(x) for name, x in values.items()}
    for a, b in combinations(halves, 2):
        if a.strip("|") == b.strip("|"):
            continue  # a quantity and its size
        corners = {
            (u, v): (halves[a] == u, halves[b] == v) for u, v in product((True, False), repeat=2)
        }
        p = {corner: _both_needed(*sides, failed) for corner, sides in corners.items()}
        regions: list[tuple[tuple[tuple[bool, bool], ...], float]]
        regions = [((corner,), p[corner]) for corner in corners]
        for u in (True, False):
            two = ((True, u), (False, not u))
            regions.append((two, max(p[corner] for corner in two)))
        for region, chance in regions:
            there = np.any([np.all(corners[corner], axis=0) for corner in region], axis=0)
            u, v = region[0]
            counts = int(np.sum(there & failed)), int(np.sum(there & ~failed))
            yield Pair((a, b), (words[u], words[v]), len(region) > 1, chance, *counts)


def _both_needed(a: Flags, b: Flags, failed: Flags) -> float:
    """The larger p-value of: b's side has more failing runs where a holds, and a's where b does."""
    return max(_more_often(failed[a], b[a]), _more_often(failed[b], a[b]))


def _more_often(failed: Flags, there: Flags) -> float:
    """Fisher's exact test, one-sided: P(so many of the failing runs are there by chance)."""
    together = int(np.sum(failed & there))
    return float(hypergeom.sf(together - 1, len(failed), int(failed.sum()), int(there.sum())))
