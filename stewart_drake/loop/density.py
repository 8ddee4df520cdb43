"""The window of recent samples, and the densities in it, as a Drake system."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import update_every
from stewart_drake.scenario.signals import NUM_REFERENCE, NUM_STATE, NUM_TORQUES
from stewart_drake.tuner.density import NUM_INPUTS, WINDOW, Kind, density
from stewart_drake.types import Array


class DensityWindow(LeafSystem):
    """Keeps the last 31 samples and takes the densities (45) of the newest.

    With s_k = [y_k - r_k; T_k], y the measured state, or where it is not measured the estimate, r
    the reference's pose and rates, T_k the torque computed at t = k dt:

    Initialise: window = [unknown, ..., unknown], then the update of k = 0.
    Update:     at k dt   window <- [window without its oldest; s_k].
    Output:     density = `tuner.density.density`(window), hence of samples up to k from k dt on.

    What is not finite in s_k is unknown and left out of the window's mean, so that a missed
    measurement spoils nothing. While the window fills, the mean is over the samples there are.
    The update is an early, unrestricted one, like the controller's: T_k is then the torque of the
    same step that the delay chain takes.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | measurement | input | 12 | rad, m, rad/s, m/s | read every period |
    | reference | input | 18 | rad, m and time derivatives | read every period |
    | torque | input | 6 | N m | read every period |
    | density | output | 18 | - | held, NaN before the first sample |

    Args:
        period: dt in s.
        kind: of density, `magnitude` or `signed`.
    """

    def __init__(self, period: float, kind: Kind = "magnitude") -> None:
        super().__init__()
        self._kind: Kind = kind
        self._window = self.DeclareDiscreteState(np.full(WINDOW * NUM_INPUTS, np.nan))
        self._measurement = self.DeclareVectorInputPort("measurement", NUM_STATE)
        self._reference = self.DeclareVectorInputPort("reference", NUM_REFERENCE)
        self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
        self.DeclareVectorOutputPort(
            "density", NUM_INPUTS, weak(self._density), {self.discrete_state_ticket(self._window)}
        )
        update_every(self, period, self._update)

    def window(self, context: Context) -> Array:
        """(31, 18) samples in a context of this system, the newest last, NaN where unknown."""
        return np.reshape(context.get_discrete_state(self._window).value(), (WINDOW, NUM_INPUTS))

    def _update(self, context: Context, state: State) -> None:
        target = np.asarray(self._reference.Eval(context))[:NUM_STATE]
        error = np.asarray(self._measurement.Eval(context)) - target
        sample = np.concatenate([error, self._torque.Eval(context)])
        moved = np.vstack([self.window(context)[1:], sample])
        state.get_mutable_discrete_state(self._window).SetFromVector(moved.ravel())

    def _density(self, context: Context, output: BasicVector) -> None:
        window = self.window(context)
        known = np.isfinite(window).any()
        output.SetFromVector(density(window, self._kind) if known else window[-1])
