"""The law for position servos: crank angles of the reference, sent ahead.

The command computed at t = k dt is reached one period after it arrives, at t + eta + dt. Until then
the servos move to it from the one before (`law.servos.Segment`):

    command = [alpha(r); Jac(r) r'; T_ff],    r the reference at t + eta + dt.

Nothing is fed back across the delay, so that no delay makes the loop unstable. Estimates of an
observer enter T_ff, the torque that the reference takes; without T_ff the servos need an error to
produce it. The torques that acted depend on the servos' measurements, so that the machine reports
them with the measurement.

Servos given by their stiffness hold a setpoint for a period instead of moving to it. Its angles are
(setpoint) of `law.servos` for the middle of that period, r at t + eta + dt / 2: with T_ff they are
compensated for torque and velocity gain, without it they are the angles of the reference.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.feedforward import Feedforward, InverseDynamicsFeedforward
from stewart_drake.law.memory import Counts
from stewart_drake.law.motion import Motion
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import Observer
from stewart_drake.law.sensing import Measurement, Sensing
from stewart_drake.law.servos import Reported, ReportLayout, Stiffness
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
    """Memory of the law, with the names of `law.memory.Memory`."""

    command: Array  # (18,) sent last
    belief: Belief  # of the observer, at the last measurement
    measurement: Array  # (m,) at the last sample, as it came; NaN before the first
    torque: Array  # (6,) of the servos before their limit, in the last report
    in_flight: Array  # (1, 6) the same within the limit
    counts: Counts  # see `law.memory.Counts`
    lag: int  # age of that measurement, periods
    # integral, weights: NaN
    integral: Array
    weights: Array
    samples: int = 0  # number of samples so far


@dataclass(frozen=True)
class ServoPreview:
    """The law for one machine, made of parts of `law.predictive_lqi.PredictiveLqi`.

    Attributes:
        timeline: clock and delay; `parts` as of the reports.
        plant: model of the plant.
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

    def initial_memory(self, command: Array) -> ServoMemory:
        """Return the memory before the first sample, with the command (18,) that was sent last."""
        nothing = np.zeros(NUM_TORQUES)
        return ServoMemory(
            command=command,
            belief=self.observer.start(self.timeline, self.sensing, self.plant),
            measurement=np.full(self.sensing.size, np.nan),
            torque=nothing,
            in_flight=nothing[None],
            counts=Counts(),
            lag=0,
            integral=np.full(NUM_COORDINATES, np.nan),
            weights=np.full(len(WEIGHTS), np.nan),
        )

    @np.errstate(over="ignore", invalid="ignore")  # the result is checked instead
    def step(
        self, memory: ServoMemory, measurement: Measurement, motion: Motion, report: Array
    ) -> ServoMemory:
        """Compute the command of one sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; its age may be that of an earlier sample.
            motion: to follow. It is evaluated once, at `preview_times`.
            report: as of `reports`, that came with the measurement; NaN for none.

        Returns:
            The new memory; its command (18,) is finite.
        """
        lag, belief, reported = memory.lag + 1, memory.belief, None
        age = round(measurement.age / self.timeline.period)
        if np.any(measurement.valid) and 0 <= age < lag:
            reported = self.reports.read(report, lag - age)
            belief, lag = self._observe(belief, replace(measurement, age=0.0), reported), age
        else:
            belief = replace(belief, faults=("measurements_missing",))
        command, cause = self._next(memory, motion(self.preview_times)[0], belief)
        saturated = 0 if reported is None else reported.saturated
        torque = memory.torque if reported is None else reported.asked
        return replace(
            memory,
            command=command,
            belief=belief,
            lag=lag,
            measurement=measurement.values,
            torque=torque,
            in_flight=self.plant.motors.saturate(torque)[None],
            counts=memory.counts.plus(*belief.faults, cause, *["saturated_steps"] * saturated),
            samples=memory.samples + 1,
        )

    def _observe(
        self, belief: Belief, measurement: Measurement, reported: Reported | None
    ) -> Belief:
        """Take a measurement, with the reported torques since the one before.

        Without a report the observer begins anew, from the estimated parameters.
        """
        torques = np.zeros((1, NUM_TORQUES))
        if reported is not None:
            torques = reported.torques
        elif belief.has_state:
            fresh = self.observer.start(self.timeline, self.sensing, self.plant)
            belief = replace(fresh.assuming(belief.parameters), measured=belief.measured)
        return self.observer.observe(belief, measurement, torques, self.sensing, self.plant)

    def _next(self, memory: ServoMemory, wanted: Array, belief: Belief) -> tuple[Array, str | None]:
        """Return the next command (18,); where there is none, the cranks stop, with the cause."""
        last = memory.command
        stay = np.concatenate([last[POSE], np.zeros(NUM_COORDINATES), last[MODEL_TORQUE]])
        if not np.all(np.isfinite(wanted)):
            return stay, "references_missing"
        try:
            command = self.command(wanted, belief.parameters)
        except UnreachablePoseError:
            return stay, "unreachable"
        if not np.all(np.isfinite(command)):
            return stay, "nonfinite_torque"
        if self.learned is not None:
            time = self.timeline.period * memory.samples
            command[POSE] += self.learned(time + self.preview_times)[0]
        if self.servo is not None:
            command[POSE] = self.servo.limited(command[POSE], last[POSE])
        return command, None
