"""Training of the tuner's network on a data set, with one of two losses (theory.md, 23 and 34).

theta holds W1 (h, 18), b1 (h,), W2 (2, h), b2 (2,) one after the other, and the network is

    f(theta, u) = W2 sigmoid(W1 u + b1) + b2.

*Labels* are the right answers; f minimises 1/2 sum |f(theta, u_i) - y_i|^2 by Levenberg and
Marquardt, as in the paper. K of (43) depends on w_Q / w_R alone, since P of (44) scales with both:
pairs of one ratio are one gain, and a best gain has w_Q w_R = 1.

*Regret* R_i(r) = log J_i(r) - min log J_i is the cost of an answer along r = log10(w_Q / w_R),
known at 13 ratios and linear in between. f minimises by Adam

    mean over rows of R_i(r(u; theta)) + OUTSIDE |r - nearest in bounds|^2 + DECAY mean theta^2.

Rows are first those of the runs with fixed ratios, in a second round half of them are of runs with
the network. Excluded conditions decide when to stop, and which round was better, in the loop.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

from stewart_drake.files.errors import ConfigError, optional
from stewart_drake.files.versions import versions
from stewart_drake.files.yamlio import validate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.jobs import Progress, run_jobs
from stewart_drake.tuner.network import NUM_INPUTS, NUM_OUTPUTS, Kind, Network
from stewart_drake.tuner.source import densities, weights_of
from stewart_drake.tuning.data import (
    EVERY,
    LEAST,
    WATCHED,
    cells,
    data_hash,
    hash_of,
    log_cost,
    read_condition,
    roll_out,
)
from stewart_drake.tuning.families import FAULTY, RATIOS, vary
from stewart_drake.tuning.options import Labels, Split
from stewart_drake.types import Array, Flags

Indices = NDArray[np.intp]

HIDDEN: Final = 10
TRAIN_SHARE: Final = 0.7
MAX_ROWS: Final = 6000
"""Most rows that labels are trained on, drawn at random; QR of the Jacobian takes all the time."""
EVALUATIONS: Final = 60

HELD_OUT: Final = 0.2
"""Share of the conditions."""
OWN: Final = 0.5
"""Share of the trained conditions that are run with the first round's network."""
BATCH: Final = 4000
STEPS: Final = 1500
PATIENCE: Final = 300
"""Steps without improvement on the held-out conditions."""
LOOK: Final = 25
"""Steps between two evaluations on those."""
RATE: Final = 0.02
OUTSIDE: Final = 0.1
DECAY: Final = 1e-4


@dataclass(frozen=True)
class Training:
    network: Network  # with its card
    # one row per step. Labels: root mean square errors of training and test rows. Regret: round,
    # step, regret of the training and of the held-out rows.
    curve: Array
    # (N, 2) labels of the test rows, as the output layer gives them; empty for regret
    targets: Array
    outputs: Array  # (N, 2) of the network there


# ---------------------------------------------------------------- the network


def require_torch() -> Any:
    """Return the module torch, with one thread."""
    install = "install it with pip install 'stewart-drake[train]'"
    torch = optional("torch", f"tune train: needs torch; {install}")
    torch.set_num_threads(1)
    return torch


def unpack(theta: Any, inputs: int, hidden: int) -> tuple[Any, Any, Any, Any]:
    """Return W1 (h, inputs), b1 (h,), W2 (2, h), b2 (2,) of theta, numpy or torch."""
    ends = np.cumsum([hidden * inputs, hidden, NUM_OUTPUTS * hidden, NUM_OUTPUTS])
    W1, b1, W2, b2 = (theta[i:j] for i, j in zip([0, *ends[:-1]], ends, strict=True))
    return W1.reshape(hidden, inputs), b1, W2.reshape(NUM_OUTPUTS, hidden), b2


def outputs(theta: Any, u: Any, hidden: int) -> Any:
    """Return f (..., 2) of inputs u (..., n), by torch."""
    W1, b1, W2, b2 = unpack(theta, u.shape[-1], hidden)
    return (u @ W1.T + b1).sigmoid() @ W2.T + b2


def initial_theta(inputs: int, hidden: int, targets: Array, seed: int) -> Array:
    """Draw weights of variance 1 / fan-in; the output bias is the mean of the targets (N, 2)."""
    rng = np.random.default_rng(seed)
    first = rng.standard_normal((hidden, inputs)) / np.sqrt(inputs)
    second = rng.standard_normal((NUM_OUTPUTS, hidden)) / np.sqrt(hidden)
    return np.concatenate(
        [first.ravel(), np.zeros(hidden), second.ravel(), targets.mean(axis=0) - second.sum(1) / 2]
    )


