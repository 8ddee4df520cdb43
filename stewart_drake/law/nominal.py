"""The plant as the controller knows it: equations, how finely they are integrated, motors."""

from dataclasses import dataclass

import numpy as np

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.motors import TorqueLimit
from stewart_drake.law.timeline import TorqueSchedule
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

VIGOROUS = 2


@dataclass(frozen=True)
class NominalPlant:
    """What every part of the law predicts and designs with.

    Attributes:
        dynamics: its parameters are what is known beforehand.
        substeps: Runge-Kutta steps per torque.
        gentle_torque: N m; where a torque exceeds it, VIGOROUS times as many.
        motors: that the torques go through.
    """

    dynamics: StewartDynamics
    substeps: int
    gentle_torque: float
    motors: TorqueLimit

    @property
    def mechanism(self) -> Mechanism:
        """Its geometry."""
        return self.dynamics.mechanism

    def substeps_for(self, torques: Array) -> int:
        """Runge-Kutta steps per torque for a prediction through these torques (n, 6)."""
        vigorous = np.abs(torques).max(initial=0.0) > self.gentle_torque
        return self.substeps * (VIGOROUS if vigorous else 1)

    def predict(
        self, state: Array, schedule: TorqueSchedule, parameters: Array | None = None
    ) -> Array:
        """States (n, 12) after each of n torques, from a state (12,); None is as known before."""
        torques, durations = schedule
        substeps = self.substeps_for(torques)
        return self.dynamics.predict(state, torques, durations, substeps, parameters)
