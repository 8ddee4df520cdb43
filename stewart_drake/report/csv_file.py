"""Signals as CSV, for spreadsheets and other programs: one column per component, its unit named."""

import csv
import io
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.errors import ConfigError
from stewart_drake.fileio import replacing
from stewart_drake.signals import COORDINATE_UNITS, PARAMETER_UNITS

Array = NDArray[np.float64]

_PER_SECOND: Final = tuple(f"{unit}/s" for unit in COORDINATE_UNITS)
_UNITS: Final[dict[str, tuple[str, ...]]] = {
    "pose": COORDINATE_UNITS,
    "rates": _PER_SECOND,
    "reference": COORDINATE_UNITS,
    "reference_rates": _PER_SECOND,
    "error": COORDINATE_UNITS,
    "integral": tuple(f"{unit} s" for unit in COORDINATE_UNITS),
    "torque_commanded": ("N m",) * 6,
    "torque_applied": ("N m",) * 6,
    "parameters": PARAMETER_UNITS,
    "parameter_std": PARAMETER_UNITS,
}
"""Of the components; a signal that is not listed is a plain number."""


def signals_csv(signals: xr.Dataset) -> str:
    """A header as `time[s],pose_phi[rad],...`, then a line per instant, empty where not a number.

    Args:
        signals: of a `SimulationResult`, over `time`.
    """
    header, columns = ["time[s]"], [signals.time.values[:, None]]
    for name, signal in signals.data_vars.items():
        (dimension,) = (d for d in signal.dims if d != "time")
        labels = [str(label) for label in signal[dimension].values]
        units = _UNITS.get(str(name), ("-",) * len(labels))
        header += [f"{name}_{label}[{unit}]" for label, unit in zip(labels, units, strict=True)]
        columns.append(signal.transpose("time", dimension).values)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in np.hstack(columns))
    return text.getvalue()


def write_csv(signals: xr.Dataset, path: Path) -> Path:
    """Write `signals_csv` whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    text = signals_csv(signals)
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def read_signals(path: Path) -> xr.Dataset:
    """The signals that `simulate` or `compare` saved.

    Raises:
        ConfigError: there is no such file, or it is none of theirs.
    """
    if not path.is_file():
        raise ConfigError(f"signals: no file {str(path)!r}; expected one that simulate saved (.nc)")
    try:
        with xr.open_dataset(path, engine="h5netcdf") as signals:
            loaded = signals.load()
    except (OSError, ValueError, KeyError) as error:
        raise ConfigError(
            f"signals: got {str(path)!r}, which cannot be read ({error}); expected a file that "
            "simulate saved (.nc)"
        ) from None
    if "time" not in loaded.dims or not set(loaded.data_vars) >= {"pose", "torque_applied"}:
        raise ConfigError(
            f"signals: got {str(path)!r} without poses and torques over time; expected a file "
            "that simulate saved"
        )
    return loaded


def _cell(value: float) -> str:
    return f"{value:.12g}" if np.isfinite(value) else ""
