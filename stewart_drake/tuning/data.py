"""Data that a tuner is trained on: the conditions of a family, each run with every fixed gain.

A row holds a sample [state error (12); commanded torque (6)], its densities (45) and, in a family
with faults, the features `health`. A row belongs to a run with its delay, frequency, disturbance,
weights and costs. The rows of a run that ended early stay, empty (NaN) and not valid. A run costs

    J = E_ac up to the end + LOST * seconds without the plate,

so that every run counts, and a plate that leaves early costs more than one that leaves late.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.arrayio import load_netcdf, load_npz, write_netcdf
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.versions import versions
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.bulk import Ending, run_in_bulk
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.tuner import health_of
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import TUNER_INPUTS, WEIGHTS
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.tuner.network import NUM_INPUTS, WINDOW, Network
from stewart_drake.tuner.source import (
    FixedPolicy,
    RatioPolicy,
    WeightsSource,
    densities,
)
from stewart_drake.tuning.families import SAMPLES, Family, with_gain
from stewart_drake.types import Array

LOST: Final = 50.0
"""% s per second."""
EVERY: Final = 2
"""Interval of the samples with recorded `health`; neighbours are alike."""
WATCHED: Final = 2
"""Interval of the gains with recorded `health`; the other runs are in C alone."""
LEAST: Final = 1e-3
"""% s; least J in a logarithm, so that a run without error does not outweigh all others."""

_NUMBERS: Final = ("accumulated_error", "cost", "rms_torque", "peak_torque", "torque_variation")
_CONDITION: Final = ("delay_steps", "frequency", "disturbance")
_EXPECTED: Final = "a data set that `tune dataset` has written"
_VARIABLES: Final = {
    "samples": ("run", "sample", "input"),
    "density": ("run", "sample", "input"),
    "valid": ("run", "sample"),
    "weights": ("run", "weight"),
    **dict.fromkeys((*_CONDITION, "status", "stopped", *_NUMBERS), ("run",)),
}
"""Dimensions of the variables of a data set; since 0.3 it also has `J`, with faults `health`."""
_UNITS: Final = {
    "frequency": {"units": "rad/s"},
    "stopped": {"units": "s"},
    "J": {"units": "% s"},
}

Gains = tuple[tuple[float, float], ...]
"""w_Q and w_R of each run of a condition."""


# ---------------------------------------------------------------- one condition


def cost(ending: Ending, duration: float) -> float:
    """Return J in % s of a run of a scenario of `duration` s."""
    so_far = ending.error_so_far if np.isfinite(ending.error_so_far) else 0.0
    stopped = ending.stopped
    return so_far if stopped is None else so_far + LOST * (duration - stopped.time)


def watched_run(
    scenario: Scenario, policy: FixedPolicy | RatioPolicy, samples: int
) -> tuple[Ending, Array]:
    """Run a scenario with weights by a policy, from features `health`.

    Return how it ended, and the features (samples, 18) after every second sample, else NaN.
    """
    made: list[WeightsSource] = []

    def make(experiment: Experiment, law: PredictiveLqi) -> WeightsSource:
        made.append(WeightsSource(law.plant, health_of(experiment, law), policy))
        return made[0]

    ending, health = run_in_bulk(scenario, tuner=make), np.full((samples, NUM_INPUTS), np.nan)
    padded = np.vstack([np.full((WINDOW, ending.rows.shape[1]), np.nan), ending.rows])
    for k in range(0, min(len(ending.rows), samples), EVERY):
        health[k] = made[0].values(padded[k + 1 : k + 1 + WINDOW])
    return ending, health


def run_condition(
    scenario: Scenario, gains: Gains = (), samples: int = SAMPLES, watch: bool = False
) -> bytes:
    """Run a condition with each gain; return the bytes of an .npz file with a number of samples.

    Without gains there is one run with the scenario's own tuner. With `watch` every second run
    records `health`.
    """
    nothing, runs = np.full((samples, NUM_INPUTS), np.nan), []
    for i, gain in enumerate(gains):
        run = with_gain(scenario, *gain)
        if watch and i % WATCHED == 0:
            runs.append(watched_run(run, FixedPolicy(np.array(gain)), samples))
        else:
            runs.append((run_in_bulk(run), nothing))
    return _file(runs or [(run_in_bulk(scenario), nothing)], scenario.duration)


def roll_out(scenario: Scenario, network: Network, samples: int) -> bytes:
    """Run a condition with a network; return the same file of one run."""
    return _file([watched_run(scenario, RatioPolicy(network), samples)], scenario.duration)


def _file(runs: list[tuple[Ending, Array]], duration: float) -> bytes:
    def padded(rows: Array) -> Array:
        whole = np.full((len(runs[0][1]), rows.shape[1]), np.nan)
        whole[: len(rows)] = rows[: len(whole)]
        return whole

    endings = [ending for ending, _ in runs]
    arrays: dict[str, Any] = {
        "samples": [padded(one.samples) for one in endings],
        "used": [padded(one.weights) for one in endings],
        "health": np.array([health for _, health in runs], dtype=np.float32),
        "status": [one.status for one in endings],
        "stopped": [np.nan if one.stopped is None else one.stopped.time for one in endings],
        "J": [cost(one, duration) for one in endings],
        "fallbacks": [one.counts["tuner_fallbacks"] for one in endings],
        "loop": [one.loop for one in endings],
    }
    arrays |= {name: [getattr(one.figures, name) for one in endings] for name in _NUMBERS}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def read_condition(path: Path, runs: int = 1, samples: int = SAMPLES) -> dict[str, NDArray[Any]]:
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {
        "samples": ("f", (runs, samples, len(TUNER_INPUTS))),
        "used": ("f", (runs, samples, len(WEIGHTS))),
        "health": ("f", (runs, samples, NUM_INPUTS)),
        **dict.fromkeys(("status", "loop"), ("U", (runs,))),
        **dict.fromkeys(("stopped", "J", *_NUMBERS), ("f", (runs,))),
        "fallbacks": ("i", (runs,)),
    }
    return load_npz(path, shapes, "the file of one condition of a family")


# ---------------------------------------------------------------- the data set


def make_data(family: Family, directory: str | Path, **how: Any) -> xr.Dataset:
    """Run all conditions of a family for training, or continue, and write dataset.nc.

    The runs are kept in conditions/, a file per condition. `how` are workers, scheduler and
    progress, as `run_jobs` takes them. Returns the data set, as `load_data` reads it.
    """
    directory, gains = Path(directory), tuple(family.gains.values())
    drawn = "" if family.name == "paper" else f", seed {family.seed}"
    settings: dict[str, Any] = {
        "scenario": scenario_to_dict(family.base),
        "data": f"{family.name}{drawn}",
    }
    kept = run_jobs(
        {
            key: (one.scenario, gains, family.samples, family.has_faults)
            for key, one in family.conditions.items()
        },
        run_condition,
        directory / "conditions",
        settings=settings,
        suffix=".npz",
        read=partial(read_condition, runs=len(gains), samples=family.samples),
        **how,
    )
    settings |= {"draws": family.draws, "family": family.name, "seed": family.seed}
    data = assemble(family, kept, settings | {"gains": list(family.gains)})
    (directory / "summary.json").unlink(missing_ok=True)  # that of an earlier data set
    remove_partials(directory)
    write_netcdf(directory / "dataset.nc", data)
    return data


def assemble(
    family: Family, kept: Mapping[str, dict[str, NDArray[Any]]], settings: Mapping[str, Any]
) -> xr.Dataset:
    """Join the results of `read_condition` of all conditions into one data set."""
    conditions, gains = family.conditions.values(), list(family.gains.values())

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([kept[key][name] for key in family.conditions])

    rows = joined("samples")
    rho = np.array([densities(one) for one in rows]).reshape(rows.shape)
    valid = np.isfinite(rows).all(axis=2)
    rho = np.where(valid[..., None], rho, np.nan)
    if family.has_faults:  # with many runs
        rows, rho = rows.astype(np.float32), rho.astype(np.float32)
    columns: dict[str, Any] = {
        "samples": rows,
        "density": rho,
        "valid": valid,
        "weights": np.tile(gains, (len(conditions), 1)),
        **{
            name: np.repeat([getattr(one, name) for one in conditions], len(gains))
            for name in _CONDITION
        },
        "status": list(map(str, joined("status"))),
        **{name: joined(name) for name in ("stopped", "J", *_NUMBERS)},
    }
    variables = {
        name: (_VARIABLES.get(name, "run"), values, _UNITS.get(name))
        for name, values in columns.items()
    }
    if family.has_faults:
        variables["health"] = (("run", "sample", "feature"), joined("health"), None)
    runs = [f"{key}_{name}" for key in family.conditions for name in family.gains]
    coordinates = {"run": runs, "input": list(TUNER_INPUTS), "weight": list(WEIGHTS)}
    attributes = {"settings": json.dumps(settings, sort_keys=True)}
    return xr.Dataset(variables, coordinates, attributes)


def load_data(path: str | Path) -> xr.Dataset:
    """Read dataset.nc, or the one in a folder."""
    path = Path(path)
    if (path / "curves").is_dir() and not (path / "dataset.nc").exists():
        raise ConfigError(
            f"data: {str(path / 'curves')!r} is of version 0.2; run the same `tune dataset` again"
        )
    path = path / "dataset.nc" if path.is_dir() else path
    if not path.exists():
        raise ConfigError(f"data: no file {str(path)!r}; expected {_EXPECTED}")
    data = load_netcdf(path, _EXPECTED)
    wrong = [
        name for name, dims in _VARIABLES.items() if name not in data or data[name].dims != dims
    ]
    settings = data.attrs.get("settings")
    if wrong or "run" not in data.coords or not isinstance(settings, str):
        problem = (
            f"no {wrong[0]} over {_VARIABLES[wrong[0]]}" if wrong else "no runs or no settings"
        )
        raise ConfigError(f"{path}: is not a data set ({problem}); expected {_EXPECTED}")
    return data


def hash_of(*arrays: Any) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array, dtype="<f8")
        # One bit pattern for missing values.
        digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
    return digest.hexdigest()


def data_hash(data: xr.Dataset) -> str:
    """Return the SHA-256 of the values that training uses: samples, weights, conditions, costs."""
    names = ("samples", "weights", *_CONDITION, *_NUMBERS)
    return hash_of(*(data[name].values for name in names))


def log_cost(J: Array) -> Array:
    """Return the natural logarithm of J in % s, which is at least LEAST."""
    return np.log(np.maximum(np.asarray(J, dtype=np.float64), LEAST))


def cells(data: xr.Dataset) -> list[NDArray[np.intp]]:
    """Return the numbers of the runs that differ in their weights only, one entry per condition."""
    conditions = np.column_stack([data[name].values for name in _CONDITION])
    _, group = np.unique(conditions, axis=0, return_inverse=True)
    return [np.flatnonzero(group == number) for number in range(group.max(initial=-1) + 1)]


def summarize(data: xr.Dataset) -> dict[str, Any]:
    """Return the content of `summary.json` of a data set.

    `g` is the geometric mean of J by gain, `completed` the number of conditions that it completes,
    `hindsight` g with the best gain of each condition.
    """
    settings = json.loads(data.attrs["settings"])
    names, status = settings["gains"], data.status.values
    log_J = log_cost(data.J.values).reshape(-1, len(names))
    done = (status == "completed").reshape(log_J.shape)
    return {
        "runs": data.sizes["run"],
        "rows": data.sizes["run"] * data.sizes["sample"],
        "valid_rows": int(data.valid.sum()),
        "failed_runs": {
            str(data.run.values[i]): {
                "status": str(status[i]),
                "time": float(data.stopped.values[i]),
            }
            for i in np.flatnonzero(status != "completed")
        },
        "conditions": len(log_J),
        "g": dict(zip(names, np.exp(log_J.mean(axis=0)).tolist(), strict=True)),
        "completed": dict(zip(names, done.sum(axis=0).tolist(), strict=True)),
        "hindsight": float(np.exp(log_J.min(axis=1).mean())),
        "data_sha256": data_hash(data),
        **settings,
        "versions": versions(),
    }
