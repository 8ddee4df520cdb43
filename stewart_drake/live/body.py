"""A simulated machine under torques that come one by one: its plate and what its sensor reads.

The exact plant goes by DOP853 (docs/theory.md, section 32), without Drake, where the sensor reads
pose and rates and has no faults; all other machines are the plant and the sensor of the diagram.
"""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorStatus

from stewart_drake.dynamics.open_loop import Drive, IntegrationError, integrate
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.diagram import build_machine
from stewart_drake.loop.exact import set_accuracy
from stewart_drake.loop.experiment import Experiment
from stewart_drake.loop.native_loop import LONGEST_STEP, SHARE
from stewart_drake.loop.sensor import white_noise
from stewart_drake.scenario.config import StateSensorConfig
from stewart_drake.scenario.signals import BIAS, POSE
from stewart_drake.scenario.timing import look_time
from stewart_drake.types import Array


class Body(Protocol):
    """A machine at `time` s after its start."""

    time: float

    @property
    def state(self) -> Array:
        """(12,) pose and rates."""
        ...

    def advance(self, time: float, torque: Array) -> Failure | None:
        """On to `time` under a torque (6,) in N m; how the plate left its workspace, or None."""
        ...

    def measurement(self) -> Array:
        """What the sensor reads now: a state (12,) or crank angles (6 N,), NaN what it does not."""
        ...


class NativeBody:
    """The exact plant, by DOP853, and a sensor of pose and rates with white noise."""

    def __init__(self, experiment: Experiment) -> None:
        sc, sensor = experiment.scenario, experiment.scenario.sensor
        assert isinstance(sensor, StateSensorConfig)
        parameters = np.array(sc.plant.parameters)
        self._bias = parameters[BIAS].copy()
        parameters[BIAS] = 0.0  # added to what acts, as in the diagram
        self._dynamics = StewartDynamics(experiment.truth, sc.plant.gravity, parameters)
        self._accuracy = SHARE * sc.plant.accuracy
        self._noise, self._seed = np.array(sensor.noise_std), sensor.seed
        self._period, self._state, self.time = sc.controller.period, experiment.start.copy(), 0.0

    @property
    def state(self) -> Array:
        """See `Body`."""
        return self._state

    def advance(self, time: float, torque: Array) -> Failure | None:
        """See `Body`."""
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
        """See `Body`."""
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
        """See `Body`."""
        return np.array(self._diagram.GetOutputPort("state").Eval(self._simulator.get_context()))

    def advance(self, time: float, torque: Array) -> Failure | None:
        """See `Body`."""
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
        """See `Body`."""
        context = self._simulator.get_context()
        return np.array(self._diagram.GetOutputPort("measurement").Eval(context))


def body_of(experiment: Experiment) -> tuple[Callable[[], Body], str]:
    """What makes the machine of an experiment anew, at its start, and what it goes by."""
    sc = experiment.scenario
    needs_drake = {
        "plant.kind": sc.plant.kind != "exact",
        "sensor.kind": not isinstance(sc.sensor, StateSensorConfig),
        "sensor.faults": bool(sc.sensor.faults),
    }
    field = next((name for name, there in needs_drake.items() if there), None)
    if field is None:
        return lambda: NativeBody(experiment), "DOP853"
    return lambda: DrakeBody(experiment), f"Drake ({field})"
