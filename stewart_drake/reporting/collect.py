"""What a report is made of: the scenario's run, the comparison, the tuner's runs, the analyses."""

import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.loop.experiment import assemble, reference_failure
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.reporting.analyses import analyze, options_of
from stewart_drake.reporting.figures import TORQUE_CONTROLLERS
from stewart_drake.reporting.results import AnalysisResult
from stewart_drake.scenario.config import AnnTunerConfig, Scenario
from stewart_drake.scenario.loading import load_understood
from stewart_drake.studies.compare import shown
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.tuner.network import DEFAULT

ANALYSES: Final = ("delay", "hautus", "workspace")
"""In the order in which they are read."""
_OWN: Final = ""
"""The scenario's own run, which no row of a comparison is called."""
_TUNED: Final = "tuned-"


@dataclass(frozen=True)
class Collected:
    """Everything in a report.

    Attributes:
        scenario: as asked for.
        failure: where the reference leaves the workspace, so that nothing was simulated, or None.
        run: of the scenario as it stands; None with a `failure`.
        comparison: the shipped controllers on it, by name.
        tuned: those that know of the delay, with the tuner's weights; empty without a network.
        analyses: by name, in the order of ANALYSES; without their studies.
    """

    scenario: Scenario
    failure: Failure | None
    run: SimulationResult | None = None
    comparison: dict[str, SimulationResult] = field(default_factory=dict)
    tuned: dict[str, SimulationResult] = field(default_factory=dict)
    analyses: dict[str, AnalysisResult] = field(default_factory=dict)


def collect(
    scenario_name: str | Path,
    settings: Iterable[str] = (),
    progress: Progress | None = None,
    controller: str | Path | None = None,
) -> Collected:
    """Run and analyse a scenario, on all cores. A reference out of reach is analysed only.

    Args:
        scenario_name: a shipped name or a path.
        settings: as `load_scenario` takes them.
        progress: called for every finished run or analysis.
        controller: laid over the scenario's own, a shipped name or a path; the shipped ones are
            compared on the scenario without it.

    Raises:
        ConfigError: bad input.
        ChildProcessError: a worker process died.
        KeyboardInterrupt: Ctrl-C.
    """
    settings = tuple(settings)
    scenario = load_understood(scenario_name, controller, settings)
    failure = reference_failure(assemble(scenario))
    scenarios: dict[str, Scenario] = {}
    rows: set[str] = set()
    if failure is None:
        scenarios = shown(scenario_name, settings)
        rows = set(scenarios)
        if scenario not in scenarios.values():
            scenarios[_OWN] = scenario
        if has_network(scenario):
            tuned = (*settings, "tuner.kind=ann")
            for name in TORQUE_CONTROLLERS:
                scenarios[_TUNED + name] = load_understood(scenario_name, name, tuned)
    done, analyses = _work(scenario, scenarios, progress)
    return Collected(
        scenario=scenario,
        failure=failure,
        run=next((done[key] for key, sc in scenarios.items() if sc == scenario), None),
        comparison={name: done[name] for name in scenarios if name in rows},
        tuned={name: done[_TUNED + name] for name in TORQUE_CONTROLLERS if _TUNED + name in done},
        analyses=analyses,
    )


def has_network(scenario: Scenario) -> bool:
    """Whether there is a network whose weights can be shown beside the scenario's fixed ones."""
    if isinstance(scenario.tuner, AnnTunerConfig):
        return False  # the comparison itself has them
    try:
        resolve("weights", DEFAULT)
    except ConfigError:
        return False
    return True


def _work(
    scenario: Scenario, scenarios: dict[str, Scenario], progress: Progress | None
) -> tuple[dict[str, SimulationResult], dict[str, AnalysisResult]]:
    """Results by the names of the scenarios, and the analyses by theirs."""
    # The analyses first: they take longest.
    jobs: dict[str, Job] = {name: (name, scenario) for name in ANALYSES}
    jobs |= {f"run{i}": ("simulate", sc) for i, sc in enumerate(scenarios.values())}
    with TemporaryDirectory() as folder:
        paths = run_jobs(jobs, _piece, folder, settings={}, suffix=".pickle", progress=progress)
        # Written by our own workers a moment ago, into a folder that nobody else can write to.
        found: list[Any] = [pickle.loads(path.read_bytes()) for path in paths.values()]
    answers, runs = found[: len(ANALYSES)], found[len(ANALYSES) :]
    return dict(zip(scenarios, runs, strict=True)), dict(zip(ANALYSES, answers, strict=True))


def _piece(what: str, scenario: Scenario) -> bytes:
    return pickle.dumps(simulate(scenario) if what == "simulate" else _analyse(what, scenario))


def _analyse(name: str, scenario: Scenario) -> AnalysisResult:
    given = {"simulations": False} if name == "delay" else {}
    options = options_of(name)(**given)
    found = analyze(name, scenario, options, command=f"stewart-drake analyze {name}")
    return replace(found, study=None)  # what no process can send
