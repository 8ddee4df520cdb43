"""What the command shows on a terminal: coloured text, and how far it has got.

On a terminal that is a bar per running simulation, in a log a line every ten seconds."""

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Final

import typer

_COLORS: Final = {
    "green": r"\bcompleted\b|(?<=beatable: )yes|(?<=loop is )stable",
    "yellow": r"(?<=beatable: )hardly|\binterrupted( at [\d.]+ s)?|\bwarning:",
    "red": r"(?<=beatable: )no\b|\bunstable\b|^error:"
    r"|\b(left workspace|solver failed)( at [\d.]+ s(, leg \d)?)?",
}
EVERY: Final = 10.0
"""s between two lines of progress where there is no terminal."""


def echo(text: str, *, error: bool = False) -> None:
    """Print a line; good and bad words are coloured on a terminal, unless NO_COLOR is set."""
    for color, words in _COLORS.items():
        text = re.sub(words, partial(_styled, color), text)
    try:
        typer.echo(text, err=error, color=False if os.environ.get("NO_COLOR") else None)
    except BrokenPipeError:  # nobody reads on: what is still to be saved is not lost for that
        stream = sys.stderr if error else sys.stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _styled(color: str, match: re.Match[str]) -> str:
    return typer.style(match[0], fg=color)


@contextmanager
def progress_bars(
    names: Iterable[str], duration: float, quiet: bool
) -> Iterator[dict[str, Callable[[float, float], None]]]:
    """A bar per name on a terminal's stderr, else a line now and then, until the context ends.

    Args:
        names: of the runs.
        duration: of each, s.
        quiet: whether to draw nothing.

    Yields:
        By name, a function of simulated time in s and current error in % of peak to peak.
    """
    from tqdm import tqdm

    names, times = tuple(names), dict[str, float]()
    bars = {
        name: tqdm(
            total=duration,
            desc=name,
            position=position,
            leave=False,
            disable=quiet or not _is_terminal(),
            bar_format="{desc:<14}{bar} {n:6.2f} of {total:g} s{postfix}, {remaining} left",
        )
        for position, name in enumerate(names)
    }

    def advance(name: str, time: float, error: float) -> None:
        times[name] = time
        bars[name].set_postfix_str(f"error {error:7.3f} %", refresh=False)
        bars[name].update(time - bars[name].n)

    def state() -> str:
        runs = ", ".join(f"{name} {times[name]:.1f}" for name in names if name in times)
        return f"{runs} of {duration:g} s" if runs else f"{', '.join(names)}: preparing"

    try:
        with _said_now_and_then(state, quiet):
            yield {name: partial(advance, name) for name in names}
    finally:
        for bar in bars.values():
            bar.close()


@contextmanager
def count_bar(
    name: str, quiet: bool, first: str = "preparing"
) -> Iterator[Callable[[int, int], None]]:
    """One bar on a terminal's stderr, else a line now and then, until the context ends.

    Args:
        name: of what is counted.
        quiet: whether to draw nothing.
        first: what is said until it is known how many there are.

    Yields:
        A function of the number done and the number of all.
    """
    from tqdm import tqdm

    hidden = quiet or not _is_terminal()
    count = _Count(first)
    with tqdm(
        total=1,
        desc=name,
        leave=False,
        disable=hidden,
        smoothing=0,  # workers end in bursts: the mean pace of all is the better guess
        bar_format=f"{{desc:<14}}{first}",
    ) as bar:

        def show(done: int, total: int) -> None:
            if count.total != total:
                bar.bar_format = "{desc:<14}{bar} {n_fmt} of {total_fmt}, {remaining} left"
                # What an earlier start has done says nothing of the pace, nor does the time before.
                bar.total, bar.initial, bar.n, bar.last_print_n = total, done, done, done
                bar.start_t = time.time()
                bar.refresh()
            count.set(done, total)
            bar.update(done - bar.n)

        with _said_now_and_then(lambda: f"{name}: {count}", quiet):
            yield show


@contextmanager
def working(name: str, quiet: bool) -> Iterator[None]:
    """A line now and then while something is done of which nothing is counted.

    Args:
        name: of what is done.
        quiet: whether to say nothing.
    """
    with count_bar(name, quiet, "computing"):
        yield


class _Count:
    """How many of how many, and how long the rest will take at the pace so far."""

    def __init__(self, first: str) -> None:
        self._word = first
        self.done = self.total = self._first = 0
        self._start = time.monotonic()

    def set(self, done: int, total: int) -> None:
        if total != self.total:
            self._first, self._start = done, time.monotonic()
        self.done, self.total = done, total

    def __str__(self) -> str:
        if not self.total:
            return self._word
        text = f"{self.done} of {self.total}"
        if self.done > self._first:
            pace = (time.monotonic() - self._start) / (self.done - self._first)
            text += f", about {_duration(pace * (self.total - self.done))} left"
        return text


@contextmanager
def _said_now_and_then(state: Callable[[], str], quiet: bool) -> Iterator[None]:
    """A line of plain text on stderr every `EVERY` s, for logs and pipes; none on a terminal."""
    if quiet or sys.stderr is None or _is_terminal():
        yield
        return
    stop, start = threading.Event(), time.monotonic()

    def say() -> None:
        while not stop.wait(EVERY):
            with suppress(OSError, ValueError):  # whoever reads it is gone
                line = f"{state()}, after {_duration(time.monotonic() - start)}"
                print(line, file=sys.stderr, flush=True)

    thread = threading.Thread(target=say, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _is_terminal() -> bool:
    """Whether stderr is one; it may also be closed."""
    try:
        return sys.stderr is not None and sys.stderr.isatty()
    except ValueError:
        return False


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
