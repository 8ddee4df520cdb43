"""Reachy Mini's coordinates and recorded moves, in its SDK and here.

The SDK gives the head's frame H as a matrix X_WH without the height h = 0.177 m of the head at
home, in a world W that stands still while the body turns by its yaw about z. The platform stands on
the body B. With c the head's centre of mass in H,

    R_BP = Rz(-yaw) R_WH,   p_BP = Rz(-yaw) (p_WH + [0, 0, h]) + R_BP c.

A recorded move has the times of its samples, and for each the target of the head, the body and the
antennas:

    {"description": "...", "time": [0.0, ...],
     "set_target_data": [{"head": [16 numbers, or 4 rows of 4], "antennas": [0.0, 0.0],
                          "body_yaw": 0.0}, ...]}
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.files.errors import ConfigError, resembling
from stewart_drake.files.jsonio import load_json
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import brief
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.mechanism.trajectories import PlateTrajectory, make_reference, through_samples
from stewart_drake.scenario.reference_config import ReachyMoveConfig
from stewart_drake.scenario.reference_files import check_motion
from stewart_drake.scenario.signals import ANGLES, COORDINATE_NAMES, POSITION
from stewart_drake.types import Array

HEAD_HEIGHT = 0.177
"""Height of the head's frame over the robot's foot at home, m."""
_ROUNDING = 1e-3  # rotation matrices of the SDK are written with three digits
_EXPECTED: Final = "a recorded move of Reachy Mini: `time` and `set_target_data` of equal length"
_MAX_BYTES: Final = 100_000_000
_MOVE: Final = "time", "set_target_data"
_TARGET: Final = "head", "body_yaw", "antennas"
_LONGEST_STEP: Final = 1.0
"""Largest mean time between samples, s; the SDK records some 50 to 100 per second."""


@lru_cache(maxsize=1)
def _center() -> Array:
    """Return c (3,), m."""
    return load_mechanism("reachy_mini").home[POSITION] - np.array([0.0, 0.0, HEAD_HEIGHT])


def pose_of_head(head: ArrayLike, body_yaw: float = 0.0) -> Array:
    """Return the pose (6,) of the plate, rad and m, on the body.

    Args:
        head: (4, 4) or 16 numbers by rows, as the SDK's `head_pose`.
        body_yaw: rad.

    Raises:
        ConfigError: no finite matrix of a rotation and a translation.
    """
    matrix = np.asarray(head, dtype=np.float64)
    X_WH = matrix.reshape(4, 4) if matrix.size == 16 else matrix
    if X_WH.shape != (4, 4) or not np.all(np.isfinite(X_WH)):
        raise ConfigError(f"head: got shape {matrix.shape}; expected (4, 4), finite numbers")
    R = X_WH[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROUNDING or np.linalg.det(R) < 0:
        raise ConfigError(
            "head: got rows that are not a rotation; expected a rotation and a translation in m"
        )
    if not abs(body_yaw) <= math.pi:
        raise ConfigError(f"body_yaw: got {body_yaw:g}; expected -pi to pi rad")
    turn = rotation(np.array([0.0, 0.0, -body_yaw]))
    R = turn @ R
    position = turn @ (X_WH[:3, 3] + [0.0, 0.0, HEAD_HEIGHT]) + R @ _center()
    roll, yaw = np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[2, 1], R[2, 2]))
    return np.array([roll, pitch, yaw, *position])


def head_of_pose(pose: Array, body_yaw: float = 0.0) -> Array:
    """Return the head's matrix (4, 4) of the SDK at a pose (6,), the inverse of `pose_of_head`."""
    R, X_WH = rotation(pose[ANGLES]), np.eye(4)
    turn = rotation(np.array([0.0, 0.0, body_yaw]))
    X_WH[:3, :3] = turn @ R
    X_WH[:3, 3] = turn @ (pose[POSITION] - R @ _center()) - [0.0, 0.0, HEAD_HEIGHT]
    return X_WH


# ---------------------------------------------------------------- recorded moves


def read_move(path: str | Path) -> tuple[Array, Array]:
    """Read a recorded move.

    Time begins at the first sample. Antennas and the description are ignored, and a missing
    `body_yaw` is 0.

    Returns:
        Times (n,) in s, and poses (n, 6) of the plate on the robot's body, rad and m.

    Raises:
        ConfigError: no such file, or samples that are refused in a CSV file of a motion too.
    """
    path = Path(path)
    data = load_json(path, _MAX_BYTES, _EXPECTED)
    stamps, targets = data.get("time"), data.get("set_target_data")
    _check_spelling(data, _MOVE, str(path))
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
    step = times[-1] / (len(times) - 1) if len(times) > 1 else 0.0
    if step > _LONGEST_STEP:
        raise ConfigError(
            f"{path}: time: got steps of {step:.3g} s; expected at most {_LONGEST_STEP:g} s, "
            "with times in s"
        )
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
    if isinstance(target, dict):
        _check_spelling(target, _TARGET, where)
    if not isinstance(target, dict) or "head" not in target:
        raise ConfigError(f"{where}: got {brief(target)}; expected an object with `head`")
    yaw = _number(target.get("body_yaw", 0.0), f"{where}.body_yaw")
    try:
        head = np.array(target["head"], dtype=np.float64)
        if head.size != 16 or not np.all(np.isfinite(head)):
            raise ValueError
    except (ValueError, TypeError):  # ragged lists and words
        raise ConfigError(
            f"{where}.head: got {brief(target['head'])}; expected 4 rows of 4 numbers, or 16, of a "
            "rotation and a translation in m"
        ) from None
    try:
        return pose_of_head(head, yaw)
    except ConfigError as error:
        raise ConfigError(f"{where}.{error}") from None


def _check_spelling(given: dict[str, Any], names: tuple[str, ...], where: str) -> None:
    for name in given:
        if name not in names and (close := resembling(name, names)):
            raise ConfigError(f"{where}: got key {brief(name)}; did you mean {close[0]}?")


@make_reference.register
def _recorded(config: ReachyMoveConfig, duration: float) -> PlateTrajectory:
    if config.file is None:
        raise ConfigError(config.problem() or "")
    return through_samples(*read_move(resolve("move", config.file)), duration, config.file)
