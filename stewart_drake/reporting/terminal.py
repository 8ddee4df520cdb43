"""What the command shows on a terminal: coloured text, lists, and how far it has got.

On a terminal that is a bar per running simulation, in a log a line every ten seconds."""

import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from stewart_drake.reporting.document import rows

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from stewart_drake.files.resources import Kind

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


def shipped_table(kind: "Kind") -> str:
    """Return the shipped files of a kind, each with the first sentence of its opening comment."""
    from stewart_drake.files.resources import resolve, shipped

    return rows({f"  {name}": _description(resolve(kind, name)) for name in shipped(kind)})


def _description(path: Path) -> str:
    if path.suffix == ".json":  # which has no comments
        from stewart_drake.tuner.network import NUM_INPUTS, NUM_OUTPUTS, load_network

        network = load_network(path)
        low, high = network.bounds.min(), network.bounds.max()
        return (
            f"A network of {NUM_INPUTS} densities ({network.density}), {network.hidden} hidden "
            f"neurons and {NUM_OUTPUTS} weights from {low:g} to {high:g}"
        )
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))
    text = " ".join(line.strip("# ") for line in comment[0].splitlines()) if comment else ""
    return text.partition(". ")[0].rstrip(".")


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
    names, times = tuple(names), dict[str, float]()

    def advance(name: str, time: float, error: float) -> None:
        times[name] = time
        text = f"{time:6.2f} of {duration:g} s, error {error:7.3f} %"
        bars.update(tasks[name], completed=time, state=_with_rest(text, bars, tasks[name]))

    def state() -> str:
        runs = ", ".join(f"{name} {times[name]:.1f}" for name in names if name in times)
        return f"{runs} of {duration:g} s" if runs else f"{', '.join(names)}: preparing"

    with _bars(quiet) as bars, _said_now_and_then(state, quiet):
        tasks = {name: bars.add_task(name, total=duration, state="preparing") for name in names}
        yield {name: partial(advance, name) for name in names}


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
    with _bars(quiet) as bars:
        task = bars.add_task(name, total=None, state=first)

        def show(done: int, total: int) -> None:
            if bars.tasks[0].total != total:
                # What an earlier start has done says nothing of the pace, nor does the time before.
                bars.reset(task, total=total, completed=done)
                bars.advance(task, 0)  # from here on
            bars.update(task, completed=done)
            bars.update(task, state=_with_rest(f"{done} of {total}", bars, task))

        with _said_now_and_then(lambda: f"{name}: {bars.tasks[0].fields['state']}", quiet):
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


def _bars(quiet: bool) -> "Progress":
    """Bars with what the field `state` says; none where there is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(
        TextColumn("{task.description:<13}"),
        BarColumn(None),
        TextColumn("{task.fields[state]}"),
        console=Console(stderr=True, highlight=False),
        expand=True,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        speed_estimate_period=1e9,  # workers end in bursts: the mean pace of all is better
        disable=quiet or not _is_terminal(),
    )


def _with_rest(text: str, bars: "Progress", task: "TaskID") -> str:
    """The text, and as far as that is known how long the rest of the task will take."""
    left = next(one.time_remaining for one in bars.tasks if one.id == task)
    return text if left is None else f"{text}, about {_duration(left)} left"


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
    """Whether stderr is one that can draw; it may also be closed."""
    try:
        drawing = os.environ.get("TERM") not in ("dumb", "unknown")
        return drawing and sys.stderr is not None and sys.stderr.isatty()
    except ValueError:
        return False


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
