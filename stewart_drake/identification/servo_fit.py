"""Numbers of position servos from a log of setpoints and crank angles (theory.md, section 42).

A servo at each crank a has the torque clip(k (u(t - d) - a)) - D a' - F tanh(a' / s) - I a'': its
stiffness k, damping D (with its velocity gain), friction F with the speed s, armature I, and the
sum d of all delays. The ball joints have the friction f and the damping c.

`regression` gives the start of a fit by output error, the least squares of r = a(theta) - measured.
A second fit minimises the innovations (`innovations.py`) of a model in which the friction of slow
cranks is an unknown torque. The intervals join a jackknife over B blocks of the log, with H = J'J
and g_b = J_b' e_b, and the inverse of H:

    delta_b = (H - H_b)^-1 g_b,   P = (B - 1) / B sum_b delta_b delta_b'
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt
from scipy.stats import t as student

from stewart_drake.core.layout import DEFAULT_GRAVITY
from stewart_drake.dynamics.open_loop import Ended, NativePlant
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import progress
from stewart_drake.identification.innovations import Innovations
from stewart_drake.identification.logs import in_effect
from stewart_drake.identification.servo_logs import ServoLog
from stewart_drake.law.servos import PositionServo
from stewart_drake.mechanism.geometry import Mechanism, with_rotors
from stewart_drake.mechanism.kinematics import legs_along, turned
from stewart_drake.scenario.signals import (
    BALL_JOINTS,
    DEFAULT_BALL_JOINT_SPEED,
    NUM_PLANT_PARAMETERS,
    NUM_STATE,
    NUM_TORQUES,
    PLANT_PARAMETERS,
    POSE,
    RATES,
    SHAFTS,
)
from stewart_drake.types import Array

NAMES: Final = (
    "delay",
    "stiffness",
    "damping",
    "friction",
    "friction_speed",
    "armature",
    "ball_joint_friction",
    "ball_joint_damping",
)
UNITS: Final = ("s", "N m/rad", "N m s/rad", "N m", "rad/s", "kg m^2", "N m", "N m s/rad")
"""Of the unknowns theta."""
D, K, DAMPING, FRICTION, SPEED, ARMATURE, BALL_FRICTION, BALL_DAMPING = range(len(NAMES))
WEAK: Final = 0.2
"""Half width of an interval, as a share of the value, above which a number is weak."""
WEAK_DELAY: Final = 3e-3  # s
BEYOND_ROUNDING: Final = 3.0
"""Residual over that of rounding above which friction of the ball joints is tried."""
KEPT: Final = 0.9
"""Share of the residual that must remain at most, for ball joints to be kept."""
SLOW: Final = 2.0
"""Crank speed over s below which friction is unknown; tanh is 0.96 there."""
GOOD_MISFIT: Final = 1.5
"""Root mean square of the innovations above which the first fit counts."""
WRONG: Final = 0.3
"""Residual over the servos' deviation u(t - d) - a above which the fit is wrong."""

_LOW: Final = np.array([0.0, 1e-3, 0.0, 0.0, 2e-3, 0.0, 0.0, 0.0])
_HIGH: Final = np.array([0.5, 1e4, 1e3, 1e2, 2.0, 10.0, 1e2, 1e3])
_SETTLING: Final = 0.5  # s, until the unknown first rates are forgotten
_ACCURACY: Final = 1e-7  # of the integration
_BLOCK: Final = 3.0  # s
_FEWEST_BLOCKS: Final = 4
_ITERATIONS: Final = 20
_RUN_STEPS: Final = 5_000  # largest number of an integration's steps, per s; real servos take 1000
_ALL_STEPS: Final = 120_000  # of all, per s, after which a fit ends; real servos take 100 000
_CONVERGED: Final = 1e-5  # relative change of the sum of squares
_DELAY_STEP: Final = 5e-5  # s, of differences
_STEP: Final = 3e-3  # of other unknowns, relative to their scale
_GRID: Final = 2e-3  # s, of the regression
_CUTOFF: Final = 6.0  # Hz
_DELAYS: Final = np.arange(0.0, 0.3, 1e-3)  # s
_START_SPEED: Final = 0.05  # rad/s
_QUANTILE: Final = float(student.ppf(0.975, math.inf))


