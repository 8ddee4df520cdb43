"""The exact plant of core/plant.c: one machine, one run."""

from ctypes import byref, c_double
from typing import Any

import numpy as np

from stewart_drake.core.library import core_library
from stewart_drake.core.plant import Ended, LooksStruct, MachineStruct, RunStruct
from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import LEAST, home_sign
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array


class NativePlant:
    """A plant at t = 0 that one of the functions of plant.c takes to its end.

    Args:
        dynamics: equations of motion, with the true parameters,.
        start: (12,) state.
        times: (n,) s, ascending, where states are wanted; the last one is the end.
        accuracy: error of a step in a coordinate x, in units of 1 + |x|.
        longest_step: s.

    Attributes:
        states: (n, 12) result; `seen` of them are known.
        run: the rest of what is known afterwards.
    """

    def __init__(
        self,
        dynamics: StewartDynamics,
        start: Array,
        times: Array,
        accuracy: float,
        longest_step: float,
    ) -> None:
        functions = functions_of(dynamics.mechanism)
        # Buffers of its own: a controller that is called back may know the same machine.
        change, margin = functions.own_buffers("change"), functions.own_buffers("margin")
        change.arguments[2][...], change.arguments[3][...] = (
            dynamics.plant_parameters,
            dynamics.gravity,
        )
        margin.arguments[1][...], margin.arguments[2][...] = home_sign(dynamics.mechanism), LEAST
        self.states = np.empty((len(times), NUM_STATE))
        self._kept = change, margin, times
        places = [*change.arguments[:2], change.results[0], margin.arguments[0], margin.results[0]]
        self._machine = MachineStruct(*(place.ctypes.data for place in places))
        self._looks = LooksStruct(times.ctypes.data, self.states.ctypes.data, len(times), 0)
        first = (c_double * NUM_STATE)(*start)
        self.run = RunStruct(accuracy, longest_step, times[-1], 0.0, first)

    def call(self, name: str, *arguments: Any) -> Ended:
        """Run by a function of plant.c with its further arguments."""
        plant = byref(self.run), byref(self._machine), byref(self._looks)
        return Ended(core_library()[name](*plant, *arguments))

    @property
    def seen(self) -> int:
        """How many of the states are known."""
        return int(self._looks.seen)

    @property
    def time(self) -> float:
        """Where it has ended, s."""
        return float(self.run.time)

    @property
    def final(self) -> Array:
        """(12,) state there."""
        return np.array(self.run.state)
