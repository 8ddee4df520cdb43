"""Looking at mechanisms: model check, model sdf."""

import os
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.commands.common import MechanismName, check_writable
from stewart_drake.errors import ConfigError

app = typer.Typer(rich_markup_mode=None, help="Look at a mechanism.")


@app.command()
def sdf(
    mechanism: MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Instead of standard output.")
    ] = None,
) -> None:
    """Write a mechanism as SDFormat."""
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.mechanism.sdformat import to_sdformat

    text = to_sdformat(load_mechanism(mechanism))
    if out is None:
        typer.echo(text, nl=False)
        return
    if out.is_dir():
        raise ConfigError(f"--out: got {str(out)!r}, a directory; expected a file")
    check_writable(out.parent)
    partial = out.with_name(f".{out.name}.part")
    partial.write_text(text)
    os.replace(partial, out)


@app.command()
def check(mechanism: MechanismName) -> None:
    """Check a mechanism and describe it at its home pose, under gravity."""
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.report.tables import mechanism_table

    typer.echo(mechanism_table(load_mechanism(mechanism)))
