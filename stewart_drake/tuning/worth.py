"""What a tuner is worth: against every fixed ratio on fresh conditions of a family, none left out.

A run that is lost counts by J (`tuning.curves`), so that every candidate is judged on all
conditions. g is the geometric mean of J, in which every condition weighs alike, m the mean, in
which bad ones do. The fixed ratio that a tuner is compared with is the best one *of these very
conditions*, by g and by m; hindsight has the best one of each. Intervals are of a paired bootstrap.
"""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import read_bytes
from stewart_drake.files.jsonio import load_json, sealed_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import validate
from stewart_drake.loop.bulk import Ending, run_in_bulk
from stewart_drake.scenario.config import AnnTunerConfig, RuleTunerConfig, Scenario
from stewart_drake.scenario.loading import load_scenario, scenario_to_dict
from stewart_drake.studies.families import (
    FAMILIES,
    FAULTS,
    base_of,
    condition,
    draw_family,
    fault_of,
)
from stewart_drake.studies.jobs import Job, Progress, run_jobs
from stewart_drake.studies.uncertainty import Draw
from stewart_drake.tuner.network import EXPECTED, MAX_BYTES, load_network
from stewart_drake.tuner.source import ratio_of
from stewart_drake.tuning.curves import LEAST, RATIOS, at_ratio, cost, fixed_name
from stewart_drake.types import Array

SHIPPED: Final = {"T": "health_T", "N2": "health_N2"}
"""Networks by family."""
RULE: Final = "rule"
HINDSIGHT: Final = "hindsight"
RESAMPLES: Final = 10_000
ENDS: Final = (2.5, 97.5)
"""Percent, of an interval."""
_MAX_BYTES: Final = 1_000_000

_Cost = Annotated[float, Field(ge=0)]


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class Told:
    """What is kept of the runs of one condition.

    Attributes:
        cost: J of each in % s.
        completed: whether each did.
        ratio: log10(w_Q / w_R) at the samples, of the only run with a tuner, else nothing.
        fallbacks: samples at which who decides was passed over.
        loop: what ran the last of them.
    """

    cost: list[_Cost]
    completed: list[bool]
    ratio: list[float]
    fallbacks: Annotated[int, Field(ge=0)]
    loop: str


class Worth(NamedTuple):
    """What every candidate did under every condition.

    Attributes:
        family: name of it.
        names: of the candidates: the fixed ratios, then the tuners.
        draws: n conditions.
        cost: (c, n) J in % s.
        completed: (c, n).
        ratios: by tuner, of each condition log10(w_Q / w_R) at the samples.
        summary: what `summary.json` holds.
    """

    family: str
    names: tuple[str, ...]
    draws: list[Draw]
    cost: Array
    completed: NDArray[np.bool_]
    ratios: dict[str, list[list[float]]]
    summary: dict[str, Any]


FIXED: Final = tuple(fixed_name(ratio) for ratio in RATIOS)
_FIXED: Final = "fixed"
"""All of these together."""


def fixed_runs(scenario: Scenario) -> bytes:
    """A condition with each of RATIOS, as the bytes of a JSON file."""
    return _file([run_in_bulk(at_ratio(scenario, ratio)) for ratio in RATIOS], scenario, False)


def tuned_run(scenario: Scenario) -> bytes:
    """A condition with the scenario's tuner, the same."""
    return _file([run_in_bulk(scenario)], scenario, True)


def _file(endings: list[Ending], scenario: Scenario, tuned: bool) -> bytes:
    last = endings[-1]
    told = {
        "cost": [cost(one, scenario.duration) for one in endings],
        "completed": [one.stopped is None for one in endings],
        "ratio": [ratio_of(w) for w in last.weights] if tuned else [],
        "fallbacks": last.counts["tuner_fallbacks"],
        "loop": last.loop,
    }
    return sealed_json(told)


def read_told(path: Path, runs: int = 1) -> Told:
    """The file of a condition, of so many runs.

    Raises:
        ConfigError: it is damaged; one line.
    """
    expected = "the file of one condition of `tune evaluate --family`"
    told = validate(Told, load_json(path, _MAX_BYTES, expected, sealed=True), str(path))
    for name in ("cost", "completed"):
        if len(getattr(told, name)) != runs:
            raise ConfigError(
                f"{path}: {name}: got {len(getattr(told, name))} runs; expected {runs}"
            )
    return told


