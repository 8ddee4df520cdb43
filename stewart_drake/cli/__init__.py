"""The stewart-drake command. Commands import Drake when they run, so that --help is fast."""

import errno
import functools
import os
import re
import shlex
import sys
import tempfile
from itertools import pairwise
from typing import Any, Final

import typer

import stewart_drake as sd
from stewart_drake.cli import analyze, identify, live, model, run, tune
from stewart_drake.cli.common import AT_EXIT, INTERRUPTED, named
from stewart_drake.cli.examples import add_examples
from stewart_drake.files.errors import ConfigError, resembling
from stewart_drake.files.resources import KINDS, shipped
from stewart_drake.files.yamlio import accepted
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
        with named(settings="--set"):
            return _command().main(arguments, "stewart-drake", standalone_mode=False) or 0
    except _UsageError as error:
        return _complain(_usage_message(error, words))
    except typer.Abort:  # Ctrl-C
        return _stopped()
    except ImportError as error:  # Drake turns Ctrl-C into nested ones while it is loaded
        cause: BaseException | None = error
        while isinstance(cause, ImportError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            return _stopped()
        raise
    except BrokenPipeError:  # the reader of the output has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except _bad_input() as error:
        no_room = isinstance(error, OSError) and error.errno in _NO_ROOM and not error.filename
        where = f" (standard output, or a file in {tempfile.gettempdir()})" if no_room else ""
        return _complain(f"{error}{where}")
    finally:
        AT_EXIT.close()


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
    command: Any = typer.main.get_command(app)
    invoke = command.invoke

    def noticing(context: Any) -> Any:
        try:
            return invoke(context)
        except KeyboardInterrupt:  # typer would return as after a command that says so itself
            raise typer.Abort from None

    command.invoke = noticing
    return command


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


def _stopped() -> int:
    echo("stopped before the end; files that were written are kept", error=True)
    return INTERRUPTED


def _usage_message(error: Any, words: list[str]) -> str:
    option = getattr(error, "option_name", "").strip("-")
    if option in RENAMED:
        return f"--{option}: got an option of 0.2; expected --{RENAMED[option]}"
    possible = getattr(error, "possibilities", None) or ()
    if near := resembling(option, [one.strip("-") for one in possible]):
        return f"{error.message}; did you mean --{near[0]}?"
    # The context of the error is missing for an option without a value.
    command, path = _command(), "stewart-drake"
    for word in words:
        if word not in getattr(command, "commands", {}):
            break
        command, path = command.commands[word], f"{path} {word}"
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    usage = " ".join([path, "[OPTIONS]", *map(_shown, arguments)])
    message = error.message if possible else error.format_message().rstrip(".")
    message = message.replace(": Value error, ", ": ")  # pydantic's
    if message.endswith("?"):
        return str(message)
    parameter: Any = getattr(error, "param", None)
    if extra := re.fullmatch(r"Got unexpected extra argument[^ ]* \((.*)\)", message):
        hint = "a value with a blank needs quotes"
        message = f"got {extra[1]!r}, which is neither argument nor value; expected {usage}; {hint}"
        if not command.params:
            does = f"{command.help[:1].lower()}{command.help[1:].rstrip('.')}"
            message = f"got {extra[1]!r}; expected {path} alone, to {does}"
    elif parameter in arguments and message.startswith("Missing"):
        message = f"{_shown(parameter)}: got none in {shlex.join(words)!r}; expected {usage}"
        message += f", {parameter.help[:1].lower()}{parameter.help[1:].rstrip('.')}"
    elif found := re.fullmatch(r"Invalid value for '(--\S+)': (Input should .*)", message):
        parts = [part for word in words for part in word.split("=", 1)]
        typed = dict(pairwise(parts)).get(found[1])
        message = f"{found[1]}: got {typed!r}; expected {accepted(found[2])}"
    return f"{message}; see {path} --help"


def _shown(argument: Any) -> str:
    return str(argument.metavar or argument.name.upper())
