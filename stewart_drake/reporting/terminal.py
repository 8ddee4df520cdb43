"""Terminal output: coloured text, the list of shipped files, and progress.

Progress is a bar per run on a terminal, and a line every ten seconds in a log or pipe.
"""

import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import typer

from stewart_drake.reporting.document import rows, wrap

if TYPE_CHECKING:
    from rich.progress import Progress

    from stewart_drake.files.resources import Kind

_COLORS: Final = {
    "green": r"\bcompleted\b|(?<=[s)] )can be compensated|(?<=loop is )stable(?=:)",
    "yellow": r"can hardly be compensated|stable in exact arithmetic only|\bwarning:"
    r"|\binterrupted( at [\d.]+ s)?",
    "red": r"cannot be compensated|\bunstable\b|^error:"
    r"|\b(left workspace|solver failed)( at [\d.]+ s(, leg \d)?)?",
}
_FEWEST: Final = 4
"""Number of finished pieces from which the time left is estimated."""
EVERY: Final = 10.0
"""Time between two lines of progress without a terminal, s."""


def echo(text: str, *, error: bool = False) -> None:
    """Print a text, with verdicts coloured on a terminal unless NO_COLOR is set."""
    for color, words in _COLORS.items():
        text = re.sub(words, typer.style(r"\g<0>", fg=color), text)
    try:
        typer.echo(text, err=error, color=False if os.environ.get("NO_COLOR") else None)
    except BrokenPipeError:  # the reader has left; the files are still to be written
        stream = sys.stderr if error else sys.stdout
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def shipped_table(kind: "Kind") -> str:
    """Return the shipped files of a kind, each with the first sentence of its opening comment."""
    from stewart_drake.files.resources import resolve, shipped

    return rows({f"  {name}": _description(kind, resolve(kind, name)) for name in shipped(kind)})


def _description(kind: "Kind", path: Path) -> str:
    if kind == "move":
        return str(json.loads(path.read_text(encoding="utf-8"))["description"]).rstrip(".")
    if kind == "weights":  # a network, without comments
        from stewart_drake.tuner.network import NUM_INPUTS, NUM_OUTPUTS, load_network

        network = load_network(path)
        low, high = network.bounds.min(), network.bounds.max()
        inputs, family = f"densities ({network.density})", network.card.get("family")
        if network.features == "health":
            inputs = "features of the estimator's health"
        return (
            f"A network of {NUM_INPUTS} {inputs}, {network.hidden} hidden "
            f"neurons and {NUM_OUTPUTS} weights from {low:g} to {high:g}"
        ) + (f", trained on faults {family} (theory.md, section 34)" if family else "")
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))
    text = " ".join(line.strip("# ") for line in comment[0].splitlines()) if comment else ""
    return text.partition(". ")[0].rstrip(".")


@contextmanager
def progress_bars(
    names: Iterable[str], duration: float, quiet: bool
) -> Iterator[dict[str, Callable[[float, float], None]]]:
    """Show the progress of simulations of `duration` s each on stderr.

    Yields:
        By name, a function of simulated time in s and current error in % of peak to peak.
    """
    names, times = tuple(names), dict[str, float]()

    def advance(name: str, time: float, error: float) -> None:
        times[name] = time
        text = f"{time:6.2f} of {duration:g} s, error {error:7.3f} %"
        left = next(one.time_remaining for one in bars.tasks if one.id == tasks[name])
        text += "" if left is None else f", about {_duration(left)} left"
        bars.update(tasks[name], completed=time, state=text)

    def state() -> str:
        runs = ", ".join(f"{name} {times[name]:.1f}" for name in names if name in times)
        return f"{runs} of {duration:g} s" if runs else f"{', '.join(names)}: preparing"

    with _bars(quiet, state) as bars:
        tasks = {name: bars.add_task(name, total=duration, state="preparing") for name in names}
        yield {name: partial(advance, name) for name in names}


@contextmanager
def count_bar(
    name: str, quiet: bool, first: str = "preparing"
) -> Iterator[Callable[[int, int], None]]:
    """Show on stderr how many of several pieces are done; `first` until their number is known.

    Yields:
        A function of the number done and the number of all.
    """

    def show(done: int, total: int) -> None:
        if done and bars.tasks[0].total is None and not quiet:
            echo(f"{name}: {total}, {done} from before", error=True)
        now = (time.monotonic(), done)
        if bars.tasks[0].total != total:
            # The pace is measured from here: an earlier start may have done some of them.
            finished[:] = [now]
        finished.append(now)
        bars.update(task, total=total, completed=done, state=_Counted(total, finished))

    finished = list[tuple[float, int]]()

    with _bars(quiet, lambda: f"{name}: {bars.tasks[0].fields['state']}") as bars:
        task = bars.add_task(name, total=None, state=first)
        yield show


class _Counted(NamedTuple):
    """Text of a bar with the time left, by the mean pace of the later half until now.

    Args:
        finished: times, s, and the number of pieces done by then, the first at the start.
    """

    total: int
    finished: list[tuple[float, int]]

    def __format__(self, _: str) -> str:
        before, done = self.finished[0][1], self.finished[-1][1]
        text = f"{done} of {self.total}"
        if done < _FEWEST or not before < done < self.total:
            return text
        since, first = next(one for one in reversed(self.finished) if one[1] <= (before + done) / 2)
        left = (self.total - done) * (time.monotonic() - since) / (done - first)
        return f"{text}, about {_duration(max(left, 1.0))} left"


@contextmanager
def phase_bar(name: str, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Show on stderr the phase of a computation; yields a function of its text."""
    with _bars(quiet, lambda: f"{name}: {bars.tasks[0].fields['state']}") as bars:
        task = bars.add_task(name, total=None, state="computing")
        yield lambda text: bars.update(task, state=text)


@contextmanager
def _bars(quiet: bool, state: Callable[[], str]) -> "Iterator[Progress]":
    """Show bars on a terminal's stderr, and the line `state()` every `EVERY` s elsewhere."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    try:  # stderr may be closed
        terminal = sys.stderr is not None and sys.stderr.isatty()
        terminal &= os.environ.get("TERM") not in ("dumb", "unknown")
    except ValueError:
        terminal = False
    bars = Progress(
        TextColumn("{task.description:<13}"),
        BarColumn(None),
        TextColumn("{task.fields[state]}"),
        console=Console(stderr=True, highlight=False),
        expand=True,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        speed_estimate_period=1e9,  # workers end in bursts: take the mean pace of all
        disable=quiet or not terminal,
    )
    stop, start = threading.Event(), time.monotonic()

    def print_lines() -> None:
        while not stop.wait(EVERY):
            with suppress(OSError, ValueError):  # the reader may have left
                line = f"{state()}, after {_duration(time.monotonic() - start)}"
                print(wrap(line), file=sys.stderr, flush=True)

    if not (quiet or terminal or sys.stderr is None):
        threading.Thread(target=print_lines, daemon=True).start()
    try:
        with bars:
            yield bars
    finally:
        stop.set()


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    if minutes < 10:
        return f"{minutes} min {rest} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
