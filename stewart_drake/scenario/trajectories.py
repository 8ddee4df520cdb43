"""References as pydrake trajectories of the pose (6x1), with exact first and second derivatives.

Every trajectory can be evaluated at any t >= 0: the controller looks ahead, beyond the duration.
"""

import itertools
import math
from collections.abc import Sequence
from functools import singledispatch
from typing import Final

import numpy as np
from pydrake.trajectories import (
    BezierCurve,
    CompositeTrajectory,
    FunctionHandleTrajectory,
    PiecewisePolynomial,
    Trajectory,
)

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
_GRID: Final = 1e-3  # step at which the peak-to-peak of a sampled reference is read, s
_INSTANT: Final = 1e-6
"""Least length of a piece, s; derivatives of a shorter one would be rounding errors."""
_STOP_SPEED: Final = 1e-3
"""rad/s or m/s; a motion that ends slower than this, or than the share below, is at rest."""
_STOP_SHARE: Final = 0.05  # of the coordinate's largest speed at a sample
_GOLDEN: Final = (math.sqrt(5) - 1) / 2


@singledispatch
def make_reference(config: ReferenceConfig, duration: float) -> Trajectory:
    """Return the motion of a section `reference`; each kind registers its own function.

    Waypoints are left and reached at rest in the first, the last, and wherever two neighbours are
    the same pose; in between the pose is twice continuously differentiable. A CSV motion is the
    cubic spline through its samples, with third derivatives continuous next to its ends. Before
    the first and after the last sample of either the pose is constant.

    Returns:
        A 6x1 trajectory, defined for t >= 0, with derivatives of order 1 and 2.

    Raises:
        ConfigError: the samples or their file break a rule of `reference_files`, or a CSV motion
            ends before `duration` in s while it still moves.
    """
    raise TypeError(f"config: got a {type(config).__name__}; expected a kind of reference")


@make_reference.register
def _sine(config: SineConfig, duration: float) -> Trajectory:
    amplitude = np.reshape(config.amplitude, (6, 1))
    offset = np.reshape(config.offset, (6, 1))
    omega = config.angular_frequency

    def derivative(t: float, order: int) -> Array:
        # d/dt sin = cos, then -sin, -cos, sin
        wave = (math.sin, math.cos)[order % 2]
        sign = -1.0 if order % 4 in (2, 3) else 1.0
        return np.array([[sign * w**order * wave(w * t)] for w in omega]) * amplitude

    trajectory = FunctionHandleTrajectory(lambda t: offset + derivative(t, 0), 6, 1, 0.0, math.inf)
    trajectory.set_derivative(derivative)
    return trajectory


@make_reference.register
def _constant(config: HoldConfig, duration: float) -> Trajectory:
    return PiecewisePolynomial(np.reshape(config.offset, (6, 1)))


@make_reference.register
def _sampled(config: CsvConfig, duration: float) -> Trajectory:
    if config.file is None:
        raise ConfigError(config.problem() or "")
    return through_samples(*read_csv(config.file), duration, config.file)


def evaluate(trajectory: Trajectory, t: float) -> Array:
    """Return [pose; rates; accelerations] (18,) at a time in s."""
    result = np.empty(NUM_REFERENCE)
    result[POSE] = trajectory.value(t)[:, 0]
    result[RATES] = trajectory.EvalDerivative(t, 1)[:, 0]
    result[ACCELERATIONS] = trajectory.EvalDerivative(t, 2)[:, 0]
    return result


def poses_along(trajectory: Trajectory, times: Array) -> Array:
    """Return the values (n, 6) of a trajectory at times (n,)."""
    values: Array = np.array(trajectory.vector_values(times.tolist()))
    return values.T


