"""Document and figure of the analysis of a network."""

import math
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, from_template
from stewart_drake.reporting.panels import Curve, Panel, Scale, draw
from stewart_drake.reporting.style import Line, line
from stewart_drake.studies.link import NEGLIGIBLE, LinkStudy
from stewart_drake.studies.statistics import CONFIDENCE

_ASSURED: Final = 0.9
"""Share of runs for which the verdict states the number of simulations."""
_RARE: Final = 2.0
"""Worst error with new seeds, relative to that with the first, from which these are too few."""


def document(study: LinkStudy) -> Document:
    best, checked, controller = study.best, study.checked, study.scenario.controller
    own = best is not None and all(one is None or one.completed == 1 for one in (best, checked))
    same = [f"{bound:g}" for bound, excess in study.alike.items() if excess < NEGLIGIBLE]
    undecided = {bound: excess for bound, excess in study.alike.items() if not excess < NEGLIGIBLE}
    short = len(study.bounds) - len(study.usable)
    unsure = ", ".join(f"{bound:g}" for bound in study.unconfirmed_losses)
    rare = best and checked and max(checked.errors, default=0) > _RARE * max(best.errors)
    return from_template(
        "link",
        "bad" if not own else "fair" if undecided or unsure or rare else "good",
        study=study,
        repeated=controller.packet_repeats * controller.period,
        spread=lambda cell: float(np.std(cell.errors, ddof=1)),
        same=", ".join(same),
        undecided=undecided,
        unsure=unsure,
        rare=rare,
        short_better=best and any(cell.mean < best.mean for cell in study.bounds[:short]),
        most=lambda cell: max(cell.errors, default=math.nan),
        assured=_ASSURED,
        wanted=math.ceil(math.log(1 - CONFIDENCE) / math.log(_ASSURED)),
        left_out=" and ".join(f"{bound:g} s" for bound in study.left_out),
        figure=partial(bound_figure, study),
    )


def bound_figure(study: LinkStudy) -> Figure:
    done = [cell for cell in study.bounds if cell.errors]
    bounds = [cell.bound for cell in done for _ in cell.errors]
    errors = [error for cell in done for error in cell.errors]
    dots = Line("#9AA3AD", "", 1.0, "o", markersize=3)
    means = Curve([cell.bound for cell in done], [cell.mean for cell in done], "mean E_ac", line(0))
    late = Curve([c.bound for c in study.bounds], [100 * c.late for c in study.bounds], "", line(1))
    marks = {} if study.best is None else {study.best.bound: "best bound"}
    how: Any = {"x": "bound  [s]", "marks": marks, "height": 2.5}
    runs = Curve(bounds, errors, "runs", dots)
    yscale: Scale = "log" if done else "linear"
    left = Panel("E_ac  [% s]", [runs, means], yscale=yscale, **how)
    return draw([left, Panel("late packets  [%]", [late], ylim=(0, 100), **how)], 2)
