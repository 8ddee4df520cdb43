"""The sensor of pose and rates, and its faults."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, EventStatus, LeafSystem

from stewart_drake.loop.lifetime import weak
from stewart_drake.scenario.fault_config import SPIKE
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array

_EARLY = 1e-9
"""s by which a sample may come before an instant and still be at it."""
SPIKES: Final = 1
"""Stream of random numbers."""
_STRIKES: Final = 16
"""The first of those that say what faults strike, one for each."""


def draws(seed: int, stream: int, k: int) -> np.random.Generator:
    """Random numbers of sample k."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, k]))


def acts(fault: Any, time: float) -> bool:
    """Whether a fault of a scenario is there at a time, s."""
    return bool(fault["from"] <= time + _EARLY < fault["to"])


def strikes(fault: Any, seed: int, place: int, k: int, size: int) -> NDArray[np.bool_]:
    """(size,) whether a fault, of this place in the list, strikes each value of sample k."""
    share = fault.get("share")
    if share is None:
        return np.ones(size, dtype=bool)
    return draws(seed, _STRIKES + place, k).random(size) < share


def white_noise(seed: int, k: int, stream: int = 0) -> Array:
    """Normal numbers (12,) of sample k, a function of (seed, k)."""
    return draws(seed, stream, k).standard_normal(NUM_STATE)


def white_noises(seed: int, number: int) -> Array:
    """`white_noise` of the first samples, (number, 12), in a seventh of the time."""
    bits = np.random.Philox(key=seed)
    generator, state, rows = np.random.Generator(bits), bits.state, np.empty((number, NUM_STATE))
    for k in range(number):  # each begins a block of random numbers of its own
        state["state"]["counter"][:] = 0, 0, 0, k
        bits.state = state
        rows[k] = generator.standard_normal(NUM_STATE)
    return rows


class Sensor(LeafSystem):
    """Adds white Gaussian noise, new at every sample of the controller, and has faults.

    Output:  y(t) = x(t) + noise_std * n_k,   k = round(t / period),   n_k ~ N(0, 1),
             but while there is a fault
             frozen:   the y of the last sample before,
             missing:  NaN,
             spike:    y(t) + size * motion * s_k,   s_k ~ N(0, 1).
    Update:  every period, and at initialisation, the state is y; only where there are faults.

    The k-th random vectors are functions of (seed, k) by a counter-based generator, so that the
    same seed gives the same run. A sensor frozen from the start repeats its first measurement.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | measurement | output | 12 | the same | meant to be read at the controller's samples |

    Args:
        noise_std: (12,) in the units of the state.
        seed: of noise and spikes.
        period: of the controller, s.
        faults: see `scenario.fault_config.SensorFault`; of several at a time the first one counts.
        motion: (6,) how far each coordinate moves, rad and m; the same per s for the rates.
    """

    def __init__(
        self,
        noise_std: Array,
        seed: int,
        period: float,
        faults: Sequence[Any] = (),
        motion: ArrayLike = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        self._std, self._seed, self._period = np.array(noise_std), seed, period
        self._faults, self._scale = list(faults), np.tile(np.asarray(motion, np.float64), 2)
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        if self._faults:
            self.DeclareDiscreteState(np.full(NUM_STATE, np.nan))
            self.DeclareInitializationDiscreteUpdateEvent(weak(self._remember_first))
            early = event_time(period)
            self.DeclarePeriodicDiscreteUpdateEvent(early, early, weak(self._remember))
        self.DeclareVectorOutputPort("measurement", NUM_STATE, weak(self._measure))

    def noise(self, k: int) -> Array:
        """The noise (12,) of sample k."""
        return self._std * white_noise(self._seed, k)

    def _measure(self, context: Context, output: BasicVector) -> None:
        y, time = np.asarray(self._state.Eval(context)), context.get_time()
        k = round(time / self._period)
        if self._std.any():
            y = y + self.noise(k)
        there = (
            fault
            for i, fault in enumerate(self._faults)
            if acts(fault, time) and strikes(fault, self._seed, i, k, 1)[0]
        )
        fault = next(there, None)
        if fault is not None:
            y = self._faulty(fault, y, k, context)
        output.SetFromVector(y)

    def _faulty(self, fault: Any, y: Array, k: int, context: Context) -> Array:
        if fault["kind"] == "missing":
            return np.full(NUM_STATE, np.nan)
        if fault["kind"] == "spike":
            size = SPIKE if fault.get("size") is None else fault["size"]
            return y + size * self._scale * white_noise(self._seed, k, SPIKES)
        last = context.get_discrete_state_vector().value()
        return y if np.all(np.isnan(last)) else last

    def _remember_first(self, context: Context, state: DiscreteValues) -> EventStatus:
        self._remember(context, state)
        return EventStatus.Succeeded()

    def _remember(self, context: Context, state: DiscreteValues) -> None:
        state.set_value(self.get_output_port().Eval(context))
