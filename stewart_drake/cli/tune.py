"""The neural tuner: tune dataset, tune train, tune evaluate."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    INTERRUPTED,
    AsJson,
    Controller,
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
from stewart_drake.files.errors import ConfigError
from stewart_drake.report.terminal import count_bar, echo, working
from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Data for the neural tuner, its training, its worth.")

Out = Annotated[Path, typer.Option(metavar="DIR", help="Where runs, results and summary go.")]
_GO_ON = "stopped; finished runs are kept, the same command goes on from there"


class LabelKind(StrEnum):
    """Choices of --labels, those of `tuning.labels.LABELS`."""

    as_run = "as_run"
    best_in_cell = "best_in_cell"
    best_in_cell_torque = "best_in_cell_torque"


class SplitKind(StrEnum):
    """Choices of --split, those of `tuning.training.SPLITS`."""

    sample = "sample"
    run = "run"
    cell = "cell"


class DensityKind(StrEnum):
    """Choices of --density, those of `tuner.density.Kind`."""

    magnitude = "magnitude"
    signed = "signed"


@app.command()
def dataset(
    scenario: ScenarioName = "paper",
    out: Out = Path("out/tuner/data"),
    controller: Controller = None,
    settings: Settings = None,
    disturbed: Annotated[
        int, typer.Option(metavar="N", help="N drawn conditions instead of the paper's grid.")
    ] = 0,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Run the grid of delays, frequencies and weights, 180 runs."""
    from stewart_drake.files.jsonio import write_json
    from stewart_drake.report.tuner_tables import dataset_table
    from stewart_drake.tuning.dataset import make_dataset, summarize

    say = silence if quiet or as_json else echo
    base = _base(scenario, controller, settings)
    check_writable(out)
    started = time.perf_counter()
    try:
        with count_bar("runs", quiet) as progress:
            data = make_dataset(
                base,
                out,
                disturbances=disturbed,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
            )
    except KeyboardInterrupt:
        echo(_GO_ON, error=True)
        return INTERRUPTED
    summary = summarize(data) | {"wall_s": time.perf_counter() - started}
    write_json(out / "summary.json", summary)
    say(dataset_table(data))
    say(f"written to {out}: dataset.nc, summary.json, runs/")
    if as_json:
        print_json(summary)
    return 0


@app.command()
def train(
    data: Annotated[Path, typer.Argument(metavar="DATA", help="Folder or file of tune dataset.")],
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="For the network; figures go beside it.")
    ] = Path("out/tuner/tuner.json"),
    labels: Annotated[
        LabelKind, typer.Option(help="What the network learns to answer.")
    ] = LabelKind.best_in_cell,
    split: Annotated[SplitKind, typer.Option(help="What 70 % of are trained on.")] = SplitKind.run,
    density: Annotated[DensityKind, typer.Option(help="Of (45).")] = DensityKind.magnitude,
    seed: Seed = 0,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Train the network on a data set by Levenberg-Marquardt."""
    from stewart_drake.files.jsonio import write_json
    from stewart_drake.report.tuner_tables import training_table
    from stewart_drake.tuner.network import save_network
    from stewart_drake.tuning.dataset import load_dataset
    from stewart_drake.tuning.training import summarize
    from stewart_drake.tuning.training import train as run

    say = silence if quiet or as_json else echo
    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    folder = out.parent
    check_writable(folder)
    read = load_dataset(data)
    try:
        with working("training", quiet):
            result = run(
                read, kind=labels.value, split=split.value, density=density.value, seed=seed
            )
    except KeyboardInterrupt:
        echo("stopped; nothing written", error=True)
        return INTERRUPTED
    summary = summarize(result)
    remove(folder, ["summary.json"])
    save_network(result.network, out)
    write_json(folder / "summary.json", summary)
    say(training_table(summary))
    written = f"{out.name}, summary.json"
    with drawing("figures"):
        from stewart_drake.report.training_figures import training_figures

        written += f", {len(training_figures(result, folder))} figures"
    say(f"written to {folder}: {written}")
    if as_json:
        print_json(summary)
    return 0


@app.command()
def evaluate(
    weights: Annotated[
        str | None, typer.Argument(metavar="[WEIGHTS]", help="Shipped name or file.")
    ] = None,
    out: Out = Path("out/tuner/evaluation"),
    scenario: Annotated[
        str, typer.Option(metavar="SCENARIO", help="Shipped name or file, to be varied.")
    ] = "paper",
    controller: Controller = None,
    settings: Settings = None,
    scenarios: Annotated[int, typer.Option(metavar="N", help="How many to draw.")] = 40,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Compare the tuner with every fixed gain on unseen scenarios."""
    from stewart_drake.files.jsonio import write_json
    from stewart_drake.report.tuner_tables import evaluation_table
    from stewart_drake.tuning.evaluation import evaluate as run

    say = silence if quiet or as_json else echo
    base = _base(scenario, controller, settings)
    check_writable(out)
    started = time.perf_counter()
    try:
        with count_bar("runs", quiet) as progress:
            result = run(
                base,
                weights,
                out,
                scenarios=scenarios,
                seed=seed,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
            )
    except KeyboardInterrupt:
        echo(_GO_ON, error=True)
        return INTERRUPTED
    summary = result.summary | {"wall_s": time.perf_counter() - started}
    write_json(out / "summary.json", summary)
    say(evaluation_table(result))
    say(f"written to {out}: summary.json, runs in fixed/ and tuner-*/")
    if as_json:
        print_json(summary)
    return 0


def _base(scenario: str, controller: str | None, settings: list[str] | None) -> Scenario:
    """The scenario that is varied, on the exact plant unless a setting says otherwise."""
    from stewart_drake.scenario.loading import load_scenario

    return load_scenario(scenario, controller, ("plant.kind=exact", *(settings or ())))
