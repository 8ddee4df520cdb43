"""Position servos: a local loop at each motor follows the crank angles that arrive; and their law.

A servo is given by its bandwidth (`ServoLoop`) or by its stiffness (`Stiffness`).

In the motors' coordinates, the crank angles a (6,), the machine is

    H a'' + ... = tau,    H = Jac^-T M Jac^-1,    Jac = d a / d pose,

and each servo uses one number of that, the mean inertia J that a motor moves at home while the
others are free: 1 / J = trace(H^-1) / 6, the mean acceleration of a crank per its own torque.

    tau = J (w^2 (a_r - a) + 2 d w (a_r' - a')) + tau_model.                          (servo)

A direction in which H has the eigenvalue m follows the setpoint a_r with the error e = a_r - a,

    m e'' + 2 d w J e' + w^2 J e = m a_r'' - (tau_model + other torques),

a second-order loop with the frequency w sqrt(J / m) and the damping d sqrt(J / m). An unknown
constant torque b leaves e = b / (J w^2), independent of the model; a motion without its torque
leaves m a_r'' / (J w^2).

A servo with the stiffness k and the gain k_v has tau = k (u - a) - k_v a'. Its setpoint is held for
a period. To follow a_r, whose motion takes the torque tau_r with friction and armature, it needs

    u = a_r + (tau_r + k_v a_r') / k,                                             (setpoint)

taken in the middle of the hold: a motion within it deviates from its mean by the second order.

The law, `ServoPreview`, sends the crank angles of the reference ahead (core/servo.h). Until a
command is reached, servos given by their bandwidth move to it from the one before (`Segment`).
Without T_ff they need an error to produce the torque of the motion.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.feedforward import Feedforward, InverseDynamicsFeedforward
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.observers import Observer
from stewart_drake.law.sensing import Measurement, Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import turned
from stewart_drake.scenario.signals import (
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_TORQUES,
    POSE,
    RATES,
    SETPOINT,
)
from stewart_drake.types import Array, Flags


def crank_mobility(dynamics: StewartDynamics, pose: Array) -> Array:
    """Return H^-1 = Jac M^-1 Jac' (6, 6), crank accelerations per torque, rad/s^2 per N m."""
    map_ = dynamics.actuation_map(pose)  # Jac'
    return np.asarray(map_.T @ np.linalg.solve(dynamics.mass_matrix(pose), map_))


def mean_inertia(dynamics: StewartDynamics) -> float:
    """Return J, kg m^2."""
    mobility = crank_mobility(dynamics, dynamics.mechanism.home)
    return NUM_TORQUES / float(np.trace(mobility))


@dataclass(frozen=True)
class ServoLoop:
    """Local loop of each motor: (servo), sampled."""

    inertia: float  # J, kg m^2
    bandwidth: float  # w, rad/s
    damping: float  # d
    period: float  # h between two torques, s
    motors: TorqueLimit  # the limit of their torque
    speed_limit: float = math.inf  # of the setpoint, rad/s, infinite for none

    def torque(self, setpoint: Array, model: Array, cranks: Array) -> Array:
        """Return (servo), before any limit, N m.

        Args:
            setpoint: (12,) crank angles and rates to follow, rad and rad/s.
            model: (6,) torque that came with it, N m.
            cranks: (12,) measured; whole turns do not count.
        """
        error = turned(setpoint[POSE], cranks[POSE]) - cranks[POSE]
        rates = setpoint[RATES] - cranks[RATES]
        w = self.bandwidth
        return np.asarray(self.inertia * (w**2 * error + 2 * self.damping * w * rates) + model)

    def limited(self, wanted: Array, last: Array) -> Array:
        """Return the setpoint (12,) within the speed limit, a period after `last` (6,)."""
        if self.speed_limit == math.inf:
            return wanted
        most = self.speed_limit * self.period
        moved = turned(wanted[POSE], last) - last
        late = np.abs(moved) > most
        rates = np.clip(wanted[RATES], -self.speed_limit, self.speed_limit)
        rates = np.where(late, np.sign(moved) * self.speed_limit, rates)
        return np.concatenate([last + np.clip(moved, -most, most), rates])

    def highest_bandwidth(self, inertias: Array) -> float:
        """Return the w in rad/s below which the sampled loop is stable for modes of `inertias`.

        With u = -p e - q e' held for h, p = w^2 J / m and q = 2 d w J / m, the mode goes from
        (e, e') to e' + h u, e + h e' (an engine's semi-implicit step) or e + h e' + h^2 u / 2
        (exactly). By Jury's criterion the first is stable for q h + p h^2 / 2 < 2, the second for
        q h < 2 and p h < 2 q. The first and the last of these, solved for w, with the least m.
        """
        d, ratio = self.damping, inertias.min() / self.inertia
        return min(math.sqrt(4 * d**2 + 4 * ratio) - 2 * d, 4 * d) / self.period


