"""Start of a fit: measured poses, segments, their first states, and a coarse delay."""

from collections.abc import Iterable
from contextlib import nullcontext, suppress
from typing import Final

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.fit import Guess, Problem
from stewart_drake.identification.logs import ANGLES, POSE, Log
from stewart_drake.identification.logs import RATES as MEASURED_RATES
from stewart_drake.identification.model import Segment
from stewart_drake.identification.unknowns import DELAY, Unknowns
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import ForwardKinematicsError
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES
from stewart_drake.scenario.signals import RATES as STATE_RATES
from stewart_drake.types import Array

Pair = tuple[Log, Array]  # a log, and the poses (n, 6) at its instants

LONGEST: Final = 2.0  # length of a segment, s
SHORTEST: Final = 0.2
_GROWTHS: Final = 3.0  # largest exponent of the growth of an error over a segment
_LOOKS: Final = 40  # number of instants at which the growth of errors is computed
_CUBIC: Final = 0.3  # length of the cubic that gives rates, s
_LEAST_ROWS: Final = 4  # of a segment
_FEWEST: Final = 8  # least number of poses that give rates
_WINDOW: Final = 0.3  # least length of the polynomial that gives an acceleration, s
_DEGREE: Final = 4  # of that polynomial
_GRID: Final = 0.01  # step of the delays, s
_APART: Final = 0.1  # time between the middles of two such polynomials, s
_LEAST_WINDOWS: Final = 8


def measured_poses(log: Log, mechanism: Mechanism) -> Array:
    """Return the plate's poses (n, 6) at the log's instants, measured or from the crank angles."""
    poses, last = log.values[:, POSE].copy(), mechanism.home
    for row in range(len(poses)):
        angles = log.values[row, ANGLES]
        if not np.isfinite(poses[row]).all() and np.isfinite(angles).all():
            try:
                poses[row] = mechanism.forward_kinematics(angles, last)
            except ForwardKinematicsError as error:
                raise ConfigError(
                    f"{log.name}: at t = {log.times[row]:.4g} s the crank angles do not suit the "
                    f"mechanism {mechanism.name} ({error}); expected a log of this machine, with "
                    "angles as its crank_zero and motor_axis define them"
                ) from None
        if np.isfinite(poses[row]).all():
            last = poses[row]
    count = int(np.isfinite(poses).all(axis=1).sum())
    if count < _FEWEST:
        raise ConfigError(
            f"{log.name}: got all six crank angles, or a whole pose, at {count} instants; expected "
            f"at least {_FEWEST}"
        )
    return poses


def coarse_delay(
    log: Log, poses: Array, mechanism: Mechanism, believed: float, std: float
) -> float:
    """Return the delay in s with which the torques suit the motion best, to some hundredths.

    If the true delay is off by more than a swing of the motion, iterations from the believed one
    end elsewhere. A polynomial of degree four through the poses of a window gives pose, rates and
    accelerations in its middle, the drawing's inverse dynamics the torque for them, smoothed by
    about (1 - s^2)^2 over the window. It is compared with the torques that were sent, smoothed
    alike and delayed by each value within three standard deviations of the believed one.
    """
    dynamics = StewartDynamics(mechanism, log.gravity)
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    times = log.times[known]
    half = max(_WINDOW, (_DEGREE + 0.5) * float(np.median(np.diff(times)))) / 2
    middles = np.arange(times[0] + half, times[-1] - half, _APART)
    needed = np.full((len(middles), NUM_TORQUES), np.nan)
    for i, middle in enumerate(middles):
        near = known[np.abs(times - middle) <= half + 1e-9]
        if len(near) > _DEGREE:
            from_middle = log.times[near] - middle
            powers = np.polynomial.polynomial.polyfit(from_middle, poses[near], _DEGREE)
            needed[i] = dynamics.inverse_dynamics(powers[0], powers[1], 2 * powers[2])
    span = np.arange(-half, half + _GRID / 2, _GRID)
    weights = (1 - (span / half) ** 2) ** 2
    weights /= weights.sum()

    def misfit(delay: float) -> float:
        """Return the variance of torques needed less torques at the plant, relative to the former.

        Longer delays leave fewer windows to compare, in which less may have moved.
        """
        there = np.isfinite(needed).all(axis=1) & (middles + span[0] >= log.sent[0] + delay)
        if there.sum() < _LEAST_WINDOWS:
            return np.inf
        instants = middles[there, None] + span
        torques = log.applied_torque(instants.ravel(), delay).reshape(*instants.shape, NUM_TORQUES)
        apart = needed[there] - np.einsum("s,nsj->nj", weights, torques)
        left, whole = (np.var(one, axis=0).sum() for one in (apart, needed[there]))
        return float(left / whole) if whole > 0 else np.inf

    delays = np.arange(max(0.0, believed - 3 * std), believed + 3 * std + _GRID / 2, _GRID)
    costs = [misfit(delay) for delay in delays]
    return float(delays[int(np.argmin(costs))]) if np.isfinite(costs).any() else believed


