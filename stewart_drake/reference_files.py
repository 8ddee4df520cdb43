"""Sampled references from files: waypoints in YAML, measured or computed motions in CSV.

Readers return `(times, poses)`: times (n,) s, poses (n, 6) [roll, pitch, yaw, x, y, z] rad and m.
"""

import csv
import math
import re
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.config import Row, Seconds
from stewart_drake.errors import ConfigError
from stewart_drake.fileio import read_bytes
from stewart_drake.yamlio import brief, load_yaml, validate

Array = NDArray[np.float64]

_ANGLES: Final = ("roll", "pitch", "yaw")
_COLUMNS: Final = ("time", *_ANGLES, "x", "y", "z")
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
_MAX_KINK: Final = 0.05
"""Of the largest peak to peak of the angles, or of the positions: see `_roughest`."""
_LEAST_KINK: Final = 1e-3
"""rad, m; what stays below is noise of a sensor, not a jump."""


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class _WaypointFile:
    times: Annotated[list[Seconds], Field(min_length=2)]
    poses: Annotated[list[Row], Field(min_length=2)]


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

    Raises:
        ConfigError: the file breaks one of these rules, has too few rows, a gap, a value that is
            no finite number, an angle that jumps by a turn, or a jump or motion too quick for its
            samples; row and column are named, rows as a spreadsheet counts them.
    """
    path = Path(path)
    lines, cells = _read_cells(path)
    names, scales = _read_header(path, cells[0])
    samples = np.empty((len(cells) - 1, 7))
    order = [_COLUMNS.index(name) for name in names]
    labels = [cell.strip() for cell in cells[0]]
    for index, (line, row) in enumerate(zip(lines[1:], cells[1:], strict=True)):
        if len(row) != 7:
            hint = ", with a point for the decimals" if len(row) > 7 else ""
            raise ConfigError(
                f"{path}: row {line}: got {len(row)} cells; expected 7, as above{hint}"
            )
        for column, text in enumerate(row):
            place = f"{path}: row {line}, column {labels[column]}"
            try:
                value = float(text) * scales[column]
            except ValueError:
                raise ConfigError(f"{place}: got {brief(text)}; expected a number") from None
            target = order[column]
            before = float(samples[index - 1, target]) if index else None
            if target == 0:
                problem = _time_problem(value, before)
            else:
                problem = _pose_problem(target - 1, value, before)
            if problem:
                raise ConfigError(f"{place}: {problem}")
            samples[index, target] = value
    if len(samples) < _MIN_ROWS:
        plural = "" if len(samples) == 1 else "s"
        raise ConfigError(
            f"{path}: got {len(samples)} sample{plural}; expected at least {_MIN_ROWS}"
        )
    steps = np.diff(samples[:, 0])
    widest, median = int(np.argmax(steps)), float(np.median(steps))
    if steps[widest] > _MAX_GAP * median:
        raise ConfigError(
            f"{path}: row {lines[widest + 2]}, column time[s]: got a gap of {steps[widest]:.6g} s; "
            f"expected steps near the median of {median:.6g} s, fill the gap by resampling"
        )
    samples[0, 0] = 0.0
    kink = _roughest(samples[:, 0], samples[:, 1:])
    if kink is not None:
        sample, axis, size = kink
        column = order.index(axis + 1)
        size, unit = size / scales[column], labels[column].partition("[")[2].strip(" ]")
        raise ConfigError(
            f"{path}: row {lines[sample + 1]}, column {labels[column]}: got {size:.3g} {unit} off "
            "the cubic through its neighbours; expected a smooth motion with some ten samples per "
            "swing, filter or resample it"
        )
    return samples[:, 0].copy(), samples[:, 1:].copy()


def _read_cells(path: Path) -> tuple[list[int], list[list[str]]]:
    """The rows that hold anything, and the line number of each."""
    raw = read_bytes(path, _MAX_BYTES, "a CSV file of the motion's samples")
    try:
        reader = csv.reader(raw.decode("utf-8-sig").splitlines(), strict=True)
        rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; expected a CSV file") from None
    except csv.Error as error:
        raise ConfigError(f"{path}: row {reader.line_num}: is not CSV ({error})") from None
    if not rows:
        raise ConfigError(f"{path}: is empty; expected a header {_HEADER}")
    return [line for line, _ in rows], [row for _, row in rows]


def _read_header(path: Path, header: list[str]) -> tuple[list[str], list[float]]:
    """Name and factor to SI units of each column."""
    names, scales = [], []
    for separator in (";", "\t"):
        if separator in header[0]:
            raise ConfigError(
                f"{path}: row 1: got cells separated by {separator!r}; expected commas, and points "
                "for the decimals"
            )
    if header[0].strip()[:1].isdigit():
        raise ConfigError(f"{path}: row 1: got {brief(header[0])}; expected a header {_HEADER}")
    for cell in header:
        match = re.fullmatch(r"\s*(\w+)\s*\[\s*(\w+)\s*\]\s*", cell)
        name, unit = (part.lower() for part in match.groups()) if match else ("", "")
        if name not in _UNITS or name in names:
            problem = "a second" if name in names else "an unknown"
            raise ConfigError(
                f"{path}: row 1: got {problem} column {brief(cell)}; expected {_HEADER}"
            )
        if unit not in _UNITS[name]:
            raise ConfigError(
                f"{path}: row 1: got column {brief(cell)}; expected {name} in "
                f"{' or '.join(_UNITS[name])}"
            )
        names.append(name)
        scales.append(_UNITS[name][unit])
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise ConfigError(f"{path}: row 1: column {missing[0]} is missing; expected {_HEADER}")
    return names, scales


def _roughest(times: Array, poses: Array) -> tuple[int, int, float] | None:
    """Row, column and size of the worst kink of samples (n,), (n, 6), or None if all is smooth.

    A sample should lie near the cubic through the two before and the two after it. With equal
    steps h the difference is the fourth difference over 6, (omega h)^4 / 6 of a sine's amplitude:
    1.3 % of its peak to peak with ten samples per period, 5 % with seven. A jump shows by half its
    size, a glitch with all of it. Ends are seen as neighbours only. The share is taken of the
    largest peak to peak among the angles, or the positions, since one may be still but for noise.
    """
    if len(times) < 5:
        return None
    near = np.array([-2, -1, 1, 2])
    at = np.arange(2, len(times) - 2)
    t = times[at[:, None] + near] - times[at][:, None]
    weights = np.ones_like(t)  # Lagrange's, at zero
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[:, i] *= t[:, j] / (t[:, j] - t[:, i])
    kinks = np.abs(poses[at] - np.einsum("ki,kic->kc", weights, poses[at[:, None] + near]))
    spans = np.ptp(poses, axis=0)
    largest = np.repeat([spans[:3].max(), spans[3:].max()], 3)
    excess = kinks / np.maximum(_MAX_KINK * largest, _LEAST_KINK)
    row, column = np.unravel_index(excess.argmax(), excess.shape)
    if excess[row, column] <= 1:
        return None
    return int(at[row]), int(column), float(kinks[row, column])


def _time_problem(value: float, before: float | None) -> str | None:
    if not math.isfinite(value):
        return f"got {value}; expected a finite number"
    if before is None and abs(value) > 1e-9:
        return f"got {value!r}; expected 0 in the first sample, subtract it from every time"
    if before is not None and value - before < _MIN_STEP:
        return f"got {value!r} after {before!r}; expected increasing times"
    return None


def _pose_problem(column: int, value: float, before: float | None) -> str | None:
    if not abs(value) < _MAX_SIZE:  # also true of NaN
        return f"got {value!r}; expected a finite number below {_MAX_SIZE:g} rad or m"
    if column == 1 and abs(value) >= math.pi / 2:
        return f"got {value:.6g} rad; expected a pitch within 90 degrees, give deg or rad"
    if column < 3 and before is not None and abs(value - before) > math.pi:
        return f"got {value:.6g} rad after {before:.6g}; expected no jump by a turn, unwrap it"
    return None
