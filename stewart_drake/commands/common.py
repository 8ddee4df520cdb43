"""What the commands share: their usual options, and how they answer."""

import json
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from stewart_drake.errors import ConfigError

INTERRUPTED: Final = 130
"""Exit status after Ctrl-C."""

ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="Shipped name or file.")]
MechanismName = Annotated[str, typer.Argument(metavar="MECHANISM", help="Shipped name or file.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="E.g. plant.gravity=true; repeatable."),
]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="For summary, signals, figures.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, nothing else.")]


def silence(text: str) -> None:
    """Print nothing."""


def print_json(summary: dict[str, Any]) -> None:
    """Print a summary as JSON, NaN as null."""
    from stewart_drake.results import jsonable

    typer.echo(json.dumps(jsonable(summary), indent=2, allow_nan=False))


def check_writable(directory: Path | None) -> None:
    """Make the directory of `--out` if there is none.

    Raises:
        ConfigError: it cannot be written to.
    """
    if directory is None:
        return
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ConfigError(
            f"--out: got {str(directory)!r}; expected a directory that can be written "
            f"({error.strerror})"
        ) from None


def remove(directory: Path, names: Iterable[str]) -> None:
    """Delete files of an earlier run, as far as they exist."""
    for name in names:
        (directory / name).unlink(missing_ok=True)


def open_meshcat() -> Any:
    """A Meshcat server, on a free port."""
    from pydrake.geometry import Meshcat

    return Meshcat()
