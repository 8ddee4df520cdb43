"""Figures of a training: its curve, and what the network answers against what it should."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.reporting import style
from stewart_drake.reporting.style import figure_style, write_figures
from stewart_drake.tuning.training import Training

_TEST: Final = style.Line("#D55E00", "--", 1.5)
_MOST_LEVELS: Final = 12
"""Targets of more different values are shown as a cloud rather than as boxes."""


def training_figures(training: Training, directory: str | Path) -> list[Path]:
    """Write the training curve and the regression plot, as PNG and SVG.

    Args:
        training: as `train` returns it.
        directory: that exists.

    Returns:
        The paths written.

    Raises:
        OSError: the directory cannot be written to.
    """
    with figure_style():
        figures = {"training_curve": _curve(training), "regression": _regression(training)}
    return write_figures(figures, directory)


def _unit(training: Training) -> str:
    return "" if training.network.output == "weights" else "ln "


def _curve(training: Training) -> Figure:
    figure = Figure(figsize=(5.2, 3.2), layout="constrained")
    ax = figure.subplots()
    steps = np.arange(len(training.curve))
    ax.plot(steps, training.curve[:, 0], label="training rows", **style.RUN._asdict())
    ax.plot(steps, training.curve[:, 1], label="test rows", **_TEST._asdict())
    constant = training.network.card["rms_error"]["test_of_a_constant"]
    ax.axhline(constant, color="#888888", linestyle=":", label="test rows, a constant")
    ax.set_xlabel("successful Levenberg-Marquardt steps")
    ax.set_ylabel(f"rms error of {_unit(training)}w_Q, {_unit(training)}w_R")
    ax.set_xlim(0, max(1, steps[-1]))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3)
    return figure


def _regression(training: Training) -> Figure:
    """For each value of the target, the spread of the network's answers; the diagonal is right."""
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    for k, (ax, name) in enumerate(zip(figure.subplots(1, 2), ("w_Q", "w_R"), strict=True)):
        target, output = training.targets[:, k], training.outputs[:, k]
        levels = np.unique(np.round(target, 9))
        ends = np.array([levels[0], levels[-1]]) if len(levels) else np.zeros(2)
        ax.plot(ends, ends, **style.REFERENCE._asdict())
        if 1 < len(levels) <= _MOST_LEVELS:
            groups = [output[np.abs(target - level) < 1e-6] for level in levels]
            width = 0.5 * np.diff(levels).min()
            ax.boxplot(
                groups,
                positions=levels,
                widths=width,
                whis=(5, 95),
                showfliers=False,
                manage_ticks=False,
                medianprops={"color": style.RUN.color, "linewidth": 1.8},
            )
        else:
            ax.plot(target, output, ".", markersize=2, color=style.RUN.color)
        ax.set_xlabel(f"label, {_unit(training)}{name}")
        ax.set_ylabel(f"network, {_unit(training)}{name}")
    figure.suptitle(
        "Test rows: median, quartiles, 5 to 95 % of the answers; grey: the right answer", fontsize=9
    )
    return figure
