"""Documents and figures of the tuner: its data, its training and its evaluation."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stewart_drake.reporting.document import Document, Table, Tone, from_template, number
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import REFERENCE, RUN, TRUTH, Line, line
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.evaluation import HINDSIGHT, RULE, Evaluation
from stewart_drake.tuning.families import FAULTS, fault_of
from stewart_drake.tuning.training import Training
from stewart_drake.types import Array

_BASELINE: Final = Line("#888888", ":", 1.4)
_MAX_BOXES: Final = 12
"""Largest number of target values, each a box; with more every row is a dot."""


def data_document(data: xr.Dataset, summary: Mapping[str, Any]) -> Document:
    """Return how many runs completed, and how well.

    The table of the paper's grid is by delay and frequency, that of drawn conditions by gain.
    """
    grid = bool((data.disturbance.values < 0).all())  # -1: the condition was not drawn
    gains = [] if grid else list(summary["g"])
    return from_template(
        "tuner_data",
        s=summary,
        grid=_grid_table(data) if grid else None,
        gains=gains,
        # A gain is named by its logarithm, such as +0.5, or by its weights, such as 0.1 / 4.
        head="log10 w_Q/w_R" if all(name[0] in "+-" for name in gains) else "w_Q / w_R",
    )


def _grid_table(data: xr.Dataset) -> Table:
    done, delays = data.status.values == "completed", data.delay_steps.values
    frequencies, rows = np.unique(data.frequency.values), []
    for steps in np.unique(delays):
        rows.append([str(steps)])
        for frequency in frequencies:
            here = done & (delays == steps) & (data.frequency.values == frequency)
            errors = data.accumulated_error.values[here]
            rows[-1].append(f"{here.sum()}, {number(errors.min(initial=np.inf))}")
    return Table(("delay", *(f"{f:g}" for f in frequencies)), rows, brief=True)


def training_document(summary: Mapping[str, Any]) -> Document:
    """Return the document of a training; its template shows the part of the loss that was used."""
    regret = summary.get("loss") == "regret"
    return from_template("tuner_training", regret=regret and summary, labels=not regret and summary)


def training_figures(training: Training) -> dict[str, Figure]:
    return {"training_curve": _curve(training), "regression": _regression(training)}


def _unit(training: Training) -> str:
    """Return the prefix of w_Q and w_R, as the network puts out weights or their logarithms."""
    return "" if training.network.output == "weights" else "ln "


def _curve(training: Training) -> Figure:
    steps, unit = np.arange(len(training.curve)), _unit(training)
    ends = (0, max(1, steps[-1]))
    constant = training.network.card["rms_error"]["test_of_a_constant"]
    curves = [
        Curve(steps, training.curve[:, 0], "training rows"),
        Curve(steps, training.curve[:, 1], "test rows", TRUTH),
        Curve(ends, [constant] * 2, "test rows, a constant", _BASELINE),
    ]
    name, over = f"rms error of {unit}w_Q, {unit}w_R", "successful Levenberg-Marquardt steps"
    return draw([Panel(name, curves, over, xlim=ends, height=2.6)])


def _regression(training: Training) -> Figure:
    """Draw the spread of the network's outputs for each value of the target."""
    panels, unit = [], _unit(training)
    for k, name in enumerate(("w_Q", "w_R")):
        target, output = training.targets[:, k], training.outputs[:, k]
        ends = [target.min(), target.max()] if len(target) else [0.0, 0.0]
        panels.append(
            Panel(
                f"network, {unit}{name}",
                [Curve(ends, ends, "ideal", REFERENCE)],
                f"label, {unit}{name}",
                height=2.6,
                paint=partial(_outputs, target=target, output=output),
            )
        )
    return draw(panels, 2)


def _outputs(ax: Axes, target: Array, output: Array) -> None:
    levels = np.unique(np.round(target, 9))
    if 1 < len(levels) <= _MAX_BOXES:
        ax.boxplot(
            [output[np.abs(target - level) < 1e-6] for level in levels],
            positions=levels,
            widths=0.5 * np.diff(levels).min(),
            whis=(5, 95),
            showfliers=False,
            manage_ticks=False,
            medianprops={"color": RUN.color, "linewidth": 1.8},
        )
        label = "output on the test rows: median, quartiles, 5 to 95 %"
        ax.plot([], [], color=RUN.color, label=label)
    else:
        ax.plot(target, output, ".", ms=2, color=RUN.color, label="output on the test rows")


