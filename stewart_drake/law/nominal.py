"""Model of the plant in the controller, and models of the error for the design of the gain."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import get_args

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.arguments import of_kind, one_of, positive, whole
from stewart_drake.law.delay_model import LinearModel, double_integrators, linear_model
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.mechanism.assembly import TorqueMap
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array

FINE_SUBSTEP_FACTOR = 2


@dataclass(frozen=True)
class TorqueLimit:
    """Limit of each motor in N m, infinite for none. The loop applies it after the law."""

    limit: float = math.inf

    def __post_init__(self) -> None:
        positive("limit", self.limit, infinite=True)

    def saturate(self, torques: Array) -> Array:
        """Return torques (..., 6) within the limit."""
        return np.clip(torques, -self.limit, self.limit)

    def reached(self, torques: Array) -> bool:
        """Return whether any of the torques (..., 6) is at the limit or beyond."""
        return bool(np.any(np.abs(torques) >= self.limit))


@dataclass(frozen=True)
class NominalPlant:
    """Plant model for prediction and design.

    Attributes:
        dynamics: with the parameters that are known beforehand.
        substeps: Runge-Kutta steps per torque.
        coarse_torque_limit: N m; above it FINE_SUBSTEP_FACTOR times as many steps are taken.
        motors: limit that the torques pass.
    """

    dynamics: StewartDynamics
    substeps: int
    coarse_torque_limit: float
    motors: TorqueLimit

    def __post_init__(self) -> None:
        of_kind("dynamics", self.dynamics, StewartDynamics)
        whole("substeps", self.substeps, 1)
        positive("coarse_torque_limit", self.coarse_torque_limit, infinite=True)

    @property
    def mechanism(self) -> Mechanism:
        return self.dynamics.mechanism

    def substeps_for(self, torques: Array) -> int:
        """Return the Runge-Kutta steps per torque for a prediction with torques (n, 6)."""
        fine = np.abs(torques).max(initial=0.0) > self.coarse_torque_limit
        return self.substeps * (FINE_SUBSTEP_FACTOR if fine else 1)

    def predict(
        self, state: Array, schedule: TorqueSchedule, parameters: Array | None = None
    ) -> Array:
        """Return the states (n, 12) after each of n torques; None: the known parameters."""
        torques, durations = schedule
        substeps = self.substeps_for(torques)
        return self.dynamics.predict(state, torques, durations, substeps, parameters)


class DesignModel(ABC):
    """A kind of model. Instances are immutable."""

    def at(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> LinearModel:
        """Return the error model about a state (12,) under a torque (6,), with parameters (p,).

        Raises:
            UnreachablePoseError: the pose is out of reach or singular.
        """
        plant.dynamics.require_reach(state[POSE])
        return self.about(state, torque, parameters, plant)

    @abstractmethod
    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> LinearModel:
        """Return the model of `at` for a pose within reach."""


@dataclass(frozen=True)
class PaperModel(DesignModel):
    """Six double integrators behind the paper's torque map.

    Attributes:
        form: of the torque map.
    """

    form: TorqueMap = "virtual_work"

    def __post_init__(self) -> None:
        one_of("form", self.form, get_args(TorqueMap))

    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> LinearModel:
        return double_integrators(plant.dynamics.massless_map(state[POSE], self.form))


@dataclass(frozen=True)
class MultibodyModel(DesignModel):
    """The equations of motion, linearised."""

    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> LinearModel:
        derivatives = plant.dynamics.derivatives(state[POSE], state[RATES], torque, parameters)
        return linear_model(derivatives.A, derivatives.B)
