"""The report on a scenario, and the first one on a new machine.

That on a scenario shows its own run, the shipped controllers in the manner of the paper's Table II
and figures 5, 6 and 7, the analyses, and the scenario itself.
"""

import math
import pickle
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.resources import shipped
from stewart_drake.loop.preparation import prepare_unchecked, simulated_machine
from stewart_drake.loop.results import (
    SimulationResult,
    accumulated_error,
    peak_error,
    second_half,
)
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.reporting.analyses import analyze, options_of
from stewart_drake.reporting.document import (
    Block,
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
    draw_comparison,
    draw_run,
    has,
    weights_figure,
)
from stewart_drake.reporting.mechanism import document as describe
from stewart_drake.reporting.mechanism import mechanism_figure
from stewart_drake.reporting.page import Provenance
from stewart_drake.reporting.replay import replay_html
from stewart_drake.reporting.results import AnalysisResult
from stewart_drake.reporting.run import (
    comparison_document,
    late_error,
    moving,
    run_document,
    torqueless,
    worst,
)
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import link_text, number_sent
from stewart_drake.scenario.loading import load_compatible, scenario_yaml, setting_texts
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies import compare
from stewart_drake.studies.compare import LABELS, is_papers, label
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.studies.new_machine import NewMachine
from stewart_drake.studies.verdict import fold
from stewart_drake.tuner.network import DEFAULT
from stewart_drake.types import Array

ANALYSES: Final = ("delay", "hautus", "workspace")
AS_GIVEN: Final = "as_given"
_OWN: Final = ""
"""Key of the scenario's own run; no row of a comparison has this name."""
_WEIGHTED: Final = ("delay_lqr", "delay_lqi", "predictor_lqi")
"""Controllers that the report also runs with a network's weights."""
_TUNED: Final = "tuned-"
GOOD: Final = 5.0
POOR: Final = 25.0
"""Mean error in % of peak to peak up to which a run is good, and not bad."""
FEW_BAD: Final = 0.01
MANY_BAD: Final = 0.5
"""Bad measurements per sample up to which a run is good, and not bad."""

_LEVELS: Final[tuple[Tone, ...]] = ("good", "fair", "bad")
_QUESTIONS: Final = {
    "delay": "Is the loop stable with its delay?",
    "hautus": "Can the models be controlled and observed?",
    "workspace": "Does the motion fit the machine?",
}
WIDE: Final = "The stated deviation is 1.0 to 1.4 times too large."
_CAPTIONS: Final = {
    "states": "The plate's six coordinates.",
    "errors": "Their errors. Below: their mean in % of peak to peak, whose integral is E_ac.",
    "torques": "Torques as commanded, and as applied: within the motors' limit, after the delay; "
    "of servos their own.",
    "torques_delay_lqr": "Applied torques of the delay-aware LQR, without integral action.",
    "torques_delay_lqi": "Applied torques of the delay-aware LQI, with integral action.",
    "torques_predictor_lqi": "Applied torques of the LQI with nonlinear prediction.",
    "delay": f"Estimated delay with its band, and its error. {WIDE}",
    "parameters": "Plant parameters as estimated. Axes fit the second half of the run.",
    "weights": "Weights that the tuner sets online.",
}
_PAPER_FIGURES: Final = {
    "states": "5(a)",
    "errors": "5(b)",
    "torques_delay_lqr": "7(a)",
    "torques_delay_lqi": "7(b)",
    "weights": "6",
}
"""Figures of the paper with the same content, for its experiment."""
_PACKETS_BELOW: Final = (
    " Below: packets sent, lost or late, and periods with a packet to play or without one (dry)."
)


@dataclass(frozen=True)
class ReportData:
    scenario: Scenario
    failure: Failure | None  # where the reference leaves the workspace; None with runs
    scale: Array  # (6,) peak to peak of the reference, 1 where it is constant
    run: SimulationResult | None = None  # of the scenario; None with a `failure`
    # runs of the shipped controllers, by name
    comparison: dict[str, SimulationResult] = field(default_factory=dict)
    # runs of the delay-aware controllers with the tuner's weights; none without a network
    tuned: dict[str, SimulationResult] = field(default_factory=dict)
    # results without their studies, by name in the order of ANALYSES
    analyses: dict[str, AnalysisResult] = field(default_factory=dict)


