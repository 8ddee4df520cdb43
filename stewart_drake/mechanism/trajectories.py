"""References as pydrake trajectories of the pose (6x1), with exact derivatives.

Every trajectory can be evaluated at any t >= 0: the controller looks ahead, beyond the duration.
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial, singledispatch
from typing import Any, Final

import numpy as np
from pydrake.trajectories import CompositeTrajectory, FunctionHandleTrajectory, Trajectory

from stewart_drake.core.library import core
from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.reference_config import (
    CsvConfig,
    HoldConfig,
    ReferenceConfig,
    SineConfig,
    WaypointsConfig,
)
from stewart_drake.scenario.reference_files import read_csv, waypoints
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    COORDINATE_NAMES,
    NUM_REFERENCE,
    POSE,
    POSITION,
    RATES,
)
from stewart_drake.types import Array, ArrayLike

_CONSTANT: Final = 1e-9
"""Range in rad, or relative to the largest position, below which a coordinate is constant."""
_GRID: Final = 1e-3  # s, step at which the range of a motion is read
_LEAST_LENGTH: Final = 1e-6
"""Least length of a piece, s; derivatives of a shorter one would be rounding errors."""
_STOP_SPEED: Final = 1e-3
"""Speed in rad/s or m/s up to which a motion ends at rest."""
_STOP_SHARE: Final = 0.05
"""The same as a share of the coordinate's largest speed at a sample; the larger one counts."""
RESTING: Final = 0.02
"""Speed that counts as rest, as a share of the motion's largest one."""
SAME: Final = 1e-6
"""Largest difference of poses or rates that count as equal, rad, m and per s."""
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


class PlateTrajectory(FunctionHandleTrajectory):
    """Piecewise polynomials, followed by sines or another motion, computed in C (core/motion.h).

    Args:
        times: (n + 1,) begin of each piece and end of the last one, s.
        coefficients: (degree + 1, n, 6) for powers of the time since the begin of the piece, the
            highest first, as in `scipy.interpolate.PPoly`.
        then: the motion after the last piece, or None for offset + amplitude sin(frequency t).
        offset, amplitude: (6,) rad, m.
        frequency: (6,) rad/s.

    Raises:
        ValueError: `times` do not ascend, or `coefficients` have another shape.

    Attributes:
        times: as given.
        data: `stewart_motion *` for C, valid as long as this object.
        keep_alive: arrays and structures that `data` points to.
    """

    def __init__(
        self,
        times: ArrayLike = (),
        coefficients: ArrayLike = (),
        then: "PlateTrajectory | None" = None,
        offset: ArrayLike = (0.0,) * 6,
        amplitude: ArrayLike = (0.0,) * 6,
        frequency: ArrayLike = (0.0,) * 6,
    ) -> None:
        c, self.times = core(), np.array(times, np.float64)
        powers = np.array(coefficients, np.float64, order="C")
        pieces, degree = max(0, len(self.times) - 1), max(0, len(powers) - 1)
        if pieces and powers.shape[1:] != (pieces, 6):
            raise ValueError(
                f"coefficients: got shape {powers.shape}; expected (degree + 1, {pieces}, 6)"
            )
        if not np.all(np.diff(self.times) > 0):
            raise ValueError(f"times: got {self.times}; expected ascending numbers, s")
        if then is not None and not pieces:
            raise ValueError("then: got a motion; expected one after pieces only")
        after, kept = (c.ffi.NULL, ()) if then is None else (then.data, then.keep_alive)
        sines = (np.array(six, np.float64).tolist() for six in (offset, amplitude, frequency))
        tables = (c.at(self.times), c.at(powers)) if pieces else (c.ffi.NULL, c.ffi.NULL)
        fields = pieces, degree, *tables, after, *sines
        self.data: Any = c.ffi.new("stewart_motion *", fields)
        self.keep_alive: list[Any] = [self.times, powers, self.data, *kept]
        derivative = partial(_derivative, self.data, self.keep_alive)
        super().__init__(partial(derivative, order=0), 6, 1, 0.0, math.inf)
        self.set_derivative(derivative)

    def along(self, times: ArrayLike) -> Array:
        """Return pose, rates and accelerations (n, 18) at times (n,) in s."""
        c, instants = core(), np.array(times, np.float64)
        rows = np.empty((len(instants), NUM_REFERENCE))
        c.lib.stewart_rows_of_motion(self.data, len(rows), c.at(instants), c.at(rows))
        return rows


