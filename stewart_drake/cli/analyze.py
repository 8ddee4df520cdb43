"""The commands of `reporting.analyses.ANALYSES`: analyze hautus, delay and so on, and layout."""

import contextlib
import inspect
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

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
    flags_named,
    stopping,
)
from stewart_drake.reporting.analyses import ANALYSES, analyze, options_of, words_of
from stewart_drake.reporting.terminal import count_bar

if TYPE_CHECKING:
    from stewart_drake.scenario.config import Scenario
    from stewart_drake.studies.options import Option

app = typer.Typer(rich_markup_mode=None, help="Tell beforehand what can be controlled, and how.")


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
    row, options = ANALYSES[name], options_of(name)
    flags = {_flag(one): one for one in options.described() if one.flag}

    def run(
        scenario: str,
        settings: list[str] | None,
        out: Path | None,
        quiet: bool,
        as_json: bool,
        **typed: Any,
    ) -> int:
        from stewart_drake.reporting.page import command_line
        from stewart_drake.scenario.loading import load_scenario

        given = settings or []
        fixed = ("plant.kind=exact",) if row.exact else ()

        def load(controller: str | None) -> "Scenario":
            return load_scenario(scenario, controller, (*fixed, *given))

        controller = typed.pop("controller", None)
        with flags_named({one.name: f"--{_dashed(flag)}" for flag, one in flags.items()}):
            chosen = options(**{one.name: _value(one, typed[f], load) for f, one in flags.items()})
        delivery = Delivery(out, quiet, as_json)
        words = {_dashed(f): typed[f] for f, one in flags.items() if one.recorded}
        command = command_line(
            *words_of(name),
            scenario,
            settings=given,
            options={"controller": controller, **words, "out": out},
        )
        with TemporaryDirectory() as scratch, _progress(name, out, quiet) as progress:
            loaded = load(controller)
            delivery.tell_link(loaded)
            found = analyze(
                name, loaded, chosen, command=command, directory=out or scratch, progress=progress
            )
        files = getattr(found.study, "files", ())
        return delivery.answer(
            found, *files, interrupted=getattr(found.study, "interrupted", False)
        )

    kind = inspect.Parameter.KEYWORD_ONLY
    shown: dict[str, tuple[Any, Any]] = {"scenario": (ScenarioName, "paper")}
    shown |= {"controller": (Controller, None)} if row.controller else {}
    shown |= {"settings": (Settings, None)}
    shown |= {flag: _typed(one) for flag, one in flags.items()}
    shown |= {"out": (Out, None), "quiet": (Quiet, False), "as_json": (AsJson, False)}
    run.__annotations__ = {}
    run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(k, kind, annotation=a, default=d) for k, (a, d) in shown.items()]
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


def _typed(one: "Option") -> tuple[Any, Any]:
    """Return annotation and default of the command line's parameter."""
    assert one.flag is not None
    option = typer.Option(
        f"--{_dashed(_flag(one))}",
        metavar=one.flag.metavar,
        help=one.help + " Repeatable." * bool(one.flag.read),
    )
    if one.flag.read:
        return Annotated[list[str] | None, option], None
    return Annotated[one.annotation, option], one.default


def _value(one: "Option", typed: Any, load: Callable[[str], "Scenario"]) -> Any:
    if one.flag is None or one.flag.read is None:
        return typed
    return one.flag.read(typed, load) if typed else one.default


def _flag(one: "Option") -> str:
    return (one.flag and one.flag.name) or one.name


def _dashed(name: str) -> str:
    return name.replace("_", "-")
