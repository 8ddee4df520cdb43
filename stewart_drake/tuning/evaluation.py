"""Evaluation of a tuner against every fixed gain, on conditions that training did not have.

All candidates run the same conditions, so that differences are paired, and a tuner is compared with
the best fixed gain *of these very conditions*. Two measures judge them:

- E_ac, averaged over the conditions that every candidate completes, with failures counted apart;
- J (`tuning.data`), with lost runs, over all conditions: g is its geometric mean, which weighs all
  conditions alike, m its mean, which bad conditions dominate.

Hindsight has the best fixed gain of each condition. Intervals are of a paired bootstrap.
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


# ---------------------------------------------------------------- the runs


def tuners_of(
    family: Family, networks: Sequence[str | Path]
) -> tuple[dict[str, Tuner], dict[str, dict[str, Any]]]:
    """Return sections by the name of the candidate, and name, hash and card of network files.

    A family with faults has the rule and any number of networks, named by their files. Another one
    has one network, called TUNER.
    """
    if not family.has_faults and len(networks) > 1:
        raise ConfigError(f"WEIGHTS: got {len(networks)} without --family; expected one")
    tuners: dict[str, Tuner] = {RULE: RuleTunerConfig()} if family.has_faults else {}
    files: dict[str, dict[str, Any]] = {}
    shipped = FAMILIES[family.name].network if family.has_faults else DEFAULT
    for one in networks or [shipped]:
        path = resolve("weights", one)
        card = dict(load_network(path).card)
        name = path.stem if family.has_faults else TUNER
        if name in (*tuners, *family.gains, _FIXED, HINDSIGHT):
            raise ConfigError(
                f"weights: got {name!r}, the name of another candidate; expected a file with "
                "another name"
            )
        content = hashlib.sha256(read_bytes(path, MAX_BYTES, EXPECTED)).hexdigest()
        tuners[name] = AnnTunerConfig(weights=str(path))
        files[name] = {"file": path.name, "sha256": content, "card": card}
    return tuners, files


def evaluate(
    family: Family,
    networks: Sequence[str | Path],
    directory: str | Path,
    *,
    progress: Progress | None = None,
    **how: Any,
) -> Evaluation:
    """Run all candidates under all conditions of a family for evaluation, or continue.

    Networks are shipped names or files; none for the shipped one of the family. The directory keeps
    the runs in fixed/, rule/ and NAME-HASH/, so that a second network needs its own runs only.
    `how` are workers and scheduler, as `run_jobs` takes them.
    """
    cells, gains = family.conditions, tuple(family.gains.values())
    tuners, files = tuners_of(family, networks)
    about = {"family": family.name, "seed": family.seed, "scenario": scenario_to_dict(family.base)}
    candidates: dict[str, dict[str, Job]] = {
        _FIXED: {key: (one.scenario, gains, family.samples) for key, one in cells.items()}
    }
    for name, tuner in tuners.items():
        candidates[name] = {
            key: (replace(one.scenario, tuner=tuner), (), family.samples)
            for key, one in cells.items()
        }
    table: dict[str, list[Runs]] = {}
    for name, jobs in candidates.items():
        file, number = files.get(name), 1 if name in tuners else len(gains)
        found = run_jobs(
            jobs,
            run_condition,
            Path(directory) / (f"{name}-{file['sha256'][:8]}" if file else name),
            settings=about | ({"network": file["sha256"]} if file else {}),
            suffix=".npz",
            read=partial(read_condition, runs=number, samples=family.samples),
            progress=part_of(progress, len(table) * len(cells), len(candidates) * len(cells)),
            **how,
        )
        table[name] = list(found.values())
    return _judged(family, table, files, _nominal_costs(family, tuners))


def _nominal_costs(family: Family, tuners: dict[str, Tuner]) -> dict[str, dict[str, float]]:
    """Return E_ac in % s of the nominal `paper` by candidate, on the reference and from rest.

    Only for a family with faults; the base of another one is varied.
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


# ---------------------------------------------------------------- the statistics


