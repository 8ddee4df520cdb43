"""Figures of the tuner, in the manner of the paper's figures 3 and 6.

Its network, neuron by neuron, and the weights that it set in recorded runs.
"""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from stewart_drake.loop.results import SimulationResult
from stewart_drake.report import style
from stewart_drake.report.style import figure_style
from stewart_drake.scenario.signals import COORDINATES, LEGS, WEIGHTS
from stewart_drake.tuner.network import Network

Array = NDArray[np.float64]

_INK: Final = "#333333"
_AFTER_END: Final = 1.1
"""The time axis of a run that ended early goes on for this factor."""
_POSITIVE: Final = "#0072B2"
_NEGATIVE: Final = "#D55E00"
_HEIGHT: Final = 6.2
"""Inches of the drawing of a network."""
_RANGE: Final = (-2.2, 18.2)
"""Its heights, in units of the distance of two inputs."""
_POINTS: Final = 72 * _HEIGHT / (_RANGE[1] - _RANGE[0])
"""Points per such unit."""


# --------------------------------------------------------------------- weights over time


def weights_figure(runs: Mapping[str, SimulationResult]) -> Figure:
    """w_Q, w_R and their ratio over time, one column per run.

    Args:
        runs: by what each column is called; at least one.

    Returns:
        The figure; the ratio, on which alone the gain depends, in the lower row.
    """
    with figure_style():
        count = len(runs)
        figure = Figure(figsize=(max(5.0, 10 / 3 * count), 4.6))
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


# --------------------------------------------------------------------- the network


def network_figure(network: Network) -> Figure:
    """The network, neuron by neuron: a link's width is the size of its weight, its dash the sign.

    Widths are relative to the largest weight of the layer.
    """
    with figure_style():
        figure = Figure(figsize=(7.2, _HEIGHT))
        ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        ax.set(xlim=(-2.5, 5.2), ylim=_RANGE)
        ax.axis("off")
        rows = (
            np.arange(17.0, -1.0, -1.0) + np.repeat([0.3, 0.0, -0.3], 6),
            _spread(network.hidden),
            _spread(len(WEIGHTS), 0.45),
        )
        columns = (0.0, 2.0, 4.0)
        for k, matrix in enumerate((network.W1, network.W2)):
            _links(ax, matrix, columns[k : k + 2], rows[k : k + 2])
        outputs = [f"ln {w}" if network.output == "log_weights" else w for w in WEIGHTS]
        for x, ys in zip(columns, rows, strict=True):
            # In points, smaller than their distance.
            diameter = min(18.0, 0.8 * _POINTS * float(np.abs(np.diff(ys)).min(initial=np.inf)))
            ax.plot(x + 0 * ys, ys, "o", ms=diameter, mfc="white", mec=_INK, zorder=3)
        for y, text in zip(rows[0], _input_names(), strict=True):
            ax.text(-0.16, y, text, ha="right", va="center")
        for y, text in zip(rows[2], outputs, strict=True):
            ax.text(4.22, y, text, ha="left", va="center", fontsize=11)
        layers = (
            f"{len(rows[0])} densities\n({network.density}, standardised)",
            f"{network.hidden} hidden neurons\n(sigmoid)",
            "2 outputs\n(linear)",
        )
        for x, text in zip(columns, layers, strict=True):
            ax.text(x, -0.75, text, ha="center", va="top")
        handles = [
            Line2D([], [], color=_POSITIVE, ls="-", lw=2, label="positive weight"),
            Line2D([], [], color=_NEGATIVE, ls=(0, (3, 1.5)), lw=2, label="negative weight"),
        ]
        ax.legend(handles=handles, loc="upper right", bbox_to_anchor=(0.995, 0.99))
        return figure


def _spread(count: int, share: float = 1.0) -> Array:
    """Heights of `count` neurons, evenly over the middle share of the drawing."""
    reach = 8.5 * share if count > 1 else 0.0
    return np.linspace(8.5 + reach, 8.5 - reach, count)


def _input_names() -> Iterator[str]:
    names = ("φ", "θ", "ψ", "x", "y", "z")
    assert len(names) == len(COORDINATES)
    yield from (f"ρ of error, {name}" for name in names)
    yield from (f"ρ of error rate, {name}" for name in names)
    yield from (f"ρ of torque {leg}" for leg in LEGS)


def _links(ax: Axes, matrix: Array, columns: tuple[float, ...], rows: tuple[Array, ...]) -> None:
    largest = np.abs(matrix).max() or 1.0
    for j, i in np.ndindex(*matrix.shape):
        share = abs(matrix[j, i]) / largest
        ax.plot(
            columns,
            (rows[0][i], rows[1][j]),
            color=_POSITIVE if matrix[j, i] >= 0 else _NEGATIVE,
            linestyle="-" if matrix[j, i] >= 0 else (0, (3, 1.5)),
            linewidth=0.2 + 2.2 * share,
            alpha=0.25 + 0.7 * share,
            zorder=1,
        )
