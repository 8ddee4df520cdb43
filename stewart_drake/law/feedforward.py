"""The torque that the reference takes, held for a period each: see `law.holds`."""

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


class Held(NamedTuple):
    """Of consecutive holds."""

    torques: Array
    """(h, 6) N m, held; the last is that of the torque to be computed."""
    changes: Array
    """(h + 2, 6) of the torque that the motion takes, over the same holds and a neighbour each."""


class Feedforward(ABC):
    """A kind of feedforward. Instances are immutable."""

    def nodes(self, timeline: Timeline, pending: int) -> Array:
        """Instants, s from now, at which the reference must be known.

        Two per hold: of the torque to be computed, of those in the queue that enter linearly, and
        of one neighbour at each end.
        """
        holds = timeline.holds(-pending - 1, 1)
        return (holds[:, None] + timeline.period * GAUSS_NODES).ravel()

    @abstractmethod
    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        """Torque (6,) N m for pose, rates and accelerations (18,)."""

    def held(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Held:
        """From the reference (2 (h + 2), 18) at `nodes`."""
        torques = [self.at(node, dynamics, parameters) for node in wanted]
        means, changes = means_and_changes(np.reshape(torques, (-1, 2, NUM_TORQUES)))
        return Held(self.from_means(means, changes), changes)

    def from_means(self, means: Array, changes: Array) -> Array:
        """Torques (h, 6) to be held, of means and changes (h + 2, 6): the means."""
        return means[1:-1]

    def offset(self, changes: Array, B: Array, timeline: Timeline) -> Array:
        """Where held torques put pose and rates (12,) at the sample whose error is regulated.

        `changes` are those of `held`, B (6, 6) accelerations per torque.
        """
        return np.zeros(NUM_STATE)


@dataclass(frozen=True)
class NoFeedforward(Feedforward):
    """Nothing: torques enter as they are."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        """Zero."""
        return np.zeros(NUM_TORQUES)

    def held(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Held:
        """Zeros."""
        nothing = np.zeros((len(wanted) // 2, NUM_TORQUES))
        return Held(nothing[1:-1], nothing)


@dataclass(frozen=True)
class EquilibriumFeedforward(Feedforward):
    """What holds the plate still at the pose of the reference."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        """For the pose alone."""
        still = np.zeros(NUM_COORDINATES)
        return dynamics.inverse_dynamics(wanted[POSE], still, still, parameters)


@dataclass(frozen=True)
class InverseDynamicsFeedforward(Feedforward):
    """What moves the plate along the reference, held so that the poses at the samples are right."""

    def at(self, wanted: Array, dynamics: StewartDynamics, parameters: Array) -> Array:
        """For the whole motion."""
        return dynamics.inverse_dynamics(
            wanted[POSE], wanted[RATES], wanted[ACCELERATIONS], parameters
        )

    def from_means(self, means: Array, changes: Array) -> Array:
        """Equation (hold)."""
        return held_torques(means, changes)

    def offset(self, changes: Array, B: Array, timeline: Timeline) -> Array:
        """Equation (rates), or its like within a hold."""
        if timeline.fraction > 0:  # between the second hold's ends
            return state_within_hold(changes[1], B, timeline.period, 1 - timeline.fraction)
        rates = rates_at_samples(changes[:2], B, timeline.period)
        return np.concatenate([np.zeros(NUM_COORDINATES), rates])
