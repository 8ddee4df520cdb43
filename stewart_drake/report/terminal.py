"""What the command shows on a terminal: coloured text, and a bar per running simulation."""

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import typer

if TYPE_CHECKING:
    from tqdm import tqdm

_COLORS: Final = {
    "green": r"\bcompleted\b|(?<=beatable: )yes",
    "yellow": r"(?<=beatable: )hardly|\binterrupted( at [\d.]+ s)?",
    "red": r"(?<=beatable: )no\b|^error:"
    r"|\b(left workspace|solver failed)( at [\d.]+ s(, leg \d)?)?",
}


def echo(text: str, *, error: bool = False) -> None:
    """Print a line; good and bad words are coloured on a terminal, unless NO_COLOR is set."""
    for color, words in _COLORS.items():
        text = re.sub(words, partial(_styled, color), text)
    typer.echo(text, err=error, color=False if os.environ.get("NO_COLOR") else None)


def _styled(color: str, match: re.Match[str]) -> str:
    return typer.style(match[0], fg=color)


@contextmanager
def progress_bars(
    names: Iterable[str], duration: float, quiet: bool
) -> Iterator[dict[str, Callable[[float, float], None]]]:
    """A bar per name on stderr, if that is a terminal, until the context ends.

    Args:
        names: of the runs.
        duration: of each, s.
        quiet: whether to draw nothing.

    Yields:
        By name, a function of simulated time in s and current error in % of peak to peak.
    """
    from tqdm import tqdm

    bars = {
        name: tqdm(
            total=duration,
            desc=name,
            position=position,
            leave=False,
            disable=quiet or not sys.stderr.isatty(),
            bar_format="{desc:<14}{bar} {n:6.2f} of {total:g} s{postfix}",
        )
        for position, name in enumerate(names)
    }
    try:
        yield {name: partial(_advance, bar) for name, bar in bars.items()}
    finally:
        for bar in bars.values():
            bar.close()


@contextmanager
def count_bar(name: str, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """One bar on stderr, if that is a terminal, until the context ends.

    Args:
        name: of what is counted.
        quiet: whether to draw nothing.

    Yields:
        A function of the number done and the number of all.
    """
    from tqdm import tqdm

    form = "{desc:<14}{bar} {n_fmt} of {total_fmt}"
    hidden = quiet or not sys.stderr.isatty()
    with tqdm(total=0, desc=name, leave=False, disable=hidden, bar_format=form) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def _advance(bar: "tqdm[Any]", time: float, error: float) -> None:
    bar.set_postfix_str(f"error {error:7.3f} %", refresh=False)
    bar.update(time - bar.n)
