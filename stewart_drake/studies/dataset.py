"""The data that a tuner is trained on: runs with fixed weights, 100 samples each (III-D).

Every row holds a sample [state error (12); commanded torque (6)] and its densities (45), and
belongs to a run with its delay, frequency, disturbance and weights. The rows of a run that ended
early stay, empty (NaN) and not valid, so that runs are never dropped quietly.
"""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.config import Scenario
from stewart_drake.errors import ConfigError
from stewart_drake.results import SimulationResult, versions, write_signals
from stewart_drake.scenario_loading import scenario_to_dict
from stewart_drake.signals import TUNER_INPUTS, WEIGHTS
from stewart_drake.simulation import simulate
from stewart_drake.studies.disturbances import draw
from stewart_drake.studies.grid import PAPER_ROWS, SAMPLES, Run, disturbed_runs, paper_runs
from stewart_drake.studies.jobs import Progress, run_jobs
from stewart_drake.systems.sensor import Sensor
from stewart_drake.timing import METRIC_PERIOD
from stewart_drake.tuner.density import densities

Array = NDArray[np.float64]

_NUMBERS: Final = ("accumulated_error", "cost", "rms_torque", "peak_torque", "torque_variation")


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
    files = run_jobs(
        {key: (run.scenario,) for key, run in runs.items()},
        sample_run,
        directory / "runs",
        settings=settings,
        suffix=".npz",
        workers=workers,
        scheduler=scheduler,
        progress=progress,
    )
    dataset = assemble(runs, files, settings | {"draws": [one._asdict() for one in draws]})
    if not disturbances and dataset.sizes["run"] * dataset.sizes["sample"] != PAPER_ROWS:
        raise AssertionError(f"the paper's data set has {PAPER_ROWS} rows")
    # A summary that is there speaks of the data set beside it.
    (directory / "summary.json").unlink(missing_ok=True)
    write_signals(directory / "dataset.nc", dataset)
    return dataset


def sample_run(scenario: Scenario) -> bytes:
    """One run as the bytes of an .npz file: the samples, and how the run ended."""
    result = simulate(scenario)
    if result.status == "interrupted":
        raise KeyboardInterrupt
    buffer = io.BytesIO()
    np.savez(
        buffer,
        samples=samples(result),
        status=np.array(result.status),
        stopped=np.nan if result.stopped is None else result.stopped.time,
        **{name: result.summary[name] for name in _NUMBERS},
    )
    return buffer.getvalue()


def samples(result: SimulationResult) -> Array:
    """(100, 18) of a run: [measurement - reference (12); commanded torque (6)], NaN after its end.

    In rad, m, rad/s, m/s and N m. The measurement is the state with the sensor's own noise.
    """
    sc, signals = result.scenario, result.signals
    period, sensor = sc.controller.period, sc.sensor
    noise = Sensor(np.array(sensor.noise_std), sensor.seed, period)
    rows = np.full((SAMPLES, len(TUNER_INPUTS)), np.nan)
    # Held signals show the value from an instant on, so that of k dt is T_k.
    every = round(period / METRIC_PERIOD)
    state = np.hstack([signals.pose, signals.rates])[::every][:SAMPLES]
    wanted = np.hstack([signals.reference, signals.reference_rates])[::every][:SAMPLES]
    torque = signals.torque_commanded.values[::every][:SAMPLES]
    measured = state + np.array([noise.noise(k) for k in range(len(state))]).reshape(state.shape)
    rows[: len(state)] = np.hstack([measured - wanted, torque])
    return rows


def assemble(
    runs: Mapping[str, Run], files: Mapping[str, Path], settings: Mapping[str, Any]
) -> xr.Dataset:
    """All runs as one data set over (run, sample, input).

    Raises:
        ConfigError: a file is damaged.
    """
    read = [_read(files[key]) for key in runs]
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
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            dataset = file.load()
    except FileNotFoundError:
        raise ConfigError(
            f"data: no file {str(path)!r}; expected what `tune dataset --out` has written"
        ) from None
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"{path}: cannot be read ({reason}); expected what `tune dataset` has written"
        ) from None
    missing = {"samples", "valid", "weights", "accumulated_error"} - set(dataset)
    if missing or dataset.sizes.get("input") != len(TUNER_INPUTS):
        raise ConfigError(f"{path}: is not a data set; expected what `tune dataset` has written")
    return dataset


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


def _read(path: Path) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in ("samples", "status", "stopped", *_NUMBERS)}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise ConfigError(f"{path}: is damaged; delete it and start again") from None
