"""Draws one step of the controller over time: `python make_step.py`.

A sketch: the curves have no data.
"""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stewart_drake.reporting.style import figure_style

STEPS = 4
"""Torques in flight."""
INK, PLATE, QUEUE, NEW = "#333333", "#0072B2", "#BBBBBB", "#D55E00"


def reference(t: np.ndarray) -> np.ndarray:
    return 0.9 * np.sin(0.42 * t + 0.5)


def plate(t: np.ndarray) -> np.ndarray:
    return reference(t) - 0.45 - 0.05 * t


def curves(ax: Axes) -> None:
    """Draw the reference, the measured and the predicted plate, and the error."""
    t = np.linspace(-3, STEPS + 2.4, 200)
    ax.plot(t, reference(t), color="#999999", lw=4, alpha=0.6)
    ax.plot(t[t <= 0], plate(t[t <= 0]), color=PLATE, lw=2)
    ahead = t[(t >= 0) & (t <= STEPS)]
    ax.plot(ahead, plate(ahead), color=PLATE, lw=2, ls=(0, (3, 2)))
    ax.plot([0, STEPS], plate(np.array([0.0, STEPS])), "o", color=PLATE, ms=6)
    top, low = reference(np.array([1.0 * STEPS]))[0], plate(np.array([1.0 * STEPS]))[0]
    ax.annotate("", (STEPS, top), (STEPS, low), arrowprops={"arrowstyle": "<->", "color": NEW})
    ax.text(STEPS + 0.15, (top + low) / 2, "error $e$", color=NEW, va="center")
    ax.text(-2.9, reference(np.array([-2.9]))[0] + 0.3, "reference", color="#777777")
    ax.text(-1.6, plate(np.array([-1.6]))[0] - 0.3, "measured", color=PLATE)
    ax.text(1.0, plate(np.array([1.0]))[0] - 0.34, "predicted through the torques", color=PLATE)
    for x in (0, STEPS):
        ax.axvline(x, color=INK, lw=0.8, ls=":")
    ax.set(xlim=(-3.1, STEPS + 2.4), ylim=(-1.35, 1.15))
    ax.axis("off")


def torques(ax: Axes) -> None:
    """Draw which torque acts when."""
    names = [*(f"$T_{{k-{STEPS - i}}}$" for i in range(STEPS)), "$T_k$"]
    for i, name in enumerate(names):
        color = NEW if i == STEPS else QUEUE
        ax.broken_barh([(i + 0.03, 0.94)], (0, 1), facecolors=color)
        ink = "white" if i == STEPS else INK
        ax.text(i + 0.5, 0.5, name, ha="center", va="center", color=ink)
    ax.text(STEPS / 2, 1.3, "in flight: sent, not yet acting", ha="center", color=INK)
    ax.text(STEPS + 0.1, 1.3, "computed now", ha="left", color=NEW)
    ax.annotate("", (-3.1, -0.35), (STEPS + 2.4, -0.35), arrowprops={"arrowstyle": "<-"})
    for x, name in ((0, "sample $t_k$"), (STEPS, r"$t_k + \eta$")):
        ax.axvline(x, 0.27, color=INK, lw=0.8, ls=":")
        ax.text(x, -1.05, name, ha="center")
    ax.text(STEPS + 2.3, -1.05, "time", ha="right")
    ax.set(xlim=(-3.1, STEPS + 2.4), ylim=(-1.2, 1.9))
    ax.axis("off")


@figure_style()
def step_figure() -> Figure:
    """Return the curves above the torques, over one axis of time."""
    figure = Figure(figsize=(8.2, 3.4))
    above, below = figure.subplots(2, height_ratios=[2.2, 1])
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.99, hspace=0)
    curves(above)
    torques(below)
    return figure


if __name__ == "__main__":
    step_figure().savefig(Path(__file__).with_name("step.png"), dpi=120)
