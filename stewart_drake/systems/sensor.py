"""The sensor of pose and rates."""

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from stewart_drake.lifetime import weak
from stewart_drake.signals import NUM_STATE

Array = NDArray[np.float64]


class Sensor(LeafSystem):
    """Adds white Gaussian noise, new at every sample of the controller.

    Output:  y(t) = x(t) + noise_std * n_k,   k = round(t / period),   n_k ~ N(0, 1).

    The k-th noise vector is a function of (seed, k) by a counter-based generator, so that the
    sensor needs no state, and the same seed gives the same run.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | measurement | output | 12 | the same | meant to be read at the controller's samples |

    Args:
        noise_std: (12,) in the units of the state.
        seed: of the noise.
        period: of the controller, s.
    """

    def __init__(self, noise_std: Array, seed: int, period: float) -> None:
        super().__init__()
        self._std, self._seed, self._period = np.array(noise_std), seed, period
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        self.DeclareVectorOutputPort("measurement", NUM_STATE, weak(self._measure))

    def noise(self, k: int) -> Array:
        """The noise (12,) of sample k."""
        generator = np.random.Generator(np.random.Philox(key=self._seed, counter=[0, 0, 0, k]))
        return self._std * generator.standard_normal(NUM_STATE)

    def _measure(self, context: Context, output: BasicVector) -> None:
        state = np.asarray(self._state.Eval(context))
        if self._std.any():
            state = state + self.noise(round(context.get_time() / self._period))
        output.SetFromVector(state)
