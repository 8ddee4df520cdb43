"""Logs of a machine, and their files: those of `simulate` (.nc), and CSV of real machines.

A log holds torques with the times at which they were sent, and measurements.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from stewart_drake.core.layout import DEFAULT_GRAVITY
from stewart_drake.files.csvio import ANGLE_UNITS, LENGTH_UNITS, TORQUE_UNITS, Table, read_table
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.run_log import is_run, read_log, scenario_of
from stewart_drake.scenario.signals import COORDINATE_NAMES, LEGS, NUM_LEGS, NUM_STATE
from stewart_drake.types import Array

# Measurements of a log
ANGLES: Final = slice(0, NUM_LEGS)
POSE: Final = slice(6, 12)
RATES: Final = slice(12, 18)
NUM_MEASURED: Final = NUM_LEGS + NUM_STATE
KINDS: Final = {"angles": ANGLES, "pose": POSE, "rates": RATES}

EXPECTED: Final = "a log of a run, or CSV with time, torque_1 ... and angle_1 ..."
FINEST: Final = 0.01  # least time between two measurements, s; more frequent ones are left out
_LONGEST_STEP: Final = 1.0  # longest median time between two rows of a CSV log, s
_LEAST_VALUES: Final = 96  # of a log: six crank angles at 16 instants, or a state at eight
_TORQUES: Final = [f"torque_{leg}" for leg in LEGS]
_CRANKS: Final = [f"angle_{leg}" for leg in LEGS]
_MEASURED: Final = [(ANGLES, _CRANKS), (POSE, list(COORDINATE_NAMES))]
_UNITS: Final = {
    "time": {"s": 1.0},
    **dict.fromkeys(_TORQUES, TORQUE_UNITS),
    **dict.fromkeys([*_CRANKS, *COORDINATE_NAMES[:3]], ANGLE_UNITS),
    **dict.fromkeys(COORDINATE_NAMES[3:], LENGTH_UNITS),
}
_HEADER: Final = (
    "time[s], torque_1[N m] to torque_6, angle_1[rad] to angle_6 and, where it was measured, "
    "roll[rad], pitch, yaw, x[m], y, z (or mN m, deg, mm)"
)
# Least standard deviations: the error of the integration
LEAST_STD: Final = np.repeat([1e-6, 1e-7, 1e-5, 1e-6], 3)  # state: rad, m and per s
LEAST_ANGLE: Final = 1e-6  # crank angle, rad
_STEPS: Final = 1e5
"""Factor on them for the multibody plant, per s of its step: its errors are of first order.

They look like a delay that is up to a step shorter.
"""


@dataclass(frozen=True, eq=False)
class Log:
    name: str  # of the file
    sent: Array  # (m,) increasing times of the torques, s
    torques: Array  # (m, 6) within the motors' limit, N m; each acts until the next one does
    times: Array  # (n,) increasing times of the measurements, s
    values: Array  # (n, 18) crank angles, pose, rates in rad, m and per s; NaN for a missing one
    std: Array  # (18,) of their errors
    gravity: float  # m/s^2 along -z
    delay: float | None = None  # believed delay in s, or None
    # torques (6,) that act before the first of these does, or None if unknown
    before: Array | None = None
    step: float = 0.0  # of a simulated multibody plant, s; 0 for another one

    def applied_torque(self, times: Array, delay: float) -> Array:
        """Return the torques (k, 6) at instants (k,) in s."""
        return in_effect(self.sent + delay, self.torques, times)

    def measures(self, kind: slice) -> bool:
        return bool(np.isfinite(self.values[:, kind]).any())


def in_effect(arrivals: Array, values: Array, times: Array) -> Array:
    """Return the newest of the values (n, m) at times (k,); before any arrived, the first one."""
    newest = np.searchsorted(arrivals, times, side="right") - 1
    return np.asarray(values[np.maximum(newest, 0)])


def angle_std(bits: int) -> float:
    """Return the standard deviation of a code's rounding, rad: its step over sqrt(12)."""
    return 2 * math.pi / 2**bits / math.sqrt(12)


class Precision(NamedTuple):
    """Standard deviations of the measurements in a CSV log."""

    angle: float = angle_std(14)  # rad
    pose_angle: float = 1e-4  # rad
    pose_position: float = 2e-5  # m

    @property
    def std(self) -> Array:
        """Standard deviations (18,) of a log's measurements; a CSV log has no rates."""
        pose = [self.pose_angle] * 3 + [self.pose_position] * 3
        return np.array([self.angle] * 6 + pose + [np.inf] * 6)


