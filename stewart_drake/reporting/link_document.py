"""The document of the analysis of a network."""

import math
from functools import partial
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Paragraph, Picture, Section, Table, Tone
from stewart_drake.reporting.style import figure_style
from stewart_drake.reporting.words import number
from stewart_drake.studies.link_bound import Cell, LinkStudy
from stewart_drake.studies.statistics import CONFIDENCE

_TEXT: Final = (
    "A torque acts a bound after it was computed, and one period more for each repetition. With a "
    "short bound many packets come too late, with a long one the prediction has to reach further. "
    "Half periods are tried next to the best whole one.",
    "Late is the share of the packets that are not there by the bound, of those that are not lost; "
    "missing the share of the torques that are in no packet that is there in time, so that an "
    "older plan stands in. E_ac is the mean of the runs that completed.",
    "No worse is the interval of the worst run: with 95 % confidence at least this share of all "
    "runs completes and, where all that were simulated completed, has at most the worst E_ac.",
)
_LOSS_TEXT: Final = (
    "The same at the best bound, with other shares of the packets lost, and with new seeds: those "
    "above have chosen the bound, and are too good there."
)
_ASSURED: Final = 0.9
"""Share of runs for which the verdict says how many have to be simulated."""
_COLUMNS: Final = (
    "bound [s]",
    "lost",
    "late",
    "missing",
    "completed",
    "E_ac [% s]",
    "worst [% s]",
    "no worse",
)


def document(study: LinkStudy) -> Document:
    """Bounds, then losses at the best of them."""
    text, tone = _verdict(study)
    caption = f"Simulations on the exact plant, {study.runs} seeds each."
    table = Table(_COLUMNS, [_row(cell) for cell in study.bounds], caption, brief=True)
    figure = partial(bound_figure, study)
    picture = Picture(figure, "E_ac over the bound; dots are runs, dashed: best.")
    more = [Paragraph("Interrupted: not all simulations were run.", brief=True)] * study.interrupted
    if study.left_out:
        bounds = " and ".join(f"{bound:g} s" for bound in study.left_out)
        more.append(
            Paragraph(
                f"Not tried: {bounds}, no whole number of plant.time_step, as the multibody plant "
                "of the scenario needs.",
                brief=True,
            )
        )
    sections = [Section("The bound", *_TEXT, *more, table, picture)]
    if study.losses:
        rows = [_row(cell) for cell in study.losses]
        losses = Table(_COLUMNS, rows, caption, brief=True)
        sections.append(Section("Losses", _LOSS_TEXT, losses))
    facts = {"play-out without a bound given": f"{study.usual:.3g} s"}
    return Document("What a network asks for", text, sections, tone, facts)


def _verdict(study: LinkStudy) -> tuple[str, Tone]:
    """The answer in a few sentences, and how good it is."""
    best = study.best
    if best is None:
        return "No run completed, at any bound.", "bad"
    late = f"{100 * best.late:.3g} % of the packets are late"
    text = (
        f"A bound of {best.bound:.3g} s is the best of those looked at: E_ac is "
        f"{number(float(np.mean(best.errors)))} % s, {late}. Without a bound given the scenario "
        f"takes {study.usual:.3g} s."
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
    """E_ac of every completed run over the bound, their mean, and how many packets are late."""
    with figure_style():
        figure = Figure(figsize=(8.0, 3.6), layout="constrained")
        ax = figure.subplots()
        done = [cell for cell in study.bounds if cell.errors]
        for cell in done:
            ax.plot([cell.bound] * len(cell.errors), cell.errors, "o", ms=3, color="#9AA3AD")
        bounds = [cell.bound for cell in done]
        ax.plot(bounds, [np.mean(c.errors) for c in done], "o-", color="#1B6CA8", label="mean E_ac")
        if study.best is not None:
            ax.axvline(study.best.bound, color="#666666", lw=1, ls="--")
        if done:
            ax.set_yscale("log")
        ax.set(xlabel="bound  [s]", ylabel="E_ac  [% s]")
        right = ax.twinx()
        shares = [100 * cell.late for cell in study.bounds]
        every = [cell.bound for cell in study.bounds]
        right.plot(every, shares, ":", color="#B5651D", label="late packets")
        right.set(ylabel="late  [%]", ylim=(0, 100))
        right.grid(False)
        figure.legend(loc="outside upper center", ncols=2, frameon=False)
        return figure


def _row(cell: Cell) -> tuple[str, ...]:
    return (
        f"{cell.bound:.3g}",
        f"{100 * cell.loss:.3g} %",
        f"{100 * cell.late:.3g} %",
        f"{100 * cell.missing:.3g} %",
        f"{len(cell.errors)} of {cell.runs}",
        number(float(np.mean(cell.errors))) if cell.errors else "-",
        number(max(cell.errors)) if cell.errors else "-",
        f">= {100 * cell.no_worse:.0f} %" if cell.runs else "-",
    )
