"""The report on a scenario: one page that can be shown to somebody else.

How its own run went, the shipped controllers in the manner of the paper's Table II and figures 5, 6
and 7, what the analyses say beforehand, and the scenario itself.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from stewart_drake.loop.results import SimulationResult
from stewart_drake.report.collect import ANALYSES, Analysis, Collected
from stewart_drake.report.figures import draw_comparison, draw_run
from stewart_drake.report.page import Page, Picture, Provenance, Section, Table, Tone
from stewart_drake.report.tables import loops_sentence, number, paper_error, shared_warnings
from stewart_drake.report.tuner_figures import weights_figure
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.compare import LABELS, is_papers

GOOD: Final = 5.0
"""% of peak to peak: a mean error up to here, once torques can act, is called good."""

_QUESTIONS: Final = {
    "delay": "Does the loop bear its delay?",
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
    "delay": "The delay as it was found, with its band, and its error.",
    "parameters": "What the controller found out about the plant, which nobody told it.",
    "weights": "The weights that the tuner set.",
}
_COLUMNS: Final = (
    "controller",
    "paper [%\u00a0s]",  # a head is broken before its unit only
    "E_ac [%\u00a0s]",
    "floor [%\u00a0s]",
    "outcome",
    "cost",
    "commanded peak [N\u00a0m]",
    "applied peak [N\u00a0m]",
    "rms [N\u00a0m]",
    "var. [N\u00a0m]",
    "step [ms]",
)
_ERROR_IS: Final = (
    "E_ac is the error in percent of the motion's peak to peak, averaged over the six coordinates "
    "and accumulated over time."
)
_NO_NETWORK: Final = (
    "There is no network for the tuner here, so that its weights are not shown; stewart-drake "
    "tune makes one."
)


def report_page(found: Collected, name: str, made: Provenance, replay: str = "") -> Page:
    """The report as a page.

    Args:
        found: what it is about.
        name: of the scenario.
        made: how.
        replay: the replay's page, to be shown inside, or empty.
    """
    text, tone = verdict(found)
    sections = list(_run_sections(found, replay))
    if found.comparison:
        sections.append(_comparison(found))
    for key in ANALYSES:
        sections.append(_answer(_QUESTIONS[key], found.analyses[key]))
    sections += [_details(_QUESTIONS[key], found.analyses[key]) for key in ANALYSES]
    sections.append(
        Section(
            "The scenario",
            ("Every field, in the format of a scenario file: saved as one it runs again.",),
            folded=True,
            listing=scenario_yaml(found.scenario),
        )
    )
    facts = _facts(found.scenario)
    return Page(f"Report on the scenario {name}", text, sections, made, tone, facts)


def report_summary(found: Collected) -> dict[str, Any]:
    """What summary.json holds; each part as the command of its own writes it."""
    text, tone = verdict(found)
    return {
        "verdict": text,
        "tone": tone,
        "failure": None if found.failure is None else found.failure._asdict(),
        "run": None if found.run is None else found.run.summary,
        "controllers": {name: run.summary for name, run in found.comparison.items()},
        "tuned": {name: run.summary for name, run in found.tuned.items()},
        "analyses": {
            name: {"verdict": a.verdict, "tone": a.tone, **a.summary}
            for name, a in found.analyses.items()
        },
    }


def verdict(found: Collected) -> tuple[str, Tone]:
    """How the scenario went in a few sentences, and how good that is."""
    if found.run is None:
        return sentence(found.analyses["workspace"].verdict), "bad"
    run, s = found.run, found.run.summary
    if run.stopped is not None:
        return (
            f"The run ended after {run.stopped.time:.2f} of {run.scenario.duration:g} s: "
            f"{run.stopped.reason}.",
            "bad",
        )
    error, floor, mean = s["accumulated_error"], s["delay_floor"], mean_error(run)
    text = f"The plate follows its reference for all of {run.scenario.duration:g} s: E_ac is "
    average = f"{number(mean, 2)} % of peak to peak on average"
    if floor > 0:
        text += (
            f"{number(error)} % s, of which {number(floor)} pass before any torque can act. The "
            f"rest is {average}."
        )
    else:
        text += f"{number(error)} % s, {average}."
    return text, "good" if mean <= GOOD else "fair"


def mean_error(run: SimulationResult) -> float:
    """% of peak to peak, over the time in which torques can act; NaN if the run ended early."""
    s, sc = run.summary, run.scenario
    blind = sc.eta if s["delay_floor"] else 0.0
    left = sc.duration - blind
    return float((s["accumulated_error"] - s["delay_floor"]) / left) if left > 0 else np.nan


def comparison_rows(found: Collected) -> list[tuple[str, ...]]:
    """A row per controller, the tuner's after those with fixed weights."""
    runs = [(LABELS[name], name, run) for name, run in found.comparison.items()]
    runs += [(f"{LABELS[name]}, tuned", name, run) for name, run in found.tuned.items()]
    papers = is_papers(found.scenario)
    return [_row(label, name, run, papers) for label, name, run in runs]


