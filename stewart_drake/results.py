"""What a run leaves behind, in memory and on disk."""

import json
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from stewart_drake.config import Scenario
from stewart_drake.fileio import replacing
from stewart_drake.plant.workspace import Failure


@dataclass(frozen=True)
class SimulationResult:
    """A finished run.

    Attributes:
        scenario: as run.
        status: `completed`, `left_workspace`, `solver_failed` or `interrupted`.
        stopped: when and why a run did not complete, or None.
        signals: over `time` (20 ms): pose, rates, reference, reference_rates, error, integral,
            torque_commanded, torque_applied, weights, parameters and parameter_std (estimated),
            density (45). Held signals show the value from that instant on.
        summary: what `summary.json` holds.
    """

    scenario: Scenario
    status: str
    stopped: Failure | None
    signals: xr.Dataset
    summary: dict[str, Any]

    @property
    def accumulated_error(self) -> float:
        """E_ac in % s, equation (47); NaN for a run that did not complete."""
        return float(self.summary["accumulated_error"])

    @property
    def failure(self) -> str | None:
        """Why the run ended early, with the time, or None."""
        return None if self.stopped is None else str(self.stopped)

    def save(self, directory: str | Path) -> None:
        """Write signals.nc and summary.json into a directory, which is made; each whole or not.

        Raises:
            OSError: the directory cannot be written to.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        write_signals(folder / "signals.nc", self.signals)
        write_json(folder / "summary.json", self.summary)


def write_signals(path: Path, signals: xr.Dataset) -> None:
    """Write NetCDF by way of a temporary file, so that no half file remains."""
    # Made in memory: HDF5 ends the process where a disk is full.
    content: Any = signals.to_netcdf(engine="h5netcdf")
    with replacing(path) as partial:
        partial.write_bytes(content)


def write_json(path: Path, data: Any) -> None:
    """Write JSON with NaN as null, by way of a temporary file, so that no half file remains."""
    text = json.dumps(jsonable(data), indent=2, allow_nan=False)
    with replacing(path) as partial:
        partial.write_text(text + "\n")


def jsonable(data: Any) -> Any:
    """Plain JSON values: arrays as lists, non-finite numbers as None."""
    if isinstance(data, dict):
        return {str(key): jsonable(value) for key, value in data.items()}
    if isinstance(data, (list, tuple, np.ndarray)):
        return [jsonable(value) for value in data]
    if isinstance(data, (float, np.floating)):
        return float(data) if np.isfinite(data) else None
    return data.item() if isinstance(data, np.generic) else data


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    packages = ("stewart-drake", "drake", "casadi", "numpy", "scipy")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}
