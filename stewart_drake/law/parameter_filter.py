"""The filter of core/filter.h over the state and constant parameters of the plant."""

from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import Estimate
from stewart_drake.law.compiled import Compiled, Once, machine_of, numbers
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.sensing import FAULTS, Sensing, causes, compiled_sensing
from stewart_drake.scenario.calibration import OFFSETS
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array

OUTLIER = 1e-6
"""Share of the measurements, were all as the filter believes, that are taken for outliers."""


class Period(NamedTuple):
    """Torques that acted between two samples, if the delay is the assumed one."""

    torques: Array
    """(n, 6) N m, one after the other."""
    durations: Array
    """(n,) s."""
    following: Array
    """(6,) N m, acts next."""
    substeps: int
    """Integration steps per torque."""


@cache
def gate(size: int) -> float:
    """Return the squared normalised innovation beyond which `size` values are an outlier."""
    return float(chdtri(size, OUTLIER))


@dataclass(frozen=True)
class ParameterFilter:
    """The filter for one plant and sensor.

    Attributes:
        dynamics: of the plant.
        sensing: what is measured of it.
        settings: what else is assumed.
    """

    dynamics: StewartDynamics
    sensing: Sensing
    settings: FilterSettings

    def start(
        self, measurement: Measurement, parameters: Array, near: Array | None = None
    ) -> Estimate | None:
        """Return the estimate from one measurement alone, or None where it fixes no state.

        Args:
            measurement: without a fault.
            parameters: (p,) for a guess.
            near: (12,) as of `Sensing.start`.
        """
        n, m = NUM_STATE + len(parameters), self.sensing.size
        c = core()
        memory = np.empty(c.lib.stewart_posterior_size(n, m))
        values, theta = measurement.known(m), numbers(parameters)
        expected = None if near is None else numbers(near, NUM_STATE)
        given = map(c.at, (values, theta, expected, memory))
        found = self._call(c.lib.stewart_filter_start, 1, *given)
        return estimate_of(memory, n, m) if found else None

    def advance(
        self, estimate: Estimate, period: Period, measurement: Measurement | None
    ) -> Estimate:
        """Return the estimate a period later, with a measurement at its end, or none."""
        c, n, m = core(), len(estimate.mean), self.sensing.size
        memory = _memory(estimate)
        torques, durations, following = map(numbers, period[:3])
        schedule = [len(torques), c.at(torques), c.at(durations), period.substeps]
        acted = c.ffi.new("stewart_interval *", [schedule, c.at(following)])
        values = None if measurement is None else measurement.known(m)
        before = [numbers(a) for a in self._before()]
        history = c.ffi.new("stewart_history *", list(map(c.at, before)))
        given = (acted, c.at(values), history, c.at(memory))
        self._call(c.lib.stewart_filter_advance, len(torques), *given)
        return estimate_of(memory, n, m)

    def _before(self) -> tuple[Array, Array]:
        """Return what encoders showed before, `last` and `still`; nothing for another sensor."""
        return np.empty(0), np.empty(0)

    def _compiled(self) -> Compiled:
        return compiled_filter(self.dynamics, self.sensing, self.settings)

    def _call(self, function: Any, torques: int, *given: Any) -> Any:
        compiled, c = self._compiled(), core()
        scratch = c.scratch(c.lib.stewart_filter_scratch(compiled.it, torques))
        found = function(compiled.it, *given, scratch)
        compiled.require_calm()
        return found


@Once
def compiled_filter(
    dynamics: StewartDynamics,
    sensing: Sensing,
    settings: FilterSettings,
    within: bool = False,
) -> Compiled:
    """Return the `stewart_filter` for one plant and sensor.

    Args:
        dynamics: of the plant.
        sensing: what is measured of it.
        settings: what else is assumed.
        within: whether these are encoders, to be read within periods.
    """
    c, known, p = core(), settings.parameters, len(dynamics.free)
    machine, seen = machine_of(dynamics), compiled_sensing(sensing)
    free = np.full(NUM_STATE, np.inf)
    arrays = {
        "model_std": numbers(settings.model_std, NUM_STATE),
        "prior_root": numbers(np.linalg.cholesky(known.covariance), p, p),
        "usual_std": numbers(known.usual_std, p),
        "lower": numbers([*-free, *known.lower], NUM_STATE + p),
        "upper": numbers([*free, *known.upper], NUM_STATE + p),
    }
    it = c.ffi.new("stewart_filter *")
    it.machine, it.sensing, it.gate = machine.it, seen.it, gate(sensing.size)
    it.legs = c.ffi.addressof(c.lib, "stewart_encoder_legs") if within else c.ffi.NULL
    it.timing_std = settings.timing_std
    it.offsets = known.names.index(OFFSETS[0]) if OFFSETS[0] in known.names else -1
    for name, array in arrays.items():
        setattr(it, name, c.at(array))
    return Compiled(it, (machine, seen, arrays), seen.raised)


def _memory(estimate: Estimate) -> Array:
    """Return the vector of a `stewart_posterior`."""
    c, root = core(), estimate.root
    if np.isnan(root[0, 0]):
        root = numbers(estimate.covariance)
        if not c.lib.stewart_root(len(root), c.at(root)):
            root.fill(np.nan)
    bits = sum(1 << i for i, name in enumerate(FAULTS) if name in estimate.partly)
    counts = (estimate.outliers, estimate.unseen, bits)
    return np.concatenate([estimate.mean, root.ravel(), estimate.outlier, counts])


def estimate_of(memory: Array, n: int, m: int) -> Estimate:
    """Return what the vector of a `stewart_posterior` says, for n of xi and m values."""
    mean, root, outlier, counts = np.split(memory, [n, n + n * n, n + n * n + m])
    L, (outliers, unseen, bits) = root.reshape(n, n), counts.astype(int)
    return Estimate(mean, L @ L.T, outlier, outliers, unseen, causes(bits), L)
