"""The tuner's network, neuron by neuron, in the manner of the paper's figure 3."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from stewart_drake.reporting.style import figure_style
from stewart_drake.scenario.signals import COORDINATES, LEGS, WEIGHTS
from stewart_drake.tuner.network import Network

Array = NDArray[np.float64]

_INK: Final = "#333333"
_POSITIVE: Final = "#0072B2"
_NEGATIVE: Final = "#D55E00"
_HEIGHT: Final = 6.2
"""Inches of the drawing of a network."""
_RANGE: Final = (-2.2, 18.2)
"""Its heights, in units of the distance of two inputs."""
_POINTS: Final = 72 * _HEIGHT / (_RANGE[1] - _RANGE[0])
"""Points per such unit."""


@figure_style()
def network_figure(network: Network) -> Figure:
    """Draw the network: the width of a link is the size of its weight, the dash its sign.

    Widths are relative to the largest weight of the layer.
    """
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
