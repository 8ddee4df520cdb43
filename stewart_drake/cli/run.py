"""Running scenarios: simulate, compare, report, export, export-c."""

import select
import sys
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

import stewart_drake as sd
from stewart_drake.cli.common import (
    Chosen,
    Delivery,
    InPlaceOfOutput,
    check_file,
    check_log,
    check_writable,
    named,
    write_or_print,
)
from stewart_drake.cli.options import command
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.reporting.document import PAGE, Caution, counted
from stewart_drake.reporting.terminal import count_bar, echo, phase_bar, progress_bars
from stewart_drake.scenario.loading import load_compatible

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat

CSV: Final = "signals.csv"
REPLAY: Final = "replay.html"
RUN_FIGURES: Final = ("states", "errors", "torques", "parameters", "delay", "weights")
"""All that `draw_run` may return; those of an earlier run are deleted."""
COMPARED_FIGURES: Final = ("states", "errors", "weights")
OF_CONTROLLERS: Final = ("torques", "delay")
"""All that `draw_comparison` may return, of all controllers and of each."""


@command()
def simulate(
    *,
    chosen: Chosen,
    csv: bool = typer.Option(False, "--csv", help="Also write signals.csv; needs --out."),
    replay: bool = typer.Option(
        False, "--replay", help="Write replay.html, a 3-D animation; needs --out."
    ),
    log: Path | None = typer.Option(
        None, metavar="FILE", help="Log to write during the run, .mcap or .csv."
    ),
    meshcat: bool = typer.Option(
        False, "--meshcat", help="Show the run in a browser, live and as a replay."
    ),
    delivery: Delivery,
) -> int:
    """Run one scenario."""
    from pydrake.geometry import Meshcat

    from stewart_drake.loop.cautions import cautions_before
    from stewart_drake.loop.controller_margin import controller_margin, over_wire
    from stewart_drake.loop.preparation import prepare
    from stewart_drake.reporting.run import run_document
    from stewart_drake.studies.verdict import Verdict, scenario_verdict

    for option, given in (("--csv", csv), ("--replay", replay)):
        if given and delivery.out is None:
            raise ConfigError(f"{option}: got it without --out; expected --out DIR to write into")
    experiment, name = prepare(chosen.load()), chosen.title
    check_log(log)
    viewer = Meshcat() if meshcat else None
    delivery.say_link(experiment.scenario)
    margin = judged = controller_margin(experiment)
    if margin.problem and experiment.scenario.link.kind == "network":
        judged = controller_margin(over_wire(experiment))
    delivery.say_wrapped(scenario_verdict(experiment, judged))
    if experiment.scenario.controller.command == "torque":
        delivery.say_wrapped(str(Verdict.of(judged)))
    said = cautions_before(experiment, margin)
    for text in said:
        if not margin.problem or margin.problem not in text:  # which the verdict has
            delivery.say(Caution(text).plain())
    if viewer is not None:
        _await_viewer(viewer)
    with progress_bars([name], experiment.scenario.duration, delivery.quiet) as progress:
        result = sd.simulate(
            experiment, progress=progress[name], meshcat=viewer, judge_stability=margin, log=log
        )
    delivery.say(run_document(result, said).plain())

    def film(folder: Path) -> None:
        result.replay(folder / REPLAY, mechanism=experiment.truth, title=name)

    # The summary is written last of the results: where it exists, the signals are of the same run.
    delivery.discard(CSV, REPLAY, *_pictures(RUN_FIGURES))
    if delivery.out is not None:
        if csv:
            from stewart_drake.reporting.csv_file import signals_csv

            write_whole(delivery.out / CSV, signals_csv(result.signals))
        result.save(delivery.out)
        delivery.add_files("summary.json", "signals.nc", *[CSV] * csv)
    delivery.draw("figures", result.plot)
    if replay or meshcat:
        delivery.draw(REPLAY, film)
    if log is not None:
        delivery.say(f"log written to {log}")
    status = delivery.end(result.summary, interrupted=result.status == "interrupted")
    if viewer is not None:
        result.replay(meshcat=viewer, mechanism=experiment.truth)
        if sys.stdin.isatty():
            input(f"Enter ends the replay at {viewer.web_url()} ")
    return status


def _await_viewer(viewer: "Meshcat") -> None:
    """Print the address, also with --quiet; at a terminal wait until it is opened."""
    interactive = sys.stdin.isatty()
    start = "starts when it is opened, or with Enter; " if interactive else ""
    echo(f"{start}showing it live at {viewer.web_url()}", error=True)
    while interactive and viewer.GetNumActiveConnections() == 0:
        if select.select([sys.stdin], [], [], 0.1)[0]:
            sys.stdin.readline()
            return


def _pictures(names: Iterable[str]) -> list[str]:
    return [f"{name}.{suffix}" for name in names for suffix in ("png", "svg")]


def export(
    signals: Path = typer.Argument(
        metavar="FILE", help="signals.nc, log (.mcap, .csv), or run's folder."
    ),
    out: InPlaceOfOutput = None,
) -> None:
    """Convert saved signals to CSV.

    A line per instant; the header has the unit of each column.
    """
    write_or_print(partial(sd.export_csv, signals), out)


def replay(
    log: Path = typer.Argument(
        metavar="LOG", help="Log (.mcap, .csv), signals.nc, or run's folder."
    ),
    out: Path = typer.Option(REPLAY, metavar="FILE", help="Page to write."),
) -> None:
    """Write a log as a 3-D animation, one HTML file."""
    check_file(out)
    with named(out="--out"):
        sd.replay_log(log, out)
    echo(f"written to {out}")


