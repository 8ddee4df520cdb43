"""Figures of the Hautus and delay analyses; limits are drawn, and grey print tells lines apart."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from stewart_drake.reporting.style import (
    DATA_INK,
    DATA_PAPER,
    WIDTH,
    Line,
    figure_style,
    legend_above,
    limit,
    panels,
    plain_log_ticks,
    powers_of_ten,
)
from stewart_drake.scenario.delay import Delay
from stewart_drake.studies.delay_limits import DelayStudy
from stewart_drake.studies.delay_map import Cell
from stewart_drake.studies.hautus import HautusStudy, System
from stewart_drake.studies.verdict import HARDLY, NO

BLUE: Final = Line("#0072B2", "-", 1.5)
ORANGE: Final = Line("#D55E00", (0, (5, 1.6)), 1.5)
BLACK: Final = Line("#000000", (0, (1.2, 1.2)), 1.6)
_FAMILIES: Final = {
    "minimal chain": (BLUE, "o"),
    "paper's chain": (ORANGE, "s"),
    "chain under gravity": (BLACK, "^"),
}
_SMALLEST: Final = 1e-18
"""Margins below are drawn here: they are rounding."""


@figure_style()
def chain_figure(study: HautusStudy) -> Figure:
    """Margins of the delay chains over the delay, against the tolerance."""
    lines = {
        name: ([s.steps or 0 for s in study.family(name)], study.family(name), *look)
        for name, look in _FAMILIES.items()
    }
    figure, axes = _margins(study, lines, "delay μ  [periods]", 3.4)
    _envelope(axes[0], study)
    return legend_above(figure, axes[0])


@figure_style()
def plant_figure(study: HautusStudy) -> Figure:
    """Margins of the plant held still along the reference."""
    lines = {}
    for where, line, marker in (("without", BLUE, "o"), ("under", BLACK, "^")):
        some = [
            s
            for s in study.family("plant")
            if f"plant {where} gravity" in s.name and s.time is not None
        ]
        lines[f"{where} gravity"] = ([s.time or 0.0 for s in some], some, line, marker)
    figure, axes = _margins(study, lines, "time on the reference  [s]", 3.2)
    return legend_above(figure, axes[0])


def _margins(
    study: HautusStudy,
    lines: Mapping[str, tuple[Sequence[float], Sequence[System], Line, str]],
    over: str,
    height: float,
) -> tuple[Figure, list[Axes]]:
    """Margins of controllability and observability, against the tolerance."""
    figure, axes = panels(2, height)
    titles = {"controllable": "controllability", "observable": "observability"}
    for ax, (word, title) in zip(axes, titles.items(), strict=True):
        for label, (x, systems, line, marker) in lines.items():
            values = np.maximum([system.margins[word] for system in systems], _SMALLEST)
            ax.plot(x, values, marker=marker, ms=3.5, label=label, **line._asdict())
        tolerance = study.systems[0].reach.tolerance
        limit(ax, tolerance, f"tolerance {tolerance:g}")
        ax.set(xlabel=over, ylabel=f"margin of {title}", yscale="log")
        powers_of_ten(ax.yaxis)
    return figure, axes


@figure_style()
def growth_figure(study: DelayStudy) -> Figure:
    """The fastest pole along the reference, and what it makes of an error over a delay."""
    figure, (left, right) = panels(2, 3.2)
    time = [point.time for point in study.poles]
    left.plot(time, [p.moving for p in study.poles], label="in motion", **BLUE._asdict())
    left.plot(time, [p.held for p in study.poles], label="held still", **ORANGE._asdict())
    left.set(xlabel="time on the reference  [s]", ylabel="fastest unstable pole p  [1/s]")
    left.set_ylim(bottom=0)
    left.legend(loc="best")
    pole = max(point.moving for point in study.poles)
    longest = max(2.5 * study.eta, 0.1)
    delay = np.linspace(0, longest, 200)
    decades = np.minimum(pole * delay / np.log(10), 30)
    right.plot(delay, 10**decades, **BLUE._asdict())
    for level, word in ((HARDLY, "hardly beatable above"), (NO, "not beatable above")):
        limit(right, level, f"{word} {level:g}")
    right.axvline(study.eta, color="#666666", lw=1, ls=":")
    right.set(xlabel="delay η  [s]", ylabel="growth $e^{pη}$ at the worst instant", yscale="log")
    powers_of_ten(right.yaxis)
    right.set(xlim=(0, longest), ylim=(0.7, max(1e4, 3 * 10 ** decades.max())))
    x = study.eta + 0.02 * longest
    right.text(x, 1.0, f"this delay, {study.eta:.3g} s", color="#444444", fontsize=8)
    return figure


@figure_style()
def loop_figure(study: DelayStudy) -> Figure:
    """Peaks of S and T, and what the loop bears of wrong gains and delays, over the delay."""
    figure, axes = panels(3, 3.2)
    loops = [loop for loop in study.loops if loop.radius < 1]
    steps = [loop.steps for loop in loops]
    bare = [100 * min(m.gain_up - 1, 1 - m.gain_down) for m in loops]
    single = [
        100 * min(m.motor.gain_up - 1, 1 - m.motor.gain_down) if m.motor else np.nan for m in loops
    ]
    curves: dict[str, dict[str, list[float]]] = {
        "peak over all frequencies": {"S": [m.S.value for m in loops],
                                      "T": [m.T.value for m in loops]},
        "tolerable error of the gain  [%]": {"one motor": single, "all motors": bare},
        "tolerable error of the delay  [ms]": {"longer": [1e3 * m.later for m in loops],
                                               "shorter": [1e3 * m.earlier for m in loops]},
    }  # fmt: skip
    own = study.basis.experiment.scenario.true_delay.steps
    looks = ((BLUE, "o"), (ORANGE, "s"))
    for ax, (label, pair) in zip(axes, curves.items(), strict=True):
        for (name, values), (line, marker) in zip(pair.items(), looks, strict=True):
            ax.plot(steps, values, marker=marker, ms=3.5, label=name, **line._asdict())
        ax.axvline(own, color="#666666", lw=1, ls=":")
        ax.set(xlabel="delay μ  [periods]", ylabel=label, yscale="log")
        plain_log_ticks(ax.yaxis)
        ax.legend(loc="best")
    return figure


@figure_style()
def map_figure(study: DelayStudy) -> Figure:
    """E_ac over delay and amplitude, with the floor that the delay alone sets under it."""
    steps = sorted({cell.steps for cell in study.cells})
    factors = sorted({cell.factor for cell in study.cells})
    figure = Figure(figsize=(WIDTH, 1.2 + 0.75 * len(factors)), layout="constrained")
    ax = figure.subplots()
    for cell in study.cells:
        x, y = steps.index(cell.steps), factors.index(cell.factor)
        floor = study.floors[cell.steps] if study.floor_applies else 0.0
        _draw_cell(ax, cell, x, y, floor)
    period = study.basis.experiment.scenario.controller.period
    fraction = study.basis.experiment.scenario.true_delay.fraction
    ax.set_xticks(
        range(len(steps)), [f"{Delay(s, fraction).eta(period):.3g} s\nμ = {s}" for s in steps]
    )
    ax.set_yticks(range(len(factors)), [f"{100 * factor:.0f} %" for factor in factors])
    ax.set(xlim=(-0.5, len(steps) - 0.5), ylim=(-0.5, len(factors) - 0.5))
    ax.set(xlabel="delay", ylabel="amplitude")
    ax.grid(False)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    return figure


def _draw_cell(ax: Axes, cell: Cell, x: int, y: int, floor: float) -> None:
    done = cell.status == "completed"
    words = {
        "completed": f"{cell.error:.3g}" + (f"\nfloor {floor:.3g}" if floor else ""),
        "out_of_reach": f"out of reach\nat {cell.time:.2f} s",
        "left_workspace": f"leaves workspace\nat {cell.time:.2f} s",
        "not_run": "not run",
    }
    # What is above the floor, on a scale on which 30 % s is dark; text stays readable on it.
    shade = 0.55 * min(1.0, np.sqrt(max(0.0, cell.error - floor) / 30)) if done else 0.0
    color = (1 - shade, 1 - 0.55 * shade, 1 - 0.3 * shade) if shade > 0 else DATA_PAPER
    hatch = None if done else "////"
    box = Rectangle((x - 0.47, y - 0.45), 0.94, 0.9, fc=color, ec="#9AA3AD", hatch=hatch, lw=0.8)
    ax.add_patch(box)
    ax.text(
        x,
        y,
        words.get(cell.status, f"{cell.status.replace('_', ' ')}\nat {cell.time:.2f} s"),
        ha="center",
        va="center",
        fontsize=8,
        color=DATA_INK,
        bbox=None if done else {"fc": DATA_PAPER, "ec": "none", "pad": 1.5},
    )


def _envelope(ax: Axes, study: HautusStudy) -> None:
    """e^(-p eta) through the margin without delay: what the fastest mode leaves of it."""
    chains = study.family("chain under gravity")
    plants = [s for s in study.family("plant") if s.name == "plant under gravity, home"]
    if not chains or not plants:
        return
    pole = max(mode.eigenvalue.real for mode in plants[0].reach.modes)
    period = study.basis.experiment.scenario.controller.period
    steps = np.array([system.steps for system in chains], dtype=float)
    values = chains[0].margins["controllable"] * np.exp(-pole * period * steps)
    ax.plot(steps, values, color="#888888", lw=0.9, label="$e^{-pη}$, home under gravity")
