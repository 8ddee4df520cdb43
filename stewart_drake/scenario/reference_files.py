"""Sampled references from files: waypoints in YAML, measured or computed motions in CSV.

Readers return `(times, poses)`: times (n,) s, poses (n, 6) [roll, pitch, yaw, x, y, z] rad and m.
"""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.csvio import ANGLE_UNITS, LENGTH_UNITS, read_table
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import load_yaml, validate
from stewart_drake.scenario.field_types import STRICT, Row, Seconds
from stewart_drake.scenario.reference_config import MOST_TURN, WaypointsConfig, degrees_hint
from stewart_drake.scenario.signals import COORDINATE_NAMES
from stewart_drake.types import Array, Flags

_POSE: Final = "pose_"  # prefix of a coordinate's name in the files that `export` writes
_UNITS: Final = {
    "time": {"s": 1.0},
    **dict.fromkeys(COORDINATE_NAMES[:3], ANGLE_UNITS),
    **dict.fromkeys(COORDINATE_NAMES[3:], LENGTH_UNITS),
}
_HEADER: Final = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m] (or deg, mm)"
_MIN_ROWS: Final = 4  # least number for a cubic with free ends
_MIN_STEP: Final = 1e-6  # s
_MAX_GAP: Final = 10  # largest step over the median step
_MAX_SIZE: Final = 1e3  # rad or m
_MAX_KINK: Final = 0.05
"""Largest kink, as a share of the largest peak to peak of the angles, or of the positions."""
_LEAST_KINK: Final = 1e-3  # rad, m; less is noise of a sensor, not a jump


@dataclass(config=STRICT)
class _WaypointFile:
    times: Annotated[list[Seconds], Field(min_length=2)]
    poses: Annotated[list[Row], Field(min_length=2)]


def waypoints(config: WaypointsConfig) -> tuple[Array, Array]:
    """Return the waypoints of a scenario's section, from its lists or its file."""
    if config.file is not None:
        return read_waypoints(config.file)
    if problem := config.problem():
        raise ConfigError(problem)
    return _checked_waypoints(config.times, config.poses, "reference.")


def read_waypoints(path: str | Path) -> tuple[Array, Array]:
    """Read `times` (s) and `poses` (rad, m) from a YAML file."""
    data = validate(_WaypointFile, load_yaml(path), str(path))
    if len(data.poses) != len(data.times):
        raise ConfigError(
            f"{path}: poses: got {len(data.poses)} poses; expected {len(data.times)}, one per time"
        )
    return _checked_waypoints(data.times, data.poses, f"{path}: ")


def _checked_waypoints(
    times: list[float] | None, poses: list[list[float]] | None, where: str
) -> tuple[Array, Array]:
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
            f"{table.location(0, 'time')}: got {float(times[0])!r}; expected 0 in the first "
            "sample, subtract it from every time"
        )
    check_motion(path, times, poses, table.location, table.scales)
    times[0] = 0.0
    return times, poses


Place = Callable[[int, str], str]
"""Opening of a message about a row and a column, `time` or a coordinate."""


def check_motion(
    path: Path, times: Array, poses: Array, place: Place, scales: Mapping[str, float]
) -> None:
    """Check that samples (n,), (n, 6) are dense and smooth enough for a spline through them.

    `scales` has by coordinate the SI units in the unit of the file.
    """
    _check_samples(times, poses, place, scales)
    if len(times) < _MIN_ROWS:
        raise ConfigError(f"{path}: got {len(times)} samples; expected at least {_MIN_ROWS}")
    steps = np.diff(times)
    widest, median = int(np.argmax(steps)), float(np.median(steps))
    if steps[widest] > _MAX_GAP * median:
        raise ConfigError(
            f"{place(widest + 1, 'time')}: got a gap of {steps[widest]:.6g} s; "
            f"expected steps near the median of {median:.6g} s, fill the gap by resampling"
        )
    kink = _worst_kink(times, poses)
    if kink is not None:
        row, axis, size = kink
        name = COORDINATE_NAMES[axis]
        scale = scales[name]
        raise ConfigError(
            f"{place(row, name)}: got {size / scale:.3g} {_unit(name, scale)} off "
            "the cubic through its neighbours; expected a smooth motion with some ten samples per "
            "swing, filter or resample it"
        )


def _check_samples(times: Array, poses: Array, place: Place, scales: Mapping[str, float]) -> None:
    """Check that times (n,) increase, poses (n, 6) are unique and do not jump by a turn."""

    def check(bad: Flags, problem: str, limit: float = 0.0, before: bool = False) -> None:
        for row, axis in np.argwhere(bad)[:1]:
            row, name = int(row) + before, COORDINATE_NAMES[axis]
            scale = scales[name]
            unit, previous = _unit(name, scale), ""
            if before:
                previous = f" after {poses[row - 1, axis] / scale:.6g}"
            got = f"{float(poses[row, axis]) / scale:.9g} {unit}{previous}"
            expected = problem.format(limit=f"{limit / scale:.6g} {unit}")
            if unit == "rad":
                expected += degrees_hint(poses[row, axis])
            raise ConfigError(f"{place(row, name)}: got {got}; expected {expected}")

    for row in 1 + np.flatnonzero(np.diff(times) < _MIN_STEP)[:1]:
        raise ConfigError(
            f"{place(row, 'time')}: got {float(times[row])!r} after {float(times[row - 1])!r}; "
            "expected increasing times"
        )
    check(np.abs(poses) >= _MAX_SIZE, "a finite number below {limit}", _MAX_SIZE)
    check(np.abs(poses[:, :3]) >= MOST_TURN, "an angle within {limit}, a turn", MOST_TURN)
    steep = np.abs(poses[:, :2]) >= [[math.inf, math.pi / 2]]
    check(steep, "a pitch within {limit}, 90 degrees", math.pi / 2)
    jumps = np.abs(np.diff(poses[:, :3], axis=0)) > math.pi
    check(jumps, "no jump by a turn, unwrap it", before=True)


def _worst_kink(times: Array, poses: Array) -> tuple[int, int, float] | None:
    """Return row, column and size of the worst kink of samples (n,), (n, 6), None if smooth.

    A sample should lie near the cubic through the two before and the two after it. With equal
    steps h the difference is the fourth difference over 6, (omega h)^4 / 6 of a sine's amplitude:
    1.3 % of its peak to peak with ten samples per period, 5 % with seven. A jump shows by half its
    size, a glitch with all of it. Ends are seen as neighbours only. The limit is a share of the
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


def _unit(name: str, scale: float) -> str:
    return next(unit for unit, factor in _UNITS[name].items() if factor == scale)