def segment_length(log: Log, poses: Array, mechanism: Mechanism, delay: float) -> float:
    """Return the time in s over which errors of a trajectory stay small."""
    dynamics = StewartDynamics(mechanism, log.gravity)
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    fastest = 1e-9
    for row in known[:: max(1, len(known) // _LOOKS)]:
        rates = first_state(log, poses, row)[STATE_RATES]
        torque = log.applied_torque(log.times[row : row + 1], delay)[0]
        A = dynamics.derivatives(poses[row], rates, torque).A
        fastest = max(fastest, float(np.linalg.eigvals(A).real.max()))
    return float(np.clip(_GROWTHS / fastest, SHORTEST, LONGEST))


def segments_of(log: Log, start: float, length: float) -> list[Segment]:
    """Return equal parts of the log from `start` in s on; those with few values join the next."""
    rows = np.flatnonzero(log.times >= start - 1e-9)
    few = np.isfinite(log.values[rows]).sum() < 2 * NUM_STATE
    if few or len(rows) < 2 * _LEAST_ROWS or log.times[-1] - log.times[rows[0]] < SHORTEST:
        raise ConfigError(
            f"{log.name}: too short: got measurements from {start:.4g} s, the arrival of the first "
            f"logged torque, to {log.times[-1]:.4g} s; expected a longer log"
        )
    first, last = log.times[rows[0]], log.times[-1]
    edges = np.linspace(first, last, max(1, round((last - first) / length)) + 1)
    groups = np.split(rows, np.searchsorted(log.times[rows], edges[1:-1] - 1e-9))
    segments, kept = list[Segment](), np.empty(0, dtype=np.intp)
    for number, group in enumerate(groups):
        kept = np.concatenate([kept, group])
        values = np.isfinite(log.values[kept]).sum()
        if values >= 2 * NUM_STATE and len(kept) >= _LEAST_ROWS:
            segments.append(Segment(log, float(log.times[kept[0]]), kept))
            kept = np.empty(0, dtype=np.intp)
        elif number == len(groups) - 1 and segments:
            before = segments.pop()
            segments.append(before._replace(rows=np.concatenate([before.rows, kept])))
    return segments


def problem_of(
    pairs: Iterable[Pair],
    unknowns: Unknowns,
    values: Array,
    late: float,
    *,
    share: float = 1.0,
    longest: float = np.inf,
    step: float = 0.02,
    skip_short: bool = False,
) -> tuple[Problem, Guess]:
    """Return the problem of all logs and its first guess, at values of the unknowns.

    A log counts from the first torque's arrival on, whose delay may be `late` s too short. Segments
    have a share of `segment_length` and are at most `longest` s long. With `skip_short` logs that
    are too short are left out.
    """
    segments, delay = list[Segment](), float(values[DELAY])
    first = list[Array]()
    for log, poses in pairs:
        with suppress(ConfigError) if skip_short else nullcontext():
            length = min(longest, share * segment_length(log, poses, unknowns.mechanism, delay))
            parts = segments_of(log, float(log.sent[0]) + delay + late, length)
            segments += parts
            first += [first_state(log, poses, int(part.rows[0])) for part in parts]
    return Problem(segments, unknowns, step), Guess(values, np.array(first))


def first_state(log: Log, poses: Array, row: int) -> Array:
    """Return the state (12,) at a row, measured or of a cubic through the next poses (n, 6)."""
    rates = log.values[row, MEASURED_RATES]
    if np.isfinite(rates).all() and np.isfinite(poses[row]).all():
        return np.concatenate([poses[row], rates])
    known = np.flatnonzero(np.isfinite(poses).all(axis=1))
    near = known[min(int(np.searchsorted(known, row)), len(known) - _FEWEST) :]
    near = near[: max(_FEWEST, int(np.searchsorted(log.times[near], log.times[row] + _CUBIC)))]
    cubic = np.polynomial.polynomial.polyfit(log.times[near] - log.times[row], poses[near], 3)
    return np.concatenate([cubic[0], cubic[1]])