def _derivative(data: Any, keep_alive: list[Any], time: float, order: int) -> Array:
    """Return a derivative (6, 1) of a motion in C, which points to `keep_alive`."""
    c, values = core(), np.empty((order + 1, 6))
    c.lib.stewart_derivatives_of_motion(data, time, order + 1, c.at(values))
    return values[order].reshape(6, 1)


@singledispatch
def make_reference(config: ReferenceConfig, duration: float) -> PlateTrajectory:
    """Return the motion of a section `reference`; each kind registers its own function.

    A motion through waypoints is at rest at the first, at the last, and at two equal neighbours. It
    is twice continuously differentiable. A CSV motion is the cubic spline through its samples, with
    continuous third derivatives at the second and the last but one. In both, the pose is constant
    before the first and after the last sample.

    Raises:
        ConfigError: the samples or their file break a rule of `reference_files`, or a CSV motion
            ends before `duration` in s while it still moves.
    """
    raise TypeError(f"config: got a {type(config).__name__}; expected a kind of reference")


@make_reference.register
def _sine(config: SineConfig, duration: float) -> PlateTrajectory:
    amplitude, frequency = config.amplitude, config.angular_frequency
    return PlateTrajectory(offset=config.offset, amplitude=amplitude, frequency=frequency)


@make_reference.register
def _hold(config: HoldConfig, duration: float) -> PlateTrajectory:
    return PlateTrajectory(offset=config.offset)


@make_reference.register
def _sampled(config: CsvConfig, duration: float) -> PlateTrajectory:
    if config.file is None:
        raise ConfigError(config.problem() or "")
    return through_samples(*read_csv(config.file), duration, config.file)


def evaluate(trajectory: Trajectory, t: float) -> Array:
    """Return [pose; rates; accelerations] (18,) at a time in s."""
    return rows_along(trajectory, [t])[0]


def rows_along(trajectory: Trajectory, times: ArrayLike) -> Array:
    """Return [pose; rates; accelerations] (n, 18) at times (n,) in s."""
    if isinstance(trajectory, PlateTrajectory):
        return trajectory.along(times)
    instants = np.array(times, np.float64)
    rows = np.empty((len(instants), NUM_REFERENCE))
    for row, t in zip(rows, instants.tolist(), strict=True):
        row[POSE] = trajectory.value(t)[:, 0]
        row[RATES] = trajectory.EvalDerivative(t, 1)[:, 0]
        row[ACCELERATIONS] = trajectory.EvalDerivative(t, 2)[:, 0]
    return rows


def poses_along(trajectory: Trajectory, times: Array) -> Array:
    """Return the values (n, 6) of a trajectory at times (n,)."""
    if isinstance(trajectory, PlateTrajectory):
        return trajectory.along(times)[:, POSE]
    values: Array = np.array(trajectory.vector_values(times.tolist()))
    return values.T


def spread_instants(duration: float, number: int) -> Array:
    """Return instants (number,) in s to sample a motion of unknown period, from 0 on.

    Evenly spaced instants may all have the same phase: a sine of 0.5 Hz is 0 at each whole second.
    Here there is one instant in each of `number` equal parts, placed in it by the golden ratio, so
    that the phases are spread evenly for any period.
    """
    k = np.arange(number)
    return duration / number * (k + k * _GOLDEN % 1)


