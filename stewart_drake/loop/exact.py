"""The exact plant: loops closed in closed form, twelve continuous states."""
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"
# A Drake class template over scalar types has no static type.

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.analysis import ApplySimulatorConfig, ExtractSimulatorConfig, Simulator
from pydrake.systems.framework import (
    BasicVector_,
    EventStatus,
    LeafSystem_,
    PublishEvent,
    WitnessFunctionDirection,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, Limits, Workspace
from stewart_drake.loop.sampling import weak
from stewart_drake.scenario.signals import NUM_TORQUES, POSE, RATES
from stewart_drake.scenario.timing import METRIC_PERIOD


@TemplateSystem.define("ExactPlant_", T_list=(float, AutoDiffXd))
def ExactPlant_(T):
    """Class template of `ExactPlant` over float and AutoDiffXd."""

    class Impl(LeafSystem_[T]):
        """A mechanism's plate under motor torques, loops closed exactly.

        Dynamics:  d[pose; rates]/dt = [rates; accelerations(pose, rates, torque)], plus those of a
                   wrench, `StewartDynamics.wrench_accelerations`.
        Witness:   the margin of its limits, of a machine the least of `dynamics.workspace.margin`;
                   the simulation ends where it passes zero: a leg at a dead centre, a parallel
                   singularity, a pitch of 85 degrees.

        | port | direction | size | unit | rate |
        | --- | --- | --- | --- | --- |
        | torque | input | 6 | N m | continuous |
        | wrench | input | 6 | N m, N, in W at the plate's COM | continuous, only if asked for |
        | state | output | 12 | rad, m, rad/s, m/s | continuous |

        In a diagram of your own, call `set_accuracy` on its simulator. Drake isolates the witness
        only if the accuracy is set on the context too, and stops with an error otherwise. With
        AutoDiffXd, derivatives are exact and end at first order.

        Args:
            dynamics: equations of motion, with gravity and the true parameters.
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
            self.dynamics = dynamics
            self.limits = Workspace(dynamics.mechanism) if limits is None else limits
            self._initial = np.concatenate([dynamics.mechanism.home, np.zeros(6)])
            if initial_state is not None:
                self._initial[:] = initial_state
            default = BasicVector_[T]([T(value) for value in self._initial])
            state = self.DeclareContinuousState(default, 6, 6, 0)
            self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
            # Only if needed: `HasValue` of an input costs a tenth of the derivatives.
            self._wrench = self.DeclareVectorInputPort("wrench", 6) if wrench else None
            self.DeclareStateOutputPort("state", state)
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
            torque = self._torque.Eval(context)
            wrench = None
            if self._wrench is not None and self._wrench.HasValue(context):
                wrench = self._wrench.Eval(context)
            if T is float:
                change = self.dynamics.change(x, torque)
                if wrench is not None:
                    change[RATES] += self.dynamics.wrench_accelerations(x[POSE], wrench)
            else:
                change = self._with_gradient(x, torque, wrench)
            derivatives.SetFromVector(change)

        def _with_gradient(self, x, torque, wrench):
            """Return d(x_dot) = A dx + B dT + (M N)^-1 dF, F the wrench."""
            value, tau, d = ExtractValue(x).ravel(), ExtractValue(torque).ravel(), self.dynamics
            pose, rates = value[POSE], value[RATES]
            force = None if wrench is None else ExtractValue(wrench).ravel()
            at = d.derivatives(pose, rates, tau, wrench=force)
            inputs, maps = [x, torque], [at.A, at.B]
            a = d.accelerations(pose, rates, tau)
            if force is not None:
                a += d.wrench_accelerations(pose, force)
                columns = [d.wrench_accelerations(pose, unit) for unit in np.eye(6)]
                inputs.append(wrench)
                maps.append(np.vstack([np.zeros((6, 6)), np.column_stack(columns)]))
            gradient = np.hstack(maps) @ ExtractGradient(np.concatenate(inputs))
            return InitializeAutoDiff(np.concatenate([rates, a]), gradient).ravel()

        def set_state(self, context, state) -> None:
            """Put the plate, in this system's context, into [pose; rates] (12,)."""
            context.SetContinuousState(state)

        def margin(self, context) -> float:
            """Return a margin, positive inside the limits."""
            return self.limits.margin(context.get_time(), self._pose(context))

        def diagnose(self, context) -> Failure | None:
            """Return why the plate is outside its limits, or None."""
            return self.limits.diagnose(context.get_time(), self._pose(context))

        def _pose(self, context):
            return context.get_continuous_state_vector().CopyToVector()[POSE]

        def DoGetWitnessFunctions(self, context):
            return [self._witness] if T is float else []

        def _leave(self, system, context, event):
            return EventStatus.ReachedTermination(self, "the plate left its workspace")

    return Impl


ExactPlant = ExactPlant_[None]


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
