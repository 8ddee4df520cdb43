"""Torque that the reference takes, held for a period each: see `law.holds`."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.holds import (
    GAUSS_NODES,
    held_torques,
    means_and_changes,
    rates_at_samples,
    state_within_hold,
)
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    NUM_COORDINATES,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.types import Array


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
        """Return equation (rates), or its counterpart within a hold."""
        if timeline.fraction > 0:  # between the second hold's ends
            return state_within_hold(changes[1], B, timeline.period, 1 - timeline.fraction)
        rates = rates_at_samples(changes[:2], B, timeline.period)
        return np.concatenate([np.zeros(NUM_COORDINATES), rates])
