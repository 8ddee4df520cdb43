"""Setpoints of position servos: crank angles to send, checked and compensated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.arguments import fixed
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.fileio import write_asked
from stewart_drake.files.yamlio import load_yaml, one_message, validate
from stewart_drake.law.learned import LearnedSignal
from stewart_drake.law.servos import Stiffness, rise
from stewart_drake.loop.learned import learned_signal
from stewart_drake.loop.preparation import Experiment, knowing, prepare
from stewart_drake.loop.servos import known_stiffness
from stewart_drake.mechanism.kinematics import turned
from stewart_drake.mechanism.trajectories import RESTING, PlateTrajectory, continues, evaluate
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.field_types import Row, section
from stewart_drake.scenario.reference_config import degrees_hint
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    ANGLES,
    LEGS,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    POSITION,
    RATES,
)
from stewart_drake.types import Array

SHORTEST_BLEND: Final = 1.0
"""Shortest soft start, s; it is doubled until the motion keeps its limits."""
_LARGEST_RATE: Final = 1000.0  # Hz
_ROUNDING: Final = 1e-12
_REVERSED: Final = np.repeat([1.0, -1.0, 1.0], 6)  # a motion (18,) backwards in time


@section
class ServoUnits:
    """Units of servos: value = offset + sign * angle, in that unit.

    Attributes:
        unit: `rad`, `deg` or `ticks`; ticks are rounded.
        ticks_per_turn: of a crank, with `ticks`.
        offset: at a crank angle of 0, in the unit, one or six.
        sign: 1 or -1, one or six.
    """

    unit: Literal["rad", "deg", "ticks"] = "rad"
    ticks_per_turn: Annotated[float, Field(gt=0, le=1e9)] = 4096.0
    offset: Annotated[float | Row, one_message("a finite number, or six of them")] = 0.0
    sign: Annotated[
        Literal[1, -1] | Annotated[list[Literal[1, -1]], Field(min_length=6, max_length=6)],
        one_message("1 or -1, or six of these"),
    ] = 1

    def converted(self, angles: Array) -> Array:
        """Return angles (..., 6) in rad as values of the servos."""
        per_rad = {
            "rad": 1.0,
            "deg": 180 / math.pi,
            "ticks": self.ticks_per_turn / (2 * math.pi),
        }[self.unit]
        values = np.asarray(self.offset) + np.asarray(self.sign) * per_rad * angles
        return np.rint(values) if self.unit == "ticks" else values


def load_units(path: str | Path) -> ServoUnits:
    """Read a YAML file with the fields of `ServoUnits`."""
    data = load_yaml(Path(path))
    units = validate(ServoUnits, data, str(path))
    if ("ticks_per_turn" in data) != (units.unit == "ticks"):
        got = "none" if units.unit == "ticks" else "one"
        raise ConfigError(
            f"{path}: ticks_per_turn: got {got} in {units.unit}; expected one with unit: ticks only"
        )
    return units


@dataclass(frozen=True)
class Setpoints:
    """Setpoints, each to be held until the next one."""

    times: Array  # (n,) s, at which each is sent
    angles: Array  # (n, 6) setpoints, rad
    cranks: Array  # (n, 6) angles of the cranks in the middle of each period, rad
    crank_rates: Array  # (n, 6) rad/s
    torques: Array  # (n, 6) that the motion takes there from the servos, N m
    steps: Array  # (n, 6) largest torques of servos that hold the setpoints, N m
    period: float  # s, for which each is held
    blend: float  # length of the soft start and the soft end, s; 0 without both
    softens: str  # what is soft: "start", "end" or "start and end"; empty without both
    ends: float  # of the motion, s; infinite for one without an end
    torque_limit: float  # N m
    from_rest: bool  # whether the motion itself begins at rest where the plate is

    def __repr__(self) -> str:
        return f"Setpoints({len(self.times)} of six cranks)"

    def __str__(self) -> str:
        return self.table()

    def table(self) -> str:
        """Return the largest torques and speed, and how the motion begins and ends, as text."""
        torque, speed, step = (
            np.abs(values).max() for values in (self.torques, self.crank_rates, self.steps)
        )
        end = self.times[-1] + self.period
        text = (
            f"limits kept; the motion needs {torque:.3g} N m at most, crank speed {speed:.3g} rad/s"
        )
        if step > torque:
            said = f"held setpoints need up to {step:.3g} N m where they change"
            if step > self.torque_limit:
                said = (
                    f"warning: {said},\n  more than their {self.torque_limit:.3g} N m: raise --rate"
                )
            text += f"\n{said}"
        if self.from_rest:
            text += "\nno soft start: the motion begins at rest where the plate is"
        if self.blend:
            text += f"\nsoft {self.softens}: {self.blend:g} s"
        if self.ends < end - _ROUNDING:
            text += f"\nthe motion ends at {self.ends:.6g} s: its last pose is held up to {end:g} s"
        if math.inf > self.ends > end + _ROUNDING:
            text += (
                f"\nwarning: the motion goes on to {self.ends:.6g} s, beyond the duration: "
                f"--set duration={self.ends:.6g}"
            )
        first, last = np.abs(self.crank_rates[[0, -1]]).max(axis=1)
        if first > RESTING * speed and not (self.from_rest or "start" in self.softens):
            text += f"\nwarning: the first setpoint is in motion ({first:.2g} rad/s): see --from"
        if last > RESTING * speed and "end" not in self.softens:
            text += f"\nwarning: the last setpoint is in motion ({last:.2g} rad/s): see --soft-end"
        return text

    def csv(self, units: ServoUnits | None = None) -> str:
        """Return a header `time[s],setpoint_1[rad],...` and a line per setpoint."""
        units = ServoUnits() if units is None else units
        header = ["time[s]", *(f"setpoint_{leg}[{units.unit}]" for leg in LEGS)]
        digits = "{:.0f}" if units.unit == "ticks" else "{:.9g}"
        rows = zip(self.times, units.converted(self.angles), strict=True)
        lines = (
            ",".join([f"{time:.9g}", *(digits.format(value + 0.0) for value in row)])
            for time, row in rows
        )
        return "\n".join([",".join(header), *lines]) + "\n"

    def save(self, path: str | Path, units: ServoUnits | None = None) -> None:
        """Write the CSV file `path`; its folder is made."""
        write_asked("out", path, self.csv(units))


def make_setpoints(
    scenario: Scenario,
    rate: float = 50.0,
    *,
    plain: bool = False,
    start: Sequence[float] | Array | None = None,
    soft_end: bool = False,
) -> Setpoints:
    """Return the setpoints of a scenario's motion, see `functions.setpoints`.

    Setpoint k is held for a period h = 1 / rate from t_k = k h on. With the motion taken in the
    middle of that, it is (setpoint) of `law.servos`. What was learned (`controller.learned`) is
    added. Values of a `controller.calibration` replace those of the plant.

    A motion that does not begin at rest where the plate is, starts softly (theory.md, section 40),
    in 1 s, or 2, 4, .. s if the limits need it. What was learned is blended in alike. A soft end is
    the same, backwards in time from rest at the reference's pose at the end.

    Raises:
        ConfigError: bad input, or a motion beyond reach, or beyond the range, speed or torque of a
            motor; with its time and motor.
    """
    least = 2 / scenario.duration
    if not (least <= rate <= _LARGEST_RATE):
        raise ConfigError(
            f"rate: got {rate:g} Hz; expected {least:g}, two setpoints in duration, to "
            f"{_LARGEST_RATE:g}"
        )
    if not plain and scenario.actuator.kind != "position_servo":
        raise ConfigError(
            f"actuator.kind: got {scenario.actuator.kind!r}; expected position_servo, or plain "
            "setpoints, --plain"
        )
    experiment = knowing(prepare(scenario))
    learned = learned_signal(experiment)
    if learned is not None:
        _check_learned(scenario, rate, plain)
    if start is not None:
        start = _checked(start, experiment)
    elif scenario.start == "rest":
        start = experiment.start[POSE]
    reference = experiment.reference
    from_rest = start is not None and continues(
        np.concatenate([start, np.zeros(6)]), reference, 0.0, scenario.duration
    )
    if from_rest:
        start = None
    if start is None and not soft_end:
        return _along(experiment, _Soft(from_rest=from_rest), rate, plain, learned)
    stop = evaluate(reference, scenario.duration)[POSE] if soft_end else None
    soft = _Soft(start, stop, SHORTEST_BLEND, scenario.duration, from_rest)
    if scenario.duration < soft.blend:
        raise ConfigError(
            f"duration: got {scenario.duration:g} s; expected at least {soft.blend:g} s, the "
            f"length of the soft {soft.name}, or a start on the reference and no soft end"
        )
    while True:
        try:
            return _along(experiment, soft, rate, plain, learned)
        except _BrokenLimit as broken:
            # A slower start or end does not mend what the motion between them breaks.
            if not soft.at(broken.time) or 2 * soft.blend > scenario.duration:
                raise ConfigError(str(broken)) from None
            soft = replace(soft, blend=2 * soft.blend)


def _check_learned(scenario: Scenario, rate: float, plain: bool) -> None:
    """Refuse setpoints other than those that were learned."""
    c = scenario.controller
    if c.command != "cranks":
        raise ConfigError(
            "controller.learned: got a file of learned torques; expected null, or learned "
            "setpoints and the controller servo_feedforward"
        )
    wanted = "none" if plain else "inverse_dynamics"
    if c.feedforward != wanted:
        sent = "plain" if plain else "compensated"
        raise ConfigError(
            f"controller.feedforward: got {c.feedforward}, with which the setpoints were learned; "
            f"expected {wanted} for {sent} setpoints"
        )
    if abs(rate * c.period - 1) > _ROUNDING:
        raise ConfigError(
            f"rate: got {rate:g} Hz; expected {1 / c.period:g} Hz, that of controller.period, for "
            "which the setpoints were learned"
        )


class _BrokenLimit(ConfigError):
    """Error for a limit that a motion breaks, at a time in s."""

    def __init__(self, time: float, message: str) -> None:
        self.time = time
        super().__init__(message)


def _checked(start: Sequence[float] | Array, experiment: Experiment) -> Array:
    pose = fixed("start", start, (6,))
    if failure := diagnose(experiment.mechanism, 0.0, pose):
        angle, length = (float(np.abs(pose[part]).max()) for part in (ANGLES, POSITION))
        hint = degrees_hint(angle, length) or (" (are these mm?)" if length >= 1 else "")
        home = ",".join(f"{value:.4g}" for value in experiment.mechanism.home)
        raise ConfigError(
            f"start: got a pose where {failure.reason}; expected one within reach, as home "
            f"{home}{hint}"
        )
    return pose


def softened(wanted: Array, pose: Array, time: float, blend: float) -> Array:
    """Return pose, rates and accelerations (18,) of a soft start of `blend` s.

    `wanted` (18,) is the reference at `time` in s; the plate rests at `pose` (6,) at t = 0.
    """
    s = min(time / blend, 1.0)
    g = rise(s)
    g_dot = 30 * s**2 * (1 - s) ** 2 / blend
    g_ddot = 60 * s * (1 - s) * (1 - 2 * s) / blend**2
    apart, rates, accelerations = wanted[POSE] - pose, wanted[RATES], wanted[ACCELERATIONS]
    return np.concatenate(
        [
            pose + g * apart,
            g_dot * apart + g * rates,
            g_ddot * apart + 2 * g_dot * rates + g * accelerations,
        ]
    )


@dataclass(frozen=True)
class _Soft:
    """A soft start from one pose, and a soft end at another; None is without."""

    start: Array | None = None
    stop: Array | None = None
    blend: float = 0.0  # s
    end: float = math.inf  # of the motion, s
    from_rest: bool = False  # whether the motion itself begins at rest where the plate is

    @property
    def name(self) -> str:
        named = (("start", self.start), ("end", self.stop))
        return " and ".join(name for name, pose in named if pose is not None)

    def at(self, time: float) -> bool:
        """Return whether the motion is softened at a time in s."""
        return (self.start is not None and time <= self.blend) or (
            self.stop is not None and time >= self.end - self.blend
        )

    def motion(self, wanted: Array, time: float) -> Array:
        """Return pose, rates and accelerations (18,) for those of the reference."""
        if self.start is not None:
            wanted = softened(wanted, self.start, time, self.blend)
        if self.stop is not None:
            backwards = softened(wanted * _REVERSED, self.stop, self.end - time, self.blend)
            wanted = backwards * _REVERSED
        return wanted

    def share(self, times: Array) -> Array:
        """Return the share of the reference in the motion at times in s."""
        share = np.ones(len(times))
        if self.start is not None:
            share *= rise(times / self.blend)
        if self.stop is not None:
            share *= rise((self.end - times) / self.blend)
        return share


def _along(
    experiment: Experiment,
    soft: _Soft,
    rate: float,
    plain: bool,
    learned: LearnedSignal | None,
) -> Setpoints:
    """Return the setpoints of the motion, checked at the middle of each period."""
    mechanism, dynamics = experiment.mechanism, experiment.nominal
    servo, functions = known_stiffness(experiment.scenario), functions_of(mechanism)
    number = math.ceil(experiment.scenario.duration * rate - 1e-9)
    times, (cranks, rates, torques) = np.arange(number) / rate, np.empty((3, number, NUM_TORQUES))
    last = functions.crank_angles(mechanism.home)  # whole turns are those of `model check`
    for k, t in enumerate(times):
        middle = t + 0.5 / rate
        x = soft.motion(evaluate(experiment.reference, middle), middle)
        if failure := diagnose(mechanism, middle, x[POSE]):
            raise _BrokenLimit(middle, f"motion: {failure.reason} at t = {middle:.2f} s")
        angles, rates[k] = np.split(functions.cranks(x[:NUM_STATE]), 2)
        last = cranks[k] = turned(angles, last)
        torques[k] = dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
    setpoints = cranks
    if not plain:
        assert servo is not None
        setpoints = servo.setpoint(cranks, rates, torques)
    if learned is not None:
        assert servo is not None
        middles = times + 0.5 / rate
        setpoints = setpoints + soft.share(middles)[:, None] * learned(middles)
        torques = servo.stiffness * (setpoints - cranks) - servo.velocity_gain * rates
    steps = np.abs(torques)
    if not plain:
        assert servo is not None
        # A period begins and ends half of it away from the angle for which the setpoint is.
        steps = steps + servo.stiffness * np.abs(rates) * (0.5 / rate)
    course = experiment.reference
    samples = course.times if isinstance(course, PlateTrajectory) else np.empty(0)
    ends = float(samples[-1]) if len(samples) else math.inf
    found = Setpoints(
        times=times,
        angles=setpoints,
        cranks=cranks,
        crank_rates=rates,
        torques=torques,
        steps=steps,
        period=1 / rate,
        blend=soft.blend,
        softens=soft.name,
        ends=ends,
        torque_limit=experiment.torque_limit,
        from_rest=soft.from_rest,
    )
    _check(found, servo, experiment, rate)
    return found


def _check(found: Setpoints, servo: Stiffness | None, experiment: Experiment, rate: float) -> None:
    """Raise _BrokenLimit for the setpoint furthest beyond a limit."""
    actuator = experiment.scenario.actuator
    speed = (actuator.kind != "torque" and actuator.speed_limit) or math.inf
    lowest, highest = (-math.inf, math.inf) if servo is None else (servo.low, servo.high)
    moved = np.diff(found.angles, axis=0, prepend=found.angles[:1]) * rate
    torque = experiment.torque_limit
    limits: tuple[tuple[str, str, Array, Array | float, Array | float], ...] = (
        ("setpoint", "rad", found.angles, lowest, highest),
        ("speed of the setpoint", "rad/s", moved, -speed, speed),
        ("torque", "N m", found.torques, -torque, torque),
    )
    for name, unit, values, least, most in limits:
        excess = np.maximum(values - most, least - values)
        if excess.max() > _ROUNDING:
            k, motor = np.unravel_index(excess.argmax(), excess.shape)
            low, high = (float(np.broadcast_to(end, NUM_TORQUES)[motor]) for end in (least, most))
            value, allowed = float(values[k, motor]), f"{low:.3g} to {high:.3g} {unit}"
            if low == -high:
                value, allowed = abs(value), f"at most {high:.3g} {unit}"
            raise _BrokenLimit(
                float(found.times[k]),
                f"motor {LEGS[motor]} needs a {name} of up to {value:.3g} {unit} (t = "
                f"{found.times[k]:.2f} s); expected {allowed}",
            )
