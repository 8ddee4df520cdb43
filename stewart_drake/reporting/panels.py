"""Figures as lists of panels, drawn by one function."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter
from matplotlib.transforms import blended_transform_factory

from stewart_drake.reporting import style
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array, ArrayLike

Scale = Literal["linear", "log", "powers"]
"""Scale of an axis: `log` has ticks such as 20 and 50, `powers` such as 10⁻³."""
Ends = tuple[float | None, float | None]  # None follows the data

_LEGEND_LINE: Final = 0.25
_HANDLE, _CHARACTER = 0.62, 0.079
"""Height of a legend's line, width of an entry without its text, and of a character, inches."""
_LABELS: Final = 0.45
"""Height of tick labels and name of a horizontal axis, inches."""
_BEYOND: Final = ("v", "^")
"""Markers of a run that ended below or above its axis."""
_CROSS: Final = Line2D([], [], ls="", marker="x", color="#666666", ms=7, mew=2)


@dataclass(frozen=True)
class Curve:
    x: ArrayLike
    y: ArrayLike
    label: str = ""  # for the legend, or empty
    line: style.Line = style.RUN
    steps: bool = False  # whether a value holds until the next x
    # lower and upper end of an interval, and its label
    band: tuple[ArrayLike, ArrayLike, str] | None = None
    ended: float | None = None  # x at which a run ended early, marked by a cross


@dataclass(frozen=True)
class Panel:
    y: str  # name and unit of the vertical axis
    curves: Sequence[Curve] = ()
    # name and unit of the horizontal axis, shown below the last panel that shares it
    x: str = "time  [s]"
    limits: Mapping[float, str] = field(default_factory=dict)  # levels with a text on each
    # places on the horizontal axis with a dotted line, and labels for the legend
    marks: Mapping[float, str] = field(default_factory=dict)
    xscale: Scale = "linear"
    yscale: Scale = "linear"
    xlim: Ends | None = None
    ylim: Ends | None = None
    title: str = ""
    # place of its legend: above the whole figure, above the panel, or inside
    legend: Literal["figure", "panel", "inside"] = "figure"
    height: float = 1.8  # in inches
    wide: bool = False  # whether it fills a whole row, below the others
    paint: Callable[[Axes], object] | None = None  # draws anything else


def leg_curves(x: ArrayLike, values: Array, name: str = "leg") -> list[Curve]:
    """Return the curves of six columns (n, 6), a leg each."""
    legs = zip(LEGS, style.LEG_LINES, values.T, strict=True)
    return [Curve(x, column, f"{name} {leg}", look) for leg, look, column in legs]


@style.figure_style()
def draw(
    panels: Sequence[Panel],
    columns: int = 1,
    *,
    down: bool = False,
    sharey: bool | Literal["row"] = False,
    colors: tuple[ScalarMappable, str] | None = None,
    title: str = "",
) -> Figure:
    """Draw panels in rows, or column by column with `down`, below a legend of all their curves.

    Args:
        panels: share a horizontal axis of the same name.
        columns: of the panels that are not `wide`.
        down: whether panels are ordered column by column.
        sharey: whether all panels share a vertical axis; with "row" those of a row, while each has
            its own horizontal axis.
        colors: a scale of colours on the right, and its name.
        title: of the legend.
    """
    grid = [one for one in panels if not one.wide]
    placed = [*grid, *(one for one in panels if one.wide)]
    rows = math.ceil(len(grid) / columns)
    spots = [divmod(k, rows)[::-1] if down else divmod(k, columns) for k in range(len(grid))]
    spots += [(rows + k, 0) for k in range(len(placed) - len(grid))]
    pairs = list(zip(placed, spots, strict=True))
    alike = sharey == "row" or (sharey and len({one.y for one in grid}) == 1)
    in_row = [[one for one, (r, _) in pairs if r == row] for row in range(spots[-1][0] + 1)]
    heights = [max(one.height for one in row) for row in in_row]
    figure = Figure(figsize=(style.WIDTH, 1.0), layout="constrained")
    first, named = dict[int, Axes](), set[int]()
    spec = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    for one, (row, column) in pairs:
        sharex = sharey != "row" and one.x == grid[0].x and not one.wide
        same_y = first.get(row if sharey == "row" else 0) if sharey and not one.wide else None
        place = spec[row, :] if one.wide else spec[row, column]
        ax = figure.add_subplot(place, sharex=first.get(0) if sharex else None, sharey=same_y)
        first.setdefault(row, ax)
        below = [p.x for p, (r, c) in pairs if r > row and c == column and not p.wide]
        last = one.x not in below
        named |= {row} if last else set()
        _fill(ax, one, last=last, named=column == 0 or not alike)
    titled = sum(any(one.title or one.legend == "panel" for one in row) for row in in_row)
    lines = _legend(figure, panels, title) + titled
    figure.set_figheight(sum(heights) + _LABELS * len(named) + _LEGEND_LINE * (lines + 0.5))
    if colors is not None:
        figure.colorbar(colors[0], ax=figure.axes, aspect=30).set_label(colors[1])
    # The layout takes most of the drawing time, so it is computed once.
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine(None)
    _align_ylabels(figure, figure.axes[: len(pairs)])
    return figure