def peak_to_peak(config: ReferenceConfig, trajectory: Trajectory, duration: float) -> Array:
    """Return the range of the motion (6,), the scale of tracking errors, rad and m.

    For a sine it is twice its amplitude, else the range within [0, duration]. It is 0 where the
    coordinate is constant. The trajectory is `make_reference(config, duration)`.
    """
    span = 2 * np.abs(config.amplitude) if isinstance(config, SineConfig) else None
    return motion_range(trajectory, duration, span)


def motion_range(trajectory: Trajectory, duration: float, span: Array | None = None) -> Array:
    """Return the range (6,) of any motion within [0, duration], 0 where constant; rad and m."""
    if span is None:
        samples = int(np.clip(math.ceil(duration / _GRID), 1000, 1_000_000)) + 1
        span = np.ptp(poses_along(trajectory, np.linspace(0.0, duration, samples)), axis=0)
    furthest = np.abs(trajectory.value(0.0)[POSITION, 0]).max() + span[POSITION].max()
    return np.where(span < _CONSTANT * np.repeat([1.0, furthest], 3), 0.0, span)


def continues(state: Array, reference: Trajectory, time: float, duration: float) -> bool:
    """Return whether a reference goes on from a state (12,) at a time in s: it needs no catch-up.

    Rates may differ by `RESTING` of the largest ones within [0, duration].
    """
    x = evaluate(reference, time)
    if not np.abs(x[POSE] - state[POSE]).max() < SAME:
        return False
    instants = np.linspace(0.0, duration, 501)
    speeds = np.abs(rows_along(reference, instants)[:, RATES]).max(axis=0)
    return bool(np.all(np.abs(x[RATES] - state[RATES]) <= RESTING * speeds + SAME))


def catch_up(
    start_pose: ArrayLike,
    start_rates: ArrayLike,
    reference: Trajectory,
    t_start: float,
    duration: float,
) -> Trajectory:
    """Return a reference that leaves the start state smoothly and ends on `reference`.

    Up to `t_start` it keeps the rates of the start at t = 0, as a plate on which no torque acts
    yet. Over the next `duration` it is a quintic: this continues pose and rates with zero
    acceleration, and reaches pose, rates and accelerations of the reference. Then it is the
    reference. A `t_start` below 1e-6 s counts as 0.
    """
    pose, rates = np.asarray(start_pose, dtype=float), np.asarray(start_rates, dtype=float)
    if pose.shape != (6,) or rates.shape != (6,):
        raise ValueError(
            f"start_pose and start_rates have shapes {pose.shape} and {rates.shape}; expected (6,)"
        )
    if not (0 <= t_start < math.inf and _LEAST_LENGTH <= duration < math.inf):
        raise ValueError(
            f"got t_start {t_start}, duration {duration}; expected t_start >= 0, "
            f"duration >= {_LEAST_LENGTH}"
        )
    t_start = t_start if t_start >= _LEAST_LENGTH else 0.0
    t_end = t_start + duration
    start = np.concatenate([pose + rates * t_start, rates, np.zeros(6)])
    return through_states([(t_start, start, t_end, evaluate(reference, t_end))], reference)


Piece = tuple[float, Array, float, Array]
"""Start time in s, [pose; rates; accelerations] (18,) there, end time, the same there."""


def through_states(pieces: Sequence[Piece], reference: Trajectory) -> Trajectory:
    """Return quintics through given states, followed by `reference`, with two derivatives.

    Before the first piece the rates are constant, as at its start. Accelerations may jump between
    two pieces.
    """
    t_start, start = pieces[0][:2]
    quintics = [_quintic(*piece) for piece in pieces]
    times = [t_start, *(piece[2] for piece in pieces)]
    if t_start > 0:
        line = np.zeros((6, 6))
        line[-1], line[-2] = start[POSE] - start[RATES] * t_start, start[RATES]
        times, quintics = [0.0, *times], [line, *quintics]
    powers = np.stack(quintics, axis=1)
    if isinstance(reference, PlateTrajectory):
        return PlateTrajectory(times, powers, reference)
    segments = []
    for motion, begin, end in (
        (PlateTrajectory(times, powers), 0.0, times[-1]),
        (reference, times[-1], math.inf),
    ):
        segments.append(FunctionHandleTrajectory(motion.value, 6, 1, begin, end))
        segments[-1].set_derivative(motion.EvalDerivative)
    return CompositeTrajectory(segments)


