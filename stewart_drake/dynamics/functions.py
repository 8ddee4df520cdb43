"""Interface of the functions of a plant's dynamics."""

from collections.abc import Sequence
from typing import Protocol

from numpy.typing import ArrayLike

from stewart_drake.types import Array


class Call(Protocol):
    """Takes what can be broadcast to its arguments, gives fresh arrays, matrices transposed."""

    def __call__(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Evaluate; several threads may."""


class MotionFunctions(Protocol):
    """Functions of pose, rates, torque, parameters (13,) and gravity (m/s^2) of one plant."""

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
