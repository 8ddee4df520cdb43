"""Machines: new, model check, model sdf, model view."""

import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from stewart_drake.cli.common import (
    AsJson,
    Delivery,
    MechanismName,
    Quiet,
    check_file,
    open_meshcat,
)
from stewart_drake.cli.options import Given, with_options
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.reporting.terminal import echo
from stewart_drake.studies.study_options import LARGEST, Measurements

if TYPE_CHECKING:
    from stewart_drake.studies.options import Option

app = typer.Typer(rich_markup_mode=None, help="Check and view a mechanism.")


@app.command()
def sdf(
    mechanism: MechanismName,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="File to write, in place of standard output."),
    ] = None,
) -> None:
    """Write a mechanism as SDFormat."""
    from stewart_drake.functions import model_sdf

    text = model_sdf(mechanism)
    if out is None:
        typer.echo(text, nl=False)
    else:
        check_file(out)
        write_whole(out, text)
        echo(f"written to {out}")


@app.command()
def check(
    mechanism: MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of summary and drawing.")
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
        Path | None, typer.Option(metavar="DIR", help="Write a page of the home pose, and end.")
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
    # The address is printed also with --quiet.
    echo(f"showing it at {viewer.meshcat.web_url()}, ends with {STOP!r} there or Ctrl-C")
    viewer.run(delivery.say)


# ---------------------------------------------------------------- a new machine


@with_options(Measurements)
def new(
    *,
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the two files.")],
    given: Given,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Make a machine and a first scenario from a few measurements.

    Asks for the measurements that are not given. Lengths in m, masses in kg; moments of inertia
    are estimated.
    """
    from stewart_drake.reporting.mechanism import document
    from stewart_drake.studies import new_machine as study
    from stewart_drake.studies.verdict import Verdict, loop_verdict

    delivery = Delivery(folder, quiet, as_json)
    study.check_free(folder)
    asked = _asked(given.missing, sys.stdin.isatty() and not (quiet or as_json))
    measurements = given.options(more=asked)
    with given.named():
        made = study.new_machine(measurements, _name_of(folder), folder)
    margin = made.margin
    delay = Verdict(margin.eta, margin.pole, margin.pole_time)
    delivery.say(document(made.check).plain())
    delivery.say_wrapped(made.verdict, loop_verdict(margin), str(delay))
    delivery.wrote(study.MACHINE, study.SCENARIO)
    delivery.write(made.summary)
    status = delivery.end(made.summary)
    delivery.say(f"next: stewart-drake simulate {folder / study.SCENARIO} --out {folder / 'run'}")
    return status


def _asked(missing: "list[Option]", asking: bool) -> dict[str, float]:
    """Ask for missing measurements at a terminal; elsewhere they are an error."""
    if missing and not asking:
        flags = ", ".join("--" + one.name.replace("_", "-") for one in missing)
        raise ConfigError(
            f"new: got no {flags}; expected the measurements as options, or a terminal to ask at"
        )
    return {one.name: _ask(one.help[0].lower() + one.help[1:-1]) for one in missing}


def _ask(question: str) -> float:
    while True:
        value = float(typer.prompt(question, type=float))
        if not (question.endswith(", m") and value > LARGEST):
            return value
        if typer.confirm(f"{value:g} m? {value / 1000:g} m for {value:g} mm", default=True):
            return value / 1000


def _name_of(folder: Path) -> str:
    """Return the name of a machine from its folder, or `machine` if its name is not valid."""
    from stewart_drake.mechanism.geometry import RESERVED_NAMES

    name = re.sub("[^A-Za-z0-9_-]", "_", folder.resolve().name)
    fits = re.match("[A-Za-z]", name) and name not in RESERVED_NAMES
    return name if fits else "machine"
