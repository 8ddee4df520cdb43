"""Updates of a sampled system, in the order that a discrete plant needs; and laws as systems."""

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.loop.lifetime import weak
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array


def update_every(
    system: LeafSystem,
    period: float,
    update: Callable[[Context, Any], None],
    when: Callable[[float], float] = event_time,
) -> None:
    """Call a method of `system` at t = 0 and every `period` s, before a plant steps out of there.

    The first call is at initialisation, ahead of all periodic events: nothing else is earlier than
    a plant's first step. The later ones come slightly early (`scenario.timing.event_time`). Updates
    of one instant all read what was there before.

    Args:
        system: in its constructor.
        period: s.
        update: takes a Context and the State to be changed.
        when: how early, of the functions in `scenario.timing`.
    """
    call, early = weak(update), when(period)

    def first(context: Context, state: Any) -> EventStatus:
        call(context, state)
        return EventStatus.Succeeded()

    system.DeclareInitializationUnrestrictedUpdateEvent(first)
    system.DeclarePeriodicUnrestrictedUpdateEvent(early, early, call)


class Sample(NamedTuple):
    """What one step of a law left behind."""

    memory: Any
    seconds: float
    """Time that it took to compute; 0 before the first."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "Sample":
        """Drake copies what it keeps; nobody changes a memory, so that itself will do."""
        return self


class SteppedLaw(LeafSystem):
    """A law that a system takes from sample to sample.

    Initialise: s = [m, 0], m what the law remembers before the first sample.
    Update:     every period s <- [step(m, inputs), the time it took].
    Output:     of s, held; or of what the step of now leaves, to be taken at the samples, where the
                update happens too: one step serves both.
    """

    def _begin(self, memory: Any, period: float) -> None:
        """Declare the state and its update, after the input ports."""
        first = Sample(memory, 0.0)
        self._last = self.DeclareAbstractState(Value(first))
        self._held = {self.abstract_state_ticket(self._last)}
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=lambda: Value(first), calc=weak(self._calc_step)),
            {self.all_input_ports_ticket(), *self._held},
        )
        update_every(self, period, self._update)

    @abstractmethod
    def _prepared(self, context: Context) -> Callable[[], Any]:
        """The step to the next memory, its inputs read: the time that it takes is the law's."""

    def sample(self, context: Context) -> Sample:
        """What the last step left in a context of this system."""
        value: Any = context.get_abstract_state(int(self._last))
        return value.get_value()

    def _put_out(
        self, port: str, size: int, part: Callable[[Any], Array], *, now: bool = False
    ) -> None:
        """Declare an output (size,) of the memory: that of the last sample, or of `now`."""
        ticket = {self._step.ticket()} if now else self._held
        self.DeclareVectorOutputPort(port, size, weak(self._show, part, now), ticket)

    def _show(
        self, part: Callable[[Any], Array], now: bool, context: Context, output: BasicVector
    ) -> None:
        sample: Any = self._step.Eval(context) if now else self.sample(context)
        output.SetFromVector(part(sample.memory))

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        step = self._prepared(context)
        started = time.perf_counter()
        memory = step()
        result.set_value(Sample(memory, time.perf_counter() - started))

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._last)).set_value(self._step.Eval(context))