@dataclass(frozen=True)
class PositionServo:
    """The six servos of a machine, given by their stiffness (core/plant.h)."""

    stiffness: float  # k, N m/rad
    velocity_gain: float  # k_v, N m s/rad
    torque_limit: float  # N m, infinite for none

    @cached_property
    def compiled(self) -> Any:
        numbers = self.stiffness, self.velocity_gain, self.torque_limit
        return core().ffi.new("stewart_position_servo *", numbers)

    def torques(self, geometry: Array, setpoint: Array, state: Array) -> Array:
        """Return torques (2, 6) in N m, without and within the limit.

        Args:
            geometry: numbers of the machine, `Mechanism.numbers`.
            setpoint: (6,) crank angles, rad.
            state: (12,) pose and rates.
        """
        c, found = core(), np.empty((2, NUM_TORQUES))
        given = map(c.at, (geometry, setpoint, state, found[0], found[1]))
        c.lib.stewart_position_torque(self.compiled, *given)
        return found


@dataclass(frozen=True)
class Stiffness:
    """Servos given by their stiffness, as the controller knows them; their setpoints are held."""

    stiffness: float  # k, N m/rad
    velocity_gain: float  # k_v, N m s/rad
    # low, high: (6,) range of the setpoints, rad, infinite for none
    low: Array
    high: Array
    most: float  # largest change of a setpoint per period, rad, infinite for none

    def setpoint(self, angles: Array, rates: Array, torque: Array) -> Array:
        """Return (setpoint) (6,) in rad, without limits, for angles, rates and torques (6,)."""
        return np.asarray(angles + (torque + self.velocity_gain * rates) / self.stiffness)

    def limited(self, setpoint: Array, last: Array) -> Array:
        """Return a setpoint (6,) within range and speed, a period after `last` (6,), rad."""
        within = np.clip(turned(setpoint, last), self.low, self.high)
        return np.asarray(last + np.clip(within - last, -self.most, self.most))


class Segment(NamedTuple):
    """Motion of the setpoint from its present value to a command.

    Angles are cubic in time, with the angles and rates of both ends, and the model's torque is
    linear: with commands a period apart, setpoint, rates and torque are continuous.
    """

    begin: float  # s
    end: float  # s; when the command is to be reached
    start: Array  # (18,) angles, rates, torques
    stop: Array  # (18,)

    def at(self, time: float, coast: float) -> Array:
        """Return (18,) at a time in s; after the end it moves on for `coast` s, then stays."""
        h = self.end - self.begin
        if time < self.end:
            s = (time - self.begin) / h
            torques = (1 - s) * self.start[MODEL_TORQUE] + s * self.stop[MODEL_TORQUE]
            return np.concatenate(
                [*cubic(self.start[SETPOINT], self.stop[SETPOINT], h, s), torques]
            )
        angles, rates, torques = np.split(self.stop, 3)
        past = time - self.end
        angles = angles + rates * min(past, coast)
        return np.concatenate([angles, rates if past < coast else 0 * rates, torques])

    def then(self, command: Array, begin: float, end: float, coast: float) -> "Segment":
        """Return the segment from the setpoint at `begin` to a command (18,) at `end`, s."""
        start, stop = self.at(begin, coast), np.array(command)
        stop[POSE] = turned(command[POSE], start[POSE])
        return Segment(begin, end, start, stop)


def cubic(start: Array, end: Array, h: float, s: float) -> tuple[Array, Array]:
    """Return angles and rates (6,) at the share s of h s, by the cubic between two states (12,)."""
    rise, v_0, v_1 = (end[POSE] - start[POSE]) / h, start[RATES], end[RATES]
    a, b = v_0 - rise, v_1 - rise
    left = 1 - s
    pose = left * start[POSE] + s * end[POSE] + h * s * left * (left * a - s * b)
    return pose, rise + left * (1 - 3 * s) * a + s * (3 * s - 2) * b


