"""What is told of the tuner's data set, training and evaluation."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from stewart_drake.reporting.document import Block, Document, Paragraph, Section, Table, Values
from stewart_drake.reporting.words import number
from stewart_drake.tuning.evaluation import TUNER, Evaluation
from stewart_drake.tuning.labels import cells


def dataset_document(dataset: xr.Dataset) -> Document:
    """How the runs of each delay and frequency ended; of many cells, all in one line."""
    valid = int(dataset.valid.sum())
    size = dataset.sizes["run"] * dataset.sizes["sample"]
    done = dataset.status.values == "completed"
    verdict = (
        f"{dataset.sizes['run']} runs, {size} rows of which {valid} valid; {int((~done).sum())} "
        "runs ended early"
    )
    part: Block
    if (dataset.disturbance.values < 0).all():
        part = _grid_table(dataset, done)
    else:
        groups = cells(dataset)
        alive = sum(bool(done[members].any()) for members in groups)
        text = f"{len(groups)} conditions, in {alive} of them at least one run completed"
        part = Paragraph(text, brief=True)
    return Document("Data set of the tuner", verdict, [Section("", part)])


def _grid_table(dataset: xr.Dataset, done: np.typing.NDArray[np.bool_]) -> Table:
    frequencies, rows = np.unique(dataset.frequency.values), []
    for steps in np.unique(dataset.delay_steps.values):
        rows.append([str(steps)])
        for frequency in frequencies:
            here = dataset.delay_steps.values == steps
            here = done & here & (dataset.frequency.values == frequency)
            errors = dataset.accumulated_error.values[here]
            rows[-1].append(f"{here.sum()}, {number(errors.min(initial=np.inf))}")
    caption = "Completed of nine, and the least E_ac in % s, at a frequency in rad/s of"
    return Table(("delay", *(f"{f:g}" for f in frequencies)), rows, caption, brief=True)


def training_document(summary: Mapping[str, Any]) -> Document:
    """What was trained on what, and the errors."""
    error, used = summary["rms_error"], summary["rows"]
    correlation = ", ".join(
        f"{name} {number(value, 2)}" for name, value in summary["correlation"].items()
    )
    end = "converged" if summary["converged"] else "stopped"
    entries = {
        "labels": f"{summary['labels']}, split by {summary['split']}, seed {summary['seed']}",
        "rows": f"{used['labelled']} labelled, {used['trained_on']} trained on, "
        f"{used['tested_with']} tested with",
        "rms error": f"training {number(error['train'])}, test {number(error['test'])}, "
        f"test of a constant {number(error['test_of_a_constant'])} (of {summary['output']})",
        "correlation": f"{correlation} on the test rows",
        "training": f"{end} after {summary['evaluations']} evaluations",
    }
    return Document("Training of the tuner", "", [Section("", Values(entries))])


def evaluation_document(evaluation: Evaluation) -> Document:
    """Table of the candidates, and the verdict on the tuner."""
    s, rows = evaluation.summary, []
    for name in evaluation.candidates:
        one = s["candidates"][name]
        low, high = map(number, one["interval"])
        mark = " *" if name == s["best_fixed"] else ""
        rows.append((f"{name}{mark}", str(one["failures"]), number(one["mean"]),
                     f"{low} to {high}", number(one["worst"])))  # fmt: skip
    low, high = (f"{-100 * x:+.1f}" for x in reversed(s["improvement_interval"]))
    extra = s["candidates"][TUNER]["failures"] - s["candidates"][s["best_fixed"]]["failures"]
    text = (
        f"E_ac in % s over the {s['common']} of {evaluation.error.shape[1]} scenarios that all "
        f"complete; * best fixed gain. Against it the tuner's mean is "
        f"{-100 * s['improvement']:+.1f} % (95 %: {low} to {high}), with {extra:+d} failures; that "
        f"of the best gain of each scenario, picked in hindsight, {-100 * s['hindsight']:+.1f} %."
    )
    columns = ("w_Q / w_R", "failures", "mean E_ac", "95 % interval", "worst")
    section = Section("", Table(columns, rows, brief=True), Paragraph(text, brief=True))
    return Document("Evaluation of the tuner", "", [section])
