"""What a tuner is worth: compared with every fixed gain on conditions that training did not have.

All candidates run the same conditions, so that differences are paired, and the fixed gain that a
tuner is compared with is the best one *of these very conditions*. Two measures judge them:

- E_ac, averaged over the conditions that every candidate completes, with failures counted apart;
- J (`tuning.data`), in which a lost run counts, over all conditions: g is its geometric mean, in
  which every condition weighs alike, m its mean, in which bad ones do.

Hindsight has the best fixed gain of each condition. Intervals are of a paired bootstrap.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass
from scipy import stats

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.jsonio import load_json, sealed_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import validate
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.scenario.config import AnnTunerConfig, RuleTunerConfig, Scenario
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.studies.families import FAMILIES, FAULTS, Family, fault_of, with_gain
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.tuner.network import DEFAULT, EXPECTED, MAX_BYTES, load_network
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.data import LEAST, Gains, cost
from stewart_drake.types import Array

TUNER: Final = "tuner"
"""The only network of a family without faults."""
RULE: Final = "rule"
HINDSIGHT: Final = "hindsight"
CONFIDENCE: Final = 0.95
RESAMPLES: Final = 10_000
_FIXED: Final = "fixed"
"""Folder of the runs with fixed gains."""
_ENDS: Final = (2.5, 97.5)
"""Percentiles of an interval."""
_MAX_BYTES: Final = 1_000_000

_Cost = Annotated[float, Field(ge=0)]
Tuner = AnnTunerConfig | RuleTunerConfig


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class Told:
    """What is kept of the runs of one condition.

    Attributes:
        cost: J of each in % s.
        error: E_ac of each in % s, None for a run that did not complete.
        ratio: log10(w_Q / w_R) at the samples, of the only run with a tuner, else nothing.
        fallbacks: samples at which the tuner was passed over.
        loops: what ran each of them, see `loop.bulk.Ending`.
    """

    cost: list[_Cost]
    error: list[_Cost | None]
    ratio: list[float]
    fallbacks: Annotated[int, Field(ge=0)]
    loops: list[str]


class Worth(NamedTuple):
    """What every candidate did under every condition.

    Attributes:
        family: with its conditions.
        names: of the candidates: the fixed gains, then the tuners.
        cost: (c, n) J in % s.
        error: (c, n) E_ac in % s, NaN for a run that did not complete.
        ratios: by tuner, of each condition log10(w_Q / w_R) at the samples.
        summary: what `summary.json` holds.
    """

    family: Family
    names: tuple[str, ...]
    cost: Array
    error: Array
    ratios: dict[str, list[list[float]]]
    summary: dict[str, Any]

    @property
    def tuners(self) -> tuple[str, ...]:
        """Names of the tuners."""
        return self.names[len(self.family.gains) :]


# ---------------------------------------------------------------- the runs


def fixed_runs(scenario: Scenario, gains: Gains) -> bytes:
    """Run a condition with each gain: the bytes of a JSON file."""
    return _file([with_gain(scenario, *gain) for gain in gains], tuned=False)


def tuned_run(scenario: Scenario) -> bytes:
    """Run a condition with the scenario's tuner: the same file of one run."""
    return _file([scenario], tuned=True)


def _file(scenarios: list[Scenario], *, tuned: bool) -> bytes:
    endings = [run_in_bulk(one) for one in scenarios]
    errors = [one.figures.accumulated_error for one in endings]
    return sealed_json(
        {
            "cost": [cost(one, scenarios[0].duration) for one in endings],
            "error": [error if np.isfinite(error) else None for error in errors],
            "ratio": [ratio_of(w) for w in endings[-1].weights] if tuned else [],
            "fallbacks": endings[-1].counts["tuner_fallbacks"],
            "loops": [one.loop for one in endings],
        }
    )


def read_told(path: Path, runs: int = 1) -> Told:
    """Read the file of a condition of so many runs.

    Raises:
        ConfigError: it is damaged; one line.
    """
    expected = "the file of one condition of `tune evaluate`"
    told = validate(Told, load_json(path, _MAX_BYTES, expected, sealed=True), str(path))
    for name in ("cost", "error", "loops"):
        if len(getattr(told, name)) != runs:
            raise ConfigError(
                f"{path}: {name}: got {len(getattr(told, name))} runs; expected {runs}"
            )
    return told


