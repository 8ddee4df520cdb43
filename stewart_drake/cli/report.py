"""The report on a scenario: report."""

import time
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    AsJson,
    Quiet,
    ScenarioName,
    Settings,
    check_writable,
    drawing,
    print_json,
    remove,
    silence,
)
from stewart_drake.report.terminal import count_bar, echo

PAGE = "report.html"
REPLAY = "replay.html"


def report(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where it goes.")] = Path("out/report"),
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Write one HTML file about a scenario.

    It is run, compared under all shipped controllers, and analysed.
    """
    from stewart_drake.files.jsonio import write_json
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.report.collect import collect
    from stewart_drake.report.page import Provenance, command_line, write_page
    from stewart_drake.report.report_page import report_page, report_summary, sentence
    from stewart_drake.report.tables import comparison_table, wrap

    say = silence if quiet or as_json else echo
    check_writable(out)
    started, name = time.perf_counter(), Path(scenario).stem
    with count_bar("runs, analyses", quiet or as_json) as progress:
        found = collect(scenario, settings or (), progress)
    # Nothing of an earlier scenario beside this one's numbers, which come first.
    remove(out, ["summary.json", REPLAY, PAGE])
    summary = report_summary(found)
    write_json(out / "summary.json", summary)
    written = ["summary.json"]
    replay = ""
    if found.run is not None:
        with drawing(REPLAY):
            from stewart_drake.report.replay import write_replay

            mechanism = load_mechanism(found.scenario.mechanism)
            path = write_replay(found.run, mechanism, out / REPLAY, name)
            replay = path.read_text(encoding="utf-8")
            written.insert(0, REPLAY)
    command = command_line("report", scenario, settings=settings or (), options={"out": out})
    made = Provenance(command, seconds=time.perf_counter() - started)
    with drawing(PAGE):
        page = report_page(found, name, made, replay)
        write_page(page, out / PAGE)
        written.insert(0, PAGE)
        say(wrap(page.verdict, rest=""))
    for analysis in found.analyses.values():
        say(wrap(sentence(analysis.verdict), "  ", "    "))
    if found.comparison:
        say(comparison_table(found.comparison))
    say(f"written to {out}: {', '.join(written)}")
    if as_json:
        print_json(summary)
    return 0
