"""Base of Drake systems in Python: callbacks, disposal, updates at samples, laws as systems.

Drake never frees a system written in Python, nor its diagram (Drake's issues 22515, 23930 and
24162). Two reference circles in C++ are invisible to Python's garbage collector: a system holds its
callbacks, bound methods that hold the system; a diagram holds its systems, whose attributes hold
it. A thousand runs would leak up to a gigabyte. `weak` makes callbacks without references,
`dispose` breaks the other circle of a diagram that is no longer needed.
"""

import math
import time
import warnings
import weakref
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, Final

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    State,
    ValueProducer,
)

from stewart_drake.files.arguments import positive
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

ONCE: Final = 1e9
"""Period of an event that occurs once, s: longer than any run."""
_NOTES: Final = "_pydrake_internal_ref_cycle_peers"


def weak(method: Callable[..., Any], *first: Any) -> Callable[..., Any]:
    """Return a function that calls a bound method with `first` before its own arguments.

    It does not keep the method's object alive.
    """
    reference = weakref.WeakMethod(method)

    def call(*arguments: Any) -> Any:
        target = reference()
        assert target is not None, "called for a system that was deleted"
        return target(*first, *arguments)

    return call


def free_name(builder: DiagramBuilder, name: str) -> str:
    """Return the name, or with a number if a system of the builder has it.

    Drake ends the process at `Build` where two systems have one name.
    """
    names = (name if i == 0 else f"{name}_{i}" for i in count())
    return next(one for one in names if not builder.HasSubsystemNamed(one))


def dispose(diagram: Any, kept: Sequence[Any] = (), made: Sequence[Any] = ()) -> None:
    """Remove all attributes of a diagram and its subsystems, which are unusable afterwards.

    Args:
        diagram: a diagram that is no longer needed.
        kept: systems in it that are still used; they lose nothing and keep the diagram.
        made: systems of the user that lose Drake's references to builders and ports only.
    """
    if any(diagram is system for system in kept):
        return
    if any(diagram is system for system in made):
        vars(diagram).pop(_NOTES, None)
        return
    for system in diagram.GetSystems() if hasattr(diagram, "GetSystems") else ():
        dispose(system, kept, made)
    vars(diagram).clear()


def update_every(
    system: LeafSystem,
    period: float,
    update: Callable[[Context, Any], None],
    when: Callable[[float], float] = event_time,
) -> int:
    """Call a method of `system` at t = 0 and every `period` s, before a plant's step from there.

    The first call is at initialisation, before all periodic events and a plant's first step. Later
    calls come slightly early (`scenario.timing.event_time`). Updates of one instant read the values
    from before it. The time of the last call is an abstract state: a simulator that is initialised
    again in the middle of a run, as after a change of its integrator, makes no further call.

    Args:
        system: the system, in its constructor.
        period: s.
        update: takes a Context and the State to be changed.
        when: the lead, a function in `scenario.timing`.

    Returns:
        Index of that abstract state.
    """
    change, early = weak(update), when(positive("period", period))
    last = int(system.DeclareAbstractState(Value(math.inf)))

    def call(context: Context, state: Any) -> EventStatus:
        state.get_mutable_abstract_state(last).set_value(context.get_time())
        change(context, state)
        return EventStatus.Succeeded()

    def first(context: Context, state: Any) -> EventStatus:
        called: Any = context.get_abstract_state(last)
        if called.get_value() <= context.get_time():
            return EventStatus.DidNothing()
        return call(context, state)

    system.DeclareInitializationUnrestrictedUpdateEvent(first)
    system.DeclarePeriodicUnrestrictedUpdateEvent(early, early, call)
    return last


@dataclass(eq=False)
class Sample:
    """Result of one step of a law."""

    memory: Any
    seconds: float = 0.0  # computing time
    read: bool = True  # whether a system has read it from a port for readers at the samples

    def __deepcopy__(self, memo: dict[int, Any]) -> "Sample":
        """Return the same object: only `read` is ever changed."""
        return self


class SteppedLaw(LeafSystem):
    """A law as a system.

    Initialise: s = [m, 0], m the memory of the law before the first sample.
    Update:     every period s <- [step(m, inputs), computing time].
    Output:     of s, held; or of the present step, to be read at the samples. Output and update
                share one step.
    """

    def _begin(
        self, memory: Any, period: float, when: Callable[[float], float] = event_time
    ) -> None:
        """Declare the state and its update, after the input ports."""
        first = Sample(memory)
        self._last = self.DeclareAbstractState(Value(first))
        self._held = {self.abstract_state_ticket(self._last)}
        self._step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=lambda: Value(first), calc=weak(self._calc_step)),
            {self.all_input_ports_ticket(), *self._held},
        )
        self._every, self._called = period, update_every(self, period, self._update, when)

    @abstractmethod
    def _prepared(self, context: Context) -> Callable[[], Any]:
        """Read the inputs and return the step, a function that returns the next memory."""

    def sample(self, context: Context) -> Sample:
        """Return the result of the last step in a context of this system."""
        value: Any = context.get_abstract_state(int(self._last))
        return value.get_value()

    def _put_out(
        self,
        port: str,
        size: int,
        part: Callable[[Any], Array],
        *,
        now: bool = False,
        held: str = "",
    ) -> None:
        """Declare an output (size,) of the memory, of the last sample or of `now`.

        With the name of a `held` port, a reader of this one that does not read it at every sample,
        and then only, causes a warning.
        """
        ticket = {self._step.ticket()} if now else self._held
        show = weak(self._show, port, part, now, held)
        self.DeclareVectorOutputPort(port, size, show, ticket)

    def _show(
        self,
        port: str,
        part: Callable[[Any], Array],
        now: bool,
        held: str,
        context: Context,
        output: BasicVector,
    ) -> None:
        last = self.sample(context)
        sample: Any = self._step.Eval(context) if now else last
        if held:
            called: Any = context.get_abstract_state(self._called)
            since = context.get_time() - called.get_value()
            between = 0 <= since < self._every * (1 - 1e-6)
            if between or not last.read:
                warnings.warn(
                    f"{self.get_name()}: got a reader of the port {port} "
                    f"{'between the' if between else 'that skips'} samples; expected one that "
                    f"reads every {self._every:g} s by `update_every`, such as DelayChain, or the "
                    f"held port {held}",
                    stacklevel=1,
                )
            sample.read = True
        output.SetFromVector(part(sample.memory))

    def _calc_step(self, context: Context, result: AbstractValue) -> None:
        step = self._prepared(context)
        started = time.perf_counter()
        memory = step()
        result.set_value(Sample(memory, time.perf_counter() - started, read=False))

    def _update(self, context: Context, state: State) -> None:
        state.get_mutable_abstract_state(int(self._last)).set_value(self._step.Eval(context))


def declare_constant(system: LeafSystem, name: str, value: Array) -> None:
    """Declare an output (n,) that never changes."""

    def put_out(context: Context, output: BasicVector) -> None:
        output.SetFromVector(value)

    system.DeclareVectorOutputPort(name, len(value), put_out, {system.nothing_ticket()})