def standard(inputs: Array) -> tuple[Array, Array]:
    """Return mean and spread (18,) of inputs; one that never changes keeps the scale 1."""
    spread = inputs.std(axis=0)
    return inputs.mean(axis=0), np.where(spread > 1e-12, spread, 1.0)


class TorchModel:
    """f and its Jacobian over rows of inputs, by torch in double precision.

    `outputs` is f (N, 2) of theta and inputs u (N, n), `jacobian` df/dtheta (N, 2, len(theta)).
    """

    def __init__(self, hidden: int) -> None:
        torch, forward = require_torch(), partial(outputs, hidden=hidden)

        def of_arrays(function: Any) -> Callable[[Array, Array], Array]:
            over_rows = torch.func.vmap(function, in_dims=(None, 0))

            def call(theta: Array, u: Array) -> Array:
                with torch.no_grad():
                    tensors = (torch.from_numpy(np.ascontiguousarray(x)) for x in (theta, u))
                    return np.asarray(over_rows(*tensors).numpy())

            return call

        self.outputs, self.jacobian = map(of_arrays, (forward, torch.func.jacrev(forward)))


def _card(seed: int, **more: Any) -> dict[str, Any]:
    return more | {"seed": seed, "versions": versions() | {"torch": version("torch")}}


# ---------------------------------------------------------------- by labels


def fit(
    model: TorchModel,
    theta: Array,
    train: tuple[Array, Array],
    test: tuple[Array, Array],
    evaluations: int,
) -> OptimizeResult:
    """Minimise the squared errors by Levenberg-Marquardt from `theta` on.

    Rows are standardised inputs (N, n) and targets (N, 2); those to test with may be none. The
    result is that of `least_squares`, with `curve` (iterations, 2): root mean square errors of
    training and test rows, from the start on.
    """
    curve: list[tuple[float, float]] = []

    def rms(theta: Array, rows: tuple[Array, Array]) -> float:
        if not len(rows[0]):
            return float("nan")
        return float(np.sqrt(np.mean((model.outputs(theta, rows[0]) - rows[1]) ** 2)))

    def residuals(theta: Array) -> Array:
        return (model.outputs(theta, train[0]) - train[1]).ravel()

    # MINPACK asks for the Jacobian at the start and after each successful step.
    def jacobian(theta: Array) -> Array:
        curve.append((rms(theta, train), rms(theta, test)))
        return model.jacobian(theta, train[0]).reshape(-1, len(theta))

    found = least_squares(
        residuals, theta, jac=jacobian, method="lm", max_nfev=evaluations, x_scale=1.0
    )
    curve.append((rms(found.x, train), rms(found.x, test)))
    found["curve"] = np.array(curve)
    return found


def labels(data: xr.Dataset, kind: Labels) -> Array:
    """Return the weights (run, 2) that the rows of each run are labelled with.

    These are with `as_run` the weights of the run, as the paper has it; with `best_in_cell` those
    of least E_ac among the runs of the same delay, frequency and disturbance, w_Q w_R = 1; with
    `best_in_cell_torque` the same of least E_ac + rms torque, each relative to its least in the
    cell. They are NaN if no run of the cell completed.
    """
    weights = np.array(data.weights.values, dtype=np.float64)
    if kind == "as_run":
        return weights
    result = np.full_like(weights, np.nan)
    ratios = weights[:, 0] / weights[:, 1]
    for members in cells(data):
        costs = np.array(data.accumulated_error.values[members])  # NaN for a run that ended early
        if not np.isfinite(costs).any():
            continue
        if kind == "best_in_cell_torque":
            torque = np.where(np.isfinite(costs), data.rms_torque.values[members], np.nan)
            costs = costs / np.nanmin(costs) + torque / np.nanmin(torque)
        root = np.sqrt(ratios[members[np.nanargmin(costs)]])
        result[members] = root, 1 / root
    return result


class Rows(NamedTuple):
    """Valid rows of a data set: inputs, targets, and run and cell of each."""

    inputs: Array
    targets: Array
    runs: Indices
    cells: Indices


def labelled_rows(data: xr.Dataset, kind: Labels, density: Kind) -> Rows:
    """Return the valid rows that have a label, targets as the output layer gives them."""
    wanted = labels(data, kind)
    use = data.valid.values & np.all(np.isfinite(wanted), axis=1)[:, np.newaxis]
    rho = np.array([densities(run, density) for run in data.samples.values])
    cell = np.empty(data.sizes["run"], dtype=np.intp)
    for number, members in enumerate(cells(data)):
        cell[members] = number
    run = np.nonzero(use)[0]
    targets = wanted[run] if kind == "as_run" else np.log(wanted[run])
    return Rows(rho[use], targets, run, cell[run])


