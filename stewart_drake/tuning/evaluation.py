"""Evaluation of a tuner against every fixed gain, on conditions that training did not have.

All candidates run the same conditions, so differences are paired. A tuner is compared with the
fixed gain that is best on *these very conditions*. Two measures judge it:

- E_ac, averaged over the conditions that every candidate completes; failures are counted apart;
- J (`tuning.data`), over all conditions, lost runs included: by its geometric mean g, which weighs
  all conditions alike, and by its mean m, which bad conditions dominate.

Hindsight is a candidate that has the best fixed gain of each condition. Intervals of improvements
are of a paired bootstrap.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.resources import resolve
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.scenario.config import AnnTunerConfig, RuleTunerConfig
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.studies.jobs import Job, Progress, part_of, run_jobs
from stewart_drake.studies.statistics import CONFIDENCE
from stewart_drake.tuner.network import DEFAULT, EXPECTED, MAX_BYTES, load_network
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.data import log_cost, read_condition, run_condition
from stewart_drake.tuning.families import FAMILIES, FAULTS, Family, fault_of
from stewart_drake.types import Array, Flags

TUNER: Final = "tuner"
"""Name of the only network of a family without faults."""
RULE: Final = "rule"
HINDSIGHT: Final = "hindsight"
RESAMPLES: Final = 10_000
_FIXED: Final = "fixed"
"""Name of the jobs that run all fixed gains of a condition."""

Tuner = AnnTunerConfig | RuleTunerConfig
Runs = dict[str, NDArray[Any]]
"""Results of `read_condition`, of one condition."""


class Evaluation(NamedTuple):
    """Results of all candidates under all conditions."""

    family: Family  # with its conditions
    names: tuple[str, ...]  # of the candidates: the fixed gains, then the tuners
    cost: Array  # (c, n) J in % s
    error: Array  # (c, n) E_ac in % s, NaN for a run that did not complete
    # by tuner, log10(w_Q / w_R) at the samples of each condition
    ratios: dict[str, list[list[float]]]
    summary: dict[str, Any]  # content of `summary.json`

    @property
    def tuners(self) -> tuple[str, ...]:
        return self.names[len(self.family.gains) :]


def tuners_of(
    family: Family, networks: Sequence[str | Path]
) -> tuple[dict[str, Tuner], dict[str, dict[str, Any]]]:
    """Return the tuners by name, and the file name, hash and card of each network.

    A family with faults has the rule and any number of networks, named by their files. Without
    faults it has one network, called TUNER.
    """
    if not family.has_faults and len(networks) > 1:
        raise ConfigError(f"WEIGHTS: got {len(networks)} without --family; expected one")
    tuners: dict[str, Tuner] = {RULE: RuleTunerConfig()} if family.has_faults else {}
    files: dict[str, dict[str, Any]] = {}
    shipped = FAMILIES[family.name].network if family.has_faults else DEFAULT
    for network in networks or [shipped]:
        path = resolve("weights", network)
        card = dict(load_network(path).card)
        name = path.stem if family.has_faults else TUNER
        if name in (*tuners, *family.gains, _FIXED, HINDSIGHT):
            raise ConfigError(
                f"weights: got {name!r}, the name of another candidate; expected a file with "
                "another name"
            )
        digest = hashlib.sha256(read_bytes(path, MAX_BYTES, EXPECTED)).hexdigest()
        tuners[name] = AnnTunerConfig(weights=str(path))
        files[name] = {"file": path.name, "sha256": digest, "card": card}
    return tuners, files


def evaluate(
    family: Family,
    networks: Sequence[str | Path],
    directory: str | Path,
    *,
    progress: Progress | None = None,
    **execution: Any,
) -> Evaluation:
    """Run all candidates under all conditions of a family for evaluation, or continue.

    Networks are shipped names or files; none for the shipped one of the family. The directory keeps
    the runs in fixed/, rule/ and NAME-HASH/, so that a second network needs its own runs only.
    `execution` are workers and scheduler, as `run_jobs` takes them.
    """
    scenarios = {key: condition.scenario for key, condition in family.conditions.items()}
    gains, (tuners, files) = tuple(family.gains.values()), tuners_of(family, networks)
    about = {"family": family.name, "seed": family.seed, "scenario": scenario_to_dict(family.base)}
    jobs_of: dict[str, dict[str, Job]] = {
        _FIXED: {key: (scenario, gains, family.samples) for key, scenario in scenarios.items()}
    }
    for name, tuner in tuners.items():
        jobs_of[name] = {
            key: (replace(scenario, tuner=tuner), (), family.samples)
            for key, scenario in scenarios.items()
        }
    table: dict[str, list[Runs]] = {}
    for name, jobs in jobs_of.items():
        file, runs = files.get(name), 1 if name in tuners else len(gains)
        results = run_jobs(
            jobs,
            run_condition,
            Path(directory) / (f"{name}-{file['sha256'][:8]}" if file else name),
            settings=about | ({"network": file["sha256"]} if file else {}),
            suffix=".npz",
            read=partial(read_condition, runs=runs, samples=family.samples),
            progress=part_of(progress, len(table) * len(jobs), len(jobs_of) * len(jobs)),
            **execution,
        )
        table[name] = list(results.values())
    return _compare(family, table, files, _nominal_errors(family, tuners))


def _nominal_errors(family: Family, tuners: dict[str, Tuner]) -> dict[str, dict[str, float]]:
    """Return E_ac in % s of the nominal `paper` by candidate, on the reference and from rest.

    A family without faults has none, as its base is varied.
    """
    if not family.has_faults:
        return {}
    at_rest = (*FAMILIES[family.name].settings, "start=rest", "queue=zero", *family.settings)
    bases = {"on_reference": family.base, "from_rest": load_scenario("paper", None, at_rest)}
    return {
        name: {
            where: run_in_bulk(replace(base, tuner=tuner)).figures.accumulated_error
            for where, base in bases.items()
        }
        for name, tuner in {"default": family.base.tuner, **tuners}.items()
    }


def _compare(
    family: Family,
    table: dict[str, list[Runs]],
    files: dict[str, dict[str, Any]],
    nominal: dict[str, dict[str, float]],
) -> Evaluation:
    """Compare the candidates: the fixed gains, then each tuner."""
    tuners = [name for name in table if name != _FIXED]
    names, fixed = (*family.gains, *tuners), len(family.gains)

    def by_candidate(name: str) -> Array:
        """Return a result (c, n) of each candidate under each condition."""
        return np.vstack([np.array([run[name] for run in runs]).T for runs in table.values()])

    J, error = by_candidate("J"), by_candidate("accumulated_error")
    faults = [fault_of(draw) if family.has_faults else "" for draw in family.draws]
    by_error = compare_errors(names, fixed, error, family.seed)
    completed = np.isfinite(error)
    by_cost = compare_costs(names, fixed, J, completed, np.array(faults), family.seed)
    candidates = {  # with hindsight, which has no E_ac
        name: by_error["candidates"].get(name, {}) | costs
        for name, costs in by_cost["candidates"].items()
    }
    loops = Counter(str(loop) for loop in np.concatenate(by_candidate("loop")) if loop)
    summary = {
        **by_error,
        **by_cost,
        "candidates": candidates,
        "fallbacks": {
            name: sum(int(run["fallbacks"][0]) for run in table[name]) for name in tuners
        },
        "loops": dict(loops.most_common()),
        "scenarios": [
            draw | {"E_ac": dict(zip(names, errors, strict=True))}
            for draw, errors in zip(family.draws, error.T, strict=True)
        ],
        "family": FAMILIES[family.name].about if family.has_faults else family.name,
        "seed": family.seed,
        "networks": {name: file["sha256"] for name, file in files.items()},
        "network": list(files.values())[-1],
        "base": scenario_to_dict(family.base),
        "nominal": nominal,
    }
    ratios = {
        name: [[ratio_of(w) for w in run["used"][0] if np.isfinite(w).all()] for run in table[name]]
        for name in tuners
    }
    return Evaluation(family, names, J, error, ratios, summary)


def compare_errors(names: Sequence[str], fixed: int, error: Array, seed: int) -> dict[str, Any]:
    """Compare E_ac (c, n) in % s, NaN for a failure, of the fixed gains first and the tuner last.

    Returns:
        `candidates`: by name, `failures` (of all conditions), `mean` with `interval` (95 %,
        Student) and `worst` over the conditions that all complete; `common`, their number;
        `best_fixed`, of fewest failures, then of least mean; `improvement` of the tuner on it,
        1 - ratio of the means, with `improvement_interval` (95 %, bootstrap over conditions,
        paired); `hindsight`, the same for the best gain of each condition.
    """
    failed = np.isnan(error)
    common = error[:, ~failed.any(axis=0)]
    number, failures = common.shape[1], failed.sum(axis=1)
    if number == 0:
        common = np.full((len(names), 1), np.nan)
    mean, half = common.mean(axis=1), np.full(len(names), np.nan)
    if number > 1:
        half = stats.t.ppf((1 + CONFIDENCE) / 2, number - 1) * stats.sem(common, axis=1)
    best = min(range(fixed), key=lambda i: (failures[i], mean[i]))
    improvement, *ends = _reduction(common[-1], common[best], seed)
    return {
        "candidates": {
            name: {
                "failures": int(failures[i]),
                "mean": mean[i],
                "interval": [np.maximum(0.0, mean[i] - half[i]), mean[i] + half[i]],
                "worst": common[i].max(),
            }
            for i, name in enumerate(names)
        },
        "common": number,
        "best_fixed": names[best],
        "improvement": improvement,
        "hindsight": 1 - common[:fixed].min(axis=0).mean() / mean[best],
        "improvement_interval": ends if number > 1 else [np.nan, np.nan],
    }


def compare_costs(
    names: Sequence[str],
    fixed: int,
    J: Array,
    completed: Flags,
    faults: NDArray[np.str_],
    seed: int,
) -> dict[str, Any]:
    """Compare J (c, n) in % s of candidates, the fixed gains first; conditions have `faults` (n,).

    Returns:
        `candidates`: by name g, m and the number `completed`; `best_g` and `best_m`, the names of
        the fixed gains that are best by each; `gains` of each tuner and of hindsight: the shares by
        which its g is below that of `best_g` (`g`) and that of the rule (`rule`), and its m below
        that of `best_m` (`m`), each [value, low, high]; `by_fault`: `g` for each fault alone.
    """
    log_J = log_cost(J)
    best_g, best_m = int(log_J[:fixed].mean(1).argmin()), int(J[:fixed].mean(1).argmin())
    rule = names.index(RULE) if RULE in names else best_g
    picked, every = log_J[:fixed].argmin(axis=0), np.arange(J.shape[1])
    J_of, log_J_of, completed_of = (
        dict(zip(names, rows, strict=True)) | {HINDSIGHT: rows[picked, every]}
        for rows in (J, log_J, completed)
    )
    tuners = [name for name in J_of if name not in names[:fixed]]

    by_fault: dict[str, dict[str, list[float]]] = {fault: {} for fault in FAULTS}
    for fault in FAULTS:
        has_fault = faults == fault
        for name in tuners if has_fault.any() else ():
            one, other = log_J_of[name][has_fault], log_J[best_g][has_fault]
            by_fault[fault][name] = _reduction(one, other, seed, logarithms=True)
    return {
        "candidates": {
            name: {
                "g": float(np.exp(log_J_of[name].mean())),
                "m": float(J_of[name].mean()),
                "completed": int(completed_of[name].sum()),
            }
            for name in J_of
        },
        "conditions": J.shape[1],
        "best_g": names[best_g],
        "best_m": names[best_m],
        "gains": {
            name: {
                "g": _reduction(log_J_of[name], log_J[best_g], seed, logarithms=True),
                "m": _reduction(J_of[name], J[best_m], seed),
                "rule": _reduction(log_J_of[name], log_J[rule], seed, logarithms=True),
            }
            for name in tuners
        },
        "by_fault": by_fault,
    }


def _reduction(values: Array, others: Array, seed: int, logarithms: bool = False) -> list[float]:
    """Return 1 - mean / mean of the others, and its 95 % interval, by a paired bootstrap.

    The means are geometric if the arguments are logarithms.
    """
    n = len(values)
    resamples = np.random.default_rng(seed).integers(n, size=(RESAMPLES, n))
    ratios: list[Any] = []
    for rows in (np.arange(n), resamples):
        one, other = values[rows].mean(axis=-1), others[rows].mean(axis=-1)
        ratios.append(one - other if logarithms else one / other)
    ends = np.percentile(ratios[1], (97.5, 2.5))  # the largest ratio is the least reduction
    found = np.append(ratios[0], ends)
    return (1 - (np.exp(found) if logarithms else found)).tolist()
