"""Document and figure of a mechanism at its home pose, held there under gravity."""

import itertools
import math
from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.mechanism.assembly import assemble
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.reporting.document import Document, from_template, number
from stewart_drake.reporting.panels import Panel, draw
from stewart_drake.reporting.style import Line
from stewart_drake.reporting.workspace import travel_text
from stewart_drake.scenario.signals import LEGS
from stewart_drake.studies.new_machine import MechanismCheck
from stewart_drake.types import Array

# Distinct by width and darkness too, for grey print.
CRANK: Final = Line("#D55E00", "-", 4.5)
ROD: Final = Line("#7A828C", "-", 2.0)
PLATE: Final = Line("#0072B2", "-", 1.6)
BASE: Final = Line("#9AA1AA", "--", 1.0)
_LABEL_GAP: Final = 0.13
"""Distance of a shaft's number, as a share of the drawn radius."""
_VIEWS: Final = {"top view": (0, 1), "front view": (0, 2)}


def document(check: MechanismCheck) -> Document:
    mechanism = check.mechanism
    bodies = {"plate": "disc", "crank": "bar", "rod": "bar"}
    return from_template(
        "mechanism",
        check=check,
        mechanism=mechanism,
        measures=check.measures,
        six=_six,
        deg=np.rad2deg(check.crank_angles),
        cranks=_lengths(mechanism.crank_lengths),
        rods=_lengths(mechanism.rod_lengths),
        bodies=[(name, shape, getattr(mechanism, name)) for name, shape in bodies.items()],
        limit=SINGULARITY_LIMIT,
        regular=check.failure is None,
        poles=check.failure is None and _poles(check.poles),
        travel=check.failure is None and travel_text(check.travel),
    )


def _six(values: Array) -> str:
    return ", ".join(map(number, values))


def _lengths(values: Array) -> str:
    """Return lengths in mm, one number if all are equal."""
    equal = bool(np.ptp(values) < 1e-12)
    return _six(1e3 * (values[:1] if equal else values))


def _poles(poles: NDArray[np.complex128]) -> str:
    """Return what constant torques do, and the growing and oscillating poles.

    Each pole has its mirror image in a frictionless machine.
    """
    fastest = np.abs(poles).max()
    grow = [pole.real for pole in poles if pole.real > 1e-6 * fastest]
    swing = [pole.imag for pole in poles if abs(pole.real) <= 1e-6 * fastest < pole.imag]
    parts = [f"unstable poles {_six(np.array(grow))} /s"] if grow else []
    parts += [f"oscillating poles {_six(np.array(swing))} rad/s"] if swing else []
    if grow:
        double = number(1e3 * math.log(2) / max(grow), 2)
        text = f"errors double in {double} ms under constant torques; servos hold the plate"
        parts.insert(0, text)
    return "; ".join(parts) or "all poles zero"


def mechanism_figure(mechanism: Mechanism) -> Figure:
    """Draw two views of a mechanism at its home pose, of the same scale; lengths in mm."""
    home = assemble(mechanism, mechanism.home)
    joints = mechanism.home[3:] + mechanism.p_PQ @ home.R_WP.T
    points = {"shaft": 1e3 * mechanism.p_WS, "tip": 1e3 * home.p_WT, "joint": 1e3 * joints}
    everything = np.vstack(list(points.values()))
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = 0.62 * max((high - low)[:2].max(), high[2] - low[2], abs(high[2]), abs(low[2]))
    middle, centre = (low + high) / 2, 1e3 * mechanism.home[3:]
    view = partial(_view, points=points, centre=centre, corners=middle + [[-half], [half]])
    panels = []
    for name, axes in _VIEWS.items():
        paint = partial(view, axes=axes)
        upwards = f"{'xyz'[axes[1]]}  [mm]"
        panels.append(Panel(upwards, x="x  [mm]", title=name, height=4.05, paint=paint))
    return draw(panels, 2)


def _view(
    ax: Axes, points: dict[str, Array], axes: tuple[int, int], centre: Array, corners: Array
) -> None:
    shaft, tip, joint = (points[name][:, axes] for name in ("shaft", "tip", "joint"))
    seen_from_above = axes == (0, 1)
    # Parts nearer to the viewer are drawn later: by z from above, by -y from the front.
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
        for name, look, begin, end, above in (
            ("rod", ROD, tip, joint, 0.0),
            ("crank", CRANK, shaft, tip, 0.05),
        ):
            label = None if rank else name
            link = zip(begin[i], end[i], strict=True)
            ax.plot(*link, label=label, zorder=order + above, **look._asdict())
        ax.plot(*joint[i], "o", color=PLATE.color, ms=4, zorder=order + 0.06)
        ax.plot(*shaft[i], "o", color="#1B1F24", ms=5, zorder=order + 0.06)
    ax.update_datalim(corners[:, axes])
    ax.margins(0)
    ax.set_aspect("equal", adjustable="datalim")
    mass = centre[list(axes)]
    ax.plot(*mass, "+", color="#1B1F24", ms=9, mew=1.4, label="plate's centre of mass", zorder=6)
    _number(ax, shaft, seen_from_above)


def _around(points: Array) -> NDArray[np.intp]:
    """Return indices of points by their azimuth about the mean."""
    offsets = points - points.mean(axis=0)
    return np.argsort(np.arctan2(offsets[:, 1], offsets[:, 0]))


def _number(ax: Axes, shaft: Array, seen_from_above: bool) -> None:
    """Write leg numbers next to the shafts, without overlap."""
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
