"""Document of a search for a layout."""

from functools import partial
from typing import Final

import numpy as np

from stewart_drake.reporting.document import (
    Document,
    Picture,
    Section,
    Table,
    Tone,
    from_template,
    number,
)
from stewart_drake.reporting.mechanism import mechanism_figure
from stewart_drake.studies.layout import INSTANTS, Layout, LayoutStudy
from stewart_drake.studies.layout_space import MEASURES, PARAMETERS

_RUN: Final = {"completed": "completed", "refused": "does not reach the motion"}
_TONES: Final[dict[str, Tone]] = {"yes": "good", "partly": "fair"}


def document(study: LayoutStudy) -> Document:
    machines = [study.before, *study.layouts]
    goal = study.problem.requirements.goal
    found = from_template(
        "layout",
        _TONES.get(study.verdict.split(":")[0], "bad"),
        study=study,
        instants=INSTANTS,
        goal=MEASURES[goal].text,
        goal_name=goal,
        compared=_compared(study, machines),
        near=[one for one in machines if one.nearest is not None],
        missed=[one for one in machines if one.missed],
        numbers=_numbers(study, machines),
        searches=study.searches.items(),
        reached=lambda one: MEASURES[goal].factor * one.measures.get(goal, np.nan),
        shares=_shares,
    )
    for one in machines:
        figure = partial(mechanism_figure, one.mechanism)
        caption = f"{one.name} at home, from above and from the front."
        found.sections.append(Section(one.name, Picture(figure, caption, one.name)))
    return found


def _compared(study: LayoutStudy, machines: list[Layout]) -> Table:
    rows: list[tuple[str, ...]] = []
    for name, measure in MEASURES.items():
        unit = "" if measure.shown == "-" else f" [{measure.shown}]"
        limit = study.problem.requirements.limits.get(name)
        sign = "≥" if measure.more else "≤"
        asked = "" if limit is None else f"{sign} {limit * measure.factor:g}"
        found = (number(measure.factor * one.measures.get(name, np.nan)) for one in machines)
        rows.append((name.removesuffix("_deg") + unit, asked, *found))
    rows += [
        ("scenario", "", *map(_run, machines)),
        ("E_ac [% s]", "", *(number(one.outcome.error) for one in machines)),
        ("largest torque [N\u00a0m]", "", *(number(one.outcome.peak_torque) for one in machines)),
    ]
    return Table(("", "limit", *(one.name for one in machines)), rows, brief=True)


def _run(one: Layout) -> str:
    status, outcome = one.outcome.status, one.outcome
    if status in _RUN:
        return _RUN[status]
    return f"left at {outcome.time:.2f} s" if status == "left_workspace" else status


def _shares(shares: dict[str, float]) -> str:
    return ", ".join(f"{name} by {number(100 * share, 2)} %" for name, share in shares.items())


def _numbers(study: LayoutStudy, machines: list[Layout]) -> Table:
    rows: list[tuple[str, ...]] = []
    for k, name in enumerate(PARAMETERS):
        low, high = study.problem.space.bounds[name]
        centred = name == "plate_offset_deg" and study.problem.space.offset_from_centre
        between = f"{low:g} to {high:g}" + (" from centre" if centred else "")
        values = (f"{one.values[k]:.4g}" for one in machines)
        rows.append((name, between if low < high else "kept", *values))
    signs = ("".join("-+"[int(b > 0)] for b in one.mechanism.branches) for one in machines)
    orders = ("".join(map(str, one.order)) for one in machines)
    rows += [("branches", "", *signs), ("plate_order", "", *orders)]
    return Table(("", "between", *(one.name for one in machines)), rows)
