"""Commands of the tuner: tune dataset, tune train, tune evaluate."""

from pathlib import Path

import typer

from stewart_drake.cli.common import GO_ON, Chosen, Delivery, command_line, stopping
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
    """
    from stewart_drake import functions

    with given.named(), stopping(GO_ON), count_bar("conditions", delivery.quiet) as progress:
        found = functions.make_tuner_data(
            delivery.folder, *chosen, progress=progress, options=given.options()
        )
    delivery.write(found.summary)
    delivery.say(found.table())
    delivery.wrote("dataset.nc", "conditions/")
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
    network itself.
    """
    from stewart_drake import functions
    from stewart_drake.reporting.results import drawn
    from stewart_drake.reporting.tuner import training_figures

    if out.suffix != ".json":
        raise ConfigError(f"--out: got {str(out)!r}; expected a file ending in .json")
    options, delivery = given.options(), delivery.into(out.parent)
    name, kept = ("own runs", GO_ON) if options.regret else ("training", "nothing written")
    first = "training" if options.regret else "computing"
    with given.named(), stopping(kept), count_bar(name, delivery.silent, first) as progress:
        found = functions.train_tuner(data, out, progress=progress, options=options)
    delivery.discard()
    delivery.wrote(out.name, *([f"{out.stem}-runs/"] if options.regret else []))
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
    """
    from stewart_drake import functions

    options, weights = given.options(), weights or []
    named = {"scenario": None if options.family else scenario, "controller": chosen.controller}
    words, typed = ("tune", "evaluate", *weights), named | given.words
    line = command_line(*words, settings=chosen.settings, options=typed)
    with given.named(), stopping(GO_ON), count_bar("conditions", delivery.quiet) as progress:
        found = functions.evaluate_tuner(
            delivery.folder,
            weights,
            *chosen._replace(scenario=scenario),
            progress=progress,
            command=line,
            options=options,
        )
    return delivery.answer(found, page="worth.html")
