"""Tables of the tuner's data set, training and evaluation, for a terminal of 80 columns."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from stewart_drake.report.tables import number, rows, wrap
from stewart_drake.tuning.evaluation import TUNER, Evaluation
from stewart_drake.tuning.labels import cells


def dataset_table(dataset: xr.Dataset) -> str:
    """How the runs of each delay and frequency ended; of many cells, all in one line."""
    valid = int(dataset.valid.sum())
    size = dataset.sizes["run"] * dataset.sizes["sample"]
    done = dataset.status.values == "completed"
    lines = [
        wrap(
            f"{dataset.sizes['run']} runs, {size} rows of which {valid} valid; "
            f"{int((~done).sum())} runs ended early"
        )
    ]
    if (dataset.disturbance.values < 0).all():
        frequencies = np.unique(dataset.frequency.values)
        lines += [
            "completed of nine, and the least E_ac in % s, at a frequency in rad/s of",
            f"{'delay':<8}" + "".join(f"{f:>16g}" for f in frequencies),
        ]
        for steps in np.unique(dataset.delay_steps.values):
            line = f"{steps:<8d}"
            for frequency in frequencies:
                here = (dataset.delay_steps.values == steps) & (
                    dataset.frequency.values == frequency
                )
                errors = dataset.accumulated_error.values[here & done]
                least = number(errors.min()) if len(errors) else "-"
                line += f"{f'{(here & done).sum()}, {least}':>16}"
            lines.append(line)
    else:
        groups = cells(dataset)
        alive = sum(bool(done[members].any()) for members in groups)
        lines.append(f"{len(groups)} conditions, in {alive} of them at least one run completed")
    return "\n".join(lines)


def training_table(summary: Mapping[str, Any]) -> str:
    """What was trained on what, and the errors."""
    error, used = summary["rms_error"], summary["rows"]
    correlation = ", ".join(
        f"{name} {number(value, 2)}" for name, value in summary["correlation"].items()
    )
    end = "converged" if summary["converged"] else "stopped"
    return rows(
        {
            "labels": f"{summary['labels']}, split by {summary['split']}, seed {summary['seed']}",
            "rows": f"{used['labelled']} labelled, {used['trained_on']} trained on, "
            f"{used['tested_with']} tested with",
            "rms error": f"training {number(error['train'])}, test {number(error['test'])}, "
            f"test of a constant {number(error['test_of_a_constant'])} (of {summary['output']})",
            "correlation": f"{correlation} on the test rows",
            "training": f"{end} after {summary['evaluations']} evaluations",
        }
    )


def evaluation_table(evaluation: Evaluation) -> str:
    """Table of the candidates, and the verdict on the tuner."""
    s = evaluation.summary
    drawn = evaluation.error.shape[1]
    lines = [
        f"{'w_Q / w_R':<14}{'failures':>10}{'mean E_ac':>12}{'95 % interval':>20}{'worst':>10}",
    ]
    for name in evaluation.candidates:
        one = s["candidates"][name]
        low, high = one["interval"]
        mark = " *" if name == s["best_fixed"] else ""
        lines.append(
            f"{name + mark:<14}{one['failures']:>10}{number(one['mean']):>12}"
            f"{f'{number(low)} to {number(high)}':>20}{number(one['worst']):>10}"
        )
    low, high = (-100 * x for x in reversed(s["improvement_interval"]))
    extra = s["candidates"][TUNER]["failures"] - s["candidates"][s["best_fixed"]]["failures"]
    lines.append(
        wrap(
            f"E_ac in % s over the {s['common']} of {drawn} scenarios that all complete; * best "
            f"fixed gain. Against it the tuner's mean is {-100 * s['improvement']:+.1f} % (95 %: "
            f"{low:+.1f} to {high:+.1f}), with {extra:+d} failures; that of the best gain of each "
            f"scenario, picked in hindsight, {-100 * s['hindsight']:+.1f} %."
        )
    )
    return "\n".join(lines)
