"""Whether the tuner is worth having: against every fixed gain of the grid, on unseen scenarios.

All candidates run the same scenarios, so that differences are paired. E_ac is averaged over the
scenarios that every candidate completes, failures are counted apart, and the fixed gain that the
tuner is compared with is the one that did best on these very scenarios.
"""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from scipy import stats

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.resources import resolve
from stewart_drake.scenario.config import AnnTunerConfig, Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.studies.disturbances import disturbed, draw, with_gain
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.studies.runs import Outcome, loops_of, read_outcome, run_scenario
from stewart_drake.studies.uncertainty import Draw
from stewart_drake.tuner.network import DEFAULT, EXPECTED, MAX_BYTES, load_network
from stewart_drake.tuning.grid import PAIRS
from stewart_drake.types import Array

GAINS: Final = {
    f"{q:g} / {r:g}": (q, r)
    for _, (q, r) in sorted({q / r: (q, r) for q, r in reversed(PAIRS)}.items())
}
"""The seven gains of the nine pairs by name, the gentlest first: one pair of each ratio."""
TUNER: Final = "tuner"
CONFIDENCE: Final = 0.95
RESAMPLES: Final = 10_000


class Evaluation(NamedTuple):
    """What every candidate did on every scenario.

    Attributes:
        candidates: names, the fixed gains first, `TUNER` last.
        error: (candidates, scenarios) E_ac in % s, NaN for a run that did not complete.
        summary: what `summary.json` holds.
    """

    candidates: tuple[str, ...]
    error: Array
    summary: dict[str, Any]


def evaluate(
    scenario: Scenario,
    weights: str | Path | None,
    directory: str | Path,
    *,
    scenarios: int = 40,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Run the candidates on scenarios drawn from a seed, or go on with it.

    Args:
        scenario: base of all runs; its own weights are where the tuner starts from.
        weights: of the network, as `load_network` takes them; None for the shipped one.
        directory: the runs are kept in fixed/ and tuner-HASH/ there, so that a second network
            needs its own runs only.
        scenarios: number to draw, at least 2.
        seed: of the draws; those for training are others.
        workers, scheduler, progress: as `run_jobs` takes them.

    Raises:
        As `run_jobs` and `load_network`, and ConfigError for a scenario that does not suit.
    """
    if scenarios < 2:
        raise ConfigError(f"--scenarios: got {scenarios}; expected 2 or more")
    path = resolve("weights", weights or DEFAULT)
    network = load_network(path)
    content = hashlib.sha256(read_bytes(path, MAX_BYTES, EXPECTED)).hexdigest()
    draws = draw(scenario, scenarios, seed, "evaluation")
    cells = [disturbed(scenario, one) for one in draws]
    fixed: dict[str, Job] = {
        f"{number:04d}_wQ{q:g}_wR{r:g}": (with_gain(cell, q, r),)
        for number, cell in enumerate(cells)
        for q, r in GAINS.values()
    }
    tuned: dict[str, Job] = {
        f"{number:04d}_tuner": (_with_tuner(cell, path),) for number, cell in enumerate(cells)
    }
    settings = {"scenario": scenario_to_dict(scenario), "seed": seed}
    directory, runs = Path(directory), dict[str, Outcome]()

    def counted(number: int, _: int) -> None:
        if progress is not None:
            progress(done + number, len(fixed) + len(tuned))

    for jobs, name, extra in (
        (fixed, "fixed", {}),
        (tuned, f"tuner-{content[:8]}", {"network": content}),
    ):
        done = len(runs)
        runs |= run_jobs(
            jobs,
            run_scenario,
            directory / name,
            settings=settings | extra,
            read=read_outcome,
            workers=workers,
            scheduler=scheduler,
            progress=counted,
        )
    # The fixed runs go through all gains, one scenario after the other.
    table = [[runs[key] for key in fixed][i :: len(GAINS)] for i in range(len(GAINS))]
    table.append([runs[key] for key in tuned])
    about = {"file": path.name, "sha256": content, "card": dict(network.card)}
    return _evaluation(table, draws, settings | {"network": about})


def _evaluation(
    table: list[list[Outcome]], draws: list[Draw], settings: dict[str, Any]
) -> Evaluation:
    """What runs (candidates x scenarios) say together, the tuner's last."""
    candidates = (*GAINS, TUNER)
    error = np.array([[run.error for run in row] for row in table])
    summary = {
        **compare(candidates, error, settings["seed"]),
        "loops": loops_of(run for row in table for run in row),
        "fallbacks": sum(run.tuner_fallbacks for run in table[-1]),
        "scenarios": [
            one | {"E_ac": dict(zip(candidates, error[:, number], strict=True))}
            for number, one in enumerate(draws)
        ],
        "base": settings["scenario"],
        "seed": settings["seed"],
        "network": settings["network"],
    }
    return Evaluation(candidates, error, summary)


def compare(candidates: tuple[str, ...], error: Array, seed: int) -> dict[str, Any]:
    """Means with confidence intervals, failures and worst cases; the tuner is the last row.

    Args:
        candidates: names of the rows.
        error: (candidates, scenarios) E_ac in % s, NaN for a failure.
        seed: of the bootstrap.

    Returns:
        `candidates`: by name, `failures` (of all scenarios), `mean` with `interval` (95 %, Student)
        and `worst` over the scenarios that all complete; `common`, their number; `best_fixed`, of
        fewest failures, then of least mean; `improvement` of the tuner on it, 1 - ratio of the
        means, with `improvement_interval` (95 %, bootstrap over scenarios, paired); `hindsight`,
        the same for whoever picked the best gain of each scenario afterwards.
    """
    failed = np.isnan(error)
    common = error[:, ~failed.any(axis=0)]
    number, failures = common.shape[1], failed.sum(axis=1)
    some = common if number else np.full((len(candidates), 1), np.nan)
    mean, half = some.mean(axis=1), np.full(len(candidates), np.nan)
    if number > 1:
        half = stats.t.ppf((1 + CONFIDENCE) / 2, number - 1) * stats.sem(some, axis=1)
    best = min(range(len(candidates) - 1), key=lambda i: (failures[i], mean[i]))

    def improvement(tuner: Array, fixed: Array, axis: int = -1) -> Any:
        return 1 - tuner.mean(axis=axis) / fixed.mean(axis=axis)

    sure: Any = (np.nan, np.nan)
    if number > 1:
        sure = stats.bootstrap(
            (common[-1], common[best]),
            improvement,
            paired=True,
            n_resamples=RESAMPLES,
            confidence_level=CONFIDENCE,
            method="percentile",
            random_state=np.random.default_rng(seed),
        ).confidence_interval
    return {
        "candidates": {
            name: {
                "failures": int(failures[i]),
                "mean": mean[i],
                "interval": [mean[i] - half[i], mean[i] + half[i]],
                "worst": some[i].max(),
            }
            for i, name in enumerate(candidates)
        },
        "common": number,
        "best_fixed": candidates[best],
        "improvement": improvement(some[-1], some[best]),
        "hindsight": 1 - some[:-1].min(axis=0).mean() / mean[best],
        "improvement_interval": list(map(float, sure)),
    }


def _with_tuner(scenario: Scenario, path: Path) -> Scenario:
    return replace(scenario, tuner=AnnTunerConfig(weights=str(path)))
