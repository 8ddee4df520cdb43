"""Logs from files: those that `simulate` saved (.nc), and CSV of a machine's own."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from stewart_drake.files.arrayio import load_netcdf
from stewart_drake.files.csvio import csv_rows, read_columns, read_lines
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief, parse_yaml, validate
from stewart_drake.identification.logs import ANGLES, NUM_MEASURED, POSE, Log
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.native.layout import STANDARD_GRAVITY
from stewart_drake.scenario.config import NetworkConfig, Scenario, StateSensorConfig
from stewart_drake.scenario.renames import with_new_names
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS, NUM_LEGS, NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array

EXPECTED: Final = "a log: signals.nc of simulate, or CSV with time, torque_1 ... and angle_1 ..."
_MAX_BYTES: Final = 100_000_000
FINEST: Final = 0.01
"""s between two measurements that are used; of more frequent ones as many are left out."""
_LEAST_VALUES: Final = 96
"""Measured values of a log: six crank angles at 16 instants, or a state at eight."""
_ANGLE: Final = {"rad": 1.0, "deg": math.pi / 180}
_LENGTH: Final = {"m": 1.0, "mm": 1e-3}
_TORQUES: Final = [f"torque_{leg}" for leg in LEGS]
_CRANKS: Final = [f"angle_{leg}" for leg in LEGS]
_UNITS: Final[dict[str, Mapping[str, float]]] = {
    "time": {"s": 1.0},
    **{name: {"N m": 1.0, "mN m": 1e-3} for name in _TORQUES},
    **{name: _ANGLE for name in (*_CRANKS, *COORDINATE_NAMES[:3])},  # noqa: C420
    **{name: _LENGTH for name in COORDINATE_NAMES[3:]},  # noqa: C420
}
_HEADER: Final = (
    "time[s], torque_1[N m] to torque_6, angle_1[rad] to angle_6 and, where it was measured, "
    "roll[rad], pitch, yaw, x[m], y, z (or mN m, deg, mm)"
)
LEAST_STD: Final = np.repeat([1e-6, 1e-7, 1e-5, 1e-6], 3)
"""rad, m and per s; a state that is measured without an error is trusted no further than the
equations are integrated."""


def angle_std(bits: int) -> float:
    """Of a code of so many bits per turn, rad: off by up to half a step either way, evenly."""
    return 2 * math.pi / 2**bits / math.sqrt(12)


LEAST_ANGLE: Final = 1e-6
"""rad, alike of encoders without a code."""


class Precision(NamedTuple):
    """What the measurements of a CSV log are worth, standard deviations."""

    angle: float = angle_std(14)
    """rad."""
    pose_angle: float = 1e-4
    """rad."""
    pose_position: float = 2e-5
    """m."""

    @property
    def std(self) -> Array:
        """(18,) of a log's measurements; rates are not in a CSV log."""
        pose = [self.pose_angle] * 3 + [self.pose_position] * 3
        return np.array([self.angle] * 6 + pose + [np.inf] * 6)


def read_log(path: Path, mechanism: Mechanism, precision: Precision, gravity: bool = True) -> Log:
    """Read a log.

    Args:
        path: a file of `simulate` where it ends in .nc, else CSV.
        mechanism: whose motors' limit clips the torques of a CSV log.
        precision: of a CSV log.
        gravity: whether it acted, in a CSV log.

    Raises:
        ConfigError: one line, with the file, and row and column where there are such.
    """
    if path.suffix == ".nc":
        return _of_run(path, mechanism)
    return _of_csv(path, mechanism, precision, STANDARD_GRAVITY if gravity else 0.0)


# ---------------------------------------------------------------- runs of simulate


def _of_run(path: Path, mechanism: Mechanism) -> Log:
    signals = load_netcdf(path, EXPECTED)
    scenario = _scenario_of(path, signals)
    problem = _run_problem(signals, scenario)
    if problem:
        raise ConfigError(f"{path}: {problem}; expected {EXPECTED}")
    period, time = scenario.controller.period, signals.time.values
    # Held signals show a sample's value from its instant on; each has a row of its own.
    count = int(min(time[-1] / period + 1e-9, len(time))) + 1
    samples: Array = period * np.arange(count, dtype=np.float64)
    rows = np.minimum(np.searchsorted(time, samples - 1e-9), len(time) - 1)
    seen = time[rows] < samples + period - 1e-9
    if not seen.all():
        raise ConfigError(
            f"{path}: log_period: got a step of {np.diff(time, prepend=0.0).max():.4g} s, longer "
            f"than the controller's {period:g} s; expected each of its samples in the log"
        )
    torques, believed = _sent(signals, scenario, samples, rows)
    own = scenario.actuator.torque_limit
    limit = mechanism.effort_limit if own is None else own
    times, values, std = _measured(signals.measurement, scenario, samples, rows)
    changing = scenario.queue == "reference" or isinstance(scenario.link, NetworkConfig)
    return _checked(
        Log(
            name=str(path),
            sent=samples,
            torques=_limited(torques, limit),
            times=times,
            values=values,
            std=std,
            gravity=STANDARD_GRAVITY if scenario.plant.gravity else 0.0,
            delay=believed if math.isfinite(believed) else None,
            before=None if changing else signals.torque_applied.transpose("time", "leg").values[0],
        ),
        path,
    )


