"""Data that a tuner is trained on: the conditions of a family, each run with every fixed gain.

A row holds a sample [state error (12); commanded torque (6)], its densities (45) and, in a family
with faults, the features `health`. A row belongs to a run with its delay, frequency, disturbance,
weights and costs. The rows of a run that ended early stay, empty (NaN) and not valid. A run costs

    J = E_ac up to the end + LOST * seconds that were lost with the plate,

so that every run counts, and a plate that leaves early costs more than one that leaves late.
"""

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
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
from stewart_drake.files.yamlio import brief
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.bulk import Ending, MakeTuner, run_in_bulk
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.tuner import health_of
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import TUNER_INPUTS, WEIGHTS
from stewart_drake.studies.families import SAMPLES, Family, with_gain
from stewart_drake.studies.jobs import Progress, run_jobs
from stewart_drake.tuner.features import HealthFeatures
from stewart_drake.tuner.network import NUM_INPUTS, WINDOW, Network, densities
from stewart_drake.tuner.source import Decision, RatioPolicy, WeightsSource
from stewart_drake.types import Array

LOST: Final = 50.0
"""% s per second."""
EVERY: Final = 2
"""Interval of the samples whose `health` is kept; neighbours are alike."""
WATCHED: Final = 2
"""Interval of the gains whose runs are watched; the others run in C alone."""
LEAST: Final = 1e-3
"""% s; a smaller J counts as this one, so that a run without error is not worth everything."""

_NUMBERS: Final = ("accumulated_error", "cost", "rms_torque", "peak_torque", "torque_variation")
_STATUSES: Final = ("completed", "left_workspace", "solver_failed")
_EXPECTED: Final = "what `tune dataset --out` has written"
_SAMPLE: Final = ("run", "sample", "input")
_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str]]] = {
    "samples": (_SAMPLE, "f"),
    "density": (_SAMPLE, "f"),
    "valid": (("run", "sample"), "b"),
    "weights": (("run", "weight"), "f"),
    "delay_steps": (("run",), "iu"),
    "frequency": (("run",), "f"),
    "disturbance": (("run",), "iu"),
    "status": (("run",), "OUT"),
    "stopped": (("run",), "f"),
    **dict.fromkeys(_NUMBERS, (("run",), "f")),
}
"""Dimensions and kind of number of the variables of a data set."""
_SINCE_0_3: Final[dict[str, tuple[tuple[str, ...], str]]] = {
    "J": (("run",), "f"),
    "health": (("run", "sample", "feature"), "f"),
}
"""The same of those that a file of 0.2 does not have."""

Gains = tuple[tuple[float, float], ...]
"""w_Q and w_R of each run of a condition."""


# ---------------------------------------------------------------- one condition


@dataclass(frozen=True)
class FixedPolicy:
    """A tuner with fixed weights.

    Attributes:
        first: (2,) w_Q and w_R, throughout.
    """

    first: Array

    def decide(self, values: Array, last: Array) -> Decision:
        return Decision(self.first, False)


def watching(w_Q: float, w_R: float) -> MakeTuner:
    """Return the factory of a tuner that computes `health` while the weights are fixed."""

    def make(experiment: Experiment, law: PredictiveLqi) -> WeightsSource:
        return WeightsSource(health_of(experiment, law), FixedPolicy(np.array([w_Q, w_R])))

    return make


def cost(ending: Ending, duration: float) -> float:
    """Compute J in % s of a run whose scenario lasts `duration` s."""
    so_far = ending.error_so_far if np.isfinite(ending.error_so_far) else 0.0
    stopped = ending.stopped
    return so_far if stopped is None else so_far + LOST * (duration - stopped.time)


def watched_run(scenario: Scenario, tuner: MakeTuner, samples: int) -> tuple[Ending, Array]:
    """Run a scenario with a tuner of features `health`.

    Returns:
        How it ended, and the features (samples, 18) after every second sample, else NaN.
    """
    made: list[HealthFeatures] = []

    def make(experiment: Experiment, law: PredictiveLqi) -> WeightsSource | None:
        source = tuner(experiment, law)
        assert source is not None and isinstance(source.features, HealthFeatures)
        made.append(source.features)
        return source

    ending, health = run_in_bulk(scenario, tuner=make), np.full((samples, NUM_INPUTS), np.nan)
    padded = np.vstack([np.full((WINDOW, ending.rows.shape[1]), np.nan), ending.rows])
    for k in range(0, min(len(ending.rows), samples), EVERY):
        health[k] = made[0].values(padded[k + 1 : k + 1 + WINDOW])
    return ending, health


def run_condition(
    scenario: Scenario, gains: Gains, samples: int = SAMPLES, watch: bool = False
) -> bytes:
    """Run a condition with each gain: the bytes of an .npz file.

    Args:
        scenario: the condition.
        gains: w_Q and w_R of each run.
        samples: number of samples that are kept.
        watch: whether `health` is computed, for every second gain.
    """
    runs = []
    for i, gain in enumerate(gains):
        run = with_gain(scenario, *gain)
        if watch and i % WATCHED == 0:
            runs.append(watched_run(run, watching(*gain), samples))
        else:
            runs.append((run_in_bulk(run), np.full((samples, NUM_INPUTS), np.nan)))
    return _file(runs, scenario.duration)


