"""The law for position servos: crank angles of the reference, sent ahead.

The command computed at t = k dt is reached one period after it arrives, at t + eta + dt, and until
then the servos move to it from the one before (`law.servos.Segment`):

    command = [alpha(r); Jac(r) r'; T_ff],    r the reference at t + eta + dt.

Nothing is fed back across the delay, so that no delay makes the loop unstable. What an observer
finds of the machine goes into T_ff, the torque that the reference takes, without which the servos
need an error to put it out. An observer needs the torques that acted; here these depend on what the
servos saw, and the machine reports them with the measurement.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.feedforward import Feedforward
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import Observer
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.servos import Reported, ReportLayout
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import (
    MODEL_TORQUE,
    NUM_COORDINATES,
    NUM_TORQUES,
    POSE,
    RATES,
    WEIGHTS,
)
from stewart_drake.types import Array


@dataclass(frozen=True)
class ServoMemory:
    """What the law carries from one sample to the next, in the words of `law.memory.Memory`.

    Attributes:
        command: (18,) sent last.
        belief: of the observer, at the last measurement.
        behind: periods since that was taken.
        measurement: (m,) at the last sample, as it came; NaN before the first.
        torque: (6,) that the servos asked for when they reported last.
        in_flight: (1, 6) what their limit let through of it.
        counts: see `law.memory.Counts`.
        integral, weights: NaN: there are none.
    """

    command: Array
    belief: Belief
    measurement: Array
    torque: Array
    in_flight: Array
    counts: Counts
    behind: int
    integral: Array
    weights: Array


@dataclass(frozen=True)
class ServoPreview:
    """The law for one machine, made of parts of `law.predictive_lqi.PredictiveLqi`.

    Attributes:
        timeline: clock and delay; parts as of the reports.
        plant: the machine as it is known.
        sensing: what is measured.
        observer: what it makes of measurements and of the torques that are reported.
        feedforward: the torque T_ff that goes with the angles.
        reports: how the machine tells what acted.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    feedforward: Feedforward
    reports: ReportLayout

    @cached_property
    def preview_times(self) -> Array:
        """(1,) s from now, when the next command is to be reached."""
        return np.array([self.timeline.eta + self.timeline.period])

    def command(self, wanted: Array, parameters: Array) -> Array:
        """(18,) for pose, rates and accelerations (18,), with parameters (p,) of the plant.

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        angles = self.plant.mechanism.crank_angles(wanted[POSE])
        rates = self.plant.dynamics.actuation_map(wanted[POSE]).T @ wanted[RATES]
        torque = self.feedforward.at(wanted, self.plant.dynamics, parameters)
        return np.concatenate([angles, rates, torque])

    def initial_memory(self, command: Array) -> ServoMemory:
        """Before the first sample, with a command (18,) for the one that was sent last."""
        nothing = np.zeros(NUM_TORQUES)
        return ServoMemory(
            command=command,
            belief=self.observer.start(self.timeline, self.sensing, self.plant),
            measurement=np.full(self.sensing.size, np.nan),
            torque=nothing,
            in_flight=nothing[None],
            counts=Counts(),
            behind=0,
            integral=np.full(NUM_COORDINATES, np.nan),
            weights=np.full(len(WEIGHTS), np.nan),
        )

    @np.errstate(over="ignore", invalid="ignore")  # its outcome is checked and counted instead
    def step(
        self, memory: ServoMemory, measurement: Measurement, motion: Motion, report: Array
    ) -> ServoMemory:
        """One sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; it may be of an earlier sample, and says so by its age.
            motion: to follow. It is asked once, for `preview_times`.
            report: as of `reports`, that came with the measurement; NaN for none.

        Returns:
            The new memory; its command (18,) is finite.
        """
        behind, belief, said = memory.behind + 1, memory.belief, None
        if np.any(measurement.valid):
            age = round(measurement.age / self.timeline.period)
            said = self.reports.read(report, behind - age)
            belief, behind = self._observed(belief, replace(measurement, age=0.0), said), age
        else:
            belief = replace(belief, faults=("measurements_missing",))
        command, trouble = self._ahead(memory.command, motion(self.preview_times)[0], belief)
        saturated = 0 if said is None else said.saturated
        asked = memory.torque if said is None else said.asked
        return replace(
            memory,
            command=command,
            belief=belief,
            behind=behind,
            measurement=measurement.values,
            torque=asked,
            in_flight=self.plant.motors.saturate(asked)[None],
            counts=memory.counts.plus(*belief.faults, trouble, *["saturated_steps"] * saturated),
        )

    def _observed(self, belief: Belief, measurement: Measurement, said: Reported | None) -> Belief:
        """After a measurement, of which the report tells what acted since the one before.

        Where that got lost too, the observer begins anew, from the parameters that it had found.
        """
        torques = np.zeros((1, NUM_TORQUES))
        if said is not None:
            torques = said.torques
        elif belief.has_state:
            fresh = self.observer.start(self.timeline, self.sensing, self.plant)
            belief = replace(fresh.assuming(belief.parameters), measured=belief.measured)
        return self.observer.observe(belief, measurement, torques, self.sensing, self.plant)

    def _ahead(self, last: Array, wanted: Array, belief: Belief) -> tuple[Array, str | None]:
        """The next command (18,), and what went wrong: then the cranks stop where they are."""
        stay = np.concatenate([last[POSE], np.zeros(NUM_COORDINATES), last[MODEL_TORQUE]])
        try:
            command = self.command(wanted, belief.parameters)
        except UnreachablePoseError:
            return stay, "unreachable"
        if not np.all(np.isfinite(command)):
            return stay, "nonfinite_torque"
        return command, None
