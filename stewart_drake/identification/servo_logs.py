"""Logs of setpoints and crank angles of a machine with position servos, as CSV."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from stewart_drake.files.csvio import ANGLE_UNITS, Table, read_table
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.logs import in_effect
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import ForwardKinematicsError, turned
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.run_log import is_run, read_log, scenario_of
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array, Flags

SETPOINTS: Final = tuple(f"setpoint_{leg}" for leg in LEGS)
CRANKS: Final = tuple(f"crank_{leg}" for leg in LEGS)
LEAST_LENGTH: Final = 4.0
"""Least length of a log, s."""
_UNITS: Final = {"time": {"s": 1.0}, **dict.fromkeys((*SETPOINTS, *CRANKS), ANGLE_UNITS)}
_HEADER: Final = "time[s], setpoint_1[rad] to setpoint_6, crank_1[rad] to crank_6 (or deg)"
_EXPECTED: Final = f"CSV with {_HEADER}"
_LONGEST_GAP: Final = 0.1  # s
_LATEST: Final = 0.4  # s, of an angle after its setpoint: delay and lag
_FOLLOWS: Final = 0.2
"""Least correlation of a crank with its setpoint. Weak servos with joints that stick have 0.45."""
_AGAINST: Final = -0.5  # largest correlation of a crank whose sign is wrong
_SHARES: Final = (0.05, 7.5)
"""Range of the motion of a crank over its setpoint's. Friction leaves 0.15; degrees are 57."""
_STILL: Final = 0.01  # rad; what moves less is judged later


class ServoLog(NamedTuple):
    """Log of position servos: what was sent and what came back, by one clock."""

    name: str  # of the file
    times: Array  # (n,) increasing, s, at which a setpoint was sent and an angle was received
    setpoints: Array  # (n, 6) rad, each until the next one
    cranks: Array  # (n, 6) rad
    poses: Array  # (n, 6) of the plate, from the cranks; rad and m
    scenario: Scenario | None = None  # of a run


def is_servo_log(path: Path) -> bool:
    """Return whether a file is CSV with a column of setpoints."""
    if path.suffix != ".csv" or not path.is_file():
        return False
    with open(path, encoding="utf-8", errors="replace") as file:
        return "setpoint_" in file.readline(1 << 16).lower()


def read_servo_log(path: Path, mechanism: Mechanism) -> ServoLog:
    run = is_run(path)
    lacking = (*SETPOINTS, *CRANKS) if run else ()
    table = read_table(path, _EXPECTED, _HEADER, _UNITS, optional=lacking, others=run)
    times = table.stacked(["time"])[:, 0]
    setpoints, cranks = table.stacked(SETPOINTS), table.stacked(CRANKS)
    known = np.arange(len(times))
    if run:  # live may miss measurements
        known = np.flatnonzero(np.isfinite(cranks).all(axis=1))
    if not (len(known) and np.isfinite(setpoints).all()):
        raise ConfigError(
            f"{path}: lacks setpoints or cranks, as a log of `machine`; expected that of its "
            "controller, from `live --log`"
        )
    at = times[known]
    gaps = np.diff(at)
    for bad in 1 + np.flatnonzero(~((gaps > 0) & (gaps <= _LONGEST_GAP)))[:1]:
        raise ConfigError(
            f"{table.location(known[bad], 'time')}: got {at[bad]:.9g} s after {at[bad - 1]:.9g} s; "
            f"expected a later time, by at most {_LONGEST_GAP:g} s; log again, next to the servos"
        )
    if len(known) < len(times):
        whole, angles = slice(known[0], known[-1] + 1), np.unwrap(cranks[known], axis=0)
        times, setpoints = times[whole], setpoints[whole]
        cranks = np.column_stack([np.interp(times, at, angle) for angle in angles.T])
    if len(times) < 2 or times[-1] - times[0] < LEAST_LENGTH:
        length = float(np.ptp(times)) if len(times) else 0.0
        raise ConfigError(f"{path}: got {length:.3g} s; expected at least {LEAST_LENGTH:g} s")
    scenario = scenario_of(read_log(path), path) if run else None
    if scenario is not None:
        period, step = scenario.controller.period, float(np.median(gaps))
        if step > period * (1 + 1e-6):
            raise ConfigError(
                f"{path}: log_period: got a step of {step:.4g} s, longer than the controller's "
                f"{period:g} s; expected each of its samples in the log"
            )
    log = servo_log(str(path), times, setpoints, cranks, mechanism, table)
    return log._replace(scenario=scenario)


