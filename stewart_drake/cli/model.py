"""Looking at mechanisms: model check, model sdf, model view."""

from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    AsJson,
    Delivery,
    MechanismName,
    Quiet,
    check_file,
    open_meshcat,
)
from stewart_drake.files.fileio import write_whole
from stewart_drake.reporting.terminal import echo

app = typer.Typer(rich_markup_mode=None, help="Look at a mechanism.")


@app.command()
def sdf(
    mechanism: MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Instead of standard output.")
    ] = None,
) -> None:
    """Write a mechanism as SDFormat."""
    from stewart_drake.functions import model_sdf

    text = model_sdf(mechanism)
    if out is None:
        typer.echo(text, nl=False)
        return
    check_file(out)
    write_whole(out, text)
    echo(f"written to {out}")


@app.command()
def check(
    mechanism: MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="For summary and a drawing.")
    ] = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> None:
    """Check a mechanism and describe it at its home pose, under gravity."""
    from stewart_drake.functions import check_model
    from stewart_drake.reporting.mechanism import document

    def draw(folder: Path) -> None:
        from stewart_drake.reporting.mechanism import write_mechanism_figure

        write_mechanism_figure(found.mechanism, folder)

    delivery = Delivery(out, quiet, as_json)
    found = check_model(mechanism)
    delivery.say(document(found).plain())
    delivery.discard("mechanism.png", "mechanism.svg")
    delivery.write(found.summary)
    delivery.draw("mechanism.png, mechanism.svg", draw)
    delivery.end(found.summary)


@app.command()
def view(
    mechanism: MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="For a page of the home pose; then end.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Show a mechanism in a browser, with sliders for its pose."""
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.reporting.viewer import STOP, PoseViewer

    delivery = Delivery(out, quiet)
    viewer = PoseViewer(load_mechanism(mechanism), open_meshcat())
    if out is not None:
        write_whole(out / "view.html", viewer.meshcat.StaticHtml())
        delivery.wrote("view.html")
        delivery.end({})
        return
    # A reader needs the address even when everything else is quiet.
    echo(f"showing it at {viewer.meshcat.web_url()}, ends with {STOP!r} there or Ctrl-C")
    viewer.run(delivery.say)