def load_log(path: Path, mechanism: Mechanism, precision: Precision, gravity: bool = True) -> Log:
    """Read a log without empty rows, and with at most one row per `FINEST` s.

    It is that of a run: signals.nc, .mcap, .csv or a folder; else CSV of a machine, in which the
    motors' limit clips the torques. Precision and gravity are for CSV.
    """
    if path.is_file() and path.suffix in (".json", ".yaml", ".html", ".npz"):
        raise ConfigError(f"{path}: got a file of another kind; expected {EXPECTED}")
    if is_run(path):
        log = _of_run(path, mechanism)
    else:
        log = _of_csv(path, mechanism, precision, DEFAULT_GRAVITY if gravity else 0.0)
    if len(log.sent) < 2:
        raise ConfigError(f"{path}: got one torque throughout; expected torques that change")
    kept, last = list[int](), -math.inf
    for row in np.flatnonzero(np.isfinite(log.values).any(axis=1)):
        if log.times[row] - last > FINEST - 1e-6:
            kept.append(int(row))
            last = float(log.times[row])
    values = log.values[kept]
    count = int(np.isfinite(values).sum())
    if count < _LEAST_VALUES:
        raise ConfigError(
            f"{path}: got {count} measured values, at {len(kept)} instants; expected at least "
            f"{_LEAST_VALUES}"
        )
    return replace(log, times=log.times[kept], values=values)


