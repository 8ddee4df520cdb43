"""Document of a scenario, to be shown to somebody else.

How its own run went, the shipped controllers in the manner of the paper's Table II and figures 5, 6
and 7, what the analyses say beforehand, and the scenario itself.
"""

import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.loop.preparation import assemble
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.reporting.analyses import analyze, options_of
from stewart_drake.reporting.document import (
    Document,
    Frame,
    Listing,
    Paragraph,
    Picture,
    Section,
    Tone,
    from_template,
    number,
    sentence,
)
from stewart_drake.reporting.figures import (
    TORQUE_CONTROLLERS,
    draw_comparison,
    draw_run,
    has_packets,
    weights_figure,
)
from stewart_drake.reporting.results import AnalysisResult
from stewart_drake.reporting.run import comparison_blocks, run_blocks
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import link_text, number_sent
from stewart_drake.scenario.loading import load_compatible, scenario_yaml
from stewart_drake.studies.compare import LABELS, is_papers, label, shown
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.tuner.network import DEFAULT

ANALYSES: Final = ("delay", "hautus", "workspace")
"""In the order in which they are read."""
_OWN: Final = ""
"""The scenario's own run, which no row of a comparison is called."""
_TUNED: Final = "tuned-"
GOOD: Final = 5.0
POOR: Final = 25.0
"""% of peak to peak: mean errors, once torques can act, up to which a run is good, and not bad."""
FEW_BAD: Final = 0.01
MANY_BAD: Final = 0.5
"""Bad measurements per sample up to which a run is good, and not bad."""

_LEVELS: Final[tuple[Tone, ...]] = ("good", "fair", "bad")
WIDE: Final = "The stated deviation is 1.6 to 2.6 times too large."
_QUESTIONS: Final = {
    "delay": "Is the loop stable with its delay?",
    "hautus": "Can the models be controlled and observed?",
    "workspace": "Does the motion fit the machine?",
}
_CAPTIONS: Final = {
    "states": "The plate's six coordinates.",
    "errors": "Their errors.",
    "torques_delay_lqr": "Applied torques of the delay-aware LQR, without integral action.",
    "torques_delay_lqi": "Applied torques of the delay-aware LQI, with integral action.",
    "torques_predictor_lqi": "Applied torques of the LQI with nonlinear prediction.",
    "weights": "The weights that the tuner's network sets online.",
}
_PAPER_FIGURES: Final = {
    "states": "5(a)",
    "errors": "5(b)",
    "torques_delay_lqr": "7(a)",
    "torques_delay_lqi": "7(b)",
    "weights": "6",
}
"""Of the paper, which show the same for its experiment."""
_RUN_CAPTIONS: Final = {
    "states": "Where the plate was, and where it should have been.",
    "errors": "The difference.",
    "torques": "Torques as commanded, and as applied: within the motors' limit, after the delay.",
    "delay": f"The delay as it was found, with its band, and its error. {WIDE}",
    "parameters": "Parameters of the plant, as the controller estimates them.",
    "weights": "The weights that the tuner set.",
}
_PACKETS_BELOW: Final = (
    " Below: packets that were sent, lost, or late, and periods in which one was played, or the "
    "buffer was dry."
)


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
    scenario = load_compatible(scenario_name, controller, settings)
    failure = assemble(scenario).reference_failure()
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
                scenarios[_TUNED + name] = load_compatible(scenario_name, name, tuned)
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
    if scenario.tuner.kind == "ann":
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


# ---------------------------------------------------------------- the document


def document(found: Collected, name: str, replay: str = "") -> Document:
    """The report.

    Args:
        found: what it is about.
        name: of the scenario.
        replay: the replay's page, to be shown inside, or empty.
    """
    text, tone = verdict(found)
    compared, weights = _compared(found)
    made = from_template(
        "report",
        tone,
        name=name,
        verdict=text,
        sc=found.scenario,
        mechanism=load_mechanism(found.scenario.mechanism).name,
        link=link_text(found.scenario),
        failure=found.failure,
        replay=replay and Frame(replay),
        run=found.run and [*run_blocks(found.run), *_run_pictures(found.run)],
        comparison=found.comparison and comparison_blocks(found.comparison, found.tuned),
        papers=is_papers(found.scenario),
        no_weights=not weights,
        compared=compared,
    )
    answers = {_QUESTIONS[key]: found.analyses[key] for key in ANALYSES}
    made.sections.extend(_answer(question, answer) for question, answer in answers.items())
    made.sections.extend(_details(question, answer) for question, answer in answers.items())
    above = "Every field, in the format of a scenario file: saved as one it runs again."
    listing = Listing(scenario_yaml(found.scenario))
    made.sections.append(Section("The scenario", above, listing, folded=True))
    return made


def report_summary(found: Collected) -> dict[str, Any]:
    """Return the content of summary.json; each part is as its own command writes it."""
    text, tone = verdict(found)
    return {
        "verdict": text,
        "tone": tone,
        "failure": None if found.failure is None else found.failure._asdict(),
        "run": None if found.run is None else found.run.summary,
        "controllers": {name: run.summary for name, run in found.comparison.items()},
        "tuned": {name: run.summary for name, run in found.tuned.items()},
        "analyses": {
            name: {"verdict": a.verdict, "tone": a.document.tone, **a.summary}
            for name, a in found.analyses.items()
        },
    }


