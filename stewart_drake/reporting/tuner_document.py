"""Documents on the tuner's data set and training."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from stewart_drake.reporting.document import Block, Document, Section, Table, Values
from stewart_drake.reporting.words import number


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
    correlation = ", ".join(
        f"{name} {number(value, 2)}" for name, value in summary["correlation"].items()
    )
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
    return {
        "conditions": f"{summary['conditions']}, {summary['held_out']} of them held out",
        "g held out": f"round 1 {number(held['rounds'][0])}, round 2 {number(held['rounds'][1])}, "
        f"best fixed {number(held['best_fixed'])}, hindsight {number(held['hindsight'])}",
        "kept": f"round {summary['round']}",
    }
