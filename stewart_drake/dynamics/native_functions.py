"""Compiled functions of a mechanism's dynamics, and the limit of threads for linear algebra."""

import threading
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import OpenBLASController, threadpool_limits

from stewart_drake.core.layout import SHAPES, SIGNATURES
from stewart_drake.core.library import core
from stewart_drake.mechanism.clearance import LINK_PAIRS, link_radii
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.mechanism.kinematics import angle_rate_map
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    ANGLES,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.types import Array, ArrayLike

Call = Callable[..., Sequence[Array]]
"""Broadcasts its arguments; returns new arrays, matrices transposed. Several threads may call."""


class Buffers(NamedTuple):
    """Places of arguments and results, and a call that evaluates."""

    arguments: list[Array]
    results: list[Array]
    evaluate: Callable[[], object]


_IN_C: Final = {
    "accelerations": ("stewart_accelerations", ["plant", "pose", "rates", "torque"]),
    "inverse_dynamics": ("stewart_inverse_dynamics", ["plant", "pose", "rates", "accelerations"]),
    "energy": ("stewart_energy", ["plant", "pose", "rates"]),
    "residual_derivatives": (
        "stewart_residual_derivatives",
        ["plant", "pose", "rates", "accelerations", "torque"],
    ),
    "measures": ("stewart_measures", ["geometry", "pose", "NULL"]),
    "measures_of_tree": ("stewart_measures", ["geometry", "pose", "angles"]),
    "change": ("stewart_change", ["plant", "state", "torque"]),
}
"""Function of core/dynamics.h and its inputs, by the names of `core.layout.SIGNATURES`. Results
follow. A plant is geometry, parameters and gravity."""


class NativeFunction:
    """A function of core/dynamics.h for one machine, with fixed places for arguments and results.

    Each thread has its own places. That of a matrix has its columns one after the other.

    Args:
        name: in `core.layout.SIGNATURES`.
        geometry: numbers of the machine.
    """

    def __init__(self, name: str, geometry: Array) -> None:
        self._name, self._geometry, self._own = name, geometry, threading.local()

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        places, results, evaluate = self.own_buffers()
        for place, argument in zip(places, arguments, strict=True):
            place[...] = argument
        evaluate()
        return [result.copy() for result in results]

    def own_buffers(self) -> Buffers:
        """Return the buffers of this thread."""
        try:
            return self._own.buffers
        except AttributeError:
            self._own.buffers = self._buffers()
            return self._own.buffers

    def _buffers(self) -> Buffers:
        (names, shapes), c = SIGNATURES[self._name], core()
        given = {name: np.zeros(SHAPES[name]) for name in names}
        results = [np.zeros(shape) for shape in shapes]
        pointers = {name: c.at(array) for name, array in given.items()}
        pointers |= {"geometry": c.at(self._geometry), "NULL": c.ffi.NULL}
        function, arguments = _IN_C[self._name]
        if "plant" in arguments:
            parts = (pointers[name] for name in ("geometry", "parameters", "gravity"))
            pointers["plant"] = c.plant(*parts)
        inputs, outputs = (pointers[name] for name in arguments), map(c.at, results)
        call = partial(getattr(c.lib, function), *inputs, *outputs)
        return Buffers(list(given.values()), results, call)


