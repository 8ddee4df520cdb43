"""A motion that tells much of a machine: sums of sines in all coordinates, inside its workspace.

Coordinate i of six moves by

    q_i(t) = q_0i + w(t) a_i sum_j cos(2 pi f_ij t + phi_ij) / f_ij,

with frequencies f_ij = low + (j + i/6) (high - low) / n of its own, and phases spread evenly over
the turn by the golden sequence, so that no two coordinates move alike. The window w rises from rest
and falls to rest. a_i makes the peak what is asked for.
"""

from typing import Final

import numpy as np

from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

GRID: Final = 0.02
"""s between two samples of the motion."""
_LINES: Final = 5
_LOW: Final = 0.1
_HIGH: Final = 0.7
"""Hz."""
_GOLDEN: Final = (np.sqrt(5) - 1) / 2
_RISE: Final = 2.0
"""s."""
_ROOM: Final = 0.5
"""Of the workspace's margin at the middle of the motion, what is left at least."""
_LEAST_SHARE: Final = 0.05


def multisine(middle: Array, peak: Array, duration: float) -> tuple[Array, Array]:
    """Times (n,) in s and poses (n, 6).

    Args:
        middle: (6,) pose.
        peak: (6,) of each coordinate's departure from it, rad and m.
        duration: s.
    """
    time = GRID * np.arange(round(duration / GRID) + 1)
    line, coordinate = np.arange(_LINES)[:, None], np.arange(6) / 6
    frequency = _LOW + (line + coordinate) * (_HIGH - _LOW) / _LINES
    phase = 2 * np.pi * _GOLDEN * (line + _LINES * np.arange(6))
    waves = np.cos(2 * np.pi * frequency * time[:, None, None] + phase) / frequency
    rise = min(_RISE, duration / 4)
    y = np.clip(np.minimum(time, time[-1] - time) / rise, 0, 1)[:, None]
    window = y**4 * (35 - 84 * y + 70 * y**2 - 20 * y**3)  # three derivatives vanish at both ends
    moved = window * waves.sum(axis=1)
    poses: Array = middle + peak * moved / np.abs(moved).max(axis=0)
    return np.asarray(time, np.float64), poses


def fitted_multisine(
    mechanism: Mechanism, middle: Array, peak: Array, duration: float
) -> tuple[Array, Array, float]:
    """The same, made smaller until it stays well inside the workspace; and the share of `peak`.

    Raises:
        ConfigError: there is no room for a twentieth of it.
    """
    least, share = _ROOM * margin(mechanism, middle), 1.0
    while share > _LEAST_SHARE:
        time, poses = multisine(middle, share * peak, duration)
        if min(margin(mechanism, pose) for pose in poses) > least:
            return time, poses, share
        share *= 0.9
    raise ConfigError(
        f"--plan: got a motion of which not even {100 * _LEAST_SHARE:g} % fits the workspace; "
        "expected a smaller one, around a pose with room on all sides"
    )
