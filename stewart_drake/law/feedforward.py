"""Torque that the reference takes, held for a period each so that the plate follows it.

With s_k the change of the inverse-dynamics torque over hold k, and B accelerations per torque,

    T_k = mean_k - (s_{k+1} - s_{k-1}) / 24,                                           (hold)
    rates_k - rates(t_k) = -dt/24 B (s_{k-1} + s_k),                                   (rates)

see core/design.c. A motion under held torques has s = 0 and is followed exactly.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.compiled import numbers
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.types import Array

GAUSS_NODES = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3)
"""Two-point Gauss quadrature on [0, 1], weights 1/2: exact for cubics."""


def torques_at_nodes(
    dynamics: StewartDynamics, motion: Trajectory, starts: Array, ends: Array
) -> Array:
    """Return inverse-dynamics torques (n, 2, 6) in N m along `motion` at the nodes of each hold."""
    times = starts[:, None] + (ends - starts)[:, None] * GAUSS_NODES
    rows = rows_along(motion, times.ravel())
    return dynamics.torques_along(rows).reshape(-1, 2, NUM_TORQUES)


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


class HeldTorques(NamedTuple):
    """Torques of h consecutive holds.

    Attributes:
        torques: (h, 6) N m, held; the last is that of the torque to be computed.
        changes: (h + 2, 6) of the exact torque over these holds and a neighbour on each side.
    """

    torques: Array
    changes: Array


class Feedforward(ABC):
    """A kind of feedforward. Instances are immutable."""

    def nodes(self, timeline: Timeline, pending: int) -> Array:
        """Return the instants, s from now, at which the reference must be known.

        Two per hold: of the torque to be computed, of `pending` torques in the queue that enter
        linearly, and of a neighbour on each side.
        """
        holds = timeline.holds(-pending - 1, 1)
        return (holds[:, None] + timeline.period * GAUSS_NODES).ravel()

    @abstractmethod
    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        """Return the torque (6,) N m for pose, rates and accelerations (18,)."""

    def held(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> HeldTorques:
        """Return the held torques for the reference (2 (h + 2), 18) at `nodes`."""
        torques = [self.at(node, dynamics, parameters) for node in wanted]
        means, changes = means_and_changes(np.reshape(torques, (-1, 2, NUM_TORQUES)))
        return HeldTorques(means[1:-1], changes)

    def offset(self, changes: Array, B: Array, timeline: Timeline) -> Array:
        """Return the offset (12,) that held torques cause at the sample that is regulated.

        `changes` are those of `held`, B (6, 6) accelerations per torque.
        """
        return np.zeros(NUM_STATE)


@dataclass(frozen=True)
class NoFeedforward(Feedforward):
    """No torque."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        return np.zeros(NUM_TORQUES)


@dataclass(frozen=True)
class EquilibriumFeedforward(Feedforward):
    """Torque that holds the plate still at the pose of the reference."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        still = np.zeros(NUM_COORDINATES)
        return dynamics.inverse_dynamics(wanted[POSE], still, still, parameters)


@dataclass(frozen=True)
class InverseDynamicsFeedforward(Feedforward):
    """Torque that moves the plate along the reference, held so that poses at samples are right."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        return dynamics.inverse_dynamics(
            wanted[POSE], wanted[RATES], wanted[ACCELERATIONS], parameters
        )

    def held(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> HeldTorques:
        """Return the torques of equation (hold)."""
        torques = dynamics.torques_along(wanted, parameters)
        means, changes = means_and_changes(np.reshape(torques, (-1, 2, NUM_TORQUES)))
        return HeldTorques(held_torques(means, changes), changes)

    def offset(self, changes: Array, B: Array, timeline: Timeline) -> Array:
        """Return equation (rates), or its counterpart within a hold (core/design.c)."""
        c, error = core(), np.zeros(NUM_STATE)
        given = map(c.at, (numbers(changes), numbers(B, 6, 6), error))
        c.lib.stewart_subtract_offset(timeline.period, timeline.fraction, *given)
        return -error
