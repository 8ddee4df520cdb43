"""Trajectories of a machine under held torques with a delay, with their sensitivities.

A log is cut into segments, each with a free first state, which are integrated side by side.
With x_dot = f(x, T; p) the sensitivity S = dx/d[x_0; p; delay] obeys

    S_dot = A S + df/dp,   S = [1, 0, 0] at the start,

and at an instant t_k + delay at which the torque changes from T to T+, which moves with the delay,
x stays and S jumps in the delay's column by f(x, T) - f(x, T+), the effect of holding the old
torque longer. That is exact for any instant, so that the delay need not be a whole number of
samples. Both equations are integrated by the classical Runge-Kutta method.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.identification.logs import Log
from stewart_drake.identification.model import NUM_DYNAMIC, NUM_GEOMETRY, MachineModel, Numbers
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, RATES
from stewart_drake.types import Array

_INSTANT: Final = 1e-9  # s; events closer to each other are one
_ROUNDING: Final = 1e-9  # excess of a number of steps that is rounded down
# Columns of S: first state, parameters of the dynamics and numbers of the legs, and last the delay
FIRST_COLUMNS: Final = slice(0, NUM_STATE)
PARAMETER_COLUMNS: Final = slice(NUM_STATE, NUM_STATE + NUM_DYNAMIC + NUM_GEOMETRY)
DELAY_COLUMN: Final = -1


class Segment(NamedTuple):
    """Stretch of a log that is integrated from a free first state."""

    log: Log
    start: float  # s
    rows: NDArray[np.intp]  # of the log's samples, in order


class Steps(NamedTuple):
    """Steps (m, n) of n segments side by side; a segment that has ended has steps of 0."""

    h: Array  # s
    torques: Array  # (m, n, 6) during a step
    after: Array  # (m, n, 6) after it
    sample: NDArray[np.intp]  # number of the segment's sample at the end of a step, or -1


class Trajectories(NamedTuple):
    """States and sensitivities at the samples of n segments, at most m each.

    Where a segment has no sample, states are NaN and sensitivities 0.
    """

    states: Array  # (m, n, 12)
    sensitivities: Array  # (m, n, 12, columns)


def plan_steps(segments: list[Segment], delay: float, longest_step: float) -> Steps:
    """Return the steps from sample to sample and from torque to torque; times in s."""
    plans = [_steps_of(segment, delay, longest_step) for segment in segments]
    longest, n = max(len(h) for h, *_ in plans), len(plans)
    torques, after = np.zeros((2, longest, n, NUM_TORQUES))
    joined = Steps(np.zeros((longest, n)), torques, after, np.full((longest, n), -1))
    for i, one in enumerate(plans):
        m = len(one.h)
        for whole, part in zip(joined, one, strict=True):
            whole[:m, i] = part
        torques[m:, i] = after[m:, i] = one.after[-1]  # no jump after the segment's end
    return joined


def _steps_of(segment: Segment, delay: float, longest_step: float) -> Steps:
    """Return the steps of one segment; arrays (m,) and (m, 6)."""
    log, start = segment.log, segment.start
    samples = log.times[segment.rows]
    arrivals = log.sent + delay
    inner = arrivals[(arrivals > start + _INSTANT) & (arrivals < samples[-1] + _INSTANT)]
    events = np.sort(np.concatenate([samples, inner]))
    events = events[np.diff(events, prepend=-np.inf) > _INSTANT]
    gaps = np.diff(events, prepend=start)
    parts = np.maximum(1, np.ceil(gaps / longest_step - _ROUNDING)).astype(int)
    ends = np.cumsum(parts) - 1
    sample = np.full(ends[-1] + 1, -1)
    sample[ends[np.searchsorted(events, samples - _INSTANT)]] = np.arange(len(samples))
    # Torque in the middle of each gap. An arrival within _INSTANT of the start counts as before it,
    # so look just behind.
    middle = np.repeat(np.maximum(events - gaps / 2, start + 2 * _INSTANT), parts)
    torques = log.applied_torque(middle, delay)
    after = np.vstack([torques[1:], log.applied_torque(samples[-1:] + 2 * _INSTANT, delay)])
    return Steps(np.repeat(gaps / parts, parts), torques, after, sample)


def integrate(
    model: MachineModel, numbers: Numbers, first: Array, steps: Steps, sensitive: bool
) -> Trajectories:
    """Integrate all segments from their first states (n, 12).

    A state that grows beyond all bounds ends as NaN or infinity, without a warning.
    """
    n, count = len(first), int(steps.sample.max()) + 1
    columns = PARAMETER_COLUMNS.stop + 1 if sensitive else 0
    x, S = first.copy(), np.zeros((n, NUM_STATE, columns))
    if sensitive:
        S[:, :, FIRST_COLUMNS] = np.eye(NUM_STATE)
    states = np.full((count, n, NUM_STATE), np.nan)
    sensitivities = np.zeros((count, n, NUM_STATE, columns))
    with np.errstate(all="ignore"):
        for h, torques, after, sample in zip(*steps, strict=True):
            x, S = _step(model, numbers, x, S, torques, h)
            if sensitive and np.any(torques != after):
                # before the sample: a sample at the very switch gets the derivative from the right
                old = model.accelerations(x, torques, numbers)
                S[:, RATES, DELAY_COLUMN] += old - model.accelerations(x, after, numbers)
            there = np.flatnonzero(sample >= 0)
            states[sample[there], there] = x[there]
            sensitivities[sample[there], there] = S[there]
    return Trajectories(states, sensitivities)


def _step(
    model: MachineModel, numbers: Numbers, x: Array, S: Array, torques: Array, h: Array
) -> tuple[Array, Array]:
    """Return states and sensitivities after a step of the classical Runge-Kutta method.

    The sensitivities, which may have no columns, are exact derivatives of the step: the chain rule
    is applied to each stage.
    """

    def f(x: Array, S: Array) -> tuple[Array, Array]:
        if not S.size:
            return np.hstack([x[:, RATES], model.accelerations(x, torques, numbers)]), S
        at = model.slopes(x, torques, numbers)
        S_dot = np.empty_like(S)
        S_dot[:, :6] = S[:, 6:]
        np.matmul(at.state, S, out=S_dot[:, 6:])
        S_dot[:, 6:, PARAMETER_COLUMNS] += at.numbers
        return np.hstack([x[:, RATES], at.accelerations]), S_dot

    one, all_ = h[:, None], h[:, None, None]
    k1, K1 = f(x, S)
    k2, K2 = f(x + one / 2 * k1, S + all_ / 2 * K1)
    k3, K3 = f(x + one / 2 * k2, S + all_ / 2 * K2)
    k4, K4 = f(x + one * k3, S + all_ * K3)
    return (
        x + one / 6 * (k1 + 2 * k2 + 2 * k3 + k4),
        S + all_ / 6 * (K1 + 2 * K2 + 2 * K3 + K4),
    )
