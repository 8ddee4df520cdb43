"""Signals of a run as CSV, for spreadsheets: one column per component, with its unit."""

from pathlib import Path

import numpy as np
import xarray as xr

from stewart_drake.files.csvio import csv_text
from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.run_log import EXPECTED, read_log
from stewart_drake.scenario.signals import NUM_LEGS, headings, run_signals
from stewart_drake.types import Array


def signals_csv(signals: xr.Dataset) -> str:
    """Return a header `time[s],pose_roll[rad],...` and a line per instant; NaN is an empty cell.

    A reference of `kind: csv` reads the columns `pose_...` as a motion.
    """
    return csv_text(*columns_of(signals))


def columns_of(signals: xr.Dataset) -> tuple[list[str], Array]:
    """Return the heads of `signals_csv` and its numbers (instants, columns)."""
    header, columns = ["time[s]"], [signals.time.values[:, None]]
    known = run_signals(signals.sizes.get("encoder", 0) // NUM_LEGS or None)
    for name, signal in signals.data_vars.items():
        others = [dimension for dimension in signal.dims if dimension != "time"]
        labels = [label for other in others for label in signal[other].values]
        units = known[str(name)].quantity.units if name in known else ["1"] * max(1, len(labels))
        header += headings(str(name), labels, units)
        columns.append(signal.transpose("time", *others).values.reshape(len(signal.time), -1))
    return header, np.hstack(columns)


def read_signals(path: Path) -> xr.Dataset:
    """Return the signals of a run, which `columns_of` can write; `path` as of `read_log`."""
    try:
        signals = read_log(path)
        signals[["time", "pose", "torque_applied"]].astype(float)
        signals_csv(signals)
    except ConfigError as error:
        raise ConfigError(f"signals: {error}") from None
    except (KeyError, TypeError, ValueError, IndexError) as error:
        reason = " ".join(str(error).split())
        raise ConfigError(
            f"signals: {path}: not the signals of a run ({reason}); expected {EXPECTED}"
        ) from None
    return signals
