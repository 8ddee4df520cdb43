"""The measurement y = h(x) + noise: its model, first states from it, and its faults.

The law and its observers use a sensor through `Sensing` alone, which finds three faults:

- missing: values that are not there.
- frozen: a repetition of the last measurement, bit for bit, which noise or motion excludes.
- rejected: values that the machine cannot have.

The filter (core/filter.h) has a model of the motion. It finds outliers, and a sensor that froze
while the plate was at rest.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, Protocol

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.files.arguments import fixed, whole
from stewart_drake.law.belief import root_of
from stewart_drake.law.compiled import Compiled, Once, Out, call_back, numbers
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_LEGS, NUM_STATE
from stewart_drake.types import Array, Flags


@dataclass(frozen=True)
class Measurement:
    """Values of one sample; some may be missing.

    Attributes:
        values: (m,) in the units of the sensing; meaningless where not valid.
        valid: (m,) which values exist.
        age: time since the values were taken, s.
    """

    values: Array
    valid: Flags
    age: float = 0.0

    @classmethod
    def of(cls, values: Array, age: float = 0.0) -> "Measurement":
        """Return a measurement from values (m,); those that are not finite count as missing."""
        values = np.array(values, np.float64)
        return cls(values, np.isfinite(values), age)

    @property
    def complete(self) -> bool:
        """Whether no value is missing."""
        return bool(np.all(self.valid))

    def known(self, size: int) -> Array:
        """Return the values (size,), NaN for the missing ones.

        Raises:
            ValueError: another number of values.
        """
        values = np.where(self.valid, self.values, np.nan)
        if values.shape != (size,):
            raise ValueError(f"measurement: got shape {values.shape}; expected {(size,)}")
        return values

    def missing(self) -> "Measurement":
        """Return a measurement of the same size without any value."""
        return Measurement(self.values, np.zeros_like(self.valid))


FAULTS = ("measurements_missing", "measurements_frozen", "measurements_rejected")
"""Names of the counts, by bit of the result of `fault` of `stewart_sensing`."""


class FirstState(NamedTuple):
    """Initial state (12,) and covariance (12, 12) of an observer, from one measurement."""

    state: Array
    covariance: Array


class Sensing(Protocol):
    """A kind of sensor. Instances are immutable."""

    @property
    def size(self) -> int:
        """Number m of values."""
        ...

    @property
    def noise_std(self) -> Array:
        """Standard deviations (m,) of the values."""
        ...

    def seen(self, state: Array) -> Array:
        """Return h(x), the values (m,) of a state (12,) without noise."""
        ...

    def through(self, state: Array, changes: Array) -> Array:
        """Return H X (m, ...), H = dh/dx at a state (12,), of changes X (12, ...) of the state."""
        ...

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """Return the fault of a measurement, as the name of a count, or None.

        Args:
            measurement: of m values.
            last: (m,) last valid value of each; NaN before the first.
            period: s since the sample before.
            mechanism: as the controller knows it.

        Raises:
            ValueError: a shape that does not fit.
        """
        ...

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """Return the state from one measurement without a fault, or None if it is undetermined.

        Args:
            measurement: of m values.
            near: (12,) expected state, for a sensor that needs one; None at the beginning.
        """
        ...


def _fault(sensor: Any, *given: Any) -> str | None:
    """Return the first fault that a `stewart_sensing` finds, for arguments of `fault`, or None."""
    bits = sensor.fault(core().ffi.addressof(sensor), *given)
    return next((name for i, name in enumerate(FAULTS) if bits >> i & 1), None)


@dataclass(frozen=True)
class StateSensing:
    """Measurement of pose and rates: h(x) = x.

    Attributes:
        noise_std: (12,) rad, m and per s.
        motion: (6,) expected range of each coordinate, rad and m: the scale of its faults.
        anywhere: whether poses out of the machine's reach are accepted.
    """

    noise_std: Array
    motion: Array
    anywhere: bool = False

    def __post_init__(self) -> None:
        fixed("noise_std", self.noise_std, (NUM_STATE,), 0.0)
        fixed("motion", self.motion, (NUM_COORDINATES,), 0.0)

    @property
    def size(self) -> int:
        return NUM_STATE

    def seen(self, state: Array) -> Array:
        return state

    def through(self, state: Array, changes: Array) -> Array:
        return changes

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """Return the fault; one missing value makes the whole measurement missing."""
        c, values, before = core(), measurement.known(self.size), numbers(last, self.size)
        arguments = c.at(mechanism.numbers), period, c.at(values), c.at(before)
        return _fault(c.lib.stewart_state_sensing(state_sensor(self).pointer), *arguments)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState:
        """Return the measurement, with the variance of its noise."""
        return FirstState(measurement.values, np.diag(self.noise_std**2))


@Once
def state_sensor(sensing: StateSensing) -> Compiled:
    """Return the `stewart_state_sensor` of a sensor."""
    sensor = core().ffi.new("stewart_state_sensor *")
    sensor.noise_std = list(numbers(sensing.noise_std, NUM_STATE))
    sensor.motion = list(numbers(sensing.motion, NUM_COORDINATES))
    sensor.anywhere = sensing.anywhere
    return Compiled(sensor)


@Once
def described(sensing: Sensing, mechanism: Mechanism) -> Compiled:
    """Return a `stewart_sensing` for C whose functions call those of a sensor in Python.

    Results are NaN before the function of the sensor, so that C finds the ones that it leaves out.
    """
    c, m, raised = core(), sensing.size, list[BaseException]()
    noise = numbers(sensing.noise_std, m)

    def seen(state: Array, values: Array) -> None:
        values[:] = np.nan
        values[:] = sensing.seen(state)

    def jacobian(state: Array, J: Array) -> None:
        J[:] = np.nan
        J[:] = np.ravel(sensing.through(state, np.eye(NUM_STATE)))

    def start(values: Array, near: Array | None, state: Array, root: Array) -> int:
        first = sensing.start(Measurement.of(values), near)
        if first is None or not np.isfinite(first.covariance).all():
            return 0
        least, *_, most = np.linalg.eigvalsh(first.covariance)
        if least < -ROUNDING * most:
            return 0
        state[:], root[:] = first.state, np.ravel(root_of(first.covariance))
        return 1

    def fault(period: float, values: Array, last: Array) -> int:
        found = sensing.fault(Measurement.of(values), last, period, mechanism)
        return 0 if found is None else 1 << FAULTS.index(found)

    table, n = c.ffi.new("stewart_sensing *", [m, c.at(noise)]), NUM_STATE
    keep_alive = call_back(
        table,
        raised,
        seen=(seen, ..., n, Out(m)),
        jacobian=(jacobian, ..., n, Out(m * n)),
        start=(start, ..., m, n, Out(n), Out(n * n), ...),
        fault=(fault, ..., ..., None, m, m),
    )
    return Compiled(table, (noise, *keep_alive), (raised,))


ROUNDING = 1e-13
"""Smallest accepted eigenvalue of a covariance, times -1, as a share of its largest one."""
NODES = 3
"""Largest number of Gauss nodes per period (`node_times`)."""
FINEST = 1e-7
"""Smallest standard deviation of an encoder's value, rad: that of the model's crank angles."""


@cache
def node_times(samples: int) -> Array:
    """Return the Gauss nodes (M,) of N samples at 1/N, 2/N, ..., 1 of a period, in periods.

    They are the roots of the polynomial of degree M that is orthogonal on the samples: eigenvalues
    of the multiplication by t, projected onto the polynomials of lower degree.
    """
    t = np.arange(1, samples + 1) / samples
    if samples <= NODES:
        return t
    Q, _ = np.linalg.qr(np.vander(t, NODES))  # orthonormal polynomials on the samples
    return np.linalg.eigvalsh(Q.T @ (t[:, None] * Q))


@dataclass(frozen=True)
class EncoderSensing:
    """Motor encoders, y = h(q) + o: six crank angles, sampled N times a period.

    A parabola fits the residuals of a predicted motion at the N samples; its values at three nodes
    of the period, or fewer, are compared, see core/encoders.h.

    Attributes:
        mechanism: as the controller knows it.
        samples: N per period, the last of them at the controller's sample.
        quantum: q, rad; 0 for exact encoders.
        initial_state: (12,) pose and rates at the start. They select one of the assemblies with the
            measured angles.
        rates_std: (6,) rad/s and m/s, of those rates and of the rates after any restart.
        motion: (6,) expected range of each coordinate, rad and m.
        offset: (6,) o, rad, as far as it is known beforehand.
    """

    mechanism: Mechanism
    samples: int
    quantum: float
    initial_state: Array
    rates_std: Array
    motion: Array
    offset: Array

    def __post_init__(self) -> None:
        whole("samples", self.samples, 1)
        fixed("quantum", self.quantum, (), 0.0)
        fixed("initial_state", self.initial_state, (NUM_STATE,))
        for name in ("rates_std", "motion"):
            fixed(name, getattr(self, name), (NUM_COORDINATES,), 0.0)
        fixed("offset", self.offset, (NUM_LEGS,))

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
        """Return H X, see `Sensing.through`; NaN out of reach or at a dead centre of a leg."""
        return self._filled(state, np.empty((self.size, NUM_STATE)), "jacobian") @ changes

    def _filled(self, state: Array, values: Array, function: str) -> Array:
        """Return `values` after a function of `stewart_sensing` has written them for a state."""
        copy, sensing = numbers(state), _sensing_of(self).pointer
        getattr(sensing, function)(sensing, core().at(copy), core().at(values))
        return values

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """Return the fault: a measurement is of use as long as one leg is."""
        values, c = measurement.known(self.size), core()
        arguments = c.ffi.NULL, 0.0, c.at(values), c.ffi.NULL
        return _fault(c.lib.stewart_encoder_sensing(encoders_of(self).pointer), *arguments)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """Return the pose by forward kinematics, with the expected rates."""
        c, values, sensing = core(), measurement.known(self.size), _sensing_of(self).pointer
        state, root = np.empty(NUM_STATE), np.empty((NUM_STATE, NUM_STATE))
        expected = None if near is None else numbers(near)
        scratch = c.scratch(c.lib.stewart_encoder_scratch(encoders_of(self).pointer))
        arrays = map(c.at, (values, expected, state, root))
        found = sensing.start(sensing, *arrays, scratch)
        return FirstState(state, root @ root.T) if found else None


@Once
def _sensing_of(sensing: EncoderSensing) -> Compiled:
    """Return the `stewart_sensing` of encoders."""
    encoders = encoders_of(sensing)
    it = core().ffi.new("stewart_sensing *", core().lib.stewart_encoder_sensing(encoders.pointer))
    return Compiled(it, (encoders,))


@Once
def encoders_of(sensing: EncoderSensing) -> Compiled:
    """Return the `stewart_encoders` of encoders."""
    c, it, times = core(), core().ffi.new("stewart_encoders *"), node_times(sensing.samples)
    machine, noise = sensing.mechanism.numbers, sensing.noise_std
    it.geometry, it.noise_std = c.at(machine), c.at(noise)
    it.samples, it.nodes = sensing.samples, len(times)
    it.quantum, it.std = sensing.quantum, sensing.std
    it.node_times = list(times)
    for name in ("initial_state", "rates_std", "motion", "offset"):
        setattr(it, name, list(getattr(sensing, name)))
    return Compiled(it, (machine, noise))
