"""A mechanism drawn from above and from the front, with its legs numbered."""

import itertools
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from stewart_drake.mechanism.assembly import assemble
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.style import Line, figure_style, write_figures
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array

# Told apart by width and darkness too, for grey print.
CRANK: Final = Line("#D55E00", "-", 4.5)
ROD: Final = Line("#7A828C", "-", 2.0)
PLATE: Final = Line("#0072B2", "-", 1.6)
BASE: Final = Line("#9AA1AA", "--", 1.0)
_LABEL_GAP: Final = 0.13
"""Of the drawn radius, between a shaft and its number."""
_VIEWS: Final = {"top view": (0, 1), "front view": (0, 2)}


def mechanism_figure(mechanism: Mechanism) -> Figure:
    """Two views of a mechanism at its home pose; lengths in mm.

    Raises:
        UnreachablePoseError: home is out of reach.
    """
    home = assemble(mechanism, mechanism.home)
    joints = mechanism.home[3:] + mechanism.p_PQ @ home.R_WP.T
    points = {"shaft": mechanism.p_WS, "tip": home.p_WT, "joint": joints}
    points = {name: 1e3 * p for name, p in points.items()}
    everything = np.vstack(list(points.values()))
    height = np.ptp(np.append(everything[:, 2], 0.0))
    width = np.ptp(everything, axis=0)[:2].max()
    with figure_style():
        figure = Figure(figsize=(10, 5.6))
        grid = figure.add_gridspec(1, 2, left=0.075, right=0.985, bottom=0.1, top=0.88, wspace=0.2)
        for column, (title, axes) in enumerate(_VIEWS.items()):
            ax = figure.add_subplot(grid[column])
            _view(ax, points, axes, 1e3 * mechanism.home[3:])
            ax.set_title(title)
        _frame(figure.axes, everything, max(width, height))
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper center", ncols=len(labels))
        return figure


def write_mechanism_figure(mechanism: Mechanism, directory: Path) -> list[Path]:
    """Write mechanism.png and mechanism.svg.

    Raises:
        OSError: the directory cannot be written to.
    """
    return write_figures({"mechanism": mechanism_figure(mechanism)}, directory)


def _view(ax: Axes, points: dict[str, Array], axes: tuple[int, int], centre: Array) -> None:
    shaft, tip, joint = (points[name][:, axes] for name in ("shaft", "tip", "joint"))
    seen_from_above = axes == (0, 1)
    # What is nearer to the viewer is drawn later: height seen from above, -y seen from the front.
    depth = points["joint"][:, 2] if seen_from_above else -points["shaft"][:, 1]
    hull = joint[_around(points["joint"])]
    ax.add_patch(
        Polygon(hull, facecolor="#0072B233", edgecolor="none", zorder=2.5 if seen_from_above else 1)
    )
    ax.plot(*np.vstack([hull, hull[:1]]).T, label="plate", zorder=3, **PLATE._asdict())
    base = shaft[_around(points["shaft"])]
    ax.plot(*np.vstack([base, base[:1]]).T, label="shaft centres", zorder=1, **BASE._asdict())
    for rank, i in enumerate(np.argsort(depth)):
        order = 3 + rank / 10
        first = {"crank": "crank", "rod": "rod"} if rank == 0 else {}
        ax.plot(
            *zip(tip[i], joint[i], strict=True),
            label=first.get("rod"),
            zorder=order,
            **ROD._asdict(),
        )
        ax.plot(
            *zip(shaft[i], tip[i], strict=True),
            label=first.get("crank"),
            zorder=order + 0.05,
            **CRANK._asdict(),
        )
        ax.plot(*joint[i], "o", color=PLATE.color, ms=4, zorder=order + 0.06)
        ax.plot(*shaft[i], "o", color="#1B1F24", ms=5, zorder=order + 0.06)
    mass = centre[list(axes)]
    ax.plot(*mass, "+", color="#1B1F24", ms=9, mew=1.4, label="plate's centre of mass", zorder=6)
    _number(ax, shaft, seen_from_above)
    ax.set_aspect("equal")
    ax.set_xlabel("x  [mm]")
    ax.set_ylabel("y  [mm]" if seen_from_above else "z  [mm]")


def _around(points: Array) -> NDArray[np.intp]:
    """Indices of points in the order of their azimuth about their mean."""
    offsets = points - points.mean(axis=0)
    return np.argsort(np.arctan2(offsets[:, 1], offsets[:, 0]))


def _number(ax: Axes, shaft: Array, seen_from_above: bool) -> None:
    """Leg numbers next to the shafts, moved apart where they would cover each other."""
    gap = _LABEL_GAP * np.ptp(shaft, axis=0).max() / 2
    if seen_from_above:
        outwards = shaft - shaft.mean(axis=0)
        places = shaft + gap * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    else:
        places = shaft - [0, gap]
        order = np.argsort(places[:, 0])
        for before, after in itertools.pairwise(order):
            if places[after, 0] - places[before, 0] < 0.9 * gap:
                lowered = places[before, 1] < shaft[:, 1].min() - 1.5 * gap
                places[after, 1] -= 0.0 if lowered else gap
    for leg, (x, y) in zip(LEGS, places.tolist(), strict=True):
        ax.text(x, y, str(leg), ha="center", va="center", weight="bold", zorder=7)


def _frame(views: list[Axes], everything: Array, size: float) -> None:
    """The same scale for both views, the machine in the middle of each."""
    half = 0.62 * size
    for ax, axes in zip(views, _VIEWS.values(), strict=True):
        middle = (everything[:, axes].min(axis=0) + everything[:, axes].max(axis=0)) / 2
        ax.set_xlim(middle[0] - half, middle[0] + half)
        ax.set_ylim(middle[1] - half, middle[1] + half)
