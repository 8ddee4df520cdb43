"""Recorded moves of Reachy Mini as references, in the format of its SDK.

A file has the times of the samples, and for each the target of the head, the body and the antennas:

    {"description": "...", "time": [0.0, ...],
     "set_target_data": [{"head": [16 numbers, or 4 rows of 4], "antennas": [0.0, 0.0],
                          "body_yaw": 0.0}, ...]}
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.jsonio import load_json
from stewart_drake.files.yamlio import brief
from stewart_drake.machines.reachy_mini import pose_of_head
from stewart_drake.scenario.reference_config import ReachyMoveConfig
from stewart_drake.scenario.reference_files import check_motion
from stewart_drake.scenario.signals import ANGLES, COORDINATE_NAMES
from stewart_drake.scenario.trajectories import make_reference, through_samples
from stewart_drake.types import Array

_EXPECTED: Final = "a recorded move of Reachy Mini: `time` and `set_target_data` of equal length"
_MAX_BYTES: Final = 100_000_000


def read_move(path: str | Path) -> tuple[Array, Array]:
    """Read a recorded move.

    The first sample is at time 0. Antennas and the description are ignored, and a missing
    `body_yaw` is 0.

    Returns:
        Times (n,) in s, and poses (n, 6) of the plate on the robot's body, rad and m.

    Raises:
        ConfigError: no such file, or samples that are refused in a CSV file of a motion too.
    """
    path = Path(path)
    data = load_json(path, _MAX_BYTES, _EXPECTED)
    stamps, targets = data.get("time"), data.get("set_target_data")
    if not (isinstance(stamps, list) and isinstance(targets, list)):
        raise ConfigError(f"{path}: got keys {brief(sorted(data))}; expected {_EXPECTED}")
    if len(stamps) != len(targets):
        raise ConfigError(
            f"{path}: got {len(stamps)} times and {len(targets)} targets; expected {_EXPECTED}"
        )
    times = np.array([_number(t, f"{path}: time[{i}]") for i, t in enumerate(stamps)])
    poses = np.array([_pose(t, f"{path}: set_target_data[{i}]") for i, t in enumerate(targets)])
    poses = poses.reshape(-1, len(COORDINATE_NAMES))
    times -= times[:1].sum()  # of no sample 0
    poses[:, ANGLES] = np.unwrap(poses[:, ANGLES], axis=0)

    def place(row: int, name: str) -> str:
        return f"{path}: " + (f"time[{row}]" if name == "time" else f"sample {row}, {name}")

    check_motion(path, times, poses, place, dict.fromkeys(COORDINATE_NAMES, 1.0))
    return times, poses


def _number(value: Any, where: str) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e12:
        return float(value)
    raise ConfigError(f"{where}: got {brief(value)}; expected a finite number")


def _pose(target: Any, where: str) -> Array:
    if not isinstance(target, dict) or "head" not in target:
        raise ConfigError(f"{where}: got {brief(target)}; expected an object with `head`")
    yaw = _number(target.get("body_yaw", 0.0), f"{where}.body_yaw")
    try:
        return pose_of_head(np.array(target["head"], dtype=np.float64), yaw)
    except (ValueError, TypeError):  # ConfigError is a ValueError; ragged lists and words too
        raise ConfigError(
            f"{where}.head: got {brief(target['head'])}; expected 4 rows of 4 numbers, or 16, of a "
            "rotation and a translation in m"
        ) from None


@make_reference.register
def _recorded(config: ReachyMoveConfig, duration: float) -> Trajectory:
    if config.file is None:
        raise ConfigError(config.problem() or "")
    return through_samples(*read_move(config.file), duration, config.file)
