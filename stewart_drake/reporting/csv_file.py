"""Signals as CSV, for spreadsheets and other programs: one column per component, its unit named."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr

from stewart_drake.files.arrayio import load_netcdf
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_whole
from stewart_drake.files.yamlio import brief
from stewart_drake.scenario.signals import COORDINATE_NAMES, COORDINATES, SIGNALS, Signal

_SPOKEN: Final = dict(zip(COORDINATES, COORDINATE_NAMES, strict=True))
_ENCODERS: Final = ("time", "encoder")
"""Dimensions of a measurement of crank angles."""
_EXPECTED: Final = "a file that simulate saved (.nc)"


def signals_csv(signals: xr.Dataset) -> str:
    """A header as `time[s],pose_roll[rad],...`, then a line per instant, empty where not a number.

    A reference of `kind: csv` reads it as a motion, that of its columns `pose_...`.

    Args:
        signals: of a `SimulationResult`, over `time`.
    """
    header, columns = ["time[s]"], [signals.time.values[:, None]]
    for name, signal in signals.data_vars.items():
        others = [dimension for dimension in signal.dims if dimension != "time"]
        labels = [str(label) for other in others for label in signal[other].values]
        known = _known(str(name), signal)
        units = ("1",) * max(1, len(labels)) if known is None else known.quantity.units
        if signal.dims == _ENCODERS:
            units = ("rad",) * len(labels)
        header += _columns(str(name), labels, units)
        columns.append(signal.transpose("time", *others).values.reshape(len(signal.time), -1))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in np.hstack(columns))
    return text.getvalue()


def columns_of(signal: Signal, labels: Iterable[str | int]) -> list[str]:
    """Return the header's cells of a signal with these labels of its components, if it has any."""
    return _columns(signal.name, [str(label) for label in labels], signal.quantity.units)


def _columns(name: str, labels: Sequence[str], units: Sequence[str]) -> list[str]:
    named = [f"{name}_{_spoken(label)}" for label in labels] or [name]
    pairs = zip(named, units, strict=True)
    return [f"{column}[{'-' if unit == '1' else unit}]" for column, unit in pairs]


def write_csv(signals: xr.Dataset, path: Path) -> Path:
    """Write `signals_csv` whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    write_whole(path, signals_csv(signals))
    return path


def read_signals(path: Path) -> xr.Dataset:
    """The signals that `simulate` or `compare` saved.

    Raises:
        ConfigError: there is no such file, or it is none of theirs.
    """
    if not path.exists():
        raise ConfigError(f"signals: no file {str(path)!r}; expected {_EXPECTED}")
    try:
        loaded = load_netcdf(path, _EXPECTED)
    except ConfigError as error:
        raise ConfigError(f"signals: {error}") from None
    problem = _problem(loaded)
    if problem:
        raise ConfigError(f"signals: got {str(path)!r}, where {problem}; expected {_EXPECTED}")
    return loaded


def _problem(signals: xr.Dataset) -> str | None:
    """What tells signals from those of a run, or None."""
    missing = [name for name in ("pose", "torque_applied") if name not in signals.data_vars]
    if missing:
        return f"{missing[0]} is missing"
    # What is no coordinate can be asked for as well, and is an index then.
    if "time" not in signals.coords or signals.time.dims != ("time",):
        return "the coordinate time is missing"
    if not all(signals.sizes.values()):
        return "a dimension is empty"
    time = signals.time
    for name, signal in {"time": time, **signals.data_vars}.items():
        if signal.dtype.kind not in "fiu" or " since " in str(signal.attrs.get("units")):
            return f"{name} is no number"
        others = [dimension for dimension in signal.dims if dimension != "time"]
        known = _known(str(name), signal)
        single = name == "time" if known is None else known.quantity.dimension is None
        if "time" not in signal.dims or len(others) != (not single):
            return f"{name} is over {', '.join(map(str, signal.dims)) or 'nothing'}"
        if known is not None and others and signal.sizes[others[0]] != known.size:
            return f"{name} has {signal.sizes[others[0]]} components"
    if time.attrs.get("units", "s") != "s":
        return f"time is in {brief(time.attrs['units'])}"
    if not np.all(np.diff(time.values) > 0) or not np.isfinite(time.values).all():
        return "time does not increase"
    return None


def _known(name: str, signal: xr.DataArray) -> Signal | None:
    """The signal of that name, unless it is one whose size a scenario decides."""
    return None if signal.dims == _ENCODERS else SIGNALS.get(name)


def _spoken(label: str) -> str:
    """`error_phi` as `error_roll`, the names of scenario and reference files."""
    return "_".join(_SPOKEN.get(word, word) for word in label.split("_"))


def _cell(value: float) -> str:
    return f"{value:.12g}" if np.isfinite(value) else ""
