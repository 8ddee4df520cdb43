"""Logs of setpoints and crank angles of a machine with position servos, as CSV."""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from stewart_drake.files.csvio import ANGLE_UNITS, Table, read_table
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.servos import turned
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import ForwardKinematicsError
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array

SETPOINTS: Final = tuple(f"setpoint_{leg}" for leg in LEGS)
CRANKS: Final = tuple(f"crank_{leg}" for leg in LEGS)
LEAST_LENGTH: Final = 4.0
"""s."""
_UNITS: Final = {"time": {"s": 1.0}, **dict.fromkeys((*SETPOINTS, *CRANKS), ANGLE_UNITS)}
_HEADER: Final = "time[s], setpoint_1[rad] to setpoint_6, crank_1[rad] to crank_6 (or deg)"
_EXPECTED: Final = f"CSV with {_HEADER}"
_LONGEST_GAP: Final = 0.1  # s


class ServoLog(NamedTuple):
    """Log of position servos: what was sent and what came back, by one clock."""

    name: str  # of the file
    times: Array  # (n,) increasing, s, at which a setpoint was sent and an angle was received
    setpoints: Array  # (n, 6) rad, each until the next one
    cranks: Array  # (n, 6) rad
    poses: Array  # (n, 6) of the plate, from the cranks; rad and m


def is_servo_log(path: Path) -> bool:
    """Return whether a file is CSV with a column of setpoints."""
    if path.suffix != ".csv" or not path.is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as file:
        return "setpoint_" in file.readline(1 << 16).lower()


def read_servo_log(path: Path, mechanism: Mechanism) -> ServoLog:
    table = read_table(path, _EXPECTED, _HEADER, _UNITS)
    times = table.stacked(["time"])[:, 0]
    setpoints, cranks = table.stacked(SETPOINTS), table.stacked(CRANKS)
    gaps = np.diff(times)
    for bad in 1 + np.flatnonzero(~((gaps > 0) & (gaps <= _LONGEST_GAP)))[:1]:
        raise ConfigError(
            f"{table.location(bad, 'time')}: got {times[bad]:.9g} s after {times[bad - 1]:.9g} s; "
            f"expected a later time, by at most {_LONGEST_GAP:g} s"
        )
    if len(times) < 2 or times[-1] - times[0] < LEAST_LENGTH:
        length = float(np.ptp(times)) if len(times) else 0.0
        raise ConfigError(f"{path}: got {length:.3g} s; expected at least {LEAST_LENGTH:g} s")
    return servo_log(str(path), times, setpoints, cranks, mechanism, table)


def servo_log(
    name: str,
    times: Array,
    setpoints: Array,
    cranks: Array,
    mechanism: Mechanism,
    table: Table | None = None,
) -> ServoLog:
    """Return a log with its poses; angles of any turn, the arrays of `ServoLog`."""
    cranks = turned(np.unwrap(cranks, axis=0), mechanism.crank_angles(mechanism.home))
    cranks = np.unwrap(cranks, axis=0)
    poses, pose = np.empty_like(cranks), mechanism.home
    for row, angles in enumerate(cranks):
        try:
            pose = poses[row] = mechanism.forward_kinematics(angles, pose)
        except ForwardKinematicsError:
            place = f"{name}: t = {times[row]:g} s" if table is None else table.location(row)
            raise ConfigError(
                f"{place}: got crank angles {np.round(angles, 4).tolist()} without a pose; "
                "expected those of this mechanism, with its signs and zeros"
            ) from None
    return ServoLog(name, times, turned(setpoints, cranks), cranks, poses)
