"""Figures of a robustness study: distribution of E_ac, what matters, every run, when it failed."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stewart_drake.reporting.style import (
    BAND_ALPHA,
    LIMIT,
    RUN,
    TRUTH,
    WIDTH,
    figure_style,
    legend_above,
    limit,
    panels,
    plain_log_ticks,
)
from stewart_drake.studies.robustness_result import (
    Influence,
    RobustnessStudy,
    factor_values,
    factors,
)
from stewart_drake.studies.statistics import Correlation, wilson_interval
from stewart_drake.types import Array

TITLES: Final = {
    "payload": "payload",
    "torque_bias": "torque bias, rms",
    "noise": "noise of the sensor",
    "torque_limit": "torque limit",
    "damping": "joint damping",
    "delay": "delay error",
    "lengths": "lengths, rms",
    "anchors": "anchors, rms",
    "coulomb": "Coulomb friction",
    "payload_position": "payload's place, rms",
    "jitter": "jitter of the delay",
    "loss": "lost on the way",
}
SIGNIFICANT: Final = 0.05
"""Adjusted p-value below which an influence counts as found."""
_ABREAST: Final = 4
"""Panels in a row."""
_SOFT: Final = "#666666"
# Of many points, which are a bitmap that a dark page cannot change: readable on both.
_SUCCESS, _ABOVE, _FAILED = "#2F86C6", "#E69F00", "#C4502A"


def title(factor: str) -> str:
    """A factor in words; |factor| is its size."""
    name = TITLES[factor.strip("|")]
    return f"|{name}|" if factor.startswith("|") else name


@figure_style()
def distribution_figure(study: RobustnessStudy) -> Figure:
    """Share of all runs with E_ac at most so large, with its interval point by point."""
    figure, (ax,) = panels(1, 3.4)
    errors, number = np.sort(study.errors[np.isfinite(study.errors)]), len(study.outcomes)
    counts = np.arange(1, len(errors) + 1)
    bounds = [wilson_interval(int(n), number) for n in counts]
    low, high = ([100 * getattr(b, end) for b in bounds] for end in ("low", "high"))
    label = "95 % interval"
    ax.fill_between(errors, low, high, step="post", color=RUN.color, alpha=BAND_ALPHA, lw=0,
                    label=label)  # fmt: skip
    ax.step(errors, 100 * counts / number, where="post", label="all runs", **RUN._asdict())
    if len(errors) < number:
        share = 100 * len(errors) / number
        text = f"{number - len(errors)} of {number} runs did not complete"
        limit(ax, share, text, below=share > 50)  # where there is room for the words
    if np.isfinite(study.undisturbed.error):
        ax.axvline(study.undisturbed.error, label="undisturbed run", **TRUTH._asdict())
    if study.limit is not None:
        ax.axvline(study.limit, color=LIMIT.color, ls=":", label="limit")
    ax.set(xscale="log", ylim=(0, 103))
    plain_log_ticks(ax.xaxis)
    ax.set(xlabel="accumulated error E_ac  [% s]", ylabel="share of all runs  [%]")
    return legend_above(figure, ax)


@figure_style()
def influence_figure(influences: Sequence[Influence]) -> Figure:
    """Rank correlations with their intervals; hollow where chance explains them."""
    some_failed = any(np.isfinite(one.failure.rho) for one in influences)
    figure, axes = panels(1 + some_failed, 1.2 + 0.27 * len(influences), sharey=True)
    names = [title(one.factor) for one in influences]
    errors = [(one.error, one.error_p) for one in influences]
    failures = [(one.failure, one.failure_p) for one in influences]
    _dots(axes[0], errors, "rank correlation with E_ac, completed runs")
    if some_failed:
        _dots(axes[1], failures, "rank correlation with failing, all runs")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    return figure


@figure_style()
def runs_figure(study: RobustnessStudy) -> Figure:
    """E_ac of every run over every drawn quantity, failures in a strip of their own on top."""
    told = factors(study.draws)
    rows = math.ceil(len(told) / _ABREAST)
    figure = Figure(figsize=(WIDTH, 2.6 * rows), layout="constrained")
    grid = figure.subplots(rows, _ABREAST, sharey=True, squeeze=False)
    axes, spare = np.split(grid.ravel(), [len(told)])
    for ax in spare:
        ax.remove()
    values, done = factor_values(study.draws), np.isfinite(study.errors)
    for ax, (name, unit) in zip(axes, told.items(), strict=True):
        x = values[name]
        kept = done & ~study.failed
        _scatter(ax, x[kept], study.errors[kept], "o", _SUCCESS, "success")
        above = done & study.failed
        if above.any():
            _scatter(ax, x[above], study.errors[above], "s", _ABOVE, "above the limit")
        ax.set(yscale="log", xlabel=f"{TITLES[name]}  [{unit}]")
        ax.xaxis.set_major_locator(MaxNLocator(3))  # room between neighbours' labels
        if not np.isfinite(x).all():
            ax.text(0.5, 0.5, "none", transform=ax.transAxes, ha="center", color=_SOFT)
    low, high = _log_range(study.errors[done])
    strip = high * (high / low) ** 0.06
    top = high * (high / low) ** 0.18
    for ax, name in zip(axes, told, strict=True):
        ax.set_ylim(low, top)
        ax.axhspan(strip, top, color="#F1EAE6", zorder=0)
        # Spread over the strip by the number of the run, so that marks do not hide each other.
        spread = (np.arange(len(done)) * 0.618034) % 1 * 0.8 + 0.1
        y = strip * (top / strip) ** spread[~done]
        _scatter(ax, values[name][~done], y, "x", _FAILED, "did not complete")
    plain_log_ticks(axes[0].yaxis)  # which all share
    for ax in grid[:, 0]:
        ax.set_ylabel("E_ac  [% s]")
    return legend_above(figure, axes[0])


@figure_style()
def times_figure(study: RobustnessStudy) -> Figure:
    """When runs ended early."""
    figure, (ax,) = panels(1, 2.2)
    times = [one.time for one in study.outcomes if one.status != "completed"]
    end = study.experiment.scenario.duration
    ax.hist(times, bins=np.linspace(0, end, 41).tolist(), color=RUN.color, ec="white", lw=0.5)
    ax.set(xlim=(0, end), xlabel="time at which a run ended early  [s]", ylabel="runs")
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _dots(ax: Axes, found: Sequence[tuple[Correlation, float]], label: str) -> None:
    ax.axvline(0, color=_SOFT, lw=0.8)
    for row, (one, p) in enumerate(found):
        if np.isnan(one.rho):
            ax.text(0.02, row, "not asked", va="center", fontsize=8, color=_SOFT)
            continue
        sure = p < SIGNIFICANT
        color = RUN.color if sure else _SOFT
        ax.plot([one.low, one.high], [row, row], color=color, lw=1.8 if sure else 1.0)
        ax.plot(one.rho, row, "o", ms=6, mec=color, mfc=color if sure else "white")
    ax.set(xlim=(-1, 1), xlabel=label, xticks=(-1, -0.5, 0, 0.5, 1))


def _scatter(ax: Axes, x: Array, y: Array, marker: str, color: str, label: str) -> None:
    style = {"linewidths": 0.9} if marker == "x" else {"edgecolors": "none"}
    ax.scatter(x, y, s=11, marker=marker, color=color, alpha=0.75, label=label, rasterized=True,
               **style)  # fmt: skip


def _log_range(errors: Array) -> tuple[float, float]:
    """Ends of a logarithmic axis around the errors that there are."""
    positive = errors[errors > 0]
    if not len(positive):
        return 0.1, 10.0
    low, high = float(positive.min()), float(positive.max())
    room = max((high / low) ** 0.05, 1.2)
    return low / room, high * room
