"""Setpoints whose log shows the numbers of position servos (theory.md, section 42).

Friction shows in slow turns, armature and damping in quick ones, the delay in steps. So the
setpoints are crank angles of three motions of equal length, about one pose:

    sine:  all coordinates at once, at 0.5 Hz and then 1 Hz,
    sines: eight in each coordinate, 0.3 to 4 Hz in a geometric sequence, smaller above 1.2 Hz,
    steps: a new pose every half second.

Each motion is as large as the limits of the scenario allow, in a simulation with its numbers.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.workspace import margin, margins
from stewart_drake.files.csvio import csv_text
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.logs import in_effect
from stewart_drake.identification.servo_fit import (
    NAMES,
    UNITS,
    ServoIdentification,
    ServoModel,
)
from stewart_drake.identification.servo_logs import SETPOINTS, ServoLog, servo_log
from stewart_drake.law.servos import rise
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.servos import known_stiffness
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import turned
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.signals import BALL_JOINTS, POSE, RATES
from stewart_drake.types import Array

SETPOINTS_FILE: Final = "setpoints.csv"
_SHARES: Final = (1.0, 0.35, 0.6)
"""Of the scenario's motion: amplitude of the sine, rms of the sines, largest step."""
_LINES: Final = 8
_RISE: Final = 1.0  # s
_STEP: Final = 0.5  # s
_SMALLER: Final = 0.85
_LEAST: Final = 0.02
_ROOM: Final = 0.3  # least share of the workspace's margin at the middle
_USED: Final = 0.9  # share of the torque limit


@dataclass(frozen=True)
class ServoPlan:
    """Setpoints for a log, and the expected accuracy of its identification."""

    shares: tuple[float, ...]  # of the three motions, of the size asked for
    # at the scenario's numbers, for a log of them with rounded angles
    expected: ServoIdentification
    peak_torque: float  # N m, with the scenario's numbers
    peak_speed: float  # of a crank, rad/s

    @property
    def log(self) -> ServoLog:
        return self.expected.model.log

    @property
    def csv(self) -> str:
        heads = ["time[s]", *(f"{name}[rad]" for name in SETPOINTS)]
        return csv_text(heads, np.column_stack([self.log.times, self.log.setpoints]), digits=9)

    @cached_property
    def summary(self) -> dict[str, Any]:
        widths = zip(NAMES, self.expected.intervals, UNITS, strict=True)
        return {
            "mechanism": self.expected.model.mechanism.name,
            "shares": list(self.shares),
            "peak_torque": self.peak_torque,
            "peak_crank_rate": self.peak_speed,
            "parameters": {
                name: {"interval": float(width), "unit": unit} for name, width, unit in widths
            },
        }


