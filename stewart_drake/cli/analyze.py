"""Commands of `reporting.analyses.ANALYSES`: analyze hautus, delay and so on, and layout."""

from collections.abc import Callable
from contextlib import nullcontext
from tempfile import TemporaryDirectory

import typer

from stewart_drake.cli.common import RESUMABLE, Chosen, Delivery, on_interrupt
from stewart_drake.cli.options import Given, command
from stewart_drake.reporting.analyses import ANALYSES, analyze, options_of, words_of
from stewart_drake.reporting.terminal import count_bar
from stewart_drake.scenario.config import Scenario

app = typer.Typer(rich_markup_mode=None, help="Analyse a loop before it is built.")


def add_analyses(root: typer.Typer) -> None:
    """Add the command of every analysis to the family `analyze`, or to the root."""
    for name, row in ANALYSES.items():
        group = root if row.alone else app
        group.command(name, help=row.help)(_callback(name))


def _callback(name: str) -> Callable[..., int | None]:
    """Return a function with the parameters of an analysis on the command line."""
    row = ANALYSES[name]

    @command(options_of(name), without=() if row.controller else ("controller",))
    def run(*, chosen: Chosen, given: Given, delivery: Delivery) -> int:
        fixed = ("plant.kind=exact",) if row.exact else ()

        def load(controller: str | None) -> Scenario:
            return chosen._replace(controller=controller).load(*fixed)

        options, out, loaded = given.options(load), delivery.out, chosen.load(*fixed)
        options.check_scenario(loaded)  # before anything heavy is imported
        line = chosen.line(*words_of(name), **given.words, out=out)
        kept = RESUMABLE.replace("runs", row.keeps) if out else "nothing is kept without --out"
        first = "preparing" if row.counts else "computing"
        with (
            TemporaryDirectory() as scratch,
            on_interrupt(kept) if row.keeps else nullcontext(lambda show: show) as counted,
            count_bar(row.counts or name, delivery.quiet, first) as bar,
        ):
            delivery.say_link(loaded)
            found = analyze(
                name,
                loaded,
                options,
                command=line,
                directory=out or scratch,
                progress=counted(bar),
            )
        there = len(list((out / "runs").glob("run[0-9]*.json"))) if out else 0
        if there > found.summary.get("runs", there):
            delivery.say(
                f"this report is of {found.summary['runs']} runs; {there} are kept in {out}/runs"
            )
        files, interrupted = (getattr(found.study, key, ()) for key in ("files", "interrupted"))
        files = (*files, *found.write_files(out))
        return delivery.answer(found, *files, interrupted=bool(interrupted))

    return run
