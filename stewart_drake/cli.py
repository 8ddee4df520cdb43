"""The stewart-drake command. Drake is imported by the commands that need it, not for --help."""

import json
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from stewart_drake.errors import ConfigError
from stewart_drake.report.terminal import echo, progress_bars

INTERRUPTED: Final = 130
_BAD_INPUT: Final = 2
# Releases of typer keep their usage errors in different places; all derive from this class.
_UsageError: Final[Any] = typer.BadParameter.__mro__[1]

app = typer.Typer(add_completion=False, rich_markup_mode=None)
model_app = typer.Typer(rich_markup_mode=None, help="Look at a mechanism.")
app.add_typer(model_app, name="model")

_ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="Shipped name or file.")]
_MechanismName = Annotated[str, typer.Argument(metavar="MECHANISM", help="Shipped name or file.")]
_Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="FIELD=VALUE", help="E.g. plant.gravity=true; repeatable."),
]
_Out = Annotated[Path | None, typer.Option(metavar="DIR", help="For summary, signals, figures.")]
_Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
_Json = Annotated[bool, typer.Option("--json", help="Print the summary as JSON, nothing else.")]


def main(arguments: list[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: those of the command line by default.

    Returns:
        The exit status: 0; 2 for bad input, with one line on stderr; 130 for Ctrl-C.
    """
    command = typer.main.get_command(app)
    try:
        return command.main(arguments, "stewart-drake", standalone_mode=False) or 0
    except _UsageError as error:
        return _complain(_usage_message(error))
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except _bad_input() as error:
        return _complain(str(error))


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    show_version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """Delay-aware control of rotary Stewart platforms, simulated with Drake."""
    if show_version:
        from importlib.metadata import version

        typer.echo(f"stewart-drake {version('stewart-drake')}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def simulate(
    scenario: _ScenarioName = "paper",
    controller: Annotated[
        str | None, typer.Option(metavar="NAME|FILE", help="Laid over the scenario's own.")
    ] = None,
    settings: _Settings = None,
    out: _Out = None,
    quiet: _Quiet = False,
    as_json: _Json = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Show it in a browser, live and as a replay.")
    ] = False,
) -> int:
    """Run one scenario."""
    from stewart_drake.experiment import prepare
    from stewart_drake.report.tables import run_table, wrap
    from stewart_drake.scenario_loading import load_scenario
    from stewart_drake.simulation import simulate as run
    from stewart_drake.studies.verdict import delay_verdict

    say = _silence if quiet or as_json else echo
    experiment = prepare(load_scenario(scenario, controller, settings or ()))
    _check_writable(out)
    viewer = _open_meshcat() if meshcat else None
    say(wrap(str(delay_verdict(experiment))))
    if viewer is not None:
        say(f"showing it at {viewer.web_url()}")
    name = Path(scenario).stem
    with progress_bars([name], experiment.scenario.duration, quiet) as progress:
        result = run(experiment.scenario, progress=progress[name], meshcat=viewer)
    say(run_table(result))
    if out is not None:
        from stewart_drake.report.figures import run_figures

        # The summary comes last: where there is one, everything beside it is of the same run.
        _remove(out, ["summary.json"])
        figures = run_figures(result, out)
        result.save(out)
        say(f"written to {out}: summary.json, signals.nc, {len(figures)} figures")
    if as_json:
        _print_json(result.summary)
    if viewer is not None:
        from stewart_drake.report.replay import replay

        replay(result.signals, experiment.mechanism, viewer)
        if out is not None:
            (out / "replay.html").write_text(viewer.StaticHtml())
            say(f"written to {out}: replay.html")
        if sys.stdin.isatty():
            input(f"replay at {viewer.web_url()}, Enter ends")
    return INTERRUPTED if result.status == "interrupted" else 0


@app.command()
def compare(
    scenario: _ScenarioName = "paper",
    settings: _Settings = None,
    out: _Out = None,
    quiet: _Quiet = False,
    as_json: _Json = False,
) -> int:
    """Run the five controllers on a scenario: Table II."""
    from stewart_drake.experiment import prepare
    from stewart_drake.report.tables import comparison_table, wrap
    from stewart_drake.scenario_loading import load_scenario
    from stewart_drake.studies import compare as study
    from stewart_drake.studies.verdict import delay_verdict

    say = _silence if quiet or as_json else echo
    experiment = prepare(load_scenario(scenario, settings=settings or ()))
    _check_writable(out)
    say(wrap(str(delay_verdict(experiment))))
    names = study.CONTROLLERS
    with progress_bars(names, experiment.scenario.duration, quiet) as progress:
        results = study.compare(
            scenario, settings or (), lambda name, time, error: progress[name](time, error)
        )
    say(comparison_table(results))
    if out is not None:
        from stewart_drake.report.figures import comparison_figures

        _remove(out, ["summary.json", *(f"{name}.nc" for name in names)])
        figures = comparison_figures(results, out)
        study.save_comparison(results, out)
        say(f"written to {out}: summary.json, {len(results)} signal files, {len(figures)} figures")
    if as_json:
        _print_json(study.comparison_summary(results))
    ended = [result.status for result in results.values()]
    return INTERRUPTED if "interrupted" in ended or len(ended) < len(names) else 0


@app.command("list")
def list_shipped() -> None:
    """List the shipped mechanisms, scenarios and controllers."""
    from stewart_drake.report.tables import shipped_table

    for kind in ("mechanism", "scenario", "controller"):
        typer.echo(f"{kind}s")
        typer.echo(shipped_table(kind))


@model_app.command()
def sdf(
    mechanism: _MechanismName,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Instead of standard output.")
    ] = None,
) -> None:
    """Write a mechanism as SDFormat."""
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.mechanism.sdformat import to_sdformat

    text = to_sdformat(load_mechanism(mechanism))
    if out is None:
        typer.echo(text, nl=False)
        return
    if out.is_dir():
        raise ConfigError(f"--out: got {str(out)!r}, a directory; expected a file")
    _check_writable(out.parent)
    partial = out.with_name(f".{out.name}.part")
    partial.write_text(text)
    os.replace(partial, out)


@model_app.command()
def check(mechanism: _MechanismName) -> None:
    """Check a mechanism and describe it at its home pose, under gravity."""
    from stewart_drake.mechanism.files import load_mechanism
    from stewart_drake.report.tables import mechanism_table

    typer.echo(mechanism_table(load_mechanism(mechanism)))


def _bad_input() -> tuple[type[Exception], ...]:
    from stewart_drake.mechanism.kinematics import UnreachablePoseError

    return ConfigError, UnreachablePoseError, OSError


def _complain(message: str) -> int:
    echo("error: " + " ".join(message.split()), error=True)
    return _BAD_INPUT


def _usage_message(error: Any) -> str:
    if getattr(error, "possibilities", None):
        return f"{error.message}; did you mean {error.possibilities[0]}?"
    message = error.format_message().rstrip(".")
    if message.endswith("?"):
        return message
    command = "stewart-drake" if error.ctx is None else error.ctx.command_path
    return f"{message}; see {command} --help"


def _silence(text: str) -> None:
    pass


def _print_json(summary: dict[str, Any]) -> None:
    from stewart_drake.results import jsonable

    typer.echo(json.dumps(jsonable(summary), indent=2, allow_nan=False))


def _check_writable(directory: Path | None) -> None:
    if directory is None:
        return
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise ConfigError(
            f"--out: got {str(directory)!r}; expected a directory that can be written "
            f"({error.strerror})"
        ) from None


def _remove(directory: Path, names: Iterable[str]) -> None:
    for name in names:
        (directory / name).unlink(missing_ok=True)


def _open_meshcat() -> Any:
    from pydrake.geometry import Meshcat

    return Meshcat()