def mixed_motion(scale: Array, duration: float, period: float, seed: int = 0) -> list[Array]:
    """Return the departures (n, 6) from the middle of the three motions, rad and m.

    `scale` (6,) is the amplitude of the scenario's motion; all three take `duration` s.
    """
    rng, number = np.random.default_rng(seed), round(duration / 3 / period)
    t: Array = period * np.arange(number, dtype=np.float64)
    window = rise(np.minimum(t, t[-1] - t) / _RISE)[:, None]
    half = t[number // 2]
    phase = 2 * np.pi * (0.5 * np.minimum(t, half) + np.maximum(t - half, 0.0))
    sine = np.sin(phase[:, None] + np.arange(6) + rng.uniform(0, 2 * np.pi))
    f = 0.3 * (4 / 0.3) ** (np.arange(_LINES) / (_LINES - 1))
    a = np.minimum(1, 1.2 / f) / np.sqrt(np.sum(np.minimum(1, 1.2 / f) ** 2) / 2)
    phases = rng.uniform(0, 2 * np.pi, (6, _LINES))
    sines = (a * np.sin(2 * np.pi * f * t[:, None, None] + phases)).sum(axis=2)
    count = math.ceil(t[-1] / _STEP) + 1
    poses = rng.uniform(-1, 1, (count, 6))
    poses[[0, -1]] = 0.0
    steps = poses[(t / _STEP).astype(int)]
    return [
        share * scale * one
        for share, one in zip(_SHARES, (window * sine, window * sines, steps), strict=True)
    ]


def plan_servos(
    experiment: Experiment, rounding: float, duration: float = 12.0, seed: int = 0
) -> ServoPlan:
    """Plan the setpoints of a log around the middle of the motion of a scenario with servos.

    `rounding` is the standard deviation of the rounding of a measured angle, rad.
    """
    sc = experiment.scenario
    seen = poses_along(experiment.reference, np.linspace(0, sc.duration))
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    planner = _Planner(experiment, middle)
    motions = mixed_motion(experiment.motion_scale, duration, sc.controller.period, seed)
    fitted = [planner.fitted(motion) for motion in motions]
    model = planner.model(np.vstack([angles for _, angles in fitted]))
    states = model.states(planner.theta)
    if states is None:
        raise ConfigError("plan: got motions that leave the workspace one after the other")
    cranks = _cranks(experiment.truth, states)[:, POSE]
    phase = np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
    code = rounding * math.sqrt(12)
    rounded = code * (np.round(cranks / code - phase) + phase)
    log = servo_log("plan", model.log.times, model.log.setpoints, rounded, experiment.truth)
    seen_by = ServoModel(log, model.mechanism, model.torque_limit, model.gravity)
    rubs, residuals = bool(np.any(planner.theta[-2:] > 0)), seen_by.residuals(planner.theta)
    filtered = seen_by.innovations(planner.theta, rounding)
    free = np.arange(len(NAMES) if rubs else len(NAMES) - 2)
    expected = ServoIdentification(
        model=seen_by,
        theta=planner.theta,
        residuals=residuals,
        innovations=filtered(residuals),
        jacobian=filtered(seen_by.jacobian(planner.theta, free, residuals)),
        free=free,
        rounding=rounding,
        ball_joints_tried=rubs,
        iterations=0,
    )
    torque, speed = planner.peaks(model, states)
    return ServoPlan(tuple(share for share, _ in fitted), expected, torque, speed)


def _cranks(mechanism: Mechanism, states: Array) -> Array:
    """Return crank angles and rates (n, 12) of states (n, 12)."""
    functions = functions_of(mechanism)
    return np.array([functions.cranks(x) for x in states])


class _Planner:
    """Check of motions about a pose (6,) against the limits of a scenario with position servos.

    `theta` (8,) has the scenario's numbers, of `servo_fit.NAMES`.
    """

    def __init__(self, experiment: Experiment, middle: Array) -> None:
        sc, servo = experiment.scenario, known_stiffness(experiment.scenario)
        actuator = sc.actuator
        assert actuator.kind == "position_servo" and servo is not None
        self._experiment, self._middle = experiment, middle
        self._actuator, self._servo = actuator, servo
        damping, friction, _ = np.array(sc.plant_parameters)[BALL_JOINTS]
        self.theta = np.array(
            [
                sc.eta,
                actuator.stiffness,
                actuator.crank_damping + actuator.velocity_gain,
                actuator.friction,
                actuator.friction_speed,
                actuator.armature,
                friction,
                damping,
            ]
        )
        self._least = _ROOM * margin(experiment.mechanism, middle)

    def model(self, setpoints: Array) -> ServoModel:
        """Return the machine under setpoints (n, 6)."""
        experiment = self._experiment
        period = experiment.scenario.controller.period
        times: Array = period * np.arange(len(setpoints), dtype=np.float64)
        log = ServoLog("plan", times, setpoints, setpoints, self._middle[None])
        gravity = experiment.nominal.gravity
        return ServoModel(log, experiment.truth, experiment.torque_limit, gravity)

    def fitted(self, motion: Array) -> tuple[float, Array]:
        """Return the largest share of a motion (n, 6) within all limits, and its setpoints."""
        share = 1.0
        while share > _LEAST:
            setpoints = self._setpoints(self._middle + share * motion)
            if setpoints is not None:
                return share, setpoints
            share *= _SMALLER
        raise ConfigError(
            "plan: got a motion beyond the limits of range, torque or reach even at "
            f"{100 * _LEAST:g} %; expected a pose in the middle of the scenario's motion with room "
            "on all sides"
        )

    def _setpoints(self, poses: Array) -> Array | None:
        """Return the crank angles (n, 6) of poses, or None beyond a limit."""
        machine, servo = self._experiment.mechanism, self._servo
        if margins(machine, poses).min() < self._least:
            return None
        wanted = np.unwrap([machine.crank_angles(pose) for pose in poses], axis=0)
        if not np.all((servo.low <= wanted) & (wanted <= servo.high)):
            return None
        setpoints = wanted.copy()
        for k in range(1, len(wanted)):
            setpoints[k] = servo.limited(wanted[k], setpoints[k - 1])
        model = self.model(setpoints)
        states = model.states(self.theta)
        if states is None or margins(machine, states[:, POSE]).min() < self._least:
            return None
        torque, speed = self.peaks(model, states)
        within = torque <= _USED * self._experiment.torque_limit
        fastest = self._actuator.speed_limit
        return setpoints if within and (fastest is None or speed <= fastest) else None

    def peaks(self, model: ServoModel, states: Array) -> tuple[float, float]:
        """Return the largest torque without limit, N m, and crank speed, rad/s."""
        cranks = _cranks(self._experiment.truth, states)
        log, actuator = model.log, self._actuator
        late = log.times - self.theta[0]
        torques = []
        for instants in (late, late - 1e-9):  # after and before a setpoint that arrives here
            setpoints = in_effect(log.times, log.setpoints, instants)
            error = turned(setpoints - cranks[:, POSE], 0.0)
            torques.append(actuator.stiffness * error - actuator.velocity_gain * cranks[:, RATES])
        return float(np.abs(torques).max()), float(np.abs(cranks[:, RATES]).max())
