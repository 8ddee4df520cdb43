"""Cost curves: drawn conditions, each run with 13 fixed ratios w_Q / w_R, as a tuner sees them.

    J = E_ac up to the end + LOST * seconds that were lost with the plate,

so that a plate that leaves early costs more than one that leaves late, and every run counts. A
regret is log J above the least of its curve: what another ratio would have been worth.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import pydantic.dataclasses
from numpy.typing import NDArray
from pydantic import ConfigDict

from stewart_drake.files.arrayio import load_npz
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.versions import versions
from stewart_drake.files.yamlio import validate
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.bulk import Ending, run_in_bulk
from stewart_drake.loop.experiment import Experiment
from stewart_drake.loop.preparation import MakeTuner
from stewart_drake.loop.weights import health_of
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.renames import with_new_names
from stewart_drake.studies.disturbances import with_gain
from stewart_drake.studies.families import FamilyName, base_of, condition, draw_family
from stewart_drake.studies.jobs import MANIFEST, Progress, read_manifest, run_jobs
from stewart_drake.studies.uncertainty import Draw
from stewart_drake.tuner.density import NUM_INPUTS, WINDOW, densities
from stewart_drake.tuner.health import HealthFeatures
from stewart_drake.tuner.network import Network
from stewart_drake.tuner.source import (
    Decision,
    RatioPolicy,
    WeightsSource,
    weights_of,
)
from stewart_drake.types import Array

RATIOS: Final = np.linspace(-4.0, 2.0, 13)
"""log10(w_Q / w_R)."""


def fixed_name(ratio: float) -> str:
    """Of a run with fixed weights."""
    return f"{ratio:+.1f}"


LOST: Final = 50.0
"""% s per second."""
EVERY: Final = 2
"""Samples of which one is kept: neighbours say the same."""
WATCHED: Final = 2
"""Every so many ratios one is watched; of the others only J is wanted, which C alone computes."""
LEAST: Final = 1e-3
"""% s; a lesser J counts as this one, lest a run without error is worth everything."""
EXPECTED: Final = "the file of one condition of `tune dataset --family`"


@dataclass(frozen=True)
class FixedPolicy:
    """A tuner that looks on.

    Attributes:
        first: (2,) w_Q and w_R, throughout.
    """

    first: Array

    def decide(self, values: Array, last: Array) -> Decision:
        """See `tuner.source.Policy`."""
        return Decision(self.first, False)


@dataclass(frozen=True)
class Watched:
    """Makes a tuner that looks on with the features `health` while the weights are fixed.

    Attributes:
        ratio: log10(w_Q / w_R).
    """

    ratio: float

    def __call__(self, experiment: Experiment, law: PredictiveLqi) -> WeightsSource:
        """See `loop.preparation.MakeTuner`."""
        return WeightsSource(health_of(experiment, law), FixedPolicy(weights_of(self.ratio)))


@dataclass(frozen=True)
class Driven:
    """Makes a tuner of a network that is in no file.

    Attributes:
        network: whose features are `health`.
    """

    network: Network

    def __call__(self, experiment: Experiment, law: PredictiveLqi) -> WeightsSource:
        """See `loop.preparation.MakeTuner`."""
        return WeightsSource(health_of(experiment, law), RatioPolicy(self.network))


def cost(ending: Ending, duration: float) -> float:
    """J in % s, of a run of so many s."""
    stopped = ending.stopped
    so_far = ending.error_so_far if np.isfinite(ending.error_so_far) else 0.0
    return so_far if stopped is None else so_far + LOST * (duration - stopped.time)


def at_ratio(scenario: Scenario, ratio: float) -> Scenario:
    """With fixed weights of a ratio."""
    return with_gain(scenario, *weights_of(ratio).tolist())


def samples_of(scenario: Scenario) -> int:
    """How many of a run are kept: not the one at its end, after which nothing is decided."""
    return round(scenario.duration / scenario.controller.period)


def cost_curve(scenario: Scenario) -> bytes:
    """A condition with each of RATIOS, as the bytes of an .npz file."""
    runs = [at_ratio(scenario, ratio) for ratio in RATIOS]
    return _file(
        [
            watched_run(run, Watched(float(ratio))) if i % WATCHED == 0 else plain_run(run)
            for i, (ratio, run) in enumerate(zip(RATIOS, runs, strict=True))
        ]
    )


def roll_out(scenario: Scenario, network: Network) -> bytes:
    """A condition with a network, the same with one run."""
    return _file([watched_run(scenario, Driven(network))])


def plain_run(scenario: Scenario) -> dict[str, Any]:
    """As `watched_run`, without features."""
    return _run(run_in_bulk(scenario), scenario)


def _run(ending: Ending, scenario: Scenario) -> dict[str, Any]:
    nothing = np.full((samples_of(scenario), NUM_INPUTS), np.nan)
    return {
        "cost": cost(ending, scenario.duration),
        "completed": ending.stopped is None,
        "health": nothing,
        "densities": nothing.copy(),
    }


def watched_run(scenario: Scenario, tuner: MakeTuner) -> dict[str, Any]:
    """J, whether it completed, and the features of both kinds before each sample but the first."""
    made: list[HealthFeatures] = []

    def make(experiment: Experiment, law: PredictiveLqi) -> WeightsSource | None:
        source = tuner(experiment, law)
        assert source is not None and isinstance(source.features, HealthFeatures)
        made.append(source.features)
        return source

    ending = run_in_bulk(scenario, tuner=make)
    run = _run(ending, scenario)
    taken = min(len(ending.rows), samples_of(scenario))
    if taken:
        padded = np.vstack([np.full((WINDOW, ending.rows.shape[1]), np.nan), ending.rows])
        for k in range(0, taken, EVERY):
            run["health"][k] = made[0].values(padded[k + 1 : k + 1 + WINDOW])
        run["densities"][:taken] = densities(ending.samples[:taken])
    return run


def _file(runs: list[dict[str, Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez(
        buffer,
        cost=np.array([run["cost"] for run in runs]),
        completed=np.array([run["completed"] for run in runs]),
        health=np.array([run["health"] for run in runs], dtype=np.float32),
        densities=np.array([run["densities"] for run in runs], dtype=np.float32),
    )
    return buffer.getvalue()


@dataclass(frozen=True)
class Curves:
    """What a family's conditions came to.

    Attributes:
        family: name of it.
        base: the scenario that it varies.
        draws: n conditions.
        cost: (n, m) J in % s, of m = 13 fixed ratios, or 1 roll-out.
        completed: (n, m).
        features: by name, (n, m, k, 18) after each of k samples, NaN after a run's end.
    """

    family: str
    base: Scenario
    draws: list[Draw]
    cost: Array
    completed: NDArray[np.bool_]
    features: dict[str, NDArray[np.float32]]

    @property
    def log_cost(self) -> Array:
        """(n, m) natural logarithm."""
        return np.log(np.maximum(self.cost, LEAST))

    @property
    def regret(self) -> Array:
        """(n, m) above the least of each condition."""
        return self.log_cost - self.log_cost.min(axis=1, keepdims=True)


def make_curves(
    family: str,
    directory: str | Path,
    *,
    number: int,
    seed: int = 0,
    settings: tuple[str, ...] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Curves:
    """Run a family's training conditions with all ratios, or go on with it.

    Args:
        family: name in `studies.families.FAMILIES`.
        directory: the runs are kept in curves/ there, a file for each condition.
        number: of conditions; more may be asked for later.
        seed: of the draws.
        settings: further ones of the scenario.
        workers, scheduler, progress: as `run_jobs` takes them.

    Raises:
        As `run_jobs`, and ConfigError for fewer than ten conditions.
    """
    if number < 10:
        raise ConfigError(f"--draws: got {number}; expected 10 or more")
    base, draws = base_of(family, settings), draw_family(family, number, seed, "training")
    kept = run_jobs(
        {f"{i:05d}": (condition(base, one),) for i, one in enumerate(draws)},
        cost_curve,
        Path(directory) / "curves",
        settings={"family": family, "seed": seed, "scenario": scenario_to_dict(base)},
        suffix=".npz",
        read=partial(read_curve, runs=len(RATIOS), samples=samples_of(base)),
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    return collected(family, base, draws, kept)


def load_curves(directory: str | Path) -> Curves:
    """What `make_curves` has left, all of it.

    Raises:
        ConfigError: there is nothing of the kind, some of it is missing or damaged.
    """
    folder = Path(directory) / "curves"
    manifest = str(folder / MANIFEST)
    said = validate(_Settings, read_manifest(folder, EXPECTED).settings, manifest)
    base = validate(Scenario, with_new_names(said.scenario), manifest)
    paths = sorted(folder.glob("[0-9]*.npz"))
    if [path.stem for path in paths] != [f"{i:05d}" for i in range(len(paths))] or not paths:
        raise ConfigError(f"{folder}: conditions are missing; go on with tune dataset --family")
    draws = draw_family(said.family, len(paths), said.seed, "training")
    read = partial(read_curve, runs=len(RATIOS), samples=samples_of(base))
    return collected(said.family, base, draws, {path.stem: read(path) for path in paths})


@pydantic.dataclasses.dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class _Settings:
    family: FamilyName
    seed: int
    scenario: dict[str, Any]


def roll_outs(
    curves: Curves,
    chosen: NDArray[np.intp],
    network: Network,
    directory: Path,
    *,
    key: str,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Curves:
    """Run some of the conditions with a network, or go on with it.

    Args:
        curves: of the conditions.
        chosen: numbers of those that are run.
        network: what sets the weights.
        directory: where the runs are kept.
        key: by which the network differs from others.
        workers, progress: as `run_jobs` takes them.
    """
    family, base = curves.family, curves.base
    draws = [curves.draws[i] for i in chosen]
    kept = run_jobs(
        {f"{i:05d}": (condition(base, one), network) for i, one in zip(chosen, draws, strict=True)},
        roll_out,
        directory,
        settings={"family": family, "scenario": scenario_to_dict(base), "network": key},
        suffix=".npz",
        read=partial(read_curve, runs=1, samples=samples_of(base)),
        workers=workers,
        progress=progress,
    )
    return collected(family, base, draws, kept)


def collected(
    family: str, base: Scenario, draws: list[Draw], kept: Mapping[str, dict[str, Any]]
) -> Curves:
    """The files of all conditions, in their order."""
    read = list(kept.values())
    return Curves(
        family=family,
        base=base,
        draws=draws,
        cost=np.array([one["cost"] for one in read]),
        completed=np.array([one["completed"] for one in read]),
        features={name: np.array([one[name] for one in read]) for name in ("health", "densities")},
    )


def read_curve(path: Path, runs: int, samples: int) -> dict[str, Any]:
    """The file of a condition.

    Args:
        path: of it.
        runs: that it holds.
        samples: of each of them.

    Raises:
        ConfigError: it is damaged; one line.
    """
    seen = ("f", (runs, samples, NUM_INPUTS))
    shapes = {
        "cost": ("f", (runs,)),
        "completed": ("b", (runs,)),
        "health": seen,
        "densities": seen,
    }
    found: dict[str, Any] = load_npz(path, shapes, EXPECTED)
    if not (np.isfinite(found["cost"]).all() and (found["cost"] >= 0).all()):
        raise ConfigError(
            f"{path}: cost: got one that is negative or not finite; expected J in % s"
        )
    return found


def summarize(curves: Curves) -> dict[str, Any]:
    """What `summary.json` of a family's data holds."""
    g = np.exp(curves.log_cost.mean(axis=0))
    return {
        "family": curves.family,
        "conditions": len(curves.draws),
        "g": dict(zip(map(fixed_name, RATIOS), g.tolist(), strict=True)),
        "completed": dict(
            zip(map(fixed_name, RATIOS), curves.completed.sum(axis=0).tolist(), strict=True)
        ),
        "hindsight": float(np.exp(curves.log_cost.min(axis=1).mean())),
        "scenario": scenario_to_dict(curves.base),
        "versions": versions(),
    }
