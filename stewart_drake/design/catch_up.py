"""The way from rest onto a moving reference, planned with torques that are held for a period each.

A plan is a sequence of n held torques that takes the nominal plant from its state at the first
instant a torque can act, exactly onto the reference: 12 equations in 6 n unknowns, n >= 2. Starting
from the mean torques along a quintic, Newton steps of least norm (a Gauss-Newton shooting method)

    dT = J^+ (x_reference - x_n(T)),     J = [Phi_n ... Phi_2 Gamma_1, ..., Gamma_n],

change it as little as possible, so that it stays smooth. The controller then follows the response
to the plan, which held torques can follow without error.
"""

import math

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from stewart_drake.design.delay_model import sample
from stewart_drake.design.holds import (
    mean_torques,
    means_and_changes,
    rates_at_samples,
    torques_at_nodes,
)
from stewart_drake.errors import ConfigError
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.workspace import margin
from stewart_drake.signals import POSE, RATES
from stewart_drake.trajectories import Piece, catch_up, evaluate, through_states

Array = NDArray[np.float64]

DEFAULT_CATCH_UP = 0.3
"""s; when no torque limit says otherwise."""
LONGEST_CATCH_UP = 10.0
HEADROOM = 0.95
"""Share of the torque limit that a plan may use; feedback needs the rest."""
PIECE = 0.025
"""s; longest piece of the planned motion between two states taken from the dynamics."""
TOLERANCE = 1e-10
"""rad, m and per s, by which a plan may miss the reference."""


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
    wanted = DEFAULT_CATCH_UP if duration is None else duration
    fewest = 2 if torque_limit is not None and duration is None else _periods(wanted, period)
    most = fewest if duration is not None else _periods(LONGEST_CATCH_UP, period)
    limit = math.inf if torque_limit is None or duration is not None else HEADROOM * torque_limit

    def attempt(holds: int) -> Trajectory | None:
        return _plan(dynamics, reference, start, t_start, period, holds, limit)

    # What n periods can do, more can do with less torque: double n, then halve the bracket.
    failed, holds, motion = fewest - 1, fewest, attempt(fewest)
    while motion is None and holds < most:
        failed, holds = holds, min(2 * holds, most)
        motion = attempt(holds)
    if motion is None and duration is None:
        return reference, 0.0
    if motion is None:
        raise ConfigError(
            f"controller.catch_up: got {duration:g} s, with which the plate would leave its "
            "workspace; expected a longer time, or null for the shortest possible"
        )
    while holds - failed > 1:
        middle = (failed + holds) // 2
        shorter = attempt(middle)
        if shorter is None:
            failed = middle
        else:
            holds, motion = middle, shorter
    return motion, holds * period


def _periods(duration: float, period: float) -> int:
    return max(2, math.ceil(duration / period - 1e-9))


def _plan(
    dynamics: StewartDynamics,
    reference: Trajectory,
    start: Array,
    t_start: float,
    period: float,
    holds: int,
    torque_limit: float,
) -> Trajectory | None:
    """The planned motion with so many held torques, or None where there is none."""
    pieces = math.ceil(period / PIECE)
    edges = t_start + period * np.arange(holds + 1)
    target = _target(dynamics, reference, float(edges[-1]), period)
    origin = start[POSE] - t_start * start[RATES]  # where a plate with these rates was at t = 0
    guess = catch_up(origin, start[RATES], reference, t_start, holds * period)
    torques = mean_torques(dynamics, guess, edges[:-1], edges[1:])
    for _ in range(12):
        states = _response(dynamics, start, torques, period, pieces)
        if not _inside(dynamics, states):
            return None
        miss = target - states[-1]
        if np.abs(miss).max() <= TOLERANCE:
            if np.abs(torques).max() > torque_limit:
                return None
            return _motion(dynamics, reference, states, torques, t_start, period / pieces)
        J = _sensitivity(dynamics, states, torques, period, pieces)
        torques = torques + np.reshape(np.linalg.lstsq(J, miss)[0], torques.shape)
    return None


def _target(dynamics: StewartDynamics, reference: Trajectory, t: float, period: float) -> Array:
    """State (12,) at which held torques take the reference over, see `design.holds`."""
    x = evaluate(reference, t)
    nodes = torques_at_nodes(dynamics, reference, np.array([t]), np.array([t + period]))
    means, changes = means_and_changes(nodes)
    B = dynamics.derivatives(x[POSE], x[RATES], means[0]).B[RATES]
    before = np.zeros_like(changes)  # the plan's own torques do not change within their holds
    x[RATES] += rates_at_samples(np.vstack([before, changes]), B, period)
    return x[:12]


def _response(
    dynamics: StewartDynamics, start: Array, torques: Array, period: float, pieces: int
) -> Array:
    """States (n pieces + 1, 12) under the held torques (n, 6), the start first."""
    short = np.repeat(torques, pieces, axis=0)
    return np.vstack([start, dynamics.predict(start, short, period / pieces)])


def _inside(dynamics: StewartDynamics, states: Array) -> bool:
    mechanism = dynamics.mechanism
    return all(margin(mechanism, state[POSE]) > 0 for state in states)


def _sensitivity(
    dynamics: StewartDynamics, states: Array, torques: Array, period: float, pieces: int
) -> Array:
    """J (12, 6 n): last state per torque, linearised half-way through each hold."""
    columns: list[Array] = []
    for k, torque in enumerate(torques):
        middle = (states[k * pieces] + states[(k + 1) * pieces]) / 2
        derivatives = dynamics.derivatives(middle[POSE], middle[RATES], torque)
        Phi, Gamma = sample(derivatives.A, derivatives.B, period)
        columns = [Phi @ column for column in columns] + [Gamma]
    return np.hstack(columns)


def _motion(
    dynamics: StewartDynamics,
    reference: Trajectory,
    states: Array,
    torques: Array,
    t_start: float,
    step: float,
) -> Trajectory:
    pieces: list[Piece] = []
    per_hold = (len(states) - 1) // len(torques)
    for i in range(len(states) - 1):
        torque = torques[i // per_hold]
        ends = (
            np.concatenate([x, dynamics.accelerations(x[POSE], x[RATES], torque)])
            for x in states[i : i + 2]
        )
        pieces.append((t_start + i * step, next(ends), t_start + (i + 1) * step, next(ends)))
    return through_states(pieces, reference)