def roll_out(scenario: Scenario, network: Network, samples: int) -> bytes:
    """Run a condition with a network: the same file of one run."""

    def make(experiment: Experiment, law: PredictiveLqi) -> WeightsSource:
        return WeightsSource(health_of(experiment, law), RatioPolicy(network))

    return _file([watched_run(scenario, make, samples)], scenario.duration)


def _file(runs: list[tuple[Ending, Array]], duration: float) -> bytes:
    rows = np.full((len(runs), len(runs[0][1]), NUM_INPUTS), np.nan)
    for row, (ending, _) in zip(rows, runs, strict=True):
        row[: len(ending.samples)] = ending.samples[: len(row)]
    endings = [ending for ending, _ in runs]
    arrays: dict[str, Any] = {
        "samples": rows,
        "health": np.array([health for _, health in runs], dtype=np.float32),
        "status": np.array([one.status for one in endings]),
        "stopped": [np.nan if one.stopped is None else one.stopped.time for one in endings],
        "J": [cost(one, duration) for one in endings],
    }
    arrays |= {name: [getattr(one.figures, name) for one in endings] for name in _NUMBERS}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def read_condition(path: Path, runs: int, samples: int = SAMPLES) -> dict[str, NDArray[Any]]:
    """Read the file of a condition with so many runs.

    Raises:
        ConfigError: the file is damaged; one line.
    """
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {
        "samples": ("f", (runs, samples, len(TUNER_INPUTS))),
        "health": ("f", (runs, samples, NUM_INPUTS)),
        "status": ("U", (runs,)),
        **dict.fromkeys(("stopped", "J", *_NUMBERS), ("f", (runs,))),
    }
    found = load_npz(path, shapes, "the file of one condition of `tune dataset`")
    there = np.isfinite(found["samples"]).all(axis=2)
    numbers = np.array([found[name] for name in ("stopped", "J", *_NUMBERS)])
    done, unknown = found["status"] == "completed", ~np.isin(found["status"], _STATUSES)
    problem = None
    if unknown.any():
        got = brief(str(found["status"][unknown][0]))
        problem = f"status: got {got}; expected one of {', '.join(_STATUSES)}"
    elif np.isinf(numbers).any() or (numbers < 0).any() or np.isnan(found["J"]).any():
        problem = "a number of it is infinite or negative; expected NaN or what is measured"
    elif (np.isnan(found["stopped"]) != done).any() or (
        np.isnan(found["accumulated_error"]) == done
    ).any():
        problem = "stopped and E_ac do not go with the status; expected those of one run"
    elif not there[done].all() or not np.isnan(found["samples"][~there]).all():
        problem = "samples: some are missing; expected all of a run that completed"
    if problem:
        raise ConfigError(f"{path}: {problem}")
    return found


# ---------------------------------------------------------------- the data set


