"""Whether a moving start was forgotten."""

import warnings

import numpy as np
from pydrake.systems.framework import Context, EventStatus, LeafSystem

from stewart_drake.loop.lifetime import weak
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.types import Array


class StartCheck(LeafSystem):
    """Warns at initialisation if a plate that shall start in motion is there at rest.

    A MultibodyPlant has default positions, but no default velocities: a context that C++ makes,
    such as that of `Simulator(loop)`, is at rest.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s |

    Args:
        start: (12,) pose and rates that the plate shall start with.
    """

    def __init__(self, start: Array) -> None:
        super().__init__()
        self._start = start
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        self.DeclareInitializationPublishEvent(weak(self._look))

    def _look(self, context: Context) -> EventStatus:
        state = np.asarray(self._state.Eval(context))
        there = np.allclose(state[POSE], self._start[POSE], rtol=0, atol=1e-9)
        if there and not state[RATES].any():
            warnings.warn(
                "the plate starts at rest, where the scenario starts it in motion: make the "
                "simulator with Simulator(loop, loop.CreateDefaultContext())",
                stacklevel=2,
            )
        return EventStatus.Succeeded()
