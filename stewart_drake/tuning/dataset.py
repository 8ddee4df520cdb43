"""The data that a tuner is trained on: runs with fixed weights, 100 samples each (III-D).

Every row holds a sample [state error (12); commanded torque (6)] and its densities (45), and
belongs to a run with its delay, frequency, disturbance and weights. The rows of a run that ended
early stay, empty (NaN) and not valid, so that runs are never dropped quietly.
"""

import hashlib
import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from stewart_drake.files.arrayio import load_netcdf, load_npz, write_netcdf
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.versions import versions
from stewart_drake.files.yamlio import brief
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import TUNER_INPUTS, WEIGHTS
from stewart_drake.studies.disturbances import draw
from stewart_drake.studies.jobs import Progress, run_jobs
from stewart_drake.tuner.density import densities
from stewart_drake.tuning.grid import SAMPLES, Run, disturbed_runs, paper_runs
from stewart_drake.types import Array

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
"""Dimensions and kind of number of what a data set holds."""


def make_dataset(
    scenario: Scenario,
    directory: str | Path,
    *,
    disturbances: int = 0,
    seed: int = 0,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Run the grid, or go on with it, and write dataset.nc; the runs are kept in runs/.

    Args:
        scenario: base of all runs; its controller is the paper's master.
        directory: for dataset.nc.
        disturbances: number of disturbed cells to draw instead of the paper's grid; more of them
            may be asked for later.
        seed: of the draws.
        workers, scheduler, progress: as `run_jobs` takes them.

    Returns:
        What `load_dataset` reads back.

    Raises:
        As `run_jobs`, and ConfigError for a scenario that does not suit.
    """
    if disturbances < 0:
        raise ConfigError(f"--disturbed: got {disturbances}; expected 0 or more")
    if disturbances:
        draws = draw(scenario, disturbances, seed, "training")
        runs = disturbed_runs(scenario, draws)
    else:
        draws, runs = [], paper_runs(scenario)
    settings: dict[str, Any] = {
        "scenario": scenario_to_dict(scenario),
        "data": f"disturbed, seed {seed}" if disturbances else "paper",
    }
    directory = Path(directory)
    kept = run_jobs(
        {key: (run.scenario,) for key, run in runs.items()},
        sample_run,
        directory / "runs",
        settings=settings,
        suffix=".npz",
        read=read_run,
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    dataset = assemble(runs, kept, settings | {"draws": draws})
    # A summary that is there speaks of the data set beside it.
    (directory / "summary.json").unlink(missing_ok=True)
    remove_partials(directory)
    write_netcdf(directory / "dataset.nc", dataset)
    return dataset


def sample_run(scenario: Scenario) -> bytes:
    """One run as the bytes of an .npz file: the samples, and how the run ended."""
    ending, buffer = run_in_bulk(scenario), io.BytesIO()
    numbers = ending.figures._asdict()
    arrays: dict[str, Any] = {
        "samples": first_samples(ending.samples),
        "status": np.array(ending.status),
        "stopped": np.nan if ending.stopped is None else ending.stopped.time,
    }
    np.savez(buffer, **arrays, **{name: numbers[name] for name in _NUMBERS})
    return buffer.getvalue()


def first_samples(samples: Array) -> Array:
    """(100, 18) of those of a run, see `loop.bulk.Ending`, NaN after its end."""
    rows = np.full((SAMPLES, len(TUNER_INPUTS)), np.nan)
    rows[: len(samples)] = samples[:SAMPLES]
    return rows


def assemble(
    runs: Mapping[str, Run], kept: Mapping[str, dict[str, Any]], settings: Mapping[str, Any]
) -> xr.Dataset:
    """All runs, and what `read_run` tells of each, as one data set over (run, sample, input)."""
    read = [kept[key] for key in runs]
    rows = np.array([one["samples"] for one in read]).reshape(-1, SAMPLES, len(TUNER_INPUTS))
    valid = np.isfinite(rows).all(axis=2)
    rho = np.array([densities(one) for one in rows]).reshape(rows.shape)
    variables: dict[str, Any] = {
        "samples": (("run", "sample", "input"), rows),
        "density": (("run", "sample", "input"), np.where(valid[..., None], rho, np.nan)),
        "valid": (("run", "sample"), valid),
        "weights": (("run", "weight"), [[run.w_Q, run.w_R] for run in runs.values()]),
        "delay_steps": ("run", [run.delay_steps for run in runs.values()]),
        "frequency": ("run", [run.frequency for run in runs.values()], {"units": "rad/s"}),
        "disturbance": ("run", [run.disturbance for run in runs.values()]),
        "status": ("run", [str(one["status"]) for one in read]),
        "stopped": ("run", [float(one["stopped"]) for one in read], {"units": "s"}),
    }
    variables |= {name: ("run", [float(one[name]) for one in read]) for name in _NUMBERS}
    coordinates = {"run": list(runs), "input": list(TUNER_INPUTS), "weight": list(WEIGHTS)}
    attributes = {"settings": json.dumps(settings, sort_keys=True)}
    return xr.Dataset(variables, coordinates, attributes)


def load_dataset(path: str | Path) -> xr.Dataset:
    """Read dataset.nc, or the one in a folder.

    Raises:
        ConfigError: there is none, or it is not a data set of this kind.
    """
    path = Path(path)
    path = path / "dataset.nc" if path.is_dir() else path
    if not path.exists():
        raise ConfigError(f"data: no file {str(path)!r}; expected {_EXPECTED}")
    dataset = load_netcdf(path, _EXPECTED)
    problem = _problem(dataset)
    if problem:
        raise ConfigError(f"{path}: is not a data set ({problem}); expected {_EXPECTED}")
    return dataset


def _problem(dataset: xr.Dataset) -> str | None:
    """What tells a file from one that `make_dataset` has written, or None."""
    for name, (dimensions, kinds) in _VARIABLES.items():
        if name not in dataset.data_vars:
            return f"it has no {name}"
        if dataset[name].dims != dimensions or dataset[name].dtype.kind not in kinds:
            return f"{name} is {dataset[name].dtype} over {dataset[name].dims}"
    sizes = dataset.sizes
    if not (sizes["run"] and sizes["sample"]) or "run" not in dataset.coords:
        return "it has no runs"
    if (sizes["input"], sizes["weight"]) != (len(TUNER_INPUTS), len(WEIGHTS)):
        return f"a sample has {sizes['input']} values and {sizes['weight']} weights"
    samples, valid, weights = dataset.samples.values, dataset.valid.values, dataset.weights.values
    if not np.array_equal(np.isfinite(samples).all(axis=2), valid) or np.isinf(samples).any():
        return "valid is not where its samples are finite"
    if not np.all((weights > 0) & np.isfinite(weights)):
        return "a weight is no positive number"
    done = dataset.status.values == "completed"
    error = dataset.accumulated_error.values
    if not np.array_equal(np.isfinite(error), done) or np.any(error[done] < 0):
        return "E_ac is not where its runs are completed"
    try:
        settings = json.loads(dataset.attrs["settings"])
        return None if isinstance(settings["data"], str) else "its settings are damaged"
    except (KeyError, TypeError, ValueError, RecursionError):
        return "its settings are damaged"


def data_hash(dataset: xr.Dataset) -> str:
    """SHA-256 over the values that training sees: samples and what is known of each run."""
    digest = hashlib.sha256()
    for name in ("samples", "weights", "delay_steps", "frequency", "disturbance", *_NUMBERS):
        values = np.ascontiguousarray(dataset[name].values, dtype="<f8")
        # One bit pattern for what is not there.
        digest.update(np.where(np.isnan(values), np.nan, values).tobytes())
    return digest.hexdigest()


def summarize(dataset: xr.Dataset) -> dict[str, Any]:
    """What `summary.json` of a data set holds."""
    status = dataset.status.values
    failed = np.flatnonzero(status != "completed")
    return {
        "runs": dataset.sizes["run"],
        "rows": dataset.sizes["run"] * dataset.sizes["sample"],
        "valid_rows": int(dataset.valid.sum()),
        "failed_runs": {
            str(dataset.run.values[i]): {
                "status": str(status[i]),
                "time": float(dataset.stopped.values[i]),
            }
            for i in failed
        },
        "data_sha256": data_hash(dataset),
        **json.loads(dataset.attrs["settings"]),
        "versions": versions(),
    }


def read_run(path: Path) -> dict[str, Any]:
    """What `sample_run` has kept of a run.

    Raises:
        ConfigError: the file is damaged; one line.
    """
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {
        "samples": ("f", (SAMPLES, len(TUNER_INPUTS))),
        "status": ("U", ()),
        "stopped": ("f", ()),
        **dict.fromkeys(_NUMBERS, ("f", ())),
    }
    run = load_npz(path, shapes, "the file of one run of `tune dataset`")
    numbers = {name: float(run[name]) for name in ("stopped", *_NUMBERS)}
    status, there = str(run["status"]), np.isfinite(run["samples"]).all(axis=1)
    done = status == "completed"
    problem = None
    if status not in _STATUSES:
        problem = f"status: got {brief(status)}; expected one of {', '.join(_STATUSES)}"
    elif any(math.isinf(value) or value < 0 for value in numbers.values()):
        problem = "a number of it is infinite or negative; expected NaN or what is measured"
    elif math.isnan(numbers["stopped"]) != done or math.isnan(numbers["accumulated_error"]) == done:
        problem = f"stopped and E_ac do not go with status {status}"
    elif there.sum() < SAMPLES and (done or not np.isnan(run["samples"][~there]).all()):
        problem = "samples: some are missing; expected all of a run that completed"
    if problem:
        raise ConfigError(f"{path}: {problem}")
    return {"samples": run["samples"], "status": status, **numbers}
