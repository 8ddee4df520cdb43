"""The weights that the tuner set in recorded runs, in the manner of the paper's figure 6."""

from collections.abc import Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from stewart_drake.loop.results import SimulationResult
from stewart_drake.reporting import style
from stewart_drake.reporting.style import figure_style
from stewart_drake.scenario.signals import WEIGHTS

_INK: Final = "#333333"
_AFTER_END: Final = 1.1
"""The time axis of a run that ended early goes on for this factor."""


@figure_style()
def weights_figure(runs: Mapping[str, SimulationResult]) -> Figure:
    """w_Q, w_R and their ratio over time, one column per run.

    Args:
        runs: by what each column is called; at least one.

    Returns:
        The figure; the ratio, on which alone the gain depends, in the lower row.
    """
    count = len(runs)
    figure = Figure(figsize=(max(10.0, 10 / 3 * count), 4.6))
    width = figure.get_figwidth()
    figure.subplots_adjust(
        left=0.62 / width,
        right=1 - 0.12 / width,
        bottom=0.11,
        top=0.86,
        hspace=0.12,
        wspace=0.1,
    )
    axes = figure.subplots(2, count, sharex="col", sharey="row", squeeze=False)
    for column, (label, run) in enumerate(runs.items()):
        _draw_weights(axes[0, column], axes[1, column], run)
        axes[0, column].set_title(label)
        axes[1, column].set_xlabel("time  [s]")
        axes[0, column].set_xlim(0, shown_until(run))
    axes[0, 0].set_ylabel("weight")
    axes[1, 0].set_ylabel("w_Q / w_R")
    figure.legend(*_weight_handles(axes), loc="upper center", ncols=4)
    return figure


def shown_until(run: SimulationResult) -> float:
    """s, where the time axis of a run ends."""
    end = run.scenario.duration
    return end if run.stopped is None else min(end, _AFTER_END * run.stopped.time) or end


def _draw_weights(above: Axes, below: Axes, run: SimulationResult) -> None:
    time, weights = run.signals.time.values, run.signals.weights.values
    for k, line in enumerate((style.RUN, style.COMMANDED)):
        above.plot(time, weights[:, k], drawstyle="steps-post", label=WEIGHTS[k], **line._asdict())
    ratio = weights[:, 0] / weights[:, 1]
    below.plot(time, ratio, drawstyle="steps-post", color="#000000", linewidth=1.3)
    c = run.scenario.controller
    below.axhline(c.w_Q / c.w_R, label="fixed weights", color="#888888", ls=":", lw=1.2)
    for ax in (above, below) if len(time) else ():
        ax.set_yscale("log")
        style.plain_log_ticks(ax.yaxis)
        if run.stopped is not None and run.status != "interrupted":
            end = (weights[-1, 0], ratio[-1])[ax is below]
            ax.plot(run.stopped.time, end, "x", color=_INK, ms=7, mew=2, clip_on=False)


def _weight_handles(axes: NDArray[np.object_]) -> tuple[list[Line2D], list[str]]:
    above, below = axes[0, 0].get_legend_handles_labels(), axes[1, 0].get_legend_handles_labels()
    handles, labels = [*above[0], *below[0]], [*above[1], *below[1]]
    if any(line.get_marker() == "x" for ax in axes.ravel() for line in ax.lines):
        handles.append(Line2D([], [], ls="", marker="x", color=_INK, ms=7, mew=2))
        labels.append("run ended")
    return handles, labels
