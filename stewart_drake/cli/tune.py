"""Tuners: tune dataset, tune train, tune evaluate."""

import time
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

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

if TYPE_CHECKING:
    from stewart_drake.studies.families import Family as DrawnFamily
    from stewart_drake.tuning.training import Training

app = typer.Typer(rich_markup_mode=None, help="Data for the neural tuner, its training, its worth.")

DRAWS: Final = 384
Out = Annotated[Path, typer.Option(metavar="DIR", help="Where runs, results and summary go.")]


class LabelKind(StrEnum):
    """Choices of --labels, those of `tuning.training.LABELS`."""

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
        refuse({"--disturbed": disturbed}, "with --family, which has --draws; expected one of them")
        least, name, number = 10, "--draws", DRAWS if draws is None else draws
    else:
        refuse({"--draws": draws}, "without --family; expected both or neither")
        least, name, number = 0, "--disturbed", disturbed or 0
    if number < least:
        raise ConfigError(f"{name}: got {number}; expected {least} or more")
    from stewart_drake.reporting.tuner_document import data_document
    from stewart_drake.tuning.data import make_data, summarize

    conditions = _family(family, scenario, controller, settings, number, seed, "training")
    delivery, started = Delivery(out, quiet, as_json), time.perf_counter()
    with stopping(GO_ON), count_bar("conditions", quiet) as progress:
        data = make_data(conditions, out, workers=workers, scheduler=scheduler, progress=progress)
    summary = summarize(data) | {"wall_s": time.perf_counter() - started}
    delivery.write(summary)
    delivery.say(data_document(data, summary).plain())
    delivery.wrote("dataset.nc", "conditions/")
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
    from stewart_drake.tuning import training
    from stewart_drake.tuning.data import load_data

    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    of_labels = {"--labels": labels, "--split": split, "--density": density}
    of_regret = {"--start": start, "--workers": workers}
    if regret:
        refuse(of_labels, "with --regret; expected it without")
    else:
        refuse(of_regret, "without --regret; expected it with --regret")
    delivery, read, runs = Delivery(out.parent, quiet, as_json), load_data(data), out.stem + "-runs"
    if regret:
        with stopping(GO_ON), count_bar("own runs", delivery.silent, "training") as progress:
            result = training.train_by_regret(
                read,
                out.with_name(runs),
                seed=seed,
                start=start,
                workers=workers,
                progress=progress,
            )
    else:
        given = {"kind": labels, "split": split, "density": density}
        chosen: dict[str, Any] = {name: one.value for name, one in given.items() if one is not None}
        with stopping("nothing written"), working("training", quiet):
            result = training.train(read, seed=seed, **chosen)
    summary = training.summarize(result)
    delivery.discard()
    save_network(result.network, out)
    delivery.wrote(out.name, *([f"{runs}/"] if regret else []))
    delivery.write(summary)
    delivery.say(training_document(summary).plain())

    if not regret:
        delivery.draw("figures", partial(_training_figures, result))
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
    from stewart_drake.reporting.page import Provenance, command_line, write_page
    from stewart_drake.reporting.worth_document import worth_document
    from stewart_drake.tuning.worth import evaluate as run

    if scenarios < 2:
        raise ConfigError(f"--scenarios: got {scenarios}; expected 2 or more")
    conditions = _family(family, scenario, controller, settings, scenarios, seed, "evaluation")
    delivery, started = Delivery(out, quiet, as_json), time.perf_counter()
    with stopping(GO_ON), count_bar("conditions", quiet) as progress:
        worth = run(
            conditions,
            weights or [],
            out,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )
    seconds = time.perf_counter() - started
    summary, document = worth.summary | {"wall_s": seconds}, worth_document(worth)
    delivery.write(summary)
    delivery.say(document.plain())
    drawn = {"family": family, "scenario": None if family else scenario, "controller": controller}
    options = {**drawn, "scenarios": scenarios, "seed": seed}
    words = command_line(
        "tune", "evaluate", *(weights or []), settings=settings or (), options=options
    )
    made = Provenance(words, seconds=seconds)
    delivery.draw("worth.html", lambda folder: [write_page(document, made, folder / "worth.html")])
    return delivery.end(summary)


def _training_figures(result: "Training", folder: Path) -> list[Path]:
    from stewart_drake.reporting.training_figures import training_figures

    return training_figures(result, folder)


def _family(
    family: FamilyName | None,
    scenario: str,
    controller: str | None,
    settings: list[str] | None,
    number: int,
    seed: int,
    purpose: Literal["training", "evaluation"],
) -> "DrawnFamily":
    """Draw the conditions that a command names, on the exact plant unless a setting says otherwise.

    Raises:
        ConfigError: as the families; a scenario or controller beside a family, which has its own.
    """
    from stewart_drake.scenario.loading import load_scenario
    from stewart_drake.studies.families import disturbed_family, faulty_family, paper_grid

    if family is not None:
        said = {"SCENARIO": None if scenario == "paper" else scenario, "--controller": controller}
        refuse(said, "with --family, which says it; expected none")
        return faulty_family(family.value, number, seed, purpose, tuple(settings or ()))
    base = load_scenario(scenario, controller, ("plant.kind=exact", *(settings or ())))
    return disturbed_family(base, number, seed, purpose) if number else paper_grid(base)
