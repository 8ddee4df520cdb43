"""What the commands do, from Python and in notebooks: tables, figures, replay, report, analyses."""

import dataclasses
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure
from pydrake.geometry import Meshcat

from stewart_drake.loop.experiment import simulated_machine
from stewart_drake.loop.results import SimulationResult
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting import report_document
from stewart_drake.reporting.analyses import analyze
from stewart_drake.reporting.answer import Answer, framed
from stewart_drake.reporting.collect import collect
from stewart_drake.reporting.figures import (
    comparison_figures,
    draw_comparison,
    draw_run,
    run_figures,
)
from stewart_drake.reporting.page import Provenance, source
from stewart_drake.reporting.replay import replay as animate
from stewart_drake.reporting.replay import replay_html, write_replay
from stewart_drake.reporting.run_document import comparison_document, run_document
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.ranges import Ranges

Results = SimulationResult | Mapping[str, SimulationResult]
"""Of `simulate`, or of `compare`."""


class Figures(dict[str, Figure]):
    """Figures by name; a notebook shows them."""

    def _repr_html_(self) -> str:
        pictures = (
            f'<img src="{source(figure)}" alt="{html.escape(name)}">'
            for name, figure in self.items()
        )
        return "\n".join(pictures)

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"


class Replay:
    """The animation of a run; a notebook shows it, `save` writes it as a file."""

    def __init__(self, text: str) -> None:
        self.html = text

    def __repr__(self) -> str:
        return f"Replay({len(self.html) / 1e6:.1f} MB of HTML)"

    def _repr_html_(self) -> str:
        return framed(self.html)


def table(results: Results) -> str:
    """How a run or a comparison went, as at a terminal."""
    if isinstance(results, SimulationResult):
        return run_document(results).plain()
    return comparison_document(results).plain()


def plot(results: Results, directory: str | Path | None = None) -> Figures:
    """Figures of a run or a comparison, by name.

    Args:
        results: of `simulate` or `compare`.
        directory: where they are also written, as PNG and SVG; it is made.

    Raises:
        OSError: the directory cannot be written to.
    """
    if directory is not None:
        Path(directory).mkdir(parents=True, exist_ok=True)
    if isinstance(results, SimulationResult):
        if directory is not None:
            run_figures(results, directory)
        return Figures(draw_run(results))
    if directory is not None:
        comparison_figures(results, directory)
    return Figures(draw_comparison(results))


def replay(
    result: SimulationResult,
    path: str | Path | None = None,
    *,
    meshcat: Meshcat | None = None,
    mechanism: Mechanism | None = None,
    title: str = "replay",
) -> Replay | Path | Meshcat:
    """A run in three dimensions: in Meshcat, as a file, or for a notebook.

    Args:
        result: of `simulate`.
        path: of the HTML file to write, which plays without a network; its folder is made.
        meshcat: where it is played instead.
        mechanism: that was run, by default the scenario's.
        title: of the page.

    Returns:
        The path, the Meshcat, or without either what a notebook shows.

    Raises:
        OSError: the file cannot be written.
    """
    machine = simulated_machine(result.scenario) if mechanism is None else mechanism
    if meshcat is not None:
        return animate(result.signals, machine, meshcat)
    if path is None:
        return Replay(replay_html(result, machine, title))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    return write_replay(result, machine, Path(path), title)


def report(
    scenario: str | Path, settings: Iterable[str] = (), controller: str | Path | None = None
) -> Answer:
    """Run, compare and analyse a scenario, as one page.

    Args:
        scenario: a shipped name or a path.
        settings: as `load_scenario` takes them.
        controller: laid over the scenario's own, see `report.collect.collect`.

    Raises:
        ConfigError: bad input.
    """
    settings = tuple(settings)
    found = collect(scenario, settings, controller=controller)
    film = ""
    if found.run is not None:
        film = replay_html(found.run, simulated_machine(found.scenario), Path(scenario).stem)
    own = "" if controller is None else f", {str(controller)!r}"
    made = Provenance(f"sd.report({str(scenario)!r}, {list(settings)}{own})")
    document = report_document.document(found, Path(scenario).stem, film)
    return Answer(found, report_document.report_summary(found), document, made)


