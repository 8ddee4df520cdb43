"""What an engineer reads before building anything: analyze hautus, delay, link, and so on."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import typer

from stewart_drake.cli.common import (
    GO_ON,
    AsJson,
    Controller,
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
from stewart_drake.reporting.terminal import count_bar, working
from stewart_drake.studies.ranges import RANGE_UNITS

if TYPE_CHECKING:
    from stewart_drake.reporting.answer import Answer
    from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Tell beforehand what can be controlled, and how.")


@app.command()
def hautus(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Whether every model can be controlled and observed, by mode."""
    delivery = Delivery(out, quiet, as_json)
    with working("hautus", quiet):
        answer = _answer("hautus", delivery, scenario, None, settings)
    return delivery.answer(answer)


@app.command()
def delay(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """How much delay the open loop, and the closed one, can bear."""
    delivery = Delivery(out, quiet, as_json)
    with count_bar("simulations", quiet) as progress:
        answer = _answer("delay", delivery, scenario, controller, settings, progress=progress)
    return delivery.answer(answer, interrupted=answer.study.interrupted)


@app.command()
def link(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    runs: Annotated[int, typer.Option(metavar="N", help="Seeds for each bound and loss.")] = 5,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Which play-out bound suits a network, and what loss it bears.

    Needs --set link.kind=network or a scenario with a network.
    """
    delivery = Delivery(out, quiet, as_json)
    with count_bar("simulations", quiet) as progress:
        answer = _answer(
            "link",
            delivery,
            scenario,
            controller,
            settings,
            typed={"runs": runs},
            runs=runs,
            progress=progress,
        )
    return delivery.answer(answer, interrupted=answer.study.interrupted)


@app.command()
def workspace(
    scenario: ScenarioName = "paper",
    settings: Settings = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Whether the motion fits the machine, and what the motors do.

    A motion that does not fit is analysed too. Shown are the reach that each leg has left, how
    large the motion may be, and torque, speed and power of each motor.
    """
    delivery = Delivery(out, quiet, as_json)
    with working("workspace", quiet):
        answer = _answer("workspace", delivery, scenario, None, settings)
    return delivery.answer(answer)


Vary = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="How far off, 0: not at all. Repeatable. "
        + "; ".join(f"{name}: {unit}" for name, unit in RANGE_UNITS.items())
        + ". torque_limit takes null too: as the scenario has it.",
    ),
]


@app.command()
def robustness(
    scenario: ScenarioName = "paper",
    controller: Controller = None,
    settings: Settings = None,
    vary: Vary = None,
    runs: Annotated[int, typer.Option(metavar="N", help="How many machines to draw.")] = 200,
    seed: Seed = 0,
    limit: Annotated[
        float | None, typer.Option(metavar="E_AC", help="A run above, in % s, counts as failed.")
    ] = None,
    beside: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CONTROLLER",
            help="Run the same machines with this controller too, such as adaptive_lqi, which "
            "finds the delay. Repeatable.",
        ),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    out: Out = None,
    quiet: Quiet = False,
    as_json: AsJson = False,
) -> int:
    """Monte Carlo: how often it works, how well, and what matters.

    With --out the same command goes on where it was stopped.
    """
    from stewart_drake.studies.ranges import read_ranges

    ranges, others = read_ranges(vary or ()), {Path(name).stem: name for name in beside or ()}
    if len(others) < len(beside or ()):
        raise ConfigError(
            f"--beside: got two of one name, {', '.join(beside or ())}; expected each but once"
        )
    delivery = Delivery(out, quiet, as_json)
    with TemporaryDirectory() as scratch:
        kept = GO_ON if out else "nothing is kept without --out"
        given = {"runs": runs, "seed": seed, "limit": limit}
        with stopping(kept), count_bar("runs", quiet) as progress:
            answer = _answer(
                "robustness",
                delivery,
                scenario,
                controller,
                settings,
                fixed=("plant.kind=exact",),
                typed={"vary": vary or (), **given, "beside": beside or ()},
                beside={key: _load(scenario, name, settings) for key, name in others.items()},
                directory=out or scratch,
                ranges=ranges,
                workers=workers,
                scheduler=scheduler,
                progress=progress,
                **given,
            )
    return delivery.answer(answer, "runs.csv", "runs/")


def _load(scenario: str, controller: str, settings: list[str] | None) -> "Scenario":
    from stewart_drake.scenario.loading import load_scenario

    return load_scenario(scenario, controller, ("plant.kind=exact", *(settings or [])))


def _answer(
    name: str,
    delivery: Delivery,
    scenario: str,
    controller: str | None,
    settings: list[str] | None,
    *,
    fixed: tuple[str, ...] = (),
    typed: Mapping[str, object] | None = None,
    **options: Any,
) -> "Answer":
    """Analyse a scenario; `fixed` are settings below the user's, `typed` further words of theirs.

    Of these a list or tuple is an option given so many times, None is one that is not.
    """
    from stewart_drake.reporting.analyses import analyze
    from stewart_drake.reporting.page import command_line
    from stewart_drake.scenario.loading import load_scenario

    given = settings or []
    words = {"controller": controller, **(typed or {}), "out": delivery.out}
    command = command_line("analyze", name, scenario, settings=given, options=words)
    loaded = load_scenario(scenario, controller, (*fixed, *given))
    delivery.tell_link(loaded)
    return analyze(name, loaded, command=command, **options)
