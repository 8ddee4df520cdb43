"""Document and figure of the analysis of a network."""

import math
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Tone, table
from stewart_drake.reporting.outline import sections
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import Line, line
from stewart_drake.reporting.words import number
from stewart_drake.studies.link_bound import Cell, LinkStudy
from stewart_drake.studies.statistics import CONFIDENCE

_ASSURED: Final = 0.9
"""Share of runs for which the verdict says how many have to be simulated."""


def _mean(cell: Cell) -> float:
    return float(np.mean(cell.errors)) if cell.errors else math.nan


_COLUMNS: Final = {
    "bound [s]": lambda cell: f"{cell.bound:.3g}",
    "lost": lambda cell: f"{100 * cell.loss:.3g} %",
    "late": lambda cell: f"{100 * cell.late:.3g} %",
    "missing": lambda cell: f"{100 * cell.missing:.3g} %",
    "completed": lambda cell: f"{len(cell.errors)} of {cell.runs}",
    "E_ac [% s]": _mean,
    "worst [% s]": lambda cell: max(cell.errors, default=math.nan),
    "no worse": lambda cell: f">= {100 * cell.no_worse:.0f} %" if cell.runs else "-",
}


def document(study: LinkStudy) -> Document:
    """Return bounds, then losses at the best of them."""
    verdict, tone = _verdict(study)
    parts = sections(
        "link",
        study=study,
        left_out=" and ".join(f"{bound:g} s" for bound in study.left_out),
        bounds=table(study.bounds, _COLUMNS, brief=True),
        losses=study.losses and table(study.losses, _COLUMNS, brief=True),
        figure=partial(bound_figure, study),
    )
    facts = {"play-out without a bound given": f"{study.usual:.3g} s"}
    return Document("Which play-out bound suits this network?", verdict, parts, tone, facts)


def _verdict(study: LinkStudy) -> tuple[str, Tone]:
    best = study.best
    if best is None:
        return "No run completed, at any bound.", "bad"
    late = f"{100 * best.late:.3g} % of the packets are late"
    text = (
        f"A bound of {best.bound:.3g} s is the best of those tried: E_ac is {number(_mean(best))} "
        f"% s, {late}. Default play-out bound for this scenario: {study.usual:.3g} s."
    )
    if study.losses:
        survived = study.survivable
        text += (
            " At the best bound no loss is survived in every run."
            if math.isnan(survived)
            else f" At the best bound every run completed up to a loss of {100 * survived:.3g} %."
        )
    checked = study.checked
    if checked is not None and checked.runs:
        text += f" {_assured(checked)}"
    own = best.completed == 1 and (checked is None or checked.completed == 1)
    return text, "good" if own else "bad"


def _assured(cell: Cell) -> str:
    """Return what new seeds at the best bound say of all runs."""
    share = f"With 95 % confidence at least {100 * cell.no_worse:.0f} % of all runs"
    if len(cell.errors) < cell.runs:
        return f"Of {cell.runs} new runs {len(cell.errors)} completed. {share} complete."
    text = f"{share} have at most {number(max(cell.errors))} % s, the worst of {cell.runs} new runs"
    if cell.no_worse >= _ASSURED:
        return f"{text}."
    wanted = math.ceil(math.log(1 - CONFIDENCE) / math.log(_ASSURED))
    return f"{text}; --runs {wanted} would make it {100 * _ASSURED:.0f} %."


def bound_figure(study: LinkStudy) -> Figure:
    """Draw E_ac of every completed run, and the share of late packets, over the bound."""
    done = [cell for cell in study.bounds if cell.errors]
    bounds = [cell.bound for cell in done for _ in cell.errors]
    errors = [error for cell in done for error in cell.errors]
    dots = Line("#9AA3AD", "", 1.0, "o", markersize=3)
    means = Curve(
        [cell.bound for cell in done], [_mean(cell) for cell in done], "mean E_ac", line(0)
    )
    late = [100 * cell.late for cell in study.bounds]
    marks = {} if study.best is None else {study.best.bound: "best bound"}
    error = Panel(
        "E_ac  [% s]",
        [Curve(bounds, errors, "runs", dots), means],
        "bound  [s]",
        marks=marks,
        yscale="log" if done else "linear",
        height=2.5,
    )
    share = Panel(
        "late packets  [%]",
        [Curve([cell.bound for cell in study.bounds], late, "", line(1))],
        "bound  [s]",
        marks=marks,
        ylim=(0, 100),
        height=2.5,
    )
    return draw([error, share], 2)