def make_data(
    family: Family,
    directory: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Run all conditions, or go on with them, and write dataset.nc.

    Args:
        family: for training.
        directory: for dataset.nc; the runs are kept in conditions/ there, a file per condition.
        workers, scheduler, progress: as `run_jobs` takes them.

    Returns:
        What `load_data` reads back.

    Raises:
        As `run_jobs`.
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
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    more = {
        "draws": family.draws,
        "family": family.name,
        "gains": list(family.gains),
        "seed": family.seed,
    }
    data = assemble(family, kept, settings | more)
    # A summary that is there describes the data set beside it.
    (directory / "summary.json").unlink(missing_ok=True)
    remove_partials(directory)
    write_netcdf(directory / "dataset.nc", data)
    return data


def assemble(
    family: Family, kept: Mapping[str, dict[str, NDArray[Any]]], settings: Mapping[str, Any]
) -> xr.Dataset:
    """Join what `read_condition` returns of all conditions into one data set."""
    conditions, gains = family.conditions.values(), list(family.gains.values())

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([kept[key][name] for key in family.conditions])

    rows = joined("samples")
    rho = np.array([densities(one) for one in rows]).reshape(rows.shape)
    valid = np.isfinite(rows).all(axis=2)
    rho = np.where(valid[..., None], rho, np.nan)
    if family.has_faults:  # of which there are many runs
        rows, rho = rows.astype(np.float32), rho.astype(np.float32)
    variables: dict[str, Any] = {
        "samples": (_SAMPLE, rows),
        "density": (_SAMPLE, rho),
        "valid": (("run", "sample"), valid),
        "weights": (("run", "weight"), np.tile(gains, (len(conditions), 1))),
        **{
            name: ("run", np.repeat([getattr(one, name) for one in conditions], len(gains)), unit)
            for name, unit in (
                ("delay_steps", {}),
                ("frequency", {"units": "rad/s"}),
                ("disturbance", {}),
            )
        },
        "status": ("run", list(map(str, joined("status")))),
        "stopped": ("run", joined("stopped"), {"units": "s"}),
        "J": ("run", joined("J"), {"units": "% s"}),
    }
    variables |= {name: ("run", joined(name)) for name in _NUMBERS}
    if family.has_faults:
        variables["health"] = (("run", "sample", "feature"), joined("health"))
    runs = [f"{key}_{name}" for key in family.conditions for name in family.gains]
    coordinates = {"run": runs, "input": list(TUNER_INPUTS), "weight": list(WEIGHTS)}
    attributes = {"settings": json.dumps(settings, sort_keys=True)}
    return xr.Dataset(variables, coordinates, attributes)


def load_data(path: str | Path) -> xr.Dataset:
    """Read dataset.nc, or the one in a folder.

    Raises:
        ConfigError: there is none, or it is not a data set of this kind.
    """
    path = Path(path)
    if (path / "curves").is_dir() and not (path / "dataset.nc").exists():
        raise ConfigError(
            f"data: {str(path / 'curves')!r} is of version 0.2; run the same `tune dataset` again"
        )
    path = path / "dataset.nc" if path.is_dir() else path
    if not path.exists():
        raise ConfigError(f"data: no file {str(path)!r}; expected {_EXPECTED}")
    data = load_netcdf(path, _EXPECTED)
    problem = _problem(data)
    if problem:
        raise ConfigError(f"{path}: is not a data set ({problem}); expected {_EXPECTED}")
    return data


def _problem(data: xr.Dataset) -> str | None:
    """Return what distinguishes a file from one that `make_data` has written, or None."""
    known = _VARIABLES | {name: one for name, one in _SINCE_0_3.items() if name in data.data_vars}
    for name, (dimensions, kinds) in known.items():
        if name not in data.data_vars:
            return f"it has no {name}"
        if data[name].dims != dimensions or data[name].dtype.kind not in kinds:
            return f"{name} is {data[name].dtype} over {data[name].dims}"
    sizes = data.sizes
    if not (sizes["run"] and sizes["sample"]) or "run" not in data.coords:
        return "it has no runs"
    if (sizes["input"], sizes["weight"]) != (len(TUNER_INPUTS), len(WEIGHTS)):
        return f"a sample has {sizes['input']} values and {sizes['weight']} weights"
    if sizes.get("feature", NUM_INPUTS) != NUM_INPUTS:
        return f"health has {sizes['feature']} values"
    samples, valid, weights = data.samples.values, data.valid.values, data.weights.values
    if not np.array_equal(np.isfinite(samples).all(axis=2), valid) or np.isinf(samples).any():
        return "valid is not where its samples are finite"
    if not np.all((weights > 0) & np.isfinite(weights)):
        return "a weight is no positive number"
    if "J" in data and not np.all(np.isfinite(data.J.values) & (data.J.values >= 0)):
        return "a J is negative or not finite"
    done, error = data.status.values == "completed", data.accumulated_error.values
    if not np.array_equal(np.isfinite(error), done) or np.any(error[done] < 0):
        return "E_ac is not where its runs are completed"
    try:
        settings = json.loads(data.attrs["settings"])
        return None if isinstance(settings["data"], str) else "its settings are damaged"
    except (KeyError, TypeError, ValueError, RecursionError):
        return "its settings are damaged"


def data_hash(data: xr.Dataset) -> str:
    """Compute SHA-256 over the values that training sees: samples and what is known of each run."""
    digest = hashlib.sha256()
    for name in ("samples", "weights", "delay_steps", "frequency", "disturbance", *_NUMBERS):
        values = np.ascontiguousarray(data[name].values, dtype="<f8")
        # One bit pattern for missing values.
        digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
    return digest.hexdigest()


def log_cost(data: xr.Dataset) -> Array:
    """Return the natural logarithm of J of each run."""
    return np.log(np.maximum(np.asarray(data.J.values, dtype=np.float64), LEAST))


def cells(data: xr.Dataset) -> list[NDArray[np.intp]]:
    """Return the numbers of the runs that differ in their weights only, one entry per condition."""
    conditions = np.column_stack(
        [data[name].values for name in ("delay_steps", "frequency", "disturbance")]
    )
    _, group = np.unique(conditions, axis=0, return_inverse=True)
    return [np.flatnonzero(group == number) for number in range(group.max(initial=-1) + 1)]


def summarize(data: xr.Dataset) -> dict[str, Any]:
    """Return what `summary.json` of a data set holds.

    `g` is the geometric mean of J by gain, `completed` the number of conditions that it completes,
    `hindsight` g with the best gain of each condition.
    """
    settings = json.loads(data.attrs["settings"])
    names, status = settings["gains"], data.status.values
    log_J = log_cost(data).reshape(-1, len(names))
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
