"""The functions of a mechanism's dynamics in C: nothing is built, every machine is data."""

import ctypes
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.compiled import Buffered, Buffers
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.native.layout import SHAPES, SIGNATURES, geometry_of
from stewart_drake.scenario.signals import NUM_PLANT_PARAMETERS, NUM_STATE, NUM_TORQUES

Array = NDArray[np.float64]
Shape = tuple[int, ...]


class NativeFunction(Buffered):
    """A function of native/packed.c: one buffer with arguments, geometry and results.

    Args:
        library: what holds it.
        name: its name there.
        geometry: of the machine.
        arguments, results: their shapes.
        first: numbers that stand before the arguments.
    """

    def __init__(
        self,
        library: ctypes.CDLL,
        name: str,
        geometry: Array,
        arguments: Sequence[Shape],
        results: Sequence[Shape],
        first: Sequence[float] = (),
    ) -> None:
        super().__init__()
        self._call = getattr(library, name)
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
    """`DynamicsFunctions` in C; a mechanism costs nothing but its numbers."""

    backend = "native"

    def __init__(self, mechanism: Mechanism, library: ctypes.CDLL) -> None:
        self._library, self._geometry = library, geometry_of(mechanism)
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
        return NativeFunction(self._library, name, self._geometry, arguments, signature.results)

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
        """`margin_of` the measures of a pose."""
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
            made = NativeFunction(
                self._library, "predict", self._geometry, shapes, results, [steps]
            )
            found = self._many.setdefault(steps, made)
        return found
