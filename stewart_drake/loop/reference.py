"""The reference as a Drake system."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.trajectories import Trajectory

from stewart_drake.loop.sampling import weak
from stewart_drake.scenario.signals import NUM_REFERENCE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array


class Reference(LeafSystem):
    """What the plate shall do: now, and ahead for a controller that looks ahead.

    Output:  reference(t) = [pose; rates; accelerations] of `true_motion`,
             preview(t)   = the same of `planned_motion` at t + each of `preview_times`.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | reference | output | 18 | rad, m and their time derivatives | continuous |
    | preview | output | 18 len(preview_times) | the same | continuous |

    Args:
        true_motion: what tracking is judged by, a trajectory (6, 1).
        planned_motion: what the controller follows; it may approach the true motion smoothly.
        preview_times: (p,) in s from now.
    """

    def __init__(
        self, true_motion: Trajectory, planned_motion: Trajectory, preview_times: Array
    ) -> None:
        super().__init__()
        self._true, self._planned = true_motion, planned_motion
        self._times = np.array(preview_times)
        time_only = {self.time_ticket()}
        self.DeclareVectorOutputPort("reference", NUM_REFERENCE, weak(self._now), time_only)
        size = NUM_REFERENCE * len(self._times)
        self.DeclareVectorOutputPort("preview", size, weak(self._ahead), time_only)

    def _now(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(evaluate(self._true, context.get_time()))

    def _ahead(self, context: Context, output: BasicVector) -> None:
        t = context.get_time()
        values = [evaluate(self._planned, max(0.0, t + ahead)) for ahead in self._times]
        output.SetFromVector(np.concatenate(values))
