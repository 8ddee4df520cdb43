"""Figures of a tuner's worth: the distribution of J per candidate, and weights over time."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting import style
from stewart_drake.reporting.style import Line, figure_style, legend_above, plain_log_ticks
from stewart_drake.studies.families import FAULTS, fault_of
from stewart_drake.tuning.curves import RATIOS
from stewart_drake.tuning.worth import FIXED, Worth

_TUNERS: Final = (
    Line("#D55E00", "--", 1.5),
    Line("#0072B2", "-", 1.6),
    Line("#009E73", "-.", 1.6),
    Line("#CC79A7", ":", 1.8),
)
_DEFAULT: Final = FIXED[int(np.argmin(np.abs(RATIOS)))]


def _lines(worth: Worth) -> dict[str, Line]:
    tuners = [name for name in worth.names if name not in FIXED]
    return {name: _TUNERS[i % len(_TUNERS)] for i, name in enumerate(tuners)}


def distributions(worth: Worth) -> Figure:
    """Share of the conditions below each J: the default, the best fixed ratio, the tuners."""
    best = worth.summary["best_g"]
    lines = {_DEFAULT: Line("#888888", ":", 1.4), best: Line("#000000", "-", 1.4)} | _lines(worth)
    with figure_style():
        figure = Figure(figsize=(style.WIDTH, 3.6), layout="constrained")
        ax = figure.subplots()
        for name, line in lines.items():
            J = np.sort(worth.cost[worth.names.index(name)])
            share = 100 * np.arange(1, len(J) + 1) / len(J)
            label = f"fixed, {name}" if name in FIXED else name
            ax.step(J, share, where="post", label=label, **line._asdict())
        ax.set_xscale("log")
        plain_log_ticks(ax.xaxis)
        ax.set_xlabel("J in % s")
        ax.set_ylabel("conditions, %")
        ax.set_ylim(0, 100)
        return legend_above(figure, ax)


def runs_of_each_kind(worth: Worth) -> Figure:
    """log10(w_Q / w_R) over the samples in the first condition of each fault."""
    kinds = [fault_of(one) for one in worth.draws]
    period = worth.summary["base"]["controller"]["period"]
    with figure_style():
        figure = Figure(figsize=(style.WIDTH, 4.6), layout="constrained")
        panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for ax, fault in zip(panels, FAULTS, strict=True):
            ax.set_title(fault, fontsize=9)
            if fault not in kinds:
                continue
            i = kinds.index(fault)
            best = RATIOS[worth.cost[: len(FIXED), i].argmin()]
            ax.axhline(best, label="best fixed there", **style.REFERENCE._asdict())
            for name, line in _lines(worth).items():
                ratio = worth.ratios[name][i]
                time = period * np.arange(len(ratio))
                ax.step(time, ratio, where="post", label=name, **line._asdict())
            ax.set_ylim(RATIOS[0] - 0.2, RATIOS[-1] + 0.2)
        for ax in panels[2:]:
            ax.set_xlabel("time in s")
        for ax in panels[::2]:
            ax.set_ylabel("log10 w_Q / w_R")
        return legend_above(figure, panels[0])