def collect(
    scenario_name: Scenario | str | Path,
    settings: Iterable[str] = (),
    progress: Progress | None = None,
    controller: str | Path | None = None,
) -> ReportData:
    """Run and analyse a scenario on all cores. A reference out of reach is analysed only.

    The arguments are those of `sd.report`; `progress` is called for every finished run or analysis.

    Raises:
        ConfigError: bad input.
        ChildProcessError: a worker process died.
        KeyboardInterrupt: Ctrl-C.
    """
    settings = setting_texts(settings)
    scenario = load_compatible(scenario_name, controller, settings)
    experiment = prepare_unchecked(scenario)
    failure = experiment.reference_failure()
    scenarios: dict[str, Scenario] = {}
    rows: set[str] = set()
    if failure is None:
        scenarios = compare.shown(scenario_name, settings)
        rows = set(scenarios)
        if scenario not in scenarios.values():
            scenarios[_OWN] = scenario
            if scenario.actuator.kind == "position_servo":  # its rows are few, so this one, too
                scenarios = {AS_GIVEN: scenarios.pop(_OWN), **scenarios}
                rows.add(AS_GIVEN)
        if has_network(scenario):
            tuned = (*settings, "tuner.kind=ann")
            for name in _WEIGHTED:
                scenarios[_TUNED + name] = load_compatible(scenario_name, name, tuned)
    done, analyses = _work(scenario, scenarios, progress)
    return ReportData(
        scenario=scenario,
        failure=failure,
        scale=experiment.scale,
        run=next((done[key] for key, sc in scenarios.items() if sc == scenario), None),
        comparison={name: done[name] for name in scenarios if name in rows},
        tuned={name: done[_TUNED + name] for name in _WEIGHTED if _TUNED + name in done},
        analyses=analyses,
    )


def has_network(scenario: Scenario) -> bool:
    """Return whether the report adds runs with a network's weights."""
    servos = scenario.actuator.kind == "position_servo"
    return scenario.tuner.kind != "ann" and not servos and DEFAULT in shipped("weights")


def _work(
    scenario: Scenario, scenarios: dict[str, Scenario], progress: Progress | None
) -> tuple[dict[str, SimulationResult], dict[str, AnalysisResult]]:
    """Return the runs by the names of the scenarios, and the analyses by theirs."""
    # The analyses come first because they take longest.
    jobs: dict[str, Job] = {name: (name, scenario) for name in ANALYSES}
    jobs |= {f"run{i}": ("simulate", sc) for i, sc in enumerate(scenarios.values())}
    with TemporaryDirectory() as folder:
        paths = run_jobs(jobs, _job, folder, settings={}, suffix=".pickle", progress=progress)
        found: list[Any] = [pickle.loads(path.read_bytes()) for path in paths.values()]
    analyses, runs = found[: len(ANALYSES)], found[len(ANALYSES) :]
    return dict(zip(scenarios, runs, strict=True)), dict(zip(ANALYSES, analyses, strict=True))


def _job(what: str, scenario: Scenario) -> bytes:
    return pickle.dumps(simulate(scenario) if what == "simulate" else _analyse(what, scenario))


def _analyse(name: str, scenario: Scenario) -> AnalysisResult:
    options = options_of(name)(**({"simulations": False} if name == "delay" else {}))
    found = analyze(name, scenario, options, command=f"stewart-drake analyze {name}")
    return replace(found, study=None)  # a study cannot be pickled


# ---------------------------------------------------------------- the document


def film(found: ReportData, name: str) -> str:
    """Return the page of the replay of the scenario's run; empty without a run."""
    if found.run is None:
        return ""
    return replay_html(found.run, simulated_machine(found.scenario), name)


def result(found: ReportData, name: str, replay: str, made: Provenance) -> AnalysisResult:
    """Return the report with all that a page and summary.json have."""
    return AnalysisResult(found, report_summary(found), document(found, name, replay), made)


