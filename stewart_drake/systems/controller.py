"""The control law as a Drake system."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.design.control_law import DelayLqi
from stewart_drake.design.law_types import Memory
from stewart_drake.lifetime import weak
from stewart_drake.signals import (
    NUM_COORDINATES,
    NUM_PARAMETERS,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    WEIGHTS,
)
from stewart_drake.timing import event_time

Array = NDArray[np.float64]


class DelayLqiController(LeafSystem):
    """Delayed LQI with prediction, feedforward and parameter estimation, by its options.

    With m the memory (`design.law_types.Memory`) and `step` the law (`DelayLqi.step`):

    Initialise: m holds the torques in flight at t = 0 and nothing else.
    Update:     every period m <- step(m, measurement, preview, weights)
    Output:     torque        = step(m, measurement, preview, weights).torque, to be taken at the
                samples, where the update happens too: one step serves both.
                the others    = parts of m, as of the last sample.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period |
    | preview | input | 18 p | rad, m and time derivatives | read every period |
    | weights | input | 2 | w_Q, w_R | read every period |
    | torque | output | 6 | N m | direct feedthrough |
    | torque_commanded | output | 6 | N m | held |
    | integral | output | 6 | rad s, m s | held |
    | weights_used | output | 2 | - | held, NaN before the first sample |
    | parameters | output | 8 | N m, kg, N m s/rad | held; estimate, zero without estimator |
    | parameter_std | output | 8 | the same | held; NaN without estimator |

    Args:
        law: the control law.
        queue: (L, 6) torques in flight at t = 0 in N m, oldest first, as the controller believes.
    """

    def __init__(self, law: DelayLqi, queue: Array) -> None:
        super().__init__()
        self._law = law
        self._memory = self.DeclareAbstractState(Value(law.initial_memory(queue)))
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        preview_size = NUM_REFERENCE * len(law.preview_times)
        self._preview = self.DeclareVectorInputPort("preview", preview_size)
        self._weights = self.DeclareVectorInputPort("weights", len(WEIGHTS))
        memory_ticket = self.abstract_state_ticket(self._memory)
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(
                allocate=lambda: Value(law.initial_memory(queue)), calc=weak(self._calc_step)
            ),
            {self.all_input_ports_ticket(), memory_ticket},
        )
        self.DeclareVectorOutputPort(
            "torque", NUM_TORQUES, weak(self._torque), {self._step.ticket()}
        )
        for name, size, part in (
            ("torque_commanded", NUM_TORQUES, lambda m: m.torque),
            ("integral", NUM_COORDINATES, lambda m: m.integral),
            ("weights_used", len(WEIGHTS), lambda m: m.weights),
            ("parameters", NUM_PARAMETERS, _parameters),
            ("parameter_std", NUM_PARAMETERS, _parameter_std),
        ):
            self.DeclareVectorOutputPort(
                name,
                size,
                weak(self._held, part),
                {memory_ticket},
            )
        # The first sample before all periodic events, as `DelayChain` does.
        self.DeclareInitializationUnrestrictedUpdateEvent(weak(self._update_first))
        early = event_time(law.options.period)
        self.DeclarePeriodicUnrestrictedUpdateEvent(early, early, weak(self._update))

    def memory(self, context: Context) -> Memory:
        """The memory in a context of this system."""
        value: Any = context.get_abstract_state(int(self._memory))
        return value.get_value()

    def _held(self, part: Callable[[Memory], Array], context: Context, output: BasicVector) -> None:
        output.SetFromVector(part(self.memory(context)))

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        preview = np.reshape(np.asarray(self._preview.Eval(context)), (-1, NUM_REFERENCE))
        memory = self.memory(context)
        measurement = np.asarray(self._measurement.Eval(context))
        weights = np.asarray(self._weights.Eval(context))
        result.set_value(self._law.step(memory, measurement, preview, weights))

    def _torque(self, context: Context, output: BasicVector) -> None:
        memory: Any = self._step.Eval(context)
        output.SetFromVector(memory.torque)

    def _update_first(self, context: Context, state: State) -> EventStatus:
        self._update(context, state)
        return EventStatus.Succeeded()

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._memory)).set_value(self._step.Eval(context))


def _parameters(memory: Memory) -> Array:
    return np.zeros(NUM_PARAMETERS) if memory.estimate is None else memory.estimate.parameters


def _parameter_std(memory: Memory) -> Array:
    if memory.estimate is None:
        return np.full(NUM_PARAMETERS, np.nan)
    return memory.estimate.parameter_std