@command()
def export_c(
    *,
    chosen: Chosen,
    out: Path = typer.Option("out/export-c", metavar="DIR", help="Folder to write."),
    single: bool = typer.Option(False, "--single", help="Use single precision."),
) -> None:
    """Write the controller as C, for a board.

    A folder that builds with its own Makefile; its test replays a run of the scenario.
    """
    from stewart_drake.export.controller import changed

    check_writable(out)
    with phase_bar("export-c", False) as show:
        show("simulating the run, compiling and replaying it")
        files = sd.export_c(chosen.scenario, out, *chosen[1:], single=single)
    echo(f"written to {out}: {len(files)} files; make test replays the run")
    if kept := changed(out):
        echo(f"kept, as changed since the last export: {', '.join(kept)}; delete to write anew")


@command(scenario="reachy_mini")
def setpoints(
    *,
    chosen: Chosen,
    out: Path = typer.Option("out/setpoints.csv", metavar="FILE.csv", help="File to write."),
    rate: float = typer.Option(50.0, metavar="HZ", help="Setpoints per second."),
    plain: bool = typer.Option(
        False, "--plain", help="Angles of the reference, without compensation."
    ),
    start: str | None = typer.Option(
        None,
        "--from",
        metavar="POSE",
        help="Pose where the plate rests: roll,pitch,yaw in rad, x,y,z in m.",
    ),
    soft_end: bool = typer.Option(
        False, "--soft-end", help="Come to rest at the end of the duration."
    ),
    units: Path | None = typer.Option(
        None, metavar="FILE", help="Units of the servos: rad, deg or ticks, offset, sign."
    ),
) -> None:
    """Write the crank angles to send to position servos.

    They are compensated for the torque of the motion, and checked for reach, and for range, speed
    and torque of each motor.
    """
    check_file(out)
    with named(start="--from", rate="--rate"):
        made = sd.setpoints(
            chosen.scenario,
            rate,
            out,
            plain=plain,
            start=None if start is None else _pose(start),
            soft_end=soft_end,
            units=units,
            controller=chosen.controller,
            settings=chosen.settings,
        )
    kind = "plain" if plain else "compensated"
    echo(f"written to {out}: {len(made.times)} {kind} setpoints at {rate:g} Hz")
    echo(made.table())


def _pose(text: str) -> list[float]:
    try:
        pose = [float(part) for part in text.strip(" []()").split(",")]
    except ValueError:
        pose = []
    if len(pose) != 6:
        raise ConfigError(
            f"--from: got {text!r}; expected six numbers, roll,pitch,yaw in rad and x,y,z in m, "
            "with commas"
        )
    return pose


@command(without=("controller",))
def compare(
    *,
    chosen: Chosen,
    controllers: str | None = typer.Option(
        None, metavar="A,B,...", help="Names or files of controllers, in this order."
    ),
    delivery: Delivery,
) -> int:
    """Compare controllers on a scenario: by default the shipped ones."""
    from stewart_drake.loop.preparation import prepare
    from stewart_drake.studies import compare as study
    from stewart_drake.studies.verdict import delay_verdict

    scenario, _, settings = chosen
    given = None if controllers is None else [one.strip() for one in controllers.split(",")]
    names = tuple(study.shown(scenario, settings, given))
    experiment = prepare(load_compatible(*chosen))
    delivery.say_link(experiment.scenario)
    delivery.say_wrapped(str(delay_verdict(experiment)))
    with progress_bars(names, experiment.scenario.duration, delivery.quiet) as progress:
        results = sd.compare(
            scenario,
            settings,
            lambda name, time, error: progress[name](time, error),
            controllers=given,
        )
    delivery.say(results.table())
    known = dict.fromkeys((*names, *study.LABELS))
    drawn = [f"{what}_{name}" for what in OF_CONTROLLERS for name in known]
    delivery.discard(*[f"{name}.nc" for name in known], *_pictures([*COMPARED_FIGURES, *drawn]))
    if delivery.out is not None:
        results.save(delivery.out)
        delivery.add_files("summary.json", counted(len(results), "files of signals"))
    delivery.draw("figures", results.plot)
    ended = [result.status for result in results.values()]
    interrupted = "interrupted" in ended or len(ended) < len(names)
    return delivery.end(results.summary, interrupted)


@command(out=Path("out/report"))
def report(*, chosen: Chosen, delivery: Delivery) -> int:
    """Write one HTML file about a scenario.

    Runs it, compares all shipped controllers on it, and analyses it.
    """
    from stewart_drake.reporting import report as report_document
    from stewart_drake.reporting.page import Provenance

    started, name = time.perf_counter(), chosen.title
    with count_bar("runs, analyses", delivery.silent) as progress:
        found = report_document.collect(
            chosen.scenario, chosen.settings, progress, chosen.controller
        )
    delivery.discard(REPLAY, PAGE)
    summary = report_document.report_summary(found)
    delivery.write(summary)
    films = []  # empty where the replay could not be drawn

    def film(folder: Path) -> None:
        films.append(report_document.film(found, name))
        write_whole(folder / REPLAY, films[0])

    if found.run is not None:
        delivery.draw(REPLAY, film)
    line = chosen.line("report", out=delivery.out)
    made = Provenance(line, seconds=time.perf_counter() - started)

    def page(folder: Path) -> None:
        shown = report_document.result(found, name, "".join(films), made)
        delivery.say(str(shown))
        shown.write_page(folder)

    delivery.draw(PAGE, page)
    return delivery.end(summary)