class NativeFunctions:
    """Functions of one machine, by the names of `core.layout.SIGNATURES`.

    `measures` are the eight of the workspace (`equations.workspace_measures`); `measures_of_tree`
    takes known crank angles (6,) too.
    """

    accelerations: Call
    inverse_dynamics: Call
    energy: Call
    residual_derivatives: Call
    measures: Call
    measures_of_tree: Call

    def __init__(self, mechanism: Mechanism) -> None:
        geometry = geometry_of(mechanism)
        for name in SIGNATURES.keys() - {"change"}:
            setattr(self, name, NativeFunction(name, geometry))
        self._change = NativeFunction("change", geometry)
        self._geometry = core().at(geometry)
        self._links = np.array(LINK_PAIRS, np.intc)
        self._radii, self._unit = link_radii(mechanism), mechanism.crank_lengths.min()

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        """Return d[pose; rates]/dt (12,), in half the time of a `Call`."""
        places, results, evaluate = self._change.own_buffers()
        places[0][...], places[1][...] = state, torque
        places[2][...], places[3][...] = parameters, gravity
        evaluate()
        return np.array(results[0])

    def torques(self, rows: Array, parameters: Array, gravity: float) -> Array:
        """Return `inverse_dynamics` (n, 6) of rows (n, 18), in a fifth of the time of `Call`s."""
        c, function = core(), core().lib.stewart_inverse_dynamics
        rows, torques = np.array(rows, np.float64), np.empty((len(rows), NUM_TORQUES))
        p, g = np.array(parameters, np.float64), np.array([gravity], np.float64)
        plant = c.plant(self._geometry, c.at(p), c.at(g))
        first, result = c.at(rows), c.at(torques)
        for k in range(len(rows)):
            pose = first + NUM_REFERENCE * k
            rates, accelerations = pose + RATES.start, pose + ACCELERATIONS.start
            function(plant, pose, rates, accelerations, result + NUM_TORQUES * k)
        return torques

    def inertia(self, pose: ArrayLike, parameters: Array) -> tuple[Array, Array]:
        """Return M (6, 6) and B (6, 6) of M accelerations + h = B torque.

        `residual_derivatives` has M N and B of nu = N rates, N = diag(E(angles), 1); N' times them
        is in pose coordinates.
        """
        *_, MN, B = self.residual_derivatives(pose, 0.0, 0.0, 0.0, parameters, 0.0)
        N = np.eye(NUM_TORQUES)
        N[ANGLES, ANGLES] = angle_rate_map(np.asarray(pose)[ANGLES])
        return N.T @ MN.T, N.T @ B

    def crank_angles(self, pose: ArrayLike) -> Array:
        """Return crank angles (6,), NaN where a leg does not reach."""
        c, pose, angles = core(), np.array(pose, np.float64), np.empty(NUM_TORQUES)
        c.lib.stewart_crank_angles(self._geometry, c.at(pose), c.at(angles))
        return angles

    def cranks(self, state: ArrayLike) -> Array:
        """Return crank angles and rates (12,) at [pose; rates] (12,).

        NaN where a leg does not reach; rates also where a leg is at its dead centre.
        """
        c, state, J = core(), np.array(state, np.float64), np.empty((NUM_TORQUES, NUM_TORQUES))
        c.lib.stewart_crank_jacobian(self._geometry, c.at(state), c.at(J))
        return np.concatenate([self.crank_angles(state[POSE]), J @ state[RATES]])

    def margins(self, poses: Array, sign: float, least: Array) -> Array:
        """Return the least distances (n,) of the measures of poses (n, 6) above `least` (8,).

        `sign` is that of the parallel measure at home. NaN gives NaN.
        """
        c, function = core(), core().lib.stewart_margin
        rows = np.array(poses, np.float64)
        first, limits = c.at(rows), c.at(least)
        number = range(0, rows.size, NUM_TORQUES)
        return np.array([function(self._geometry, first + i, sign, limits) for i in number])

    def room(self, poses: Array, pairs: NDArray[np.intp], least: Array) -> Array:
        """Return reach margins and clearances (n, 6 + k) of poses (n, 6) above `least` (6 + k,).

        All are in shortest cranks; `pairs` (k,) are indices in `clearance.LINK_PAIRS`.
        """
        rows, links = np.array(poses, np.float64), self._links[pairs]
        room = np.empty((len(rows), len(least)))
        given = self._geometry, len(rows), rows, len(links), links, self._radii, self._unit
        core().call("room", *given, least, room)
        return room

    def many_steps(
        self, state: ArrayLike, torques: Array, parameters: Array, gravity: float, h: Array
    ) -> Array:
        """Return the states (n, 12) after classical Runge-Kutta steps of h (n,) s each.

        The torques (n, 6) are constant in each step.
        """
        c, number = core(), len(torques)
        states = np.empty((number, NUM_STATE))
        given = (np.array(one, np.float64, order="C") for one in (state, torques, h))
        x, held, steps = map(c.at, given)
        p, g = np.array(parameters, np.float64), np.array([gravity], np.float64)
        plant = c.plant(self._geometry, c.at(p), c.at(g))
        kept = c.at(np.arange(number, dtype=np.intc))  # each step's end is a row of `states`
        with_legs, after, slopes = 0, held, c.ffi.NULL  # no slopes; `held` acts to the step's end
        c.lib.stewart_shoot(
            plant, with_legs, number, steps, held, after, kept, x, c.at(states), slopes
        )
        return states


@lru_cache(maxsize=64)
def functions_of(mechanism: Mechanism) -> NativeFunctions:
    """Return the functions of a mechanism, shared by the whole process.

    Raises:
        ConfigError: the compiled core is missing.
    """
    return NativeFunctions(mechanism)


class _OneBlasThread:
    """A context with linear algebra on one thread, until the last user in the process leaves it."""

    def __init__(self) -> None:
        self._lock, self._users = threading.Lock(), 0
        self._limit: threadpool_limits | None = None

    def __enter__(self) -> None:
        with self._lock:
            if self._limit is None:
                self._limit = threadpool_limits(limits=1, user_api="blas")
                _leave_control()
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0 and self._limit is not None:
                self._limit.restore_original_limits()
                self._limit = None
                _leave_control()


def _leave_control() -> None:
    """Let any thread change the limit, which threadpoolctl from 3.8 on allows its setter only."""
    leave = getattr(OpenBLASController, "clear_controlling_thread", None)
    if leave is not None:
        leave()


one_blas_thread: Final = _OneBlasThread()
