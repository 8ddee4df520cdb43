"""Style of all figures: for light and dark pages, grey print and colour-blind readers."""

import itertools
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
    LogLocator,
    MaxNLocator,
    NullFormatter,
    ScalarFormatter,
)

from stewart_drake.files.fileio import replacing
from stewart_drake.types import ArrayLike


class Line(NamedTuple):
    """Keyword arguments of `Axes.plot`, by `_asdict()`."""

    color: str
    linestyle: Any
    linewidth: float
    marker: str = ""
    markevery: Any = None
    markersize: float = 4.0


# Colours of Okabe and Ito, which colour-blind readers can distinguish.
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
COMMANDED: Final = Line("#D55E00", "--", 1.0)
TRUTH: Final = Line("#D55E00", "--", 1.2)
LIMIT: Final = Line("#8A2B0B", "-", 0.9)
MARK: Final = Line("#666666", ":", 1.1)
WIDTH: Final = 10.0  # of a figure, inches
UNITS: Final = ("deg",) * 3 + ("mm",) * 3
FACTORS: Final = np.array([180 / np.pi] * 3 + [1e3] * 3)
"""Units in which coordinates are shown, and factors from rad and m."""
BAND_ALPHA: Final = 0.2
"""Opacity of an uncertainty band, in the colour of its line."""

DATA_INK: Final = "#111111"
DATA_PAPER: Final = "#FDFDFD"
"""Text and background of fields with a colour scale, which stay as they are on a dark page."""
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
"""Colours on a dark page of lines and letters; all other colours are data and stay."""

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


TORQUES: Final = {"N m": 1.0, "mN m": 1e3, "µN m": 1e6}
POWERS: Final = {"W": 1.0, "mW": 1e3, "µW": 1e6}
"""Units to choose from, with their factors; see `unit_for`."""


def line(k: int, *, marked: bool = True, width: float = 1.5) -> Line:
    """Return the style of curve k, distinct by dash or marker in grey print.

    A `marked` curve has few points, each with a marker. Of the others, the sixth and later ones
    have ten markers along the curve.
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
    """Return a line per controller; those that are not shipped get the next free styles."""
    others = (line(k, marked=False, width=1.3) for k in itertools.count(len(_DASHES)))
    return {name: CONTROLLER_LINES.get(name) or next(others) for name in names}


@contextmanager
def figure_style() -> Iterator[None]:
    """Use the package's settings of Matplotlib, not the user's."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


class _RoundTicks(LogLocator):
    """Ticks at 1, 2 and 5; evenly spaced on an axis of less than a decade."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        narrow = max(vmin, vmax) < 10 * min(vmin, vmax)
        return MaxNLocator(5).tick_values(vmin, vmax) if narrow else super().tick_values(vmin, vmax)


def unit_for(values: ArrayLike, choice: Mapping[str, float]) -> tuple[str, float]:
    """Return the first unit in which the values reach 0.1, else the last, and its factor."""
    largest = np.nanmax(np.abs(values), initial=0.0)
    return next((one for one in choice.items() if one[1] * largest > 0.1), [*choice.items()][-1])


def plain_log_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers such as 20 and 50."""
    axis.set_major_locator(_RoundTicks(subs=(1, 2, 5)))
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_formatter(NullFormatter())


def powers_of_ten(axis: Axis) -> None:
    """Label a logarithmic axis with 10⁻³ and so on, as text: formulas take ten times as long."""
    axis.set_major_formatter(_power_of_ten)
    axis.set_minor_formatter(NullFormatter())


_RAISED: Final = str.maketrans("-−0123456789", "⁻⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power_of_ten(value: float, _: float) -> str:
    return "10" + f"{round(np.log10(value))}".translate(_RAISED)


class PlainNumbers(ScalarFormatter):
    """Numbers with a common power of ten above the axis, as text: see `powers_of_ten`."""

    def __init__(self) -> None:
        super().__init__(useOffset=False)
        self.set_powerlimits((-2, 4))

    def get_offset(self) -> str:
        _, _, power = super().get_offset().partition("e")
        return f"×10{power.translate(_RAISED)}" if power else ""


def write_figures(figures: Mapping[str, Figure], directory: str | Path) -> list[Path]:
    """Write each figure as NAME.png and NAME.svg; the same figure gives the same bytes."""
    paths = []
    with figure_style():
        for (name, figure), suffix in itertools.product(figures.items(), ("png", "svg")):
            paths.append(Path(directory) / f"{name}.{suffix}")
            metadata = {"Date": None} if suffix == "svg" else None
            with replacing(paths[-1]) as partial:
                figure.savefig(partial, format=suffix, metadata=metadata)
    return paths


def for_dark_too(svg: str) -> str:
    """Return an SVG of Matplotlib with the colours of `DARK` for readers who prefer dark.

    Matplotlib writes colours into style attributes, in lower case, and leaves out a black fill.
    """
    rules = "".join(
        f'[style*="{what}: {light}"]{{{what}:{dark}!important}}'
        for light, dark in DARK.items()
        for what in ("fill", "stroke")
    )
    style = f"@media(prefers-color-scheme:dark){{svg{{fill:{DARK['#000000']}}}{rules}}}"
    before, end, after = svg.partition("<defs>")
    assert end, "a figure without definitions"
    return f"{before}<style>{style}</style>{end}{after}"
