"""The table of analyses, from which command line, `sd.analyze_*` and documentation follow.

Studies are imported when they run, so that the table serves the help of the commands.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from stewart_drake.reporting.results import AnalysisResult
    from stewart_drake.scenario.config import Scenario
    from stewart_drake.studies.options import Options


class Analysis(NamedTuple):
    help: str  # of the command
    examples: tuple[str, ...]  # of the command, without the program's name
    counts: str = ""  # pieces that its progress counts; empty without progress
    keeps: str = ""  # pieces that a folder keeps, so that a stopped study can continue
    controller: bool = False  # whether the command has `--controller`
    exact: bool = False  # whether the default plant is the exact one
    alone: bool = False  # whether the command is not one of `analyze`
    second: str = ""  # argument of the Python function that may be positional


ANALYSES: Final = {
    "hautus": Analysis(
        "Check controllability and observability, by mode.",
        ("analyze hautus paper --out out/hautus",),
    ),
    "delay": Analysis(
        "Find the delay that the loop tolerates.",
        ("analyze delay gravity --out out/delay",),
        counts="simulations",
        controller=True,
        second="simulations",
    ),
    "link": Analysis(
        "Find the best play-out bound of a network.\n\n"
        "Simulates 10 to 25 bounds and losses, --runs times each: minutes for paper.\n"
        "Needs --set link.kind=network or a scenario with a network. With --out the same command\n"
        "continues an interrupted study.",
        ("analyze link paper --set link.kind=network --out out/link",),
        counts="simulations",
        keeps="runs",
        controller=True,
        second="runs",
    ),
    "workspace": Analysis(
        "Check whether the motion fits the machine.\n\n"
        "Also for a motion that does not fit. Shows the reach margin of each leg, the largest "
        "feasible\namplitude, and torque, speed and power of each motor.",
        ("analyze workspace paper --out out/workspace",),
    ),
    "robustness": Analysis(
        "Run a Monte Carlo study of uncertain machines.\n\n"
        "With --out the same command continues an interrupted study.",
        ("analyze robustness paper --out out/robustness",),
        counts="runs",
        keeps="runs",
        controller=True,
        exact=True,
        second="runs",
    ),
    "learn": Analysis(
        "Learn a torque from repetitions of a motion.\n\n"
        "Simulates the motion again and again, as after a return to its start. Writes learned.npz\n"
        "for controller.learned, and a page with the error of each repetition.",
        ("learn paper --set plant.coulomb_friction=1e-4 --out out/learn",),
        counts="repetitions",
        controller=True,
        alone=True,
        second="repetitions",
    ),
    "layout": Analysis(
        "Search the layout and lengths of a machine for a motion.\n\n"
        "Writes the best few as machine files, and a page that compares them. With --out the same\n"
        "command continues an interrupted search.",
        (
            "layout paper --out out/layout",
            "layout paper --keep crank --keep rod --out out/layout",
        ),
        counts="searches and runs",
        keeps="searches",
        alone=True,
        second="directory",
    ),
}
"""By name. Each has a module in `studies` with a function `study_...`, a module in this room with a
function `document`, and a class `...Options` in `studies.study_options`. A function `write` of that
module writes further files."""


def words_of(name: str) -> tuple[str, ...]:
    """Return the words of an analysis's command, which joined by `_` name the Python function."""
    return (name,) if ANALYSES[name].alone else ("analyze", name)


def options_of(name: str) -> "type[Options]":
    from stewart_drake.studies import study_options
    from stewart_drake.studies.options import Options

    options: type[Options] = getattr(study_options, f"{name.capitalize()}Options", Options)
    return options


def analyze(
    name: str,
    scenario: "Scenario",
    options: "Options | None" = None,
    *,
    command: str,
    directory: "str | Path | None" = None,
    progress: "Callable[[int, int], None] | None" = None,
) -> "AnalysisResult":
    """Study a scenario and describe the result.

    The page shows `command`, which repeats the analysis. A study keeps its runs in `directory`, and
    calls `progress` with the number of finished runs and of all.
    """
    from dataclasses import replace

    from stewart_drake.files.schema import plain
    from stewart_drake.reporting.results import analysis_result
    from stewart_drake.scenario.link import link_text

    row = ANALYSES[name]
    given: dict[str, Any] = {"directory": directory} if row.keeps else {}
    if row.counts:
        given |= {"options": options or options_of(name)(), "progress": progress}
    study = getattr(import_module(f"stewart_drake.studies.{name}"), f"study_{name}")
    room = import_module(f"stewart_drake.reporting.{name}")
    write = getattr(room, "write", None)
    found = analysis_result(lambda: study(scenario, **given), room.document, command, write)
    facts = {"link": text} if (text := link_text(scenario)) else {}
    return replace(
        found,
        summary=found.summary | {"link": plain(scenario.assumed_link)},
        document=replace(found.document, facts={**facts, **found.document.facts}),
    )
