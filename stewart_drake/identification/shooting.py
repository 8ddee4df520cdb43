"""Trajectories of a machine under held torques that come late, with their sensitivities.

A log is cut into segments, each with a free first state, which are integrated side by side.
With x_dot = f(x, T; p) the sensitivity S = dx/d[x_0; p; delay] obeys

    S_dot = A S + df/dp,   S = [1, 0, 0] at the start,

and at an instant t_k + delay at which the torque changes from T to T+, an instant that moves with
the delay, x stays and S jumps in the delay's column by f(x, T) - f(x, T+): what a moment longer of
the old torque does. That is exact wherever the instant lies, so that no whole number of samples
has to be searched for. Both equations are integrated by the classical Runge-Kutta method.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.identification.logs import Log
from stewart_drake.identification.model import NUM_DYNAMIC, NUM_GEOMETRY, MachineModel, Numbers
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, RATES
from stewart_drake.types import Array

_INSTANT: Final = 1e-9
"""s; events closer to each other are one."""
FIRST: Final = slice(0, NUM_STATE)
"""Columns of S: first state,"""
NUMBERS: Final = slice(NUM_STATE, NUM_STATE + NUM_DYNAMIC + NUM_GEOMETRY)
"""parameters of the dynamics and numbers of the legs, and last the delay."""


class Segment(NamedTuple):
    """Stretch of a log that is integrated from a free first state."""

    log: Log
    start: float
    """s."""
    rows: NDArray[np.intp]
    """Of the log's samples, in order."""


class Plan(NamedTuple):
    """Steps (m, n) of n segments side by side, s; a segment that has ended waits in steps of 0."""

    h: Array
    torques: Array
    """(m, n, 6) that act in a step."""
    after: Array
    """(m, n, 6) that act after it."""
    sample: NDArray[np.intp]
    """Number of the segment's sample at the end of a step, -1 where there is none."""


class Course(NamedTuple):
    """States and sensitivities at the samples of n segments, at most m each."""

    states: Array
    """(m, n, 12), NaN where a segment has fewer samples."""
    slopes: Array
    """(m, n, 12, columns)."""


def plan_steps(segments: list[Segment], delay: float, longest_step: float) -> Plan:
    """Return the steps from sample to sample and from torque to torque; times in s."""
    plans = [_steps_of(segment, delay, longest_step) for segment in segments]
    longest = max(len(h) for h, *_ in plans)
    joined = Plan(
        np.zeros((longest, len(plans))),
        np.zeros((longest, len(plans), NUM_TORQUES)),
        np.zeros((longest, len(plans), NUM_TORQUES)),
        np.full((longest, len(plans)), -1),
    )
    for i, one in enumerate(plans):
        m = len(one.h)
        for whole, part in zip(joined, one, strict=True):
            whole[:m, i] = part
        # As if the last torque went on: a segment that waits has no switch.
        joined.torques[m:, i] = joined.after[m:, i] = one.after[-1]
    return joined


def _steps_of(segment: Segment, delay: float, longest_step: float) -> Plan:
    log, start = segment.log, segment.start
    samples = log.times[segment.rows]
    arrivals = log.sent + delay
    inner = arrivals[(arrivals > start + _INSTANT) & (arrivals < samples[-1] + _INSTANT)]
    events = np.sort(np.concatenate([samples, inner]))
    events = events[np.diff(events, prepend=-np.inf) > _INSTANT]
    gaps = np.diff(events, prepend=start)
    parts = np.maximum(1, np.ceil(gaps / longest_step - 1e-9)).astype(int)
    ends = np.cumsum(parts) - 1
    m = ends[-1] + 1
    sample = np.full(m, -1)
    sample[ends[np.searchsorted(events, samples - _INSTANT)]] = np.arange(len(samples))
    # The torque within a step, and just after it.
    middle = np.repeat(np.maximum(events - gaps / 2, start + 2 * _INSTANT), parts)
    applied = log.applied_torque(middle, delay)
    after = np.vstack([applied[1:], log.applied_torque(samples[-1:] + 2 * _INSTANT, delay)])
    return Plan(np.repeat(gaps / parts, parts), applied, after, sample)


def integrate(
    model: MachineModel, numbers: Numbers, first: Array, plan: Plan, sensitive: bool
) -> Course:
    """Integrate all segments from their first states (n, 12).

    A state that grows beyond all bounds ends as NaN or infinity, without a warning.
    """
    n, count = len(first), int(plan.sample.max()) + 1
    columns = NUMBERS.stop + 1 if sensitive else 0
    x, S = first.copy(), np.zeros((n, NUM_STATE, columns))
    if sensitive:
        S[:, :, FIRST] = np.eye(NUM_STATE)
    course = Course(
        np.full((count, n, NUM_STATE), np.nan), np.zeros((count, n, NUM_STATE, columns))
    )
    with np.errstate(all="ignore"):
        for h, torques, after, sample in zip(*plan, strict=True):
            x, S = _step(model, numbers, x, S, torques, h)
            if sensitive and np.any(torques != after):
                old = model.accelerations(x, torques, numbers)
                S[:, RATES, -1] += old - model.accelerations(x, after, numbers)
            there = np.flatnonzero(sample >= 0)
            course.states[sample[there], there] = x[there]
            course.slopes[sample[there], there] = S[there]
    return course


def _step(
    model: MachineModel, numbers: Numbers, x: Array, S: Array, torques: Array, h: Array
) -> tuple[Array, Array]:
    """Return states and sensitivities after a step of the classical Runge-Kutta method.

    The sensitivities are exact derivatives of the step, stage by stage by the chain rule. They may
    have no columns.
    """

    def f(x: Array, S: Array) -> tuple[Array, Array]:
        if not S.size:
            return np.hstack([x[:, RATES], model.accelerations(x, torques, numbers)]), S
        at = model.slopes(x, torques, numbers)
        S_dot = np.empty_like(S)
        S_dot[:, :6] = S[:, 6:]
        np.matmul(at.state, S, out=S_dot[:, 6:])
        S_dot[:, 6:, NUMBERS] += at.numbers
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