def _sent(
    signals: xr.Dataset, scenario: Scenario, samples: Array, rows: NDArray[np.intp]
) -> tuple[Array, float]:
    """Torques (n, 6) that were sent at `samples`, as far as they arrived, and their delay, s.

    Over a network other torques may act than were sent; but when they act is known, a bound later.
    So what acted then stands for what was sent.
    """
    if not isinstance(scenario.link, NetworkConfig):
        torques = signals.torque_commanded.transpose("time", "leg").values[rows]
        return torques, float(signals.delay_estimate.values[-1])
    eta, time = scenario.eta, signals.time.values
    then = np.minimum(np.searchsorted(time, samples + eta - 1e-9), len(time) - 1)
    return signals.torque_applied.transpose("time", "leg").values[then], eta


def _measured(
    signal: xr.DataArray, scenario: Scenario, samples: Array, rows: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """Instants (n,), values (n, 18) and their std (18,) of a run's measurements.

    Args:
        signal: of the record.
        scenario: of the run.
        samples: instants of the controller's samples, s.
        rows: of the record that show them.
    """
    sensor, said = scenario.sensor, signal.transpose("time", ...).values[rows]
    if isinstance(sensor, StateSensorConfig):
        values = np.full((len(rows), NUM_MEASURED), np.nan)
        values[:, POSE.start :] = said
        noise = np.hypot(sensor.noise_std, LEAST_STD)
        return samples, values, np.concatenate([np.full(6, np.inf), noise])
    # What was read in the period before a sample, the oldest first; before the first one, nothing.
    ago = np.arange(sensor.samples - 1, -1, -1) * scenario.controller.period / sensor.samples
    times, angles = (samples[:, None] - ago).ravel(), said.reshape(-1, NUM_LEGS)
    kept = times > -1e-9
    values = np.full((kept.sum(), NUM_MEASURED), np.nan)
    values[:, ANGLES] = angles[kept]
    error = LEAST_ANGLE if sensor.bits is None else angle_std(sensor.bits)
    return times[kept], values, np.concatenate([np.full(6, error), np.full(NUM_STATE, np.inf)])


def _scenario_of(path: Path, signals: xr.Dataset) -> Scenario:
    text = signals.attrs.get("scenario")
    data = parse_yaml(text, f"{path}: scenario") if isinstance(text, str) else None
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: says nothing of its scenario; expected {EXPECTED}")
    return validate(Scenario, with_new_names(data), f"{path}: scenario")


def _run_problem(signals: xr.Dataset, scenario: Scenario) -> str | None:
    """Why a run cannot serve as a log, or None."""
    sensor, measured = scenario.sensor, {"state": NUM_STATE}
    if not isinstance(sensor, StateSensorConfig):
        measured = {"encoder": NUM_LEGS * sensor.samples}
    shapes: dict[str, dict[str, int]] = {
        "torque_commanded": {"leg": NUM_TORQUES},
        "torque_applied": {"leg": NUM_TORQUES},
        "measurement": measured,
        "delay_estimate": {},
    }
    for name, others in shapes.items():
        if name not in signals.data_vars:
            return f"{name} is missing"
        found = {str(d): n for d, n in signals[name].sizes.items() if d != "time"}
        if found != others or signals[name].dtype.kind != "f" or "time" not in signals[name].dims:
            return f"{name} is no signal over time of {others or 'one number'}"
    time = signals.time.values if "time" in signals.coords else np.empty(0)
    if time.dtype.kind != "f" or not len(time) or not np.isfinite(time).all():
        return "time is missing, or no number"
    if not np.all(np.diff(time) > 0):
        return "time does not increase"
    if isinstance(scenario.link, NetworkConfig) and scenario.link.back is not None:
        return "its measurements came over a network, each of an age of its own (link.return)"
    if scenario.actuator.kind != "torque":
        return f"its motors got no torques (actuator.kind {scenario.actuator.kind!r})"
    if scenario.sensor.delay > 0:
        return f"its measurements are {scenario.sensor.delay:g} s old (sensor.delay)"
    return None


def _limited(torques: Array, limit: float | str | None) -> Array:
    """What the motors give of torques (n, 6)."""
    return torques if limit is None or isinstance(limit, str) else np.clip(torques, -limit, limit)


# ---------------------------------------------------------------- CSV


def _of_csv(path: Path, mechanism: Mechanism, precision: Precision, gravity: float) -> Log:
    rows = csv_rows(path, read_lines(path, _MAX_BYTES, EXPECTED))
    header = next(rows, None)
    if header is None:
        raise ConfigError(f"{path}: is empty; expected a header {_HEADER}")
    names, scales = _header(path, header[1])
    lines, numbers = list[int](), list[list[float]]()
    for line, row in rows:
        if len(row) != len(names):
            raise ConfigError(
                f"{path}: row {line}: got {len(row)} cells; expected {len(names)}, as above"
            )
        cells = zip(row, names, scales, strict=True)
        numbers.append([_number(path, line, *cell) for cell in cells])
        lines.append(line)
    table = dict(zip(names, np.array(numbers).reshape(-1, len(names)).T, strict=True))
    time = table["time"]
    for bad in np.flatnonzero(~(np.diff(time) > 0))[:1]:
        raise ConfigError(
            f"{path}: row {lines[bad + 1]}, column time: got {time[bad + 1]:.9g} s after "
            f"{time[bad]:.9g} s; expected increasing times"
        )
    torques = np.column_stack([table[name] for name in _TORQUES])
    told = np.isfinite(torques)
    for bad in np.flatnonzero(told.any(axis=1) != told.all(axis=1))[:1]:
        raise ConfigError(
            f"{path}: row {lines[bad]}: got some of the six torques; expected all or none of them"
        )
    said = np.flatnonzero(told.all(axis=1))
    # A torque that is repeated goes on acting: only a change has a time of its own.
    changed = np.any(np.diff(torques[said], axis=0, prepend=np.nan) != 0, axis=1)
    values = np.full((len(time), NUM_MEASURED), np.nan)
    for part, columns in ((ANGLES, _CRANKS), (POSE, COORDINATE_NAMES)):
        if columns[0] in table:
            values[:, part] = np.column_stack([table[name] for name in columns])
    log = Log(
        name=str(path),
        sent=time[said][changed],
        torques=_limited(torques[said][changed], mechanism.effort_limit),
        times=time,
        values=values,
        std=precision.std,
        gravity=gravity,
    )
    return _checked(log, path)


def _header(path: Path, header: list[str]) -> tuple[list[str], list[float]]:
    """Name of each column, and its factor to SI units."""
    names, scales = read_columns(path, header, _UNITS, _name_and_unit, _HEADER)
    wanted = ["time", *_TORQUES]
    for group in (_CRANKS, COORDINATE_NAMES):
        wanted += group if set(group) & set(names) else ()
    if not set(names) & {*_CRANKS, *COORDINATE_NAMES}:
        wanted += _CRANKS
    for name in wanted:
        if name not in names:
            raise ConfigError(f"{path}: row 1: column {name} is missing; expected {_HEADER}")
    return names, scales


def _name_and_unit(cell: str) -> tuple[str, str]:
    match = re.fullmatch(r"\s*(\w+)\s*\[\s*([\w ]+?)\s*\]\s*", cell)
    return (match[1].lower(), match[2]) if match else ("", "")


def _number(path: Path, line: int, text: str, name: str, scale: float) -> float:
    """A cell in SI units; NaN where it is empty, which a time must not be."""
    if not text.strip() and name != "time":
        return math.nan
    try:
        value = float(text) * scale
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(
            f"{path}: row {line}, column {name}: got {brief(text)}; expected a finite number"
        )
    return value


# ---------------------------------------------------------------- both


def _checked(log: Log, path: Path) -> Log:
    """Without the rows in which nothing is measured, and of the others not too many.

    Raises:
        ConfigError: too little is left.
    """
    if len(log.sent) < 2:
        raise ConfigError(f"{path}: got one torque throughout; expected torques that change")
    measured = np.flatnonzero(np.isfinite(log.values).any(axis=1))
    kept, last = list[int](), -math.inf
    for row in measured:
        if log.times[row] - last > FINEST - 1e-6:
            kept.append(int(row))
            last = float(log.times[row])
    values = log.values[kept]
    count = int(np.isfinite(values).sum())
    if count < _LEAST_VALUES:
        raise ConfigError(
            f"{path}: got {count} measured values, at {len(kept)} instants; expected at least "
            f"{_LEAST_VALUES}"
        )
    return replace(log, times=log.times[kept], values=values)
