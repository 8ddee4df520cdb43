"""Updates of a sampled system, in the order that a discrete plant needs."""

from collections.abc import Callable
from typing import Any

from pydrake.systems.framework import Context, EventStatus, LeafSystem

from stewart_drake.loop.lifetime import weak
from stewart_drake.scenario.timing import event_time


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
