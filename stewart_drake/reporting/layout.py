"""Document of a search for a layout."""

from collections.abc import Callable, Sequence
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
        found.sections.append(Section(one.name, Picture(figure, caption)))
    return found


def _by_machine(
    head: str,
    rows: Sequence[tuple[str, str, Callable[[Layout], str]]],
    machines: Sequence[Layout],
    brief: bool = False,
) -> Table:
    """Return a table with a column per machine; a row has a name, a text, and a function."""
    cells = [(name, text, *map(cell, machines)) for name, text, cell in rows]
    return Table(("", head, *(one.name for one in machines)), cells, brief=brief)


def _compared(study: LayoutStudy, machines: list[Layout]) -> Table:
    def measured(name: str, one: Layout) -> str:
        return number(MEASURES[name].factor * one.measures.get(name, np.nan))

    rows: list[tuple[str, str, Callable[[Layout], str]]] = []
    for name, measure in MEASURES.items():
        unit = "" if measure.shown == "-" else f" [{measure.shown}]"
        limit = study.problem.requirements.limits.get(name)
        sign = "≥" if measure.more else "≤"
        asked = "" if limit is None else f"{sign} {limit * measure.factor:g}"
        rows.append((name.removesuffix("_deg") + unit, asked, partial(measured, name)))
    rows += [
        ("scenario", "", _run),
        ("E_ac [% s]", "", lambda one: number(one.outcome.error)),
        ("largest torque [N\u00a0m]", "", lambda one: number(one.outcome.peak_torque)),
    ]
    return _by_machine("limit", rows, machines, brief=True)


def _run(one: Layout) -> str:
    status, outcome = one.outcome.status, one.outcome
    if status in _RUN:
        return _RUN[status]
    return f"left at {outcome.time:.2f} s" if status == "left_workspace" else status


def _shares(shares: dict[str, float]) -> str:
    return ", ".join(f"{name} by {number(100 * share, 2)} %" for name, share in shares.items())


def _numbers(study: LayoutStudy, machines: list[Layout]) -> Table:
    def value(k: int, one: Layout) -> str:
        return f"{one.values[k]:.4g}"

    rows: list[tuple[str, str, Callable[[Layout], str]]] = []
    for k, name in enumerate(PARAMETERS):
        low, high = study.problem.space.bounds[name]
        centred = name == "plate_offset_deg" and study.problem.space.offset_from_centre
        between = f"{low:g} to {high:g}" + (" from centre" if centred else "")
        rows.append((name, between if low < high else "kept", partial(value, k)))
    signs = ("branches", "", lambda one: "".join("-+"[int(b > 0)] for b in one.mechanism.branches))
    order = ("plate_order", "", lambda one: "".join(map(str, one.order)))
    return _by_machine("between", [*rows, signs, order], machines)
