"""Options that commands share, and the output of results."""

import contextlib
import fcntl
import json
import os
import shlex
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials, unwritable, write_whole
from stewart_drake.files.resources import Kind, shipped
from stewart_drake.reporting.document import PAGE, WIDTH, counted, wrap
from stewart_drake.reporting.terminal import echo
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario, setting_choices, title_of

if TYPE_CHECKING:
    from stewart_drake.reporting.results import AnalysisResult
    from stewart_drake.studies.jobs import Progress

INTERRUPTED: Final = 130
"""Exit status after Ctrl-C."""
TERMINATED: Final = 143
"""Exit status after SIGTERM."""
SIGNALS: Final = set[int]()
"""Signals that have asked this process to end."""

RESUMABLE: Final = "finished runs are kept, the same command goes on from there"
"""Text after Ctrl-C of commands that continue."""
AT_EXIT: Final = contextlib.ExitStack()
"""Clean-up when the running command ends: unlock directories, and remove new ones if empty."""


def _shipped_argument(kind: Kind) -> Any:
    def complete(incomplete: str) -> list[str]:
        return [name for name in shipped(kind) if name.startswith(incomplete)]

    help = f"Shipped name, file, or folder with {kind}.yaml."
    return typer.Argument(metavar=kind.upper(), help=help, autocompletion=complete)


def _complete_setting(incomplete: str) -> list[str]:
    """Return completions of `--set`: field names, and the values of fields with few values."""
    return [text for text in setting_choices() if text.startswith(incomplete)]


