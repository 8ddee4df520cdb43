"""Reachy Mini's coordinates: the pose of its head in its SDK, and the pose of the plate here.

The SDK gives the head's frame H as a matrix X_WH without the height h = 0.177 m of the head at
home, in a world W that stands still while the body turns by its yaw about z. The platform stands on
the body B. With c the head's centre of mass in H,

    R_BP = Rz(-yaw) R_WH,   p_BP = Rz(-yaw) (p_WH + [0, 0, h]) + R_BP c.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.scenario.signals import ANGLES, POSITION
from stewart_drake.types import Array

HEAD_HEIGHT = 0.177
"""Height of the head's frame over the robot's foot at home, m."""
_ROUNDING = 1e-3  # rotation matrices of the SDK are written with three digits


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
    if X_WH.shape != (4, 4) or not np.all(np.isfinite([*X_WH.ravel(), body_yaw])):
        raise ConfigError(f"head: got shape {matrix.shape}; expected (4, 4), finite numbers")
    R = X_WH[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROUNDING or np.linalg.det(R) < 0:
        raise ConfigError("head: got no rotation in its first three rows; expected one")
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
