"""How failing runs differ from the others, in sentences and tables."""

from collections.abc import Callable

from stewart_drake.reporting.document import Table
from stewart_drake.reporting.words import number
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
        told = "; ".join(
            f"{names(one.factor)}, of which {one.failing} of the {found.failing} have the outer "
            f"third ({_third(one, units)}) against {one.others} of the {found.others} "
            f"(AUC {one.auc.value:.2f}, {one.auc.low:.2f} to {one.auc.high:.2f})"
            for one in found.found[:_TOLD]
        )
        text = f"What tells {total}: {told}."
    else:
        text = f"No single quantity separates {total}."
    if found.pairs:
        told = "; ".join(
            f"{_where(one, names)}, {one.failing} of the {found.failing} against {one.others} of "
            f"the {found.others}"
            for one in found.pairs[:_TOLD]
        )
        text += f" Two together: {told}."
    elif not found.found:
        text += " Nor does a pair of them."
    return text


def failures_tables(found: Explanation, names: Names, units: Names) -> list[Table]:
    """Every quantity asked about, and the pairs that were found."""

    def counts(one: Separation | Pair) -> tuple[str, str]:
        return f"{one.failing} of {found.failing}", f"{one.others} of {found.others}"

    singles = [
        (names(one.factor), _third(one, units), *counts(one), f"{one.auc.value:.2f}",
         f"{one.auc.low:.2f} to {one.auc.high:.2f}", f"{one.p:.2g}")
        for one in found.singles
    ]  # fmt: skip
    head = ("quantity", "its outer third", "of failing runs", "of the others",
            "P(failing larger)", "interval", "adjusted p")  # fmt: skip
    caption = (
        "Failing runs against the others, by Mann and Whitney's rank test; a third of all runs "
        "would lie in the outer third by chance."
    )
    tables = [Table(head, singles, caption)]
    if found.pairs:
        pairs = [(_where(one, names), *counts(one), f"{one.p:.2g}") for one in found.pairs]
        caption = (
            "Pairs, cut at their medians, that tell more together than each alone (Fisher's exact "
            "tests)."
        )
        tables.append(
            Table(("both", "of failing runs", "of the others", "adjusted p"), pairs, caption)
        )
    return tables


def _third(one: Separation, units: Names) -> str:
    return f"{'from' if one.larger else 'up to'} {number(one.bound)} {units(one.factor)}"


def _where(one: Pair, names: Names) -> str:
    a, b = map(names, one.factors)
    text = f"{one.sides[0]} {a} with {one.sides[1]} {b}"
    return f"{text}, or just the opposite" if one.opposite else text
