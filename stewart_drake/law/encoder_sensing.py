"""Motor encoders, y = h(q) + o: what six crank angles, sampled N times a period, tell of a motion.

Between two controller samples the legs are read N times. The residuals beside a predicted motion
are projected onto at most three nodes of the period; core/encoders.h computes that, and says how.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.compiled import Compiled, Once, geometry, numbers
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.sensing import FirstState, Sensing, causes, compiled_sensing
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE
from stewart_drake.types import Array

NODES = 3
"""Of a period, at the most."""
FINEST = 1e-7
"""rad; standard deviation of the crank angles of the model itself."""


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
    """Crank angles; without an observer that knows of periods, those of the last sample.

    Attributes:
        mechanism: as the controller knows it.
        samples: N per period, the last of them at the controller's sample.
        quantum: q, rad; 0 for exact encoders.
        declared: (12,) pose and rates that the machine is said to begin in: which of the assemblies
            with the measured angles it is.
        rates_std: (6,) rad/s and m/s, of those rates, and of those of any new start.
        motion: (6,) how far each coordinate is expected to move, rad and m.
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
        """6 N; sample by sample, the oldest first."""
        return NUM_LEGS * self.samples

    @property
    def std(self) -> float:
        """rad, of one sample."""
        return max(self.quantum / np.sqrt(12), FINEST)

    @property
    def noise_std(self) -> Array:
        """(6 N,) rad."""
        return np.full(self.size, self.std)

    @property
    def shares(self) -> Array:
        """(M,) of the period, the nodes at which a motion is compared."""
        return node_shares(self.samples)

    def seen(self, state: Array) -> Array:
        """Return the angles (6 N,) of a plate at rest there."""
        return self._filled(state, np.empty(self.size), compiled_sensing(self).it.seen)

    def through(self, state: Array, changes: Array) -> Array:
        """See `Sensing.through`; NaN out of reach or at a dead centre."""
        J = np.empty((self.size, NUM_STATE))
        return self._filled(state, J, compiled_sensing(self).it.jacobian) @ changes

    def _filled(self, state: Array, values: Array, function: Any) -> Array:
        at, it = numbers(state), compiled_sensing(self).it
        function(it, core().at(at), core().at(values))
        return values

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """See `Sensing.fault`: a measurement is of use as long as one leg is."""
        values, c = measurement.known(self.size), core()
        found = c.lib.stewart_encoder_fault(encoders_of(self).it, c.at(values))
        return next(iter(causes(found)), None)

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """See `Sensing.stood`: periods, of each leg, without a change of code."""
        after = numbers(still) if len(still) else np.zeros(NUM_LEGS)
        given, c = (measurement.known(self.size), numbers(last, self.size), after), core()
        c.lib.stewart_encoders_stood(encoders_of(self).it, *map(c.at, given))
        return after

    def now(self, measurement: Measurement) -> tuple[Sensing, Measurement]:
        """See `Sensing.now`."""
        if self.samples == 1:
            return self, measurement
        last = slice(-NUM_LEGS, None)
        values, valid = measurement.values[last], measurement.valid[last]
        return self._of_now, Measurement(values, valid, measurement.age)

    @cached_property
    def _of_now(self) -> "EncoderSensing":
        return replace(self, samples=1)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """Pose by forward kinematics, rates as they are expected."""
        c, values, it = core(), measurement.known(self.size), compiled_sensing(self).it
        state, root = np.empty(NUM_STATE), np.empty((NUM_STATE, NUM_STATE))
        expected = None if near is None else numbers(near)
        scratch = c.scratch(c.lib.stewart_encoder_scratch(encoders_of(self).it))
        given = map(c.at, (values, expected, state, root))
        return FirstState(state, root @ root.T) if it.start(it, *given, scratch) else None

    def compiled(self) -> Compiled:
        """Return the `stewart_sensing`."""
        encoders = encoders_of(self)
        sensing = core().lib.stewart_encoder_sensing(encoders.it)
        return Compiled(core().ffi.new("stewart_sensing *", sensing), (encoders,))


@Once
def encoders_of(sensing: EncoderSensing) -> Compiled:
    """Return the `stewart_encoders`."""
    c, it, shares = core(), core().ffi.new("stewart_encoders *"), sensing.shares
    machine, noise = geometry(sensing.mechanism), sensing.noise_std
    it.geometry, it.noise_std = c.at(machine), c.at(noise)
    it.samples, it.nodes, it.quantum, it.std = (
        *(sensing.samples, len(shares)),
        *(sensing.quantum, sensing.std),
    )
    for name in ("shares", "declared", "rates_std", "motion", "offset"):
        setattr(it, name, list(getattr(sensing, name)))
    return Compiled(it, (machine, noise))
