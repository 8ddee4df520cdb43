"""What a run leaves behind, in memory and on disk."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import xarray as xr

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.arrayio import write_netcdf
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.jsonio import write_json
from stewart_drake.scenario.config import Scenario


@dataclass(frozen=True)
class SimulationResult:
    """A finished run.

    Attributes:
        scenario: as run.
        status: `completed`, `left_workspace`, `solver_failed` or `interrupted`.
        stopped: when and why a run did not complete, or None.
        signals: over `time` (every 20 ms and every sample of the controller, or the scenario's
            `log_period`): pose, rates, reference, reference_rates, error, integral,
            torque_commanded (what the law asked for), torque_applied (what acted of it: within the
            limit, late), weights, parameters and parameter_std (estimated), density (45),
            measurement and state_estimate (12, as the controller has them). Held signals show the
            value from that instant on. Units, long names, the scenario and versions are attributes.
        summary: what `summary.json` holds: of commanded torques `peak_torque`, `rms_torque` and
            `torque_variation`, of applied ones `peak_torque_applied`; `cost` counts what the limit
            let through.
    """

    scenario: Scenario
    status: str
    stopped: Failure | None
    signals: xr.Dataset
    summary: dict[str, Any]

    def __repr__(self) -> str:
        status = self.status if self.stopped is None else f"{self.status}: {self.stopped}"
        return f"SimulationResult({status}, E_ac={self.accumulated_error:.4g}, {self.scenario})"

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
        remove_partials(folder)
        write_netcdf(folder / "signals.nc", self.signals)
        write_json(folder / "summary.json", self.summary)
