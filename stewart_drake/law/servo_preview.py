"""The law for position servos: crank angles of the reference, sent ahead, see core/servo.h.

Until a command is reached, the servos move to it from the one before (`law.servos.Segment`).
Without T_ff they need an error to produce the torque of the motion. Servos given by their stiffness
hold a setpoint instead, (setpoint) of `law.servos`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from stewart_drake.law.core_law import CompiledLaw
from stewart_drake.law.feedforward import Feedforward, InverseDynamicsFeedforward
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import Observer
from stewart_drake.law.sensing import Measurement, Sensing
from stewart_drake.law.servos import ReportLayout, Stiffness
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array


@dataclass(frozen=True)
class ServoPreview:
    """The law for one machine, made of parts of `law.predictive_lqi.PredictiveLqi`.

    Attributes:
        timeline: clock and delay; `parts` as of the reports.
        sensing: model of the sensor.
        observer: estimates state and parameters, with the reported torques.
        feedforward: the torque T_ff of a command.
        reports: layout of the machine's reports.
        servo: servos given by their stiffness, None for others.
        learned: correction (n, 6) of the angles at instants (n,) of the motion, which begins with
            the first sample, in rad and s; None: none.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    feedforward: Feedforward
    reports: ReportLayout
    servo: Stiffness | None = None
    learned: Callable[[Array], Array] | None = None

    @cached_property
    def preview_times(self) -> Array:
        """Instant (1,) at which the next command is to be reached, s from now."""
        share = 1.0 if self.servo is None else 0.5
        return np.array([self.timeline.eta + share * self.timeline.period])

    def command(self, wanted: Array, parameters: Array) -> Array:
        """Return the command (18,) for pose, rates and accelerations (18,), with parameters (p,).

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        angles = self.plant.mechanism.crank_angles(wanted[POSE])
        rates = self.plant.dynamics.actuation_map(wanted[POSE]).T @ wanted[RATES]
        torque = self.feedforward.at(wanted, self.plant.dynamics, parameters)
        if self.servo is not None:
            moves = isinstance(self.feedforward, InverseDynamicsFeedforward)
            angles = self.servo.setpoint(angles, rates * moves, torque)
        return np.concatenate([angles, rates, torque])

    @cached_property
    def _compiled(self) -> CompiledLaw:
        return CompiledLaw(self)

    def initial_memory(self, command: Array) -> Memory:
        """Return the memory before the first sample, with the command (18,) that was sent last."""
        return self._compiled.start(command)

    def step(
        self, memory: Memory, measurement: Measurement, motion: Motion, report: Array
    ) -> Memory:
        """Compute the command of one sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; its age may be that of an earlier sample.
            motion: to follow. It is evaluated once, at `preview_times`.
            report: as of `reports`, that came with the measurement; NaN for none.

        Returns:
            The new memory; its command (18,) is finite.
        """
        return self._compiled.step(memory, measurement, motion, report)
