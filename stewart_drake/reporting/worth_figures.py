"""Figures of a tuner's worth: the distribution of J per candidate, and weights over time."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting import style
from stewart_drake.reporting.style import Line, figure_style, legend_above, plain_log_ticks
from stewart_drake.studies.families import FAULTS, fault_of
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.worth import Worth

_TUNERS: Final = (
    Line("#D55E00", "--", 1.5),
    Line("#0072B2", "-", 1.6),
    Line("#009E73", "-.", 1.6),
    Line("#CC79A7", ":", 1.8),
)
_PANELS: Final = 4


def _lines(worth: Worth) -> dict[str, Line]:
    return {name: _TUNERS[i % len(_TUNERS)] for i, name in enumerate(worth.tuners)}


def _ratios(worth: Worth) -> np.typing.NDArray[np.float64]:
    """Return log10(w_Q / w_R) of the fixed gains."""
    return np.array([ratio_of(np.array(gain)) for gain in worth.family.gains.values()])


def distributions(worth: Worth) -> Figure:
    """Draw the share of the conditions below each J: equal weights, the best gain, the tuners."""
    best, equal = worth.summary["best_g"], worth.names[int(np.argmin(np.abs(_ratios(worth))))]
    lines = {equal: Line("#888888", ":", 1.4), best: Line("#000000", "-", 1.4)} | _lines(worth)
    with figure_style():
        figure = Figure(figsize=(style.WIDTH, 3.6), layout="constrained")
        ax = figure.subplots()
        for name, line in lines.items():
            J = np.sort(worth.cost[worth.names.index(name)])
            share = 100 * np.arange(1, len(J) + 1) / len(J)
            label = f"fixed, {name}" if name in worth.family.gains else name
            ax.step(J, share, where="post", label=label, **line._asdict())
        ax.set_xscale("log")
        plain_log_ticks(ax.xaxis)
        ax.set_xlabel("J in % s")
        ax.set_ylabel("conditions, %")
        ax.set_ylim(0, 100)
        return legend_above(figure, ax)


def _shown(worth: Worth) -> dict[str, int | None]:
    """Return the condition of each panel: the first of each fault, or the first four."""
    if not worth.family.has_faults:
        count = worth.cost.shape[1]
        return {f"condition {i + 1}": i if i < count else None for i in range(_PANELS)}
    kinds = [fault_of(one) for one in worth.family.draws]
    return {fault: kinds.index(fault) if fault in kinds else None for fault in FAULTS}


def weights_over_time(worth: Worth) -> Figure:
    """Draw log10(w_Q / w_R) over the samples in some conditions."""
    period, ratios = worth.family.base.controller.period, _ratios(worth)
    with figure_style():
        figure = Figure(figsize=(style.WIDTH, 4.6), layout="constrained")
        panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
        for ax, (title, i) in zip(panels, _shown(worth).items(), strict=True):
            ax.set_title(title, fontsize=9)
            if i is None:
                continue
            best = ratios[worth.cost[: len(ratios), i].argmin()]
            ax.axhline(best, label="best fixed there", **style.REFERENCE._asdict())
            for name, line in _lines(worth).items():
                ratio = worth.ratios[name][i]
                time = period * np.arange(len(ratio))
                ax.step(time, ratio, where="post", label=name, **line._asdict())
            ax.set_ylim(ratios.min() - 0.2, ratios.max() + 0.2)
        for ax in panels[2:]:
            ax.set_xlabel("time in s")
        for ax in panels[::2]:
            ax.set_ylabel("log10 w_Q / w_R")
        return legend_above(figure, panels[0])