def _align_ylabels(figure: Figure, axes: Sequence[Axes]) -> None:
    """Align the names of vertical axes in each column, once: Matplotlib does it at each drawing."""
    columns = defaultdict[float, dict[Axes, float]](dict)
    for ax in axes:
        ax.yaxis.get_tightbbox()  # places its name
        x = ax.yaxis.label.get_position()[0] / figure.bbox.width
        columns[round(ax.get_position().x0, 3)][ax] = x
    for column in columns.values():
        for ax in column:
            place = blended_transform_factory(figure.transFigure, ax.transAxes)
            ax.yaxis.set_label_coords(min(column.values()), 0.5, place)


def _fill(ax: Axes, panel: Panel, last: bool, named: bool) -> None:
    if isinstance(ax.yaxis.get_major_formatter(), ScalarFormatter):
        ax.yaxis.set_major_formatter(style.PlainNumbers())
    for one in panel.curves:
        how: dict[str, Any] = {"drawstyle": "steps-post"} if one.steps else {}
        ax.plot(one.x, one.y, label=one.label or None, **one.line._asdict(), **how)
        if one.band is not None:
            low, high, label = one.band
            step: Any = "post" if one.steps else None
            look: Any = {"color": one.line.color, "alpha": style.BAND_ALPHA, "linewidth": 0}
            ax.fill_between(one.x, low, high, step=step, label=label, **look)
    for x, label in panel.marks.items():
        ax.axvline(x, label=label or None, **style.MARK._asdict())
    for level, text in panel.limits.items():
        limit(ax, level, text)
    for axis, scale in (("x", panel.xscale), ("y", panel.yscale)):
        if scale != "linear":
            ax.set(**{f"{axis}scale": "log"})
            ticks = style.plain_log_ticks if scale == "log" else style.powers_of_ten
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
            low, high = ax.get_ylim()
            end, marker = np.clip(values[-1], low, high), "x"
            if end != values[-1]:
                marker = _BEYOND[int(end == high)]
            ax.plot(one.ended, end, marker, color=one.line.color, ms=7, mew=2, clip_on=False)
    ax.set(ylabel=panel.y if named else "", xlabel=panel.x if last else "", title=panel.title)
    ax.tick_params(labelbottom=last, labelleft=named)
    if panel.legend == "inside":
        ax.legend(loc="best")
    elif panel.legend == "panel":
        ax.legend(ncols=6, loc="lower center", bbox_to_anchor=(0.5, 0.98))


def limit(ax: Axes, level: float, text: str, *, below: bool = False) -> None:
    ax.axhline(level, label=None if text else "limit", **style.LIMIT._asdict())
    ax.annotate(
        text,
        (0.01, level),
        xycoords=("axes fraction", "data"),
        xytext=(0, -4 if below else 2.5),
        textcoords="offset points",
        ha="left",
        va="top" if below else "bottom",
        fontsize=8,
        color=style.LIMIT.color,
        bbox={"fc": "white", "ec": "none", "pad": 0.6},  # a curve may pass behind it
        zorder=5,
    )


def _legend(figure: Figure, panels: Sequence[Panel], title: str) -> int:
    """Name all curves above the figure, below a title; return the number of lines."""
    handles: dict[str, Artist] = {}
    for ax, panel in zip(figure.axes, panels, strict=False):
        if panel.legend == "figure":
            for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
                handles.setdefault(label, handle)
    if any(curve.ended is not None for panel in panels for curve in panel.curves):
        beyond = any(one.get_marker() in _BEYOND for ax in figure.axes for one in ax.lines)
        handles["run ended (triangle: beyond the axis)" if beyond else "run ended"] = _CROSS
    labels = list(handles)
    for lines in range(1, len(labels) + 1):
        columns = math.ceil(len(labels) / lines)
        taken = [labels[k : k + lines] for k in range(0, len(labels), lines)]
        if sum(_HANDLE + _CHARACTER * max(map(len, one)) for one in taken) <= style.WIDTH:
            break
    else:
        return 0
    how: Any = {"loc": "outside upper center", "ncols": columns}
    figure.legend(handles.values(), labels, title=title or None, **how)
    return lines + bool(title)
