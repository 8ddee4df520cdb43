"""Public functions of runs, comparisons, reports and analyses."""

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ParamSpec, TypeVar

from stewart_drake.loop import controller_margin as margins
from stewart_drake.loop import simulation
from stewart_drake.reporting.analyses import ANALYSES, analyze, options_of, words_of
from stewart_drake.reporting.results import (
    AnalysisResult,
    ComparisonResult,
    ControllerMargin,
    SimulationResult,
)
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario, setting_texts, title_of
from stewart_drake.studies import compare as comparison
from stewart_drake.studies.options import Options, takes

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")


def _with(kind: type[R], shown: Callable[[S], R], function: Callable[P, S]) -> Callable[P, R]:
    """Return the function with its result converted to a kind, with the same docstring."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        return shown(function(*args, **kwargs))

    own = inspect.signature(function).replace(return_annotation=kind)
    call.__signature__ = own  # type: ignore[attr-defined]
    return call


simulate = _with(SimulationResult, SimulationResult.of, simulation.simulate)
compare = _with(ComparisonResult, ComparisonResult, comparison.compare)
controller_margin = _with(ControllerMargin, ControllerMargin.of, margins.controller_margin)


def report(
    scenario: Scenario | str | Path,
    settings: Iterable[str] = (),
    controller: str | Path | None = None,
) -> AnalysisResult:
    """Run, compare and analyse a scenario, as one page.

    Args:
        scenario: a Scenario, a shipped name or a path.
        settings: as `load_scenario` takes them.
        controller: replaces the scenario's own in its run and the analyses; a name or a path.

    Raises:
        ConfigError: bad input.
    """
    from stewart_drake.reporting import report as report_document
    from stewart_drake.reporting.page import Provenance

    settings, name = setting_texts(settings), title_of(scenario)
    found = report_document.collect(scenario, settings, controller=controller)
    own = "" if controller is None else f", {str(controller)!r}"
    shown = repr(scenario) if isinstance(scenario, Scenario) else repr(str(scenario))
    made = Provenance(f"sd.report({shown}, {list(settings)}{own})")
    return report_document.result(found, name, report_document.film(found, name), made)


def analysis_function(name: str) -> Callable[..., AnalysisResult]:
    """Return the Python function of an analysis, with its options as arguments."""
    row, words = ANALYSES[name], "_".join(words_of(name))

    def call(
        scenario: Scenario | str | Path,
        *,
        settings: Iterable[str] = (),
        controller: str | Path | None = None,
        options: Options,
        directory: str | Path | None = None,
    ) -> AnalysisResult:
        settings = list(setting_texts(settings))
        given = {"settings": settings or None, "controller": controller and str(controller)}
        given |= {key: value for key, value in options if key in options.model_fields_set}
        shown = "".join(f", {key}={value!r}" for key, value in given.items() if value is not None)
        loaded = as_scenario(scenario, controller, settings)
        if row.exact:
            loaded = _exact(loaded)
            options = options.model_copy(update=_exact(dict(options)))
        command = f"sd.{words}({scenario!r}{shown})"
        with TemporaryDirectory() as scratch:
            where = directory or scratch
            return analyze(name, loaded, options, command=command, directory=where)

    own = inspect.signature(call)
    left_out = {"directory": not row.keeps, "controller": not row.controller}
    kept = [one for one in own.parameters.values() if not left_out.get(one.name)]
    call.__signature__ = own.replace(parameters=kept)  # type: ignore[attr-defined]
    instead = "\n    controller: a shipped name or a YAML file, laid over the scenario's own."
    folder = f"\n    directory: folder of the {row.keeps}, from which a second call continues."
    exact = "; the exact plant replaces Drake's engine"
    call.__name__ = call.__qualname__ = words
    call.__doc__ = f"""{row.help.partition(chr(10))[0]}

Args:
    scenario: a Scenario, a shipped name or a path{exact if row.exact else ""}.
    settings: as `load_scenario` takes them.{instead if row.controller else ""}
    OPTIONS{folder if row.keeps else ""}

Raises:
    ConfigError: bad input.
"""
    return takes(options_of(name), row.second)(call)


def _exact(value: Any) -> Any:
    """Return scenarios, also in mappings, with the exact plant."""
    if isinstance(value, Scenario):
        return replace(value, plant=value.plant.without_engine)
    return {k: _exact(v) for k, v in value.items()} if isinstance(value, Mapping) else value


def __getattr__(name: str) -> Any:
    for analysis in ANALYSES:
        if "_".join(words_of(analysis)) == name:
            return analysis_function(analysis)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
