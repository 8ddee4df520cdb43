"""The simulated part of a machine: link, motors, plant and sensor. Times are ns of its clock.

The exact plant is integrated by DOP853 (docs/theory.md, section 32), without Drake, if the sensor
measures pose and rates without faults. Any other machine is the plant and sensor of the diagram.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from pydrake.systems.analysis import SimulatorStatus

from stewart_drake.core.link import Link
from stewart_drake.dynamics.open_loop import IntegrationError, NativePlant
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.protocol import MISSING, MOST_HISTORY, NEVER, SECOND, Refusal
from stewart_drake.loop.bulk import SHARE
from stewart_drake.loop.diagram import build_machine
from stewart_drake.loop.peer import code_bits
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sensor import white_noise
from stewart_drake.loop.servos import commands_in_flight, compose_servo_law, position_servo
from stewart_drake.loop.simulation import failure_of, make_simulator, solver_failure
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.link import forward_times, return_times, sensor_times, torque_delays
from stewart_drake.scenario.signals import NUM_CONSTANTS, NUM_LEGS, NUM_TORQUES, POSE
from stewart_drake.scenario.timing import look_time
from stewart_drake.types import Array

_TIMES: Final = 1 << 17
"""Number of transit times and losses each way; then they repeat."""
MOST_WAITING: Final = 1 << 12
"""Largest number of torques that wait; a plan that exceeds it is refused."""
_REFUSALS: Final = (None, Refusal.MALFORMED, Refusal.LATE)
_WITHOUT_DRAKE: Final[Accepted] = {
    "plant.kind": "exact",
    "sensor.kind": "state",
    "sensor.faults": [],
}
"""Values of the fields that `NativeBody` supports."""


# ---------------------------------------------------------------- link


class LinkTimes:
    """Transit times of a scenario by the number of a datagram, the same as in its simulation."""

    def __init__(self, scenario: Scenario) -> None:
        self._ways = {
            "forward": forward_times(scenario, _TIMES),
            "back": return_times(scenario, _TIMES),
            "sensor": sensor_times(scenario, _TIMES),
        }

    def of(self, way: str, number: int) -> int | None:
        """Return a time on one of the ways, ns, or None for a lost datagram."""
        seconds = self._ways[way][number % _TIMES]
        return round(seconds * SECOND) if np.isfinite(seconds) else None


# ---------------------------------------------------------------- motors


class Plan(NamedTuple):
    sequence: int  # sequence of the datagram; 0 for torques in flight at the begin
    sampled: int  # time of the sample that they were computed for
    sample: int  # number of that sample, from the begin on
    playout: int  # time at which the first row acts
    torques: Array  # torques (n, 6), N m


class Motors:
    """Motors behind a link of core/link.h.

    In a play-out buffer, row i of a plan is for the period from playout + i dt on. On a wire only
    the first row counts, and acts when it arrives.

    Args:
        holds: whether a dry buffer holds the last torque; otherwise it outputs zero.
        delay_of: delay of the torque of sample k on a wire; None for a buffer.
        cranks: whether rows are setpoints of servos, in rad, which are never zero for lack of one.
    """

    def __init__(
        self,
        limit: float,
        period: int,
        holds: bool = True,
        delay_of: Callable[[int], int] | None = None,
        cranks: bool = False,
    ) -> None:
        self.holds, self.is_wire, self._delay_of = holds or cranks, delay_of is not None, delay_of
        self.cranks = cranks
        self._link = Link(
            NUM_TORQUES,
            MOST_WAITING,
            period,
            is_wire=self.is_wire,
            hold_when_dry=self.holds,
            history=MOST_HISTORY,
            limit=math.inf if cranks else limit,
        )
        self._memory, self._begun = self._link.start(), False

    @classmethod
    def of(cls, experiment: Experiment) -> "Motors":
        """Return the motors of a scenario: a buffer over a network, otherwise a wire."""
        sc, limit = experiment.scenario, experiment.torque_limit
        period, cranks = round(sc.controller.period * SECOND), sc.controller.command == "cranks"
        if sc.link.kind == "network":
            return cls(limit, period, sc.link.dry == "hold", cranks=cranks)
        delays = torque_delays(replace(sc, duration=_TIMES * sc.controller.period))
        last = len(delays) - 1
        return cls(
            *(limit, period, True, lambda k: round(delays[min(k, last)] * SECOND)), cranks=cranks
        )

    @property
    def torque(self) -> Array:
        """Torque (6,) that acts, N m, or setpoint, rad."""
        return self._link.acted(self._memory)[0, 1:].copy()

    @property
    def acted(self) -> list[tuple[int, Array]]:
        """Times at which the last torques began to act, and these, the newest first."""
        rows = self._link.acted(self._memory)[: self._number("acted")]
        return [(int(row[0]), row[1:].copy()) for row in rows]

    @property
    def played(self) -> int:
        """Number of periods with a torque of a plan."""
        return self._number("played")

    @property
    def dry(self) -> int:
        """Number of periods without one."""
        return self._number("dry")

    @property
    def fed(self) -> bool:
        """Whether the torque that acts is from a plan."""
        return self._number("fed") > 0

    def _number(self, name: str) -> int:
        return int(self._link.number(self._memory, name))

    def begin(self, queue: Plan) -> None:
        self._begun = True
        self._link.preload(self._memory, queue.playout, queue.torques)

    def take(self, plan: Plan, time: int, begin: int = 0) -> Refusal | None:
        """Take the rows of a plan from `begin` on; return why it is refused, or None.

        The plan has arrived at `time`.
        """
        first, since = plan.playout, max(time, begin)
        if self._delay_of is not None:
            first = max(time, plan.sampled + self._delay_of(plan.sample))
            if first < begin:
                return Refusal.LATE
        return _REFUSALS[self._link.take(self._memory, since, plan.sequence, first, plan.torques)]

    def dry_for(self, time: int) -> int:
        """Return for how long the buffer has been dry at a change of the torque, ns."""
        return time - self._number("supplied")

    @property
    def next_change(self) -> int:
        """Time of the next call of `change`, or NEVER."""
        there = self._link.next_change(self._memory) if self._begun else math.inf
        return NEVER if math.isinf(there) else int(there)

    def change(self, time: int) -> None:
        """Change the torque at `next_change`."""
        self._link.change(self._memory, time)

    def safe(self, time: int, holds: bool, keeps: bool = False) -> None:
        """Hold the torque, or output zero, until the next row; drop what waits unless `keeps`."""
        self._link.reset(self._memory, time, holds or self.cranks, keeps)


def first_rows(experiment: Experiment) -> Array:
    """Return the torques or setpoints (n, 6) in flight at the begin of a run."""
    sc = experiment.scenario
    if sc.controller.command == "torque":
        return experiment.torques_in_flight(sc.true_delay)
    law = compose_servo_law(experiment)
    first, flying = commands_in_flight(experiment, law, sc.true_delay)
    return (flying if len(flying) else first[None])[:, POSE]


# ---------------------------------------------------------------- plant and sensor


class Body(Protocol):
    """Plant and sensor, `time` s after the start."""

    time: float

    @property
    def state(self) -> Array:
        """Pose and rates (12,)."""
        ...

    def advance(self, time: float, torque: Array) -> Failure | None:
        """Advance to `time` s under a torque (6,), N m; return why the plate left, or None.

        Servos get a setpoint (6,) in rad instead.
        """
        ...

    def measurement(self) -> Array:
        """Return a state (12,) or crank angles (6 N,), NaN for missing values."""
        ...


class NativeBody:
    """The exact plant by DOP853, also under position servos, and a sensor with white noise."""

    def __init__(self, experiment: Experiment) -> None:
        sc, sensor = experiment.scenario, experiment.scenario.sensor
        assert sensor.kind == "state"
        self._bias, self._push = np.array(sc.plant.torque_bias), sc.plant.push
        # The bias is added to the torque that acts, as in the diagram.
        self._free = experiment.true_dynamics(biased=False)
        pushed = np.append(self._free.plant_parameters[:NUM_CONSTANTS], self._push.wrench)
        self._pushed = StewartDynamics(experiment.truth, sc.plant.gravity, pushed)
        self._accuracy = SHARE * sc.plant.accuracy
        self._noise, self._seed = np.array(sensor.noise_std), sensor.seed
        self._period, self.state, self.time = sc.controller.period, experiment.start.copy(), 0.0
        cranks = sc.controller.command == "cranks"
        self._servo = position_servo(experiment).compiled if cranks else None

    def advance(self, time: float, torque: Array) -> Failure | None:
        push = self._push
        for change in (push.start, push.end):  # integrate up to each
            if self.time < change < time and (failure := self.advance(change, torque)):
                return failure
        if time <= self.time:
            return None
        dynamics = self._pushed if any(push.at(self.time)) else self._free
        try:
            command = torque if self._servo is not None else torque + self._bias
            until = np.array([time - self.time])
            plant = NativePlant(dynamics, self.state, until, self._accuracy)
            left = plant.failure(plant.hold([0.0], [command], self._servo))
        except IntegrationError as error:
            return Failure(self.time, None, np.nan, str(error))
        began = self.time
        self.state, self.time = plant.final, time if left is None else began + plant.run.time
        return None if left is None else left._replace(time=began + left.time)

    def measurement(self) -> Array:
        if not self._noise.any():
            return self.state
        return self.state + self._noise * white_noise(self._seed, round(self.time / self._period))


class DrakeBody:
    """Plant and sensor of the scenario's diagram."""

    def __init__(self, experiment: Experiment) -> None:
        self.time, self._bias = 0.0, np.array(experiment.scenario.plant.torque_bias)
        self._diagram = build_machine(experiment)
        self._simulator = make_simulator(self._diagram)
        self._torque = self._diagram.GetInputPort("torque")
        self._torque.FixValue(self._simulator.get_mutable_context(), self._bias)
        self._simulator.Initialize()

    @property
    def state(self) -> Array:
        return np.array(self._diagram.GetOutputPort("state").Eval(self._simulator.get_context()))

    def advance(self, time: float, torque: Array) -> Failure | None:
        context = self._simulator.get_mutable_context()
        if time <= self.time:
            return None
        self._torque.FixValue(context, torque + self._bias)
        try:
            outcome = self._simulator.AdvanceTo(look_time(time))
        except RuntimeError as error:
            return solver_failure(context, error)
        self.time = time
        if outcome.reason() != SimulatorStatus.ReturnReason.kReachedTerminationCondition:
            return None
        self.time = context.get_time()
        return failure_of(self._diagram, context)

    def measurement(self) -> Array:
        context = self._simulator.get_context()
        return np.array(self._diagram.GetOutputPort("measurement").Eval(context))


