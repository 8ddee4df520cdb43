"""The exact plant: loops closed in closed form, twelve continuous states."""
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"
# A Drake class template over scalar types has no static type.

import math
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, TypedDict, Unpack

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.common.value import Value
from pydrake.systems.analysis import ApplySimulatorConfig, ExtractSimulatorConfig, Simulator
from pydrake.systems.framework import (
    BasicVector_,
    EventStatus,
    LeafSystem_,
    PublishEvent,
    ValueProducer,
    WitnessFunctionDirection,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, Limits, Workspace
from stewart_drake.files.arguments import fixed, of_kind
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.sampling import weak
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.scenario.config import PlantConfig
from stewart_drake.scenario.signals import (
    CONSTANTS,
    NUM_STATE,
    NUM_TORQUES,
    PLANT_PARAMETERS,
    POSE,
    RATES,
    WRENCH,
)
from stewart_drake.scenario.timing import METRIC_PERIOD
from stewart_drake.types import ArrayLike


class Loads(TypedDict, total=False):
    """Fields of `PlantConfig` that `set_parameters` of every plant accepts."""

    payload_mass: float  # kg
    payload_position: ArrayLike  # (3,) m, in the plate's frame, from its COM
    joint_damping: float  # N m s/rad
    coulomb_friction: float  # N m
    coulomb_speed: float  # rad/s


def checked_loads(loads: Loads) -> PlantConfig:
    """Return the checked changes of a plant's parameters."""
    for name in loads:
        if name not in Loads.__annotations__:
            expected = ", ".join(("plate_mass", *Loads.__annotations__))
            raise ConfigError(f"parameter: got {name!r}; expected {expected}")
    try:
        return PlantConfig(**loads)
    except ConfigError as error:
        raise ConfigError(str(error).replace("PlantConfig: ", "", 1)) from None


def plate_of_mass(mechanism: Mechanism, mass: float) -> Body:
    """Return the plate with another mass in kg and the same moments of inertia."""
    plate = replace(mechanism.plate, mass=float(fixed("plate_mass", mass, ())))
    if (problem := plate.problem("plate")) is not None:
        raise ConfigError(problem)
    return plate


# Given the module, Drake does not look for it in the sources of all callers, for 0.25 s.
@TemplateSystem.define("ExactPlant_", (float, AutoDiffXd), scope=sys.modules[__name__])
def ExactPlant_(T):
    """Class template of `ExactPlant` over float and AutoDiffXd."""

    class Impl(LeafSystem_[T]):
        """A mechanism's plate under motor torques, loops closed exactly.

        Dynamics:  d[pose; rates]/dt = [rates; accelerations(pose, rates, torque)], with the input
                   `wrench` added to that of parameter 0.
        Witness:   the margin of its limits, of a machine the least of `dynamics.workspace.margin`;
                   the simulation ends where it passes zero: a leg at a dead centre, a parallel
                   singularity, a pitch of 85 degrees.

        | port | direction | size | unit | rate |
        | --- | --- | --- | --- | --- |
        | torque | input | 6 | N m | continuous |
        | wrench | input | 6 | N m, N, in W at the plate's COM | continuous, only if asked for |
        | state | output | 12 | rad, m, rad/s, m/s | continuous |

        | numeric parameter | size | contents |
        | --- | --- | --- |
        | 0 | 22 | `scenario.signals.PLANT_PARAMETERS`: friction, payload, torque bias and so on |
        | 1 | 4 | mass of the plate, kg, and its moments of inertia, kg m^2 |

        In a diagram of your own, call `set_accuracy` on its simulator: without an accuracy in the
        context Drake stops with an error where the plate leaves its workspace. With AutoDiffXd,
        derivatives by state, inputs and parameter 0 are exact and end at first order.

        Args:
            dynamics: equations of motion, with gravity and the default parameters.
            initial_state: (12,) default of the continuous state; at home and at rest if None.
            wrench: whether there is an input for a wrench on the plate; unconnected it is zero.
            limits: limits of the plate's motion; its machine's workspace if None.
        """

        def _construct(
            self,
            dynamics: StewartDynamics,
            initial_state: ArrayLike | None = None,
            wrench: bool = False,
            limits: Limits | None = None,
            converter=None,
        ) -> None:
            super().__init__(converter=converter)
            of_kind("dynamics", dynamics, StewartDynamics)
            self.dynamics = dynamics
            self.limits = Workspace(dynamics.mechanism) if limits is None else limits
            self._initial = np.concatenate([dynamics.mechanism.home, np.zeros(6)])
            if initial_state is not None:
                self._initial = fixed("initial_state", initial_state, (NUM_STATE,))
            default = BasicVector_[T]([T(value) for value in self._initial])
            state = self.DeclareContinuousState(default, 6, 6, 0)
            self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
            # Only if needed: `HasValue` of an input costs a tenth of the derivatives.
            self._wrench = self.DeclareVectorInputPort("wrench", 6) if wrench else None
            self.DeclareStateOutputPort("state", state)
            plate = dynamics.mechanism.plate
            for values in (dynamics.plant_parameters, [plate.mass, *plate.inertia]):
                self.DeclareNumericParameter(BasicVector_[T]([T(value) for value in values]))
            self._dynamics = self.DeclareCacheEntry(
                "dynamics",
                ValueProducer(allocate=lambda: Value[object](), calc=weak(self._calc_dynamics)),
                {self.all_parameters_ticket()},
            )
            if T is float:
                self._witness = self.MakeWitnessFunction(
                    "workspace margin",
                    WitnessFunctionDirection.kPositiveThenNonPositive,
                    weak(self.margin),
                    PublishEvent(system_callback=weak(self._leave)),
                )

        def _construct_copy(self, other, converter=None) -> None:
            wrench = other._wrench is not None
            Impl._construct(
                self, other.dynamics, other._initial, wrench, other.limits, converter=converter
            )

        def DoCalcTimeDerivatives(self, context, derivatives) -> None:
            x = context.get_continuous_state_vector().CopyToVector()
            torque, dynamics = self._torque.Eval(context), self._dynamics.Eval(context)
            port: Any = self._wrench
            parameters: Any = None  # those of the calculator
            pushed = port is not None and port.HasValue(context)
            if pushed or T is not float:
                parameters = context.get_numeric_parameter(0).CopyToVector()
            if pushed:
                parameters[WRENCH] += port.Eval(context)
            if T is float:
                change = dynamics.change(x, torque, parameters)
                # The integrator would shorten its steps for ever. Each acceleration needs all.
                if not math.isfinite(change[-1]) and not np.isfinite(torque).all():
                    raise ValueError(f"torque: got {torque.tolist()}; expected finite numbers, N m")
            else:
                change = self._with_gradient(dynamics, x, torque, parameters)
            derivatives.SetFromVector(change)

        def _calc_dynamics(self, context, result) -> None:
            """Make the calculator of the context's parameters; the default one where they agree."""
            parameters, plate = (context.get_numeric_parameter(i).CopyToVector() for i in (0, 1))
            if T is not float:
                if ExtractGradient(plate).any():
                    raise ValueError(
                        "parameter 1: got derivatives by mass or inertia of the plate; expected "
                        "those by parameter 0, such as payload_mass"
                    )
                parameters, plate = ExtractValue(parameters).ravel(), ExtractValue(plate).ravel()
            d, body = self.dynamics, self.dynamics.mechanism.plate
            same = np.array_equal(plate, [body.mass, *body.inertia])
            if T is not float or not same or not np.array_equal(parameters, d.plant_parameters):
                plate = body if same else replace(body, mass=plate[0], inertia=plate[1:])
                machine = d.mechanism if same else replace(d.mechanism, plate=plate)
                d = type(d)(machine, d.gravity, parameters, PLANT_PARAMETERS)
            result.set_value(d)

        @staticmethod
        def _with_gradient(d, x, torque, parameters):
            """Return d(x_dot) = A dx + B dT + G dp."""
            state, tau, values = (ExtractValue(part).ravel() for part in (x, torque, parameters))
            at = d.derivatives(state[POSE], state[RATES], tau, values)
            gradient = np.hstack(at) @ ExtractGradient(np.concatenate([x, torque, parameters]))
            return InitializeAutoDiff(d.change(state, tau, values), gradient).ravel()

        def set_state(self, context, state) -> None:
            """Put the plate, in this system's context, into [pose; rates] (12,)."""
            context.SetContinuousState(state)

        def set_parameters(self, context, *, plate_mass=None, **loads: Unpack[Loads]) -> None:
            """Change the parameters in its context as `StewartPlatform.SetParameters` does."""
            values = checked_loads(loads).parameters
            if plate_mass is not None:
                mass = plate_of_mass(self.dynamics.mechanism, plate_mass).mass
                context.get_mutable_numeric_parameter(1).SetAtIndex(0, mass)
            vector = context.get_mutable_numeric_parameter(0)
            for i, name in enumerate(CONSTANTS):
                if name.startswith(tuple(loads)):
                    vector.SetAtIndex(i, values[i])

        def margin(self, context) -> float:
            """Return a margin, positive inside the limits."""
            return self.limits.margin(context.get_time(), self._pose(context))

        def diagnose(self, context) -> Failure | None:
            return self.limits.diagnose(context.get_time(), self._pose(context))

        def _pose(self, context):
            return context.get_continuous_state_vector().CopyToVector()[POSE]

        def DoGetWitnessFunctions(self, context):
            return [self._witness] if T is float else []

        def _leave(self, system, context, event):
            return EventStatus.ReachedTermination(self, "the plate left its workspace")

    return Impl


# Drake reads the sources of all callers, which takes 0.2 s below an import. A thread has few.
with ThreadPoolExecutor(1) as thread:
    ExactPlant = thread.submit(lambda: ExactPlant_[None]).result()


def set_accuracy(simulator: Simulator, accuracy: float = 1e-8) -> None:
    """Configure the simulator of a diagram with exact plants.

    Sets a Runge-Kutta method of fifth order with error control, steps of at most 20 ms, and the
    accuracy of integrator and context. The simulation then ends, with
    `kReachedTerminationCondition`, where a plate leaves its workspace.

    Args:
        simulator: before it starts, or between two calls of `AdvanceTo`.
        accuracy: relative, 1e-12 to 1e-2.

    Raises:
        ValueError: another accuracy.
    """
    if not 1e-12 <= accuracy <= 1e-2:
        raise ValueError(f"accuracy: got {accuracy!r}; expected a number from 1e-12 to 1e-2")
    config = ExtractSimulatorConfig(simulator)
    config.integration_scheme, config.use_error_control = "runge_kutta5", True
    config.accuracy, config.max_step_size = accuracy, METRIC_PERIOD
    ApplySimulatorConfig(config, simulator)
    simulator.get_mutable_context().SetAccuracy(accuracy)
