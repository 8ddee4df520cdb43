"""Figures as lists of panels: each says what it shows, and one function draws them all alike."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter
from numpy.typing import ArrayLike

from stewart_drake.reporting.style import (
    BAND_ALPHA,
    LIMIT,
    MARK,
    RUN,
    WIDTH,
    Line,
    figure_style,
    plain_log_ticks,
    powers_of_ten,
)

Scale = Literal["linear", "log", "powers"]
"""Of an axis: `log` has ticks such as 20 and 50, `powers` such as 10⁻³."""
Ends = tuple[float | None, float | None]
"""Of an axis; None is left to the data."""

# Inches around and between panels. A layout engine takes most of the drawing time.
_LEFT, _RIGHT, _TOP, _BOTTOM = 0.85, 0.2, 0.15, 0.5
_BESIDE, _BESIDE_SHARED, _BELOW, _BELOW_NAMED = 0.85, 0.25, 0.17, 0.62
_NAME: Final = -0.58
"""From an axis to its name."""
_LEGEND_LINE: Final = 0.25
_HANDLE, _CHARACTER = 0.62, 0.079
"""Width of a legend's entry without its text, and of a character."""
_CROSS: Final = Line2D([], [], ls="", marker="x", color="#666666", ms=7, mew=2)


@dataclass(frozen=True)
class Curve:
    """A line in a panel.

    Attributes:
        label: for the legend, or empty.
        steps: whether a value holds until the next x.
        band: lower and upper end of an interval, and its label.
        ended: x at which a run ended early, which is marked by a cross.
    """

    x: ArrayLike
    y: ArrayLike
    label: str = ""
    line: Line = RUN
    steps: bool = False
    band: tuple[ArrayLike, ArrayLike, str] | None = None
    ended: float | None = None


@dataclass(frozen=True)
class Panel:
    """A pair of axes.

    Attributes:
        y: name and unit of the vertical axis.
        x: those of the horizontal axis, shown below the last of the panels that share it.
        limits: levels that the curves should stay on one side of, with a text on each.
        marks: places on the horizontal axis with a dotted line, with a label for the legend.
        legend: where its curves are named: above the whole figure, above the panel, or inside.
        height: in inches.
        wide: take a row of its own, below the others.
        paint: draw anything else.
    """

    y: str
    curves: Sequence[Curve] = ()
    x: str = "time  [s]"
    limits: Mapping[float, str] = field(default_factory=dict)
    marks: Mapping[float, str] = field(default_factory=dict)
    xscale: Scale = "linear"
    yscale: Scale = "linear"
    xlim: Ends | None = None
    ylim: Ends | None = None
    title: str = ""
    legend: Literal["figure", "panel", "inside"] = "figure"
    height: float = 1.8
    wide: bool = False
    paint: Callable[[Axes], object] | None = None


@figure_style()
def draw(
    panels: Sequence[Panel],
    columns: int = 1,
    *,
    down: bool = False,
    sharey: bool | Literal["row"] = False,
    room: float = _LEFT,
    edge: float = _RIGHT,
    top: float = 0.0,
) -> Figure:
    """Draw panels in rows, or column by column with `down`, below a legend of all their curves.

    Panels share a horizontal axis of the same name. `sharey` gives all panels the same vertical
    axis; with "row" those of a row, while each has its own horizontal one.
    `room` is for the labels of the vertical axis on the left, `edge` is kept free on the right and
    `top` above, in inches.
    """
    grid = [one for one in panels if not one.wide]
    placed = [*grid, *(one for one in panels if one.wide)]
    rows = math.ceil(len(grid) / columns)
    spots = [divmod(k, rows)[::-1] if down else divmod(k, columns) for k in range(len(grid))]
    spots += [(rows + k, 0) for k in range(len(placed) - len(grid))]
    alike = sharey == "row" or (sharey and len({one.y for one in grid}) == 1)
    figure, first = Figure(figsize=(WIDTH, 1.0)), dict[int, Axes]()
    for one, (row, column) in zip(placed, spots, strict=True):
        sharex = sharey != "row" and one.x == grid[0].x and not one.wide
        same_y = first.get(row if sharey == "row" else 0) if sharey and not one.wide else None
        ax = figure.add_subplot(sharex=first.get(0) if sharex else None, sharey=same_y)
        first.setdefault(row, ax)
        below = [p.x for p, (r, c) in zip(placed, spots, strict=True)
                 if r > row and c == column and not p.wide]  # fmt: skip
        _fill(ax, one, last=one.x not in below, named=column == 0 or not alike)
    beside = _BESIDE_SHARED if alike else _BESIDE
    _place(figure, placed, spots, (room, edge, top), beside, columns)
    return figure


