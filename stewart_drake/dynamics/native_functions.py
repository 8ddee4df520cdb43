"""Compiled functions of a mechanism's dynamics, and the limit of threads for linear algebra."""

import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
from threadpoolctl import OpenBLASController, threadpool_limits

from stewart_drake.core.layout import MEASURES
from stewart_drake.core.library import core
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    ANGLES,
    NUM_COORDINATES,
    NUM_PLANT_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.types import Array, ArrayLike


class NativeFunctions:
    """Functions of core/dynamics.h and core/kinematics.h for one machine; several threads may call.

    Those of `arguments` take the ones of the function in C, then all parameters (22,) and gravity.
    They return new arrays, matrices transposed.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self._core = core()
        self._geometry = self._core.at(mechanism.numbers)
        self._plant = lru_cache(maxsize=64)(self._make_plant)  # takes half the time of a call

    def _make_plant(self, parameters: bytes, gravity: float) -> Any:
        """Return a `stewart_plant *` and what it points to."""
        numbers = np.frombuffer(parameters), np.array([gravity])
        return self._core.plant(self._geometry, *map(self._core.at, numbers)), numbers

    def _call(self, name: str, arguments: Sequence[Any], *shapes: tuple[int, ...]) -> Any:
        c, (*inputs, parameters, gravity) = self._core, arguments
        plant, _kept = self._plant(np.asarray(parameters, np.float64).tobytes(), gravity)
        arrays = [np.ascontiguousarray(one, np.float64) for one in inputs]
        results = [np.empty(shape) for shape in shapes]
        getattr(c.lib, f"stewart_{name}")(plant, *map(c.at, arrays), *map(c.at, results))
        return results

    def accelerations(self, *arguments: ArrayLike) -> list[Array]:
        return self._call("accelerations", arguments, (NUM_COORDINATES,))

    def inverse_dynamics(self, *arguments: ArrayLike) -> list[Array]:
        return self._call("inverse_dynamics", arguments, (NUM_TORQUES,))

    def energy(self, *arguments: ArrayLike) -> list[Array]:
        return self._call("energy", arguments, ())

    def residual_derivatives(self, *arguments: ArrayLike) -> list[Array]:
        by_state, by_parameters = ((n, 6) for n in (NUM_STATE, NUM_PLANT_PARAMETERS))
        return self._call(
            "residual_derivatives", arguments, by_state, by_parameters, (6, 6), (6, 6)
        )

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        """Return d[pose; rates]/dt (12,); written out, as integrators call it most."""
        c, change = self._core, np.empty(NUM_STATE)
        plant, _kept = self._plant(parameters.tobytes(), gravity)
        x, tau = np.ascontiguousarray(state), np.ascontiguousarray(torque)
        c.lib.stewart_change(plant, c.at(x), c.at(tau), c.at(change))
        return change

    def measures(self, pose: ArrayLike, angles: ArrayLike | None = None) -> Array:
        """Return the eight measures of the workspace, see core/dynamics.h."""
        measures = np.empty(MEASURES)
        known = None if angles is None else np.array(angles, np.float64)
        arrays = np.array(pose, np.float64).reshape(NUM_COORDINATES), known, measures
        self._core.lib.stewart_measures(self._geometry, *map(self._core.at, arrays))
        return measures

    def torques(self, rows: Array, parameters: Array, gravity: float) -> Array:
        """Return `inverse_dynamics` (n, 6) of rows (n, 18), in a fifth of the time of calls."""
        c, function = self._core, self._core.lib.stewart_inverse_dynamics
        rows, torques = np.array(rows, np.float64), np.empty((len(rows), NUM_TORQUES))
        plant, _kept = self._plant(parameters.tobytes(), gravity)
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
        rest = np.zeros(NUM_TORQUES)
        *_, MN, B = self.residual_derivatives(pose, rest, rest, rest, parameters, 0.0)
        N = np.eye(NUM_TORQUES)
        N[ANGLES, ANGLES] = angle_rate_map(np.asarray(pose)[ANGLES])
        return N.T @ MN.T, N.T @ B

    def crank_angles(self, pose: ArrayLike) -> Array:
        """Return crank angles (6,), NaN where a leg does not reach."""
        c, pose, angles = self._core, np.array(pose, np.float64), np.empty(NUM_TORQUES)
        c.lib.stewart_crank_angles(self._geometry, c.at(pose), c.at(angles))
        return angles

    def cranks(self, state: ArrayLike) -> Array:
        """Return crank angles and rates (12,) at [pose; rates] (12,).

        NaN where a leg does not reach; rates also where a leg is at its dead centre.
        """
        c, state, J = self._core, np.array(state, np.float64), np.empty((NUM_TORQUES, NUM_TORQUES))
        c.lib.stewart_crank_jacobian(self._geometry, c.at(state), c.at(J))
        return np.concatenate([self.crank_angles(state[POSE]), J @ state[RATES]])

    def margins(self, poses: Array, sign: float, least: Array) -> Array:
        """Return the least distances (n,) of the measures of poses (n, 6) above `least` (8,).

        `sign` is that of the parallel measure at home. NaN gives NaN.
        """
        c, function = self._core, self._core.lib.stewart_margin
        rows = np.array(poses, np.float64)
        first, limits = c.at(rows), c.at(least)
        number = range(0, rows.size, NUM_TORQUES)
        return np.array([function(self._geometry, first + i, sign, limits) for i in number])

    def many_steps(
        self, state: ArrayLike, torques: Array, parameters: Array, gravity: float, h: Array
    ) -> Array:
        """Return the states (n, 12) after classical Runge-Kutta steps of h (n,) s each.

        The torques (n, 6) are constant in each step.
        """
        c, number = self._core, len(torques)
        states = np.empty((number, NUM_STATE))
        given = (np.array(one, np.float64, order="C") for one in (state, torques, h))
        x, held, steps = map(c.at, given)
        plant, _kept = self._plant(parameters.tobytes(), gravity)
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
