"""Base of Drake systems in Python: callbacks, disposal, updates at samples, laws as systems.

Drake keeps a system written in Python for ever, and with it the diagram that it is in (Drake's
issues 22515, 23930 and 24162): in C++, where Python's garbage collector does not look, a system
holds its callbacks, which as bound methods hold the system; and a diagram holds its systems, whose
attributes hold the diagram. A thousand runs would leave up to a gigabyte behind. `weak` makes
callbacks that hold nothing, `let_go` opens the other circle where a diagram is no longer needed.
"""

import time
import weakref
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

_NOTES: Final = "_pydrake_internal_ref_cycle_peers"


def weak(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """A function that calls a bound method with `first` before its own arguments.

    It does not keep the method's object alive, which must still be there when it is called.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        target = reference()
        assert target is not None, "called for a system that is gone"
        return target(*first, *arguments)

    return call


def let_go(diagram: Any, kept: Sequence[Any] = (), made: Sequence[Any] = ()) -> None:
    """Remove all attributes of a diagram and its subsystems, which are unusable afterwards.

    Among them is what Drake notes there about builders and ports. In C++ nothing changes.

    Args:
        diagram: that is no longer needed.
        kept: systems in it that somebody else goes on using: they lose nothing, and keep the
            diagram.
        made: systems of somebody else's that lose Drake's notes only.
    """
    if any(diagram is system for system in kept):
        return
    if any(diagram is system for system in made):
        vars(diagram).pop(_NOTES, None)
        return
    for system in diagram.GetSystems() if hasattr(diagram, "GetSystems") else ():
        let_go(system, kept, made)
    vars(diagram).clear()


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
    """Result of one step of a law."""

    memory: Any
    seconds: float
    """Time that it took to compute; 0 before the first."""

    def __deepcopy__(self, memo: dict[int, Any]) -> "Sample":
        """Return the sample itself: a memory is never changed."""
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
        """Return the result of the last step in a context of this system."""
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


def declare_constant(system: LeafSystem, name: str, value: Array) -> None:
    """Declare an output port (n,) of a system that never changes."""

    def put_out(context: Context, output: BasicVector) -> None:
        output.SetFromVector(value)

    system.DeclareVectorOutputPort(name, len(value), put_out, {system.nothing_ticket()})
