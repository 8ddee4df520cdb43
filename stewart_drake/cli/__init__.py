"""The stewart-drake command. Commands import Drake when they run, so that --help is fast."""

import errno
import functools
import os
import sys
import tempfile
from itertools import pairwise
from typing import Any, Final

import typer

import stewart_drake as sd
from stewart_drake.cli import analyze, identify, live, model, run, tune
from stewart_drake.cli.common import INTERRUPTED, release
from stewart_drake.cli.examples import add_examples
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import KINDS, shipped
from stewart_drake.reporting.terminal import echo
from stewart_drake.studies.options import RENAMED

_BAD_INPUT: Final = 2
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# The base class of usage errors; its module differs between releases of typer.
_UsageError: Final[Any] = typer.BadParameter.__mro__[1]

app = typer.Typer(rich_markup_mode=None)
for _one in (
    *(run.simulate, run.compare, run.export, run.replay, run.export_c, run.setpoints, run.report),
    *(identify.identify, model.new, live.machine, live.live),
):
    app.command()(_one)
analyze.add_analyses(app)
for _name, _group in {"model": model, "analyze": analyze, "tune": tune}.items():
    app.add_typer(_group.app, name=_name)


def main(arguments: list[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: those of the command line by default.

    Returns:
        The exit status: 0; 2 for bad input, with one line on stderr; 130 for Ctrl-C.
    """
    _prepare_surroundings()
    words = sys.argv[1:] if arguments is None else arguments
    for argument in words:
        if any("\ud800" <= letter <= "\udfff" for letter in argument):  # an undecodable byte
            return _complain(f"{argument!r}: is not UTF-8 text; expected names in UTF-8")
    if option := _without_value(words):
        return _complain(f"{option}: got ''; expected a value")
    try:
        return _command().main(arguments, "stewart-drake", standalone_mode=False) or 0
    except _UsageError as error:
        return _complain(_usage_message(error))
    except typer.Abort:  # Ctrl-C
        return INTERRUPTED
    except ImportError as error:  # Drake turns Ctrl-C into nested ones while it is loaded
        cause: BaseException | None = error
        while isinstance(cause, ImportError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            return INTERRUPTED
        raise
    except BrokenPipeError:  # the reader of the output has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except _bad_input() as error:
        no_room = isinstance(error, OSError) and error.errno in _NO_ROOM and not error.filename
        where = f" (standard output, or a file in {tempfile.gettempdir()})" if no_room else ""
        return _complain(f"{error}{where}")
    finally:
        release()


def _without_value(words: list[str]) -> str | None:
    """Return the first option that is given an empty text, or None."""
    for before, word in pairwise(["", *words]):
        option = word.removesuffix("=") if word else before
        if option != word and option.startswith("--") and "=" not in option:
            return option
    return None


@functools.cache
def _command() -> Any:
    add_examples(app)
    return typer.main.get_command(app)


def _prepare_surroundings() -> None:
    """Reopen closed standard streams, and select Matplotlib's backend for files.

    The first opened file would take the number of a closed stream, and with it Drake's messages.
    """
    os.environ["MPLBACKEND"] = "agg"
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            place = os.open(os.devnull, os.O_RDWR)
            os.dup2(place, number)
            if place != number:
                os.close(place)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    show_version: bool = typer.Option(False, "--version", help="Print the version."),
) -> None:
    """Delay-aware control of rotary Stewart platforms, simulated with Drake."""
    if show_version:
        typer.echo(f"stewart-drake {sd.__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command("list")
def list_shipped() -> None:
    """List the shipped models, scenarios and so on."""
    from stewart_drake.reporting.terminal import shipped_table

    for kind, (heading, *_) in KINDS.items():
        if shipped(kind):
            typer.echo(heading)
            typer.echo(shipped_table(kind))


def _bad_input() -> tuple[type[Exception], ...]:
    from stewart_drake.mechanism.kinematics import SingularPoseError, UnreachablePoseError

    return ConfigError, UnreachablePoseError, SingularPoseError, OSError


def _complain(message: str) -> int:
    echo("error: " + " ".join(message.split()), error=True)
    return _BAD_INPUT


def _usage_message(error: Any) -> str:
    option = getattr(error, "option_name", "").removeprefix("--")
    if option in RENAMED:
        return f"--{option}: got an option of 0.2; expected --{RENAMED[option]}"
    if getattr(error, "possibilities", None):
        return f"{error.message}; did you mean {error.possibilities[0]}?"
    message = error.format_message().rstrip(".").replace(": Value error, ", ": ")  # pydantic's
    if message.endswith("?"):
        return message
    command = "stewart-drake" if error.ctx is None else error.ctx.command_path
    return f"{message}; see {command} --help"
