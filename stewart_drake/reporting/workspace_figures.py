"""Figures of a workspace study: margins along the reference, sections, and the motors' work."""

from typing import Any, Final

import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke

from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT, Failure
from stewart_drake.native.layout import DEAD_CENTRE_SINE
from stewart_drake.reporting.style import FACTORS, UNITS, Line, figure_style
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS
from stewart_drake.studies.clearance import ClearanceStudy
from stewart_drake.studies.reach import Margins
from stewart_drake.studies.sizing import Sizing
from stewart_drake.studies.workspace_map import Section
from stewart_drake.types import Array

# A colour per pair of legs, a line style per leg: apart in grey print too.
LEG_LINES: Final = (
    Line("#0072B2", "-", 1.5),
    Line("#0072B2", (0, (4, 1.5)), 1.5),
    Line("#E69F00", "-", 1.7),
    Line("#E69F00", (0, (4, 1.5)), 1.7),
    Line("#000000", "-", 1.2),
    Line("#000000", (0, (4, 1.5)), 1.2),
)
LIMIT: Final = Line("#B00020", ":", 1.8)
_LEVELS: Final = (1, 2, 3, 5, 8, 13, 30, 100)
"""Of the condition number."""
_CMAP: Final = colormaps["cividis_r"]
_OUTSIDE: Final = "#F2F2F2"
_HALO: Final = (withStroke(linewidth=3, foreground="#FFFFFF"),)
"""Of black lines over colours of any darkness; on a dark page it is the lines that are light."""
_PATH: Final[dict[str, Any]] = {"color": "#000000", "lw": 1.2, "path_effects": _HALO}
_HOME: Final[dict[str, Any]] = {**_PATH, "marker": "+", "ls": "", "ms": 9, "mew": 1.5}


@figure_style()
def margins_figure(margins: Margins, left: Failure | None) -> Figure:
    """Reach, dead centre, parallel singularity and condition along the reference."""
    figure = Figure(figsize=(10, 7.4))
    grid = {"left": 0.08, "right": 0.985, "bottom": 0.07, "top": 0.93, "wspace": 0.22}
    figure.subplots_adjust(hspace=0.16, **grid)
    axes = figure.subplots(2, 2, sharex=True).ravel()
    _legs(axes[0], margins.time, 1e3 * margins.reach, "reach margin  [mm]", 0.0)
    _legs(axes[1], margins.time, margins.sines, "sine off dead centre  [-]", DEAD_CENTRE_SINE)
    axes[1].set_ylim(max(-0.05, axes[1].get_ylim()[0]), 1.05)
    style = LEG_LINES[4]._asdict()
    inside = np.where(np.isnan(margins.condition), np.nan, margins.parallel)
    axes[2].plot(margins.time, inside, **style)
    axes[2].axhline(SINGULARITY_LIMIT, **LIMIT._asdict())
    axes[2].set_ylabel("parallel measure, det W  [-]")
    axes[2].set_ylim(bottom=-0.1)
    axes[3].plot(margins.time, margins.condition, **style)
    axes[3].set_ylabel("condition number of A  [-]")
    axes[3].set_yscale("log")
    axes[3].set_yticks([1, 2, 3, 5, 10, 20, 50, 100, 1000], minor=False)
    axes[3].set_yticks([], minor=True)
    axes[3].yaxis.set_major_formatter("{x:g}")
    top = np.nanmax(margins.condition, initial=2.0)
    axes[3].set_ylim(0.95, 1.25 * min(top, 1e4))
    for ax in axes:
        ax.set_xlim(0, margins.time[-1])
        if left is not None:
            ax.axvspan(left.time, margins.time[-1], color="#000000", alpha=0.07, lw=0)
    for ax in axes[2:]:
        ax.set_xlabel("time  [s]")
    _legend(figure, left is not None)
    return figure


