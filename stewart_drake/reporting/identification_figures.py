"""Figures of an identification: what the fit leaves, and a planned motion."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from stewart_drake.identification.identify import Identification
from stewart_drake.identification.logs import KINDS
from stewart_drake.identification.plan import Plan
from stewart_drake.reporting.style import FACTORS, UNITS, WIDTH, Line, figure_style, limit
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS
from stewart_drake.types import Array

_LINES: Final = (
    Line("#0072B2", "-", 0.9),
    Line("#0072B2", (0, (4, 1.5)), 0.9),
    Line("#E69F00", "-", 0.9),
    Line("#E69F00", (0, (4, 1.5)), 0.9),
    Line("#000000", "-", 0.8),
    Line("#000000", (0, (4, 1.5)), 0.8),
)
_OF_KIND: Final = {
    "angles": [f"leg {leg}" for leg in LEGS],
    "pose": list(COORDINATE_NAMES),
    "rates": [f"d{name}/dt" for name in COORDINATE_NAMES],
}


@figure_style()
def residual_figure(found: Identification, log: int) -> Figure:
    """What the fit leaves of a log's measurements, by kind, in standard deviations."""
    kinds = [kind for kind, part in KINDS.items() if found.logs[log].measures(part)]
    figure = Figure(figsize=(WIDTH, 0.5 + 2.1 * len(kinds)), layout="constrained")
    axes = figure.subplots(len(kinds), sharex=True, squeeze=False)[:, 0]
    times, residuals = residuals_of(found, log)
    for ax, kind in zip(axes, kinds, strict=True):
        for k, label in enumerate(_OF_KIND[kind]):
            ax.plot(times, residuals[:, KINDS[kind]][:, k], label=label, **_LINES[k]._asdict())
        limit(ax, 2.0, "2 standard deviations")
        ax.axhline(-2.0, color="#8A2B0B", lw=0.9)
        ax.set_ylabel(f"{kind}  [std]")
        ax.legend(ncols=6, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes[-1].set_xlabel("time  [s]")
    return figure


def residuals_of(found: Identification, log: int) -> tuple[Array, Array]:
    """Times (n,) of a log in s, and residuals (n, 18) in standard deviations, NaN without one."""
    times, rows = [], []
    for i, segment in enumerate(found.problem.segments):
        if segment.log is not found.logs[log]:
            continue
        here = found.fit.residuals.measured[: len(segment.rows), i]
        there = np.isfinite(segment.log.values[segment.rows])
        times.append(segment.log.times[segment.rows])
        rows.append(np.where(there, here, np.nan))
    if not times:
        return np.empty(0), np.empty((0, 18))
    return np.concatenate(times), np.concatenate(rows)


@figure_style()
def motion_figure(plan: Plan) -> Figure:
    """The motion that is proposed, degrees and mm from its middle."""
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    moved = FACTORS * (plan.poses - np.median(plan.poses, axis=0))
    for k, name in enumerate(COORDINATE_NAMES):
        axes[k // 3].plot(plan.times, moved[:, k], label=name, **_LINES[2 * (k % 3)]._asdict())
    for ax, unit in zip(axes, (UNITS[0], UNITS[3]), strict=True):
        ax.set(xlabel="time  [s]", ylabel=f"from the middle  [{unit}]")
        ax.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure
