"""Training by regret: not to answer with somebody's label, but to lose little.

With R_i(r) = log J_i(r) - min log J_i the regret of condition i along r = log10(w_Q / w_R), known
at 13 ratios and linear in between, the network r(u; theta) of features u minimises

    mean over rows of R_i(r(u; theta)) + OUTSIDE |r - nearest in bounds|^2 + DECAY mean theta^2.

Where any ratio will do, a label is noise, and here nothing is lost. Rows are first those of the
runs with fixed ratios. A network leads to features that no fixed ratio does: in a second round half
of the rows are of its own runs. Conditions, and with them motions, that are held out say when to
stop, and which round was better, in the loop.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.versions import versions
from stewart_drake.studies.jobs import Progress
from stewart_drake.tuner.density import NUM_INPUTS
from stewart_drake.tuner.network import Network
from stewart_drake.tuner.source import weights_of
from stewart_drake.tuning.curves import EVERY, LEAST, RATIOS, WATCHED, Curves, roll_outs
from stewart_drake.tuning.levenberg import initial_theta, require_torch, unpack
from stewart_drake.types import Array

FeatureName = Literal["densities", "health"]

HIDDEN: Final = 10
HELD_OUT: Final = 0.2
"""Of the conditions."""
OWN: Final = 0.5
"""Of the conditions trained on that are run with the first round's network."""
BATCH: Final = 4000
STEPS: Final = 1500
PATIENCE: Final = 300
"""Steps without anything better on the conditions that are held out."""
LOOK: Final = 25
"""Steps between two looks at those."""
RATE: Final = 0.02
OUTSIDE: Final = 0.1
DECAY: Final = 1e-4
Told = Callable[[str], None]
"""Called with a line on how far training is."""


class Rows(NamedTuple):
    """Of some runs.

    Attributes:
        inputs: (N, 18) features.
        condition: (N,) number of the condition that each is of.
    """

    inputs: Array
    condition: NDArray[np.intp]


@dataclass(frozen=True)
class RegretTraining:
    """A network, and how it came about.

    Attributes:
        network: with its card.
        curve: (n, 4) round, step, regret of the rows trained on and of those held out.
    """

    network: Network
    curve: Array


def rows_of(curves: Curves, features: FeatureName) -> Rows:
    """Every second sample of every watched run."""
    values = curves.features[features][:, ::WATCHED, ::EVERY].astype(np.float64)
    known = np.isfinite(values).all(axis=-1)
    return Rows(values[known], np.nonzero(known)[0])


def best_ratio(curves: Curves) -> float:
    """The fixed ratio of least mean log J."""
    return float(RATIOS[np.argmin(curves.log_cost.mean(axis=0))])


def train_by_regret(
    curves: Curves,
    directory: str | Path,
    *,
    features: FeatureName = "health",
    seed: int = 0,
    start: float | None = None,
    workers: int | None = None,
    told: Told = lambda line: None,
    progress: Progress | None = None,
) -> RegretTraining:
    """Train a network; the same arguments give the same one.

    Args:
        curves: of the conditions to train on.
        directory: its own runs are kept there, so that a second start goes on.
        features: what it decides by; the second round is for `health` alone.
        seed: of the split, the first theta and the batches.
        start: log10(w_Q / w_R) at which the network begins in the end, the best fixed one if None.
        workers, progress: as of `tuning.curves.make_curves`.
        told: how far it is.

    Raises:
        ConfigError: torch is missing, or a start that is no ratio.
        As `run_jobs`.
    """
    if start is not None and not RATIOS[0] <= start <= RATIOS[-1]:
        raise ConfigError(f"--start: got {start:g}; expected {RATIOS[0]:g} to {RATIOS[-1]:g}")
    trainer = _Trainer(curves, features, seed, told)
    theta = trainer.fit(trainer.start, [trainer.rows], 1)
    first, begin = trainer.network(theta), trainer.first if start is None else start
    if features != "health":
        network = replace(first, start=weights_of(begin))
        return RegretTraining(network, np.array(trainer.curve))

    def own_runs(network: Network, chosen: NDArray[np.intp], number: int) -> Curves:
        key = _key(network)
        folder = Path(directory) / f"round{number}-{key[:8]}"
        return roll_outs(
            curves, chosen, network, folder, key=key, workers=workers, progress=progress
        )

    held, some = np.flatnonzero(trainer.held), np.flatnonzero(~trainer.held)[:: round(1 / OWN)]
    chosen = np.sort(np.concatenate([held, some]))
    own = own_runs(first, chosen, 1)
    rows = rows_of(own, features)
    theta = trainer.fit(theta, [trainer.rows, Rows(rows.inputs, chosen[rows.condition])], 2)
    second = trainer.network(theta)
    scores = [
        float(own.log_cost[np.isin(chosen, held)].mean()),
        float(own_runs(second, held, 2).log_cost.mean()),
    ]
    told("held out, in the loop: J of round 1 {:.3g}, of round 2 {:.3g}".format(*np.exp(scores)))
    best = (first, second)[int(np.argmin(scores))]
    fixed = curves.log_cost[held].mean(axis=0)
    card = dict(best.card) | {
        "start": begin,
        "round": 1 + int(np.argmin(scores)),
        "held_out_J": {
            "rounds": np.exp(scores).tolist(),
            "best_fixed": float(np.exp(fixed.min())),
            "hindsight": float(np.exp(curves.log_cost[held].min(axis=1).mean())),
        },
    }
    network = replace(best, start=weights_of(begin), card=card)
    return RegretTraining(network, np.array(trainer.curve))


class _Trainer:
    """What both rounds have in common."""

    def __init__(self, curves: Curves, features: FeatureName, seed: int, told: Told) -> None:
        self._torch = require_torch()
        self._curves, self._features, self._seed, self._told = curves, features, seed, told
        self.rows = rows_of(curves, features)
        number, rng = len(curves.draws), np.random.default_rng(seed)
        self.held = np.zeros(number, dtype=bool)
        self.held[rng.permutation(number)[: round(HELD_OUT * number)]] = True
        seen = self.rows.inputs[~self.held[self.rows.condition]]
        spread = seen.std(axis=0)
        self.mean, self.scale = seen.mean(axis=0), np.where(spread > 1e-12, spread, 1.0)
        self.first = best_ratio(curves)
        target = np.log(weights_of(self.first))[None, :]
        self.start = initial_theta(NUM_INPUTS, HIDDEN, target, seed)
        self.curve: list[tuple[float, float, float, float]] = []

    def fit(self, theta: Array, sources: list[Rows], number: int) -> Array:
        """Adam on batches, as many rows of each source, until those held out gain no more."""
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
                losses.append(self._loss(x, u[rows], regret[rows]))
            loss = sum(losses) / len(losses) + DECAY * (x**2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if (step + 1) % LOOK == 0:
                with torch.no_grad():
                    # The last source is what the network itself leads to, where there is one.
                    held = float(self._loss(x, *parts[-1][1]))
                self.curve.append((float(number), step + 1.0, float(loss.detach()), held))
                line = f"{float(loss.detach()):.3f}, held out {held:.3f}"
                self._told(f"round {number}, step {step + 1}: {line}")
                since += LOOK
                if held < best:
                    best, kept, since = held, x.detach().numpy().astype(np.float64), 0
                if since >= PATIENCE:
                    break
        return kept

    def _split(self, rows: Rows) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """Standardised inputs and regrets (N, 13), to train on and held out."""
        torch, held = self._torch, self.held[rows.condition]
        regret = self._curves.regret[rows.condition]
        inputs = (rows.inputs - self.mean) / self.scale
        parts = [
            tuple(torch.tensor(a[chosen], dtype=torch.float32) for a in (inputs, regret))
            for chosen in (~held, held)
        ]
        return parts[0], parts[1]

    def _loss(self, theta: Any, inputs: Any, regret: Any) -> Any:
        torch = self._torch
        W1, b1, W2, b2 = unpack(theta, NUM_INPUTS, HIDDEN)
        y = torch.sigmoid(inputs @ W1.T + b1) @ W2.T + b2
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

    def network(self, theta: Array) -> Network:
        """The same ratio with w_Q w_R = 1."""
        W1, b1, W2, b2 = unpack(theta, NUM_INPUTS, HIDDEN)
        half = np.array([[0.5, -0.5], [-0.5, 0.5]])
        ends = np.array([weights_of(RATIOS[0]), weights_of(RATIOS[-1])])
        card = {
            "family": self._curves.family,
            "conditions": len(self._curves.draws),
            "held_out": int(self.held.sum()),
            "seed": self._seed,
            "loss": "regret",
            "costs_sha256": hashlib.sha256(
                np.maximum(self._curves.cost, LEAST).astype("<f8").tobytes()
            ).hexdigest(),
            "versions": versions() | {"torch": version("torch")},
        }
        return Network(
            input_mean=self.mean,
            input_scale=self.scale,
            W1=W1,
            b1=b1,
            W2=half @ W2,
            b2=half @ b2,
            bounds=np.sort(ends, axis=0),
            output="log_weights",
            features=self._features,
            start=weights_of(self.first),
            card=card,
        )


def _key(network: Network) -> str:
    """SHA-256 of what a network computes."""
    digest = hashlib.sha256()
    for name in ("input_mean", "input_scale", "W1", "b1", "W2", "b2", "bounds", "start"):
        digest.update(np.ascontiguousarray(getattr(network, name), "<f8").tobytes())
    return digest.hexdigest()
