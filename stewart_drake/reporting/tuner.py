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

_CONSTANT: Final = Line("#888888", ":", 1.4)
_MOST_LEVELS: Final = 12
"""Largest number of target values that are drawn as boxes, not as a cloud."""


def data_document(data: xr.Dataset, summary: Mapping[str, Any]) -> Document:
    """Return how runs ended: of the grid by delay and frequency, of drawn conditions by gain."""
    grid = bool((data.disturbance.values < 0).all())
    gains = [] if grid else list(summary["g"])
    return from_template(
        "tuner_data",
        s=summary,
        grid=_grid_table(data) if grid else None,
        gains=gains,
        head="log10 w_Q/w_R" if all(name[0] in "+-" for name in gains) else "weights",
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
    regret = summary.get("loss") == "regret"
    return from_template("tuner_training", regret=regret and summary, labels=not regret and summary)


def training_figures(training: Training) -> dict[str, Figure]:
    return {"training_curve": _curve(training), "regression": _regression(training)}


def _unit(training: Training) -> str:
    return "" if training.network.output == "weights" else "ln "


def _curve(training: Training) -> Figure:
    steps, unit = np.arange(len(training.curve)), _unit(training)
    ends = (0, max(1, steps[-1]))
    constant = training.network.card["rms_error"]["test_of_a_constant"]
    curves = [
        Curve(steps, training.curve[:, 0], "training rows"),
        Curve(steps, training.curve[:, 1], "test rows", TRUTH),
        Curve(ends, [constant] * 2, "test rows, a constant", _CONSTANT),
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
    if 1 < len(levels) <= _MOST_LEVELS:
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

    A terminal shows the table by J for a family with faults, by E_ac for another one.
    """
    s, faulty = found.summary, found.family.has_faults
    networks = [name for name in found.tuners if name != RULE]
    tone: Tone = "plain"
    if faulty:
        ends = [s["gains"][one]["g"][1:] for one in networks]
        tone = "good" if all(low > 0 for low, _ in ends) else "fair"
        tone = "bad" if any(high < 0 for _, high in ends) else tone
    by_cost, by_error, failures = (*found.names, HINDSIGHT), found.names, s["candidates"]
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
        change=lambda part: f"{-100 * part:+.1f}",
        gains=lambda name: s["gains"].get(name) or {},
        by_fault_of=lambda fault: s["by_fault"][fault] or {},
        by_cost=faulty and by_cost,
        by_cost_page=not faulty and by_cost,
        by_error=not faulty and by_error,
        by_error_page=faulty and by_error,
        compared=not faulty,
        extra_failures=failures[found.names[-1]]["failures"]
        - failures[s["best_fixed"]]["failures"],
        by_fault=faulty and (*found.tuners, HINDSIGHT),
        nominal=faulty and s["nominal"].items(),
        distribution=partial(distributions, found),
        weights=partial(weights_over_time, found),
    )


def _share(gain: Sequence[float] | None) -> str:
    if gain is None:
        return ""
    value, low, high = (100 * x for x in gain)
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def _lines(found: Evaluation) -> dict[str, Line]:
    # Every second style: the best fixed gain is a solid line.
    return {name: line(2 * k + 1, marked=False) for k, name in enumerate(found.tuners)}


def _ratios(found: Evaluation) -> Array:
    return np.array([ratio_of(np.array(gain)) for gain in found.family.gains.values()])


def distributions(found: Evaluation) -> Figure:
    best, equal = found.summary["best_g"], found.names[int(np.argmin(np.abs(_ratios(found))))]
    curves = []
    for name, look in ({equal: _CONSTANT, best: Line("#000000", "-", 1.4)} | _lines(found)).items():
        J = np.sort(found.cost[found.names.index(name)])
        share = 100 * np.arange(1, len(J) + 1) / len(J)
        label = f"fixed, {name}" if name in found.family.gains else name
        curves.append(Curve(J, share, label, look, steps=True))
    return draw(
        [Panel("conditions  [%]", curves, "J  [% s]", xscale="log", ylim=(0, 100), height=2.8)]
    )


def _shown(found: Evaluation) -> dict[str, int | None]:
    """Return the condition of each panel: the first of each fault, or the first four."""
    if not found.family.has_faults:
        count = found.cost.shape[1]
        return {f"condition {i + 1}": i if i < count else None for i in range(4)}
    kinds = [fault_of(one) for one in found.family.draws]
    return {fault: kinds.index(fault) if fault in kinds else None for fault in FAULTS}


def weights_over_time(found: Evaluation) -> Figure:
    period, ratios, panels = found.family.base.controller.period, _ratios(found), []
    for title, i in _shown(found).items():
        curves = []
        if i is not None:
            taken = {name: found.ratios[name][i] for name in found.tuners}
            best = ratios[found.cost[: len(ratios), i].argmin()]
            ends = [0.0, period * max(map(len, taken.values()))]
            curves = [
                Curve(ends, [best] * 2, "best fixed there", REFERENCE),
                *(
                    Curve(period * np.arange(len(taken[name])), taken[name], name, look, steps=True)
                    for name, look in _lines(found).items()
                ),
            ]
        limits = (ratios.min() - 0.2, ratios.max() + 0.2)
        panels.append(Panel("log10 w_Q / w_R", curves, title=title, ylim=limits))
    return draw(panels, 2, sharey=True)
