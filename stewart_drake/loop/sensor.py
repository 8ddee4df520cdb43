"""The sensors of a machine as Drake systems, and their faults."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.files.arguments import fixed, of_kind, positive, whole
from stewart_drake.loop.sampling import update_every, weak
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.field_types import SPIKE
from stewart_drake.scenario.signals import LEGS, NUM_COORDINATES, NUM_LEGS, NUM_STATE, POSE
from stewart_drake.types import Array, ArrayLike

_EARLY = 1e-9
"""Tolerance of the instants of a fault, s."""
SPIKES: Final = 1
"""Stream of random numbers of spikes."""
_STRIKES: Final = 16
"""First of the streams that select the values with a fault, one per fault."""


def draws(seed: int, stream: int, k: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, k]))


def faulty(
    faults: Sequence[Any], y: Array, last: Array, time: float, seed: int, k: int, motion: Array
) -> Array:
    """Return the values of a sensor with faults; the first of simultaneous faults counts.

    Args:
        faults: see `scenario.field_types.SensorFault`.
        y: (n,) without faults.
        last: (n,) at the sample before, NaN for none.
        time: s.
        seed: of spikes and of the affected values.
        k: number of the sample.
        motion: (n,) scale of each value.
    """
    legs = len(y) if len(y) == NUM_LEGS else 1  # a fault affects a whole state
    read, left = y.copy(), np.ones(legs, dtype=bool)
    for i, fault in enumerate(faults):
        if not fault["from"] <= time + _EARLY < fault["to"]:
            continue
        struck = left.copy()
        if fault.get("share") is not None:
            struck &= draws(seed, _STRIKES + i, k).random(legs) < fault["share"]
        if fault.get("leg"):
            struck &= np.isin(LEGS, fault["leg"])
        left &= ~struck
        which = np.broadcast_to(struck, len(y)) if legs == 1 else struck
        if fault["kind"] == "missing":
            read[which] = np.nan
        elif fault["kind"] == "frozen":
            read[which] = np.where(np.isfinite(last), last, y)[which]
        else:
            size = SPIKE if fault.get("size") is None else fault["size"]
            spikes = draws(seed, SPIKES, k).standard_normal(len(y))
            read[which] += (size * motion * spikes)[which]
    return read


def white_noise(seed: int, k: int) -> Array:
    """Return normal numbers (12,) of sample k, a function of (seed, k)."""
    return draws(seed, 0, k).standard_normal(NUM_STATE)


def white_noises(seed: int, number: int) -> Array:
    """Return `white_noise` of the first samples, (number, 12), in a seventh of the time."""
    bits = np.random.Philox(key=seed)
    generator, state, rows = np.random.Generator(bits), bits.state, np.empty((number, NUM_STATE))
    for k in range(number):  # each begins a new block of random numbers
        state["state"]["counter"][:] = 0, 0, 0, k
        bits.state = state
        rows[k] = generator.standard_normal(NUM_STATE)
    return rows


class Sensor(LeafSystem):
    """Sensor of pose and rates with white Gaussian noise at each sample, and with faults.

    Output:  y(t) = x(t) + noise_std * n_k,   k = round(t / period),   n_k ~ N(0, 1),
             except during a fault
             frozen:   the y of the last sample before,
             missing:  NaN,
             spike:    y(t) + size * motion * s_k,   s_k ~ N(0, 1).
    Update:  every period, and at initialisation, the state is y; only where there are faults.

    The k-th random vectors are functions of (seed, k) by a counter-based generator, so that the
    same seed gives the same run. A sensor frozen at the start repeats its first measurement.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | measurement | output | 12 | the same | to be read at the controller's samples |

    Args:
        noise_std: (12,) in the units of the state.
        seed: of noise and spikes.
        period: of the controller, s.
        faults: see `scenario.field_types.SensorFault`; the first of simultaneous faults counts.
        motion: (6,) scale of each coordinate, rad and m; the same per s for the rates.
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
        self._std = fixed("noise_std", noise_std, (NUM_STATE,), 0.0)
        self._seed, self._period = whole("seed", seed, 0), positive("period", period)
        scale = fixed("motion", motion, (NUM_COORDINATES,), 0.0)
        self._faults, self._scale = list(faults), np.tile(scale, 2)
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        if self._faults:
            self.DeclareDiscreteState(np.full(NUM_STATE, np.nan))
            update_every(self, period, self._remember)
        self.DeclareVectorOutputPort("measurement", NUM_STATE, weak(self._measure))

    def noise(self, k: int) -> Array:
        return self._std * white_noise(self._seed, k)

    def _measure(self, context: Context, output: BasicVector) -> None:
        y, time = np.asarray(self._state.Eval(context)), context.get_time()
        k = round(time / self._period)
        if self._std.any():
            y = y + self.noise(k)
        if self._faults:
            last = context.get_discrete_state_vector().value()
            y = faulty(self._faults, y, last, time, self._seed, k, self._scale)
        output.SetFromVector(y)

    def _remember(self, context: Context, state: State) -> None:
        read = self.get_output_port().Eval(context)
        state.get_mutable_discrete_state().get_mutable_vector().SetFromVector(read)