def _place(
    figure: Figure,
    panels: Sequence[Panel],
    spots: Sequence[tuple[int, int]],
    free: tuple[float, float, float],
    beside: float,
    columns: int,
) -> None:
    """Put the axes of panels in their places in a figure that is as high as they need."""
    in_row = [
        [panel for panel, (r, _) in zip(panels, spots, strict=True) if r == row]
        for row in range(spots[-1][0] + 1)
    ]
    heights = [max(one.height for one in row) for row in in_row]
    gaps = [_gap(above, below) for above, below in pairwise(in_row)]
    titled = any(one.title or one.legend == "panel" for one in in_row[0])
    left, right, top = free
    top += _TOP + _LEGEND_LINE * (_legend(figure, panels) + titled)
    height = top + sum(heights) + sum(gaps) + _BOTTOM
    figure.set_figheight(height)
    whole = WIDTH - left - right
    single = (whole - beside * (columns - 1)) / columns
    for ax, one, (row, column) in zip(figure.axes, panels, spots, strict=False):
        low = height - top - sum(heights[: row + 1]) - sum(gaps[:row])
        width = whole if one.wide else single
        start = left + column * (single + beside)
        box = (start / WIDTH, low / height, width / WIDTH, heights[row] / height)
        ax.set_position(box)
        ax.yaxis.set_label_coords(_NAME / width, 0.5)


def _gap(above: Sequence[Panel], below: Sequence[Panel]) -> float:
    """Return inches between two rows: more where something is written between them."""
    named = above[0].x != below[0].x or below[0].wide
    titled = any(one.title or one.legend == "panel" for one in below)
    return (_BELOW_NAMED if named else _BELOW) + _LEGEND_LINE * titled


def _fill(ax: Axes, panel: Panel, last: bool, named: bool) -> None:
    if isinstance(ax.yaxis.get_major_formatter(), ScalarFormatter):
        # More digits than these would run into the name of the axis.
        ax.ticklabel_format(axis="y", scilimits=(-2, 4), useMathText=True)
    for one in panel.curves:
        how: dict[str, Any] = {"drawstyle": "steps-post"} if one.steps else {}
        ax.plot(one.x, one.y, label=one.label or None, **one.line._asdict(), **how)
        if one.band is not None:
            low, high, label = one.band
            step: Any = "post" if one.steps else None
            look: Any = {"color": one.line.color, "alpha": BAND_ALPHA, "linewidth": 0}
            ax.fill_between(one.x, low, high, step=step, label=label, **look)
    for x, label in panel.marks.items():
        ax.axvline(x, label=label or None, **MARK._asdict())
    for level, text in panel.limits.items():
        limit(ax, level, text)
    for axis, scale in (("x", panel.xscale), ("y", panel.yscale)):
        if scale != "linear":
            ax.set(**{f"{axis}scale": "log"})
            ticks = plain_log_ticks if scale == "log" else powers_of_ten
            ticks(getattr(ax, f"{axis}axis"))
    if panel.paint is not None:
        panel.paint(ax)
    if panel.xlim is not None:
        ax.set_xlim(*panel.xlim)
    if panel.ylim is not None:
        ax.set_ylim(*panel.ylim)
    for one in panel.curves:
        values = np.asarray(one.y)
        if one.ended is not None and len(values):
            end = np.clip(values[-1], *ax.get_ylim())
            ax.plot(one.ended, end, "x", color=one.line.color, ms=7, mew=2, clip_on=False)
    ax.set(ylabel=panel.y if named else "", xlabel=panel.x if last else "", title=panel.title)
    ax.tick_params(labelbottom=last, labelleft=named)
    if panel.legend == "inside":
        ax.legend(loc="best")
    elif panel.legend == "panel":
        ax.legend(ncols=6, loc="lower center", bbox_to_anchor=(0.5, 0.98))


def limit(ax: Axes, level: float, text: str, *, below: bool = False) -> None:
    """Draw a level that something must stay on one side of, with words on it."""
    ax.axhline(level, label=None if text else "limit", **LIMIT._asdict())
    ax.annotate(
        text,
        (0.01, level),
        xycoords=("axes fraction", "data"),
        xytext=(0, -4 if below else 2.5),
        textcoords="offset points",
        ha="left",
        va="top" if below else "bottom",
        fontsize=8,
        color=LIMIT.color,
        bbox={"fc": "white", "ec": "none", "pad": 0.6},  # a curve may pass behind it
        zorder=5,
    )


def _legend(figure: Figure, panels: Sequence[Panel]) -> int:
    """Name all curves above the figure, and return in how many lines."""
    handles: dict[str, Artist] = {}
    for ax, panel in zip(figure.axes, panels, strict=False):
        if panel.legend == "figure":
            for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
    if any(curve.ended is not None for panel in panels for curve in panel.curves):
        handles["run ended"] = _CROSS
    labels = list(handles)
    for lines in range(1, len(labels) + 1):
        columns = math.ceil(len(labels) / lines)
        taken = [labels[k : k + lines] for k in range(0, len(labels), lines)]
        if sum(_HANDLE + _CHARACTER * max(map(len, one)) for one in taken) <= WIDTH:
            break
    else:
        return 0
    figure.legend(handles.values(), labels, loc="upper center", ncols=columns)
    return lines
