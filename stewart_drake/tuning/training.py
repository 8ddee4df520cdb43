"""From a data set to a network that the loop can use."""

import json
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Final, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.versions import versions
from stewart_drake.tuner.density import NUM_INPUTS, Kind, densities
from stewart_drake.tuner.network import Network
from stewart_drake.tuning.dataset import data_hash
from stewart_drake.tuning.labels import Labels, cells, labels
from stewart_drake.tuning.levenberg import TorchModel, fit, initial_theta, unpack
from stewart_drake.types import Array

Split = Literal["sample", "run", "cell"]
SPLITS: Final = ("sample", "run", "cell")

HIDDEN: Final = 10
TRAIN_SHARE: Final = 0.7
MAX_ROWS: Final = 6000
"""Rows that training uses at most, drawn at random: QR of the Jacobian takes all the time."""
EVALUATIONS: Final = 60
"""Of the residuals, at most."""


@dataclass(frozen=True)
class Training:
    """A trained network and how it was trained.

    Attributes:
        network: with its card.
        curve: (iterations, 2) root mean square errors of training and test rows.
        targets: (N, 2) of the test rows, as the output layer gives them.
        outputs: (N, 2) of the network there.
    """

    network: Network
    curve: Array
    targets: Array
    outputs: Array


@dataclass(frozen=True)
class Rows:
    """Valid rows of a data set: densities, targets, and the run and cell that each is of."""

    densities: Array
    targets: Array
    runs: NDArray[np.intp]
    cells: NDArray[np.intp]


def train(
    dataset: xr.Dataset,
    *,
    kind: Labels = "best_in_cell",
    split: Split = "run",
    density: Kind = "magnitude",
    seed: int = 0,
    hidden: int = HIDDEN,
    max_rows: int = MAX_ROWS,
    evaluations: int = EVALUATIONS,
) -> Training:
    """Train a network; the same arguments give the same network.

    Args:
        dataset: as `load_dataset` returns it.
        kind: of labels; with `as_run` the network's outputs are the weights, as the paper has it,
            otherwise their logarithms.
        split: 70 % of what is drawn for training: of samples, as printed, of runs, whose samples
            resemble each other, or of cells, whose runs do.
        density: kind of the inputs.
        seed: of split, choice of rows and start.
        hidden: number of hidden neurons.
        max_rows: used for training at most.
        evaluations: of the residuals at most.

    Raises:
        ConfigError: torch is missing, or too few rows are left to train on or to test with.
    """
    rows = training_rows(dataset, kind, density)
    rng = np.random.default_rng(seed)
    in_train = _split(rows, split, rng)
    chosen = rng.permutation(np.flatnonzero(in_train))[:max_rows]
    if not len(chosen) or in_train.all():
        raise ConfigError(
            f"data: {len(rows.densities)} labelled rows give nothing to "
            f"{'test with' if len(chosen) else 'train on'}; expected more runs that complete"
        )
    theta = initial_theta(NUM_INPUTS, hidden, rows.targets[chosen], seed)
    if rows.targets[chosen].size < len(theta):
        raise ConfigError(
            f"data: {len(chosen)} rows to train on cannot tell the {len(theta)} numbers of a "
            f"network with {hidden} hidden neurons; expected more runs that complete"
        )
    mean, scale = _standard(rows.densities[chosen])
    u = (rows.densities - mean) / scale
    model = TorchModel(NUM_INPUTS, hidden)
    test = (u[~in_train], rows.targets[~in_train])
    found = fit(
        model,
        theta,
        (u[chosen], rows.targets[chosen]),
        test,
        evaluations,
    )
    outputs = model.outputs(found.theta, test[0])
    weights = unpack(found.theta, NUM_INPUTS, hidden)
    card = {
        "data_sha256": data_hash(dataset),
        "data_made_with": json.loads(dataset.attrs["settings"])["data"],
        "labels": kind,
        "split": split,
        "seed": seed,
        "rows": {"labelled": len(u), "trained_on": len(chosen), "tested_with": len(test[0])},
        "evaluations": found.evaluations,
        "converged": found.converged,
        "rms_error": {
            "train": float(found.curve[-1, 0]),
            "test": float(found.curve[-1, 1]),
            "test_of_a_constant": _constant_error(rows.targets[chosen], test[1]),
        },
        "versions": versions() | {"torch": version("torch")},
    }
    bounds, output = _bounds(dataset, kind), _output(kind)
    network = Network(mean, scale, *weights, bounds, output, density, card)
    return Training(network, found.curve, test[1], outputs)


def training_rows(dataset: xr.Dataset, kind: Labels, density: Kind) -> Rows:
    """The valid rows that have a label, targets as the output layer gives them."""
    wanted = labels(dataset, kind)
    use = dataset.valid.values & np.all(np.isfinite(wanted), axis=1)[:, np.newaxis]
    rho = np.array([densities(run, density) for run in dataset.samples.values])
    cell = np.empty(dataset.sizes["run"], dtype=np.intp)
    for number, members in enumerate(cells(dataset)):
        cell[members] = number
    run = np.nonzero(use)[0]
    targets = wanted[run]
    return Rows(
        densities=rho[use],
        targets=targets if _output(kind) == "weights" else np.log(targets),
        runs=run,
        cells=cell[run],
    )


def _output(kind: Labels) -> Literal["weights", "log_weights"]:
    return "weights" if kind == "as_run" else "log_weights"


def _bounds(dataset: xr.Dataset, kind: Labels) -> Array:
    """Lower and upper bounds of w_Q and w_R: what the labels could be."""
    weights = np.asarray(dataset.weights.values)
    if kind == "as_run":
        return np.array([weights.min(axis=0), weights.max(axis=0)])
    root = np.sqrt(weights[:, 0] / weights[:, 1])
    both = np.column_stack([root, 1 / root])
    return np.array([both.min(axis=0), both.max(axis=0)])


def _split(rows: Rows, split: Split, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which rows are for training."""
    number = len(rows.densities)
    group = {"sample": np.arange(number), "run": rows.runs, "cell": rows.cells}[split]
    groups = rng.permutation(np.unique(group))
    return np.isin(group, groups[: round(TRAIN_SHARE * len(groups))])


def _standard(densities: Array) -> tuple[Array, Array]:
    """Mean and spread (18,); a density that never changes keeps the scale 1."""
    spread = densities.std(axis=0)
    return densities.mean(axis=0), np.where(spread > 1e-12, spread, 1.0)


def _constant_error(train: Array, test: Array) -> float:
    """What answering with the mean of the training targets would have as its error."""
    return float(np.sqrt(np.mean((test - train.mean(axis=0)) ** 2)))


def summarize(training: Training) -> dict[str, Any]:
    """What `summary.json` of a training holds: the card, and the correlation of each output."""
    y, f = training.targets, training.outputs
    spread = np.std(y, axis=0) * np.std(f, axis=0)
    covariance = np.mean((y - y.mean(axis=0)) * (f - f.mean(axis=0)), axis=0)
    correlation = np.where(spread > 0, covariance / np.where(spread > 0, spread, 1.0), np.nan)
    network = training.network
    return {
        **network.card,
        "hidden": network.hidden,
        "density": network.density,
        "output": network.output,
        "correlation": dict(zip(("w_Q", "w_R"), correlation, strict=True)),
    }
