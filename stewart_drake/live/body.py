"""A simulated machine under torques that come one by one: its plate and what its sensor reads.

The exact plant goes by DOP853 (docs/theory.md, section 32), without Drake, where the sensor reads
pose and rates and has no faults; all other machines are the plant and the sensor of the diagram.
"""

from collections.abc import Callable
from typing import Any, Final, Protocol

import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorStatus

from stewart_drake.dynamics.open_loop import Drive, IntegrationError, integrate
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.bulk import LONGEST_STEP, SHARE
from stewart_drake.loop.diagram import build_machine
from stewart_drake.loop.exact import set_accuracy
from stewart_drake.loop.preparation import Experiment
from stewart_drake.loop.sensor import white_noise
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.signals import BIAS, POSE
from stewart_drake.scenario.timing import look_time
from stewart_drake.types import Array

_WITHOUT_DRAKE: Final[Accepted] = {
    "plant.kind": "exact",
    "sensor.kind": "state",
    "sensor.faults": [],
}
"""Values of fields that `NativeBody` has."""


class Body(Protocol):
    """A machine at `time` s after its start."""

    time: float

    @property
    def state(self) -> Array:
        """(12,) pose and rates."""
        ...

    def advance(self, time: float, torque: Array) -> Failure | None:
        """Advance to `time` under a torque (6,), N m; return how the plate left, or None."""
        ...

    def measurement(self) -> Array:
        """Return what the sensor reads: a state (12,) or crank angles (6 N,), NaN where missing."""
        ...


class NativeBody:
    """The exact plant, by DOP853, and a sensor of pose and rates with white noise."""

    def __init__(self, experiment: Experiment) -> None:
        sc, sensor = experiment.scenario, experiment.scenario.sensor
        assert sensor.kind == "state"
        parameters = np.array(sc.plant.parameters)
        self._bias = parameters[BIAS].copy()
        parameters[BIAS] = 0.0  # added to what acts, as in the diagram
        self._dynamics = StewartDynamics(experiment.truth, sc.plant.gravity, parameters)
        self._accuracy = SHARE * sc.plant.accuracy
        self._noise, self._seed = np.array(sensor.noise_std), sensor.seed
        self._period, self._state, self.time = sc.controller.period, experiment.start.copy(), 0.0

    @property
    def state(self) -> Array:
        return self._state

    def advance(self, time: float, torque: Array) -> Failure | None:
        if time <= self.time:
            return None
        drives, span = (Drive(torque + self._bias),), (time - self.time,)
        try:
            course = integrate(
                self._dynamics, self._state, drives, span, self._accuracy, LONGEST_STEP
            )
        except IntegrationError as error:
            return Failure(self.time, None, np.nan, str(error))
        self._state, began, self.time = course.final, self.time, self.time + course.end
        left = course.failure
        return None if left is None else left._replace(time=began + left.time)

    def measurement(self) -> Array:
        if not self._noise.any():
            return self._state
        return self._state + self._noise * white_noise(self._seed, round(self.time / self._period))


class DrakeBody:
    """Plant and sensor of the scenario's diagram."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, self.time = experiment, 0.0
        self._bias = np.array(experiment.scenario.plant.torque_bias)
        self._diagram: Any = build_machine(experiment)
        context = self._diagram.CreateDefaultContext()
        plant: Any = self._diagram.GetSubsystemByName("plant")
        plant.set_state(plant.GetMyMutableContextFromRoot(context), experiment.start)
        self._plant = plant
        self._torque = self._diagram.GetInputPort("torque")
        self._torque.FixValue(context, self._bias)
        self._simulator = Simulator(self._diagram, context)
        if experiment.scenario.plant.kind == "exact":
            set_accuracy(self._simulator, experiment.scenario.plant.accuracy)
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
        except RuntimeError as error:  # of Drake's solver, where constraints contradict dynamics
            return Failure(context.get_time(), None, np.nan, " ".join(str(error).split()))
        self.time = time
        if outcome.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
            self.time = context.get_time()
            return self._failure()
        return None

    def _failure(self) -> Failure:
        context = self._simulator.get_context()
        cranks = None
        if self._plant.HasOutputPort("crank_angles"):
            own = self._plant.GetMyContextFromRoot(context)
            cranks = self._plant.GetOutputPort("crank_angles").Eval(own)
        found = diagnose(self._experiment.truth, self.time, self.state[POSE], cranks)
        assert found is not None, "the simulation ended inside the workspace"
        return found

    def measurement(self) -> Array:
        context = self._simulator.get_context()
        return np.array(self._diagram.GetOutputPort("measurement").Eval(context))


def body_of(experiment: Experiment) -> tuple[Callable[[], Body], str]:
    """Return what makes the machine of an experiment, and the name of its integrator."""
    found = differing(experiment.scenario, _WITHOUT_DRAKE)
    if found is None:
        return lambda: NativeBody(experiment), "DOP853"
    return lambda: DrakeBody(experiment), f"Drake ({found.field})"
