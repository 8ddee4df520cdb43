"""Words and numbers for a person, at a terminal of 80 columns and elsewhere."""

import math
import re
import textwrap
from collections.abc import Mapping
from typing import Final

WIDTH: Final = 80
_NO_BREAK: Final = "\N{NO-BREAK SPACE}"
_TOGETHER: Final = (
    r"(?<=\d) (?=(?:%|mm|ms|s|N|mN|kg|deg)(?!\w))|(?<=N) (?=m\b)|(?<=\d %) (?=s\b)|(?<=beatable:) "
)
"""Spaces at which no line is broken: before a unit and in it."""


def wrap(text: str, first: str = "", rest: str = "  ") -> str:
    """One paragraph of at most WIDTH columns, its first line and the others opened as given."""
    together = re.sub(_TOGETHER, _NO_BREAK, text)
    filled = textwrap.fill(
        together, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )
    return filled.replace(_NO_BREAK, " ")


def rows(entries: Mapping[str, str]) -> str:
    """Names and texts in two columns, long texts wrapped."""
    indent = " " * (max(map(len, entries)) + 2)
    return "\n".join(wrap(text, name.ljust(len(indent)), indent) for name, text in entries.items())


def number(value: float, digits: int = 3) -> str:
    """So many significant digits; a dash where there is no number."""
    if not math.isfinite(value):
        return "-"
    if value != 0 and not 1e-4 <= abs(value) < 1e5:
        return f"{value:.0e}"
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.{max(0, decimals)}f}"


def capital(text: str) -> str:
    """With a capital letter."""
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """With a capital letter and a full stop."""
    return capital(text).removesuffix(".") + "."