def split_rows(rows: Rows, split: Split, rng: np.random.Generator) -> Flags:
    """Choose the training rows, 70 % of the samples, runs or cells."""
    group = {"sample": np.arange(len(rows.inputs)), "run": rows.runs, "cell": rows.cells}[split]
    groups = rng.permutation(np.unique(group))
    return np.isin(group, groups[: round(TRAIN_SHARE * len(groups))])


def train(
    data: xr.Dataset,
    *,
    kind: Labels = "best_in_cell",
    split: Split = "run",
    density: Kind = "magnitude",
    seed: int = 0,
    hidden: int = HIDDEN,
    max_rows: int = MAX_ROWS,
    evaluations: int = EVALUATIONS,
) -> Training:
    """Train a network by labels; the same arguments give the same network.

    With labels `as_run` the network's outputs are the weights, as the paper has it, otherwise their
    logarithms. The unit of the 70 % for training is a sample, as printed; a run, because the
    samples of a run resemble each other; or a cell, because the runs of a cell do.
    """
    rows, rng = labelled_rows(data, kind, density), np.random.default_rng(seed)
    in_train = split_rows(rows, split, rng)
    chosen = rng.permutation(np.flatnonzero(in_train))[:max_rows]
    if not len(chosen) or in_train.all():
        raise ConfigError(
            f"data: {len(rows.inputs)} labelled rows give nothing to "
            f"{'test with' if len(chosen) else 'train on'}; expected more runs that complete"
        )
    theta = initial_theta(NUM_INPUTS, hidden, rows.targets[chosen], seed)
    if rows.targets[chosen].size < len(theta):
        raise ConfigError(
            f"data: {len(chosen)} rows are too few to train the {len(theta)} parameters of a "
            f"network with {hidden} hidden neurons; expected more runs that complete"
        )
    mean, scale = standard(rows.inputs[chosen])
    u, model = (rows.inputs - mean) / scale, TorchModel(hidden)
    test = (u[~in_train], rows.targets[~in_train])
    found = fit(model, theta, (u[chosen], rows.targets[chosen]), test, evaluations)
    constant = np.sqrt(np.mean((test[1] - rows.targets[chosen].mean(axis=0)) ** 2))
    weights = np.asarray(data.weights.values)
    if kind != "as_run":
        root = np.sqrt(weights[:, 0] / weights[:, 1])
        weights = np.column_stack([root, 1 / root])
    card = _card(
        seed,
        data_sha256=data_hash(data),
        data_made_with=json.loads(data.attrs["settings"])["data"],
        labels=kind,
        split=split,
        rows={"labelled": len(u), "trained_on": len(chosen), "tested_with": len(test[0])},
        evaluations=int(found.nfev),
        converged=bool(found.status > 0),  # MINPACK stopped by itself
        rms_error={
            "train": float(found.curve[-1, 0]),
            "test": float(found.curve[-1, 1]),
            "test_of_a_constant": float(constant),
        },
    )
    network = Network(
        mean,
        scale,
        *unpack(found.x, NUM_INPUTS, hidden),
        bounds=np.array([weights.min(axis=0), weights.max(axis=0)]),
        output="weights" if kind == "as_run" else "log_weights",
        density=density,
        card=card,
    )
    return Training(network, found.curve, test[1], model.outputs(found.x, test[0]))


# ---------------------------------------------------------------- by regret


class Curves(NamedTuple):
    """Cost curves of conditions, and the features of their runs."""

    J: Array  # (n, m) in % s, of m = 13 fixed ratios, or of 1 roll-out
    # (n, m, k, 18) after each of k samples, NaN if they are not known
    features: NDArray[np.float32]

    @property
    def log_J(self) -> Array:
        """(n, m) natural logarithm."""
        return log_cost(self.J)

    @property
    def regret(self) -> Array:
        """(n, m) above the least of each condition."""
        return self.log_J - self.log_J.min(axis=1, keepdims=True)

    @property
    def best_ratio(self) -> float:
        """Fixed ratio of least mean log J."""
        return float(RATIOS[np.argmin(self.log_J.mean(axis=0))])


class FeatureRows(NamedTuple):
    inputs: Array
    condition: Indices


