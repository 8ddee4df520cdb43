"""Motor encoders, y = h(q) + o: six crank angles, sampled N times a period.

Between two controller samples the legs are read N times. The residuals of a predicted motion are
projected onto at most three nodes of the period, see core/encoders.h.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.compiled import Compiled, Once, geometry, numbers
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.sensing import FAULTS, FirstState
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE
from stewart_drake.types import Array

NODES = 3
"""Largest number of nodes per period."""
FINEST = 1e-7
"""Standard deviation of the model's crank angles, rad."""


@cache
def node_shares(samples: int) -> Array:
    """Return Gauss nodes (M,) of N samples at 1/N, 2/N, ..., 1 of a period, as shares of it.

    They are the roots of the polynomial of degree M that is orthogonal on the samples: eigenvalues
    of the Jacobi matrix of its recurrence (Golub and Welsch).
    """
    number = min(NODES, samples)
    t = 2 * np.arange(1, samples + 1) / samples - 1
    if samples <= number:
        return (t + 1) / 2
    # Stieltjes: p_{k+1} = (t - a_k) p_k - b_k p_{k-1}, orthogonal on the samples.
    a, b = np.empty(number), np.empty(number)
    before, p, norm = np.zeros(samples), np.ones(samples), 1.0
    for k in range(number):
        square = float(np.mean(p * p))
        a[k], b[k], norm = float(np.mean(t * p * p)) / square, square / norm, square
        before, p = p, (t - a[k]) * p - (b[k] if k else 0.0) * before
    off = np.sqrt(b[1:])
    nodes = np.linalg.eigvalsh(np.diag(a) + np.diag(off, 1) + np.diag(off, -1))
    return np.asarray((nodes + 1) / 2)


@dataclass(frozen=True)
class EncoderSensing:
    """Measurement of crank angles.

    Attributes:
        mechanism: as the controller knows it.
        samples: N per period, the last of them at the controller's sample.
        quantum: q, rad; 0 for exact encoders.
        declared: (12,) pose and rates at the start. They select one of the assemblies with the
            measured angles.
        rates_std: (6,) rad/s and m/s, of those rates and of the rates after any restart.
        motion: (6,) expected range of each coordinate, rad and m.
        offset: (6,) o, rad, as far as it is known beforehand.
    """

    mechanism: Mechanism
    samples: int
    quantum: float
    declared: Array
    rates_std: Array
    motion: Array
    offset: Array

    @property
    def size(self) -> int:
        """Number of values 6 N, sample by sample, oldest first."""
        return NUM_LEGS * self.samples

    @property
    def std(self) -> float:
        """Standard deviation of one value, rad."""
        return max(self.quantum / np.sqrt(12), FINEST)

    @property
    def noise_std(self) -> Array:
        return np.full(self.size, self.std)

    def seen(self, state: Array) -> Array:
        """Return the angles (6 N,) of a plate at rest."""
        return self._filled(state, np.empty(self.size), "seen")

    def through(self, state: Array, changes: Array) -> Array:
        """Return H X, see `Sensing.through`; NaN out of reach or at a dead centre."""
        return self._filled(state, np.empty((self.size, NUM_STATE)), "jacobian") @ changes

    def _filled(self, state: Array, values: Array, function: str) -> Array:
        at, it = numbers(state), _sensing_of(self).it
        getattr(it, function)(it, core().at(at), core().at(values))
        return values

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """Return the fault: a measurement is of use as long as one leg is."""
        values, c = measurement.known(self.size), core()
        sensor = c.lib.stewart_encoder_sensing(encoders_of(self).it)
        nothing = c.ffi.NULL, 0.0, c.at(values), c.ffi.NULL
        found = sensor.fault(c.ffi.addressof(sensor), *nothing)
        return next((name for i, name in enumerate(FAULTS) if found >> i & 1), None)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """Return the pose by forward kinematics, with the expected rates."""
        c, values, it = core(), measurement.known(self.size), _sensing_of(self).it
        state, root = np.empty(NUM_STATE), np.empty((NUM_STATE, NUM_STATE))
        expected = None if near is None else numbers(near)
        scratch = c.scratch(c.lib.stewart_encoder_scratch(encoders_of(self).it))
        given = map(c.at, (values, expected, state, root))
        return FirstState(state, root @ root.T) if it.start(it, *given, scratch) else None


@Once
def _sensing_of(sensing: EncoderSensing) -> Compiled:
    encoders = encoders_of(sensing)
    it = core().ffi.new("stewart_sensing *", core().lib.stewart_encoder_sensing(encoders.it))
    return Compiled(it, (encoders,))


@Once
def encoders_of(sensing: EncoderSensing) -> Compiled:
    """Return the `stewart_encoders`."""
    c, it, shares = core(), core().ffi.new("stewart_encoders *"), node_shares(sensing.samples)
    machine, noise = geometry(sensing.mechanism), sensing.noise_std
    it.geometry, it.noise_std = c.at(machine), c.at(noise)
    it.samples, it.nodes = sensing.samples, len(shares)
    it.quantum, it.std = sensing.quantum, sensing.std
    it.shares = list(shares)
    for name in ("declared", "rates_std", "motion", "offset"):
        setattr(it, name, list(getattr(sensing, name)))
    return Compiled(it, (machine, noise))