@dataclass(frozen=True)
class ServoModel:
    """Machine with position servos under the setpoints of a log."""

    log: ServoLog  # setpoints, and the measured crank angles
    mechanism: Mechanism  # without armature
    torque_limit: float  # of each motor, N m, infinite for none
    gravity: float = DEFAULT_GRAVITY  # m/s^2 along -z
    steps: list[int] = field(default_factory=list, compare=False)  # of each integration so far

    def states(self, theta: Array) -> Array | None:
        """Return states (n, 12) at the times of the log, from rest.

        Return None if the plate leaves, or if the servos are too stiff to integrate.
        """
        times = self.log.times - self.log.times[0]
        start = np.concatenate([self.log.poses[0], np.zeros(NUM_STATE // 2)])
        plant = NativePlant(self._dynamics(theta), start, times, _ACCURACY)
        plant.run.most_steps = round(_RUN_STEPS * times[-1])
        servo = PositionServo(theta[K], 0.0, self.torque_limit)
        # The first setpoint acts from the start on.
        ended = plant.hold(times + theta[D], self.log.setpoints, servo.compiled)
        self.steps.append(plant.run.steps)
        return plant.states if ended == Ended.INSIDE else None

    def _dynamics(self, theta: Array) -> StewartDynamics:
        parameters = np.zeros(NUM_PLANT_PARAMETERS)
        parameters[SHAFTS] = theta[[DAMPING, FRICTION, SPEED]]
        ball = theta[[BALL_DAMPING, BALL_FRICTION]]
        parameters[BALL_JOINTS] = [*ball, DEFAULT_BALL_JOINT_SPEED]
        machine = with_rotors(self.mechanism, theta[ARMATURE])
        return StewartDynamics(machine, self.gravity, parameters, PLANT_PARAMETERS)

    @cached_property
    def counted(self) -> Any:
        """(n,) rows whose residuals count."""
        return self.log.times - self.log.times[0] >= _SETTLING

    def residuals(self, theta: Array) -> Array:
        """Return crank angles minus measured ones (m, 6), rad; 1 if the plate leaves."""
        states, measured = self.states(theta), self.log.cranks[self.counted]
        if states is None:
            return np.ones_like(measured)
        angles = legs_along(self.mechanism, states[self.counted][:, POSE]).crank_angles
        return turned(angles, measured) - measured

    def jacobian(self, theta: Array, free: NDArray[np.intp], here: Array) -> Array:
        """Return the derivatives (m, 6, k) of the residuals by the free unknowns.

        `here` (m, 6) are the residuals at theta.
        """
        scale, columns = scale_of(theta), list[Array]()
        for k in free:
            moved = theta.copy()
            moved[k] += _DELAY_STEP if k == D else _STEP * scale[k]
            columns.append((self.residuals(moved) - here) / (moved[k] - theta[k]))
        return np.stack(columns, axis=2)

    def held_setpoints(self, delay: float) -> Array:
        """Return the setpoints (n, 6) in effect at the times of the log."""
        return in_effect(self.log.times + delay, self.log.setpoints, self.log.times)

    def innovations(self, theta: Array, rounding: float) -> Innovations:
        """Return the filter of residuals near theta; friction of slow cranks is unknown."""
        states = self.states(theta)
        if states is None:
            raise ConfigError(f"{self.log.name}: got a motion that leaves the workspace")
        states, smooth = states[self.counted], theta.copy()
        smooth[[FRICTION, BALL_FRICTION]] = 0.0
        dynamics, geometry = self._dynamics(smooth), self.mechanism
        arms = np.array([geometry.jacobian(x[POSE]) for x in states])
        angles = legs_along(geometry, states[:, POSE]).crank_angles
        asked = theta[K] * (turned(self.held_setpoints(theta[D])[self.counted], angles) - angles)
        torques = np.clip(asked, -self.torque_limit, self.torque_limit)
        stiff = theta[K] * (asked == torques)[:, :, None] * arms
        slopes = np.zeros((len(states) - 1, NUM_STATE + NUM_TORQUES, NUM_STATE + NUM_TORQUES))
        for slope, x, torque, back in zip(slopes, states, torques, stiff, strict=False):
            A, B, _ = dynamics.derivatives(x[POSE], x[RATES], torque)
            slope[:NUM_STATE] = np.hstack([A, B])
            slope[:NUM_STATE, POSE] -= B @ back
        held = expm(slopes * np.diff(self.log.times[self.counted])[:, None, None])
        rates = np.einsum("nij,nj->ni", arms, states[:, RATES])
        still = np.abs(rates) < SLOW * theta[SPEED]
        slow = still[1:] | still[:-1] | (rates[1:] * rates[:-1] < 0)
        return Innovations(
            np.concatenate([arms, np.zeros_like(arms)], axis=2),
            held[:, :NUM_STATE, :NUM_STATE],
            held[:, :NUM_STATE, NUM_STATE:] * (theta[FRICTION] * slow)[:, None, :],
            rounding,
        )


def scale_of(theta: Array) -> Array:
    """Return the size (8,) of each unknown, also where it is 0, from the others."""
    k = theta[K]
    least = np.array([1e-2, k, 1e-3 * k, 1e-3 * k, 1e-2, 1e-5 * k, 1e-3 * k, 1e-3 * k])
    return np.maximum(theta, least)


@dataclass(frozen=True)
class ServoIdentification:
    model: ServoModel  # with the log
    theta: Array  # (8,) values found, of NAMES
    residuals: Array  # (m, 6) rad
    innovations: Array  # (m, 6) residuals after the filter of the fit, of std 1
    jacobian: Array  # (m, 6, k) of the innovations by the free unknowns
    free: NDArray[np.intp]  # (k,) places of those in theta
    rounding: float  # standard deviation of the rounding of a measured angle, rad
    ball_joints_tried: bool  # whether friction of the ball joints was fitted
    iterations: int  # of the fit
    # (8,) of theta from the first fit to the second, 0 if that explains the log
    change: Array = field(default_factory=lambda: np.zeros(len(NAMES)))
    velocity_gain: float = 0.0  # known, a part of the damping, N m s/rad

    @property
    def misfit(self) -> float:
        """Root mean square of the innovations."""
        return float(np.sqrt(np.mean(self.innovations**2)))

    @property
    def residual(self) -> float:
        """Root mean square of the residuals, rad."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @cached_property
    def deviation(self) -> float:
        """Root mean square of u(t - d) - a, rad: what the servos leave."""
        log = self.model.log
        apart = self.model.held_setpoints(self.theta[D]) - log.cranks
        return float(np.sqrt(np.mean(apart[self.model.counted] ** 2)))

    @property
    def right(self) -> bool:
        """Whether the fit explains the log."""
        return self.residual <= WRONG * self.deviation

    @cached_property
    def blocks(self) -> int:
        """Number B of blocks."""
        log = self.model.log
        return max(_FEWEST_BLOCKS, round((log.times[-1] - log.times[0] - _SETTLING) / _BLOCK))

    @cached_property
    def covariances(self) -> tuple[Array, Array]:
        """P of (jackknife) and H^-1 (8, 8); 0 for unknowns that are fixed or at their bound."""
        inner = self.free[(self.theta > _LOW)[self.free]]
        scale = scale_of(self.theta)[inner]
        both = self.jacobian[:, :, np.isin(self.free, inner)] * scale, self.innovations
        parts = zip(*(np.array_split(one, self.blocks) for one in both), strict=True)
        pairs = [(np.vstack(list(j)), e.ravel()) for j, e in parts]
        H = sum(j.T @ j for j, _ in pairs)
        deltas = np.array([np.linalg.lstsq(H - j.T @ j, j.T @ e)[0] for j, e in pairs])
        deltas -= deltas.mean(axis=0)
        both = (1 - 1 / self.blocks) * deltas.T @ deltas, np.linalg.pinv(H)
        P, inverse = np.zeros((2, len(NAMES), len(NAMES)))
        for whole, one in zip((P, inverse), both, strict=True):
            whole[np.ix_(inner, inner)] = np.outer(scale, scale) * one
        return P, inverse

    def interval(self, slope: Array) -> float:
        """Return the half width of the 95 % interval of a function with this slope (8,)."""
        quantiles = float(student.ppf(0.975, self.blocks - 1)), _QUANTILE
        pairs = zip(quantiles, self.covariances, strict=True)
        parts = (q * math.sqrt(float(slope @ P @ slope)) for q, P in pairs)
        return math.hypot(*parts, float(slope @ self.change))

    @cached_property
    def intervals(self) -> Array:
        """(8,) half widths of the 95 % intervals; NaN of a wrong fit and for fixed values."""
        widths = np.array([self.interval(unit) for unit in np.eye(len(NAMES))])
        return np.where(self.right & (widths > 0), widths, np.nan)

    @cached_property
    def combined(self) -> dict[str, tuple[float, float, str]]:
        """Value, half width and unit of the combinations that a log shows best."""
        found = {}
        k, size = self.theta[K], len(NAMES)
        for name, place, unit in (
            ("delay + damping/stiffness", DAMPING, "s"),
            ("friction/stiffness", FRICTION, "rad"),
        ):
            slope = np.zeros(size)
            slope[place], slope[K] = 1 / k, -self.theta[place] / k**2
            slope[D] = float(place == DAMPING)
            value = self.theta[place] / k + slope[D] * self.theta[D]
            found[name] = (float(value), self.interval(slope) if self.right else math.nan, unit)
        return found

    @property
    def weak(self) -> list[str]:
        """Names of the numbers that the log determines badly."""
        limits = np.where(np.arange(len(NAMES)) == D, WEAK_DELAY, WEAK * self.theta)
        return [NAMES[k] for k in self.free if not self.intervals[k] <= limits[k]]

    @property
    def overlay(self) -> dict[str, Any]:
        """Fields of a scenario with the numbers found, for `--set overlay=FILE`.

        Without the delay: in `live` that includes the link's.
        """
        period = float(np.median(np.diff(self.model.log.times)))
        value = [float(f"{x:.6g}") for x in self.theta]
        gain = min(self.velocity_gain, value[DAMPING])
        return {
            "actuator": {
                "kind": "position_servo",
                "stiffness": value[K],
                "velocity_gain": gain,
                "crank_damping": float(f"{value[DAMPING] - gain:.6g}"),
                "friction": value[FRICTION],
                "friction_speed": value[SPEED],
                "armature": value[ARMATURE],
            },
            "plant": {
                "ball_joint_friction": value[BALL_FRICTION],
                "ball_joint_damping": value[BALL_DAMPING],
            },
            "controller": {"period": float(f"{period:.6g}")},
        }

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`; intervals are null if the fit is wrong."""
        return {
            "logs": [self.model.log.name],
            "mechanism": self.model.mechanism.name,
            "intervals": self.right,
            "parameters": {
                NAMES[k]: {
                    "value": float(self.theta[k]),
                    "interval": float(self.intervals[k]),
                    "unit": UNITS[k],
                    "weak": NAMES[k] in self.weak,
                }
                for k in range(len(NAMES))
            },
            "combined": {
                name: {"value": value, "interval": width, "unit": unit}
                for name, (value, width, unit) in self.combined.items()
            },
            "known_mass_kg": self.model.mechanism.plate.mass,
            "torque_limit": self.model.torque_limit,
            "residual_rad": self.residual,
            "rounding_rad": self.rounding,
            "ball_joints_tried": self.ball_joints_tried,
            "iterations": self.iterations,
        }


def regression(model: ServoModel, ball_joints: bool) -> Array:
    """Return theta (8,) by regression; s is a guess."""
    log, machine = model.log, model.mechanism
    times = log.times - log.times[0]
    grid = np.arange(0.0, times[-1], _GRID)
    held = in_effect(times, log.setpoints, grid)
    filtering = butter(4, _CUTOFF * 2 * _GRID, output="sos")
    u, a = (
        CubicSpline(grid, sosfiltfilt(filtering, one, axis=0))
        for one in (held, CubicSpline(times, log.cranks)(grid))
    )
    pose = CubicSpline(grid, sosfiltfilt(filtering, CubicSpline(times, log.poses)(grid), axis=0))
    looks = np.arange(_SETTLING, times[-1] - _SETTLING, 5 * _GRID)
    motion = np.hstack([pose(looks, order) for order in range(3)])
    units = np.zeros((2, NUM_PLANT_PARAMETERS))
    units[:, SHAFTS] = 0.0, 0.0, _START_SPEED
    units[:, BALL_JOINTS] = [(0, 1, DEFAULT_BALL_JOINT_SPEED), (1, 0, DEFAULT_BALL_JOINT_SPEED)]
    dynamics = StewartDynamics(machine, model.gravity)
    tau = np.array([dynamics.inverse_dynamics(*np.split(x, 3)) for x in motion])
    columns = [tau, a(looks, 1), np.tanh(a(looks, 1) / _START_SPEED), a(looks, 2)]
    for parameters in units if ball_joints else ():
        rubbing = StewartDynamics(machine, model.gravity, parameters, PLANT_PARAMETERS)
        columns.append(np.array([rubbing.inverse_dynamics(*np.split(x, 3)) for x in motion]) - tau)
    X = np.stack(columns, axis=2).reshape(-1, len(columns))
    best, found = math.inf, np.zeros(len(columns))
    delay = 0.0
    for one in _DELAYS[times[-1] / 4 > _DELAYS]:
        y = (u(looks - one) - a(looks)).ravel()
        b = np.linalg.lstsq(X, y)[0]
        left = float(np.sum((y - X @ b) ** 2))
        if left < best:
            best, delay, found = left, float(one), b
    theta = np.zeros(len(NAMES))
    stiffness = 1 / found[0] if found[0] > 0 else 1.0
    theta[[D, K, SPEED]] = delay, stiffness, _START_SPEED
    places = (DAMPING, FRICTION, ARMATURE, BALL_FRICTION, BALL_DAMPING)
    theta[list(places[: len(found) - 1])] = stiffness * found[1:]
    return np.clip(theta, _LOW, _HIGH)


def identify_servos(
    log: ServoLog,
    mechanism: Mechanism,
    rounding: float,
    gravity: float = DEFAULT_GRAVITY,
    velocity_gain: float = 0.0,
) -> ServoIdentification:
    """Return the servos that explain a log best.

    A log shows the sum of velocity gain and damping only; the `overlay` has both.

    Friction of the ball joints is fitted if residuals without it are more than rounding, and kept
    if it explains a part of them. `effort_limit` of the mechanism is the motors' torque limit,
    `rounding` the standard deviation of the rounding of a measured angle, rad.
    """
    for name, angles in (("setpoints", log.setpoints), ("crank angles", log.cranks)):
        if not np.ptp(angles, axis=0).max() > 20 * rounding:
            raise ConfigError(f"{log.name}: got {name} that hardly change; expected a motion")
    limit = mechanism.effort_limit
    model = ServoModel(log, mechanism, math.inf if limit is None else limit, gravity)
    progress.phase("servos")
    found = _fitted(model, regression(model, False), np.arange(BALL_FRICTION), rounding)
    if found.residual >= BEYOND_ROUNDING * rounding:
        progress.phase("friction of the ball joints")
        start = regression(model, True)
        start[ARMATURE] = found.theta[ARMATURE]  # a motor without inertia takes short steps
        rubbing = _fitted(model, start, np.arange(len(NAMES)), rounding)
        better = rubbing.residual < KEPT * found.residual
        found = rubbing if better else replace(found, ball_joints_tried=True)
    found = replace(found, velocity_gain=velocity_gain)
    if not found.right:
        return found
    progress.phase("friction of slow cranks unknown")
    white = model.innovations(found.theta, rounding)
    again = _fitted(model, found.theta, found.free, rounding, white)
    kept = again if again.misfit <= GOOD_MISFIT else found
    change = again.theta - found.theta if again.misfit > 1 else kept.change
    tried = found.ball_joints_tried
    return replace(kept, change=change, ball_joints_tried=tried, velocity_gain=velocity_gain)


class _Spent(Exception):
    """The fits have had their number of steps."""


def _fitted(
    model: ServoModel,
    start: Array,
    free: NDArray[np.intp],
    rounding: float,
    white: Callable[[Array], Array] | None = None,
) -> ServoIdentification:
    """Return the fit of the free unknowns by output error, of filtered residuals if given."""
    filtered = white or (lambda residuals: residuals / rounding)
    first, scale = _in_reach(model, start), scale_of(start)[free]
    here, accepted = np.empty(0), list[tuple[Array, Array, Array]]()
    most = _ALL_STEPS * float(np.ptp(model.log.times))

    def whole(x: Array) -> Array:
        theta = first.copy()
        theta[free] = x * scale
        return theta

    def residuals(x: Array) -> Array:
        nonlocal here
        here = model.residuals(whole(x))
        return filtered(here).ravel()

    def jacobian(x: Array) -> Array:
        if accepted and sum(model.steps) > most:
            raise _Spent
        progress.iteration(len(accepted) + 1, _ITERATIONS)
        # The solver asks for it where it has just asked for the residuals, last at the result.
        left = here
        J = filtered(model.jacobian(whole(x), free, here) * scale)
        accepted.append((whole(x), left, J))
        return J.reshape(-1, len(free))

    with suppress(_Spent):
        least_squares(
            residuals,
            np.maximum(first[free], _LOW[free] + 1e-2 * scale) / scale,
            jac=jacobian,
            bounds=(_LOW[free] / scale, _HIGH[free] / scale),
            ftol=_CONVERGED,
            xtol=1e-4,
            max_nfev=_ITERATIONS,
        )
    theta, left, J = accepted[-1]
    return ServoIdentification(
        model=model,
        theta=theta,
        residuals=left,
        innovations=filtered(left),
        jacobian=J / scale,
        free=free,
        rounding=rounding,
        ball_joints_tried=bool(np.isin(BALL_FRICTION, free)),
        iterations=len(accepted),
    )


def _in_reach(model: ServoModel, start: Array) -> Array:
    """Return the start, stiffer if the plate leaves its workspace under it."""
    for factor in (1.0, 2.0, 4.0, 8.0):
        theta = start.copy()
        theta[K] *= factor
        theta[DAMPING] = max(theta[DAMPING], 1e-3 * theta[K])
        if model.states(theta) is not None:
            return theta
    raise ConfigError(
        f"{model.log.name}: got setpoints under which the plate of {model.mechanism.name} leaves "
        "its workspace with any servos; expected a log of this machine"
    )
