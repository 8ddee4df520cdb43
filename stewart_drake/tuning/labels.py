"""What a tuner is told to answer: the labels of a data set.

K of (43) depends on w_Q / w_R alone: P of (44) scales with both. Pairs of one ratio are therefore
one gain, and (0.1, 0.1), (1, 1) and (4, 4) one answer. A best gain is written with w_Q w_R = 1.
"""

from typing import Any, Final, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.types import Array

Labels = Literal["as_run", "best_in_cell", "best_in_cell_torque"]
LABELS: Final = ("as_run", "best_in_cell", "best_in_cell_torque")


def labels(dataset: xr.Dataset, kind: Labels) -> Array:
    """The weights (run, 2) that the rows of each run are labelled with.

    Args:
        dataset: as `load_dataset` returns it.
        kind: `as_run`, the weights that the run used, as the paper has it; `best_in_cell`, those of
            least E_ac among the runs of the same delay, frequency and disturbance, w_Q w_R = 1;
            `best_in_cell_torque`, the same of least E_ac + rms torque, each relative to its least
            in the cell.

    Returns:
        w_Q and w_R; NaN where no run of the cell completed, so that nothing is best.
    """
    weights = np.array(dataset.weights.values, dtype=np.float64)
    if kind == "as_run":
        return weights
    result = np.full_like(weights, np.nan)
    ratios = weights[:, 0] / weights[:, 1]
    for members in cells(dataset):
        costs = _costs(dataset, members, kind)
        if np.isfinite(costs).any():
            root = np.sqrt(ratios[members[np.nanargmin(costs)]])
            result[members] = root, 1 / root
    return result


def cells(dataset: xr.Dataset) -> list[NDArray[np.intp]]:
    """Runs that differ in their weights only, by their numbers: one entry per cell."""
    conditions = np.column_stack(
        [dataset[name].values for name in ("delay_steps", "frequency", "disturbance")]
    )
    _, group = np.unique(conditions, axis=0, return_inverse=True)
    return [np.flatnonzero(group == number) for number in range(group.max(initial=-1) + 1)]


def _costs(dataset: xr.Dataset, members: Any, kind: Labels) -> Array:
    error = np.array(dataset.accumulated_error.values[members])  # NaN where a run ended early
    if kind == "best_in_cell" or not np.isfinite(error).any():
        return error
    torque = np.where(np.isfinite(error), dataset.rms_torque.values[members], np.nan)
    return error / np.nanmin(error) + torque / np.nanmin(torque)
