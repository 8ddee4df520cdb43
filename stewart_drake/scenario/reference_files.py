"""Sampled references from files: waypoints in YAML, measured or computed motions in CSV.

Readers return `(times, poses)`: times (n,) s, poses (n, 6) [roll, pitch, yaw, x, y, z] rad and m.
"""

import itertools
import math
import re
from array import array
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.csvio import csv_rows, read_columns, read_lines
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief, load_yaml, validate
from stewart_drake.scenario.field_types import Row, Seconds
from stewart_drake.scenario.reference_config import WaypointsConfig
from stewart_drake.scenario.smoothness import roughest
from stewart_drake.types import Array

_ANGLES: Final = ("roll", "pitch", "yaw")
_COLUMNS: Final = ("time", *_ANGLES, "x", "y", "z")
_POSE: Final = "pose_"
"""Before a coordinate's name in the files that `export` writes."""
_UNITS: Final = {
    "time": {"s": 1.0},
    **{name: {"rad": 1.0, "deg": math.pi / 180} for name in _ANGLES},
    **{name: {"m": 1.0, "mm": 1e-3} for name in ("x", "y", "z")},
}
_HEADER: Final = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m] (or deg, mm)"
_MAX_BYTES: Final = 50_000_000
_MIN_ROWS: Final = 4
"""What a cubic through the samples with free ends needs."""
_MIN_STEP: Final = 1e-6
_MAX_GAP: Final = 10
"""Times the median step."""
_MAX_SIZE: Final = 1e3


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class _WaypointFile:
    times: Annotated[list[Seconds], Field(min_length=2)]
    poses: Annotated[list[Row], Field(min_length=2)]


def waypoints(config: WaypointsConfig) -> tuple[Array, Array]:
    """The waypoints of a scenario's section, from its lists or its file.

    Raises:
        ConfigError: see `read_waypoints` and `check_waypoints`.
    """
    if config.file is not None:
        return read_waypoints(config.file)
    if config.times is None or config.poses is None:
        raise ConfigError("reference.times: got None; expected times and poses, or a file")
    return check_waypoints(config.times, config.poses, "reference.")


def read_waypoints(path: str | Path) -> tuple[Array, Array]:
    """Reads `times` (s) and `poses` (rad, m) from a YAML file.

    Raises:
        ConfigError: see `load_yaml`, `validate` and `check_waypoints`.
    """
    data = validate(_WaypointFile, load_yaml(path), str(path))
    return check_waypoints(data.times, data.poses, f"{path}: ")


def check_waypoints(
    times: list[float], poses: list[list[float]], where: str
) -> tuple[Array, Array]:
    """Waypoints as arrays.

    Args:
        times: s.
        poses: one of six numbers per time, rad and m.
        where: what precedes the field's name in messages.

    Raises:
        ConfigError: as many poses as times are expected; times increase; poses lie where roll,
            pitch and yaw are distinct and do not jump by a turn.
    """
    if len(poses) != len(times):
        raise ConfigError(
            f"{where}poses: got {len(poses)} poses; expected {len(times)}, one per time"
        )
    for row in range(len(times)):
        label = f"{where}times[{row}]"
        if row and times[row] - times[row - 1] < _MIN_STEP:
            raise ConfigError(
                f"{label}: got {times[row]!r} after {times[row - 1]!r}; expected increasing times"
            )
        for column in range(6):
            before = poses[row - 1][column] if row else None
            problem = _pose_problem(column, poses[row][column], before)
            if problem:
                raise ConfigError(f"{where}poses[{row}][{column}]: {problem}")
    return np.array(times), np.array(poses)


