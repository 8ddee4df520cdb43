"""A wrench on the plate for a while, as a Drake system."""

import math

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, EventStatus, LeafSystem

from stewart_drake.loop.sampling import ONCE, weak
from stewart_drake.scenario.config import PushConfig
from stewart_drake.scenario.timing import event_time


class Push(LeafSystem):
    """A constant wrench between two times.

    Initialise: u = wrench if the push starts at 0 s, else 0.
    Update:     at `start` u <- wrench, at `end` u <- 0, before a discrete plant's step from there,
                so that integrators stop at both.
    Output:     wrench = u.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | wrench | output | 6, moment then force, in W at the plate's COM | N m, N | held |
    """

    def __init__(self, push: PushConfig) -> None:
        super().__init__()
        self._wrench = np.array(push.wrench)
        held = self.DeclareDiscreteState(np.array(push.at(0.0)))
        self.DeclareStateOutputPort("wrench", held)
        for time, share in ((push.start, 1.0), (push.end, 0.0)):
            if 0 < time < math.inf:
                change = weak(self._change, share)
                self.DeclarePeriodicDiscreteUpdateEvent(ONCE, event_time(time), change)

    def _change(self, share: float, context: Context, state: DiscreteValues) -> EventStatus:
        state.get_mutable_vector().SetFromVector(share * self._wrench)
        return EventStatus.Succeeded()
