"""What the commands do, from Python and in notebooks: tables, figures, replay, report, analyses."""

import dataclasses
import html
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.figure import Figure
from pydrake.geometry import Meshcat

from stewart_drake.files.jsonio import write_json
from stewart_drake.loop.results import SimulationResult
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.report import delay_page, hautus_page, robustness_page, workspace_page
from stewart_drake.report.collect import collect
from stewart_drake.report.figures import comparison_figures, draw_comparison, draw_run, run_figures
from stewart_drake.report.page import Page, Picture, Provenance, write_page
from stewart_drake.report.replay import replay as animate
from stewart_drake.report.replay import replay_html, write_replay
from stewart_drake.report.report_page import report_page, report_summary
from stewart_drake.report.tables import comparison_table, run_table
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.studies.delay_limits import study_delay
from stewart_drake.studies.hautus import study_hautus
from stewart_drake.studies.ranges import Ranges
from stewart_drake.studies.robustness import study_robustness
from stewart_drake.studies.workspace import study_workspace

Results = SimulationResult | Mapping[str, SimulationResult]
"""Of `simulate`, or of `compare`."""


class Figures(dict[str, Figure]):
    """Figures by name; a notebook shows them."""

    def _repr_html_(self) -> str:
        pictures = (
            f'<img src="{Picture(figure, name).source}" alt="{html.escape(name)}">'
            for name, figure in self.items()
        )
        return "\n".join(pictures)

    def __repr__(self) -> str:
        return f"Figures({', '.join(self)})"


@dataclass(frozen=True)
class Answer:
    """An analysis or a report; printed it is a table, in a notebook the page.

    Attributes:
        verdict: in a sentence.
        summary: what `summary.json` holds.
        page: that can be saved.
        study: everything that was found.
    """

    verdict: str
    summary: dict[str, Any] = field(repr=False)
    page: Page = field(repr=False)
    study: Any = field(repr=False)
    _table: str = field(repr=False)

    def __str__(self) -> str:
        return self._table

    def _repr_html_(self) -> str:
        return _frame(self.page.html())

    def save(self, directory: str | Path) -> Path:
        """Write report.html and summary.json into a directory, which is made; the page's path.

        Raises:
            OSError: the directory cannot be written to.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / "summary.json", self.summary)
        return write_page(self.page, folder / "report.html")


class Replay:
    """The animation of a run; a notebook shows it, `save` writes it as a file."""

    def __init__(self, text: str) -> None:
        self.html = text

    def __repr__(self) -> str:
        return f"Replay({len(self.html) / 1e6:.1f} MB of HTML)"

    def _repr_html_(self) -> str:
        return _frame(self.html)


def table(results: Results) -> str:
    """How a run or a comparison went, as at a terminal."""
    if isinstance(results, SimulationResult):
        return run_table(results)
    return comparison_table(results)


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
    machine = load_mechanism(result.scenario.mechanism) if mechanism is None else mechanism
    if meshcat is not None:
        return animate(result.signals, machine, meshcat)
    if path is None:
        return Replay(replay_html(result, machine, title))
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    return write_replay(result, machine, Path(path), title)


def report(scenario: str | Path, settings: Iterable[str] = ()) -> Answer:
    """Run, compare and analyse a scenario, as one page.

    Args:
        scenario: a shipped name or a path.
        settings: as `load_scenario` takes them.

    Raises:
        ConfigError: bad input.
    """
    settings = tuple(settings)
    found = collect(scenario, settings)
    film = ""
    if found.run is not None:
        film = replay_html(found.run, load_mechanism(found.scenario.mechanism), Path(scenario).stem)
    made = Provenance(f"sd.report({str(scenario)!r}, {list(settings)})")
    page = report_page(found, Path(scenario).stem, made, film)
    text = comparison_table(found.comparison) if found.comparison else page.verdict
    return Answer(page.verdict, report_summary(found), page, found, text)


def analyze_delay(scenario: Scenario | str | Path, simulations: bool = True) -> Answer:
    """What delay the open and the closed loop of a scenario bear.

    Args:
        scenario: or a shipped name or a path.
        simulations: whether delay and amplitude are also varied in simulations, on all cores.

    Raises:
        ConfigError: bad input.
    """
    study, made = _study(partial(study_delay, simulations=simulations), scenario, "delay")
    page, text = delay_page.delay_page(study, made), delay_page.delay_table(study)
    return Answer(page.verdict, study.summary, page, study, text)


def analyze_robustness(
    scenario: Scenario | str | Path,
    runs: int = 200,
    *,
    ranges: Ranges | None = None,
    seed: int = 0,
    limit: float | None = None,
    directory: str | Path | None = None,
) -> Answer:
    """Monte Carlo over what is not known of the machine: how often it works, and what matters.

    Args:
        scenario: or a shipped name or a path; the exact plant is run whatever it says.
        runs: number of machines that are drawn.
        ranges: of what is drawn, the defaults if None.
        seed: of all draws.
        limit: E_ac in % s above which a completed run counts as failed, or None.
        directory: where runs are kept, so that a second call goes on with them; None is nowhere.

    Raises:
        ConfigError: bad input.
        ChildProcessError: a worker process died.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    base = dataclasses.replace(loaded, plant=dataclasses.replace(loaded.plant, kind="exact"))

    def study(into: str | Path) -> Any:
        return study_robustness(base, into, ranges=ranges, runs=runs, seed=seed, limit=limit)

    if directory is None:
        with TemporaryDirectory() as scratch:
            found = study(scratch)
    else:
        found = study(directory)
    page = robustness_page.robustness_page(
        found, Provenance(f"sd.analyze_robustness({loaded!r}, {runs})")
    )
    text = robustness_page.robustness_table(found)
    return Answer(page.verdict, found.summary, page, found, text)


def analyze_hautus(scenario: Scenario | str | Path) -> Answer:
    """Controllability and observability of a scenario's models, mode by mode.

    Raises:
        ConfigError: bad input.
    """
    study, made = _study(study_hautus, scenario, "hautus")
    page, text = hautus_page.hautus_page(study, made), hautus_page.hautus_table(study)
    return Answer(page.verdict, study.summary, page, study, text)


def analyze_workspace(scenario: Scenario | str | Path) -> Answer:
    """Reach, singularity, the largest amplitude that fits, and motors, along a scenario's motion.

    Raises:
        ConfigError: bad input.
    """
    study, made = _study(study_workspace, scenario, "workspace")
    page = workspace_page.workspace_page(study, made)
    text = workspace_page.workspace_table(study)
    return Answer(page.verdict, study.summary, page, study, text)


def _study(
    study: Callable[[Scenario], Any], scenario: Scenario | str | Path, name: str
) -> tuple[Any, Provenance]:
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    return study(loaded), Provenance(f"sd.analyze_{name}({scenario!r})")


def _frame(page: str) -> str:
    """A page inside another one, where its scripts reach nothing outside."""
    return (
        f'<iframe srcdoc="{html.escape(page)}" sandbox="allow-scripts" '
        'style="width: 100%; height: 600px; border: 0"></iframe>'
    )
