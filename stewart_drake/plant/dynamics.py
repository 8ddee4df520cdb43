"""`StewartDynamics`: the exact dynamics of a mechanism as a pure calculator, no LeafSystem."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.plant.equations import STANDARD_GRAVITY
from stewart_drake.plant.functions import compiled_functions
from stewart_drake.signals import (
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


class StewartDynamics:
    """Equations of motion of a `Mechanism` in the pose coordinates of its plate.

    Loops are closed exactly: the state is [pose; rates] (12,). `parameters` (8,) are torque bias
    (6, N m), payload at the plate's COM (kg) and viscous damping of the crank shafts
    (N m s/rad), zero by default; they are arguments of the compiled functions.

    Args:
        mechanism: the machine.
        gravity: True for standard gravity along -z, False for none, or m/s^2.
        parameters: defaults for the methods' `parameters`.

    Calls do not check reach: outside the workspace derivatives stay finite and smooth but mean
    nothing (see `equations._held_above`). Use `Mechanism.reach_margins` or `plant.workspace`.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        gravity: bool | float = True,
        parameters: ArrayLike | None = None,
    ) -> None:
        self.mechanism = mechanism
        switch = isinstance(gravity, bool | np.bool_)
        self.gravity = float(gravity) * (STANDARD_GRAVITY if switch else 1.0)
        self.parameters = np.zeros(NUM_PARAMETERS)
        self._functions = compiled_functions(mechanism)
        if parameters is not None:
            self.parameters[:] = parameters

    def _or_default(self, parameters: ArrayLike | None) -> ArrayLike:
        return self.parameters if parameters is None else parameters

    def accelerations(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        torque: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Second derivative (6,) of the pose under motor torques (6,) in N m."""
        return self._functions.accelerations(
            pose, rates, torque, self._or_default(parameters), self.gravity
        )[0]

    def inverse_dynamics(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        accelerations: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Motor torques (6,) in N m that give these accelerations (6,)."""
        return self._functions.inverse_dynamics(
            pose, rates, accelerations, self._or_default(parameters), self.gravity
        )[0]

    def equilibrium_torque(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Motor torques (6,) in N m that hold the plate still.

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        margins = self.mechanism.reach_margins(np.asarray(pose))
        if not np.all(margins >= 0):
            raise UnreachablePoseError(margins)
        return self.inverse_dynamics(pose, np.zeros(6), np.zeros(6), parameters)

    def energy(
        self, pose: ArrayLike, rates: ArrayLike, parameters: ArrayLike | None = None
    ) -> float:
        """Kinetic plus potential energy in J."""
        return float(
            self._functions.energy(pose, rates, self._or_default(parameters), self.gravity)[0]
        )

    def mass_matrix(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Mass matrix (6, 6) in pose coordinates: kinetic energy = rates' M rates / 2."""
        return self._functions.terms(pose, 0.0, self._or_default(parameters), self.gravity)[0]

    def bias(self, pose: ArrayLike, rates: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Bias (6,): M accelerations + bias = actuation_map (torque + torque bias - friction)."""
        return self._functions.terms(pose, rates, self._or_default(parameters), self.gravity)[1]

    def actuation_map(self, pose: ArrayLike) -> Array:
        """Generalised force (6, 6) in pose coordinates per torque: the Jacobian's transpose."""
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
    ) -> Linearization:
        """Exact derivatives at any point, from those of the residual F(state, accelerations).

        F = M nu_dot + h - B torque = 0 defines the accelerations implicitly, so that their
        derivatives are -(M N)^-1 dF, with dF taken at constant accelerations: no derivative of a
        matrix inverse is needed.
        """
        parameters = self._or_default(parameters)
        accelerations = self.accelerations(pose, rates, torque, parameters)
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
        """States (n, 12) after each of n torques (n, 6) held for `durations` (n,) s.

        Each hold is cut into `substeps` steps of the classical Runge-Kutta method; one CasADi call.
        """
        torques = np.reshape(torques, (-1, NUM_TORQUES))
        n = len(torques)
        if n == 0:
            return np.empty((0, NUM_STATE))
        h = np.broadcast_to(np.asarray(durations, dtype=np.float64), n) / substeps
        states = self._functions.many_steps(n * substeps)(
            state,
            np.repeat(torques, substeps, axis=0),
            self._or_default(parameters),
            self.gravity,
            np.repeat(h, substeps),
        )[0]
        return states.reshape(n, substeps, NUM_STATE)[:, -1]
