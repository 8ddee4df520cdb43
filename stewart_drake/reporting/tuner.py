"""Documents and figures of the tuner: its data, its training and its evaluation."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from stewart_drake.reporting.document import (
    Block,
    Document,
    Paragraph,
    Picture,
    Section,
    Table,
    Tone,
    Values,
    number,
)
from stewart_drake.reporting.panels import Curve, Panel, draw
from stewart_drake.reporting.style import REFERENCE, RUN, TRUTH, Line, line, write_figures
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.evaluation import HINDSIGHT, RULE, Evaluation
from stewart_drake.tuning.families import FAULTS, fault_of
from stewart_drake.tuning.training import Training
from stewart_drake.types import Array

_CONSTANT: Final = Line("#888888", ":", 1.4)
_MOST_LEVELS: Final = 12
"""Targets of more different values are shown as a cloud rather than as boxes."""
_PANELS: Final = 4
_HOW: Final = (
    "J is E_ac up to the end plus 50 % s for each second without a plate; g its geometric mean, m "
    "its mean. Below best: by how much g is below that of the best fixed gain of these very "
    "conditions, m below that of the best by m; below rule: g below the rule's. 95 % by a paired "
    "bootstrap over conditions. Hindsight is the best fixed gain of each condition."
)


# ---------------------------------------------------------------- data and training


def data_document(data: xr.Dataset, summary: Mapping[str, Any]) -> Document:
    """Return how runs ended: of the grid by delay and frequency, of drawn conditions by gain."""
    verdict = (
        f"{summary['runs']} runs, {summary['rows']} rows of which {summary['valid_rows']} valid; "
        f"{len(summary['failed_runs'])} runs ended early"
    )
    part: Block
    if (data.disturbance.values < 0).all():
        part = _grid_table(data)
    else:
        verdict += (
            f"; {summary['conditions']} conditions, with the best gain of each g is "
            f"{number(summary['hindsight'])} % s"
        )
        rows = [
            (name, str(summary["completed"][name]), number(g)) for name, g in summary["g"].items()
        ]
        ratios = all(name[0] in "+-" for name in summary["g"])
        head = "log10 w_Q/w_R" if ratios else "weights"
        part = Table((head, "completed", "g"), rows, brief=True)
    return Document("Data set of the tuner", verdict, [Section("", part)])


def _grid_table(data: xr.Dataset) -> Table:
    done, delays = data.status.values == "completed", data.delay_steps.values
    frequencies, rows = np.unique(data.frequency.values), []
    for steps in np.unique(delays):
        rows.append([str(steps)])
        for frequency in frequencies:
            here = done & (delays == steps) & (data.frequency.values == frequency)
            errors = data.accumulated_error.values[here]
            rows[-1].append(f"{here.sum()}, {number(errors.min(initial=np.inf))}")
    caption = "Completed of nine, and the least E_ac in % s, at a frequency in rad/s of"
    return Table(("delay", *(f"{f:g}" for f in frequencies)), rows, caption, brief=True)


def training_document(summary: Mapping[str, Any]) -> Document:
    """Return what was trained on what, and the errors."""
    entries = _regret(summary) if summary.get("loss") == "regret" else _labels(summary)
    return Document("Training of the tuner", "", [Section("", Values(entries))])


def _labels(summary: Mapping[str, Any]) -> dict[str, str]:
    error, used = summary["rms_error"], summary["rows"]
    correlation = ", ".join(f"{name} {number(r, 2)}" for name, r in summary["correlation"].items())
    end = "converged" if summary["converged"] else "stopped"
    return {
        "labels": f"{summary['labels']}, split by {summary['split']}, seed {summary['seed']}",
        "rows": f"{used['labelled']} labelled, {used['trained_on']} trained on, "
        f"{used['tested_with']} tested with",
        "rms error": f"training {number(error['train'])}, test {number(error['test'])}, "
        f"test of a constant {number(error['test_of_a_constant'])} (of {summary['output']})",
        "correlation": f"{correlation} on the test rows",
        "training": f"{end} after {summary['evaluations']} evaluations",
    }


def _regret(summary: Mapping[str, Any]) -> dict[str, str]:
    held = summary["held_out_J"]
    first, second, fixed, hindsight = map(
        number, (*held["rounds"], held["best_fixed"], held["hindsight"])
    )
    return {
        "conditions": f"{summary['conditions']}, {summary['held_out']} of them held out",
        "g held out": f"round 1 {first}, round 2 {second}, best fixed {fixed}, hindsight "
        f"{hindsight}",
        "kept": f"round {summary['round']}",
    }


def training_figures(training: Training, directory: str | Path) -> list[Path]:
    """Write the training curve and the regression plot, as PNG and SVG, and return their paths.

    Raises:
        OSError: the directory cannot be written to.
    """
    figures = {"training_curve": _curve(training), "regression": _regression(training)}
    return write_figures(figures, directory)


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
    """Draw for each value of the target the spread of the network's answers."""
    panels, unit = [], _unit(training)
    for k, name in enumerate(("w_Q", "w_R")):
        target, output = training.targets[:, k], training.outputs[:, k]
        ends = [target.min(), target.max()] if len(target) else [0.0, 0.0]
        panels.append(
            Panel(
                f"network, {unit}{name}",
                [Curve(ends, ends, "right answer", REFERENCE)],
                f"label, {unit}{name}",
                height=2.6,
                paint=partial(_answers, target=target, output=output),
            )
        )
    return draw(panels, 2)


def _answers(ax: Axes, target: Array, output: Array) -> None:
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
        label = "answers to the test rows: median, quartiles, 5 to 95 %"
        ax.plot([], [], color=RUN.color, label=label)
    else:
        ax.plot(target, output, ".", ms=2, color=RUN.color, label="answers to the test rows")