def read_csv(path: str | Path) -> tuple[Array, Array]:
    """Reads a sampled motion.

    The first line names seven comma-separated columns with their units, in any order:
    `time[s]`; `roll`, `pitch`, `yaw` in `[rad]` or `[deg]`; `x`, `y`, `z` in `[m]` or `[mm]`.
    Each further line is one sample. Time starts at 0 and increases.

    In a file that `simulate --csv` or `export` wrote, the motion is that of the columns `pose_roll`
    to `pose_z`, and the others are left alone.

    Raises:
        ConfigError: the file breaks one of these rules, has too few rows, a gap, a value that is
            no finite number, an angle that jumps by a turn, or a jump or motion too quick for its
            samples; row and column are named, rows as a spreadsheet counts them.
    """
    path = Path(path)
    text = read_lines(path, _MAX_BYTES, "a CSV file of the motion's samples")
    header = next((row for _, row in csv_rows(path, text)), None)
    if header is None:
        raise ConfigError(f"{path}: is empty; expected a header {_HEADER}")
    chosen = _motion_columns(header)
    names, scales = _read_header(path, [header[at] for at in chosen])
    columns = _Columns(
        width=len(header),
        chosen=chosen,
        labels=[header[at].strip() for at in chosen],
        order=[_COLUMNS.index(name) for name in names],
        scales=scales,
    )
    lines, values = _read_numbers(path, text, columns)
    samples = np.empty_like(values)
    samples[:, columns.order] = values * scales
    bad = _first_problem(samples)
    if bad is not None:
        before = samples[bad - 1] if bad else None
        _, row = next(itertools.islice(csv_rows(path, text), bad + 1, None))
        _check_row(f"{path}: row {lines[bad]}", row, columns, before)
    if len(samples) < _MIN_ROWS:
        plural = "" if len(samples) == 1 else "s"
        raise ConfigError(
            f"{path}: got {len(samples)} sample{plural}; expected at least {_MIN_ROWS}"
        )
    steps = np.diff(samples[:, 0])
    widest, median = int(np.argmax(steps)), float(np.median(steps))
    if steps[widest] > _MAX_GAP * median:
        raise ConfigError(
            f"{path}: row {lines[widest + 1]}, column time[s]: got a gap of {steps[widest]:.6g} s; "
            f"expected steps near the median of {median:.6g} s, fill the gap by resampling"
        )
    samples[0, 0] = 0.0
    kink = roughest(samples[:, 0], samples[:, 1:])
    if kink is not None:
        sample, axis, size = kink
        column = columns.order.index(axis + 1)
        label = columns.labels[column]
        size, unit = size / scales[column], label.partition("[")[2].strip(" ]")
        raise ConfigError(
            f"{path}: row {lines[sample]}, column {label}: got {size:.3g} {unit} off "
            "the cubic through its neighbours; expected a smooth motion with some ten samples per "
            "swing, filter or resample it"
        )
    return samples[:, 0].copy(), samples[:, 1:].copy()


class _Columns(NamedTuple):
    """Where a file has the motion: of its `width` columns those `chosen`, with their labels, their
    places in a sample and their factors to SI units."""

    width: int
    chosen: list[int]
    labels: list[str]
    order: list[int]
    scales: list[float]


def _read_numbers(path: Path, text: list[str], columns: _Columns) -> tuple[list[int], Array]:
    """Line numbers (n,) and chosen cells (n, 7) below the header, up to the first row that is of
    another width or not seven numbers; that row is the last, with NaN."""
    lines, numbers = list[int](), array("d")
    whole = columns.chosen == list(range(columns.width))
    for line, row in itertools.islice(csv_rows(path, text), 1, None):
        lines.append(line)
        try:
            if len(row) != columns.width:
                raise ValueError
            cells = row if whole else [row[at] for at in columns.chosen]
            numbers.extend([*map(float, cells)])  # whole, or nothing of it
        except ValueError:
            numbers.extend([math.nan] * 7)
            break
    return lines, np.frombuffer(numbers).reshape(-1, 7)


def _first_problem(samples: Array) -> int | None:
    """The first row of samples (n, 7) in which `_check_row` finds something, or None."""
    time, poses = samples[:, 0], samples[:, 1:]
    with np.errstate(invalid="ignore", over="ignore"):
        wrong = ~np.isfinite(time) | ~(np.abs(poses) < _MAX_SIZE).all(axis=1)
        wrong |= np.abs(poses[:, 1]) >= math.pi / 2
        wrong[:1] |= np.abs(time[:1]) > 1e-9
        wrong[1:] |= np.diff(time) < _MIN_STEP
        wrong[1:] |= (np.abs(np.diff(poses[:, :3], axis=0)) > math.pi).any(axis=1)
    return int(wrong.argmax()) if wrong.any() else None