def rise(share: Array | float) -> Array:
    """Return 10 s^3 - 15 s^4 + 6 s^5 for the share s of a soft start; 0 before it, 1 after it."""
    s = np.clip(share, 0, 1)
    return np.asarray(s**3 * (10 - 15 * s + 6 * s**2))


def still(command: Array, time: float) -> Segment:
    """Return the setpoint of a command (18,) that is reached at a time in s."""
    assert command.shape == (NUM_REFERENCE,)
    return Segment(time, time, command, command)


@dataclass(frozen=True)
class ReportLayout:
    """Layout of the report that a machine with servos sends with each measurement.

    A row for each period, the oldest first: the means of the torques over equal parts of it
    (6 parts), and whether one was at the limit (1 or 0). Then the last torque before the limit (6).
    """

    parts: int  # of a period
    periods: int  # rows; one report fewer may be lost in a row without loss of information

    @property
    def width(self) -> int:
        return NUM_TORQUES * self.parts + 1

    @property
    def size(self) -> int:
        return self.periods * self.width + NUM_TORQUES

    def written(self, put_out: Array, asked: Array, motors: TorqueLimit) -> Array:
        """Return the report (size,) of torques (n, 6), oldest first, n a multiple of all parts."""
        means = put_out.reshape(self.periods * self.parts, -1, NUM_TORQUES).mean(axis=1)
        at_limit = np.array([motors.reached(part) for part in np.split(put_out, self.periods)])
        return self.of_means(means, np.repeat(at_limit, self.parts), asked)

    def of_means(self, means: Array, at_limit: Flags, asked: Array) -> Array:
        """Return the report (size,) of mean torques (n, 6) of all parts, oldest first.

        `at_limit` (n,) is whether a torque was at its limit within a part.
        """
        ever = at_limit.reshape(self.periods, self.parts).any(axis=1)
        rows = np.column_stack([means.reshape(self.periods, -1), ever])
        return np.concatenate([rows.ravel(), asked])


@dataclass(frozen=True)
class ServoPreview:
    """The law for one machine, made of parts of `law.predictive_lqi.PredictiveLqi`.

    Attributes:
        timeline: clock and delay; `parts` as of the reports.
        sensing: model of the sensor.
        observer: estimates state and parameters, with the reported torques.
        feedforward: the torque T_ff of a command.
        reports: layout of the machine's reports.
        servo: servos given by their stiffness, None for others.
        learned: correction (n, 6) of the angles at instants (n,) of the motion, which begins with
            the first sample, in rad and s; None: none.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    feedforward: Feedforward
    reports: ReportLayout
    servo: Stiffness | None = None
    learned: Callable[[Array], Array] | None = None

    @cached_property
    def preview_times(self) -> Array:
        """Instant (1,) at which the next command is to be reached, s from now."""
        share = 1.0 if self.servo is None else 0.5
        return np.array([self.timeline.eta + share * self.timeline.period])

    def command(self, wanted: Array, parameters: Array) -> Array:
        """Return the command (18,) for pose, rates and accelerations (18,), with parameters (p,).

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        angles = self.plant.mechanism.crank_angles(wanted[POSE])
        rates = self.plant.dynamics.actuation_map(wanted[POSE]).T @ wanted[RATES]
        torque = self.feedforward.at(wanted, self.plant.dynamics, parameters)
        if self.servo is not None:
            moves = isinstance(self.feedforward, InverseDynamicsFeedforward)
            angles = self.servo.setpoint(angles, rates * moves, torque)
        return np.concatenate([angles, rates, torque])

    @cached_property
    def _compiled(self) -> CompiledLaw:
        return CompiledLaw(self)

    def initial_memory(self, command: Array) -> Memory:
        """Return the memory before the first sample, with the command (18,) that was sent last."""
        return self._compiled.start(command)

    def step(
        self, memory: Memory, measurement: Measurement, motion: Motion, report: Array
    ) -> Memory:
        """Compute the command of one sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; its age may be that of an earlier sample.
            motion: to follow. It is evaluated once, at `preview_times`.
            report: as of `reports`, that came with the measurement; NaN for none.

        Returns:
            The new memory; its command (18,) is finite.
        """
        return self._compiled.step(memory, measurement, motion, report)
