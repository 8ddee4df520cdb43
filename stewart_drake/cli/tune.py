"""The neural tuner: tune dataset, tune train, tune evaluate."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    GO_ON,
    AsJson,
    Controller,
    Delivery,
    Quiet,
    ScenarioName,
    Scheduler,
    Seed,
    Settings,
    Workers,
    stopping,
)
from stewart_drake.files.errors import ConfigError
from stewart_drake.report.terminal import count_bar, working
from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Data for the neural tuner, its training, its worth.")

Out = Annotated[Path, typer.Option(metavar="DIR", help="Where runs, results and summary go.")]


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
    from stewart_drake.report.tuner_document import dataset_document
    from stewart_drake.tuning.dataset import make_dataset, summarize

    base, delivery = _base(scenario, controller, settings), Delivery(out, quiet, as_json)
    started = time.perf_counter()
    with stopping(GO_ON), count_bar("runs", quiet) as progress:
        data = make_dataset(
            base,
            out,
            disturbances=disturbed,
            seed=seed,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    summary = summarize(data) | {"wall_s": time.perf_counter() - started}
    delivery.write(summary)
    delivery.say(dataset_document(data).plain())
    delivery.wrote("dataset.nc", "runs/")
    return delivery.end(summary)


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
    from stewart_drake.report.tuner_document import training_document
    from stewart_drake.tuner.network import save_network
    from stewart_drake.tuning.dataset import load_dataset
    from stewart_drake.tuning.training import summarize
    from stewart_drake.tuning.training import train as run

    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    delivery = Delivery(out.parent, quiet, as_json)
    read = load_dataset(data)
    with stopping("nothing written"), working("training", quiet):
        result = run(read, kind=labels.value, split=split.value, density=density.value, seed=seed)
    summary = summarize(result)
    delivery.discard()
    save_network(result.network, out)
    delivery.wrote(out.name)
    delivery.write(summary)
    delivery.say(training_document(summary).plain())

    def draw(folder: Path) -> list[Path]:
        from stewart_drake.report.training_figures import training_figures

        return training_figures(result, folder)

    delivery.draw("figures", draw)
    return delivery.end(summary)


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
    from stewart_drake.report.tuner_document import evaluation_document
    from stewart_drake.tuning.evaluation import evaluate as run

    base, delivery = _base(scenario, controller, settings), Delivery(out, quiet, as_json)
    started = time.perf_counter()
    with stopping(GO_ON), count_bar("runs", quiet) as progress:
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
    summary = result.summary | {"wall_s": time.perf_counter() - started}
    delivery.write(summary)
    delivery.say(evaluation_document(result).plain())
    delivery.wrote("runs in fixed/ and tuner-*/")
    return delivery.end(summary)


def _base(scenario: str, controller: str | None, settings: list[str] | None) -> Scenario:
    """The scenario that is varied, on the exact plant unless a setting says otherwise."""
    from stewart_drake.scenario.loading import load_scenario

    return load_scenario(scenario, controller, ("plant.kind=exact", *(settings or ())))
