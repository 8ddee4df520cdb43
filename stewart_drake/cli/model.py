"""Machines: new, model check, model sdf, model view."""

import re
import sys
from contextlib import closing
from functools import partial
from pathlib import Path

import typer

import stewart_drake as sd
from stewart_drake.cli.common import (
    Delivery,
    InPlaceOfOutput,
    MechanismName,
    command_line,
    on_interrupt,
    write_or_print,
)
from stewart_drake.cli.options import Given, command
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.reporting.document import PAGE
from stewart_drake.reporting.terminal import echo
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.options import MissingOption, Option, quantity
from stewart_drake.studies.study_options import LARGEST, Measurements

app = typer.Typer(rich_markup_mode=None, help="Check and view a mechanism.")


@app.command()
def sdf(mechanism: MechanismName, out: InPlaceOfOutput = None) -> None:
    """Write a mechanism as SDFormat."""
    write_or_print(partial(sd.model_sdf, mechanism), out)


@app.command()
@command()
def check(*, mechanism: MechanismName, delivery: Delivery) -> int:
    """Check a mechanism and describe it at its home pose, under gravity."""
    from stewart_drake.reporting import mechanism as shown
    from stewart_drake.reporting.style import write_figures

    def draw(folder: Path) -> None:
        write_figures({"mechanism": shown.mechanism_figure(found.mechanism)}, folder)

    found = sd.check_model(mechanism)
    delivery.say(found.table())
    delivery.discard("mechanism.png", "mechanism.svg")
    delivery.write(found.summary)
    delivery.draw("mechanism.png, mechanism.svg", draw)
    return delivery.end(found.summary)


@app.command()
@command(without=("as_json",))
def view(*, mechanism: MechanismName, delivery: Delivery) -> int:
    """Show a mechanism in a browser, with sliders for its pose.

    With --out it writes a page of the home pose, and ends.
    """
    from pydrake.geometry import Meshcat

    from stewart_drake.reporting.viewer import STOP, PoseViewer

    viewer = PoseViewer(sd.load_mechanism(mechanism), Meshcat())
    if delivery.out is not None:
        write_whole(delivery.out / "view.html", viewer.meshcat.StaticHtml())
        delivery.add_files("view.html")
        return delivery.end({})
    # The address is printed also with --quiet.
    echo(f"{STOP!r} or Ctrl-C ends it; showing it at {viewer.meshcat.web_url()}")
    viewer.run(delivery.say)
    return 0


# ---------------------------------------------------------------- a new machine


@command(Measurements, without=("out",))
def new(
    *,
    folder: Path = typer.Argument(metavar="DIR", help="Folder of the files."),
    given: Given,
    form: bool = typer.Option(False, "--form", help="Ask by a form in a browser, with a drawing."),
    delivery: Delivery,
) -> int:
    """Make a machine and a first scenario from a few measurements.

    Asks for the measurements that are not given. A number is in m, kg, s or N m, or has a unit, as
    300 mm or 250 g. Moments of inertia are estimated. Runs the scenario, and writes report.html.
    """
    from stewart_drake.studies import new_machine as study

    delivery = delivery.into(folder, "DIR")
    study.refuse_existing(folder)
    if form:
        from stewart_drake.reporting.machine_form import MachineForm

        with (
            on_interrupt("nothing was written"),
            closing(MachineForm(given.given, "new machine")) as page,
        ):
            # The address is printed also with --quiet.
            echo(f"Ctrl-C ends it; fill in the form at {page.url}", error=delivery.as_json)
            measurements = page.wait()
            status, text = _new(delivery, given, measurements, folder)
            page.show(text)
        return status
    asking = sys.stdin.isatty() and not delivery.silent
    return _new(delivery, given, _measured(given, asking), folder)[0]


def _new(
    delivery: Delivery, given: Given, measurements: Measurements, folder: Path
) -> tuple[int, str]:
    """Write the files; return the exit status and the report as HTML."""
    from stewart_drake import functions
    from stewart_drake.loop.simulation import simulate
    from stewart_drake.reporting.page import Provenance, html
    from stewart_drake.reporting.report import first_report
    from stewart_drake.studies import new_machine as study

    with given.named():
        made = functions.new(folder, _name_of(folder), options=measurements)
    delivery.add_files(study.MACHINE, study.SCENARIO)
    delivery.say(made.table())
    delivery.say_wrapped(*_assumptions(measurements))
    delivery.discard(PAGE)
    delivery.write(made.summary)
    text = ""

    def draw(where: Path) -> None:
        nonlocal text
        result = simulate(load_scenario(folder / study.SCENARIO))
        typed = {name.replace("_", "-"): value for name, value in measurements.model_dump().items()}
        made_by = Provenance(command_line("new", str(folder), options=typed))
        text = html(first_report(made, result, made.findings), made_by)
        write_whole(where / PAGE, text)

    delivery.draw(PAGE, draw)
    status = delivery.end(made.summary)
    following = command_line(
        "simulate", str(folder / study.SCENARIO), options={"out": folder / "run"}
    )
    delivery.say(f"next: {following}")
    return status, text or "The report could not be written; see the terminal."


def _assumptions(measurements: Measurements) -> list[str]:
    """Return a line on the options that have their defaults, or none."""
    usual = []
    for one in Measurements.described():
        if one.required or getattr(measurements, one.name) != one.default:
            continue
        text = f"{one.default:g}" if isinstance(one.default, float) else str(one.default)
        words = {None: f"no --{one.dashed}", True: f"--{one.dashed}"}
        usual.append(words.get(one.default, f"--{one.dashed} {text} {one.unit or ''}".strip()))
    line = f"assumed by default: {', '.join(usual)}; give those that differ on your machine"
    return [line] if usual else []


def _measured(given: Given, asking: bool) -> Measurements:
    """Return the measurements; ask for missing ones, and again for those that do not fit."""
    missing, asked = {one.name: one for one in given.missing}, dict[str, float]()
    while True:
        try:
            return given.options(more=asked)
        except MissingOption:
            if not asking:
                flags = ", ".join(f"--{one.dashed}" for one in given.missing)
                raise ConfigError(
                    f"new: got no {flags}; expected the measurements as options, a terminal to ask "
                    "at, or --form"
                ) from None
            asked = {name: _ask(one) for name, one in missing.items()}
        except ConfigError as error:
            flag = str(error).partition(":")[0]
            name = flag.removeprefix("--").replace("-", "_")
            if name not in asked:
                raise
            echo(f"{error}", error=True)
            asked[name] = _ask(missing[name])


def _ask(one: Option) -> float:
    question, unit = one.help[0].lower() + one.help[1:-1], one.unit or ""
    while True:
        text = str(typer.prompt(question)).strip()
        try:
            value = quantity(one.name, text, unit)
        except ConfigError as error:
            echo(str(error), error=True)
            continue
        bare = text[-1:].isdigit() or text.endswith(".")
        if not (bare and unit == "m" and value > LARGEST):
            return value
        if typer.confirm(f"{value:g} m? {value / 1000:g} m for {value:g} mm", default=True):
            return value / 1000


def _name_of(folder: Path) -> str:
    """Return the name of a machine from its folder, or `machine` if its name is not valid."""
    from stewart_drake.mechanism.geometry import RESERVED_NAMES

    name = re.sub("[^A-Za-z0-9_-]", "_", folder.resolve().name)
    fits = re.match("[A-Za-z]", name) and name not in RESERVED_NAMES
    return name if fits else "machine"
