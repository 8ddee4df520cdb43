"""The closed loop as a block diagram, drawn from the Drake diagram: the paper's figure 4.

Blocks, connections, signal names and sizes are the diagram's own; only where a block stands and
which way a line takes is decided here.
"""

import re
from itertools import pairwise
from typing import Any, Final, NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from pydrake.systems.framework import Diagram

from stewart_drake.reporting.style import figure_style

Point = tuple[float, float]

_SIZE: Final = (10.0, 5.2)
"""Inches, in which everything here is measured."""
_BOX: Final = (1.24, 0.62)
_PLACES: Final[dict[str, Point]] = {
    "reference": (0.78, 4.65),
    "controller": (2.89, 4.65),
    "saturation": (5.0, 4.65),
    "delay_chain": (7.11, 4.65),
    "torque_bias": (9.22, 4.65),
    "plant": (9.22, 3.475),
    "sensor": (9.22, 2.3),
    "density": (6.2, 1.05),
    "tuner": (2.89, 1.05),
    "weights": (2.89, 1.05),
}
_INK: Final = "#333333"
_FILL: Final = {"density": "#E3EEF6", "tuner": "#E3EEF6"}


class _Route(NamedTuple):
    """From one block to another along axes.

    `start` and `end` are a side of the block and a shift along it, `label` is where the text
    stands, `via` the corners where there is more than one; the first is a dot if it `branches`.
    """

    start: tuple[str, float]
    end: tuple[str, float]
    label: Point
    via: tuple[Point, ...] = ()
    branches: bool = False


_ROUTES: Final[dict[tuple[str, str], _Route]] = {
    ("reference", "controller"): _Route(("right", 0), ("left", 0), (1.83, 4.65)),
    ("controller", "saturation"): _Route(("right", 0), ("left", 0), (3.94, 4.65)),
    ("saturation", "delay_chain"): _Route(("right", 0), ("left", 0), (6.05, 4.65)),
    ("delay_chain", "torque_bias"): _Route(("right", 0), ("left", 0), (8.16, 4.65)),
    ("torque_bias", "plant"): _Route(("bottom", 0), ("top", 0), (9.22, 4.07)),
    ("plant", "sensor"): _Route(("bottom", 0), ("top", 0), (9.22, 2.89)),
    ("sensor", "controller"): _Route(("left", 0), ("bottom", 0.3), (5.6, 2.3)),
    ("sensor", "density"): _Route(("bottom", 0), ("right", 0), (8.0, 1.05)),
    ("controller", "density"): _Route(
        ("right", 0), ("top", 0), (4.75, 1.68), ((3.66, 4.65), (3.66, 1.68), (6.2, 1.68)), True
    ),
    ("reference", "density"): _Route(
        ("bottom", 0), ("bottom", 0), (3.5, 0.3), ((0.78, 0.3), (6.2, 0.3))
    ),
    ("density", "tuner"): _Route(("left", 0), ("right", 0), (4.55, 1.05)),
    ("tuner", "controller"): _Route(("top", -0.3), ("bottom", -0.3), (2.59, 2.3)),
    ("weights", "controller"): _Route(("top", -0.3), ("bottom", -0.3), (2.59, 2.3)),
}


@figure_style()
def loop_figure(loop: Diagram) -> Figure:
    """Draw the block diagram of a closed loop, see `loop.diagram.build_closed_loop`.

    Raises:
        ValueError: a block or a connection that has no place in the drawing.
    """
    figure = Figure(figsize=_SIZE)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(0, _SIZE[0]), ylim=(0, _SIZE[1]))
    ax.axis("off")
    for (target, j), (source, i) in loop.connection_map().items():
        output, into = source.get_output_port(i), target.get_input_port(j)
        _line(ax, source.get_name(), target.get_name(), _text(output, into))
    for system in loop.GetSystems():
        _block(ax, system)
    return figure


def _text(output: Any, into: Any) -> str:
    """Name and size of a signal; Drake's own blocks leave their ports unnamed."""
    name = output.get_name()
    if re.fullmatch(r"y\d*", name):
        name = into.get_name()
    return f"{name}\n{output.size()}"


def _place(name: str) -> Point:
    if name not in _PLACES:
        raise ValueError(f"block {name!r}: has no place in the drawing of the loop")
    return _PLACES[name]


def _block(ax: Axes, system: Any) -> None:
    name = system.get_name()
    x, y = _place(name)
    width, height = _BOX
    ax.add_patch(
        FancyBboxPatch(
            (x - width / 2, y - height / 2),
            width,
            height,
            boxstyle="round,pad=0,rounding_size=0.06",
            facecolor=_FILL.get(name, "white"),
            edgecolor=_INK,
            linewidth=1.2,
            zorder=3,
            gid=name,
        )
    )
    kind = re.sub(r"_?[<\[].*", "", system.GetSystemType()).replace("::", ".").rpartition(".")[2]
    ax.text(x, y + 0.1, name.replace("_", " "), ha="center", va="center", zorder=4)
    ax.text(x, y - 0.13, kind, ha="center", va="center", fontsize=6.5, color="#666666", zorder=4)


def _line(ax: Axes, source: str, target: str, text: str) -> None:
    if (source, target) not in _ROUTES:
        raise ValueError(f"connection {source!r} to {target!r}: has no way in the drawing")
    route = _ROUTES[source, target]
    points = _corners(_anchor(source, route.start), _anchor(target, route.end), route)
    xs, ys = zip(*points, strict=True)
    ax.plot(xs, ys, color=_INK, lw=1.1, solid_joinstyle="miter", zorder=1, gid=f"{source}-{target}")
    if route.branches:
        ax.plot(*points[1], "o", color=_INK, ms=4, zorder=2)
    ax.annotate(
        "",
        xy=points[-1],
        xytext=points[-2],
        arrowprops={"arrowstyle": "-|>", "color": _INK, "lw": 1.1, "shrinkA": 0, "shrinkB": 0},
        zorder=2,
    )
    # Name above, size below a horizontal line; a vertical one makes room for both.
    flat = any(y == route.label[1] == end for (_, y), (_, end) in pairwise(points))
    ax.text(
        *route.label,
        text,
        ha="center",
        va="center",
        fontsize=8,
        linespacing=1.7 if flat else 1.3,
        bbox=None if flat else {"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        zorder=2,
    )


def _anchor(name: str, at: tuple[str, float]) -> Point:
    (x, y), (side, shift), (width, height) = _place(name), at, _BOX
    return {
        "left": (x - width / 2, y + shift),
        "right": (x + width / 2, y + shift),
        "top": (x + shift, y + height / 2),
        "bottom": (x + shift, y - height / 2),
    }[side]


def _corners(start: Point, end: Point, route: _Route) -> list[Point]:
    """Return the way from start to end, along axes."""
    if route.via:
        return [start, *route.via, end]
    if route.start[0] in ("left", "right"):
        return [start, (end[0], start[1]), end] if start[1] != end[1] else [start, end]
    return [start, (start[0], end[1]), end] if start[0] != end[0] else [start, end]
