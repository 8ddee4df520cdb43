"""From a motion to a machine: layout."""

from collections.abc import Sequence
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from stewart_drake.cli.common import (
    GO_ON,
    AsJson,
    Delivery,
    Out,
    Quiet,
    ScenarioName,
    Scheduler,
    Seed,
    Settings,
    Workers,
    stopping,
)
from stewart_drake.files.errors import ConfigError
from stewart_drake.reporting.terminal import count_bar

Goal = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="What should be as good as can be: condition, torque, reach, clearance, "
        "transmission, plate_joint_deg or crank_joint_deg.",
    ),
]
Limits = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        metavar="NAME=VALUE",
        help="Least (reach, clearance, transmission) or largest value, SI units. Repeatable.",
    ),
]
Vary = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=LOW:HIGH",
        help="Bounds of a number of the machine's pattern, or of crank or rod; one value fixes "
        "it. Repeatable.",
    ),
]
Keep = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="A number that stays as it is, or branches or plate_order. Repeatable.",
    ),
]
Best = Annotated[int, typer.Option(metavar="N", help="How many machines to write.")]
Starts = Annotated[int, typer.Option(metavar="N", help="Searches per arrangement of legs.")]
Generations = Annotated[int, typer.Option(metavar="N", help="Of each search, at most.")]


def layout(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    goal: Goal = "condition",
    limit: Limits = None,
    vary: Vary = None,
    keep: Keep = None,
    best: Best = 3,
    starts: Starts = 1,
    generations: Generations = 100,
    seed: Seed = 0,
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Search layouts and lengths that suit a motion.

    The best few become machine files, beside a page that compares them. With --out the same
    command goes on where it was stopped.
    """
    from stewart_drake.reporting.analyses import analyze
    from stewart_drake.reporting.page import command_line
    from stewart_drake.scenario.loading import load_scenario

    limits, bounds = _limits(limit or ()), _bounds(vary or ())
    delivery, given = Delivery(out, quiet, as_json), settings or []
    numbers = {"best": best, "starts": starts, "generations": generations, "seed": seed}
    words = {"goal": goal, "limit": limit or (), "vary": vary or (), "keep": keep or (), **numbers}
    command = command_line("layout", scenario, settings=given, options={**words, "out": out})
    loaded = load_scenario(scenario, None, given)
    kept = GO_ON.replace("runs", "searches") if out else "nothing is kept without --out"
    with (
        TemporaryDirectory() as scratch,
        stopping(kept),
        count_bar("searches and runs", quiet) as progress,
    ):
        answer = analyze(
            "layout",
            loaded,
            out or scratch,
            command=command,
            goal=goal,
            limits=limits,
            vary=bounds,
            keep=keep or (),
            workers=workers,
            scheduler=scheduler,
            progress=progress,
            **numbers,
        )
    machines = [f"{one.name}.yaml" for one in answer.study.layouts]
    return delivery.answer(answer, *machines, "searches/", "judged/")


def _limits(texts: Sequence[str]) -> dict[str, float]:
    """From NAME=VALUE.

    Raises:
        ConfigError: one line.
    """
    return {
        name: _number("--limit", text, value) for text in texts for name, value in [_pair(text)]
    }


def _bounds(texts: Sequence[str]) -> dict[str, tuple[float, float]]:
    """From NAME=LOW:HIGH, or NAME=VALUE.

    Raises:
        ConfigError: one line.
    """
    found = {}
    for text in texts:
        name, value = _pair(text)
        low, colon, high = value.partition(":")
        found[name] = (
            _number("--vary", text, low),
            _number("--vary", text, high if colon else low),
        )
    return found


def _pair(text: str) -> tuple[str, str]:
    name, _, value = text.partition("=")
    return name.strip(), value


def _number(option: str, text: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        form = "NAME=VALUE" if option == "--limit" else "NAME=LOW:HIGH or NAME=VALUE"
        raise ConfigError(f"{option}: got {text!r}; expected {form}") from None
