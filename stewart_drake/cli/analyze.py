"""What an engineer reads before building anything: analyze hautus, delay, link, and so on."""

import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stewart_drake.cli.common import (
    INTERRUPTED,
    AsJson,
    Controller,
    Out,
    Quiet,
    ScenarioName,
    Scheduler,
    Seed,
    Settings,
    Workers,
    check_writable,
    drawing,
    print_json,
    remove,
    silence,
)
from stewart_drake.report.terminal import count_bar, echo, working
from stewart_drake.studies.ranges import RANGE_UNITS

if TYPE_CHECKING:
    from stewart_drake.report.page import Page, Provenance

app = typer.Typer(rich_markup_mode=None, help="Tell beforehand what can be controlled, and how.")

PAGE = "report.html"


@app.command()
def hautus(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Whether every model can be controlled and observed, by mode."""
    from stewart_drake.report.hautus_page import hautus_page, hautus_table
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.hautus import study_hautus

    check_writable(out)
    started = time.perf_counter()
    with working("hautus", quiet):
        study = study_hautus(load_scenario(scenario, settings=settings or ()))
    made = provenance("hautus", scenario, None, settings, out, started)
    return deliver(
        study.summary,
        hautus_table(study),
        lambda: hautus_page(study, made),
        out,
        quiet,
        as_json,
    )


@app.command()
def delay(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """How much delay the open loop, and the closed one, can bear."""
    from stewart_drake.report.delay_page import delay_page, delay_table
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.delay_limits import study_delay

    check_writable(out)
    started = time.perf_counter()
    with count_bar("simulations", quiet) as progress:
        study = study_delay(load_scenario(scenario, controller, settings or ()), progress)
    made = provenance("delay", scenario, controller, settings, out, started)
    return deliver(
        study.summary,
        delay_table(study),
        lambda: delay_page(study, made),
        out,
        quiet,
        as_json,
        interrupted=study.interrupted,
    )


@app.command()
def link(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    runs: Annotated[int, typer.Option(metavar="N", help="Seeds for each bound and loss.")] = 5,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Which play-out bound suits a network, and what loss it bears.

    Needs --set link.kind=network or a scenario with a network.
    """
    from stewart_drake.report.link_page import link_page, link_table
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.link_bound import study_link

    check_writable(out)
    started = time.perf_counter()
    with count_bar("simulations", quiet) as progress:
        study = study_link(load_scenario(scenario, controller, settings or ()), runs, progress)
    made = provenance("link", scenario, controller, settings, out, started, runs=runs)
    return deliver(
        study.summary,
        link_table(study),
        lambda: link_page(study, made),
        out,
        quiet,
        as_json,
        interrupted=study.interrupted,
    )


@app.command()
def workspace(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Whether the motion fits the machine, and what the motors do.

    A motion that does not fit is analysed too. Shown are the reach that each leg has left, how
    large the motion may be, and torque, speed and power of each motor.
    """
    from stewart_drake.report.workspace_page import workspace_page, workspace_table
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.workspace import study_workspace

    check_writable(out)
    started = time.perf_counter()
    with working("workspace", quiet):
        study = study_workspace(load_scenario(scenario, settings=settings or ()))
    made = provenance("workspace", scenario, None, settings, out, started)
    return deliver(
        study.summary,
        workspace_table(study),
        lambda: workspace_page(study, made),
        out,
        quiet,
        as_json,
    )


Vary = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="How far off, 0: not at all. Repeatable. "
        + "; ".join(f"{name}: {unit}" for name, unit in RANGE_UNITS.items())
        + ". torque_limit takes null too: as the scenario has it.",
    ),
]


@app.command()
def robustness(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    vary: Vary = None,
    runs: Annotated[int, typer.Option(metavar="N", help="How many machines to draw.")] = 200,
    seed: Seed = 0,
    limit: Annotated[
        float | None, typer.Option(metavar="E_AC", help="A run above, in % s, counts as failed.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Monte Carlo: how often it works, how well, and what matters.

    With --out the same command goes on where it was stopped.
    """
    from stewart_drake.report.robustness_page import robustness_page, robustness_table
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.ranges import read_ranges
    from stewart_drake.studies.robustness import study_robustness

    base = load_scenario(scenario, controller, ("plant.kind=exact", *(settings or ())))
    ranges = read_ranges(vary or ())
    check_writable(out)
    started = time.perf_counter()
    with TemporaryDirectory() as scratch:
        try:
            with count_bar("runs", quiet) as progress:
                study = study_robustness(
                    base,
                    scratch if out is None else out,
                    ranges=ranges,
                    runs=runs,
                    seed=seed,
                    limit=limit,
                    workers=workers,
                    scheduler=scheduler,
                    progress=progress,
                )
        except KeyboardInterrupt:
            kept = "finished runs are kept, the same command goes on from there"
            echo(f"stopped; {'nothing is kept without --out' if out is None else kept}", error=True)
            return INTERRUPTED
    options: dict[str, object] = {"runs": runs, "seed": seed, "limit": limit}
    made = provenance(
        "robustness", scenario, controller, settings, out, started, vary=vary or (), **options
    )
    summary = study.summary
    return deliver(
        summary,
        robustness_table(study),
        lambda: robustness_page(study, made),
        out,
        quiet,
        as_json,
        beside=("runs.csv", "runs/"),
    )


def provenance(
    analysis: str,
    scenario: str,
    controller: str | None,
    settings: list[str] | None,
    out: Path | None,
    started: float,
    **more: object,
) -> "Provenance":
    """The command as typed, versions, and the time since `started` (time.perf_counter, s).

    `more` are further options; a list or tuple is an option given so many times, None is one that
    is not.
    """
    from stewart_drake.report.page import Provenance, command_line

    options = {"controller": controller, **more, "out": out}
    command = command_line("analyze", analysis, scenario, settings=settings or (), options=options)
    return Provenance(command, seconds=time.perf_counter() - started)


def deliver(
    summary: dict[str, Any],
    table: str,
    page: "Callable[[], Page]",
    out: Path | None,
    quiet: bool,
    as_json: bool,
    *,
    interrupted: bool = False,
    beside: tuple[str, ...] = (),
) -> int:
    """Print a table or the summary as JSON; with `--out` write summary.json and the page.

    Args:
        summary: plain data.
        table: for a person, at most 80 columns.
        page: makes the page; called only with `--out`.
        out, quiet, as_json: the command's options.
        interrupted: whether Ctrl-C ended the analysis early.
        beside: what the analysis itself has written into `out`.

    Returns:
        The exit status.
    """
    say = silence if quiet or as_json else echo
    say(table)
    if out is not None:
        from stewart_drake.files.jsonio import write_json

        # No page of an earlier run beside this one's numbers, which come first.
        remove(out, ["summary.json", PAGE])
        write_json(out / "summary.json", summary)
        written = ["summary.json"]
        with drawing(PAGE):
            from stewart_drake.report.page import write_page

            write_page(page(), out / PAGE)
            written.append(PAGE)
        say(f"written to {out}: {', '.join((*written, *beside))}")
    if as_json:
        print_json(summary)
    return INTERRUPTED if interrupted else 0