# ---------------------------------------------------------------- evaluation


def evaluation_document(found: Evaluation) -> Document:
    """Return tables of the candidates by J and by E_ac, and figures.

    A terminal shows those by J of a family with faults, those by E_ac of another one.
    """
    faulty, name = found.family.has_faults, found.family.name
    sections = [
        Section("Candidates", _by_cost(found), Paragraph(_HOW)),
        Section("Where all complete", _by_error(found), Paragraph(_error_text(found), not faulty)),
    ]
    if faulty:
        sections += [
            Section("By fault", _faults(found)),
            Section("Price where nothing is wrong", _nominal(found)),
        ]
    shares = "Share of the conditions whose J is at most so much; further left is better."
    shown = "One run for each fault." if faulty else "The first conditions."
    shown += " Grey: the fixed ratio that is best there."
    sections += [
        Section("Distribution", Picture(partial(distributions, found), shares)),
        Section("Weights over time", Picture(partial(weights_over_time, found), shown)),
    ]
    if not faulty:
        return Document("Evaluation of the tuner", "", sections)
    s, networks = found.summary, [name for name in found.tuners if name != RULE]
    told = [
        f"{one} is {_share(s['gains'][one]['g'])} below the best fixed gain, {s['best_g']}"
        for one in networks
    ]
    verdict = f"{'; '.join(told)} ({s['conditions']} conditions {name})"
    ends = [s["gains"][one]["g"][1:] for one in networks]
    tone: Tone = "good" if all(low > 0 for low, _ in ends) else "fair"
    if any(high < 0 for _, high in ends):
        tone = "bad"
    return Document(f"Evaluation of a tuner, family {name}", verdict, sections, tone)


def _share(gain: Sequence[float]) -> str:
    value, low, high = (100 * x for x in gain)
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def _by_cost(found: Evaluation) -> Table:
    s, rows = found.summary, []
    measures = ("g", "m", "rule") if RULE in found.names else ("g", "m")
    for name in (*found.names, HINDSIGHT):
        one, gains = s["candidates"][name], s["gains"].get(name)
        marks = "".join(f" {m}" for m in ("g", "m") if s[f"best_{m}"] == name)
        shares = [_share(gains[key]) if gains else "" for key in measures]
        label = f"{name}{marks and ' best' + marks}"
        rows.append((label, str(one["completed"]), number(one["g"]), number(one["m"]), *shares))
    below = ("g below best", "m below best", "below rule")[: len(measures)]
    return Table((_head(found), "completed", "g", "m", *below), rows, brief=found.family.has_faults)


def _by_error(found: Evaluation) -> Table:
    s, rows = found.summary, []
    for name in found.names:
        one = s["candidates"][name]
        low, high = map(number, one["interval"])
        label = f"{name} *" if name == s["best_fixed"] else name
        mean, worst = number(one["mean"]), number(one["worst"])
        rows.append((label, str(one["failures"]), mean, f"{low} to {high}", worst))
    columns = (_head(found), "failures", "mean E_ac", "95 % interval", "worst")
    return Table(columns, rows, brief=not found.family.has_faults)


def _error_text(found: Evaluation) -> str:
    s, tuner = found.summary, found.names[-1]
    low, high = (f"{-100 * x:+.1f}" for x in reversed(s["improvement_interval"]))
    extra = s["candidates"][tuner]["failures"] - s["candidates"][s["best_fixed"]]["failures"]
    return (
        f"E_ac in % s over the {s['common']} of {s['conditions']} conditions that all complete; "
        f"* best fixed gain. Against it the mean of {tuner} is {-100 * s['improvement']:+.1f} % "
        f"(95 %: {low} to {high}), with {extra:+d} failures; that of the best gain of each "
        f"condition, picked in hindsight, {-100 * s['hindsight']:+.1f} %."
    )


def _head(found: Evaluation) -> str:
    return "log10 w_Q/w_R" if found.family.has_faults else "w_Q / w_R"


def _faults(found: Evaluation) -> Table:
    s = found.summary
    rows = [
        (name, *(_share(s["by_fault"][f][name]) if s["by_fault"][f] else "" for f in FAULTS))
        for name in (*found.tuners, HINDSIGHT)
    ]
    caption = f"g below that of {s['best_g']}, under the conditions of each fault."
    return Table(("", *FAULTS), rows, caption, brief=True)


def _nominal(found: Evaluation) -> Table:
    rows = [
        (name, number(one["on_reference"]), number(one["from_rest"]))
        for name, one in found.summary["nominal"].items()
    ]
    caption = "E_ac in % s of `paper` as it is; default is w_Q = w_R = 1."
    return Table(("", "on the reference", "from rest"), rows, caption, brief=True)


def _lines(found: Evaluation) -> dict[str, Line]:
    # Every second look: the best fixed gain is a solid line.
    return {name: line(2 * k + 1, marked=False) for k, name in enumerate(found.tuners)}


def _ratios(found: Evaluation) -> Array:
    """Return log10(w_Q / w_R) of the fixed gains."""
    return np.array([ratio_of(np.array(gain)) for gain in found.family.gains.values()])


def distributions(found: Evaluation) -> Figure:
    """Draw the share of the conditions below each J: equal weights, the best gain, the tuners."""
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
        return {f"condition {i + 1}": i if i < count else None for i in range(_PANELS)}
    kinds = [fault_of(one) for one in found.family.draws]
    return {fault: kinds.index(fault) if fault in kinds else None for fault in FAULTS}


def weights_over_time(found: Evaluation) -> Figure:
    """Draw log10(w_Q / w_R) over the samples in some conditions."""
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