ScenarioName = Annotated[str, _shipped_argument("scenario")]
MechanismName = Annotated[str, _shipped_argument("mechanism")]
Settings = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="FIELD=VALUE",
        help="Set a field, such as plant.gravity=true; repeatable.",
        autocompletion=_complete_setting,
    ),
]
Controller = Annotated[
    str | None, typer.Option(metavar="NAME|FILE", help="Controller in place of the scenario's.")
]
Out = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Folder of summary, figures and data.")
]
InPlaceOfOutput = Annotated[
    Path | None,
    typer.Option("--out", metavar="FILE", help="File to write, in place of standard output."),
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, nothing else.")]


class Chosen(NamedTuple):
    """A scenario as chosen on the command line."""

    scenario: ScenarioName = "paper"
    controller: Controller = None
    settings: Settings = []

    def load(self, *settings: str) -> Scenario:
        """Return the scenario with these settings, which the typed ones may replace."""
        return load_scenario(self.scenario, self.controller, (*settings, *self.settings))

    @property
    def title(self) -> str:
        return title_of(self.scenario)

    def line(self, *words: str, **options: object) -> str:
        """Return the command of these words with its options as typed, see `command_line`."""
        own = {"controller": self.controller} | options
        return command_line(*words, self.scenario, settings=self.settings, options=own)


def command_line(
    *words: str, settings: Iterable[str] = (), options: Mapping[str, object] | None = None
) -> str:
    """Return a command as typed: words, `--set` for each setting, and options that are not None.

    An option with a list or tuple is repeated for each item; one that is on or off has no value.
    """
    parts = ["stewart-drake", *words]
    for name, value in {"set": list(settings), **(options or {})}.items():
        for one in value if isinstance(value, list | tuple) else (value,):
            if isinstance(one, bool):
                parts.append(f"--{name}" if one else f"--no-{name}")
            elif one is not None:
                parts += [f"--{name}", str(one)]
    return shlex.join(parts)


def check_writable(directory: Path | None, *, alone: bool = True) -> None:
    """Make the directory of `--out`, and check that files can be written there.

    Args:
        directory: of the output; nothing is done for None.
        alone: whether to lock it against other commands until this one ends.
    """
    if directory is None:
        return
    try:
        made = [path for path in (directory, *directory.parents) if not path.exists()]
        directory.mkdir(parents=True, exist_ok=True)
        AT_EXIT.callback(_remove_empty, made)
        with tempfile.TemporaryFile(dir=directory):
            pass
        if alone:
            # A lock on the directory itself leaves no file and ends with the process.
            lock = os.open(directory, os.O_RDONLY)
            AT_EXIT.callback(os.close, lock)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        remove_partials(directory)
    except BlockingIOError:
        raise ConfigError(
            f"--out: got {str(directory)!r}, where another command is writing; wait for it to end, "
            "or choose another directory"
        ) from None
    except (OSError, ValueError) as error:  # a ValueError for a zero byte in the name
        raise unwritable("--out", directory, error) from None


@contextlib.contextmanager
def named(**options: str) -> Iterator[None]:
    """Replace the name of a parameter in an error by the option that sets it."""
    try:
        yield
    except ConfigError as error:
        name, colon, rest = str(error).partition(":")
        error.args = (f"{options.get(name, name)}{colon}{rest}",)
        raise


def check_file(path: Path | None, option: str = "--out") -> None:
    """Check that a file can be written, and make its directory; `option` names it in errors."""
    if path is None:
        return
    if path.exists() and not path.is_file():
        kind = "a directory" if path.is_dir() else "no regular file"
        raise ConfigError(f"{option}: got {str(path)!r}, {kind}; expected a file")
    with named(**{"--out": option}):
        check_writable(path.parent, alone=False)


def write_or_print(text: Callable[[], str], out: Path | None) -> None:
    check_file(out)
    if out is None:
        typer.echo(text(), nl=False)
    else:
        write_whole(out, text())
        echo(f"written to {out}")


def check_log(path: Path | None) -> None:
    """Check that the log of `--log` can be written and has a known suffix."""
    if path is not None:
        from stewart_drake.scenario.run_log import kind_of_log

        check_file(path, "--log")
        kind_of_log(path, "--log")


def _remove_empty(directories: list[Path]) -> None:
    with contextlib.suppress(OSError):
        for path in directories:
            path.rmdir()


def interrupt(number: int, _frame: object) -> None:
    """Handle a signal as Ctrl-C. `timeout` may send it twice, so a repeated one is ignored."""
    if number not in SIGNALS:
        SIGNALS.add(number)
        raise KeyboardInterrupt


@contextlib.contextmanager
def on_interrupt(text: str) -> Iterator[Callable[["Progress"], "Progress"]]:
    """End the command on Ctrl-C, and print the finished part and `text`.

    Yields:
        A function that returns a progress which counts the finished part.
    """
    finished = ""

    def noted(show: "Progress") -> "Progress":
        def count(done: int, total: int) -> None:
            nonlocal finished
            finished = f"{done} of {total} finished; "
            show(done, total)

        return count

    try:
        yield noted
    except KeyboardInterrupt:
        echo(f"stopped; {finished}{text}", error=True)
        raise typer.Exit(INTERRUPTED) from None


class Delivery:
    """Output of a command: text, and files in a folder; made before the computation.

    Args:
        out: directory of `--out`, or None; see `check_writable`.
        quiet, as_json: options of the command.
    """

    def __init__(self, out: Out = None, quiet: Quiet = False, as_json: AsJson = False) -> None:
        check_writable(out)
        self.out, self.quiet, self.as_json, self.silent = out, quiet, as_json, quiet or as_json
        self._written: list[str] = []

    def into(self, out: Path, name: str = "--out") -> "Delivery":
        """Return the same output, into a directory; `name` is that of its parameter in errors."""
        with named(**{"--out": name}):
            return Delivery(out, self.quiet, self.as_json)

    @property
    def folder(self) -> Path:
        assert self.out is not None
        return self.out

    def say(self, text: str) -> None:
        """Print a text, unless `--quiet` or `--json` is given."""
        if not self.silent:
            echo(text)

    def say_wrapped(self, *lines: str) -> None:
        """Print lines, each wrapped at 80 columns."""
        for line in lines:
            self.say(wrap(line))

    def say_link(self, scenario: Scenario) -> None:
        from stewart_drake.scenario.link import link_text

        if text := link_text(scenario):
            self.say_wrapped(f"link: {text}")

    def discard(self, *names: str) -> None:
        """Delete the summary and these files of an earlier run."""
        if self.out is not None:
            for name in ("summary.json", *names):
                (self.out / name).unlink(missing_ok=True)

    def write(self, summary: Mapping[str, Any]) -> None:
        from stewart_drake.files.jsonio import write_json

        if self.out is not None:
            write_json(self.out / "summary.json", summary)
            self.add_files("summary.json")

    def draw(self, what: str, draw: Callable[[Path], Any]) -> None:
        """Write figures or a page after the results.

        `draw` writes into a folder. An error in drawing is only a warning, since the results are
        written already. An OSError, as on a full disk, is raised.
        """
        if self.out is None:
            return
        try:
            found = draw(self.out)
        except OSError:
            raise
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            text = f"warning: {what} could not be drawn ({reason}); everything else is kept"
            echo(text, error=True)
        else:
            self.add_files(counted(len(found), "figures") if what == "figures" else what)

    def add_files(self, *names: str) -> None:
        """Add names to the files that `end` prints."""
        self._written += names

    def answer(
        self, found: "AnalysisResult", *files: str, interrupted: bool = False, page: str = PAGE
    ) -> int:
        """Print an analysis, write summary.json and the page, and return the exit status."""
        self.say(str(found))
        self.discard(page)  # a page of an earlier run would contradict the new numbers
        self.write(found.summary)
        self.draw(page, lambda folder: found.write_page(folder, page))
        self.add_files(*files)
        return self.end(found.summary, interrupted)

    def end(self, summary: Mapping[str, Any], interrupted: bool = False) -> int:
        """Print the names of the written files, or the summary as JSON; return the exit status."""
        from stewart_drake.files.jsonio import jsonable

        if self.out is not None:
            head, files = f"written to {self.out}:", ", ".join(self._written)
            short = len(head) + 1 + len(files) <= WIDTH
            self.say(f"{head} {files}" if short else f"{head}\n{wrap(files, '  ')}")
        if self.as_json:  # NaN as null
            typer.echo(json.dumps(jsonable(summary), indent=2, allow_nan=False))
        return INTERRUPTED if interrupted else 0
