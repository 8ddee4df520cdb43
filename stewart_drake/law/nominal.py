"""Model of the plant in the controller: equations of motion, integration steps, torque limit."""

import math
from dataclasses import dataclass

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

FINE_SUBSTEP_FACTOR = 2


@dataclass(frozen=True)
class TorqueLimit:
    """Limit of each motor in N m, infinite for none. The loop applies it after the law."""

    limit: float = math.inf

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

    @property
    def mechanism(self) -> Mechanism:
        """Geometry of the machine."""
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