@figure_style()
def sections_figure(sections: list[Section], home: Array, poses: Array) -> Figure:
    """Condition number over the sections; the reference's poses (n, 6) projected onto them."""
    figure = Figure(figsize=(10, 8.6))
    grid = figure.add_gridspec(
        2,
        3,
        width_ratios=(1, 1, 0.045),
        left=0.08,
        right=0.93,
        bottom=0.065,
        top=0.93,
        hspace=0.24,
        wspace=0.3,
    )
    norm = BoundaryNorm(_LEVELS, 256, extend="max")
    for k, section in enumerate(sections):
        ax = figure.add_subplot(grid[k // 2, k % 2])
        _section(ax, section, home, poses, norm)
    scale = figure.colorbar(
        ScalarMappable(norm, _CMAP), cax=figure.add_subplot(grid[:, 2]), extend="max"
    )
    scale.set_label("condition number of A  [-], light is good")
    handles = [
        Line2D([], [], color=LIMIT.color, lw=1.8),
        Line2D([], [], **_PATH),
        Line2D([], [], **_HOME),
    ]
    labels = ["border of the workspace", "reference, projected", "home"]
    figure.legend(handles, labels, loc="upper center", ncols=3)
    return figure


@figure_style()
def motors_figure(sizing: Sizing, torque_limit: float | None) -> Figure:
    """Torque, speed and power of the six cranks along the reference."""
    figure = Figure(figsize=(10, 7.2))
    figure.subplots_adjust(left=0.085, right=0.985, bottom=0.07, top=0.93, hspace=0.14)
    axes = figure.subplots(3, 1, sharex=True)
    _legs(axes[0], sizing.time, sizing.torque, "torque  [N m]", None)
    _legs(axes[1], sizing.time, sizing.speed, "crank speed  [rad/s]", None)
    _legs(axes[2], sizing.time, sizing.power, "power  [W]", None)
    peak = np.abs(sizing.torque).max()
    limited = torque_limit is not None and torque_limit < 3 * peak
    if torque_limit is not None and limited:
        for sign in (-1, 1):
            axes[0].axhline(sign * torque_limit, **LIMIT._asdict())
    axes[2].set_xlabel("time  [s]")
    axes[0].set_xlim(0, sizing.time[-1])
    figure.align_ylabels(list(axes))
    _legend(figure, False, limited)
    return figure


@figure_style()
def clearance_figure(clearance: ClearanceStudy, sections: list[Section], home: Array) -> Figure:
    """Distances of the nearest parts: along the reference, and over a section through home."""
    figure = Figure(figsize=(10, 4.2))
    figure.subplots_adjust(left=0.08, right=0.97, bottom=0.13, top=0.88, wspace=0.26)
    along, around = figure.subplots(1, 2)
    lines = {"links": LEG_LINES[0], "base and motors": LEG_LINES[2]}
    for (name, line), values in zip(
        lines.items(), (clearance.along.links, clearance.along.base), strict=True
    ):
        along.plot(clearance.along.time, 1e3 * values, label=name, **line._asdict())
    along.axhline(0.0, **LIMIT._asdict())
    along.set_xlim(0, clearance.along.time[-1])
    along.set_xlabel("time  [s]")
    along.set_ylabel("distance of the nearest  [mm]")
    along.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    if not clearance.sections:
        around.set_axis_off()
        return figure
    section, pair = clearance.sections[0], (sections[0].first, sections[0].second)
    x, y = (FACTORS[k] * v for k, v in zip(pair, (section.x, section.y), strict=True))
    shown = around.pcolormesh(x, y, 1e3 * section.distance, cmap=_CMAP, shading="nearest")
    around.plot(*(FACTORS[k] * home[k] for k in pair), **_HOME)
    around.grid(False)
    around.set_facecolor(_OUTSIDE)
    around.set_xlabel(f"{COORDINATE_NAMES[pair[0]]}  [{UNITS[pair[0]]}]")
    around.set_ylabel(f"{COORDINATE_NAMES[pair[1]]}  [{UNITS[pair[1]]}]")
    figure.colorbar(shown, ax=around).set_label("nearest links  [mm]")
    return figure


def _legs(ax: Axes, time: Array, values: Array, label: str, limit: float | None) -> None:
    for leg, line, column in zip(LEGS, LEG_LINES, values.T, strict=True):
        ax.plot(time, column, label=f"leg {leg}", **line._asdict())
    if limit is not None:
        ax.axhline(limit, **LIMIT._asdict())
    ax.set_ylabel(label)


def _legend(figure: Figure, outside: bool, limited: bool = True) -> None:
    handles: list[Artist] = [Line2D([], [], **line._asdict()) for line in LEG_LINES]
    labels = [f"leg {leg}" for leg in LEGS]
    if limited:
        handles.append(Line2D([], [], **LIMIT._asdict()))
        labels.append("limit")
    if outside:
        handles.append(Patch(facecolor="#000000", alpha=0.07))
        labels.append("after leaving")
    figure.legend(handles, labels, loc="upper center", ncols=len(labels))


def _section(ax: Axes, section: Section, home: Array, poses: Array, norm: BoundaryNorm) -> None:
    pair = section.first, section.second
    factors = [FACTORS[k] for k in pair]
    x, y = factors[0] * section.x, factors[1] * section.y
    # At a dead centre the condition goes like 1 / sine and the sine like the root of the distance:
    # what is nearly linear there, and so what a grid can be interpolated in, are squares.
    quality = np.nan_to_num(1 / np.square(section.condition))
    edges = [0.0, *(1 / np.square(_LEVELS[::-1]))]
    shades = [_CMAP(norm(1.01 * level)) for level in _LEVELS[::-1]]
    border = np.sign(section.margin) * np.square(section.margin)
    ax.contourf(x, y, quality, levels=edges, colors=shades)
    ax.contourf(x, y, border, levels=[-1e9, 0.0], colors=_OUTSIDE)
    if (border > 0).any():
        ax.contour(x, y, border, [0.0], colors=LIMIT.color, linewidths=1.8)
    ax.plot(*(f * poses[:, k] for f, k in zip(factors, pair, strict=True)), **_PATH)
    ax.plot(*(f * home[k] for f, k in zip(factors, pair, strict=True)), **_HOME)
    ax.grid(False)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(y[0], y[-1])
    ax.set_xlabel(f"{COORDINATE_NAMES[pair[0]]}  [{UNITS[pair[0]]}]")
    ax.set_ylabel(f"{COORDINATE_NAMES[pair[1]]}  [{UNITS[pair[1]]}]")
