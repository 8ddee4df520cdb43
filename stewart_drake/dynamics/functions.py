"""The functions of a mechanism's dynamics: in C, or on CasADi's virtual machine."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.native.library import backend
from stewart_drake.scenario.signals import NUM_LEGS

Array = NDArray[np.float64]


class Call(Protocol):
    """Takes what can be broadcast to its arguments, gives fresh arrays, matrices transposed."""

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Evaluate; several threads may."""


class MotionFunctions(Protocol):
    """Functions of pose, rates, torque, parameters (13,) and gravity (m/s^2) of one plant."""

    @property
    def backend(self) -> str:
        """What runs them, for `summary.json`."""

    @property
    def accelerations(self) -> Call:
        """(pose, rates, torque, parameters, gravity) -> accelerations (6,)."""

    @property
    def inverse_dynamics(self) -> Call:
        """(pose, rates, accelerations, parameters, gravity) -> torque (6,)."""

    @property
    def energy(self) -> Call:
        """(pose, rates, parameters, gravity) -> J."""

    @property
    def terms(self) -> Call:
        """(pose, rates, parameters, gravity) -> M, bias and B in pose coordinates."""

    @property
    def residual_derivatives(self) -> Call:
        """(pose, rates, accelerations, torque, parameters, gravity) -> derivatives of
        F = M nu_dot + h - B torque; see `StewartDynamics.derivatives`."""

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        """d[pose; rates]/dt (12,)."""

    def many_steps(self, steps: int) -> Call:
        """(state, torques (n, 6), parameters, gravity, h (n,)) -> states (n, 12), one call.

        Steps of the classical Runge-Kutta method.
        """


class DynamicsFunctions(MotionFunctions, Protocol):
    """Those of a mechanism, and where it may be."""

    @property
    def measures(self) -> Call:
        """(pose) -> the measures of the workspace (8,), see `dynamics.measures`."""

    @property
    def measures_of_tree(self) -> Call:
        """(pose, angles) -> the same with crank angles (6,) that are known."""

    def margin(self, pose: Array, sign: float, least: Array) -> float:
        """`margin_of` the measures of a pose."""


def margin_of(measures: Array, sign: float, least: Array) -> float:
    """By how much the measures (8,) are above the least (8,) allowed; NaN if one of them is.

    `sign`: the parallel measure's at home.
    """
    above = measures - least
    above[NUM_LEGS] = sign * measures[NUM_LEGS] - least[NUM_LEGS]
    return float(above.min())


@lru_cache(maxsize=64)
def compiled_functions(mechanism: Mechanism) -> DynamicsFunctions:
    """The functions of a mechanism, shared by all who ask for it in this process.

    Raises:
        ConfigError: STEWART_NATIVE asks for what there is not.
    """
    library = backend().library
    if library is None:
        from stewart_drake.dynamics.virtual_machine import VirtualMachine

        return VirtualMachine(mechanism)
    from stewart_drake.dynamics.native_functions import NativeFunctions

    return NativeFunctions(mechanism, library)