def servo_log(
    name: str,
    times: Array,
    setpoints: Array,
    cranks: Array,
    mechanism: Mechanism,
    table: Table | None = None,
) -> ServoLog:
    """Return a log with its poses; angles of any turn, the arrays of `ServoLog`."""
    cranks, setpoints = np.unwrap(cranks, axis=0), np.unwrap(setpoints, axis=0)
    _check_following(name, times, setpoints, cranks)
    cranks = turned(cranks, mechanism.crank_angles(mechanism.home))
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


def _check_following(name: str, times: Array, setpoints: Array, cranks: Array) -> None:
    """Refuse cranks that do not follow their setpoints, by the delay that suits most of them."""
    both = np.hstack([setpoints, cranks])
    spans = np.ptp(both, axis=0)
    # Before a whole turn a crank is in line with its rod, where the workspace ends.
    if np.any(spans >= 2 * np.pi):
        raise ConfigError(
            f"{name}: got ranges of more than a turn in rad: "
            f"{_listed((*SETPOINTS, *CRANKS), spans, spans >= 2 * np.pi)}; "
            "expected angles in rad, or [deg] in the header"
        )
    usual = np.ptp(np.quantile(both, (0.05, 0.95), axis=0), axis=0).reshape(2, -1)
    if not usual.max(axis=1).min() > _STILL:
        return
    sizes, apart = setpoints.std(axis=0), cranks - cranks.mean(axis=0)
    judged = sizes > sizes.max() / 3  # others may stick
    fits = []
    for delay in np.arange(0.0, _LATEST, 0.01):
        sent = in_effect(times + delay, setpoints, times)
        sent = sent - sent.mean(axis=0)
        norm = np.sqrt(np.sum(sent**2, axis=0) * np.sum(apart**2, axis=0))
        fits.append(np.sum(sent * apart, axis=0) / np.maximum(norm, 1e-12))
    fit = np.array(fits)[np.argmax(np.sum(fits, axis=1, where=judged))]
    bad = judged & (fit < _FOLLOWS)
    if bad.any():
        # At the delay at which they are most against them: wrong signs, or another motion.
        least = np.array(fits)[np.argmin(np.sum(fits, axis=1, where=bad))]
        against = bool(np.all(least[bad] < _AGAINST))
        if against:  # name those that hardly move, too
            bad |= least < _AGAINST
        raise ConfigError(
            f"{name}: got cranks that {'move against' if against else 'do not follow'} their "
            f"setpoints, correlation {_listed(CRANKS, least if against else fit, bad)}; expected "
            f"{_FOLLOWS:g} or more"
            + (", with the signs of the setpoints" if against else ", a log of this motion")
        )
    shares = apart.std(axis=0) / np.maximum(sizes, 1e-12)
    bad = judged & ~((_SHARES[0] <= shares) & (shares <= _SHARES[1]))
    if bad.any():
        raise ConfigError(
            f"{name}: got motions of cranks over those of their setpoints: "
            f"{_listed(CRANKS, shares, bad)}; expected {_SHARES[0]:g} to {_SHARES[1]:g}, with both "
            "in rad, or [deg] in the header"
        )


def _listed(names: Sequence[str], values: Array, chosen: Flags) -> str:
    return ", ".join(
        f"{name} {value:.2g}" for name, value, one in zip(names, values, chosen, strict=True) if one
    )
