"""Trajectories of a machine under held torques with a delay, with their sensitivities.

A log is cut into segments, each with a free first state, which are integrated side by side.
With x_dot = f(x, T; p) the sensitivity S = dx/d[x_0; p; delay] obeys

    S_dot = A S + df/dp,   S = [1, 0, 0] at the start,

and at an instant t_k + delay at which the torque changes from T to T+, which moves with the delay,
x stays and S jumps in the delay's column by f(x, T) - f(x, T+), the effect of holding the old
torque longer. That is exact for any instant, so that the delay need not be a whole number of
samples. Both equations are integrated by the classical Runge-Kutta method (core/shooting.h).
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.library import core
from stewart_drake.identification.logs import Log
from stewart_drake.identification.model import NUM_DYNAMIC, NUM_GEOMETRY, MachineModel, Numbers
from stewart_drake.scenario.signals import NUM_STATE
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
    """Steps (m,) of a segment."""

    h: Array  # s
    torques: Array  # (m, 6) during a step
    after: Array  # (m, 6) after it
    sample: NDArray[np.intc]  # number of the segment's sample at the end of a step, or -1


class Trajectories(NamedTuple):
    """States and sensitivities at the samples of n segments, at most m each.

    Where a segment has no sample, states are NaN and sensitivities 0.
    """

    states: Array  # (m, n, 12)
    sensitivities: Array  # (m, n, 12, columns)


def plan_steps(segments: list[Segment], delay: float, longest_step: float) -> list[Steps]:
    """Return the steps from sample to sample and from torque to torque; times in s."""
    return [_steps_of(segment, delay, longest_step) for segment in segments]


def _steps_of(segment: Segment, delay: float, longest_step: float) -> Steps:
    """Return the steps of one segment."""
    log, start = segment.log, segment.start
    samples = log.times[segment.rows]
    arrivals = log.sent + delay
    inner = arrivals[(arrivals > start + _INSTANT) & (arrivals < samples[-1] + _INSTANT)]
    events = np.sort(np.concatenate([samples, inner]))
    events = events[np.diff(events, prepend=-np.inf) > _INSTANT]
    gaps = np.diff(events, prepend=start)
    parts = np.maximum(1, np.ceil(gaps / longest_step - _ROUNDING)).astype(int)
    ends = np.cumsum(parts) - 1
    sample = np.full(ends[-1] + 1, -1, np.intc)
    sample[ends[np.searchsorted(events, samples - _INSTANT)]] = np.arange(len(samples))
    # Torque in the middle of each gap. An arrival within _INSTANT of the start counts as before it,
    # so look just behind.
    middle = np.repeat(np.maximum(events - gaps / 2, start + 2 * _INSTANT), parts)
    torques = log.applied_torque(middle, delay)
    after = np.vstack([torques[1:], log.applied_torque(samples[-1:] + 2 * _INSTANT, delay)])
    return Steps(np.repeat(gaps / parts, parts), torques, after, sample)


def integrate(
    model: MachineModel, numbers: Numbers, first: Array, steps: list[Steps], sensitive: bool
) -> Trajectories:
    """Integrate all segments from their first states (n, 12).

    A state that grows beyond all bounds ends as NaN or infinity, without a warning.
    """
    c, n, count = core(), len(first), 1 + max(int(one.sample.max()) for one in steps)
    (plant, _kept), legs = model.plant(numbers), NUM_GEOMETRY * model.free_legs
    states = np.full((n, count, NUM_STATE), np.nan)
    columns = NUM_STATE + NUM_DYNAMIC + legs + 1 if sensitive else 0
    found = np.zeros((n, count, NUM_STATE, columns))
    for k, one in enumerate(steps):
        arrays = (np.ascontiguousarray(part) for part in (*one, first[k]))
        slopes = found[k] if sensitive else None
        given = map(c.at, (*arrays, states[k], slopes))
        c.lib.stewart_shoot(plant, legs > 0, len(one.h), *given)
    sensitivities = np.zeros((count, n, NUM_STATE, PARAMETER_COLUMNS.stop + 1 if sensitive else 0))
    if sensitive:
        sensitivities[..., : columns - 1] = found[..., :-1].swapaxes(0, 1)
        sensitivities[..., DELAY_COLUMN] = found[..., -1].swapaxes(0, 1)
    return Trajectories(states.swapaxes(0, 1), sensitivities)