def document(found: ReportData, name: str, replay: str = "") -> Document:
    """Return the report on a scenario of this name, with the page of its replay, if any, inside."""
    text, tone = verdict(found)
    compared = draw_comparison(found.comparison)
    if found.tuned:
        compared["weights"] = weights_figure({LABELS[n]: run for n, run in found.tuned.items()})
    own = found.run and _blocks(run_document(found.run))
    said = found.run.summary["warnings"] if found.run else ()
    if found.run and own:
        below = _PACKETS_BELOW if has(found.run, "packets") else ""
        for what, figure in draw_run(found.run).items():
            own.append(Picture(figure, _CAPTIONS[what] + below * (what == "torques"), what))
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
        run=own,
        comparison=found.comparison
        and _blocks(comparison_document(found.comparison, found.tuned, said, found.run)),
        papers=is_papers(found.scenario),
        no_weights="weights" not in compared,
        compared=[
            Picture(figure, _caption(what, is_papers(found.scenario)), f"compared_{what}")
            for what, figure in compared.items()
        ],
    )
    answers = {_QUESTIONS[key]: found.analyses[key].document for key in ANALYSES}
    for question, answer in answers.items():
        conclusion = Paragraph(sentence(answer.verdict), brief=True)
        made.sections.append(Section(question, conclusion, *answer.all(Picture)))
    for question, answer in answers.items():
        details = [
            f"{section.heading}. {block.text}" if isinstance(block, Paragraph) else block
            for section in answer.sections
            for block in section.blocks
            if not isinstance(block, Picture)
        ]
        made.sections.append(Section(f"Details: {question}", *details, folded=True))
    above = "Every field, in the format of a scenario file; saved as one, it runs again."
    listing = Listing(scenario_yaml(found.scenario))
    made.sections.append(Section("The scenario", above, listing, folded=True))
    return made


def _blocks(document: Document) -> list[Block]:
    return [block for section in document.sections for block in section.blocks]


def _caption(figure: str, of_paper: bool) -> str:
    what, _, controller = figure.partition("_")
    caption = _CAPTIONS.get(figure)
    if caption is None and what == "delay":
        caption = f"Delay estimated by {label(controller)}, with its band, and its error. {WIDE}"
    caption = caption or f"Applied torques of {label(controller)}."
    if of_paper and figure in _PAPER_FIGURES:
        caption = (
            f"As figure {_PAPER_FIGURES[figure]} of the paper: {caption[0].lower()}{caption[1:]}"
        )
    return caption


def report_summary(found: ReportData) -> dict[str, Any]:
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


def verdict(found: ReportData) -> tuple[str, Tone]:
    """Return the conclusion in a few sentences, and the level of the worst finding."""
    if found.run is None:
        return sentence(found.analyses["workspace"].verdict), "bad"
    run, s = found.run, found.run.summary
    if run.stopped is not None:
        text = (
            f"The run ended after {run.stopped.time:.2f} of {run.scenario.duration:g} s: "
            f"{run.stopped.reason}."
        )
        runs = found.comparison.items()
        done = {key: one.accumulated_error for key, one in runs if one.status == "completed"}
        if done:
            best = min(done, key=lambda name: done[name])
            text += f" {label(best)} completes it, with an E_ac of {number(done[best])} % s."
        return text, "bad"
    findings, duration = _findings(run), f"all of {run.scenario.duration:g} s"
    clearance = found.analyses["workspace"].summary.get("clearance", {})
    if clearance.get("touching"):
        findings.append(("fair", clearance["verdict"]))
    bad, fair = (
        "; ".join(text for level, text in findings if level == tone) for tone in ("bad", "fair")
    )
    if torqueless(run):
        return f"Not reliable: {bad}.", "bad"
    text = f"The plate follows its reference for {duration}: E_ac is "
    if bad:
        text = f"Not reliable: {bad}. The run completed {duration}: E_ac is "
    if run.scenario.actuator.kind == "position_servo" and (late := late_error(run)):
        text = text.replace(": E_ac", f": rms error {late}. With the start E_ac")
    error, floor = number(round(s["accumulated_error"], 9)), s["delay_floor"]
    average = f"{number(round(mean_error(run), 9), 2)} % {_averaged(run)}"
    if floor > 0:
        text += (
            f"{error} % s, {number(floor)} % s of it before any torque can act"
            f"{_second_half(run, found.scale)}. Once torques act the error averages {average}."
        )
    else:
        text += f"{error} % s; the error averages {average}."
    largest = worst(run).replace("%", "% of its motion")
    text += f" Largest error: {largest}{_worst_later(run, found.scale)}."
    if fair:
        text += f" Caution: {fair}."
    return text, max((level for level, _ in findings), key=_LEVELS.index, default="good")