def verdict(found: Collected) -> tuple[str, Tone]:
    """Return how the scenario went in a few sentences, and the level of the worst finding."""
    if found.run is None:
        return sentence(found.analyses["workspace"].verdict), "bad"
    run, s = found.run, found.run.summary
    if run.stopped is not None:
        return (
            f"The run ended after {run.stopped.time:.2f} of {run.scenario.duration:g} s: "
            f"{run.stopped.reason}.{_who_completes(found)}",
            "bad",
        )
    error, floor, mean = s["accumulated_error"], s["delay_floor"], mean_error(run)
    findings, duration = _findings(run), f"all of {run.scenario.duration:g} s"
    told = {tone: "; ".join(one for level, one in findings if level == tone) for tone in _LEVELS}
    text = f"The plate follows its reference for {duration}: E_ac is "
    if told["bad"]:
        text = f"Not reliable: {told['bad']}. The run completed {duration}: E_ac is "
    average = f"{number(mean, 2)} % of peak to peak on average"
    if floor > 0:
        text += (
            f"{number(error)} % s, of which {number(floor)} pass before any torque can act. The "
            f"rest is {average}."
        )
    else:
        text += f"{number(error)} % s, {average}."
    if told["fair"]:
        text += f" Caution: {told['fair']}."
    return text, max((level for level, _ in findings), key=_LEVELS.index, default="good")


def _findings(run: SimulationResult) -> list[tuple[Tone, str]]:
    """Return what speaks against a completed run, each with its level."""
    s, found, mean = run.summary, list[tuple[Tone, str]](), mean_error(run)
    margin, counts = s["controller_margin"], s["counts"]
    if margin is not None and margin["stable"] is False:
        growth = f"errors grow {margin['spectral_radius']:.3g} fold per period"
        found.append(("bad", f"the loop is unstable, {growth}"))
    samples = number_sent(run.scenario.duration, run.scenario.controller.period)
    wrong = counts["bad_measurements"]
    if wrong > FEW_BAD * samples:
        text = f"{wrong} bad measurements in {samples} samples"
        found.append(("bad" if wrong > MANY_BAD * samples else "fair", text))
    failed = sum(counts[name] for name in ("riccati_failures", "unreachable", "nonfinite_torque"))
    if failed:
        found.append(("fair", f"{failed} of {samples} samples without a new gain or torque"))
    if not mean <= GOOD:  # or NaN
        text = f"a mean error of {number(mean, 2)} % of peak to peak"
        found.append(("bad" if mean > POOR else "fair", text))
    if s["warnings"]:
        found.append(("fair", "see the warnings below"))
    return found


def _who_completes(found: Collected) -> str:
    """The best of the other controllers that do, in a sentence, or nothing."""
    done = {
        name: run.accumulated_error
        for name, run in found.comparison.items()
        if run.status == "completed"
    }
    if not done:
        return ""
    best = min(done, key=lambda name: done[name])
    return f" {label(best)} completes it, with an E_ac of {number(done[best])} % s."


def mean_error(run: SimulationResult) -> float:
    """% of peak to peak, over the time in which torques can act; NaN if the run ended early."""
    s, sc = run.summary, run.scenario
    blind = sc.eta if s["delay_floor"] else 0.0
    left = sc.duration - blind
    return float((s["accumulated_error"] - s["delay_floor"]) / left) if left > 0 else np.nan


def _run_pictures(run: SimulationResult) -> list[Picture]:
    below = {"torques": _PACKETS_BELOW} if has_packets(run) else {}
    return [
        Picture(figure, _RUN_CAPTIONS[name] + below.get(name, ""))
        for name, figure in draw_run(run).items()
    ]


def _compared(found: Collected) -> tuple[list[Picture], bool]:
    """Return the figures of the comparison, and whether weights of a tuner are among them."""
    figures = draw_comparison(found.comparison)
    if found.tuned:
        figures["weights"] = weights_figure({LABELS[n]: run for n, run in found.tuned.items()})
    pictures = []
    for name, figure in figures.items():
        caption = _CAPTIONS.get(name) or _caption_of(name)
        if is_papers(found.scenario) and name in _PAPER_FIGURES:
            below = caption[:1].lower() + caption[1:]
            caption = f"As figure {_PAPER_FIGURES[name]} of the paper: {below}"
        pictures.append(Picture(figure, caption))
    return pictures, "weights" in figures


def _caption_of(figure: str) -> str:
    """Return the caption of a figure of a controller that is not always compared."""
    what, _, controller = figure.partition("_")
    if what == "delay":
        return f"How {label(controller)} found the delay: with its band, and its error. {WIDE}"
    return f"Applied torques of {label(controller)}."


def _answer(question: str, answer: AnalysisResult) -> Section:
    pictures = [one for part in answer.document.sections for one in part.all(Picture)]
    return Section(question, Paragraph(sentence(answer.verdict), brief=True), *pictures)


def _details(question: str, answer: AnalysisResult) -> Section:
    """Return texts and tables of an analysis in one folded section."""
    parts = [
        f"{section.heading}. {block.text}" if isinstance(block, Paragraph) else block
        for section in answer.document.sections
        for block in section.blocks
        if not isinstance(block, Picture)
    ]
    return Section(f"Details: {question}", *parts, folded=True)