def evaluation_document(found: Evaluation) -> Document:
    """Return tables of the candidates by J and by E_ac, and figures.

    A terminal shows the table by J for a family with faults, by E_ac for another one; a page shows
    both. The template leaves out a table whose rows are False.
    """
    s, faulty = found.summary, found.family.has_faults
    networks = [name for name in found.tuners if name != RULE]
    tone: Tone = "plain"
    if faulty:  # 95 % intervals of the reduction of g
        intervals = [s["gains"][one]["g"][1:] for one in networks]
        tone = "good" if all(low > 0 for low, _ in intervals) else "fair"
        tone = "bad" if any(high < 0 for _, high in intervals) else tone
    by_cost, by_error = (*found.names, HINDSIGHT), found.names
    failures = {name: one["failures"] for name, one in s["candidates"].items() if name in by_error}
    return from_template(
        "tuner_evaluation",
        tone,
        s=s,
        faulty=faulty,
        family=found.family.name,
        networks=networks,
        names=found.names,
        rule=RULE in found.names,
        faults=FAULTS,
        head="log10 w_Q/w_R" if faulty else "w_Q / w_R",
        share=_share,
        change=lambda part: f"{round(-100 * part, 1) + 0.0:+.1f}",  # without -0
        gains=lambda name: s["gains"].get(name) or {},
        by_fault_of=lambda fault: s["by_fault"][fault] or {},
        by_cost=faulty and by_cost,
        by_cost_page=not faulty and by_cost,
        by_error=not faulty and by_error,
        by_error_page=faulty and by_error,
        compared=not faulty,
        extra_failures=failures[found.names[-1]] - failures[s["best_fixed"]],
        by_fault=faulty and (*found.tuners, HINDSIGHT),
        nominal=faulty and s["nominal"].items(),
        distribution=partial(distributions, found),
        weights=partial(weights_over_time, found),
    )


def _share(interval: Sequence[float] | None) -> str:
    """Return a share (value, low, high) in percent."""
    if interval is None:
        return ""
    value, low, high = (round(100 * x) + 0.0 for x in interval)  # without -0
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def _lines(found: Evaluation) -> dict[str, Line]:
    # Every second style, as the first is that of the best fixed gain: a solid line.
    return {name: line(2 * k + 1, marked=False) for k, name in enumerate(found.tuners)}


def _ratios(found: Evaluation) -> Array:
    """Return log10(w_Q / w_R) of the fixed gains."""
    return np.array([ratio_of(np.array(gain)) for gain in found.family.gains.values()])


def distributions(found: Evaluation) -> Figure:
    """Draw the distribution of J of the tuners, the best fixed gain and that of equal weights."""
    best, equal = found.summary["best_g"], found.names[int(np.argmin(np.abs(_ratios(found))))]
    curves = []
    for name, look in ({equal: _BASELINE, best: Line("#000000", "-", 1.4)} | _lines(found)).items():
        J = np.sort(found.cost[found.names.index(name)])
        share = 100 * np.arange(1, len(J) + 1) / len(J)
        label = f"fixed, {name}" if name in found.family.gains else name
        curves.append(Curve(J, share, label, look, steps=True))
    return draw(
        [Panel("conditions  [%]", curves, "J  [% s]", xscale="log", ylim=(0, 100), height=2.8)]
    )


def _shown(found: Evaluation) -> dict[str, int]:
    """Return the condition of each panel: the first of each fault, or the first four."""
    if not found.family.has_faults:
        return {f"condition {i + 1}": i for i in range(min(4, found.cost.shape[1]))}
    kinds = [fault_of(one) for one in found.family.draws]
    return {fault: kinds.index(fault) for fault in FAULTS if fault in kinds}


def weights_over_time(found: Evaluation) -> Figure:
    period, ratios, panels = found.family.base.controller.period, _ratios(found), []
    for title, i in _shown(found).items():
        best = ratios[found.cost[: len(ratios), i].argmin()]
        longest = max(len(found.ratios[name][i]) for name in found.tuners)
        curves = [Curve([0.0, period * longest], [best] * 2, "best fixed there", REFERENCE)]
        for name, look in _lines(found).items():
            used = found.ratios[name][i]
            curves.append(Curve(period * np.arange(len(used)), used, name, look, steps=True))
        limits = (ratios.min() - 0.2, ratios.max() + 0.2)
        panels.append(Panel("log10 w_Q / w_R", curves, title=title, ylim=limits))
    return draw(panels, 2, sharey=True)
