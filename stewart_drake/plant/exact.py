"""The exact plant: loops closed in closed form, twelve continuous states."""
# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"
# A Drake class template over scalar types has no static type.

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import (
    BasicVector_,
    EventStatus,
    LeafSystem_,
    PublishEvent,
    WitnessFunctionDirection,
)
from pydrake.systems.scalar_conversion import TemplateSystem

from stewart_drake.lifetime import weak
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.workspace import margin
from stewart_drake.signals import NUM_STATE, NUM_TORQUES, POSE, RATES

Array = NDArray[np.float64]


@TemplateSystem.define("ExactPlant_", T_list=(float, AutoDiffXd))
def ExactPlant_(T):
    """Class template of `ExactPlant` over float and AutoDiffXd."""

    class Impl(LeafSystem_[T]):
        """A mechanism's plate under motor torques, loops closed exactly.

        Dynamics:  d[pose; rates]/dt = [rates; accelerations(pose, rates, torque)].
        Witness:   the least of the margins of `plant.workspace.margin`; the simulation ends
                   where it passes zero: a leg at a dead centre, a parallel singularity, a pitch
                   of 85 degrees.

        | port | direction | size | unit | rate |
        | --- | --- | --- | --- | --- |
        | torque | input | 6 | N m | continuous |
        | state | output | 12 | rad, m, rad/s, m/s | continuous |

        Any Drake integrator does; set its accuracy on the context too, or the witness is only
        looked at between steps. With AutoDiffXd, derivatives are exact and end at first order.

        Args:
            dynamics: equations of motion, with gravity and the true parameters.
            initial_state: (12,) default of the continuous state; at home and at rest if None.
        """

        def _construct(
            self,
            dynamics: StewartDynamics,
            initial_state: ArrayLike | None = None,
            converter=None,
        ) -> None:
            super().__init__(converter=converter)
            self.dynamics = dynamics
            self._initial = np.concatenate([dynamics.mechanism.home, np.zeros(6)])
            if initial_state is not None:
                self._initial[:] = initial_state
            default = BasicVector_[T]([T(value) for value in self._initial])
            state = self.DeclareContinuousState(default, 6, 6, 0)
            self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
            self.DeclareStateOutputPort("state", state)
            if T is float:
                self._witness = self.MakeWitnessFunction(
                    "workspace margin",
                    WitnessFunctionDirection.kPositiveThenNonPositive,
                    weak(self.margin),
                    PublishEvent(system_callback=weak(self._leave)),
                )

        def _construct_copy(self, other, converter=None) -> None:
            Impl._construct(self, other.dynamics, other._initial, converter=converter)

        def DoCalcTimeDerivatives(self, context, derivatives) -> None:
            x = context.get_continuous_state_vector().CopyToVector()
            torque = self._torque.Eval(context)
            d = self.dynamics
            if T is float:
                change = np.concatenate([x[RATES], d.accelerations(x[POSE], x[RATES], torque)])
            else:  # d(x_dot) = A dx + B dT
                value, tau = ExtractValue(x).ravel(), ExtractValue(torque).ravel()
                at = d.derivatives(value[POSE], value[RATES], tau)
                both = ExtractGradient(np.concatenate([x, torque]))
                gradient = at.A @ both[:NUM_STATE] + at.B @ both[NUM_STATE:]
                a = d.accelerations(value[POSE], value[RATES], tau)
                change = InitializeAutoDiff(np.concatenate([value[RATES], a]), gradient).ravel()
            derivatives.get_mutable_vector().SetFromVector(change)

        def set_state(self, context, state) -> None:
            """Put the plate, in this system's context, into [pose; rates] (12,)."""
            context.SetContinuousState(state)

        def margin(self, context) -> float:
            """Positive inside the permitted region, see `plant.workspace.margin`."""
            pose = context.get_continuous_state_vector().CopyToVector()[POSE]
            return margin(self.dynamics.mechanism, pose)

        def DoGetWitnessFunctions(self, context):
            return [self._witness] if T is float else []

        def _leave(self, system, context, event):
            return EventStatus.ReachedTermination(self, "the plate left its workspace")

    return Impl


ExactPlant = ExactPlant_[None]