@make_reference.register
def _through_waypoints(config: WaypointsConfig, duration: float) -> PlateTrajectory:
    """Return quintics with the knot rates and accelerations of a clamped cubic spline."""
    from scipy.interpolate import CubicSpline  # slow to import

    times, poses = waypoints(config)
    repeated = np.all(np.diff(poses, axis=0) == 0, axis=1)
    at_rest = np.concatenate([[True], repeated]) | np.concatenate([repeated, [True]])
    knots = np.zeros((len(times), NUM_REFERENCE))
    knots[:, POSE] = poses
    for first, last in itertools.pairwise(np.flatnonzero(at_rest)):
        part = slice(first, last + 1)
        spline = CubicSpline(times[part], poses[part], bc_type="clamped")
        inner = slice(first + 1, last)
        knots[inner, RATES] = spline(times[inner], 1)
        # A cubic would jump in acceleration at a stop; a quintic can start and end with none.
        knots[inner, ACCELERATIONS] = spline(times[inner], 2)
    pieces = [
        _quintic(times[k], knots[k], times[k + 1], knots[k + 1]) for k in range(len(times) - 1)
    ]
    return PlateTrajectory(times, np.stack(pieces, axis=1), offset=poses[-1])


def through_samples(times: Array, poses: Array, duration: float, file: str) -> PlateTrajectory:
    """Return the cubic spline through samples (n,), (n, 6), followed by the last pose."""
    from scipy.interpolate import CubicSpline  # slow to import

    # A clamped spline would bend the first and last interval of a motion recorded on the move.
    cubic = CubicSpline(times, poses, bc_type="not-a-knot")
    end = float(times[-1])
    if end < duration:
        speeds = np.abs(cubic(times, 1))
        stops = speeds[-1] <= np.maximum(_STOP_SPEED, _STOP_SHARE * speeds.max(axis=0))
        if not stops.all():
            column = int(np.argmin(stops))
            unit = "rad/s" if column < 3 else "m/s"
            name = COORDINATE_NAMES[column]
            raise ConfigError(
                f"{file}: last row: got {speeds[-1, column]:.3g} {unit} in {name} "
                f"at {end:.6g} s; expected samples that come to rest, or duration <= {end!r}"
            )
    return PlateTrajectory(times, cubic.c, offset=poses[-1])


def _quintic(t0: float, start: Array, t1: float, end: Array) -> Array:
    """Return the coefficients (6, 6) of the quintic between two [pose; rates; accelerations].

    The Taylor series at the start gives c_0 to c_2. Over h = t1 - t0 these miss the pose at the end
    by p, the rates by v / h and the accelerations by a / h^2, which gives c_3 to c_5:
    c_3 h^3 = 10 p - 4 v + a / 2, and so on.
    """
    h = t1 - t0
    c0, c1, c2 = start[POSE], start[RATES], start[ACCELERATIONS] / 2
    p = end[POSE] - c0 - h * (c1 + h * c2)
    v = h * (end[RATES] - c1 - 2 * h * c2)
    a = h**2 * (end[ACCELERATIONS] - 2 * c2)
    c3 = (10 * p - 4 * v + a / 2) / h**3
    c4 = (-15 * p + 7 * v - a) / h**4
    c5 = (6 * p - 3 * v + a / 2) / h**5
    return np.array([c5, c4, c3, c2, c1, c0])
