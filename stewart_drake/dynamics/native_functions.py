"""The functions of a mechanism's dynamics, of the compiled core: a mechanism is data."""

import ctypes
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.core.layout import SHAPES, SIGNATURES
from stewart_drake.core.library import core_library
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.scenario.signals import NUM_PLANT_PARAMETERS, NUM_STATE, NUM_TORQUES
from stewart_drake.types import Array

Shape = tuple[int, ...]


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
    """A function of core/packed.c: one buffer with arguments, geometry and results.

    Args:
        name: its name there.
        geometry: of the machine.
        arguments, results: their shapes.
        first: numbers that stand before the arguments.
    """

    def __init__(
        self,
        name: str,
        geometry: Array,
        arguments: Sequence[Shape],
        results: Sequence[Shape],
        first: Sequence[float] = (),
    ) -> None:
        super().__init__()
        self._call = getattr(core_library(), name)
        self._call.restype = None
        self._fixed = np.array(first, dtype=np.float64), geometry
        self._shapes = arguments, results

    def buffers(self) -> Buffers:
        """One block of memory, and views of it."""
        (first, geometry), (arguments, results) = self._fixed, self._shapes
        shapes = [first.shape, *arguments, geometry.shape, *results]
        ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
        block = np.zeros(ends[-1])
        parts = np.split(block, ends[:-1])
        views = [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]
        after = 1 + len(arguments)
        views[0][...], views[after][...] = first, geometry
        evaluate = partial(self._call, ctypes.c_void_p(block.ctypes.data))
        return Buffers(views[1:after], views[after + 1 :], evaluate, block)


class NativeFunctions:
    """Functions of `dynamics.functions.MotionFunctions` and measures of the workspace.

    `measures` takes a pose and returns the eight of `dynamics.measures`; `measures_of_tree` takes
    the crank angles (6,) too, where these are known.

    Raises:
        ConfigError: there is no compiled core.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._geometry = geometry_of(mechanism)
        self._many: dict[int, NativeFunction] = {}
        named = {name: self._function(name) for name in SIGNATURES}
        self.accelerations = named["accelerations"]
        self.inverse_dynamics = named["inverse_dynamics"]
        self.energy, self.terms = named["energy"], named["terms"]
        self.residual_derivatives = named["residual_derivatives"]
        self.measures, self.measures_of_tree = named["measures"], named["measures_of_tree"]
        self._change, self._margin = named["change"], named["margin"]

    def _function(self, name: str) -> NativeFunction:
        signature = SIGNATURES[name]
        arguments = [SHAPES[argument] for argument in signature.arguments]
        return NativeFunction(name, self._geometry, arguments, signature.results)

    def own_buffers(self, name: str) -> Buffers:
        """Fresh ones of a function of SIGNATURES, for C that calls it."""
        return self._function(name).buffers()

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
        places, results, evaluate, _ = self._margin.own_buffers()
        places[0][...], places[1][...], places[2][...] = pose, sign, least
        evaluate()
        return float(results[0])

    def many_steps(self, steps: int) -> NativeFunction:
        """(state, torques (n, 6), parameters, gravity, h (n,)) -> states (n, 12), one call."""
        found = self._many.get(steps)
        if found is None:
            shapes = (NUM_STATE,), (steps, NUM_TORQUES), (NUM_PLANT_PARAMETERS,), (), (steps,)
            results = [(steps, NUM_STATE)]
            made = NativeFunction("predict", self._geometry, shapes, results, [steps])
            found = self._many.setdefault(steps, made)
        return found


@lru_cache(maxsize=64)
def functions_of(mechanism: Mechanism) -> NativeFunctions:
    """Return the functions of a mechanism, which all of this process share.

    Raises:
        ConfigError: there is no compiled core.
    """
    return NativeFunctions(mechanism)
