"""The report on a scenario: report."""

import time
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    AsJson,
    Controller,
    Delivery,
    Quiet,
    ScenarioName,
    Settings,
)
from stewart_drake.reporting.terminal import count_bar

REPLAY = "replay.html"


def report(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where it goes.")] = Path("out/report"),
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Write one HTML file about a scenario.

    It is run, compared under all shipped controllers, and analysed.
    """
    from stewart_drake.loop.experiment import simulated_machine
    from stewart_drake.reporting import report as report_document
    from stewart_drake.reporting.page import Provenance, command_line
    from stewart_drake.reporting.report import collect
    from stewart_drake.reporting.results import PAGE, AnalysisResult

    delivery = Delivery(out, quiet, as_json)
    started, name = time.perf_counter(), Path(scenario).stem
    with count_bar("runs, analyses", delivery.silent) as progress:
        found = collect(scenario, settings or (), progress, controller)
    # Nothing of an earlier scenario beside this one's numbers, which come first.
    delivery.discard(REPLAY, PAGE)
    summary = report_document.report_summary(found)
    delivery.write(summary)
    replay = ""

    def film(folder: Path) -> None:
        nonlocal replay
        from stewart_drake.reporting.replay import write_replay

        assert found.run is not None
        mechanism = simulated_machine(found.scenario)
        replay = write_replay(found.run, mechanism, folder / REPLAY, name).read_text("utf-8")

    def page(folder: Path) -> None:
        document = report_document.document(found, name, replay)
        delivery.say(document.plain())
        AnalysisResult(found, summary, document, made).write_page(folder)

    if found.run is not None:
        delivery.draw(REPLAY, film)
    words = {"controller": controller, "out": out}
    command = command_line("report", scenario, settings=settings or (), options=words)
    made = Provenance(command, seconds=time.perf_counter() - started)
    delivery.draw(PAGE, page)
    return delivery.end(summary)
