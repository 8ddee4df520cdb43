"""The six motor encoders of the machine, and their faults."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.loop.lifetime import weak
from stewart_drake.loop.sampling import update_every
from stewart_drake.loop.sensor import SPIKES, acts, draws, strikes
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import crank_angles_along
from stewart_drake.scenario.fault_config import SPIKE
from stewart_drake.scenario.signals import LEGS, NUM_LEGS, NUM_STATE, POSE
from stewart_drake.types import Array

_PHASES: Final = 7
"""Stream of random numbers."""


class Encoders(LeafSystem):
    """Reads the crank angles N times a period, in codes of 2^bits to a turn.

    With a(t) the crank angles of the pose, o where the encoders stand on their shafts, q the width
    of a code and p their phases, uniform from -1/2 to 1/2 and drawn once per seed,

        y(t) = q (round((a(t) + o) / q + p) - p),   or a(t) + o of exact ones.

    While a leg has a fault, y of its samples is
        frozen:   that of the sample before,
        missing:  NaN,
        spike:    y + size * motion * s,   s ~ N(0, 1), new for each sample.

    Initialise: window = [N samples of t = 0], as from a burst.
    Update:     at n dt / N   window <- [window without its oldest; y(n dt / N)].
    Output:     measurement = window, with the sample of now whether or not its update has been.

    The window is sample by sample, the oldest first. Random numbers are functions of (seed, number
    of the sample) by a counter-based generator.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | measurement | output | 6 N | rad | meant to be read at the controller's samples |

    Args:
        mechanism: the true machine.
        bits: of a turn; None is exact.
        samples: N, per period; the last one is at the controller's sample.
        offset: (6,) rad.
        seed: of phases, spikes and what a fault strikes.
        period: dt, of the controller, s.
        faults: see `scenario.fault_config.SensorFault`; of several at a time the first one counts.
        motion: (6,) how far each crank moves, rad.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        bits: int | None,
        samples: int,
        offset: ArrayLike,
        seed: int,
        period: float,
        faults: Sequence[Any] = (),
        motion: ArrayLike = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        self._mechanism, self._samples, self._seed = mechanism, samples, seed
        self._quantum = 0.0 if bits is None else 2 * np.pi / 2**bits
        self._offset, self._motion = np.array(offset), np.asarray(motion, np.float64)
        self._phases = draws(seed, _PHASES, 0).uniform(-0.5, 0.5, NUM_LEGS)
        self._step, self._faults = period / samples, list(faults)
        size = samples * NUM_LEGS
        self._last = self.DeclareDiscreteState([-1.0])
        self._window = self.DeclareDiscreteState(np.full(size, np.nan))
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        self.DeclareVectorOutputPort("measurement", size, weak(self._measure))
        update_every(self, self._step, self._take)

    def _measure(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._taken(context)[1].ravel())

    def _take(self, context: Context, state: State) -> None:
        number, window = self._taken(context)
        state.get_mutable_discrete_state(self._last).SetFromVector([number])
        state.get_mutable_discrete_state(self._window).SetFromVector(window.ravel())

    def _taken(self, context: Context) -> tuple[int, Array]:
        """Number of the sample of now, and the window (N, 6) with it."""
        time = context.get_time()
        number = round(time / self._step)
        last = int(context.get_discrete_state(self._last).value()[0])
        kept = np.reshape(context.get_discrete_state(self._window).value(), (-1, NUM_LEGS))
        window = np.array(kept)
        if last == number:
            return number, window
        state = np.asarray(self._state.Eval(context))
        angles = crank_angles_along(self._mechanism, state[None, POSE])[0] + self._offset
        if self._quantum > 0:
            q, p = self._quantum, self._phases
            angles = q * (np.round(angles / q + p) - p)
        for i in range(1 if last >= 0 else self._samples):
            read = self._faulty(angles, window[-1], time, number + i)
            window = np.vstack([window[1:], read])
        return number, window

    def _faulty(self, angles: Array, last: Array, time: float, number: int) -> Array:
        read, struck = angles.copy(), np.zeros(NUM_LEGS, dtype=bool)
        for i, fault in enumerate(self._faults):
            if not acts(fault, time):
                continue
            legs = strikes(fault, self._seed, i, number, NUM_LEGS) & ~struck
            legs &= np.isin(LEGS, fault.get("leg") or LEGS)
            struck |= legs
            if fault["kind"] == "missing":
                read[legs] = np.nan
            elif fault["kind"] == "frozen":
                read[legs] = np.where(np.isfinite(last), last, angles)[legs]
            else:
                size = SPIKE if fault.get("size") is None else fault["size"]
                spikes = draws(self._seed, SPIKES, number).standard_normal(NUM_LEGS)
                read[legs] += (size * self._motion * spikes)[legs]
        return read