def _check_row(where: str, row: list[str], columns: _Columns, before: Array | None) -> None:
    """Say what is wrong with a row.

    Args:
        where: what opens the message.
        row: its cells.
        columns: of the file.
        before: the sample (7,) of the row above, or None.
    """
    width, chosen, labels, order, scales = columns
    if len(row) != width:
        hint = ", with a point for the decimals" if len(row) > width else ""
        raise ConfigError(f"{where}: got {len(row)} cells; expected {width}, as above{hint}")
    cells = [row[at] for at in chosen]
    for label, target, scale, text in zip(labels, order, scales, cells, strict=True):
        try:
            value = float(text) * scale
        except ValueError:
            raise ConfigError(
                f"{where}, column {label}: got {brief(text)}; expected a number"
            ) from None
        last = None if before is None else float(before[target])
        if target == 0:
            problem = _time_problem(value, last)
        else:
            problem = _pose_problem(target - 1, value, last, scale)
        if problem:
            raise ConfigError(f"{where}, column {label}: {problem}")
    raise AssertionError("a row that breaks no rule")


def _motion_columns(header: list[str]) -> list[int]:
    """Columns of the motion: all, but of a file that `export` wrote time and pose."""
    names = [cell.partition("[")[0].strip().lower() for cell in header]
    if not any(name.startswith(_POSE) for name in names) or set(names) & set(_COLUMNS[1:]):
        return list(range(len(header)))
    return [at for at, name in enumerate(names) if name == "time" or name.startswith(_POSE)]


def _read_header(path: Path, header: list[str]) -> tuple[list[str], list[float]]:
    """Name and factor to SI units of each column."""
    for separator in (";", "\t"):
        if separator in header[0]:
            raise ConfigError(
                f"{path}: row 1: got cells separated by {separator!r}; expected commas, and points "
                "for the decimals"
            )
    if header[0].strip()[:1].isdigit():
        raise ConfigError(f"{path}: row 1: got {brief(header[0])}; expected a header {_HEADER}")
    names, scales = read_columns(path, header, _UNITS, _name_and_unit, _HEADER)
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise ConfigError(f"{path}: row 1: column {missing[0]} is missing; expected {_HEADER}")
    return names, scales


def _name_and_unit(cell: str) -> tuple[str, str]:
    match = re.fullmatch(r"\s*(\w+)\s*\[\s*(\w+)\s*\]\s*", cell)
    name, unit = (part.lower() for part in match.groups()) if match else ("", "")
    return name.removeprefix(_POSE), unit


def _time_problem(value: float, before: float | None) -> str | None:
    if not math.isfinite(value):
        return f"got {value}; expected a finite number"
    if before is None and abs(value) > 1e-9:
        return f"got {value!r}; expected 0 in the first sample, subtract it from every time"
    if before is not None and value - before < _MIN_STEP:
        return f"got {value!r} after {before!r}; expected increasing times"
    return None


def _pose_problem(
    column: int, value: float, before: float | None, scale: float = 1.0
) -> str | None:
    """What is wrong with a coordinate in rad or m, told in the file's unit, of `scale` SI units."""
    units = _UNITS[_COLUMNS[1 + column]]
    unit = next(name for name, factor in units.items() if factor == scale)

    def told(x: float) -> str:
        return f"{x / scale:.6g}"

    if not abs(value) < _MAX_SIZE:  # also true of NaN
        return f"got {value / scale!r}; expected a finite number below {told(_MAX_SIZE)} {unit}"
    if column == 1 and abs(value) >= math.pi / 2:
        degrees = "" if unit == "deg" else ", 90 degrees"
        return (
            f"got {told(value)} {unit}; expected a pitch within {told(math.pi / 2)} {unit}{degrees}"
        )
    if column < 3 and before is not None and abs(value - before) > math.pi:
        change = f"{told(value)} {unit} after {told(before)}"
        return f"got {change}; expected no jump by a turn, unwrap it"
    return None
