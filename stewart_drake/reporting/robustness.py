"""Document and figures of a robustness study."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.reporting.document import Document, Table, from_template, number
from stewart_drake.reporting.panels import Curve, Panel, draw, limit
from stewart_drake.reporting.style import LIMIT, RUN, TRUTH
from stewart_drake.studies.robustness import (
    QUANTILES,
    Influence,
    RobustnessStudy,
    factor_values,
    factors,
    unit_of,
)
from stewart_drake.studies.statistics import (
    SIGNIFICANT,
    Correlation,
    Interval,
    Pair,
    Separation,
    runs_to_bound,
    wilson_interval,
)
from stewart_drake.studies.uncertainty import MACHINE
from stewart_drake.types import Array

_GOOD, _FAIR = 0.99, 0.9
"""Smallest lower bound of the success rate for a good and a fair verdict."""
_WORST: Final = 10
"""Rows of the table of the worst runs."""
_FEW: Final = 3
"""Fewest failures that are compared with the other runs, and whose times are drawn."""
_ENOUGH: Final = 10
"""Fewest failing and other runs from which causes are named. With fewer, Holm's correction still
limits false causes, but the causes found change from seed to seed."""
_NAMED: Final = 3
"""Number of quantities, or pairs, in a sentence."""
_GREY: Final = "#666666"
# Colours of points in a bitmap, readable on light and dark pages.
_SUCCESS, _ABOVE, _FAILED = "#2F86C6", "#E69F00", "#C4502A"


def document(study: RobustnessStudy) -> Document:
    influences, found, low = study.influences(), study.explanation, study.success.low
    early = sum(one.status != "completed" for one in study.outcomes)
    errors = [one for one in influences if one.error_p < SIGNIFICANT]
    errors.sort(key=lambda one: -abs(one.error.rho))
    return from_template(
        "robustness",
        "good" if low >= _GOOD else "fair" if low >= _FAIR else "bad",
        study=study,
        sc=study.experiment.scenario,
        found=found,
        significant=SIGNIFICANT,
        named=_NAMED,
        title=title,
        percent=_percent,
        ended=_failed,
        rank=_rank,
        third=_third,
        where=_where,
        spans=_spans(study),
        enough=_ENOUGH,
        to_bound=runs_to_bound,
        fewer=min(found.failing, found.others),
        errors=_errors(study),
        usual=1e3 * Tolerances().lengths,
        share=Tolerances().lengths / float(study.experiment.mechanism.crank_lengths.mean()),
        singles=found.failing >= _FEW and found.singles,
        pairs=found.failing >= _FEW and found.pairs,
        kept=lambda one: int(np.sum(~one.failed)),
        strong=[title(one.factor) for one in found.found],
        for_error=list(dict.fromkeys(title(one.factor.strip("|")) for one in errors))
        if found.others >= _ENOUGH
        else [],
        others=study.also and {"as asked": study, **study.also}.items(),
        quantiles=[(q, study.quantile(q)) for q in QUANTILES],
        distribution_figure=partial(distribution_figure, study),
        influences=influences,
        influence_figure=partial(influence_figure, influences),
        runs_figure=partial(runs_figure, study),
        reasons=[_reason(study, *one) for one in study.reasons.items()],
        times_figure=early >= _FEW and partial(times_figure, study),
        ranges=factors(study.draws),
        vary=", ".join(
            f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}"
            for name, value in dataclasses.asdict(study.ranges).items()
        ),
        worst=_worst_table(study),
    )


def _errors(study: RobustnessStudy) -> dict[str, float]:
    """Return the largest drawn errors of lengths in mm and of the delay in ms."""
    values = factor_values(study.draws)
    return {name: float(np.abs(values[name]).max()) for name in ("lengths", "delay")}


def title(factor: str) -> str:
    """Return the name of a varied quantity, in bars if `factor` is its absolute value."""
    name = MACHINE[factor.strip("|")].title
    return f"|{name}|" if factor.startswith("|") else name


def _percent(share: Interval) -> str:
    value, low, high = (f"{100 * part:.1f}" for part in (share.value, share.low, share.high))
    return f"{value} % (95 % interval {low} to {high} %)"


def _failed(error: float) -> str:
    """Return an E_ac in % s as text; it is infinite for a run that failed."""
    return "failed" if error == math.inf else number(error)


def _rank(one: Correlation, p: float) -> tuple[str, str, str]:
    """Return a rank correlation (with a star if significant), its interval, and p as texts."""
    if math.isnan(one.rho):
        return "-", "-", "-"
    mark = "* " if p < SIGNIFICANT else ""
    return f"{mark}{one.rho:+.2f}", f"{one.low:+.2f} to {one.high:+.2f}", f"{p:.2g}"


def _reason(study: RobustnessStudy, reason: str, runs: int) -> dict[str, Any]:
    """Return one reason of failures: number and share of runs, median time in s, runs by leg."""
    own = [one for one in study.outcomes if study.reason_of(one) == reason]
    times = [one.time for one in own if math.isfinite(one.time)]
    legs = sorted(one.leg for one in own if one.leg is not None)
    return {
        "reason": reason,
        "runs": runs,
        "share": wilson_interval(runs, len(study.outcomes)),
        "time": float(np.median(times)) if times else math.nan,
        "legs": {leg: legs.count(leg) for leg in legs},
    }


def _third(one: Separation) -> str:
    """Return the outer third of a quantity's values, on the side of the failing runs."""
    return f"{'from' if one.larger else 'up to'} {number(one.bound)} {unit_of(one.factor)}"