def curves_of(data: xr.Dataset) -> Curves:
    ratios = np.log10(data.weights.values[:, 0] / data.weights.values[:, 1])
    whole = not len(ratios) % len(RATIOS)
    if (
        "J" not in data
        or "health" not in data
        or not whole
        or not np.allclose(ratios.reshape(-1, len(RATIOS)), RATIOS)
    ):
        raise ConfigError(
            "data: has no cost curves to train by regret; expected a data set of "
            "`tune dataset --family` since version 0.3"
        )
    shape = (-1, len(RATIOS))
    recorded = data.health.values.astype(np.float32)
    return Curves(data.J.values.reshape(shape), recorded.reshape(*shape, *recorded.shape[1:]))


def feature_rows(curves: Curves) -> FeatureRows:
    """Return every second sample of every run with recorded features."""
    values = curves.features[:, ::WATCHED, ::EVERY].astype(np.float64)
    known = np.isfinite(values).all(axis=-1)
    return FeatureRows(values[known], np.nonzero(known)[0])


def train_by_regret(
    data: xr.Dataset,
    directory: str | Path,
    *,
    seed: int = 0,
    start: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Training:
    """Train a network by regret, on data of a family with faults.

    The same arguments give the same network. The directory keeps its runs, so that a second start
    continues. In the end the network begins at the ratio log10(w_Q / w_R) `start`, by default the
    best fixed one.
    """
    if start is not None and not RATIOS[0] <= start <= RATIOS[-1]:
        raise ConfigError(f"--start: got {start:g}; expected {RATIOS[0]:g} to {RATIOS[-1]:g}")
    settings = json.loads(data.attrs["settings"])
    curves = curves_of(data)
    begin = curves.best_ratio if start is None else start
    trainer = RegretTrainer(curves, seed)
    theta = trainer.fit(trainer.start, [trainer.rows], 1)
    about = {"family": settings["family"], "conditions": len(curves.J)}
    first = trainer.network(theta, about)
    base = validate(Scenario, settings["scenario"], "data")
    samples = data.sizes["sample"]

    def own_runs(network: Network, chosen: Indices, number: int) -> Curves:
        key = _key(network)
        found = run_jobs(
            {
                f"{i:05d}": (vary(FAULTY, base, settings["draws"][i]), network, samples)
                for i in chosen
            },
            roll_out,
            Path(directory) / f"round{number}-{key[:8]}",
            settings={
                "family": settings["family"],
                "scenario": scenario_to_dict(base),
                "network": key,
            },
            suffix=".npz",
            read=partial(read_condition, samples=samples),
            workers=workers,
            progress=progress,
        ).values()
        J, health = (np.array([one[name] for one in found]) for name in ("J", "health"))
        return Curves(J, health)

    held, some = np.flatnonzero(trainer.held), np.flatnonzero(~trainer.held)[:: round(1 / OWN)]
    chosen = np.sort(np.concatenate([held, some]))
    own = own_runs(first, chosen, 1)
    rows = feature_rows(own)
    both = [trainer.rows, FeatureRows(rows.inputs, chosen[rows.condition])]
    second = trainer.network(trainer.fit(theta, both, 2), about)
    scores = [
        float(own.log_J[np.isin(chosen, held)].mean()),
        float(own_runs(second, held, 2).log_J.mean()),
    ]
    best, fixed = (first, second)[int(np.argmin(scores))], curves.log_J[held]
    more = {
        "start": begin,
        "round": 1 + int(np.argmin(scores)),
        "held_out_J": {
            "rounds": np.exp(scores).tolist(),
            "best_fixed": float(np.exp(fixed.mean(axis=0).min())),
            "hindsight": float(np.exp(fixed.min(axis=1).mean())),
        },
    }
    network = replace(best, start=weights_of(begin), card=dict(best.card) | more)
    nothing = np.empty((0, NUM_OUTPUTS))
    return Training(network, np.array(trainer.curve), nothing, nothing)


class RegretTrainer:
    """Split, standardisation and loss of both rounds."""

    def __init__(self, curves: Curves, seed: int) -> None:
        self._torch, self._curves, self._seed = require_torch(), curves, seed
        self.rows = feature_rows(curves)
        number, rng = len(curves.J), np.random.default_rng(seed)
        self.held = np.zeros(number, dtype=bool)
        self.held[rng.permutation(number)[: round(HELD_OUT * number)]] = True
        self.mean, self.scale = standard(self.rows.inputs[~self.held[self.rows.condition]])
        target = np.log(weights_of(curves.best_ratio))[None, :]
        self.start = initial_theta(NUM_INPUTS, HIDDEN, target, seed)
        self.curve: list[tuple[float, float, float, float]] = []

    def fit(self, theta: Array, sources: list[FeatureRows], number: int) -> Array:
        """Minimise the regret by Adam on batches, with the same number of rows of each source.

        It stops when the held-out conditions gain no more.
        """
        torch = self._torch
        generator = torch.Generator().manual_seed(1000 * self._seed + number)
        parts = [self._split(rows) for rows in sources]
        x = torch.tensor(theta, dtype=torch.float32, requires_grad=True)
        optimizer = torch.optim.Adam([x], lr=RATE)
        best, kept, since = np.inf, theta, 0
        for step in range(STEPS):
            for group in optimizer.param_groups:
                group["lr"] = RATE * (0.5 + 0.5 * np.cos(np.pi * step / STEPS)) + 1e-4
            losses = []
            for (u, regret), _ in parts:
                rows = torch.randint(0, len(u), (BATCH // len(parts),), generator=generator)
                losses.append(self.loss(x, u[rows], regret[rows]))
            loss = sum(losses) / len(losses) + DECAY * (x**2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if (step + 1) % LOOK == 0:
                with torch.no_grad():
                    # The last source has the runs with the network, if there are any.
                    held = float(self.loss(x, *parts[-1][1]))
                self.curve.append((float(number), step + 1.0, float(loss.detach()), held))
                since += LOOK
                if held < best:
                    best, kept, since = held, x.detach().numpy().astype(np.float64), 0
                if since >= PATIENCE:
                    break
        return kept

    def _split(self, rows: FeatureRows) -> list[tuple[Any, Any]]:
        """Return standardised inputs and regrets (N, 13), to train on and held out."""
        held = self.held[rows.condition]
        arrays = (rows.inputs - self.mean) / self.scale, self._curves.regret[rows.condition]
        u, regret = (self._torch.tensor(a, dtype=self._torch.float32) for a in arrays)
        return [(u[chosen], regret[chosen]) for chosen in (~held, held)]

    def loss(self, theta: Any, inputs: Any, regret: Any) -> Any:
        """Return the mean regret of the ratios that the network answers with."""
        y = outputs(theta, inputs, HIDDEN)
        ratio = (y[:, 0] - y[:, 1]) / np.log(10)
        low, high, step = RATIOS[0], RATIOS[-1], RATIOS[1] - RATIOS[0]
        within = ratio.clamp(low, high)
        place = ((within - low) / step).clamp(max=len(RATIOS) - 1 - 1e-4)
        left = place.floor().long()
        share = place - left
        lower = regret.gather(1, left[:, None])[:, 0]
        upper = regret.gather(1, left[:, None] + 1)[:, 0]
        value = (1 - share) * lower + share * upper
        return value.mean() + OUTSIDE * ((ratio - within) ** 2).mean()

    def network(self, theta: Array, about: dict[str, Any]) -> Network:
        """Return the network of theta with w_Q w_R = 1 at the same ratio."""
        W1, b1, W2, b2 = unpack(theta, NUM_INPUTS, HIDDEN)
        half = np.array([[0.5, -0.5], [-0.5, 0.5]])
        ends = np.array([weights_of(RATIOS[0]), weights_of(RATIOS[-1])])
        card = _card(
            self._seed,
            **about,
            held_out=int(self.held.sum()),
            loss="regret",
            costs_sha256=hash_of(np.maximum(self._curves.J, LEAST)),
        )
        return Network(
            input_mean=self.mean,
            input_scale=self.scale,
            W1=W1,
            b1=b1,
            W2=half @ W2,
            b2=half @ b2,
            bounds=np.sort(ends, axis=0),
            output="log_weights",
            features="health",
            start=weights_of(self._curves.best_ratio),
            card=card,
        )


def _key(network: Network) -> str:
    names = ("input_mean", "input_scale", "W1", "b1", "W2", "b2", "bounds", "start")
    return hash_of(*(getattr(network, name) for name in names))


def summarize(training: Training) -> dict[str, Any]:
    """Return the content of `summary.json` of a training: the card and further results.

    By labels these are the correlations of the outputs, by regret the curve.
    """
    network, y, f = training.network, training.targets, training.outputs
    if not len(y):
        return dict(network.card) | {"curve": training.curve.tolist()}
    labelled, answered = (pd.DataFrame(one, columns=["w_Q", "w_R"]) for one in (y, f))
    return {
        **network.card,
        "hidden": network.hidden,
        "density": network.density,
        "output": network.output,
        "correlation": labelled.corrwith(answered).to_dict(),
    }
