"""A trajectory of the user's own as the motion of a loop, checked at the border."""

import math
from typing import Final

import numpy as np
from pydrake.trajectories import FunctionHandleTrajectory, Trajectory

from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.signals import ACCELERATIONS, NUM_COORDINATES, POSE, RATES
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

_REST: Final = 1e-6
"""rad/s or m/s; a trajectory that ends slower than this goes on at rest."""
_APART: Final = 1e-9
"""s before and after a joint of two pieces."""
_CHECKS: Final = 200
"""Instants at which a trajectory is looked at."""


def own_motion(reference: Trajectory, duration: float) -> Trajectory:
    """A trajectory of the user's own, checked, and at rest after its end.

    Args:
        reference: 6 x 1, rad and m, with derivatives of order 1 and 2.
        duration: of the simulation, s.

    Returns:
        The same, defined for t >= 0: the controller looks ahead of the end.

    Raises:
        ConfigError: one line.
    """
    name = f"reference: {type(reference).__name__}"
    shape = (reference.rows(), reference.cols())
    if shape != (NUM_COORDINATES, 1):
        raise ConfigError(f"{name}: got shape {shape}; expected (6, 1), the pose")
    begin, end = reference.start_time(), reference.end_time()
    if begin > 0:
        raise ConfigError(f"{name}: got a start at {begin:g} s; expected one at 0 s or before")
    if end < 0:
        raise ConfigError(f"{name}: got an end at {end:g} s; expected one after 0 s")
    for t in np.linspace(0.0, min(duration, end), _CHECKS):
        try:
            values = evaluate(reference, float(t))
        except (Exception, SystemExit) as error:  # Drake ends the process where it has none
            raise ConfigError(
                f"{name}: got no pose, rates and accelerations at {t:.4g} s "
                f"({' '.join(str(error).split())}); expected derivatives of order 1 and 2"
            ) from error
        if not np.all(np.isfinite(values)):
            raise ConfigError(f"{name}: got {values} at {t:.4g} s; expected finite numbers")
    _check_joints(name, reference, min(duration, end))
    if math.isinf(end):
        return reference
    rates = evaluate(reference, end)[RATES]
    if end < duration and np.abs(rates).max() > _REST:
        raise ConfigError(
            f"{name}: got an end at {end:g} s with rates {rates}; expected it to come to rest, or "
            f"duration <= {end:g}"
        )
    return _held_after(reference, end)


def _check_joints(name: str, reference: Trajectory, until: float) -> None:
    """Refuse pieces that do not fit, such as straight lines: nothing with a mass follows a jump."""
    if not hasattr(reference, "get_segment_times"):
        return
    joints = [t for t in reference.get_segment_times() if 0 < t < until]
    for t in joints:
        before, after = (evaluate(reference, t + side * _APART) for side in (-1, 1))
        for what, part, change in (("pose", POSE, RATES), ("rates", RATES, ACCELERATIONS)):
            moving = np.abs(np.concatenate([before[change], after[change]])).max()
            jump = np.abs(after[part] - before[part]).max()
            if jump > _REST + 4 * _APART * moving:
                raise ConfigError(
                    f"{name}: got a jump of {jump:.3g} in the {what} at {t:.4g} s; expected pose "
                    "and rates without jumps"
                )


def _held_after(reference: Trajectory, end: float) -> Trajectory:
    still = np.zeros((NUM_COORDINATES, 1))

    def derivative(t: float, order: int) -> Array:
        return reference.EvalDerivative(t, order) if t <= end else still

    held = FunctionHandleTrajectory(
        lambda t: reference.value(min(t, end)), NUM_COORDINATES, 1, 0.0, math.inf
    )
    held.set_derivative(derivative)
    return held
