"""`StewartDynamics`: the exact dynamics of a mechanism as a pure calculator, no LeafSystem."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.core.layout import DEAD_CENTRE_SINE, DEFAULT_GRAVITY
from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.workspace import measures_at
from stewart_drake.files.arguments import fixed
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.assembly import TorqueMap, torque_map
from stewart_drake.mechanism.files import as_mechanism
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import (
    BALL_JOINT_FRICTION_SPEED,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    DEFAULT_BALL_JOINT_SPEED,
    DEFAULT_COULOMB_SPEED,
    NUM_BALL_JOINT_PARAMETERS,
    NUM_CONSTANTS,
    NUM_COORDINATES,
    NUM_PARAMETERS,
    NUM_PLANT_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PARAMETERS,
    PLANT_PARAMETERS,
    POSE,
    RATES,
    WRENCH,
)
from stewart_drake.types import Array, ArrayLike

_SPEEDS: Final = {
    COULOMB_SPEED: DEFAULT_COULOMB_SPEED,
    BALL_JOINT_FRICTION_SPEED: DEFAULT_BALL_JOINT_SPEED,
}
"""Speeds of smooth friction among the parameters, rad/s, above 0."""
_WITHOUT_BALL_JOINTS: Final = NUM_CONSTANTS - NUM_BALL_JOINT_PARAMETERS


class Linearization(NamedTuple):
    """Derivatives of d[pose; rates]/dt at a point."""

    A: Array  # (12, 12) by the state
    B: Array  # (12, 6) by the torque
    G: Array  # (12, p) by the free parameters


def _check(**arguments: ArrayLike) -> None:
    """Check that each argument has six components; one number would be broadcast to six."""
    for name, value in arguments.items():
        if getattr(value, "shape", None) != (6,):
            _shaped(name, value, (6,))


def _shaped(name: str, value: ArrayLike, shape: tuple[int, ...]) -> ArrayLike:
    if np.shape(value) != shape:
        raise ValueError(f"{name}: got shape {np.shape(value)}; expected {shape}")
    return value


def plant_parameters(values: ArrayLike | None = None) -> Array:
    """Return all parameters of the plant (22,), in the order of `PLANT_PARAMETERS`.

    Args:
        values: all of them; the constants (16,), without a wrench; the first 13, also without
            friction in ball joints; or the first eight, also without Coulomb friction, and with a
            payload at the plate's COM. None is a plant without any.

    Raises:
        ConfigError: another shape, numbers that are not finite, a speed that is not positive.
    """
    whole = np.zeros(NUM_PLANT_PARAMETERS)
    for place, speed in _SPEEDS.items():
        whole[place] = speed
    if values is None:
        return whole
    first = np.shape(values)
    if first not in ((NUM_PARAMETERS,), (_WITHOUT_BALL_JOINTS,), (NUM_CONSTANTS,)):
        first = (NUM_PLANT_PARAMETERS,)
    whole[: first[0]] = fixed("parameters", values, first)
    for place in _SPEEDS:
        if not whole[place] > 0:
            raise ConfigError(
                f"parameters: got a {PLANT_PARAMETERS[place]} of {whole[place]:g} rad/s; expected "
                "above 0"
            )
    return whole


def _slice(indices: list[int]) -> slice | list[int]:
    """Return consecutive indices as a slice, which is ten times as fast."""
    if indices and indices == list(range(indices[0], indices[-1] + 1)):
        return slice(indices[0], indices[-1] + 1)
    return indices


class StewartDynamics:
    """Equations of motion of a `Mechanism` in the pose coordinates of its plate.

    Loops are closed exactly: the state is [pose; rates] (12,). The plant's parameters (22,) are
    torque bias (6, N m), payload (kg), viscous damping of the crank shafts (N m s/rad), their
    Coulomb friction (N m) with the speed over which it builds up (rad/s), where the payload is
    (3, m in the plate's frame, from its COM), of each ball joint viscous damping (N m s/rad),
    Coulomb friction (N m) and its speed (rad/s) (core/ball_joints.h), and a wrench on the plate
    (moment, N m, then force, N, in W at its COM).

    Some of them are `free`: the methods' `parameters` (p,) and the columns of G. The others are
    constant. By default bias, payload and damping are free (8,). A free name that the plant lacks,
    such as a constant of a sensor, has no effect.

    Args:
        mechanism: the machine, or a name or path for `load_mechanism`.
        gravity: True for 9.81 m/s^2 along -z, which is Drake's default, False for none, or m/s^2.
        parameters: (22,) or fewer, see `plant_parameters`.
        free: names (p,) out of `scenario.signals.PLANT_PARAMETERS`, and others.

    Raises:
        ConfigError: gravity or parameters of another shape, or not finite.

    Attributes:
        plant_parameters: (22,) all parameters.
        parameters: (p,) the free ones, the default of the methods' `parameters`.

    Methods raise ValueError for an argument of another shape; one number is not broadcast to six.
    NaN gives NaN. A calculator can be copied, pickled, and used by several threads.

    Calls do not check reach: outside the workspace derivatives stay finite and smooth but mean
    nothing (`equations._held_above`). Use `Mechanism.reach_margins` or `dynamics.workspace`.
    """

    def __init__(
        self,
        mechanism: Mechanism | str,
        gravity: bool | float = True,
        parameters: ArrayLike | None = None,
        free: Sequence[str] = PARAMETERS,
    ) -> None:
        self.mechanism = as_mechanism(mechanism)
        switch = isinstance(gravity, bool | np.bool_)
        scale = DEFAULT_GRAVITY if switch else 1.0
        self.gravity = float(scale * fixed("gravity", gravity, ()))
        self.plant_parameters = plant_parameters(parameters)
        self.free = tuple(free)
        # Places of the plant's parameters among the free ones, and among all of the plant's.
        own = [i for i, name in enumerate(free) if name in PLANT_PARAMETERS]
        place = [PLANT_PARAMETERS.index(free[i]) for i in own]
        self._own, self._place = _slice(own), _slice(place)
        self.parameters = self.free_of(self.plant_parameters)
        self._functions: Any = functions_of(self.mechanism)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.mechanism, self.gravity, self.plant_parameters, self.free)

    def __repr__(self) -> str:
        return f"StewartDynamics({self.mechanism}, gravity {self.gravity:g} m/s^2)"

    def assuming(self, parameters: ArrayLike) -> "StewartDynamics":
        """Return a calculator with other free parameters (p,)."""
        return type(self)(self.mechanism, self.gravity, self.complete(parameters), self.free)

    def complete(self, parameters: ArrayLike | None) -> Array:
        """Return all parameters of the plant (22,) for free ones (p,); None is the default."""
        if parameters is None:
            return self.plant_parameters
        _shaped("parameters", parameters, (len(self.free),))
        whole = self.plant_parameters.copy()
        whole[self._place] = np.asarray(parameters)[self._own]
        return whole

    def free_of(self, of_plant: Array) -> Array:
        """Return the free rows (p, ...) of (22, ...), 0 for names that the plant lacks."""
        spread = np.zeros((len(self.free), *of_plant.shape[1:]))
        spread[self._own] = of_plant[self._place]
        return spread

    def require_reach(self, pose: Array) -> None:
        """Raise UnreachablePoseError for a pose (6,) out of reach or at a dead centre, or NaN."""
        if not measures_at(self.mechanism, pose).sines.min() >= DEAD_CENTRE_SINE:
            raise UnreachablePoseError(self.mechanism.reach_margins(pose))

    def massless_map(self, pose: Array, form: TorqueMap = "virtual_work") -> Array:
        """Return the paper's accelerations per torque (6, 6), see `mechanism.assembly`."""
        return torque_map(self.mechanism, pose, form)

    def accelerations(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        torque: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Return the second derivative (6,) of the pose under motor torques (6,) in N m."""
        _check(pose=pose, rates=rates, torque=torque)
        return self._functions.accelerations(
            pose, rates, torque, self.complete(parameters), self.gravity
        )[0]

    def change(self, state: Array, torque: Array, parameters: Array | None = None) -> Array:
        """Return d[pose; rates]/dt (12,), without checks, under all parameters (22,)."""
        whole = self.plant_parameters if parameters is None else parameters
        return self._functions.change(state, torque, whole, self.gravity)

    def inverse_dynamics(
        self,
        pose: ArrayLike,
        rates: ArrayLike,
        accelerations: ArrayLike,
        parameters: ArrayLike | None = None,
    ) -> Array:
        """Return the motor torques (6,) in N m for accelerations (6,)."""
        _check(pose=pose, rates=rates, accelerations=accelerations)
        return self._functions.inverse_dynamics(
            pose, rates, accelerations, self.complete(parameters), self.gravity
        )[0]

    def torques_along(self, rows: Array, parameters: ArrayLike | None = None) -> Array:
        """Return `inverse_dynamics` (n, 6) of poses, rates and accelerations (n, 18)."""
        _shaped("rows", rows, (len(rows), NUM_REFERENCE))
        return self._functions.torques(rows, self.complete(parameters), self.gravity)

    def equilibrium_torque(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Return the motor torques (6,) in N m that hold the plate still.

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
        """Return the kinetic plus potential energy in J."""
        _check(pose=pose, rates=rates)
        return float(
            self._functions.energy(pose, rates, self.complete(parameters), self.gravity)[0]
        )

    def mass_matrix(self, pose: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Return the mass matrix (6, 6): kinetic energy = rates' M rates / 2."""
        _check(pose=pose)
        return self._functions.inertia(pose, self.complete(parameters))[0]

    def bias(self, pose: ArrayLike, rates: ArrayLike, parameters: ArrayLike | None = None) -> Array:
        """Return h (6,), friction of ball joints included.

        M accelerations + h = actuation_map (torque + torque bias - friction of the shafts) + wrench
        """
        _check(pose=pose, rates=rates)
        whole, rest = np.array(self.complete(parameters)), np.zeros(NUM_TORQUES)
        whole[[*range(NUM_TORQUES), DAMPING, COULOMB]] = 0  # biases, and friction of the shafts
        whole[WRENCH] = 0
        M = self._functions.inertia(pose, whole)[0]
        return -M @ self._functions.accelerations(pose, rates, rest, whole, self.gravity)[0]

    def wrench_accelerations(
        self, pose: ArrayLike, wrench: ArrayLike, parameters: ArrayLike | None = None
    ) -> Array:
        """Return the accelerations of the pose (6,) that a wrench on the plate adds.

        Args:
            pose: (6,).
            wrench: (6,) moment and force in W at the plate's COM, N m and N.
            parameters: (p,) or the defaults.
        """
        _check(pose=pose, wrench=wrench)
        whole, rest = self.complete(parameters), np.zeros(NUM_COORDINATES)
        pushed = whole.copy()
        pushed[WRENCH] += wrench
        with_it, without = (
            self._functions.accelerations(pose, rest, rest, given, self.gravity)[0]
            for given in (pushed, whole)
        )
        return with_it - without

    def actuation_map(self, pose: ArrayLike) -> Array:
        """Return the generalised force per torque (6, 6): the Jacobian's transpose."""
        _check(pose=pose)
        return self._functions.inertia(pose, self.plant_parameters)[1]

    def linearize(
        self, pose: ArrayLike, rates: ArrayLike | None = None, torque: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Return A, B of d[pose; rates]/dt; rates zero, torque at equilibrium by default.

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
        """Return exact derivatives at any point, from those of F(state, accelerations).

        F = M nu_dot + h - B torque = 0 defines the accelerations implicitly, so that their
        derivatives are -(M N)^-1 dF, with dF taken at constant accelerations: no derivative of a
        matrix inverse is needed.
        """
        _check(pose=pose, rates=rates, torque=torque)
        whole = self.complete(parameters)
        at = (pose, rates, torque, whole, self.gravity)
        accelerations = self._functions.accelerations(*at)[0]
        dF_dx, dF_dp, MN, arm = self._functions.residual_derivatives(
            pose, rates, accelerations, torque, whole, self.gravity
        )
        # Results come transposed (column order); `arm`' s transpose is B.
        right = np.concatenate([-dF_dx, arm.T, -self.free_of(dF_dp)]).T
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
        """Return the states (n, 12) after each of n torques (n, 6) held for `durations` s.

        Each hold, of `durations` (n,) or one, has `substeps` steps of the classical Runge-Kutta
        method.
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
        held, steps = np.repeat(torques, substeps, axis=0), np.repeat(h, substeps)
        given = self.complete(parameters), self.gravity, steps
        states: Array = self._functions.many_steps(state, held, *given)
        return states[substeps - 1 :: substeps]
