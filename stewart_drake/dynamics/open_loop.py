"""The exact plant alone, under torques that are known beforehand, without Drake.

DOP853, the Runge-Kutta method of order 8 of Dormand and Prince, goes from one change of the torques
to the next and stops where the plate leaves its workspace (docs/theory.md, section 32). It runs in
the compiled core, core/plant.h.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.core.library import core
from stewart_drake.dynamics.native_plant import Ended, NativePlant
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose, margin
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, POSE
from stewart_drake.types import Array

_NONE: Final = (0.0,) * NUM_TORQUES


class IntegrationError(ArithmeticError):
    """No step is short enough for the accuracy."""


class Drive(NamedTuple):
    """Motor torques constant + amplitude sin(frequency t + phase), from `start` on.

    Attributes:
        constant: (6,) N m.
        amplitude: (6,) N m.
        frequency: rad/s.
        phase: (6,) rad.
        start: s.
    """

    constant: ArrayLike = _NONE
    amplitude: ArrayLike = _NONE
    frequency: float = 0.0
    phase: ArrayLike = _NONE
    start: float = 0.0

    def torque(self, time: float) -> Array:
        """(6,) N m at a time in s."""
        swing = np.sin(self.frequency * time + np.asarray(self.phase))
        return np.asarray(np.asarray(self.constant) + np.asarray(self.amplitude) * swing)


class Course(NamedTuple):
    """What a plant did.

    Attributes:
        times: (n,) s, those that were asked for, up to the end.
        states: (n, 12) there.
        end: s, the last of the times that were asked for, or when the plate left.
        final: (12,) state there.
        failure: how it left its workspace, or None.
        steps: of the integrator.
        evaluations: of the dynamics.
    """

    times: Array
    states: Array
    end: float
    final: Array
    failure: Failure | None
    steps: int
    evaluations: int


def integrate(
    dynamics: StewartDynamics,
    start: ArrayLike,
    drives: Sequence[Drive],
    times: ArrayLike,
    accuracy: float = 1e-9,
    longest_step: float = math.inf,
) -> Course:
    """Follow the exact plant from t = 0 up to the last of `times`, or out of its workspace.

    Whether it is in there is looked at where steps end and at `times`; the instant at which it left
    is found to 1e-13 s.

    Args:
        dynamics: equations of motion, with the true parameters.
        start: (12,) state at t = 0, in the workspace.
        drives: torques, each until the next one starts, the first at t = 0.
        times: (n,) s, ascending, where states are wanted.
        accuracy: error of a step in a coordinate x, in units of 1 + |x| (rad, m, and per s).
        longest_step: s.

    Raises:
        ValueError: a shape, an order or a range that is none of these.
        IntegrationError: the accuracy cannot be had.
    """
    x0, looks = np.array(start, dtype=np.float64), np.array(times, dtype=np.float64)
    _check(x0, drives, looks, accuracy, longest_step)
    if not margin(dynamics.mechanism, x0[POSE]) > 0:
        raise ValueError(f"start: got pose {x0[POSE]}; expected one in the workspace")
    plant = NativePlant(dynamics, x0, looks, accuracy, longest_step)
    ended = plant.call("open_loop", *in_c(drives))
    if ended == Ended.TOO_SHORT_STEPS:
        raise IntegrationError(
            f"no step is short enough at t = {plant.time:.6g} s for an accuracy of {accuracy:g}"
        )
    failure = None
    if ended == Ended.LEFT:
        failure = diagnose(dynamics.mechanism, plant.time, plant.final[POSE])
    seen, run = plant.seen, plant.run
    kept = looks[:seen], plant.states[:seen]
    return Course(*kept, plant.time, plant.final, failure, run.steps, run.evaluations)


def _check(
    start: Array, drives: Sequence[Drive], times: Array, accuracy: float, longest_step: float
) -> None:
    if start.shape != (NUM_STATE,):
        raise ValueError(f"start: got shape {start.shape}; expected {(NUM_STATE,)}")
    ascending = times.ndim == 1 and len(times) > 0 and bool(np.all(np.diff(times) >= 0))
    if not ascending or not 0 <= times[0] <= times[-1] < math.inf:
        raise ValueError(f"times: got {times}; expected ascending ones from 0 s on")
    if not 1e-14 <= accuracy <= 1e-2:
        raise ValueError(f"accuracy: got {accuracy!r}; expected a number from 1e-14 to 1e-2")
    if not longest_step > 0:
        raise ValueError(f"longest_step: got {longest_step!r}; expected a time above 0 s")
    starts = [drive.start for drive in drives]
    if not drives or starts[0] != 0 or not all(a < b for a, b in pairwise(starts)):
        raise ValueError(f"drives: got starts {starts}; expected ascending ones from 0 s on")
    for drive in drives:
        for name in ("constant", "amplitude", "phase"):
            shape = np.shape(getattr(drive, name))
            if shape != (NUM_TORQUES,):
                raise ValueError(f"drives: {name}: got shape {shape}; expected {(NUM_TORQUES,)}")


def in_c(drives: Sequence[Drive]) -> tuple[Any, int]:
    """Return drives as arguments of `stewart_open_loop`."""
    rows = [
        (*(list(np.asarray(one, np.float64)) for one in (d.constant, d.amplitude, d.phase)),)
        + (d.frequency, d.start)
        for d in drives
    ]
    return core().ffi.new("stewart_drive[]", rows), len(rows)
