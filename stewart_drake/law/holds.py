"""Torques that are held for a period each, so that the plate follows a smooth motion.

Let T(t) be the inverse-dynamics torque of the motion. Held at its mean over each interval, it gives
the rates of the motion at the end of the interval, up to dt^3, but not the pose. With the input map
B nearly constant and T' the slope of T within the hold, the pose is ahead by

    int_0^dt (dt - s) B (mean - T(s)) ds = B T' dt^3 / 12

after each interval, which adds up to dt^2/12 int B T' dt: an error in proportion to the torque. It
is removed by holding  mean - dt^2/12 T''  instead. With s_k = T' dt, the change of T over hold k,

    T_k = mean_k - (s_{k+1} - s_{k-1}) / 24.                                           (hold)

Pose and rates cannot both be met by one torque per period. With (hold) the poses at the samples are
right, and the rates there differ from the motion's by

    rates_k - rates(t_k) = -dt/24 B (s_{k-1} + s_k),                                   (rates)

which must not be fed back as an error. A motion under held torques has s = 0 and is followed
exactly.
"""

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.scenario.signals import ACCELERATIONS, NUM_TORQUES, POSE, RATES
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

GAUSS_NODES = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3)
"""Two-point Gauss quadrature on [0, 1], weights 1/2: exact for cubics."""


def torques_at_nodes(
    dynamics: StewartDynamics, motion: Trajectory, starts: Array, ends: Array
) -> Array:
    """Return inverse-dynamics torques (n, 2, 6) in N m along `motion` at the nodes of each hold."""
    torques = np.empty((len(starts), 2, NUM_TORQUES))
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        for j, node in enumerate(GAUSS_NODES):
            x = evaluate(motion, start + (end - start) * node)
            torques[i, j] = dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
    return torques


def mean_torques(
    dynamics: StewartDynamics, motion: Trajectory, starts: Array, ends: Array
) -> Array:
    """Return the mean inverse-dynamics torque (n, 6) in N m over each interval, in s."""
    return means_and_changes(torques_at_nodes(dynamics, motion, starts, ends))[0]


def means_and_changes(at_nodes: Array) -> tuple[Array, Array]:
    """Return mean and change of T over each hold, (n, 6), from T at the nodes (n, 2, 6)."""
    # The nodes lie 1/sqrt(3) of a hold apart.
    return at_nodes.mean(axis=1), np.sqrt(3) * (at_nodes[:, 1] - at_nodes[:, 0])


def held_torques(means: Array, changes: Array) -> Array:
    """Return torques (n - 2, 6) by (hold) for the inner ones of n >= 3 consecutive holds."""
    return means[1:-1] - (changes[2:] - changes[:-2]) / 24


def rates_at_samples(changes: Array, B: Array, period: float) -> Array:
    """Return the offset (6,) by (rates) of the rates at the instant between two holds.

    Args:
        changes: (2, 6) of the torque over the hold before and the hold after.
        B: (6, 6) accelerations per torque.
        period: s.
    """
    return -period / 24 * B @ (changes[0] + changes[1])


def state_within_hold(change: Array, B: Array, period: float, passed: float) -> Array:
    """Return the offset (12,) of pose and rates when the share `passed` of a hold is over.

    From (rates) at its start on, with x = passed and constant slope of T:
    rates -dt B s (1/12 - x (1 - x) / 2),  pose -dt^2 B s x (1 - x) (1 - 2 x) / 12.

    Args:
        change: (6,) of the torque over the hold.
        B: (6, 6) accelerations per torque.
        period: s.
        passed: 0 to 1.
    """
    left = passed * (1 - passed)
    push = -period * B @ change
    return np.concatenate(
        [period * left * (1 - 2 * passed) / 12 * push, (1 / 12 - left / 2) * push]
    )


def cubic(start: Array, end: Array, h: float, s: float) -> tuple[Array, Array]:
    """Return pose and rates (6,) at the share s of h seconds, by the cubic of two states (12,).

    The same holds for crank angles and their rates.
    """
    rise, v_0, v_1 = (end[POSE] - start[POSE]) / h, start[RATES], end[RATES]
    a, b = v_0 - rise, v_1 - rise
    left = 1 - s
    pose = left * start[POSE] + s * end[POSE] + h * s * left * (left * a - s * b)
    return pose, rise + left * (1 - 3 * s) * a + s * (3 * s - 2) * b
