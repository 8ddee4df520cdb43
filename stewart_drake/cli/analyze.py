"""The commands of `reporting.analyses.ANALYSES`: analyze hautus, delay and so on, and layout."""

import contextlib
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand

from stewart_drake.cli.common import (
    GO_ON,
    AsJson,
    Controller,
    Delivery,
    Out,
    Quiet,
    ScenarioName,
    Settings,
    stopping,
)
from stewart_drake.cli.options import Given, with_options
from stewart_drake.reporting.analyses import ANALYSES, analyze, options_of, words_of
from stewart_drake.reporting.terminal import count_bar

if TYPE_CHECKING:
    from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Analyse a loop before it is built.")


class _Command(TyperCommand):
    """Command of an analysis. Its study, which has the options, is imported when it is called."""

    @cached_property
    def _made(self) -> Any:
        single = typer.Typer(rich_markup_mode=None, add_completion=False)
        single.command()(_callback(str(self.name)))
        return typer.main.get_command(single)

    @property
    def params(self) -> Any:
        return self._made.params

    @params.setter
    def params(self, _: Any) -> None: ...

    @property
    def callback(self) -> Any:
        return self._made.callback

    @callback.setter
    def callback(self, _: Any) -> None: ...


def add_analyses(root: typer.Typer) -> None:
    """Add the command of every analysis to the family `analyze`, or to the root."""
    for name, row in ANALYSES.items():
        group = root if row.alone else app
        group.command(name, cls=_Command, help=row.help)(lambda: None)


def _callback(name: str) -> Callable[..., int]:
    """Return a function with the parameters that the command line offers for an analysis."""
    row = ANALYSES[name]

    @with_options(options_of(name), without=() if row.controller else ("controller",))
    def run(
        *,
        scenario: ScenarioName = "paper",
        controller: Controller = None,
        settings: Settings = None,
        given: Given,
        out: Out = None,
        quiet: Quiet = False,
        as_json: AsJson = False,
    ) -> int:
        from stewart_drake.reporting.page import command_line
        from stewart_drake.scenario.loading import load_scenario

        typed = settings or []
        fixed = ("plant.kind=exact",) if row.exact else ()

        def load(controller: str | None) -> "Scenario":
            return load_scenario(scenario, controller, (*fixed, *typed))

        options = given.options(load)
        delivery = Delivery(out, quiet, as_json)
        command = command_line(
            *words_of(name),
            scenario,
            settings=typed,
            options={"controller": controller, **given.words, "out": out},
        )
        with TemporaryDirectory() as scratch, _progress(name, out, quiet) as progress:
            loaded = load(controller)
            delivery.tell_link(loaded)
            found = analyze(
                name, loaded, options, command=command, directory=out or scratch, progress=progress
            )
        files = getattr(found.study, "files", ())
        return delivery.answer(
            found, *files, interrupted=getattr(found.study, "interrupted", False)
        )

    return run


@contextlib.contextmanager
def _progress(name: str, out: Path | None, quiet: bool) -> Iterator[Any]:
    """Show what is counted, and say at Ctrl-C what is kept."""
    row = ANALYSES[name]
    kept = GO_ON.replace("runs", row.keeps) if out else "nothing is kept without --out"
    with stopping(kept) if row.keeps else contextlib.nullcontext():
        first = "preparing" if row.counts else "computing"
        with count_bar(row.counts or name, quiet, first) as progress:
            yield progress
