"""How failing runs differ from the others, in sentences and tables."""

from collections.abc import Callable

from stewart_drake.report.page import Table
from stewart_drake.report.tables import number
from stewart_drake.studies.failures import Explanation, Pair, Separation

Names = Callable[[str], str]
"""From a quantity to its words."""

_TOLD = 3
"""Quantities, and pairs, that a sentence names."""


def failures_sentence(found: Explanation, names: Names, units: Names) -> str:
    """What sets failing runs apart, or that nothing does; empty where none or all fail."""
    if not (found.failing and found.others):
        return ""
    total = f"the {found.failing} failing runs from the other {found.others}"
    if found.found:
        told = "; ".join(_single(one, found, names, units) for one in found.found[:_TOLD])
        text = f"What tells {total}: {told}."
    else:
        text = f"No single quantity separates {total}."
    if found.pairs:
        told = "; ".join(_pair(one, found, names) for one in found.pairs[:_TOLD])
        text += f" Two together: {told}."
    elif not found.found:
        text += " Nor does a pair of them."
    return text


def failures_tables(found: Explanation, names: Names, units: Names) -> list[Table]:
    """Every quantity asked about, and the pairs that were found."""
    lines = [
        (
            names(one.factor),
            f"{'from' if one.larger else 'up to'} {number(one.bound)} {units(one.factor)}",
            f"{one.failing} of {found.failing}",
            f"{one.others} of {found.others}",
            f"{one.auc.value:.2f}",
            f"{one.auc.low:.2f} to {one.auc.high:.2f}",
            f"{one.p:.2g}",
        )
        for one in found.singles
    ]
    head = ("quantity", "its outer third", "of failing runs", "of the others",
            "P(failing larger)", "interval", "adjusted p")  # fmt: skip
    tables = [
        Table(
            head,
            lines,
            "Failing runs against the others, by Mann and Whitney's rank test; a third of all runs "
            "would lie in the outer third by chance.",
        )
    ]
    if found.pairs:
        pairs = [
            (_where(one, names), f"{one.failing} of {found.failing}",
             f"{one.others} of {found.others}", f"{one.p:.2g}")
            for one in found.pairs
        ]  # fmt: skip
        caption = (
            "Pairs, cut at their medians, that tell more together than each alone (Fisher's exact "
            "tests)."
        )
        tables.append(
            Table(("both", "of failing runs", "of the others", "adjusted p"), pairs, caption)
        )
    return tables


def _single(one: Separation, found: Explanation, names: Names, units: Names) -> str:
    side = "from" if one.larger else "up to"
    return (
        f"{names(one.factor)}, of which {one.failing} of the {found.failing} have the outer third "
        f"({side} {number(one.bound)} {units(one.factor)}) against {one.others} of the "
        f"{found.others} (AUC {one.auc.value:.2f}, {one.auc.low:.2f} to {one.auc.high:.2f})"
    )


def _pair(one: Pair, found: Explanation, names: Names) -> str:
    return (
        f"{_where(one, names)}, {one.failing} of the {found.failing} against {one.others} of the "
        f"{found.others}"
    )


def _where(one: Pair, names: Names) -> str:
    a, b = map(names, one.factors)
    text = f"{one.sides[0]} {a} with {one.sides[1]} {b}"
    return f"{text}, or just the opposite" if one.opposite else text
