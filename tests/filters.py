"""The filter of core/filter.h alone, for one plant and one sensor."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Estimate
from stewart_drake.law.compiled import machine_of, numbers
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.observers import filter_settings_of
from stewart_drake.law.sensing import (
    FAULTS,
    EncoderSensing,
    Sensing,
    StateSensing,
    described,
    encoders_of,
    state_sensor,
)
from stewart_drake.types import Array


class Period(NamedTuple):
    """Torques (n, 6) that acted between two samples for `durations` (n,), and the next one (6,)."""

    torques: Array
    durations: Array
    following: Array
    substeps: int


@dataclass(frozen=True)
class FilterEstimate(Estimate):
    """An estimate with the rest of a `stewart_posterior`."""

    outlier: Array
    outliers: int
    unseen: int
    partly: tuple[str, ...]
    root: Array
    squares: float
    values: float
    disagreed: float
    noise: Array

    @classmethod
    def of(cls, memory: Array, n: int, m: int) -> "FilterEstimate":
        """Return the estimate that a `stewart_posterior` holds."""
        mean, root, outlier, counts = np.split(memory, [n, n + n * n, n + n * n + m])
        counts, noise = np.split(counts, [6])
        L, (outliers, unseen, bits) = root.reshape(n, n), counts[:3].astype(int)
        partly = tuple(name for i, name in enumerate(FAULTS) if bits >> i & 1)
        return cls(mean, L @ L.T, outlier, outliers, unseen, partly, L, *counts[3:], noise)


@dataclass(frozen=True)
class Filter:
    """The filter; encoders have the values `last` (6 N,) before and periods `still` (6,)."""

    dynamics: StewartDynamics
    sensing: Sensing
    settings: FilterSettings
    last: Array | None = None
    still: Array | None = None

    def _filter(self) -> Any:
        c = core()
        machine = machine_of(NominalPlant(self.dynamics, 1, np.inf, TorqueLimit()))
        settings = filter_settings_of(self.settings, self.sensing.size)
        it = c.ffi.new("stewart_filter *", settings.pointer.filter)
        if isinstance(self.sensing, EncoderSensing):
            encoders = encoders_of(self.sensing)
            sensing: Any = c.lib.stewart_encoder_sensing(encoders.pointer)
            kept = encoders, c.ffi.new("stewart_sensing *", sensing)
            it.encoder_step = c.ffi.addressof(c.lib, "stewart_encoder_filter_step")
        else:
            kept = self._state_sensing()
        it.machine, it.sensing = machine.pointer, kept[1]
        return it, (machine, settings, kept)

    def _state_sensing(self) -> tuple[Any, Any]:
        if type(self.sensing) is not StateSensing:
            return None, described(self.sensing, self.dynamics.mechanism).pointer
        c, sensor = core(), state_sensor(self.sensing)
        return sensor, c.ffi.new("stewart_sensing *", c.lib.stewart_state_sensing(sensor.pointer))

    def start(self, values: Array, parameters: Array) -> FilterEstimate:
        """Return the estimate from values (m,) alone."""
        it, _kept = self._filter()
        c, n, m = core(), 12 + len(parameters), self.sensing.size
        memory = np.zeros(c.lib.stewart_posterior_size(n, m))
        given = map(c.at, (numbers(values), numbers(parameters), None, memory))
        assert c.lib.stewart_filter_start(it, *given, c.scratch(100_000))
        memory[-c.ffi.sizeof("stewart_noise") // 8] = 1.0  # as stewart_noise_start
        return FilterEstimate.of(memory, n, m)

    def advance(self, estimate: Estimate, period: Period, values: Array | None) -> FilterEstimate:
        """Return the estimate a period later, with values (m,) at its end, or none."""
        it, _kept = self._filter()
        c, n, m = core(), len(estimate.mean), self.sensing.size
        if isinstance(estimate, FilterEstimate):
            bits = sum(1 << FAULTS.index(name) for name in estimate.partly)
            counts = [estimate.outliers, estimate.unseen, bits]
            counts += [estimate.squares, estimate.values, estimate.disagreed]
            root, outlier, noise = estimate.root, estimate.outlier, estimate.noise
        else:
            root, outlier = np.linalg.cholesky(estimate.covariance), np.full(m, np.nan)
            counts, noise = [0] * 6, np.eye(1, 12 + c.ffi.sizeof("stewart_noise") // 8, 12)[0]
        memory = np.concatenate([estimate.mean, root.ravel(), outlier, counts, noise])
        torques, durations, following = map(numbers, period[:3])
        schedule = [len(torques), c.at(torques), c.at(durations), period.substeps]
        interval = c.ffi.new("stewart_interval *", [schedule, c.at(torques), c.at(following)])
        history = c.ffi.new("stewart_history *", [c.at(self.last), c.at(self.still)])
        y = None if values is None else numbers(values)
        given = interval, c.at(y), history, c.at(memory)
        c.lib.stewart_filter_advance(it, *given, c.scratch(100_000))
        return FilterEstimate.of(memory, n, m)
