"""Running scenarios: simulate, compare."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.commands.common import (
    INTERRUPTED,
    AsJson,
    Out,
    Quiet,
    ScenarioName,
    Settings,
    check_writable,
    open_meshcat,
    print_json,
    remove,
    silence,
)
from stewart_drake.report.terminal import echo, progress_bars


def simulate(
    scenario: ScenarioName = "paper",
    controller: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Laid over the scenario's own.")
    ] = None,
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Show it in a browser, live and as a replay.")
    ] = False,
) -> int:
    """Run one scenario."""
    from stewart_drake.experiment import prepare
    from stewart_drake.report.tables import run_table, wrap
    from stewart_drake.scenario_loading import load_scenario
    from stewart_drake.simulation import simulate as run
    from stewart_drake.studies.verdict import delay_verdict

    say = silence if quiet or as_json else echo
    experiment = prepare(load_scenario(scenario, controller, settings or ()))
    check_writable(out)
    viewer = open_meshcat() if meshcat else None
    say(wrap(str(delay_verdict(experiment))))
    if viewer is not None:
        say(f"showing it at {viewer.web_url()}")
    name = Path(scenario).stem
    with progress_bars([name], experiment.scenario.duration, quiet) as progress:
        result = run(experiment.scenario, progress=progress[name], meshcat=viewer)
    say(run_table(result))
    if out is not None:
        from stewart_drake.report.figures import run_figures

        # The summary comes last: where there is one, everything beside it is of the same run.
        remove(out, ["summary.json"])
        figures = run_figures(result, out)
        result.save(out)
        say(f"written to {out}: summary.json, signals.nc, {len(figures)} figures")
    if as_json:
        print_json(result.summary)
    if viewer is not None:
        from stewart_drake.report.replay import replay

        replay(result.signals, experiment.mechanism, viewer)
        if out is not None:
            (out / "replay.html").write_text(viewer.StaticHtml())
            say(f"written to {out}: replay.html")
        if sys.stdin.isatty():
            input(f"replay at {viewer.web_url()}, Enter ends")
    return INTERRUPTED if result.status == "interrupted" else 0


def compare(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Run the five controllers on a scenario: Table II."""
    from stewart_drake.experiment import prepare
    from stewart_drake.report.tables import comparison_table, wrap
    from stewart_drake.scenario_loading import load_scenario
    from stewart_drake.studies import compare as study
    from stewart_drake.studies.verdict import delay_verdict

    say = silence if quiet or as_json else echo
    experiment = prepare(load_scenario(scenario, settings=settings or ()))
    check_writable(out)
    say(wrap(str(delay_verdict(experiment))))
    names = study.CONTROLLERS
    with progress_bars(names, experiment.scenario.duration, quiet) as progress:
        results = study.compare(
            scenario, settings or (), lambda name, time, error: progress[name](time, error)
        )
    say(comparison_table(results))
    if out is not None:
        from stewart_drake.report.figures import comparison_figures

        remove(out, ["summary.json", *(f"{name}.nc" for name in names)])
        figures = comparison_figures(results, out)
        study.save_comparison(results, out)
        say(f"written to {out}: summary.json, {len(results)} signal files, {len(figures)} figures")
    if as_json:
        print_json(study.comparison_summary(results))
    ended = [result.status for result in results.values()]
    return INTERRUPTED if "interrupted" in ended or len(ended) < len(names) else 0