def _where(one: Pair) -> str:
    """Return where two quantities together make runs fail, such as `large a with small b`."""
    a, b = map(title, one.factors)
    text = f"{one.sides[0]} {a} with {one.sides[1]} {b}"
    return f"{text}, or just the opposite" if one.opposite else text


def _spans(study: RobustnessStudy) -> dict[str, str]:
    """Return the range of the drawn values of each quantity; empty for absolute values."""
    values, units = factor_values(study.draws), factors(study.draws)
    return {
        name: f"{_span(float(x.min()), float(x.max()))} {units[name]}" if name in units else ""
        for name, x in values.items()
    }


def _span(low: float, high: float) -> str:
    if math.isinf(high):
        return "no"  # torque limit
    if low == high:
        return f"always {number(low)}"
    decimals = max(0, 1 - math.floor(math.log10(max(abs(low), abs(high)))))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def _worst_table(study: RobustnessStudy) -> Table:
    values, units = factor_values(study.draws), factors(study.draws)
    order = np.argsort(np.where(np.isnan(study.errors), np.inf, study.errors), kind="stable")[::-1]
    rows = []
    for i in order[:_WORST].tolist():
        one = study.outcomes[i]
        done = number(one.error) if one.status == "completed" else f"ends at {one.time:.2f} s"
        rows.append((str(i), done, *(f"{values[name][i]:.3g}" for name in units)))
    return Table(
        ("run", "E_ac, % s", *(f"{title(name)}, {unit}" for name, unit in units.items())), rows
    )


def distribution_figure(study: RobustnessStudy) -> Figure:
    errors, total = np.sort(study.errors[np.isfinite(study.errors)]), len(study.outcomes)
    counts = np.arange(1, len(errors) + 1)
    bounds = [wilson_interval(int(n), total) for n in counts]
    low, high = (np.array([100 * getattr(b, end) for b in bounds]) for end in ("low", "high"))

    def paint(ax: Axes) -> None:
        if len(errors) < total:
            share = 100 * len(errors) / total
            text = f"{total - len(errors)} of {total} runs did not complete"
            limit(ax, share, text, below=share > 50)
        if np.isfinite(study.undisturbed.error):
            ax.axvline(study.undisturbed.error, label="undisturbed run", **TRUTH._asdict())
        if study.limit is not None:
            ax.axvline(study.limit, color=LIMIT.color, ls=":", label="limit")

    band = (low, high, "95 % interval")
    curve = Curve(errors, 100 * counts / total, "all runs", steps=True, band=band)
    name, over = "share of all runs  [%]", "accumulated error E_ac  [% s]"
    how: Any = {"xscale": "log", "ylim": (0, 103), "height": 2.7}
    return draw([Panel(name, [curve], over, paint=paint, **how)])


