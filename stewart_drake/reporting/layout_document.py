"""What is told of a search for a layout."""

from functools import partial
from typing import Final

import numpy as np

from stewart_drake.reporting.document import Block, Document, Picture, Section, Table, Tone, Values
from stewart_drake.reporting.mechanism_figures import mechanism_figure
from stewart_drake.reporting.words import number
from stewart_drake.studies.layout import INSTANTS, Layout, LayoutStudy
from stewart_drake.studies.layout_measures import MEASURES
from stewart_drake.studies.layout_space import PARAMETERS

_RUN: Final = {"completed": "completed", "refused": "does not reach the motion"}


def document(study: LayoutStudy) -> Document:
    """What was found beside the machine that the search began from."""
    machines = [study.before, *study.layouts]
    sections = [_compared(study, machines), _numbers(study, machines), _asked(study)]
    sections += [_drawn(one) for one in machines]
    scenario = study.problem.scenario
    return Document(
        f"Layouts for a {scenario.reference.kind} motion, from {study.before.name}",
        study.verdict,
        sections,
        _tone(study),
        {
            "layouts tried": str(study.evaluations),
            "goal": MEASURES[study.problem.wish.goal].text,
            "seed": str(study.seed),
        },
    )


def _tone(study: LayoutStudy) -> Tone:
    opening = study.verdict.split(":")[0]
    tones: dict[str, Tone] = {"yes": "good", "partly": "fair"}
    return tones.get(opening, "bad")


def _compared(study: LayoutStudy, machines: list[Layout]) -> Section:
    rows: list[tuple[str, ...]] = []
    for name, measure in MEASURES.items():
        cells = [
            number(measure.factor * one.measures[name]) if name in one.measures else "-"
            for one in machines
        ]
        unit = "" if measure.shown == "-" else f" [{measure.shown}]"
        limit = study.problem.wish.limits.get(name)
        asked = (
            "" if limit is None else f"{'≥' if measure.more else '≤'} {limit * measure.factor:g}"
        )
        rows.append((name.removesuffix("_deg") + unit, asked, *cells))
    rows += [
        ("scenario", "", *(_run(one) for one in machines)),
        ("E_ac [% s]", "", *(number(one.outcome.error) for one in machines)),
        ("largest torque [N\u00a0m]", "", *(number(one.outcome.peak_torque) for one in machines)),
    ]
    columns = ("", "limit", *(one.name for one in machines))
    caption = "Worst over the motion and home; the last three rows are of a simulation of it."
    parts: list[Block | str] = [Table(columns, rows, caption, brief=True)]
    near = {
        one.name: f"{one.nearest.pair}, {number(1e3 * one.nearest.distance)} mm at "
        f"t = {one.nearest.time:.2f} s" + (", they cross" if one.nearest.distance < 0 else "")
        for one in machines
        if one.nearest is not None
    }
    if near:
        parts += ["The two links that come nearest to each other:", Values(near)]
    missed = {
        one.name: ", ".join(f"{name} by {100 * share:.2g} %" for name, share in one.missed.items())
        for one in machines
        if one.missed
    }
    if missed:
        parts += ["Limits that are missed, by which share of them:", Values(missed, brief=False)]
    return Section("Compared", *parts)


def _run(one: Layout) -> str:
    status, outcome = one.outcome.status, one.outcome
    if status in _RUN:
        return _RUN[status]
    return f"left at {outcome.time:.2f} s" if status == "left_workspace" else status


def _numbers(study: LayoutStudy, machines: list[Layout]) -> Section:
    bounds = study.problem.space.bounds
    rows = []
    for k, name in enumerate(PARAMETERS):
        low, high = bounds[name]
        centred = name == "plate_offset_deg" and study.problem.space.offset_from_centre
        told = f"{low:g} to {high:g}" + (" from centre" if centred else "")
        between = told if low < high else "kept"
        rows.append((name, between, *(f"{one.values[k]:.4g}" for one in machines)))
    signs = (["".join("+" if b > 0 else "-" for b in one.mechanism.branches)] for one in machines)
    rows.append(("branches", "", *(sign for (sign,) in signs)))
    rows.append(("plate_order", "", *("".join(map(str, one.order)) for one in machines)))
    columns = ("", "between", *(one.name for one in machines))
    caption = "Lengths in m; of crank and rod the mean."
    text = (
        "Numbers of a mechanism file's pattern, and the lengths of cranks and rods. A link's mass "
        "grows with its length, its moments of inertia with the cube of that; the plate keeps its "
        "mass."
    )
    return Section("The machines", text, Table(columns, rows, caption))


def _asked(study: LayoutStudy) -> Section:
    problem = study.problem
    rows = []
    for key, found in study.searches.items():
        goal = found.measures.get(problem.wish.goal, np.nan)
        missed = ", ".join(f"{name} by {100 * s:.2g} %" for name, s in found.missed.items())
        value = number(MEASURES[problem.wish.goal].factor * goal)
        rows.append((key, str(found.evaluations), value, missed or "kept"))
    text = (
        f"One search per arrangement of the legs and start, by differential evolution, at most "
        f"{study.generations} generations, seed {study.seed}; a layout is looked at in home and at "
        f"{INSTANTS} instants of the motion, with links in capsules, which come nearer to each "
        "other than the links do. What was found is measured again at all instants that a scenario "
        "is checked at, with Drake's distances between the shapes."
    )
    columns = ("search", "layouts", problem.wish.goal, "limits missed")
    return Section("The searches", text, Table(columns, rows), folded=True)


def _drawn(one: Layout) -> Section:
    figure = partial(mechanism_figure, one.mechanism)
    return Section(one.name, Picture(figure, f"{one.name} at home, from above and from the front."))
