"""The measurement y = h(x) + noise: its model, first states from it, and its faults.

The law and its observers know a sensor by `Sensing` alone. A measurement that is *missing* is
marked so. One that is *frozen* repeats the last one bit for bit, where that cannot be. One that
the machine cannot have is *rejected*. The filter (core/filter.h), which has a model of the motion,
finds outliers, and a sensor that froze while the plate was at rest.
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
    """State (12,) and covariance (12, 12) from one measurement alone."""

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
        """Return the state from one measurement without a fault, or None where it fixes none.

        Args:
            measurement: of m values.
            near: (12,) expected state, for a sensor that needs one; None at the beginning.
        """
        ...


@dataclass(frozen=True)
class StateSensing:
    """Measurement of pose and rates: h(x) = x.

    Attributes:
        noise_std: (12,) rad, m and per s.
        motion: (6,) expected range of each coordinate, rad and m.
        anywhere: whether poses out of the machine's reach are accepted.
    """

    noise_std: Array
    motion: Array
    anywhere: bool = False

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
        given = c.at(geometry(mechanism)), period, c.at(values), c.at(before)
        sensor = c.lib.stewart_state_sensing(state_sensor(self).it)
        found = sensor.fault(c.ffi.addressof(sensor), *given)
        return next((name for i, name in enumerate(FAULTS) if found >> i & 1), None)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState:
        """Return the measurement, with the variance of its noise."""
        return FirstState(measurement.values, np.diag(self.noise_std**2))


@Once
def state_sensor(sensing: StateSensing) -> Compiled:
    """Return the `stewart_state_sensor`."""
    sensor = core().ffi.new("stewart_state_sensor *")
    sensor.noise_std = list(numbers(sensing.noise_std, NUM_STATE))
    sensor.motion = list(numbers(sensing.motion, NUM_COORDINATES))
    sensor.anywhere = sensing.anywhere
    return Compiled(sensor)


@Once
def described(sensing: Sensing, mechanism: Mechanism) -> Compiled:
    """Return the `stewart_sensing` of a sensor that is written in Python, which C calls back."""
    c, m, raised = core(), sensing.size, list[BaseException]()
    noise = numbers(sensing.noise_std, m)

    def read(pointer: Any, number: int) -> Array:
        return np.frombuffer(c.ffi.buffer(pointer, 8 * number)).copy()

    def write(pointer: Any, values: Array | float, *shape: int) -> None:
        there = np.frombuffer(c.ffi.buffer(pointer, 8 * int(np.prod(shape)))).reshape(shape)
        there[...] = values

    def failed(_: Any, error: BaseException, __: Any) -> None:
        raised.append(error)

    def seen(_: Any, state: Any, values: Any) -> None:
        write(values, np.nan, m)
        write(values, sensing.seen(read(state, NUM_STATE)), m)

    def jacobian(_: Any, state: Any, J: Any) -> None:
        write(J, np.nan, m, NUM_STATE)
        write(J, sensing.through(read(state, NUM_STATE), np.eye(NUM_STATE)), m, NUM_STATE)

    def start(_: Any, values: Any, near: Any, state: Any, root: Any, __: Any) -> int:
        expected = None if near == c.ffi.NULL else read(near, NUM_STATE)
        first = sensing.start(Measurement.of(read(values, m)), expected)
        if first is None:
            return 0
        write(state, first.state, NUM_STATE)
        write(root, first.covariance, NUM_STATE, NUM_STATE)
        return int(c.lib.stewart_root(NUM_STATE, root))

    def fault(_: Any, __: Any, period: float, values: Any, last: Any) -> int:
        found = sensing.fault(Measurement.of(read(values, m)), read(last, m), period, mechanism)
        return 0 if found is None else 1 << FAULTS.index(found)

    it = c.ffi.new("stewart_sensing *", [m, c.at(noise)])
    functions = []
    for function in (seen, jacobian, start, fault):
        kind = c.ffi.typeof(getattr(it, function.__name__))
        functions.append(c.ffi.callback(kind, function, onerror=failed))
        setattr(it, function.__name__, functions[-1])
    return Compiled(it, (noise, *functions), (raised,))
