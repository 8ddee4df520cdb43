"""Tuners: tune dataset, tune train, tune evaluate; with --family the ones trained by regret."""

import time
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final

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
    refuse,
    stopping,
)
from stewart_drake.files.errors import ConfigError
from stewart_drake.reporting.terminal import count_bar, working
from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Data for the neural tuner, its training, its worth.")

DRAWS: Final = 384
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


class FamilyName(StrEnum):
    """Choices of --family, those of `studies.families.FAMILIES`."""

    T = "T"
    N2 = "N2"


Family = Annotated[
    FamilyName | None,
    typer.Option(help="Conditions where weights matter: T with the estimator, N2 without."),
]


Labels = Annotated[
    LabelKind | None,
    typer.Option(help="What the network learns to answer; best_in_cell by default."),
]
Density = Annotated[DensityKind | None, typer.Option(help="Of (45); magnitude by default.")]


@app.command()
def dataset(
    scenario: ScenarioName = "paper",
    out: Out = Path("out/tuner/data"),
    controller: Controller = None,
    settings: Settings = None,
    disturbed: Annotated[
        int | None,
        typer.Option(metavar="N", help="N drawn conditions instead of the paper's grid."),
    ] = None,
    family: Family = None,
    draws: Annotated[
        int | None,
        typer.Option(
            metavar="N", help=f"With --family: how many, each with 13 ratios; {DRAWS} by default."
        ),
    ] = None,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Run a grid of 180 scenarios, or a family's conditions.

    The grid has delays, frequencies and weights; a family has faults of timing, friction, noise.
    """
    if family is not None:
        refuse_with_family(scenario, controller)
        refuse({"--disturbed": disturbed}, "with --family, which has --draws; expected one of them")
        number, delivery = DRAWS if draws is None else draws, Delivery(out, quiet, as_json)
        return _curves(family.value, number, seed, settings, workers, scheduler, delivery)
    refuse({"--draws": draws}, "without --family; expected both or neither")
    from stewart_drake.reporting.tuner_document import dataset_document
    from stewart_drake.tuning.dataset import make_dataset, summarize

    base, delivery = _base(scenario, controller, settings), Delivery(out, quiet, as_json)
    started = time.perf_counter()
    with stopping(GO_ON), count_bar("runs", quiet) as progress:
        data = make_dataset(
            base,
            out,
            disturbances=disturbed or 0,
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
    regret: Annotated[
        bool, typer.Option("--regret", help="By regret, on data of a --family; else as the paper.")
    ] = False,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="For the network; figures go beside it.")
    ] = Path("out/tuner/tuner.json"),
    start: Annotated[
        float | None,
        typer.Option(
            metavar="RATIO", help="With --regret: log10 w_Q / w_R at first; else the best."
        ),
    ] = None,
    labels: Labels = None,
    split: Annotated[
        SplitKind | None, typer.Option(help="What 70 % of are trained on; run by default.")
    ] = None,
    density: Density = None,
    seed: Seed = 0,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Train the network on a data set.

    By Levenberg-Marquardt on labels, or, of a family, by regret and by its own runs.
    """
    from stewart_drake.reporting.tuner_document import training_document
    from stewart_drake.tuner.network import save_network
    from stewart_drake.tuning.dataset import load_dataset
    from stewart_drake.tuning.training import summarize
    from stewart_drake.tuning.training import train as run

    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    chosen = {"kind": labels, "split": split, "density": density}
    given: dict[str, Any] = {name: one.value for name, one in chosen.items() if one is not None}
    delivery = Delivery(out.parent, quiet, as_json)
    if regret:
        of_labels = {"--labels": labels, "--split": split, "--density": density}
        refuse(of_labels, "with --regret; expected it without")
        return _train_by_regret(data, out, seed, start, workers, delivery)
    refuse({"--start": start, "--workers": workers}, "without --regret; expected it with --regret")
    read = load_dataset(data)
    with stopping("nothing written"), working("training", quiet):
        result = run(read, seed=seed, **given)
    summary = summarize(result)
    delivery.discard()
    save_network(result.network, out)
    delivery.wrote(out.name)
    delivery.write(summary)
    delivery.say(training_document(summary).plain())

    def draw(folder: Path) -> list[Path]:
        from stewart_drake.reporting.training_figures import training_figures

        return training_figures(result, folder)

    delivery.draw("figures", draw)
    return delivery.end(summary)


@app.command()
def evaluate(
    weights: Annotated[
        list[str] | None,
        typer.Argument(metavar="[WEIGHTS]...", help="Shipped name or file; several with --family."),
    ] = None,
    out: Out = Path("out/tuner/evaluation"),
    scenario: Annotated[
        str, typer.Option(metavar="SCENARIO", help="Shipped name or file, to be varied.")
    ] = "paper",
    controller: Controller = None,
    settings: Settings = None,
    scenarios: Annotated[int, typer.Option(metavar="N", help="How many to draw.")] = 40,
    family: Family = None,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Compare a tuner with fixed gains on unseen scenarios.

    With --family on fresh conditions of a family, where lost plates count.
    """
    if family is not None:
        refuse_with_family(scenario, controller)
        delivery = Delivery(out, quiet, as_json)
        return _worth(
            family.value, weights, scenarios, seed, settings, workers, scheduler, delivery
        )
    if weights and len(weights) > 1:
        raise ConfigError(f"WEIGHTS: got {len(weights)} without --family; expected one")
    from stewart_drake.reporting.tuner_document import evaluation_document
    from stewart_drake.tuning.evaluation import evaluate as run

    base, delivery = _base(scenario, controller, settings), Delivery(out, quiet, as_json)
    started = time.perf_counter()
    with stopping(GO_ON), count_bar("runs", quiet) as progress:
        result = run(
            base,
            weights[0] if weights else None,
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


def refuse_with_family(scenario: str, controller: str | None) -> None:
    """A family says both.

    Raises:
        ConfigError: another scenario, or a controller.
    """
    said = {"SCENARIO": None if scenario == "paper" else scenario, "--controller": controller}
    refuse(said, "with --family, which says it; expected none")


def _curves(
    family: str,
    draws: int,
    seed: int,
    settings: list[str] | None,
    workers: int | None,
    scheduler: str | None,
    delivery: Delivery,
) -> int:
    from stewart_drake.reporting.worth_document import curves_document
    from stewart_drake.tuning.curves import make_curves, summarize

    assert delivery.out is not None
    started = time.perf_counter()
    with stopping(GO_ON), count_bar("conditions", delivery.silent) as progress:
        curves = make_curves(
            family,
            delivery.out,
            number=draws,
            seed=seed,
            settings=tuple(settings or ()),
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    summary = summarize(curves) | {"seed": seed, "wall_s": time.perf_counter() - started}
    delivery.write(summary)
    delivery.say(curves_document(summary).plain())
    delivery.wrote("curves/")
    return delivery.end(summary)


def _train_by_regret(
    data: Path,
    out: Path,
    seed: int,
    start: float | None,
    workers: int | None,
    delivery: Delivery,
) -> int:
    from stewart_drake.reporting.worth_document import regret_document
    from stewart_drake.tuner.network import save_network
    from stewart_drake.tuning.curves import load_curves
    from stewart_drake.tuning.regret import train_by_regret

    curves, runs = load_curves(data), out.with_name(f"{out.stem}-runs")
    with stopping(GO_ON), count_bar("own runs", delivery.silent, "training") as progress:
        result = train_by_regret(
            curves, runs, seed=seed, start=start, workers=workers, progress=progress
        )
    summary = dict(result.network.card) | {"curve": result.curve.tolist()}
    save_network(result.network, out)
    delivery.wrote(out.name, f"{runs.name}/")
    delivery.write(summary)
    delivery.say(regret_document(summary).plain())
    return delivery.end(summary)


def _worth(
    family: str,
    weights: list[str] | None,
    conditions: int,
    seed: int,
    settings: list[str] | None,
    workers: int | None,
    scheduler: str | None,
    delivery: Delivery,
) -> int:
    from stewart_drake.reporting.page import Provenance, command_line, write_page
    from stewart_drake.reporting.worth_document import worth_document
    from stewart_drake.tuning.worth import SHIPPED, weigh

    assert delivery.out is not None
    started = time.perf_counter()
    networks = weights or [SHIPPED[family]]
    with stopping(GO_ON), count_bar("conditions", delivery.silent) as progress:
        worth = weigh(
            family,
            networks,
            delivery.out,
            conditions=conditions,
            seed=seed,
            settings=tuple(settings or ()),
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    seconds = time.perf_counter() - started
    summary = worth.summary | {"wall_s": seconds}
    delivery.write(summary)
    document = worth_document(worth)
    delivery.say(document.plain())
    options = {"family": family, "scenarios": conditions, "seed": seed}
    command = command_line("tune", "evaluate", *networks, settings=settings or (), options=options)
    made = Provenance(command, seconds=seconds)
    delivery.draw("worth.html", lambda folder: [write_page(document, made, folder / "worth.html")])
    return delivery.end(summary)


def _base(scenario: str, controller: str | None, settings: list[str] | None) -> Scenario:
    """The scenario that is varied, on the exact plant unless a setting says otherwise."""
    from stewart_drake.scenario.loading import load_scenario

    return load_scenario(scenario, controller, ("plant.kind=exact", *(settings or ())))
