"""`StewartDynamics`: the exact dynamics of a mechanism as a pure calculator, no LeafSystem."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.dynamics.equations import STANDARD_GRAVITY
from stewart_drake.dynamics.functions import compiled_functions
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError, angle_rate_map
from stewart_drake.scenario.signals import (
    ANGLES,
    NUM_COORDINATES,
    NUM_PARAMETERS,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)

Array = NDArray[np.float64]


class Linearization(NamedTuple):
    """State-space derivatives of d[pose; rates]/dt at a point."""

    A: Array
    """(12, 12) with respect to the state."""
    B: Array
    """(12, 6) with respect to the torque."""
    G: Array
    """(12, 8) with respect to the parameters (torque bias, payload, damping)."""


_EIGHT = (NUM_PARAMETERS,)


def _check(**arguments: ArrayLike) -> None:
    """ValueError unless each has six components; in their place one would count for all."""
    for name, value in arguments.items():
        if getattr(value, "shape", None) != (6,):
            _shaped(name, value, (6,))


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    if np.shape(value) != shape:
        raise ValueError(f"{name}: got shape {np.shape(value)}; expected {shape}")
    return value


def _finite(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """A copy of what is finite and of this shape."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigError(f"{name}: got {value!r}; expected numbers") from None
    if numbers.shape != shape:
        expected = f"shape {shape}" if shape else "one number"
        raise ConfigError(f"{name}: got shape {numbers.shape}; expected {expected}")
    if not np.all(np.isfinite(numbers)):
        raise ConfigError(f"{name}: got {numbers}; expected finite numbers")
    return numbers


