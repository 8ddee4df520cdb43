"""The measurement y = h(x) + noise: its model, first states from it, and its faults.

The law and its observers know a sensor by `Sensing` alone. A measurement that is *missing* is
marked so. One that is *frozen* repeats the last one bit for bit, where that cannot be. One that
the machine cannot have is *rejected*. An outlier, or a sensor that froze while the plate was at
rest, is found by the filter (`law.parameter_filter`), which has a model of the motion.
The numbers are those of core/sensing.h.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.compiled import Compiled, Once, geometry, numbers
from stewart_drake.law.measurement import Measurement
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE
from stewart_drake.types import Array

FAULTS = ("measurements_missing", "measurements_frozen", "measurements_rejected")
"""Counts by the bits of `STEWART_MISSING` and so on."""


class FirstState(NamedTuple):
    """State that follows from one measurement alone."""

    state: Array
    """(12,)."""
    covariance: Array
    """(12, 12)."""


class Sensing(Protocol):
    """A kind of sensor. Instances are immutable."""

    @property
    def size(self) -> int:
        """m, the number of values."""
        ...

    @property
    def noise_std(self) -> Array:
        """(m,) standard deviations of the values."""
        ...

    def seen(self, state: Array) -> Array:
        """h(x), the values (m,) of a state (12,) without noise."""
        ...

    def through(self, state: Array, changes: Array) -> Array:
        """H X (m, ...), H = dh/dx at a state (12,), of changes X (12, ...) of the state."""
        ...

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """Return the fault of a measurement, as the name of a count, or None.

        Args:
            measurement: of m values.
            last: (m,) what each value was before; NaN for nothing.
            period: s since the sample before.
            mechanism: as the controller knows it.

        Raises:
            ValueError: a shape that does not fit.
        """
        ...

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """The state from a measurement without a fault alone, or None where it tells of none.

        Args:
            measurement: of m values.
            near: (12,) where the plate is thought to be, for a sensor that cannot do without; None
                is as at the beginning.
        """
        ...

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """Return the number of periods for which each code has been constant, for encoders.

        Args:
            measurement: of m values.
            last: (m,) what each value was before; NaN for nothing.
            still: what this said before; of no size before any.
        """
        ...

    def now(self, measurement: Measurement) -> "tuple[Sensing, Measurement]":
        """Return the part of a measurement that was taken at the sample itself, and its sensing.

        For an observer that compares it with the state at the sample alone.
        """
        ...


@dataclass(frozen=True)
class StateSensing:
    """Pose and rates themselves: h(x) = x.

    Attributes:
        noise_std: (12,) rad, m and per s.
        motion: (6,) how far each coordinate is expected to move, rad and m.
        anywhere: whether poses out of the machine's reach are believed.
    """

    noise_std: Array
    motion: Array
    anywhere: bool = False

    @property
    def size(self) -> int:
        """The number of states."""
        return NUM_STATE

    def seen(self, state: Array) -> Array:
        """The state."""
        return state

    def through(self, state: Array, changes: Array) -> Array:
        """The changes themselves."""
        return changes

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """See `Sensing.fault`; one value that is lost loses the others."""
        c, values, before = core(), measurement.known(self.size), numbers(last, self.size)
        sensor, legs = state_sensor(self).it, geometry(mechanism)
        found = c.lib.stewart_state_fault(
            sensor, *map(c.at, (legs,)), period, c.at(values), c.at(before)
        )
        return next(iter(causes(found)), None)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState:
        """The measurement, as uncertain as its noise."""
        return FirstState(measurement.values, np.diag(self.noise_std**2))

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """Nothing that matters."""
        return still

    def now(self, measurement: Measurement) -> tuple[Sensing, Measurement]:
        """Return both: all values are of the sample."""
        return self, measurement

    def compiled(self) -> Compiled:
        """Return the `stewart_sensing`."""
        sensor, noise = state_sensor(self), numbers(self.noise_std, NUM_STATE)
        sensing = core().lib.stewart_state_sensing(sensor.it)
        return Compiled(core().ffi.new("stewart_sensing *", sensing), (sensor, noise))


@Once
def state_sensor(sensing: StateSensing) -> Compiled:
    sensor = core().ffi.new("stewart_state_sensor *")
    sensor.noise_std = list(numbers(sensing.noise_std, NUM_STATE))
    sensor.motion = list(numbers(sensing.motion, NUM_COORDINATES))
    sensor.anywhere = sensing.anywhere
    return Compiled(sensor)


def causes(bits: int) -> tuple[str, ...]:
    """Return the counts of bits of `STEWART_MISSING` and so on."""
    return tuple(name for i, name in enumerate(FAULTS) if bits >> i & 1)


@Once
def compiled_sensing(sensing: Sensing) -> Compiled:
    """Return the `stewart_sensing` of a sensor.

    C calls Python for a class that has no method `compiled` of its own, not an inherited one.
    """
    own = vars(type(sensing)).get("compiled")
    return _of_python(sensing) if own is None else own(sensing)


def _of_python(sensing: Sensing) -> Compiled:
    c, m, raised = core(), sensing.size, list[BaseException]()
    noise, kind = numbers(sensing.noise_std, m), "const stewart_sensing *, const real *,"
    started = "const real *, real *, real *, stewart_scratch"

    def read(pointer: Any, number: int) -> Array:
        return np.frombuffer(c.ffi.buffer(pointer, 8 * number)).copy()

    def write(pointer: Any, values: Array, shape: tuple[int, ...]) -> None:
        there = np.frombuffer(c.ffi.buffer(pointer, 8 * int(np.prod(shape)))).reshape(shape)
        there[...] = values

    def failed(_: Any, error: BaseException, __: Any) -> None:
        raised.append(error)

    def seen(_: Any, state: Any, values: Any) -> None:
        write(values, np.nan, (m,))
        write(values, sensing.seen(read(state, NUM_STATE)), (m,))

    def jacobian(_: Any, state: Any, J: Any) -> None:
        write(J, np.nan, (m, NUM_STATE))
        write(J, sensing.through(read(state, NUM_STATE), np.eye(NUM_STATE)), (m, NUM_STATE))

    def start(_: Any, values: Any, near: Any, state: Any, root: Any, __: Any) -> int:
        expected = None if near == c.ffi.NULL else read(near, NUM_STATE)
        first = sensing.start(Measurement.of(read(values, m)), expected)
        if first is None:
            return 0
        write(state, first.state, (NUM_STATE,))
        write(root, first.covariance, (NUM_STATE, NUM_STATE))
        return int(c.lib.stewart_root(NUM_STATE, root))

    functions = (
        c.ffi.callback(f"void({kind} real *)", seen, onerror=failed),
        c.ffi.callback(f"void({kind} real *)", jacobian, onerror=failed),
        c.ffi.callback(f"int({kind} {started})", start, onerror=failed),
    )
    it = c.ffi.new("stewart_sensing *", [m, c.at(noise), c.ffi.NULL, *functions])
    return Compiled(it, (noise, *functions), (raised,))