def _judged(
    family: Family,
    table: dict[str, list[Runs]],
    files: dict[str, dict[str, Any]],
    nominal: dict[str, dict[str, float]],
) -> Evaluation:
    """Compare the candidates: the fixed gains, then each tuner."""
    tuners = [name for name in table if name != _FIXED]
    names, fixed = (*family.gains, *tuners), len(family.gains)

    def rows(name: str) -> Array:
        return np.vstack([np.array([one[name] for one in runs]).T for runs in table.values()])

    J, error = rows("J"), rows("accumulated_error")
    faults = [fault_of(one) if family.has_faults else "" for one in family.draws]
    by_error = compare_errors(names, fixed, error, family.seed)
    done = np.isfinite(error)
    by_cost = compare_costs(names, fixed, J, done, np.array(faults), family.seed)
    candidates = {
        name: by_error["candidates"].get(name, {}) | one
        for name, one in by_cost["candidates"].items()
    }
    loops = Counter(str(loop) for loop in np.concatenate(rows("loop")) if loop)
    summary = {
        **by_error,
        **by_cost,
        "candidates": candidates,
        "fallbacks": {
            name: sum(int(one["fallbacks"][0]) for one in table[name]) for name in tuners
        },
        "loops": dict(loops.most_common()),
        "scenarios": [
            one | {"E_ac": dict(zip(names, error[:, number], strict=True))}
            for number, one in enumerate(family.draws)
        ],
        "family": FAMILIES[family.name].about if family.has_faults else family.name,
        "seed": family.seed,
        "networks": {name: file["sha256"] for name, file in files.items()},
        "network": list(files.values())[-1],
        "base": scenario_to_dict(family.base),
        "nominal": nominal,
    }
    ratios = {
        name: [[ratio_of(w) for w in one["used"][0] if np.isfinite(w).all()] for one in table[name]]
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
    some = common if number else np.full((len(names), 1), np.nan)
    mean, half = some.mean(axis=1), np.full(len(names), np.nan)
    if number > 1:
        half = stats.t.ppf((1 + CONFIDENCE) / 2, number - 1) * stats.sem(some, axis=1)
    best = min(range(fixed), key=lambda i: (failures[i], mean[i]))

    improvement, *ends = _gain(some[-1], some[best], seed)
    return {
        "candidates": {
            name: {
                "failures": int(failures[i]),
                "mean": mean[i],
                "interval": [mean[i] - half[i], mean[i] + half[i]],
                "worst": some[i].max(),
            }
            for i, name in enumerate(names)
        },
        "common": number,
        "best_fixed": names[best],
        "improvement": improvement,
        "hindsight": 1 - some[:fixed].min(axis=0).mean() / mean[best],
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
        the fixed gains that are best by each; `gains` of each tuner and of hindsight: `g`, the
        share by which its g is below that of `best_g`, `m` the same of `best_m`, `rule` of the rule
        by g, each [value, low, high]; `by_fault`: the first of them for each fault alone.
    """
    log_J = log_cost(J)
    best_g, best_m = int(log_J[:fixed].mean(1).argmin()), int(J[:fixed].mean(1).argmin())
    rule = names.index(RULE) if RULE in names else best_g
    picked, every = log_J[:fixed].argmin(axis=0), np.arange(J.shape[1])
    rows, log_rows, done = (
        dict(zip(names, x, strict=True)) | {HINDSIGHT: x[picked, every]}
        for x in (J, log_J, completed)
    )
    tuners = [name for name in rows if name not in names[:fixed]]

    by_fault: dict[str, dict[str, list[float]]] = {}
    for fault in FAULTS:
        here = np.flatnonzero(faults == fault)
        by_fault[fault] = {
            name: _gain(log_rows[name][here], log_J[best_g][here], seed, logarithms=True)
            for name in tuners
            if len(here)
        }
    return {
        "candidates": {
            name: {
                "g": float(np.exp(log_rows[name].mean())),
                "m": float(row.mean()),
                "completed": int(done[name].sum()),
            }
            for name, row in rows.items()
        },
        "conditions": J.shape[1],
        "best_g": names[best_g],
        "best_m": names[best_m],
        "gains": {
            name: {
                "g": _gain(log_rows[name], log_J[best_g], seed, logarithms=True),
                "m": _gain(rows[name], J[best_m], seed),
                "rule": _gain(log_rows[name], log_J[rule], seed, logarithms=True),
            }
            for name in tuners
        },
        "by_fault": by_fault,
    }


def _gain(values: Array, others: Array, seed: int, logarithms: bool = False) -> list[float]:
    """Return 1 - mean / mean of the others, and its 95 % interval, by a paired bootstrap.

    Of logarithms the means are geometric.
    """
    chosen = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    ratios: list[Any] = []
    for some in (np.arange(len(values)), chosen):
        one, other = values[some].mean(axis=-1), others[some].mean(axis=-1)
        ratios.append(one - other if logarithms else one / other)
    found = np.append(ratios[0], np.percentile(ratios[1], (97.5, 2.5)))
    return (1 - (np.exp(found) if logarithms else found)).tolist()
