"""The paper's plant: its torque map (19) frozen at home, behind the interface of the exact one.

    d2(pose)/dt2 = map (torque + bias),      map = `mechanism.assembly.torque_map` at home,

everywhere and without limits. The paper designs its controller with this model; here it is the
plant. Legs have no mass, and the torque bias is the only parameter.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.mechanism.assembly import TorqueMap, torque_map
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map, rotation
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    ANGLES,
    BIAS,
    NUM_COORDINATES,
    NUM_PLANT_PARAMETERS,
    NUM_STATE,
    POSE,
    RATES,
)
from stewart_drake.types import Array, ArrayLike


class FrozenMap:
    """Functions as those of `native_functions.NativeFunctions`, for a constant torque map (6, 6).

    With M the plate's mass matrix at home, M accelerations = M map (torque + bias).
    """

    def __init__(self, mechanism: Mechanism) -> None:
        plate, angles = mechanism.plate, mechanism.home[ANGLES]
        self.map = torque_map(mechanism, mechanism.home)
        R_WP, E = rotation(angles), angle_rate_map(angles)
        self._mass = np.diag(np.repeat([0.0, plate.mass], 3))
        self._mass[ANGLES, ANGLES] = E.T @ R_WP @ np.diag(plate.inertia) @ R_WP.T @ E

    def accelerations(self, *arguments: ArrayLike) -> Sequence[Array]:
        _, _, torque, parameters, _ = arguments
        return [self.map @ (np.asarray(torque) + np.asarray(parameters)[BIAS])]

    def inverse_dynamics(self, *arguments: ArrayLike) -> Sequence[Array]:
        _, _, accelerations, parameters, _ = arguments
        return [np.linalg.solve(self.map, accelerations) - np.asarray(parameters)[BIAS]]

    def torques(self, rows: Array, parameters: Array, gravity: float) -> Array:
        return np.linalg.solve(self.map, rows[:, ACCELERATIONS].T).T - parameters[BIAS]

    def energy(self, *arguments: ArrayLike) -> Sequence[Array]:
        rates = np.asarray(arguments[1])
        return [rates @ self._mass @ rates / 2]

    def inertia(self, pose: ArrayLike, parameters: Array) -> tuple[Array, Array]:
        return self._mass.copy(), self._mass @ self.map

    def residual_derivatives(self, *arguments: ArrayLike) -> Sequence[Array]:
        """Return the derivatives of F = accelerations - map (torque + bias), transposed."""
        by_parameters = np.zeros((NUM_PLANT_PARAMETERS, NUM_COORDINATES))
        by_parameters[BIAS] = -self.map.T
        nothing = np.zeros((NUM_STATE, NUM_COORDINATES))
        return [nothing, by_parameters, np.eye(NUM_COORDINATES), self.map]

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        return np.concatenate([state[RATES], self.map @ (torque + parameters[BIAS])])

    def many_steps(
        self, state: ArrayLike, torques: Array, parameters: Array, gravity: float, h: Array
    ) -> Array:
        """Return the states (n, 12) after steps along parabolas."""
        accelerations = (torques + parameters[BIAS]) @ self.map.T
        states = [np.asarray(state)]
        for a, s in zip(accelerations, h, strict=True):
            pose, rates = states[-1][POSE], states[-1][RATES]
            after = pose + s * rates + s**2 / 2 * a, rates + s * a
            states.append(np.concatenate(after))
        return np.array(states[1:])


class FrozenDynamics(StewartDynamics):
    """Dynamics of the paper's plant: the map (6, 6) at home, at any pose, in or out of reach."""

    def __init__(self, mechanism: Mechanism, *arguments: Any, **named: Any) -> None:
        super().__init__(mechanism, *arguments, **named)
        self._functions = frozen = FrozenMap(mechanism)
        self.map = frozen.map

    def __repr__(self) -> str:
        return f"FrozenDynamics({self.mechanism})"

    def require_reach(self, pose: Array) -> None:
        """Accept any pose."""

    def massless_map(self, pose: Array, form: TorqueMap = "virtual_work") -> Array:
        return torque_map(self.mechanism, self.mechanism.home, form)


class Band(NamedTuple):
    """Limits of a plate without a workspace: a band about its reference."""

    reference: Callable[[float], Array]  # pose (6,) at a time in s
    width: Array  # largest error (6,) in either direction, rad and m

    def margin(self, time: float, pose: Array) -> float:
        """Return a margin in widths, positive inside."""
        return float(1 - np.max(np.abs(pose - self.reference(time)) / self.width))

    def diagnose(self, time: float, pose: Array) -> Failure | None:
        left = self.margin(time, pose)
        if left > 0:
            return None
        return Failure(time, None, left, "the error passed ten times the motion's peak to peak")
