"""Document and figures of a workspace study."""

from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from stewart_drake.core.layout import DEAD_CENTRE_SINE
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.reporting.document import Document, from_template, number
from stewart_drake.reporting.panels import Curve, Panel, draw, leg_curves
from stewart_drake.reporting.style import FACTORS, LIMIT, POWERS, TORQUES, UNITS, line, unit_for
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.studies.clearance import Nearest
from stewart_drake.studies.workspace import Sizing, WorkspaceStudy
from stewart_drake.studies.workspace_map import Section, Travel
from stewart_drake.types import Array

_COORDINATES: Final = tuple(zip(COORDINATE_NAMES, FACTORS, UNITS, strict=True))
_NEAREST: Final = 8
_LEVELS: Final = (1, 2, 3, 5, 8, 13, 30, 100)
_CMAP: Final = colormaps["cividis_r"]
_OUTSIDE: Final = "#F2F2F2"
_HALO: Final = (withStroke(linewidth=3, foreground="#FFFFFF"),)
"""Outline of black lines on any colour; on a dark page the lines are light."""
_PATH: Final[dict[str, Any]] = {"color": "#000000", "lw": 1.2, "path_effects": _HALO}
_HOME: Final[dict[str, Any]] = {**_PATH, "marker": "+", "ls": "", "ms": 9, "mew": 1.5}


def document(study: WorkspaceStudy) -> Document:
    summary, sizing, limit = study.summary, study.sizing, study.torque_limit
    along, travelled = study.clearance.along, study.clearance.travel
    limited = sizing is not None and limit is not None
    crossing = sum(one.distance < 0 for one in along.nearest)
    fair = study.home is not None or along.touching
    return from_template(
        "workspace",
        "bad" if study.exit is not None else "fair" if fair else "good",
        study=study,
        summary=summary,
        along=along,
        nearest_text=_nearest_text,
        crossing=_crossing,
        crossings=[(str(one.pair), 1e3 * one.distance) for one in along.touching],
        largest="-" if np.isnan(study.factor) else f"{study.factor_text} of this one",
        dead_centre=DEAD_CENTRE_SINE,
        singular=SINGULARITY_LIMIT,
        length=1e3 * summary["characteristic_length"],
        margins_figure=partial(margins_figure, study),
        nearest=along.nearest[: max(crossing, _NEAREST)],
        clearance_figure=partial(clearance_figure, study),
        clear_travel=travelled and list(zip(_COORDINATES, travelled, strict=True)),
        torque=_unit("peak_torque", summary, TORQUES),
        power=_unit("peak_power", summary, POWERS),
        use=limited and 100 * max(m["use_of_limit"] for m in summary["motors"]),
        motors_figure=sizing and partial(motors_figure, sizing, limit),
        from_home=study.travel and travel_text(study.travel),
        travel=study.travel and list(zip(_COORDINATES, study.travel, strict=True)),
        sections_figure=study.travel and partial(sections_figure, study),
    )


def _unit(name: str, summary: dict[str, Any], choice: dict[str, float]) -> tuple[str, float]:
    """Return the unit of the motors' largest value, and its factor."""
    return unit_for([motor[name] for motor in summary["motors"] or ()], choice)


def travel_text(travel: list[Travel]) -> str:
    """Return the range of each coordinate alone, from home, in degrees and mm."""
    return ", ".join(
        f"{name} {factor * t.low:.3g} to +{factor * t.high:.3g} {unit}"
        for (name, factor, unit), t in zip(_COORDINATES, travel, strict=True)
    )


def _nearest_text(nearest: Nearest | None) -> str:
    if nearest is None:
        return "-"
    crossing = _crossing(nearest)
    return f"{number(1e3 * nearest.distance)} mm, {nearest.where}{crossing and f', {crossing}'}"


def _crossing(nearest: Nearest) -> str:
    """Return a remark on parts that cross."""
    if nearest.distance >= 0:
        return ""
    return "crosses a base that is a full disc" if "base" in nearest.pair else "they cross"


def margins_figure(study: WorkspaceStudy) -> Figure:
    margins, left = study.margins, study.exit
    time, top = study.time, min(np.nanmax(margins.condition, initial=2.0), 1e4)
    parallel = np.where(np.isnan(margins.condition), np.nan, margins.parallel)

    def shade(ax: Axes) -> None:
        if left is not None:
            style: Any = {"color": "#000000", "alpha": 0.07, "lw": 0}
            ax.axvspan(left.time, time[-1], label="after leaving", **style)

    how: Any = {"xlim": (0, time[-1]), "height": 2.8, "paint": shade}
    panels = [
        Panel("reach margin  [mm]", leg_curves(time, 1e3 * margins.reach), limits={0.0: ""}, **how),
        Panel(
            "sine off dead centre  [-]",
            leg_curves(time, margins.sines),
            limits={DEAD_CENTRE_SINE: ""},
            ylim=(max(-0.05, float(np.nanmin(margins.sines))), 1.05),
            **how,
        ),
        Panel(
            "parallel measure, det W  [-]",
            [Curve(time, parallel)],
            limits={SINGULARITY_LIMIT: ""},
            ylim=(-0.1, None),
            **how,
        ),
        Panel(
            "condition number of A  [-]",
            [Curve(time, margins.condition)],
            ylim=(0.95, 1.25 * top),
            yscale="log",
            **how,
        ),
    ]
    return draw(panels, 2)