def weigh(
    family: str,
    networks: list[str],
    directory: str | Path,
    *,
    conditions: int = 120,
    seed: int = 0,
    settings: tuple[str, ...] = (),
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Worth:
    """Run all candidates under conditions drawn from a seed, or go on with it.

    Args:
        family: name in `studies.families.FAMILIES`.
        networks: shipped names or files.
        directory: the runs are kept in fixed/, rule/ and NAME-HASH/ there.
        conditions: number to draw, at least 2; those for training are others.
        seed: of the draws.
        settings: further ones of the scenario, for all candidates.
        workers, scheduler, progress: as `run_jobs` takes them.

    Raises:
        As `run_jobs` and `load_network`.
    """
    if conditions < 2:
        raise ConfigError(f"--scenarios: got {conditions}; expected 2 or more")
    base, directory = base_of(family, settings), Path(directory)
    draws = draw_family(family, conditions, seed, "evaluation")
    cells = [condition(base, one) for one in draws]
    tuners, contents = tuners_of(networks)
    common = {"family": family, "seed": seed, "scenario": scenario_to_dict(base)}
    total, done, table = conditions * (1 + len(tuners)), 0, dict[str, list[Told]]()

    def run(name: str, function: Callable[..., bytes], jobs: dict[str, Job], extra: Any) -> None:
        nonlocal done

        def counted(number: int, _: int) -> None:
            if progress is not None:
                progress(done + number, total)

        content = extra.get("network", "")
        found = run_jobs(
            jobs,
            function,
            directory / (f"{name}-{content[:8]}" if content else name),
            settings=common | extra,
            read=partial(read_told, runs=len(RATIOS) if function is fixed_runs else 1),
            workers=workers,
            scheduler=scheduler,
            progress=counted,
        )
        table[name], done = list(found.values()), done + len(jobs)

    run(_FIXED, fixed_runs, {f"{i:04d}": (cell,) for i, cell in enumerate(cells)}, {})
    for name, tuner in tuners.items():
        jobs = {f"{i:04d}": (replace(cell, tuner=tuner),) for i, cell in enumerate(cells)}
        run(name, tuned_run, jobs, {"network": contents[name]} if name in contents else {})
    about = {"family": FAMILIES[family].about, "seed": seed, "networks": contents}
    nominal = nominal_prices(family, settings, tuners)
    return judged(family, draws, table, about | {"base": common["scenario"], "nominal": nominal})


def tuners_of(
    networks: list[str],
) -> tuple[dict[str, AnnTunerConfig | RuleTunerConfig], dict[str, str]]:
    """Sections by the name of the candidate, the rule's first, and SHA-256 of the networks' files.

    Raises:
        ConfigError: no such network, two of one name, or one of another candidate's.
    """
    tuners: dict[str, AnnTunerConfig | RuleTunerConfig] = {RULE: RuleTunerConfig()}
    contents = {}
    for one in networks:
        path = resolve("weights", one)
        load_network(path)
        if path.stem in (*tuners, *FIXED, _FIXED, HINDSIGHT):
            raise ConfigError(
                f"weights: got {path.stem!r}, which another candidate is called; expected a file "
                "of a name of its own"
            )
        tuners[path.stem] = AnnTunerConfig(weights=str(path))
        contents[path.stem] = hashlib.sha256(read_bytes(path, MAX_BYTES, EXPECTED)).hexdigest()
    return tuners, contents


def nominal_prices(
    family: str, settings: tuple[str, ...], tuners: dict[str, Any]
) -> dict[str, dict[str, float]]:
    """E_ac in % s of `paper` as it is, by candidate: on the reference and from rest."""
    result: dict[str, dict[str, float]] = {}
    bases = {
        "on_reference": base_of(family, settings),
        "from_rest": load_scenario(
            "paper", None, (*FAMILIES[family].settings, "start=rest", "queue=zero", *settings)
        ),
    }
    for where, base in bases.items():
        for name, scenario in {
            "default": base,
            **{name: replace(base, tuner=tuner) for name, tuner in tuners.items()},
        }.items():
            found = run_in_bulk(scenario).figures.accumulated_error
            result.setdefault(name, {})[where] = found
    return result


def judged(
    family: str, draws: list[Draw], table: dict[str, list[Told]], about: dict[str, Any]
) -> Worth:
    """What runs say together: `fixed`, then each tuner's."""
    tuners = [name for name in table if name != _FIXED]
    rows = [*np.array([one.cost for one in table[_FIXED]]).T]
    rows += [np.array([one.cost[0] for one in table[name]]) for name in tuners]
    done = [*np.array([one.completed for one in table[_FIXED]]).T]
    done += [np.array([one.completed[0] for one in table[name]]) for name in tuners]
    J, completed, names = np.array(rows), np.array(done), (*FIXED, *tuners)
    faults = np.array([fault_of(one) for one in draws])
    summary = {
        **compared(names, J, completed, faults, about["seed"]),
        "fallbacks": {name: sum(one.fallbacks for one in table[name]) for name in tuners},
        "loops": {name: table[name][0].loop for name in table},
        **about,
    }
    ratios = {name: [one.ratio for one in table[name]] for name in tuners}
    return Worth(family, names, draws, J, completed, ratios, summary)


def compared(
    names: tuple[str, ...], J: Array, completed: NDArray[np.bool_], faults: Any, seed: int
) -> dict[str, Any]:
    """g, m and gains of every candidate.

    Args:
        names: of the candidates, the fixed ones first.
        J: (c, n) % s.
        completed: (c, n).
        faults: (n,) names of them.
        seed: of the bootstrap.

    Returns:
        `candidates`: by name g, m and the number `completed`; `best_g` and `best_m`, the names of
        the fixed ones that are best by each; `gains` of each tuner and of hindsight: `g`, the share
        by which its g is below that of `best_g`, `m` the same of `best_m`, `rule` of the rule by g,
        each [value, low, high]; `by_fault`: the first of them for each fault alone.
    """
    log_J, fixed = np.log(np.maximum(J, LEAST)), len(FIXED)
    best_g, best_m = int(log_J[:fixed].mean(1).argmin()), int(J[:fixed].mean(1).argmin())
    rule = names.index(RULE) if RULE in names else best_g
    picked = log_J[:fixed].argmin(axis=0)
    every = np.arange(J.shape[1])
    with_hindsight = {
        **{name: (J[i], log_J[i], completed[i]) for i, name in enumerate(names)},
        HINDSIGHT: (J[picked, every], log_J[picked, every], completed[picked, every]),
    }
    chosen = np.random.default_rng(seed).integers(J.shape[1], size=(RESAMPLES, J.shape[1]))
    gains = {
        name: {
            "g": _gain_g(log_J_one, log_J[best_g], chosen),
            "m": _gain_m(J_one, J[best_m], chosen),
            "rule": _gain_g(log_J_one, log_J[rule], chosen),
        }
        for name, (J_one, log_J_one, _) in with_hindsight.items()
        if name not in FIXED
    }
    by_fault: dict[str, dict[str, list[float]]] = {}
    for fault in FAULTS:
        here = np.flatnonzero(faults == fault)
        if not len(here):
            by_fault[fault] = {}
            continue
        some = np.random.default_rng(seed).integers(len(here), size=(RESAMPLES, len(here)))
        by_fault[fault] = {
            name: _gain_g(with_hindsight[name][1][here], log_J[best_g][here], some)
            for name in gains
        }
    return {
        "candidates": {
            name: {"g": float(np.exp(l.mean())), "m": float(j.mean()), "completed": int(c.sum())}
            for name, (j, l, c) in with_hindsight.items()
        },
        "conditions": J.shape[1],
        "best_g": names[best_g],
        "best_m": names[best_m],
        "gains": gains,
        "by_fault": by_fault,
    }


def _gain_g(log_J: Array, other: Array, chosen: NDArray[np.intp]) -> list[float]:
    """1 - g / g of the other, and its interval."""
    less = log_J - other
    ends = 1 - np.exp(np.percentile(less[chosen].mean(axis=1), ENDS[::-1]))
    return [float(1 - np.exp(less.mean())), *ends.tolist()]


def _gain_m(J: Array, other: Array, chosen: NDArray[np.intp]) -> list[float]:
    """1 - m / m of the other, and its interval."""
    ratio = J[chosen].mean(axis=1) / other[chosen].mean(axis=1)
    return [float(1 - J.mean() / other.mean()), *(1 - np.percentile(ratio, ENDS[::-1])).tolist()]
