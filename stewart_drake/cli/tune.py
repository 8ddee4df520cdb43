"""Commands of the tuner: tune dataset, tune train, tune evaluate."""

from pathlib import Path

import typer

from stewart_drake.cli.common import RESUMABLE, Chosen, Delivery, command_line, on_interrupt
from stewart_drake.cli.options import Given, command
from stewart_drake.files.errors import ConfigError
from stewart_drake.reporting.terminal import count_bar
from stewart_drake.tuning.options import DataOptions, EvaluationOptions, TrainingOptions

app = typer.Typer(
    rich_markup_mode=None, help="Make data for the neural tuner, train it, evaluate it."
)


@app.command()
@command(DataOptions, out=Path("out/tuner/data"))
def dataset(*, chosen: Chosen, given: Given, delivery: Delivery) -> int:
    """Run a grid of 180 scenarios, or the conditions of a family.

    The grid varies delay, frequency and weights. A family has faults of timing, friction and noise.
    The same command continues an interrupted run.
    """
    from stewart_drake import functions

    with (
        given.named(),
        on_interrupt(RESUMABLE) as counted,
        count_bar("conditions", delivery.quiet) as bar,
    ):
        found = functions.make_tuner_data(
            delivery.folder, *chosen, progress=counted(bar), options=given.options()
        )
    delivery.write(found.summary)
    delivery.say(found.table())
    delivery.add_files("dataset.nc", "conditions/")
    return delivery.end(found.summary)


@app.command()
@command(TrainingOptions, without=("out",))
def train(
    *,
    data: Path = typer.Argument(metavar="DATA", help="Folder or file that tune dataset wrote."),
    given: Given,
    out: Path = typer.Option(
        "out/tuner/tuner.json",
        metavar="FILE",
        help="File of the network; figures go to its folder.",
    ),
    delivery: Delivery,
) -> int:
    """Train the network on a data set.

    By Levenberg-Marquardt on labels. With --regret on the runs of a family, then on runs of the
    network itself, where the same command continues an interrupted training.
    """
    from stewart_drake import functions
    from stewart_drake.reporting.results import drawn
    from stewart_drake.reporting.tuner import training_figures

    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    options, delivery = given.options(), delivery.into(out.parent)
    if options.regret:  # trains on the data, then counts runs of the network
        bar, first, interrupted = "own runs", "training", RESUMABLE
    else:
        bar, first, interrupted = "training", "computing", "nothing written"
    with (
        given.named(),
        on_interrupt(interrupted) as counted,
        count_bar(bar, delivery.silent, first) as shown,
    ):
        found = functions.train_tuner(data, out, progress=counted(shown), options=options)
    delivery.discard()  # the summary of an earlier training in this folder
    delivery.add_files(out.name, *([f"{out.stem}-runs/"] if options.regret else []))
    delivery.write(found.summary)
    delivery.say(found.table())
    if not options.regret:
        delivery.draw("figures", lambda folder: drawn(training_figures(found.study), folder))
    return delivery.end(found.summary)


@app.command()
@command(EvaluationOptions, without=("scenario",), out=Path("out/tuner/evaluation"))
def evaluate(
    *,
    weights: list[str] | None = typer.Argument(
        None, metavar="[WEIGHTS]...", help="Shipped name or file; several with --family."
    ),
    scenario: str = typer.Option("paper", metavar="SCENARIO", help="Shipped name or file."),
    chosen: Chosen,
    given: Given,
    delivery: Delivery,
) -> int:
    """Compare a tuner with fixed gains on unseen scenarios.

    With --family on fresh conditions of a family, where runs that end early count too.
    The same command continues an interrupted evaluation.
    """
    from stewart_drake import functions

    options, weights = given.options(), weights or []
    typed = {"scenario": None if options.family else scenario, "controller": chosen.controller}
    typed |= given.words
    line = command_line("tune", "evaluate", *weights, settings=chosen.settings, options=typed)
    with (
        given.named(),
        on_interrupt(RESUMABLE) as counted,
        count_bar("conditions", delivery.quiet) as bar,
    ):
        found = functions.evaluate_tuner(
            delivery.folder,
            weights,
            *chosen._replace(scenario=scenario),
            progress=counted(bar),
            command=line,
            options=options,
        )
    return delivery.answer(found, page="worth.html")