_PHASES: Final = 7
"""Stream of random numbers."""


class Encoders(LeafSystem):
    """Encoders of the crank angles, read N times a period, with codes of 2^bits per turn.

    With a(t) the crank angles of the pose, o the offsets of the encoders on their shafts, q the
    width of a code and p their phases, uniform from -1/2 to 1/2 and drawn once per seed,

        y(t) = q (round((a(t) + o) / q + p) - p),   or a(t) + o of exact ones.

    While a leg has a fault, y of its samples is
        frozen:   that of the sample before,
        missing:  NaN,
        spike:    y + size * motion * s,   s ~ N(0, 1), new for each sample.

    Initialise: window = [N samples of t = 0], as from a burst.
    Update:     at n dt / N   window <- [window without its oldest; y(n dt / N)].
    Output:     measurement = window with the present sample, also before its update.

    The window is sample by sample, oldest first. Random numbers are functions of (seed, number
    of the sample) by a counter-based generator.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s | continuous |
    | measurement | output | 6 N | rad | to be read at the controller's samples |

    Args:
        mechanism: the true machine.
        bits: of a turn; None is exact.
        samples: N, per period; the last one is at the controller's sample.
        offset: (6,) rad.
        seed: of phases, spikes and the values affected by a fault.
        period: dt, of the controller, s.
        faults: see `scenario.field_types.SensorFault`; the first of simultaneous faults counts.
        motion: (6,) scale of each crank angle, rad.
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
        of_kind("mechanism", mechanism, Mechanism)
        self._functions, self._seed = functions_of(mechanism), whole("seed", seed, 0)
        self._samples = whole("samples", samples, 1)
        self._quantum = 0.0 if bits is None else 2 * np.pi / 2 ** whole("bits", bits, 1)
        self._offset = fixed("offset", offset, (NUM_LEGS,))
        self._motion = fixed("motion", motion, (NUM_LEGS,), 0.0)
        self._phases = draws(seed, _PHASES, 0).uniform(-0.5, 0.5, NUM_LEGS)
        self._step, self._faults = positive("period", period) / samples, list(faults)
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
        """Return the number of the present sample, and the window (N, 6) with it."""
        time = context.get_time()
        number = round(time / self._step)
        last = int(context.get_discrete_state(self._last).value()[0])
        kept = np.reshape(context.get_discrete_state(self._window).value(), (-1, NUM_LEGS))
        window = np.array(kept)
        if last == number:
            return number, window
        state = np.asarray(self._state.Eval(context))
        angles = self._functions.crank_angles(state[POSE]) + self._offset
        if self._quantum > 0:
            q, p = self._quantum, self._phases
            angles = q * (np.round(angles / q + p) - p)
        for i in range(1 if last >= 0 else self._samples):
            k = number + i
            read = faulty(self._faults, angles, window[-1], time, self._seed, k, self._motion)
            window = np.vstack([window[1:], read])
        return number, window
