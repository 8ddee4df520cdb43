"""How every figure looks: one line per controller, also told apart in grey print."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NamedTuple

import matplotlib
from matplotlib.figure import Figure

from stewart_drake.fileio import replacing


class Line(NamedTuple):
    """Keyword arguments of `Axes.plot`, by `_asdict()`."""

    color: str
    linestyle: Any
    linewidth: float


# Okabe and Ito's colours, which colour-blind readers tell apart.
CONTROLLER_LINES: Final = {
    "lqr": Line("#E69F00", ":", 2.0),
    "lqi": Line("#009E73", "-.", 1.6),
    "delay_lqr": Line("#D55E00", (0, (9, 2.5)), 1.5),
    "delay_lqi": Line("#0072B2", (0, (3, 1.2)), 1.6),
    "predictor_lqi": Line("#000000", "-", 1.3),
}
REFERENCE: Final = Line("#BBBBBB", "-", 4.0)
RUN: Final = Line("#0072B2", "-", 1.5)
"""A single run."""
COMMANDED: Final = Line("#D55E00", "--", 1.0)
TRUTH: Final = Line("#D55E00", "--", 1.2)
BAND_ALPHA: Final = 0.2
"""Opacity of an uncertainty band, in the colour of its line."""

FORMATS: Final = ("png", "svg")
_RC: Final[dict[Any, Any]] = {
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


@contextmanager
def figure_style() -> Iterator[None]:
    """Matplotlib's settings for our figures, whatever the user's own are."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


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
