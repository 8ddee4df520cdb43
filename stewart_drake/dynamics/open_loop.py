"""The exact plant alone under known torques, without Drake (core/plant.h).

DOP853, the Runge-Kutta method of order 8 of Dormand and Prince, integrates from one change of the
torques to the next and stops where the plate leaves its workspace (docs/theory.md, section 32). The
workspace is checked at the ends of steps and at the recorded times; the instant of leaving is found
to 1e-13 s.
"""

from enum import IntEnum
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import LEAST, Failure, diagnose, home_sign
from stewart_drake.scenario.signals import NUM_STATE, POSE, WRENCH
from stewart_drake.types import Array, ArrayLike


class IntegrationError(ArithmeticError):
    """No step is short enough for the accuracy."""


class Ended(IntEnum):
    """End of a run in C."""

    INSIDE = 0
    LEFT = 1
    TOO_SHORT_STEPS = 2
    CONTROLLER_FAILED = 3


class NativePlant:
    """A plant at t = 0, for one run by a function of core/plant.h.

    Args:
        dynamics: equations of motion, with the true parameters.
        start: (12,) state.
        times: (n,) s, ascending, at which states are wanted; the last one is the end.
        accuracy: error of a step in a coordinate x, in units of 1 + |x| (rad, m, and per s).

    Attributes:
        states: (n, 12) result; the first `run.recorded` are valid.
        wrench: (6,) on the plate, a view of the parameters that the run reads.
    """

    def __init__(
        self,
        dynamics: StewartDynamics,
        start: Array,
        times: Array,
        accuracy: float,
    ) -> None:
        c, mechanism = core(), dynamics.mechanism
        self._mechanism = mechanism
        self.states = np.empty((len(times), NUM_STATE))
        numbers = mechanism.numbers, dynamics.plant_parameters, dynamics.gravity
        copies = [np.array(one, np.float64) for one in numbers]
        self.wrench = copies[1][WRENCH]
        plant = c.plant(*map(c.at, copies))
        self.run: Any = c.ffi.new("stewart_run *")
        self.run.plant, self.run.sign, self.run.least = plant, home_sign(mechanism), list(LEAST)
        self.run.tolerance, self.run.end = accuracy, times[-1]
        self.run.number, self.run.times = len(times), c.at(times)
        self.run.states, self.run.state = c.at(self.states), list(start)
        self._kept = copies, plant, times

    def call(self, name: str, *arguments: Any) -> Ended:
        """Run by a function of plant.h with its further arguments."""
        return Ended(getattr(core().lib, f"stewart_{name}")(self.run, *arguments))

    def hold(self, begins: ArrayLike, commands: ArrayLike, servo: Any = None) -> Ended:
        """Run under commands (n, 6), each from its time in `begins` (n,) on, s.

        They are motor torques, N m, or setpoints in rad of `servo`, a `stewart_position_servo *`.
        """
        c, first, held = core(), np.array(begins, np.float64), np.array(commands, np.float64)
        servo = c.ffi.NULL if servo is None else servo
        return self.call("open_loop", servo, len(first), c.at(first), c.at(held))

    def failure(self, ended: Ended) -> Failure | None:
        """Return why the plate left its workspace, None if it did not.

        Raises:
            IntegrationError: no step is short enough for the accuracy.
        """
        time = self.run.time
        if ended == Ended.TOO_SHORT_STEPS:
            raise IntegrationError(
                f"no step is short enough at t = {time:.6g} s for an accuracy of "
                f"{self.run.tolerance:g}"
            )
        return diagnose(self._mechanism, time, self.final[POSE]) if ended == Ended.LEFT else None

    @property
    def final(self) -> Array:
        """(12,) state at the end."""
        return np.array(list(self.run.state))