def spread_instants(duration: float, number: int) -> Array:
    """Return instants (number,) to sample a motion of unknown period, one in each equal part.

    Evenly spaced ones may all have the same phase, such as the zeros of a sine of 0.5 Hz that is
    sampled once a second. Within their parts these are placed by the golden sequence, so that the
    phases are spread evenly for any period. The first one is 0; times are in s.
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
        span = np.ptp(trajectory.vector_values(np.linspace(0.0, duration, samples)), axis=1)
    furthest = np.abs(trajectory.value(0.0)[POSITION, 0]).max() + span[POSITION].max()
    return np.where(span < _CONSTANT * np.repeat([1.0, furthest], 3), 0.0, span)


def catch_up(
    start_pose: ArrayLike,
    start_rates: ArrayLike,
    reference: Trajectory,
    t_start: float,
    duration: float,
) -> Trajectory:
    """Return a reference that leaves the start state smoothly and ends on `reference`.

    Up to `t_start` it keeps the constant rates of the start at t = 0, as a plate on which no torque
    acts yet. Over the next `duration` it is the quintic that continues pose and rates with zero
    acceleration and reaches pose, rates and accelerations of the reference; then it is the
    reference. Below 1e-6 s `t_start` counts as 0.

    Returns:
        A 6x1 trajectory, defined for t >= 0, with derivatives of order 1 and 2.
    """
    pose, rates = np.asarray(start_pose, dtype=float), np.asarray(start_rates, dtype=float)
    if pose.shape != (6,) or rates.shape != (6,):
        raise ValueError(
            f"start_pose and start_rates have shapes {pose.shape} and {rates.shape}; expected (6,)"
        )
    if not (0 <= t_start < math.inf and _INSTANT <= duration < math.inf):
        raise ValueError(
            f"got t_start {t_start}, duration {duration}; expected t_start >= 0, "
            f"duration >= {_INSTANT}"
        )
    t_start = t_start if t_start >= _INSTANT else 0.0
    t_end = t_start + duration
    leave = np.concatenate([pose + rates * t_start, rates, np.zeros(6)])
    return through_states([(t_start, leave, t_end, evaluate(reference, t_end))], reference)


Piece = tuple[float, Array, float, Array]
"""Start time in s, [pose; rates; accelerations] (18,) there, end time, the same there."""


def through_states(pieces: Sequence[Piece], reference: Trajectory) -> Trajectory:
    """Return quintics through given states, followed by `reference`, with two derivatives.

    Before the first piece the pose is on the straight line with its first rates. Accelerations may
    jump between two pieces.
    """
    t_start, leave, t_end = pieces[0][0], pieces[0][1], pieces[-1][2]
    after = FunctionHandleTrajectory(reference.value, 6, 1, t_end, math.inf)
    after.set_derivative(reference.EvalDerivative)
    quintics = [_quintic(t0, t1, start, end) for t0, start, t1, end in pieces]
    segments: list[Trajectory] = [*quintics, after]
    if t_start > 0:
        line = np.column_stack([leave[POSE] - leave[RATES] * t_start, leave[POSE]])
        segments.insert(0, PiecewisePolynomial.FirstOrderHold([0.0, t_start], line))
    return CompositeTrajectory(segments)


@make_reference.register
def _through_waypoints(config: WaypointsConfig, duration: float) -> Trajectory:
    """Return quintics with the knot rates and accelerations of a clamped cubic spline."""
    from scipy.interpolate import CubicSpline  # slow to import

    times, poses = waypoints(config)
    same = np.all(np.diff(poses, axis=0) == 0, axis=1)
    rest = np.zeros(len(times), dtype=bool)
    rest[[0, -1]] = True
    rest[:-1] |= same
    rest[1:] |= same
    knots = np.zeros((len(times), NUM_REFERENCE))
    knots[:, POSE] = poses
    stops = np.flatnonzero(rest)
    for first, last in itertools.pairwise(stops):
        part = slice(first, last + 1)
        spline = CubicSpline(times[part], poses[part], bc_type="clamped")
        inner = slice(first + 1, last)
        knots[inner, RATES] = spline(times[inner], 1)
        # A cubic would jump in acceleration at a stop; a quintic can start and end with none.
        knots[inner, ACCELERATIONS] = spline(times[inner], 2)
    segments: list[Trajectory] = [
        _quintic(times[k], times[k + 1], knots[k], knots[k + 1]) for k in range(len(times) - 1)
    ]
    if times[0] > _INSTANT:
        segments.insert(0, _hold(poses[0], 0.0, times[0]))
    return CompositeTrajectory([*segments, _hold(poses[-1], times[-1], math.inf)])


def through_samples(times: Array, poses: Array, duration: float, file: str) -> Trajectory:
    """Return the cubic spline through samples (n,), (n, 6), followed by the last pose."""
    from scipy.interpolate import CubicSpline  # slow to import

    # The free ends follow the samples; prescribed rest would bend the first and last interval of
    # a motion that was recorded on the move. A PiecewisePolynomial would be the same cubic, but
    # takes 35 s and 4 GB of a million samples, where this takes 1 s and 0.3 GB.
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
    spline = FunctionHandleTrajectory(lambda t: cubic(t)[:, None], 6, 1, 0.0, end)
    spline.set_derivative(lambda t, order: cubic(t, order)[:, None])
    return CompositeTrajectory([spline, _hold(poses[-1], end, math.inf)])


def _hold(pose: Array, start: float, end: float) -> Trajectory:
    return PiecewisePolynomial.ZeroOrderHold([start, end], np.column_stack([pose, pose]))


def _quintic(t0: float, t1: float, start: Array, end: Array) -> BezierCurve:
    """Return the quintic between two [pose; rates; accelerations].

    A Bezier curve of degree 5 over h = t1 - t0 has c' = 5 (c1 - c0) / h and
    c'' = 20 (c2 - 2 c1 + c0) / h^2 at its start, and the mirror image at its end.
    """
    h = t1 - t0
    c0, c5 = start[POSE], end[POSE]
    c1 = c0 + h / 5 * start[RATES]
    c4 = c5 - h / 5 * end[RATES]
    c2 = 2 * c1 - c0 + h**2 / 20 * start[ACCELERATIONS]
    c3 = 2 * c4 - c5 + h**2 / 20 * end[ACCELERATIONS]
    return BezierCurve(t0, t1, np.column_stack([c0, c1, c2, c3, c4, c5]))