def motors_figure(sizing: Sizing, torque_limit: float | None) -> Figure:
    limited = torque_limit is not None and torque_limit < 3 * np.abs(sizing.torque).max()
    of_torque, torque = unit_for(sizing.torque, TORQUES)
    of_power, power = unit_for(sizing.power, POWERS)
    limits = {s * torque * torque_limit: "" for s in (-1, 1)} if torque_limit and limited else {}
    values = {
        f"torque  [{of_torque}]": (torque * sizing.torque, limits),
        "crank speed  [rad/s]": (sizing.speed, {}),
        f"power  [{of_power}]": (power * sizing.power, {}),
    }
    ends = (0, sizing.time[-1])
    return draw(
        [
            Panel(name, leg_curves(sizing.time, data), limits=levels, xlim=ends, height=1.9)
            for name, (data, levels) in values.items()
        ]
    )


def clearance_figure(study: WorkspaceStudy) -> Figure:
    along, time = study.clearance.along, study.clearance.along.time
    curves = [
        Curve(time, 1e3 * along.links, "links", line(0, marked=False)),
        Curve(time, 1e3 * along.base, "base and motors", line(1, marked=False)),
    ]
    whole = (0, time[-1])
    left = Panel("distance of the nearest  [mm]", curves, limits={0.0: ""}, xlim=whole, height=3.2)
    if not study.clearance.sections:
        return draw([left], 2)
    section, pair = study.clearance.sections[0], study.sections[0]
    x, y = FACTORS[pair.first] * section.x, FACTORS[pair.second] * section.y
    distance = 1e3 * section.distance
    ends = Normalize(np.nanmin(distance), np.nanmax(distance))
    colors = _CMAP.reversed()

    def paint(ax: Axes) -> None:
        ax.pcolormesh(x, y, distance, cmap=colors, norm=ends, shading="nearest")
        _home(ax, pair, study.experiment.mechanism.home)
        ax.set_facecolor(_OUTSIDE)

    right = Panel(_axis(pair.second), x=_axis(pair.first), height=3.2, paint=paint)
    scale = ScalarMappable(ends, colors), "nearest links  [mm], light is good"
    return draw([left, right], 2, colors=scale)


def _axis(k: int) -> str:
    return f"{COORDINATE_NAMES[k]}  [{UNITS[k]}]"


def _home(ax: Axes, pair: Section, home: Array) -> None:
    ax.plot(*(FACTORS[k] * home[k] for k in (pair.first, pair.second)), label="home", **_HOME)
    ax.grid(False)


def sections_figure(study: WorkspaceStudy) -> Figure:
    norm = BoundaryNorm(_LEVELS, 256, extend="max")
    return draw(
        [
            Panel(
                _axis(one.second),
                x=_axis(one.first),
                xlim=(FACTORS[one.first] * one.x[0], FACTORS[one.first] * one.x[-1]),
                ylim=(FACTORS[one.second] * one.y[0], FACTORS[one.second] * one.y[-1]),
                height=3.6,
                paint=partial(_section, section=one, study=study, norm=norm),
            )
            for one in study.sections
        ],
        2,
        colors=(ScalarMappable(norm, _CMAP), "condition number of A  [-], light is good"),
    )


def _section(ax: Axes, section: Section, study: WorkspaceStudy, norm: BoundaryNorm) -> None:
    pair = section.first, section.second
    factors = [FACTORS[k] for k in pair]
    x, y = factors[0] * section.x, factors[1] * section.y
    # At a dead centre the condition is proportional to 1 / sine, and the sine to the root of the
    # distance. Squares are nearly linear there and can be interpolated on a grid.
    quality = np.nan_to_num(1 / np.square(section.condition))
    edges = [0.0, *(1 / np.square(_LEVELS[::-1]))]
    shades = [_CMAP(norm(1.01 * level)) for level in _LEVELS[::-1]]
    border = np.sign(section.margin) * np.square(section.margin)
    ax.set_facecolor(_OUTSIDE)
    ax.contourf(x, y, quality, levels=edges, colors=shades)
    ax.contourf(x, y, border, levels=[-1e9, 0.0], colors=_OUTSIDE)
    if (border > 0).any():
        ax.contour(x, y, border, [0.0], colors=LIMIT.color, linewidths=1.8)
    ax.plot([], [], color=LIMIT.color, lw=1.8, label="border of the workspace")
    path = (f * study.poses[:, k] for f, k in zip(factors, pair, strict=True))
    ax.plot(*path, label="reference, projected", **_PATH)
    _home(ax, section, study.experiment.mechanism.home)
