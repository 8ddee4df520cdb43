"""Sampled references from files: waypoints in YAML, measured or computed motions in CSV.

Readers return `(times, poses)`: times (n,) s, poses (n, 6) [roll, pitch, yaw, x, y, z] rad and m.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.csvio import ANGLE_UNITS, LENGTH_UNITS, read_table
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import load_yaml, validate
from stewart_drake.scenario.field_types import Row, Seconds
from stewart_drake.scenario.reference_config import WaypointsConfig
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.scenario.smoothness import roughest
from stewart_drake.types import Array

_POSE: Final = "pose_"
"""Prefix of a coordinate's name in the files that `export` writes."""
_UNITS: Final = {
    "time": {"s": 1.0},
    **dict.fromkeys(COORDINATE_NAMES[:3], ANGLE_UNITS),
    **dict.fromkeys(COORDINATE_NAMES[3:], LENGTH_UNITS),
}
_HEADER: Final = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m] (or deg, mm)"
_MIN_ROWS: Final = 4
"""Least number for a cubic with free ends."""
_MIN_STEP: Final = 1e-6
"""s."""
_MAX_GAP: Final = 10
"""Largest step over the median step."""
_MAX_SIZE: Final = 1e3
"""rad or m."""


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class _WaypointFile:
    times: Annotated[list[Seconds], Field(min_length=2)]
    poses: Annotated[list[Row], Field(min_length=2)]


def waypoints(config: WaypointsConfig) -> tuple[Array, Array]:
    """Return the waypoints of a scenario's section, from its lists or its file.

    Raises:
        ConfigError: see `read_waypoints` and `check_waypoints`.
    """
    if config.file is not None:
        return read_waypoints(config.file)
    if config.times is None or config.poses is None:
        raise ConfigError("reference.times: got None; expected times and poses, or a file")
    return check_waypoints(config.times, config.poses, "reference.")


def read_waypoints(path: str | Path) -> tuple[Array, Array]:
    """Read `times` (s) and `poses` (rad, m) from a YAML file.

    Raises:
        ConfigError: see `load_yaml`, `validate` and `check_waypoints`.
    """
    data = validate(_WaypointFile, load_yaml(path), str(path))
    return check_waypoints(data.times, data.poses, f"{path}: ")


def check_waypoints(
    times: list[float], poses: list[list[float]], where: str
) -> tuple[Array, Array]:
    """Return waypoints as arrays.

    Args:
        times: s.
        poses: one of six numbers per time, rad and m.
        where: opening of a message, before the field's name.

    Raises:
        ConfigError: there is not one pose per time, or see `_check_samples`.
    """
    if len(poses) != len(times):
        raise ConfigError(
            f"{where}poses: got {len(poses)} poses; expected {len(times)}, one per time"
        )

    def place(row: int, name: str) -> str:
        if name == "time":
            return f"{where}times[{row}]"
        return f"{where}poses[{row}][{COORDINATE_NAMES.index(name)}]"

    samples = np.array(times), np.array(poses)
    _check_samples(*samples, place, dict.fromkeys(COORDINATE_NAMES, 1.0))
    return samples


def read_csv(path: str | Path) -> tuple[Array, Array]:
    """Read a sampled motion.

    The first line names seven comma-separated columns with their units, in any order:
    `time[s]`; `roll`, `pitch`, `yaw` in `[rad]` or `[deg]`; `x`, `y`, `z` in `[m]` or `[mm]`.
    Each further line is one sample. Time starts at 0 and increases.

    In a file that `simulate --csv` or `export` wrote, the motion is in the columns `pose_roll` to
    `pose_z`. Other columns are ignored.

    Raises:
        ConfigError: the file breaks one of these rules, has too few rows, a gap, an angle that
            jumps by a turn, or a jump or motion too quick for its samples. The message names row
            and column; rows are counted as in a spreadsheet.
    """
    path = Path(path)
    table = read_table(path, "a CSV file of the motion's samples", _HEADER, _UNITS, prefix=_POSE)
    samples = table.stacked(["time", *COORDINATE_NAMES])
    times, poses = samples[:, 0].copy(), samples[:, 1:].copy()
    if len(times) and abs(times[0]) > 1e-9:
        raise ConfigError(
            f"{table.place(0, 'time')}: got {float(times[0])!r}; expected 0 in the first sample, "
            "subtract it from every time"
        )
    _check_samples(times, poses, table.place, table.scales)
    if len(times) < _MIN_ROWS:
        plural = "" if len(times) == 1 else "s"
        raise ConfigError(f"{path}: got {len(times)} sample{plural}; expected at least {_MIN_ROWS}")
    steps = np.diff(times)
    widest, median = int(np.argmax(steps)), float(np.median(steps))
    if steps[widest] > _MAX_GAP * median:
        raise ConfigError(
            f"{table.place(widest + 1, 'time')}: got a gap of {steps[widest]:.6g} s; "
            f"expected steps near the median of {median:.6g} s, fill the gap by resampling"
        )
    times[0] = 0.0
    kink = roughest(times, poses)
    if kink is not None:
        row, axis, size = kink
        name = COORDINATE_NAMES[axis]
        scale = table.scales[name]
        raise ConfigError(
            f"{table.place(row, name)}: got {size / scale:.3g} {_unit(name, scale)} off "
            "the cubic through its neighbours; expected a smooth motion with some ten samples per "
            "swing, filter or resample it"
        )
    return times, poses


def _check_samples(
    times: Array, poses: Array, place: Callable[[int, str], str], scales: Mapping[str, float]
) -> None:
    """Check that times (n,) increase, and that poses (n, 6) are unique and do not jump by a turn.

    Args:
        times: s.
        poses: rad and m.
        place: returns the opening of a message about a row and a column.
        scales: by coordinate, the SI units in the unit of the file.

    Raises:
        ConfigError: the first sample that breaks a rule.
    """

    def told(row: int, axis: int, value: float | None = None) -> tuple[str, str, str]:
        """Return place, value and unit of a coordinate."""
        name = COORDINATE_NAMES[axis]
        scale = scales[name]
        value = float(poses[row, axis]) if value is None else value
        return place(row, name), f"{value / scale:.6g}", _unit(name, scale)

    for row in 1 + np.flatnonzero(np.diff(times) < _MIN_STEP)[:1]:
        raise ConfigError(
            f"{place(row, 'time')}: got {float(times[row])!r} after {float(times[row - 1])!r}; "
            "expected increasing times"
        )
    for row, axis in np.argwhere(np.abs(poses) >= _MAX_SIZE)[:1]:
        where, most, unit = told(row, axis, _MAX_SIZE)
        size = float(poses[row, axis]) / scales[COORDINATE_NAMES[axis]]
        raise ConfigError(f"{where}: got {size!r}; expected a finite number below {most} {unit}")
    for row in np.flatnonzero(np.abs(poses[:, 1]) >= math.pi / 2)[:1]:
        where, value, unit = told(row, 1)
        most, degrees = told(row, 1, math.pi / 2)[1], "" if unit == "deg" else ", 90 degrees"
        raise ConfigError(
            f"{where}: got {value} {unit}; expected a pitch within {most} {unit}{degrees}"
        )
    for row, axis in np.argwhere(np.abs(np.diff(poses[:, :3], axis=0)) > math.pi)[:1]:
        where, value, unit = told(row + 1, axis)
        raise ConfigError(
            f"{where}: got {value} {unit} after {told(row, axis)[1]}; expected no jump by a turn, "
            "unwrap it"
        )


def _unit(name: str, scale: float) -> str:
    return next(unit for unit, factor in _UNITS[name].items() if factor == scale)