def analyze_delay(scenario: Scenario | str | Path, simulations: bool = True) -> Answer:
    """What delay the open and the closed loop of a scenario bear.

    Args:
        scenario: or a shipped name or a path.
        simulations: whether delay and amplitude are also varied in simulations, on all cores.

    Raises:
        ConfigError: bad input.
    """
    return _analyze("delay", scenario, simulations=simulations)


def analyze_link(scenario: Scenario | str | Path, runs: int = 5) -> Answer:
    """Which play-out bound suits a scenario's network, and what loss it bears.

    Args:
        scenario: with `link.kind: network`, or a shipped name or a path.
        runs: seeds for each bound and each loss.

    Raises:
        ConfigError: bad input.
    """
    return _analyze("link", scenario, runs=runs)


def analyze_robustness(
    scenario: Scenario | str | Path,
    runs: int = 200,
    *,
    ranges: Ranges | None = None,
    seed: int = 0,
    limit: float | None = None,
    directory: str | Path | None = None,
    beside: Mapping[str, Scenario] | None = None,
) -> Answer:
    """Monte Carlo over what is not known of the machine: how often it works, and what matters.

    Args:
        scenario: or a shipped name or a path; the exact plant is run whatever it says.
        runs: number of machines that are drawn.
        ranges: of what is drawn, the defaults if None.
        seed: of all draws.
        limit: E_ac in % s above which a completed run counts as failed, or None.
        directory: where runs are kept, so that a second call goes on with them; None is nowhere.
        beside: by a name, the scenario with other controllers, for the same machines; on the exact
            plant too.

    Raises:
        ConfigError: bad input.
        ChildProcessError: a worker process died.
    """
    with TemporaryDirectory() as scratch:
        return analyze(
            "robustness",
            _on_exact_plant(_loaded(scenario)),
            directory or scratch,
            command=f"sd.analyze_robustness({scenario!r}, {runs})",
            ranges=ranges,
            runs=runs,
            seed=seed,
            limit=limit,
            beside={name: _on_exact_plant(other) for name, other in (beside or {}).items()},
        )


def _on_exact_plant(scenario: Scenario) -> Scenario:
    return dataclasses.replace(scenario, plant=scenario.plant.without_engine)


def analyze_hautus(scenario: Scenario | str | Path) -> Answer:
    """Controllability and observability of a scenario's models, mode by mode.

    Raises:
        ConfigError: bad input.
    """
    return _analyze("hautus", scenario)


def analyze_workspace(scenario: Scenario | str | Path) -> Answer:
    """Reach, singularity, the largest amplitude that fits, and motors, along a scenario's motion.

    Raises:
        ConfigError: bad input.
    """
    return _analyze("workspace", scenario)


def layout(
    scenario: Scenario | str | Path,
    directory: str | Path | None = None,
    *,
    goal: str = "condition",
    limits: Mapping[str, float] | None = None,
    vary: Mapping[str, tuple[float, float]] | None = None,
    keep: Sequence[str] = (),
    best: int = 3,
    starts: int = 1,
    generations: int = 100,
    seed: int = 0,
) -> Answer:
    """Search layouts and lengths of a machine that suit a scenario's motion, on all cores.

    Args:
        scenario: or a shipped name or a path; its machine, which has a pattern, is begun from.
        directory: where the machines found and finished searches are kept, so that a second call
            goes on with them; None is nowhere.
        goal: of `studies.layout_measures.MEASURES`, what should be as good as can be.
        limits: least or largest values by measure, SI and degrees; others are as usual.
        vary: bounds by parameter.
        keep: parameters and choices that stay as they are.
        best: how many machines are written.
        starts: searches per arrangement.
        generations: of each search, at most.
        seed: of the searches.

    Raises:
        ConfigError: bad input.
        ChildProcessError: a worker process died.
    """
    with TemporaryDirectory() as scratch:
        return analyze(
            "layout",
            _loaded(scenario),
            directory or scratch,
            command=f"sd.layout({scenario!r}, goal={goal!r}, seed={seed})",
            goal=goal,
            limits=limits,
            vary=vary,
            keep=keep,
            best=best,
            starts=starts,
            generations=generations,
            seed=seed,
        )


def _analyze(name: str, scenario: Scenario | str | Path, **options: Any) -> Answer:
    command = f"sd.analyze_{name}({scenario!r})"
    return analyze(name, _loaded(scenario), command=command, **options)


def _loaded(scenario: Scenario | str | Path) -> Scenario:
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