def _findings(run: SimulationResult) -> list[tuple[Tone, str]]:
    """Return the weaknesses of a completed run, each with its level."""
    s, found, mean = run.summary, list[tuple[Tone, str]](), mean_error(run)
    margin, counts = s["controller_margin"], s["counts"]
    if margin is not None and margin["stable"] is False:
        growth = f"errors grow {fold(margin['spectral_radius'])} per period"
        found.append(("bad", f"the loop is unstable, {growth}"))
    samples = number_sent(run.scenario.duration, run.scenario.controller.period)
    wrong = counts["bad_measurements"]
    if wrong > FEW_BAD * samples:
        text = f"{wrong} of {samples} samples without a new and usable measurement"
        found.append(("bad" if wrong > MANY_BAD * samples else "fair", text))
    failed = sum(counts[name] for name in ("riccati_failures", "unreachable", "nonfinite_torque"))
    if torqueless(run):
        found.append(("bad", "the controller never had a finite torque"))
    elif failed:
        found.append(("fair", f"{failed} of {samples} samples without a new gain or torque"))
    if not mean <= GOOD:  # or NaN
        text = f"a mean error of {number(mean, 2)} % of peak to peak"
        found.append(("bad" if mean > POOR else "fair", text))
    if s["warnings"]:
        found.append(("fair", "see the warnings below"))
    return found


def _averaged(run: SimulationResult) -> str:
    """Return the unit and the coordinates of `mean_error`."""
    moved = moving(run)
    if not moved.any():
        return "of 1 rad and 1 m, as no coordinate moves"
    names = ", ".join(np.array(COORDINATE_NAMES)[moved])
    return "of peak to peak" + ("" if moved.all() else f" over moving coordinates ({names})")


def _second_half(run: SimulationResult, scale: Array) -> str:
    """Return the parts of E_ac until half of the run and after it, if torques act by then."""
    s, half = run.summary, run.scenario.duration / 2
    if half <= run.scenario.eta:
        return ""
    late = run.signals.sel(time=slice(half, None))
    after = accumulated_error(late.time.values, late.error.values, scale)
    between = s["accumulated_error"] - s["delay_floor"] - after
    return f", {number(between)} % s until half of the run, and {number(after)} % s after it"


def _worst_later(run: SimulationResult, scale: Array) -> str:
    """Return the largest error of the second half, if one in the first was twice that or more."""
    errors = run.signals.error.values
    half = second_half(run.signals.reference.values)
    later = peak_error(errors[half], scale)
    if not max(run.summary["peak_error"]) > 2 * later.max():
        return ""
    return f" in the first half, {worst(run, later.tolist(), half)} in the second"


def mean_error(run: SimulationResult) -> float:
    """Return the mean error of the moving coordinates once torques can act, % of peak to peak.

    The mean is over all six if none moves, and NaN if the run ended early.
    """
    s, sc, moved = run.summary, run.scenario, moving(run)
    left = sc.duration - (sc.eta if s["delay_floor"] else 0.0)
    whole, signals = 6 * (s["accumulated_error"] - s["delay_floor"]), run.signals
    if moved.any():  # E_ac has the others in % of 1 rad and 1 m
        still = 100 * np.abs(signals.error.values[:, ~moved])
        whole -= float(np.trapezoid(still, signals.time.values, axis=0).sum())
    return whole / ((moved.sum() or 6) * left) if left > 0 else math.nan


def first_report(made: NewMachine, result: SimulationResult, findings: Iterable[str]) -> Document:
    """Return the first report on a new machine: its drawing, its check, and its first run.

    `findings` are sentences about the motors, the loop and its delay.
    """
    check, completed = made.check, result.status == "completed"
    good: Tone = "fair" if made.crossings else "good"
    drawing = Picture(
        lambda: mechanism_figure(check.mechanism), "The machine at its home pose.", "machine"
    )
    figures = [Picture(figure, _CAPTIONS[name], name) for name, figure in draw_run(result).items()]
    motion = (
        "Up and down, once in two seconds. A log of this motion shows friction and payload, but "
        "hardly the lengths: stewart-drake identify --plan finds a better one."
    )
    return Document(
        f"First report on {check.mechanism.name}",
        " ".join(sentence(text) for text in (check.verdict, *made.crossings, *findings)),
        [
            Section("The machine", drawing, *_blocks(describe(check))),
            Section("A first run", Paragraph(motion), *_blocks(run_document(result)), *figures),
        ],
        good if completed else "bad",
    )
