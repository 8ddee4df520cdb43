"""The way from rest onto a moving reference, planned with torques that are held.

A plan is a sequence of n held torques that takes the nominal plant from its state at the first
instant a torque can act, exactly onto the reference: 12 equations in 6 n unknowns, n >= 2. Starting
from the mean torques along a quintic, Newton steps of least norm (a Gauss-Newton shooting method)

    dT = J^+ (x_reference - x_n(T)),     J = [Phi_n ... Phi_2 Gamma_1, ..., Gamma_n],

change it as little as possible, so that it stays smooth. The controller then follows the response
to the plan, which held torques can follow without error. Each torque is held for one period, and in
a plan of more than MOST_HOLDS periods for several: that can be followed just as well, and the time
it takes to plan no longer grows with the number of periods.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.dynamics.workspace import margin
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.delay_model import sample
from stewart_drake.law.holds import (
    mean_torques,
    means_and_changes,
    rates_at_samples,
    torques_at_nodes,
)
from stewart_drake.law.startup import sizes
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.scenario.trajectories import Piece, catch_up, evaluate, through_states
from stewart_drake.types import Array

DEFAULT_CATCH_UP = 0.3
"""s; when no torque limit says otherwise."""
LONGEST_CATCH_UP = 10.0
HEADROOM = 0.95
"""Share of the torque limit that a plan may use; feedback needs the rest."""
MOST_HOLDS = 100
"""Torques in a plan."""
PIECE = 0.025
"""s; longest piece of the planned motion between two states taken from the dynamics."""
TOLERANCE = 1e-10
"""rad, shares of the reach, and per s, by which a plan may miss the reference."""


def plan_catch_up(
    dynamics: StewartDynamics,
    reference: Trajectory,
    start: Array,
    t_start: float,
    period: float,
    duration: float | None,
    torque_limit: float | None,
) -> tuple[Trajectory, float]:
    """The planned motion, then the reference; and how long the plan takes, in s.

    Where no plan of up to LONGEST_CATCH_UP is possible (a plate that falls out of its workspace
    before the first torque acts), it is the reference alone, and 0 s.

    Args:
        dynamics: the nominal plant.
        reference: the motion to reach.
        start: (12,) state at `t_start`, the first instant at which a torque can act.
        t_start: s.
        period: of the controller, s.
        duration: s, rounded up to whole periods, two at least; None for the shortest that keeps
            HEADROOM to the torque limit, or for DEFAULT_CATCH_UP or more without a limit.
        torque_limit: N m, or None.

    Raises:
        ConfigError: with the given duration the plate would leave its workspace.
    """
    return CatchUp(dynamics, reference, start, t_start, period).plan(duration, torque_limit)


class _Holds(NamedTuple):
    """States, the start first, under torques that are held from edge to edge, s."""

    states: Array
    torques: Array
    edges: Array


class CatchUp:
    """The plans from one state, each made once, whatever the limit is that they are asked for.

    Args:
        dynamics, reference, start, t_start, period: as of `plan_catch_up`.
    """

    def __init__(
        self,
        dynamics: StewartDynamics,
        reference: Trajectory,
        start: Array,
        t_start: float,
        period: float,
    ) -> None:
        self._dynamics, self._reference, self._period = dynamics, reference, period
        self._start, self._t_start = start, t_start
        self._holds: dict[int, _Holds | None] = {}
        self._motions: dict[int, Trajectory] = {}

    def plan(self, duration: float | None, torque_limit: float | None) -> tuple[Trajectory, float]:
        """As `plan_catch_up`; the same plan is the same trajectory."""
        periods = shortest(self._possible, self._period, duration, torque_limit)
        if periods is None:
            return self._reference, 0.0
        return self._motion(periods), periods * self._period

    def _possible(self, periods: int, limit: float) -> bool:
        if periods not in self._holds:
            given = self._dynamics, self._reference, self._start, self._t_start, self._period
            with one_blas_thread:
                self._holds[periods] = _plan(*given, periods)
        found = self._holds[periods]
        return found is not None and bool(np.abs(found.torques).max() <= limit)

    def _motion(self, periods: int) -> Trajectory:
        if periods not in self._motions:
            found = self._holds[periods]
            assert found is not None
            self._motions[periods] = _motion(self._dynamics, self._reference, *found)
        return self._motions[periods]


def shortest(
    possible: Callable[[int, float], bool],
    period: float,
    duration: float | None,
    torque_limit: float | None,
) -> int | None:
    """Periods of the plan that was asked for, or of the shortest one there is, or None.

    Args:
        possible: whether there is a plan of so many periods within so many N m.
        period: s.
        duration, torque_limit: as of `plan_catch_up`.

    Raises:
        ConfigError: there is none of the given duration.
    """
    wanted = DEFAULT_CATCH_UP if duration is None else duration
    fewest = 2 if torque_limit is not None and duration is None else _periods(wanted, period)
    most = fewest if duration is not None else _periods(LONGEST_CATCH_UP, period)
    limit = math.inf if torque_limit is None or duration is not None else HEADROOM * torque_limit
    # What n periods can do, more can do with less torque: double n, then halve the bracket.
    failed, periods = fewest - 1, fewest
    while not (found := possible(periods, limit)) and periods < most:
        failed, periods = periods, min(2 * periods, most)
    if not found and duration is None:
        return None
    if not found:
        raise ConfigError(
            f"controller.catch_up: got {duration:g} s, with which the plate would leave its "
            "workspace; expected a longer time, or null for the shortest possible"
        )
    while periods - failed > 1:
        middle = (failed + periods) // 2
        failed, periods = (failed, middle) if possible(middle, limit) else (middle, periods)
    return periods


def _periods(duration: float, period: float) -> int:
    return max(2, math.ceil(duration / period - 1e-9))


def _plan(
    dynamics: StewartDynamics,
    reference: Trajectory,
    start: Array,
    t_start: float,
    period: float,
    periods: int,
) -> _Holds | None:
    """The plan over so many periods, or None where there is none."""
    samples = np.round(np.linspace(0, periods, min(periods, MOST_HOLDS) + 1))
    edges, holds = t_start + period * samples, period * np.diff(samples)
    pieces = math.ceil(holds.max() / PIECE)
    target = _target(dynamics, reference, float(edges[-1]), period)
    origin = start[POSE] - t_start * start[RATES]  # where a plate with these rates was at t = 0
    guess = catch_up(origin, start[RATES], reference, t_start, periods * period)
    torques = mean_torques(dynamics, guess, edges[:-1], edges[1:])
    size = np.tile(sizes(dynamics.mechanism), 2)
    for _ in range(12):
        states = _response(dynamics, start, torques, holds, pieces)
        if not _inside(dynamics, states):
            return None
        miss = (target - states[-1]) / size
        if np.abs(miss).max() <= TOLERANCE:
            return _Holds(states, torques, edges)
        J = _sensitivity(dynamics, states, torques, holds) / size[:, None]
        torques = torques + np.reshape(np.linalg.lstsq(J, miss)[0], torques.shape)
    return None


def _target(dynamics: StewartDynamics, reference: Trajectory, t: float, period: float) -> Array:
    """State (12,) at which held torques take the reference over, see `law.holds`."""
    x = evaluate(reference, t)
    nodes = torques_at_nodes(dynamics, reference, np.array([t]), np.array([t + period]))
    means, changes = means_and_changes(nodes)
    B = dynamics.derivatives(x[POSE], x[RATES], means[0]).B[RATES]
    before = np.zeros_like(changes)  # the plan's own torques do not change within their holds
    x[RATES] += rates_at_samples(np.vstack([before, changes]), B, period)
    return x[:12]


def _response(
    dynamics: StewartDynamics, start: Array, torques: Array, holds: Array, pieces: int
) -> Array:
    """States (n pieces + 1, 12) under torques (n, 6) held for `holds` (n,) s, the start first."""
    short = np.repeat(torques, pieces, axis=0)
    return np.vstack([start, dynamics.predict(start, short, np.repeat(holds / pieces, pieces))])


def _inside(dynamics: StewartDynamics, states: Array) -> bool:
    mechanism = dynamics.mechanism
    return all(margin(mechanism, state[POSE]) > 0 for state in states)


def _sensitivity(dynamics: StewartDynamics, states: Array, torques: Array, holds: Array) -> Array:
    """J (12, 6 n): last state per torque, linearised half-way through each hold."""
    pieces = (len(states) - 1) // len(torques)
    after, columns = np.eye(NUM_STATE), []
    for k in reversed(range(len(torques))):
        middle = (states[k * pieces] + states[(k + 1) * pieces]) / 2
        derivatives = dynamics.derivatives(middle[POSE], middle[RATES], torques[k])
        Phi, Gamma = sample(derivatives.A, derivatives.B, holds[k])
        columns.append(after @ Gamma)
        after = after @ Phi
    return np.hstack(columns[::-1])


def _motion(
    dynamics: StewartDynamics, reference: Trajectory, states: Array, torques: Array, edges: Array
) -> Trajectory:
    pieces: list[Piece] = []
    per_hold = (len(states) - 1) // len(torques)
    times = np.append(
        np.linspace(edges[:-1], edges[1:], per_hold, endpoint=False, axis=1), edges[-1]
    )
    for i in range(len(states) - 1):
        torque = torques[i // per_hold]
        ends = (
            np.concatenate([x, dynamics.accelerations(x[POSE], x[RATES], torque)])
            for x in states[i : i + 2]
        )
        pieces.append((float(times[i]), next(ends), float(times[i + 1]), next(ends)))
    return through_states(pieces, reference)
