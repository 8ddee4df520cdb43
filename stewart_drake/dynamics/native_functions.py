"""The functions of a mechanism's dynamics, of the compiled core: a mechanism is data."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.core.layout import SHAPES, SIGNATURES
from stewart_drake.core.library import core
from stewart_drake.dynamics.functions import Call
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.scenario.signals import NUM_PLANT_PARAMETERS, NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array


class Buffers(NamedTuple):
    """Where a function reads arguments from and writes results to, and what makes it do so."""

    arguments: list[Array]
    results: list[Array]
    evaluate: Callable[[], object]
    owner: object
    """`evaluate` points into it without keeping it."""


class Buffered(ABC):
    """A function with fixed places for arguments and results; every thread has its own.

    A matrix argument or result is held by columns, the row order of its transpose. Results are
    fresh arrays.
    """

    def __init__(self) -> None:
        self._own = threading.local()

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Evaluate; every argument is broadcast to its place."""
        places, results, evaluate, _ = self.own_buffers()
        for place, argument in zip(places, arguments, strict=True):
            place[...] = argument
        evaluate()
        return [result.copy() for result in results]

    def own_buffers(self) -> Buffers:
        """Those of this thread."""
        try:
            return self._own.buffers
        except AttributeError:
            self._own.buffers = self.buffers()
            return self._own.buffers

    @abstractmethod
    def buffers(self) -> Buffers:
        """Those of one more thread."""


class NativeFunction(Buffered):
    """A function of core/dynamics.h for one machine.

    Args:
        name: in `core.layout.SIGNATURES`.
        geometry: numbers of the machine.
    """

    def __init__(self, name: str, geometry: Array) -> None:
        super().__init__()
        self._name, self._geometry = name, geometry
        self._core = core()

    def buffers(self) -> Buffers:
        """Return arrays of this thread, and a call of the function with their addresses."""
        names, shapes = SIGNATURES[self._name]
        given, results = {n: np.zeros(SHAPES[n]) for n in names}, [np.zeros(s) for s in shapes]
        at = {name: self._core.at(array) for name, array in given.items()}
        first = self._core.at(self._geometry)
        if "gravity" in at:
            first = self._core.plant(first, at.pop("parameters"), at.pop("gravity"))
        if self._name == "measures":
            at["angles"] = self._core.ffi.NULL
        function = getattr(self._core.lib, f"stewart_{self._name.removesuffix('_of_tree')}")
        evaluate = partial(function, first, *at.values(), *map(self._core.at, results))
        return Buffers(list(given.values()), results, evaluate, first)


class NativeFunctions:
    """Functions of `dynamics.functions.MotionFunctions` and measures of the workspace.

    `measures` takes a pose and returns the eight of `dynamics.measures`; `measures_of_tree` takes
    the crank angles (6,) too, where these are known.

    Raises:
        ConfigError: there is no compiled core.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._geometry, self._core = geometry_of(mechanism), core()
        named = {name: NativeFunction(name, self._geometry) for name in SIGNATURES}
        self.accelerations = named["accelerations"]
        self.inverse_dynamics = named["inverse_dynamics"]
        self.energy, self.terms = named["energy"], named["terms"]
        self.residual_derivatives = named["residual_derivatives"]
        self.measures, self.measures_of_tree = named["measures"], named["measures_of_tree"]
        self._change, self._first = named["change"], self._core.at(self._geometry)

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        """d[pose; rates]/dt (12,): a plain call of `_change`, in half its time."""
        places, results, evaluate, _ = self._change.own_buffers()
        places[0][...], places[1][...] = state, torque
        places[2][...], places[3][...] = parameters, gravity
        evaluate()
        return results[0].copy()

    def margin(self, pose: Array, sign: float, least: Array) -> float:
        """Return by how much the measures of a pose are above `least` (8,); NaN if one is NaN.

        `sign`: the parallel measure's at home.
        """
        at = self._core.at
        given = self._first, at(np.array(pose, np.float64)), sign, at(least)
        return float(self._core.lib.stewart_margin(*given))

    def many_steps(self, steps: int) -> Call:
        """(state, torques (n, 6), parameters, gravity, h (n,)) -> states (n, 12), one call."""

        c, first = self._core, self._first

        def call(*arguments: ArrayLike) -> Sequence[Array]:
            shapes = (NUM_STATE,), (steps, NUM_TORQUES), (NUM_PLANT_PARAMETERS,), (1,), (steps,)
            given = [np.empty(shape) for shape in shapes]
            for place, argument in zip(given, arguments, strict=True):
                place[...] = argument
            states = np.empty((steps, NUM_STATE))
            state, torques, parameters, gravity, h, result = map(c.at, (*given, states))
            plant = c.plant(first, parameters, gravity)
            c.lib.stewart_steps(plant, steps, state, torques, h, result)
            return [states]

        return call


@lru_cache(maxsize=64)
def functions_of(mechanism: Mechanism) -> NativeFunctions:
    """Return the functions of a mechanism, which all of this process share.

    Raises:
        ConfigError: there is no compiled core.
    """
    return NativeFunctions(mechanism)