def _of_run(path: Path, mechanism: Mechanism) -> Log:
    signals = read_log(path)
    scenario = scenario_of(signals, path)
    if "torque_commanded" not in signals or not np.isfinite(signals.torque_commanded).any():
        raise ConfigError(
            f"{path}: has the torques that acted, not those sent, as a log of `machine`; "
            "expected that of its controller, from `live --log`"
        )
    try:
        time, measured = signals.time.values, signals.measurement.transpose("time", ...).values
        commanded = signals.torque_commanded.transpose("time", "leg").values
        applied = signals.torque_applied.transpose("time", "leg").values
        believed = float(signals.delay_estimate.values[-1])
    except (KeyError, AttributeError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: lacks a signal ({error}); expected {EXPECTED}") from None
    if problem := _run_problem(scenario):
        raise ConfigError(f"{path}: {problem}; expected another run, or CSV")
    period = scenario.controller.period
    # Signals show a sample's value from its instant on, and every sample has a row.
    count = int(min(time[-1] / period + 1e-9, len(time))) + 1
    samples: Array = period * np.arange(count, dtype=np.float64)
    rows = np.minimum(np.searchsorted(time, samples - 1e-9), len(time) - 1)
    if not np.all(time[rows] < samples + period - 1e-9):
        raise ConfigError(
            f"{path}: log_period: got a step of {np.diff(time, prepend=0.0).max():.4g} s, longer "
            f"than the controller's {period:g} s; expected each of its samples in the log"
        )
    torques = commanded[rows]
    if scenario.link.kind == "network":
        # Other torques may act than were sent, but their time is known: a bound later. So the
        # torques that acted then are taken as sent.
        believed = scenario.eta
        then = np.searchsorted(time, samples + believed - 1e-9)
        torques = applied[np.minimum(then, len(time) - 1)]
    limit = scenario.actuator.torque_limit
    step = scenario.plant.time_step if scenario.plant.kind == "multibody" else 0.0
    least = max(1.0, _STEPS * step)  # factor on the least standard deviations
    times, values, std = _measured(measured[rows], scenario, samples, least)
    changing = scenario.queue == "reference" or scenario.link.kind == "network"
    return Log(
        name=str(path),
        sent=samples,
        torques=_limited(torques, mechanism.effort_limit if limit is None else limit),
        times=times,
        values=values,
        std=std,
        gravity=DEFAULT_GRAVITY if scenario.plant.gravity else 0.0,
        delay=believed if math.isfinite(believed) else None,
        before=None if changing else applied[0],
        step=step,
    )


def _run_problem(scenario: Scenario) -> str | None:
    """Return why a run cannot serve as a log, or None."""
    if scenario.link.kind == "network" and scenario.link.back is not None:
        return "measurements over its network have different ages (link.return)"
    if scenario.actuator.kind != "torque":
        return (
            f"its motors got no torques (actuator.kind {scenario.actuator.kind!r}), and position "
            "servos are found from CSV with setpoint_1[rad] to crank_6[rad], as of live --log "
            "FILE.csv"
        )
    if scenario.sensor.delay > 0:
        return f"its measurements are {scenario.sensor.delay:g} s old (sensor.delay)"
    return None


def _measured(
    measured: Array, scenario: Scenario, samples: Array, least: float
) -> tuple[Array, Array, Array]:
    """Return instants (n,), values (n, 18) and their std (18,) of a run's measurements.

    They are measured at each sample of the controller. `least` is a factor on the least std.
    """
    sensor = scenario.sensor
    if sensor.kind == "state":
        values = np.full((len(samples), NUM_MEASURED), np.nan)
        values[:, POSE.start :] = measured
        noise = np.hypot(sensor.noise_std, least * LEAST_STD)
        return samples, values, np.concatenate([np.full(6, np.inf), noise])
    # Readings of the period before a sample, the oldest first; the first sample has none.
    ago = np.arange(sensor.samples - 1, -1, -1) * scenario.controller.period / sensor.samples
    times = (samples[:, None] - ago).ravel()
    kept = times > -1e-9
    values = np.full((kept.sum(), NUM_MEASURED), np.nan)
    values[:, ANGLES] = measured.reshape(-1, NUM_LEGS)[kept]
    error = least * LEAST_ANGLE if sensor.bits is None else angle_std(sensor.bits)
    return times[kept], values, np.concatenate([np.full(6, error), np.full(NUM_STATE, np.inf)])


def _limited(torques: Array, limit: float | str | None) -> Array:
    return torques if limit is None or isinstance(limit, str) else np.clip(torques, -limit, limit)


def _require_radians(table: Table, mechanism: Mechanism) -> None:
    """Check that angles are no more than a turn off those of the assembled machine."""
    cranks = mechanism.crank_angles(mechanism.home)
    home = {**dict(zip(_CRANKS, cranks, strict=True)), "roll": 0.0, "pitch": 0.0, "yaw": 0.0}
    for name in (one for one in home if one in table.columns):
        off = np.abs(table.columns[name] - home[name])
        for bad in np.flatnonzero(off > 2 * np.pi)[:1]:
            raise ConfigError(
                f"{table.location(bad, name)}: got {table.columns[name][bad]:.4g} rad, more than a "
                f"turn from home, {home[name]:.4g} rad; expected radians, or [deg] in the header; "
                "take off whole turns"
            )


def _of_csv(path: Path, mechanism: Mechanism, precision: Precision, gravity: float) -> Log:
    optional = _UNITS.keys() - {"time"}
    table = read_table(path, EXPECTED, _HEADER, _UNITS, optional=optional)
    time, torques = table.stacked(["time"])[:, 0], table.stacked(_TORQUES)
    values = np.full((len(time), NUM_MEASURED), np.nan)
    measured = [kind for kind in _MEASURED if table.columns.keys() & kind[1]]
    for part, names in measured or _MEASURED[:1]:
        values[:, part] = table.stacked(names)
    for bad in 1 + np.flatnonzero(~(np.diff(time) > 0))[:1]:
        raise ConfigError(
            f"{table.location(bad, 'time')}: got {time[bad]:.9g} s after {time[bad - 1]:.9g} s; "
            "expected increasing times"
        )
    if (step := float(np.median(np.diff(time, prepend=time[:1])))) > _LONGEST_STEP:
        raise ConfigError(
            f"{path}: got rows {step:.4g} s apart; expected at most {_LONGEST_STEP:g} s, and time "
            "in s"
        )
    _require_radians(table, mechanism)
    there = np.isfinite(torques)
    for bad in np.flatnonzero(there.any(axis=1) != there.all(axis=1))[:1]:
        raise ConfigError(
            f"{table.location(bad)}: got some of the six torques; expected all or none of them"
        )
    rows = np.flatnonzero(there.all(axis=1))
    # A repeated torque continues, so only changes are kept.
    changed = rows[np.any(np.diff(torques[rows], axis=0, prepend=np.nan) != 0, axis=1)]
    return Log(
        name=str(path),
        sent=time[changed],
        torques=_limited(torques[changed], mechanism.effort_limit),
        times=time,
        values=values,
        std=precision.std,
        gravity=gravity,
    )