class StewartDynamics:
    """Equations of motion of a `Mechanism` in the pose coordinates of its plate.

    Loops are closed exactly: the state is [pose; rates] (12,). `parameters` (8,) are torque bias
    (6, N m), payload at the plate's COM (kg) and viscous damping of the crank shafts
    (N m s/rad), zero by default; they are arguments of the compiled functions.

    Args:
        mechanism: the machine.
        gravity: True for 9.81 m/s^2 along -z, which is Drake's default, False for none, or m/s^2.
        parameters: (8,) defaults for the methods' `parameters`.

    Raises:
        ConfigError: gravity or parameters of another shape, or not finite.

    Every method raises ValueError for an argument of another shape than it names: one number does
    not stand for six. Values are not looked at, so that NaN gives NaN.

    A calculator can be copied, pickled, and used by several threads.

    Calls do not check reach: outside the workspace derivatives stay finite and smooth but mean
    nothing (see `equations._held_above`). Use `Mechanism.reach_margins` or `dynamics.workspace`.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        gravity: bool | float = True,
        parameters: ArrayLike | None = None,
    ) -> None:
        self.mechanism = mechanism
        switch = isinstance(gravity, bool | np.bool_)
        scale = STANDARD_GRAVITY if switch else 1.0
        self.gravity = float(scale * _finite("gravity", gravity, ()))
        given = np.zeros(NUM_PARAMETERS) if parameters is None else parameters
        self.parameters = _finite("parameters", given, _EIGHT)
        self._functions = compiled_functions(mechanism)

    def __reduce__(self) -> tuple[Any, ...]:
        # Compiled functions cannot be copied, but made again, or found.
        return type(self), (self.mechanism, self.gravity, self.parameters)

    def __repr__(self) -> str:
        return f"StewartDynamics({self.mechanism}, gravity {self.gravity:g} m/s^2)"

    def _or_default(self, parameters: ArrayLike | None) -> ArrayLike:
        if parameters is None:
            return self.parameters
        return _shaped("parameters", parameters, _EIGHT)

    def accelerations(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        torque: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Second derivative (6,) of the pose under motor torques (6,) in N m."""
        _check(pose=pose, rates=rates, torque=torque)
        return self._functions.accelerations(
            pose, rates, torque, self._or_default(parameters), self.gravity
        )[0]

    def change(self, state: Array, torque: Array) -> Array:
        """d[pose; rates]/dt (12,), for an integrator, whose arrays have the right shape."""
        return self._functions.change(state, torque, self.parameters, self.gravity)

    def inverse_dynamics(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        accelerations: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Motor torques (6,) in N m that give these accelerations (6,)."""
        _check(pose=pose, rates=rates, accelerations=accelerations)
        return self._functions.inverse_dynamics(
            pose, rates, accelerations, self._or_default(parameters), self.gravity
        )[0]

    def equilibrium_torque(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Motor torques (6,) in N m that hold the plate still.

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        margins = self.mechanism.reach_margins(pose)
        if not np.all(margins >= 0):
            raise UnreachablePoseError(margins)
        return self.inverse_dynamics(pose, np.zeros(6), np.zeros(6), parameters)

    def energy(
        self, pose: ArrayLike, rates: ArrayLike, parameters: ArrayLike | None = None
    ) -> float:
        """Kinetic plus potential energy in J."""
        _check(pose=pose, rates=rates)
        return float(
            self._functions.energy(pose, rates, self._or_default(parameters), self.gravity)[0]
        )

    def mass_matrix(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Mass matrix (6, 6) in pose coordinates: kinetic energy = rates' M rates / 2."""
        _check(pose=pose)
        return self._functions.terms(pose, 0.0, self._or_default(parameters), self.gravity)[0]

    def bias(self, pose: ArrayLike, rates: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Bias (6,): M accelerations + bias = actuation_map (torque + torque bias - friction)."""
        _check(pose=pose, rates=rates)
        return self._functions.terms(pose, rates, self._or_default(parameters), self.gravity)[1]

    def wrench_accelerations(
        self, pose: ArrayLike, wrench: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """What a wrench on the plate adds to the accelerations of the pose (6,).

        A wrench F = [moment; force] at the plate's COM, in W, has the power
        moment . w + force . v = F . nu: it is a generalised force of nu, and joins (EOM) as

            M nu_dot + h = B torque + F.

        With nu = N rates, N' M N in pose coordinates, and all else unchanged, that adds

            (N' M N)^-1 N' F,   N = diag(E(angles), 1).

        Args:
            pose: (6,).
            wrench: (6,) N m and N.
            parameters: (8,) or the defaults.
        """
        _check(pose=pose, wrench=wrench)
        force = np.array(wrench, dtype=np.float64)
        force[ANGLES] = angle_rate_map(np.asarray(pose)[ANGLES]).T @ force[ANGLES]
        return np.linalg.solve(self.mass_matrix(pose, parameters), force)

    def actuation_map(self, pose: ArrayLike) -> Array:
        """Generalised force (6, 6) in pose coordinates per torque: the Jacobian's transpose."""
        _check(pose=pose)
        return self._functions.terms(pose, 0.0, 0.0, 0.0)[2].T

    def linearize(
        self, pose: ArrayLike, rates: ArrayLike | None = None, torque: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """A (12, 12), B (12, 6) of d[pose; rates]/dt; rates zero, torque at equilibrium by default.

        Raises:
            UnreachablePoseError: no torque was given and the pose is out of reach.
        """
        if torque is None:
            torque = self.equilibrium_torque(pose)
        return self.derivatives(pose, np.zeros(6) if rates is None else rates, torque)[:2]

    def derivatives(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        torque: ArrayLike,
        parameters: ArrayLike | None = None,
        wrench: ArrayLike | None = None,
    ) -> Linearization:
        """Exact derivatives at any point, from those of the residual F(state, accelerations).

        F = M nu_dot + h - B torque = 0 defines the accelerations implicitly, so that their
        derivatives are -(M N)^-1 dF, with dF taken at constant accelerations: no derivative of a
        matrix inverse is needed. A constant `wrench` (6,), see `wrench_accelerations`, is a
        constant part of F, so that it changes nothing but the accelerations there.
        """
        _check(pose=pose, rates=rates, torque=torque)
        parameters = self._or_default(parameters)
        at = (pose, rates, torque, parameters, self.gravity)
        accelerations = self._functions.accelerations(*at)[0]
        if wrench is not None:
            accelerations += self.wrench_accelerations(pose, wrench, parameters)
        dF_dx, dF_dp, MN, arm = self._functions.residual_derivatives(
            pose, rates, accelerations, torque, parameters, self.gravity
        )
        # Results come transposed (column order); `arm`' s transpose is B.
        right = np.concatenate([-dF_dx, arm.T, -dF_dp]).T
        both = np.zeros((NUM_STATE, right.shape[1]))
        both[POSE, RATES] = np.eye(NUM_COORDINATES)
        both[RATES] = np.linalg.solve(MN.T, right)
        return Linearization(*np.split(both, [NUM_STATE, NUM_STATE + NUM_TORQUES], axis=1))

    def predict(
        self,
        state: ArrayLike,
        torques: ArrayLike,
        durations: ArrayLike,
        substeps: int = 1,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """States (n, 12) after each of n torques (n, 6) held for `durations` s, (n,) or one.

        Each hold is cut into `substeps` steps of the classical Runge-Kutta method; one call.
        """
        _shaped("state", state, (NUM_STATE,))
        torques = np.asarray(torques, dtype=np.float64)
        if torques.shape == (NUM_TORQUES,) or torques.size == 0:  # one, or none
            torques = torques.reshape(-1, NUM_TORQUES)
        n = len(torques) if torques.ndim else 0
        _shaped("torques", torques, (n, NUM_TORQUES))
        if n == 0:
            return np.empty((0, NUM_STATE))
        if np.ndim(durations):
            _shaped("durations", durations, (n,))
        h = np.broadcast_to(np.asarray(durations, dtype=np.float64), n) / substeps
        states = self._functions.many_steps(n * substeps)(
            state,
            np.repeat(torques, substeps, axis=0),
            self._or_default(parameters),
            self.gravity,
            np.repeat(h, substeps),
        )[0]
        return states.reshape(n, substeps, NUM_STATE)[:, -1]