def influence_figure(influences: Sequence[Influence]) -> Figure:
    shown = {
        "rank correlation with E_ac, completed runs": [(i.error, i.error_p) for i in influences]
    }
    if any(np.isfinite(one.failure.rho) for one in influences):
        failures = [(one.failure, one.failure_p) for one in influences]
        shown["rank correlation with failing, all runs"] = failures
    names = [title(one.factor) for one in influences]
    panels = [
        Panel(
            "",
            x=label,
            xlim=(-1, 1),
            ylim=(len(names) - 0.5, -0.5),
            height=0.5 + 0.27 * len(names),
            paint=partial(_draw_correlations, found=found, names=names),
        )
        for label, found in shown.items()
    ]
    return draw(panels, len(panels), sharey=True)


def _draw_correlations(
    ax: Axes, found: Sequence[tuple[Correlation, float]], names: Sequence[str]
) -> None:
    ax.axvline(0, color=_GREY, lw=0.8)
    for row, (one, p) in enumerate(found):
        if np.isnan(one.rho):
            ax.text(0.02, row, "not asked", va="center", fontsize=8, color=_GREY)
            continue
        significant = p < SIGNIFICANT
        color = RUN.color if significant else _GREY
        ax.plot([one.low, one.high], [row, row], color=color, lw=1.8 if significant else 1.0)
        ax.plot(one.rho, row, "o", ms=6, mec=color, mfc=color if significant else "white")
    ax.set_xticks((-1, -0.5, 0, 0.5, 1))
    ax.set_yticks(range(len(names)), names)


def runs_figure(study: RobustnessStudy) -> Figure:
    """Return E_ac over each varied quantity; runs that did not complete are in a strip above."""
    units, done = factors(study.draws), np.isfinite(study.errors)
    low, high = _log_range(study.errors[done])
    strip, top = high * (high / low) ** 0.06, high * (high / low) ** 0.18
    # Marks are spread over the strip by the number of the run.
    spread = (np.arange(len(done)) * 0.618034) % 1 * 0.8 + 0.1
    y = np.where(done, study.errors, strip * (top / strip) ** spread)
    groups = {
        "success": (done & ~study.failed, "o", _SUCCESS),
        "above the limit": (done & study.failed, "s", _ABOVE),
        "did not complete": (~done, "x", _FAILED),
    }

    def paint(ax: Axes, x: Array) -> None:
        for label, (some, marker, color) in groups.items():
            if some.any() or label != "above the limit":
                edge: Any = {"linewidths": 0.9} if marker == "x" else {"edgecolors": "none"}
                look: Any = {"s": 11, "marker": marker, "color": color, "alpha": 0.75, **edge}
                ax.scatter(x[some], y[some], label=label, rasterized=True, **look)
        ax.axhspan(strip, top, color="#F1EAE6", zorder=0)
        ax.xaxis.set_major_locator(MaxNLocator(3))
        if not np.isfinite(x).all():
            ax.text(0.5, 0.5, "none", transform=ax.transAxes, ha="center", color=_GREY)

    values = factor_values(study.draws)
    panels = [
        Panel(
            "E_ac  [% s]",
            x=f"{title(name)}  [{unit}]",
            yscale="log",
            ylim=(low, top),
            height=1.9,
            paint=partial(paint, x=values[name]),
        )
        for name, unit in units.items()
    ]
    return draw(panels, 4, sharey=True)


def times_figure(study: RobustnessStudy) -> Figure:
    times = [one.time for one in study.outcomes if one.status != "completed"]
    end = study.experiment.scenario.duration

    def paint(ax: Axes) -> None:
        ax.hist(times, bins=np.linspace(0, end, 41).tolist(), color=RUN.color, ec="white", lw=0.5)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))

    name = "time at which a run ended early  [s]"
    return draw([Panel("runs", x=name, xlim=(0, end), height=1.6, paint=paint)])


def _log_range(errors: Array) -> tuple[float, float]:
    """Return ends of a logarithmic axis around the errors."""
    positive = errors[errors > 0]
    if not len(positive):
        return 0.1, 10.0
    low, high = float(positive.min()), float(positive.max())
    room = max((high / low) ** 0.05, 1.2)
    return low / room, high * room
