"""The exact plant of core/plant.h: one machine, one run."""

from enum import IntEnum
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import LEAST, home_sign
from stewart_drake.mechanism.geometry import geometry_of
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array


class Ended(IntEnum):
    """How a run has ended."""

    INSIDE = 0
    LEFT = 1
    TOO_SHORT_STEPS = 2
    CONTROLLER_FAILED = 3


class NativePlant:
    """A plant at t = 0 that one of the functions of plant.h takes to its end.

    Args:
        dynamics: equations of motion, with the true parameters.
        start: (12,) state.
        times: (n,) s, ascending, where states are wanted; the last one is the end.
        accuracy: error of a step in a coordinate x, in units of 1 + |x|.
        longest_step: s.

    Attributes:
        states: (n, 12) result; `seen` of them are known.
        run: the `stewart_run`.
    """

    def __init__(
        self,
        dynamics: StewartDynamics,
        start: Array,
        times: Array,
        accuracy: float,
        longest_step: float,
    ) -> None:
        c, mechanism = core(), dynamics.mechanism
        self.states = np.empty((len(times), NUM_STATE))
        numbers = geometry_of(mechanism), dynamics.plant_parameters, dynamics.gravity
        copies = [np.array(one, np.float64) for one in numbers]
        plant = c.plant(*map(c.at, copies))
        self.run: Any = c.ffi.new("stewart_run *")
        self.run.plant, self.run.sign, self.run.least = plant, home_sign(mechanism), list(LEAST)
        self.run.tolerance, self.run.longest, self.run.end = accuracy, longest_step, times[-1]
        self.run.number, self.run.times = len(times), c.at(times)
        self.run.states, self.run.state = c.at(self.states), list(start)
        self._kept = copies, plant, times

    def call(self, name: str, *arguments: Any) -> Ended:
        """Run by a function of plant.h with its further arguments."""
        return Ended(getattr(core().lib, f"stewart_{name}")(self.run, *arguments))

    @property
    def seen(self) -> int:
        """Number of states that are known."""
        return int(self.run.seen)

    @property
    def time(self) -> float:
        """End of the run, s."""
        return float(self.run.time)

    @property
    def final(self) -> Array:
        """(12,) state there."""
        return np.array(list(self.run.state))