def tuners_of(
    family: Family, networks: Sequence[str | Path]
) -> tuple[dict[str, Tuner], dict[str, dict[str, Any]]]:
    """Return sections by the name of the candidate, and what is known of the networks' files.

    A family with faults has the rule and any number of networks, which are called by their files;
    another one has one network, called TUNER.

    Raises:
        ConfigError: no such network, too many, two of one name, or one of another candidate's.
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
                f"weights: got {name!r}, which another candidate is called; expected a file of a "
                "name of its own"
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
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Worth:
    """Run all candidates under all conditions, or go on with it.

    Args:
        family: drawn for evaluation.
        networks: shipped names or files; none for the shipped one of the family.
        directory: the runs are kept in fixed/, rule/ and NAME-HASH/ there, so that a second network
            needs its own runs only.
        workers, scheduler, progress: as `run_jobs` takes them.

    Raises:
        As `run_jobs` and `load_network`, and ConfigError for fewer than two conditions.
    """
    cells = {key: one.scenario for key, one in family.conditions.items()}
    if len(cells) < 2:
        raise ConfigError(f"--scenarios: got {len(cells)}; expected 2 or more")
    tuners, files = tuners_of(family, networks)
    about = {"family": family.name, "seed": family.seed, "scenario": scenario_to_dict(family.base)}
    total, table = len(cells) * (1 + len(tuners)), dict[str, list[Told]]()

    def run(name: str, function: Callable[..., bytes], jobs: dict[str, Job], runs: int) -> None:
        done, file = len(table) * len(cells), files.get(name)

        def counted(number: int, _: int) -> None:
            if progress is not None:
                progress(done + number, total)

        found = run_jobs(
            jobs,
            function,
            Path(directory) / (f"{name}-{file['sha256'][:8]}" if file else name),
            settings=about | ({"network": file["sha256"]} if file else {}),
            read=partial(read_told, runs=runs),
            workers=workers,
            scheduler=scheduler,
            progress=counted,
        )
        table[name] = list(found.values())

    gains = tuple(family.gains.values())
    run(_FIXED, fixed_runs, {key: (cell, gains) for key, cell in cells.items()}, len(gains))
    for name, tuner in tuners.items():
        run(name, tuned_run, {k: (replace(cell, tuner=tuner),) for k, cell in cells.items()}, 1)
    return judged(family, table, files, nominal_prices(family, tuners))


def nominal_prices(family: Family, tuners: dict[str, Tuner]) -> dict[str, dict[str, float]]:
    """Compute E_ac in % s of `paper` as it is, by candidate: on the reference and from rest.

    Only for a family with faults; of another one the base is what is varied.
    """
    result: dict[str, dict[str, float]] = {}
    if not family.has_faults:
        return result
    at_rest = (*FAMILIES[family.name].settings, "start=rest", "queue=zero", *family.settings)
    bases = {
        "on_reference": family.base,
        "from_rest": load_scenario("paper", None, at_rest),
    }
    for where, base in bases.items():
        for name, tuner in {"default": base.tuner, **tuners}.items():
            ending = run_in_bulk(replace(base, tuner=tuner))
            result.setdefault(name, {})[where] = ending.figures.accumulated_error
    return result


# ---------------------------------------------------------------- the statistics


def judged(
    family: Family,
    table: dict[str, list[Told]],
    files: dict[str, dict[str, Any]],
    nominal: dict[str, dict[str, float]],
) -> Worth:
    """Compare the candidates: the fixed gains, then each tuner."""
    tuners, names = [name for name in table if name != _FIXED], (*family.gains, *list(table)[1:])

    def rows(name: str) -> Array:
        found = [np.array([getattr(told, name) for told in table[one]]).T for one in table]
        return np.vstack(found).astype(np.float64)  # None becomes NaN

    J, error = rows("cost"), rows("error")
    faults = [fault_of(one) if family.has_faults else "" for one in family.draws]
    fixed, completed = len(family.gains), np.isfinite(error)
    by_error = compare(names, fixed, error, family.seed)
    by_cost = compared(names, fixed, J, completed, np.array(faults), family.seed)
    candidates = {
        name: by_error["candidates"].get(name, {}) | one
        for name, one in by_cost["candidates"].items()
    }
    summary = {
        **by_error,
        **by_cost,
        "candidates": candidates,
        "fallbacks": {name: sum(one.fallbacks for one in table[name]) for name in tuners},
        "loops": dict(
            Counter(
                loop for told in table.values() for one in told for loop in one.loops if loop
            ).most_common()
        ),
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
    ratios = {name: [one.ratio for one in table[name]] for name in tuners}
    return Worth(family, names, J, error, ratios, summary)


def compare(names: Sequence[str], fixed: int, error: Array, seed: int) -> dict[str, Any]:
    """Compare E_ac: means with intervals, failures and worst cases; the last row is the tuner.

    Args:
        names: of the rows.
        fixed: number of the fixed gains, the first rows.
        error: (c, n) E_ac in % s, NaN for a failure.
        seed: of the bootstrap.

    Returns:
        `candidates`: by name, `failures` (of all conditions), `mean` with `interval` (95 %,
        Student) and `worst` over the conditions that all complete; `common`, their number;
        `best_fixed`, of fewest failures, then of least mean; `improvement` of the tuner on it,
        1 - ratio of the means, with `improvement_interval` (95 %, bootstrap over conditions,
        paired); `hindsight`, the same for the best gain of each condition, chosen afterwards.
    """
    failed = np.isnan(error)
    common = error[:, ~failed.any(axis=0)]
    number, failures = common.shape[1], failed.sum(axis=1)
    some = common if number else np.full((len(names), 1), np.nan)
    mean, half = some.mean(axis=1), np.full(len(names), np.nan)
    if number > 1:
        half = stats.t.ppf((1 + CONFIDENCE) / 2, number - 1) * stats.sem(some, axis=1)
    best = min(range(fixed), key=lambda i: (failures[i], mean[i]))

    def improvement(tuner: Array, other: Array, axis: int = -1) -> Any:
        return 1 - tuner.mean(axis=axis) / other.mean(axis=axis)

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
            for i, name in enumerate(names)
        },
        "common": number,
        "best_fixed": names[best],
        "improvement": improvement(some[-1], some[best]),
        "hindsight": 1 - some[:fixed].min(axis=0).mean() / mean[best],
        "improvement_interval": list(map(float, sure)),
    }


def compared(
    names: Sequence[str],
    fixed: int,
    J: Array,
    completed: NDArray[np.bool_],
    faults: NDArray[np.str_],
    seed: int,
) -> dict[str, Any]:
    """Compare J: g, m and gains of every candidate.

    Args:
        names: of the candidates.
        fixed: number of the fixed gains, the first rows.
        J: (c, n) % s.
        completed: (c, n).
        faults: (n,) names of them.
        seed: of the bootstrap.

    Returns:
        `candidates`: by name g, m and the number `completed`; `best_g` and `best_m`, the names of
        the fixed gains that are best by each; `gains` of each tuner and of hindsight: `g`, the
        share by which its g is below that of `best_g`, `m` the same of `best_m`, `rule` of the rule
        by g, each [value, low, high]; `by_fault`: the first of them for each fault alone.
    """
    log_J = np.log(np.maximum(J, LEAST))
    best_g, best_m = int(log_J[:fixed].mean(1).argmin()), int(J[:fixed].mean(1).argmin())
    rule = names.index(RULE) if RULE in names else best_g
    picked, every = log_J[:fixed].argmin(axis=0), np.arange(J.shape[1])
    rows, log_rows, done = (
        dict(zip(names, x, strict=True)) | {HINDSIGHT: x[picked, every]}
        for x in (J, log_J, completed)
    )
    tuners = [name for name in rows if name not in names[:fixed]]
    chosen = np.random.default_rng(seed).integers(J.shape[1], size=(RESAMPLES, J.shape[1]))
    by_fault: dict[str, dict[str, list[float]]] = {}
    for fault in FAULTS:
        here = np.flatnonzero(faults == fault)
        some = np.random.default_rng(seed).integers(max(1, len(here)), size=(RESAMPLES, len(here)))
        by_fault[fault] = {
            name: _gain_g(log_rows[name][here], log_J[best_g][here], some)
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
                "g": _gain_g(log_rows[name], log_J[best_g], chosen),
                "m": _gain_m(rows[name], J[best_m], chosen),
                "rule": _gain_g(log_rows[name], log_J[rule], chosen),
            }
            for name in tuners
        },
        "by_fault": by_fault,
    }


def _gain_g(log_J: Array, other: Array, chosen: NDArray[np.intp]) -> list[float]:
    """Return 1 - g / g of the other, and its interval."""
    less = log_J - other
    ends = 1 - np.exp(np.percentile(less[chosen].mean(axis=1), _ENDS[::-1]))
    return [float(1 - np.exp(less.mean())), *ends.tolist()]


def _gain_m(J: Array, other: Array, chosen: NDArray[np.intp]) -> list[float]:
    """Return 1 - m / m of the other, and its interval."""
    ratio = J[chosen].mean(axis=1) / other[chosen].mean(axis=1)
    return [float(1 - J.mean() / other.mean()), *(1 - np.percentile(ratio, _ENDS[::-1])).tolist()]
