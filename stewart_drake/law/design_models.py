"""Models A, B of the error, for the design of the gain."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from stewart_drake.law.error_model import ContinuousModel, double_integrators, linear_model
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.mechanism.assembly import TorqueMap
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array


class DesignModel(ABC):
    """A kind of model. Instances are immutable."""

    def at(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> ContinuousModel:
        """Return the error model about a state (12,) under a torque (6,), with parameters (p,).

        Raises:
            UnreachablePoseError: the pose is out of reach or singular.
        """
        plant.dynamics.require_reach(state[POSE])
        return self.about(state, torque, parameters, plant)

    @abstractmethod
    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> ContinuousModel:
        """Return the model of `at` for a pose within reach."""


@dataclass(frozen=True)
class PaperModel(DesignModel):
    """Six double integrators behind the paper's torque map.

    Attributes:
        form: of the torque map.
    """

    form: TorqueMap = "virtual_work"

    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> ContinuousModel:
        return double_integrators(plant.dynamics.massless_map(state[POSE], self.form))


@dataclass(frozen=True)
class MultibodyModel(DesignModel):
    """The equations of motion, linearised."""

    def about(
        self, state: Array, torque: Array, parameters: Array, plant: NominalPlant
    ) -> ContinuousModel:
        derivatives = plant.dynamics.derivatives(state[POSE], state[RATES], torque, parameters)
        return linear_model(derivatives.A, derivatives.B)
