"""How every figure looks: one line per controller, also told apart in grey print, light or dark."""

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FormatStrFormatter,
    FuncFormatter,
    LogLocator,
    MaxNLocator,
    NullFormatter,
)

from stewart_drake.files.fileio import replacing


class Line(NamedTuple):
    """Keyword arguments of `Axes.plot`, by `_asdict()`."""

    color: str
    linestyle: Any
    linewidth: float
    marker: str = ""
    markevery: Any = None
    markersize: float = 4.0


# Okabe and Ito's colours, which colour-blind readers tell apart.
CONTROLLER_LINES: Final = {
    "lqr": Line("#E69F00", ":", 2.0),
    "lqi": Line("#009E73", "-.", 1.6),
    "delay_lqr": Line("#D55E00", (0, (9, 2.5)), 1.5),
    "delay_lqi": Line("#0072B2", (0, (3, 1.2)), 1.6),
    "predictor_lqi": Line("#000000", "-", 1.3),
}
_COLORS: Final = ("#0072B2", "#D55E00", "#000000", "#009E73", "#9B4F80", "#946800")
_DASHES: Final = ("-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.4, 1.2, 1.4)), (0, (9, 2.5)))
_MARKERS: Final = ("o", "s", "^", "D", "v", "P", "X", "*")
REFERENCE: Final = Line("#BBBBBB", "-", 4.0)
RUN: Final = Line("#0072B2", "-", 1.5)
"""A single run."""
COMMANDED: Final = Line("#D55E00", "--", 1.0)
TRUTH: Final = Line("#D55E00", "--", 1.2)
LIMIT: Final = Line("#8A2B0B", "-", 0.9)
"""A limit that something must stay on one side of."""
MARK: Final = Line("#666666", ":", 1.1)
"""A place on the horizontal axis."""
WIDTH: Final = 10.0
"""Inches of the figures of a page."""
UNITS: Final = ("deg",) * 3 + ("mm",) * 3
FACTORS: Final = np.array([180 / np.pi] * 3 + [1e3] * 3)
"""In which coordinates are shown, and what takes them there from rad and m."""
BAND_ALPHA: Final = 0.2
"""Opacity of an uncertainty band, in the colour of its line."""

DATA_INK: Final = "#111111"
DATA_PAPER: Final = "#FDFDFD"
"""On and between fields whose colour is a value, which a dark page does not change."""
DARK: Final = {
    "#ffffff": "#16191d",  # the page's paper
    "#000000": "#e6e9ed",  # and ink
    "#1b1f24": "#e6e9ed",
    "#333333": "#d0d6dc",
    "#444444": "#c5ccd3",
    "#666666": "#a3adb8",
    "#888888": "#8f99a3",
    "#bbbbbb": "#5c6670",
    "#e4e4e4": "#2e353d",
    "#f1eae6": "#2b2622",
    "#f2f2f2": "#22272d",
    "#0072b2": "#56b4e9",
    "#009e73": "#2fc79a",
    "#8a2b0b": "#e8805c",
    "#b00020": "#ff6e7f",
    "#d55e00": "#f08a4b",
    "#9b4f80": "#d68fbd",
    "#946800": "#d9a940",
}
"""What our lines and letters become on a dark page. Any other colour is data and stays."""

FORMATS: Final = ("png", "svg")
_RAISED: Final = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PATH: Final = re.compile(rb' d="[^"]*"')
_DIGITS: Final = re.compile(rb"(\.\d\d)\d+")
"""Beyond the second, which are cut off."""
_RC: Final[dict[Any, Any]] = {
    "axes.facecolor": "none",  # the figure's is behind it, or the page
    "axes.grid": True,
    "axes.labelsize": 9,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 9,
    "figure.dpi": 150,
    "font.family": "DejaVu Sans",  # comes with matplotlib: the same figure everywhere
    "font.size": 9,
    "grid.color": "#E4E4E4",
    "legend.columnspacing": 1.1,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.3,
    "legend.handletextpad": 0.5,
    "lines.solid_capstyle": "round",
    "path.simplify": True,
    "savefig.dpi": 150,
    "svg.hashsalt": "stewart_drake",
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}


def line(k: int, *, marked: bool = True, width: float = 1.5) -> Line:
    """Return the look of curve k of any number, told apart in grey print by dash and marker.

    `marked` curves have few points, each with a marker; of others only the sixth and later ones
    have markers, ten along the curve.
    """
    rest, dash = divmod(k, len(_DASHES))
    look = Line(_COLORS[k % len(_COLORS)], _DASHES[dash], width)
    if marked:
        return look._replace(marker=_MARKERS[k % len(_MARKERS)])
    if rest == 0:
        return look
    return look._replace(marker=_MARKERS[(rest - 1) % len(_MARKERS)], markevery=(0.01 * dash, 0.1))


LEG_LINES: Final = tuple(line(k, marked=False, width=1.4) for k in range(6))


def controller_lines(names: Iterable[str]) -> dict[str, Line]:
    """Return a line per controller: the shipped ones have their own, others get the next ones."""
    others = (line(k, marked=False, width=1.3) for k in itertools.count(len(_DASHES)))
    return {name: CONTROLLER_LINES.get(name) or next(others) for name in names}


@contextmanager
def figure_style() -> Iterator[None]:
    """Matplotlib's settings for our figures, whatever the user's own are."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


class _RoundTicks(LogLocator):
    """1, 2, 5 and so on; of less than half a decade, where these are few, evenly spaced."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        narrow = max(vmin, vmax) < 3 * min(vmin, vmax)
        return MaxNLocator(5).tick_values(vmin, vmax) if narrow else super().tick_values(vmin, vmax)


def plain_log_ticks(axis: Axis) -> None:
    """Ticks such as 20 and 50 on a logarithmic axis, not powers of ten with a factor."""
    axis.set_major_locator(_RoundTicks(subs=(1, 2, 5)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def powers_of_ten(axis: Axis) -> None:
    """Ticks such as 10⁻³ on a logarithmic axis, as text: formulas take ten times as long."""
    axis.set_major_formatter(FuncFormatter(_power_of_ten))
    axis.set_minor_formatter(NullFormatter())


def _power_of_ten(value: float, _: int) -> str:
    return "10" + f"{round(np.log10(value))}".translate(_RAISED)


def write_figures(figures: Mapping[str, Figure], directory: str | Path) -> list[Path]:
    """Write every figure by its name as `write_figure` does; the paths written.

    Raises:
        OSError: the directory cannot be written to.
    """
    with figure_style():
        return [
            path
            for name, figure in figures.items()
            for path in write_figure(figure, Path(directory), name)
        ]


def write_figure(figure: Figure, directory: Path, name: str) -> list[Path]:
    """Write NAME.png and NAME.svg, each whole or not; the same figure gives the same bytes.

    Raises:
        OSError: the directory cannot be written to.
    """
    paths = []
    for suffix in FORMATS:
        path = directory / f"{name}.{suffix}"
        metadata = {"Date": None} if suffix == "svg" else None
        with replacing(path) as partial:
            figure.savefig(partial, format=suffix, metadata=metadata)
        paths.append(path)
    return paths


def rounded(svg: bytes) -> bytes:
    """A figure with its paths to a hundredth of a point, which nobody sees: a fifth is saved."""
    return _PATH.sub(lambda path: _DIGITS.sub(rb"\1", path[0]), svg)


def for_dark_too(svg: bytes) -> bytes:
    """A figure as matplotlib writes it, with the colours of DARK where its reader prefers dark.

    Matplotlib puts colours into style attributes, lower case, and leaves out a black fill.
    """
    rules = "".join(
        f'[style*="{what}: {light}"]{{{what}:{dark}!important}}'
        for light, dark in DARK.items()
        for what in ("fill", "stroke")
    )
    style = f"@media(prefers-color-scheme:dark){{svg{{fill:{DARK['#000000']}}}{rules}}}"
    before, end, after = svg.partition(b"<defs>")
    assert end, "a figure without definitions"
    return b"".join((before, b"<style>", style.encode(), b"</style>", end, after))