def _run_sections(found: Collected, replay: str) -> Iterator[Section]:
    if found.run is None:
        text = "The reference leaves the workspace, so that nothing was simulated."
        yield Section("The run", (text,))
        return
    s = found.run.summary
    entries = [
        ("E_ac", f"{number(s['accumulated_error'])} % s"),
        ("floor, from the delay alone", f"{number(s['delay_floor'])} % s"),
        *(
            (f"peak error, {name}", f"{number(value)} % of peak to peak")
            for name, value in zip(COORDINATE_NAMES, s["peak_error"], strict=True)
        ),
        ("commanded torque, peak", f"{number(s['peak_torque'])} N m"),
        ("commanded torque, rms", f"{number(s['rms_torque'])} N m"),
        ("applied torque, peak", f"{number(s['peak_torque_applied'])} N m"),
        ("controller step, median", f"{number(s['controller_step_ms']['median'])} ms"),
    ]
    if replay:
        text = "Drag to look around. The ring is where the plate should be."
        yield Section("Replay", (text,), frame=replay)
    warnings = [f"Warning: {sentence(text)}" for text in s["warnings"]]
    pictures = _pictures(draw_run(found.run), _RUN_CAPTIONS)
    yield Section("The run", (_ERROR_IS, *warnings), [Table(("", "value"), entries)], pictures)


def _comparison(found: Collected) -> Section:
    papers, captions = is_papers(found.scenario), dict(_CAPTIONS)
    text = [
        "The same scenario under each of the shipped controllers. The floor is what the delay "
        "alone adds to E_ac; the cost sums squared errors and torques, weighted by w_Q and w_R; "
        "rms and total variation (var.), which tells trembling, are of the commanded torques. "
        "Applied, as in the figures, is what is left of them within the motors' limit and after "
        "the delay: of a run that ends early the last ones never acted.",
    ]
    text.append(sentence(loops_sentence(found.comparison)))
    text += [f"Warning: {sentence(text)}" for text in shared_warnings(found.comparison)]
    if papers:
        text.append(
            "The paper's numbers are those of its Table II; its delay-aware controllers had the "
            "tuner."
        )
        for name, figure in _PAPER_FIGURES.items():
            text_below = captions[name][:1].lower() + captions[name][1:]
            captions[name] = f"As figure {figure} of the paper: {text_below}"
    figures = draw_comparison(found.comparison)
    if found.tuned:
        figures["weights"] = weights_figure({LABELS[n]: run for n, run in found.tuned.items()})
    elif "weights" not in figures:
        text.append(_NO_NETWORK)
    order = [name for name in _CAPTIONS if name in figures]
    pictures = _pictures({name: figures[name] for name in order}, captions)
    caption = "Table II of the paper, and what comes out here" if papers else ""
    columns = _COLUMNS if papers else (_COLUMNS[0], *_COLUMNS[2:])
    table = Table(columns, comparison_rows(found), caption)
    return Section("The controllers compared", text, [table], pictures)


def _row(label: str, name: str, run: SimulationResult, papers: bool) -> tuple[str, ...]:
    s = run.summary
    outcome = run.status.replace("_", " ")
    if run.stopped is not None:
        leg = "" if run.stopped.leg is None else f", leg {run.stopped.leg}"
        outcome += f" at {run.stopped.time:.2f} s{leg}"
    names = ("peak_torque", "peak_torque_applied", "rms_torque", "torque_variation")
    return (
        label,
        *([paper_error(name)] if papers else []),
        number(s["accumulated_error"]),
        number(s["delay_floor"]),
        outcome,
        number(s["cost"]),
        *(number(s[name], 2) for name in names),
        number(s["controller_step_ms"]["median"], 2),
    )


def _answer(question: str, analysis: Analysis) -> Section:
    pictures = [picture for section in analysis.page.sections for picture in section.pictures]
    return Section(question, (sentence(analysis.verdict),), pictures=pictures)


def _details(question: str, analysis: Analysis) -> Section:
    """What the analysis' own page says and tabulates, in one folded section."""
    parts = analysis.page.sections
    text = [f"{part.heading}. {paragraph}" for part in parts for paragraph in part.text]
    tables = [table for part in parts for table in part.tables]
    return Section(f"Details: {question}", text, tables, folded=True)


def _pictures(figures: Mapping[str, Any], captions: Mapping[str, str]) -> list[Picture]:
    return [Picture(figure, captions[name]) for name, figure in figures.items()]


def _facts(scenario: Scenario) -> dict[str, str]:
    c, plant = scenario.controller, scenario.plant
    return {
        "mechanism": Path(scenario.mechanism).stem,
        "reference": f"{scenario.reference.kind}, {scenario.duration:g} s",
        "delay": f"{scenario.eta:.4g} s, {scenario.true_delay.periods:g} periods of {c.period:g} s",
        "plant": f"{plant.kind}, {'with' if plant.gravity else 'without'} gravity",
        "controller": f"{c.prediction} prediction, feedforward {c.feedforward}, "
        f"estimator {c.estimator}".replace("_", " "),
        "start": f"{scenario.start.replace('_', ' ')}, torques in flight: {scenario.queue}",
    }


def sentence(text: str) -> str:
    """With a capital letter and a full stop."""
    return text[:1].upper() + text[1:].removesuffix(".") + "."