def body_of(experiment: Experiment) -> tuple[Callable[[], Body], str]:
    """Return a factory of the plant and sensor of an experiment, and the integrator's name."""
    found = differing(experiment.scenario, _WITHOUT_DRAKE)
    if found is None:
        return lambda: NativeBody(experiment), "DOP853"
    if experiment.scenario.controller.command == "cranks":
        raise ConfigError(found.problem("for a machine with servos"))
    return lambda: DrakeBody(experiment), f"Drake because of {found.field}"


class MeasurementFields:
    """Converts measurements to the fields of a `MachineMessage`."""

    def __init__(self, scenario: Scenario) -> None:
        self._bits = code_bits(scenario.sensor)
        self._zeros: Array = np.full(NUM_LEGS, np.nan)

    def of(self, values: Array) -> dict[str, Any]:
        """Return the fields of a measurement.

        Codes of the simulated encoders are whole quanta apart: the first one defines code 0.
        """
        if not self._bits:
            return {"state": values}
        quantum = 2 * np.pi / 2**self._bits
        angles = values.reshape(-1, NUM_LEGS)
        for leg in np.flatnonzero(np.isnan(self._zeros)):
            there = angles[np.isfinite(angles[:, leg]), leg]
            if len(there):
                self._zeros[leg] = there[0] - quantum * np.round(there[0] / quantum)
        zeros = np.nan_to_num(self._zeros)
        codes = np.nan_to_num(np.round((angles - zeros) / quantum), nan=MISSING)
        codes = np.clip(codes, MISSING, -MISSING - 1).astype(np.int32)
        return {"codes": codes, "bits": self._bits, "zeros": zeros}
