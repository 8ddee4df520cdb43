"""The filters compiled in single precision against themselves in double, along a recorded run."""

import os
import subprocess
from typing import Any

import numpy as np
import pytest
from cffi import FFI

import stewart_drake as sd
from stewart_drake.core import build, library
from stewart_drake.law.delay_observer import DelayBelief, DelayObserver
from stewart_drake.law.encoder_sensing import EncoderSensing
from stewart_drake.law.parameter_filter import ParameterFilter, gate
from stewart_drake.mechanism.geometry import geometry_of
from tests.backends import stepped_in_python

HOST = ("dop853", "plant")
"""Sources for the host alone, in double precision."""


class Single:
    """The core in single precision, and numbers for it."""

    def __init__(self, folder):
        made = folder / "single.so"
        sources = [str(c) for c in build.FOLDER.glob("*.c") if c.stem not in HOST]
        compiler = build.compiler() or pytest.skip("needs a C compiler")
        options = ["-std=c99", "-O1", "-DSTEWART_FLOAT", "-fPIC", "-shared", "-o", str(made)]
        subprocess.run([*compiler, *options, *sources, "-lm"], check=True)
        self.ffi, self._kept = FFI(), list[Any]()
        self.ffi.cdef(library.declarations().replace("typedef double real", "typedef float real"))
        self.lib: Any = self.ffi.dlopen(os.fspath(made))

    def at(self, values):
        """Pointer to numbers that stay."""
        self._kept.append(np.array(values, np.float32, order="C"))
        return self.ffi.from_buffer("float[]", self._kept[-1])

    def machine(self, dynamics):
        """`stewart_machine` with eight parameters."""
        machine = self.ffi.new("stewart_machine *")
        machine.geometry = list(geometry_of(dynamics.mechanism))
        machine.parameters, machine.gravity = list(dynamics.plant_parameters), dynamics.gravity
        machine.estimated, machine.place = 8, list(range(8))
        self._kept.append(machine)
        return machine

    def state_sensing(self, sensing):
        """`stewart_sensing` of the state."""
        sensor = self.ffi.new("stewart_state_sensor *")
        sensor.noise_std = list(sensing.noise_std)
        self._kept.append(sensor)
        return self.lib.stewart_state_sensing(sensor)

    def delay(self, observer, sensing, plant):
        """`stewart_delay` of an observer of eight parameters and the state."""
        known, told, it = observer.settings, observer.delay, self.ffi.new("stewart_delay *")
        theta, seen = known.parameters, self.ffi.new("stewart_sensing *")
        seen[0], it.machine = self.state_sensing(sensing), self.machine(plant.dynamics)
        it.machine.gentle_torque, it.machine.substeps = plant.gentle_torque, plant.substeps
        it.sensing, it.period, it.model_std = seen, 0.1, list(known.model_std)
        it.prior, it.prior_root = self.at(theta.prior), self.at(np.diag(theta.std))
        it.std, it.usual_std = self.at(theta.std), self.at(theta.usual_std)
        it.lower, it.upper = self.at(theta.lower), self.at(theta.upper)
        it.gate, it.first_timing, it.timing_std = gate(12), known.timing_std, told.timing_std
        it.believed, it.delay_std, it.longest = observer.believed, told.std, told.longest
        it.walk, it.rate_std, it.rate_walk = told.walk, told.rate_std, told.rate_walk
        it.quiet = observer.quiet
        self._kept.append(seen)
        return it

    def filter(self, one):
        """`stewart_filter` of a filter of eight parameters."""
        new, dynamics, known = self.ffi.new, one.dynamics, one.settings.parameters
        machine, sensing = self.machine(dynamics), one.sensing
        it, free = new("stewart_filter *"), np.full(12, np.inf)
        if isinstance(sensing, EncoderSensing):
            sensor = new("stewart_encoders *")
            sensor.geometry = self.at(geometry_of(dynamics.mechanism))
            sensor.noise_std = self.at(sensing.noise_std)
            sensor.samples, sensor.nodes = sensing.samples, len(sensing.shares)
            sensor.quantum, sensor.std = sensing.quantum, sensing.std
            for name in ("shares", "declared", "rates_std", "motion", "offset"):
                setattr(sensor, name, list(getattr(sensing, name)))
            made = self.lib.stewart_encoder_sensing(sensor)
            it.legs = self.ffi.addressof(self.lib, "stewart_encoder_legs")
        else:
            made, sensor = self.state_sensing(sensing), None
        seen = new("stewart_sensing *", made)
        self._kept += [sensor, seen]
        it.machine, it.sensing, it.offsets, it.gate = machine, seen, -1, gate(sensing.size)
        it.timing_std, it.model_std = one.settings.timing_std, self.at(one.settings.model_std)
        it.prior_root, it.usual_std = self.at(np.diag(known.std)), self.at(known.usual_std)
        it.lower = self.at([*-free, *known.lower])
        it.upper = self.at([*free, *known.upper])
        return it


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """Compiled once."""
    return Single(tmp_path_factory.mktemp("single"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor",
    [
        ("sensor.loss=0.001", "plant.payload_mass=0.3"),
        ("sensor.kind=encoders",),
        ("sensor.kind=encoders", "sensor.bits=null"),
        ("sensor.kind=encoders", "sensor.bits=16", "sensor.samples=20"),
    ],
)
def test_a_filter_is_right_to_a_share_of_its_deviation(sensor, single, monkeypatch):
    """Every estimate to 3 % of its standard deviation, which is that of double to 0.1 %."""
    calls = []
    advance = ParameterFilter.advance

    def recorded(one, *given):
        calls.append((one, *given, advance(one, *given)))
        return calls[-1][-1]

    stepped_in_python(monkeypatch)  # which calls the filter by itself
    monkeypatch.setattr(ParameterFilter, "advance", recorded)
    sd.simulate(sd.load_scenario("paper", None, ("duration=4", *sensor)), judge_stability=False)
    before = None
    filter_, m = single.filter(calls[0][0]), calls[0][0].sensing.size
    for one, estimate, period, measurement, after in calls:
        if before is None or estimate.mean is not before:  # another run: the law warms up
            n = len(estimate.mean)
            root = np.linalg.cholesky(estimate.covariance + 1e-30 * np.eye(n))
            counts = (estimate.outliers, estimate.unseen, 0)
            memory = np.array([*estimate.mean, *root.ravel(), *estimate.outlier, *counts], "f4")
        schedule = [len(period.torques), *map(single.at, period[:2]), period.substeps]
        acted = single.ffi.new("stewart_interval *", [schedule, single.at(period.following)])
        history = single.ffi.new("stewart_history *", list(map(single.at, one._before())))
        values = single.ffi.NULL if measurement is None else single.at(measurement.known(m))
        number = single.lib.stewart_filter_scratch(filter_, len(period.torques))
        given = (filter_, acted, values, history, single.ffi.from_buffer("float[]", memory))
        single.lib.stewart_filter_advance(*given, [single.ffi.new("float[]", number)])
        L = memory[n : n + n * n].reshape(n, n).astype(np.float64)
        std = np.sqrt(np.diag(after.covariance))
        assert np.all(np.abs(memory[:n] - after.mean) <= 0.03 * std)
        assert np.sqrt(np.sum(L**2, axis=1)) == pytest.approx(std, rel=1e-3)
        assert memory[-3] == after.outliers
        before = after.mean
    assert len(calls) > 30


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        ("controller.delay_steps=6", "overlay=dirty", "duration=3"),
        (
            *("start=on_reference", "queue=reference", "overlay=dirty", "duration=4"),
            *("delay.jump=0.1", "delay.jump_time=2"),
        ),
        (
            *("start=on_reference", "queue=reference", "duration=3"),
            *("delay.drift=0.005", "controller.delay_estimator=drifting"),
        ),
    ],
)
def test_the_delay_is_found_to_microseconds_of_that_in_double(settings, single, monkeypatch):
    """At every sample, through the search, a jump, and drift."""
    calls = []
    observe = DelayObserver.observe

    def recorded(one, *given):
        calls.append((one, *given, observe(one, *given)))
        return calls[-1][-1]

    stepped_in_python(monkeypatch)
    monkeypatch.setattr(DelayObserver, "observe", recorded)
    scenario = sd.load_scenario("paper", "adaptive_lqi", ("plant.kind=exact", *settings))
    sd.simulate(scenario, judge_stability=False)
    lib, ffi = single.lib, single.ffi
    for observer, before, measurement, in_flight, sensing, plant, after in calls:
        assert isinstance(after, DelayBelief)
        if not len(before.numbers):
            delay, sizes = single.delay(observer, sensing, plant), (8, 12, len(in_flight))
            numbers = ffi.new("float[]", lib.stewart_delay_size(*sizes))
            memory = ffi.cast("stewart_delay_memory *", numbers)
            scratch = [ffi.new("float[]", lib.stewart_delay_scratch(*sizes))]
            lib.stewart_delay_start(delay, len(in_flight), memory)
        used = after.fault in (None, "measurements_rejected")
        y = single.at(measurement.values) if used else ffi.NULL
        given = (len(in_flight), single.at(in_flight), y, single.at(before.state))
        lib.stewart_delay_observe(delay, *given, memory, scratch)
        assert memory.eta == pytest.approx(after.timeline.arrival, abs=3e-6)
        assert (memory.cells, memory.settled) == (after.memory.cells, after.settled)
        assert memory.std == pytest.approx(after.delay_std, rel=1e-2)
    assert after.settled
