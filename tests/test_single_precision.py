"""The filters compiled in single precision against themselves in double, along a recorded run."""

import os
import subprocess
from typing import Any

import numpy as np
import pytest
from cffi import FFI

import stewart_drake as sd
from stewart_drake.core import build, library
from stewart_drake.law.compiled import address_of
from stewart_drake.law.observers import CoreObserver
from tests.backends import with_own

HOST = ("dop853", "plant", "shooting")
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

    def law(self, observer, sensing, plant, timeline):
        """`stewart_law` with what an observer reads of it."""
        made = observer.law(timeline, sensing, plant)
        known = {
            one.ctypes.data if isinstance(one, np.ndarray) else address_of(one): one
            for one in made.pointed()
        }
        law = self._copy(made.pointer, known)
        table, read = (
            library.core().symbols[address_of(one)]
            for one in (made.pointer.observer, made.pointer.make_sensing)
        )
        law.observer, law.make_sensing = (
            self.ffi.addressof(self.lib, table),
            getattr(self.lib, read),
        )
        return law

    def _copy(self, pointer, known):
        kind = library.core().ffi.typeof(pointer).item.cname
        copy = self.ffi.new(f"{kind} *")
        self._kept.append(copy)
        self._fill(copy, pointer[0], known)
        return copy

    def _fill(self, copy, data, known):
        for name, field in library.core().ffi.typeof(data).fields:
            value, kind = getattr(data, name), field.type.kind
            if kind == "struct":
                self._fill(getattr(copy, name), value, known)
            elif kind == "array":
                setattr(copy, name, list(value))
            elif kind == "pointer":
                one = known.get(address_of(value))
                if isinstance(one, np.ndarray):
                    setattr(copy, name, self.at(one))
                elif one is not None:
                    setattr(copy, name, self._copy(one, known))
            elif kind != "function":
                setattr(copy, name, value)

    def observe(self, law, memory, measurement, in_flight):
        """One sample of the observer of a law; `memory` is None before the first."""
        observer, ffi = law.observer, self.ffi
        if memory is None:
            memory = np.empty(observer.memory(law), np.float32)
            observer.start(law, ffi.from_buffer("float[]", memory))
        values = self.at(measurement.known(law.num_values))
        given = ffi.from_buffer("float[]", memory), len(in_flight), self.at(in_flight), values
        observer.observe(law, *given, [ffi.new("float[]", observer.scratch(law))])
        return memory


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """Compiled once."""
    return Single(tmp_path_factory.mktemp("single"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "sensor",
    [
        ("sensor.loss=0.001", "plant.payload_mass=0.2"),
        ("sensor.kind=encoders",),
        ("sensor.kind=encoders", "sensor.bits=null"),
        ("sensor.kind=encoders", "sensor.bits=16", "sensor.samples=20"),
    ],
)
def test_a_filter_is_right_to_a_share_of_its_deviation(sensor, single, monkeypatch):
    """Every estimate to 3 % of its standard deviation, which is that of double to 0.1 %."""
    calls = observed("predictor_lqi", ("duration=4", *sensor), monkeypatch)
    for before, after, memory in alongside(single, calls):
        if not before.has_state:
            continue
        n = len(after.estimate.mean)
        L = memory[n : n + n * n].reshape(n, n).astype(np.float64)
        std = np.sqrt(np.diag(after.estimate.covariance))
        assert np.all(np.abs(memory[:n] - after.estimate.mean) <= 0.03 * std)
        assert np.sqrt(np.sum(L**2, axis=1)) == pytest.approx(std, rel=1e-3)
    assert len(calls) > 30


def observed(controller, settings, monkeypatch):
    """Observer, arguments and result of each sample of a run in double precision."""
    calls, observe = [], CoreObserver.observe

    def recorded(one, *given):
        calls.append((one, *given, observe(one, *given)))
        return calls[-1][-1]

    monkeypatch.setattr(CoreObserver, "observe", recorded)
    scenario = sd.load_scenario("paper", controller, settings)
    sd.simulate(scenario, judge_stability=False, modify_law=lambda law: with_own(law, "observer"))
    return calls


def alongside(single, calls):
    """Yield beliefs before and after each call, and the memory of the same in single precision."""
    law, memory = None, None
    for observer, before, measurement, in_flight, sensing, plant, after in calls:
        if law is None:
            law = single.law(observer, sensing, plant, before.timeline)
        memory = single.observe(law, memory, measurement, in_flight)
        yield before, after, memory


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
    """At every sample, through the search, a jump, and drift; 0.3 % of its deviation if larger."""
    calls = observed("adaptive_lqi", ("plant.kind=exact", *settings), monkeypatch)
    for _, after, memory in alongside(single, calls):
        found = single.ffi.from_buffer("stewart_delay_memory *", memory[12:])  # after the state
        bound = max(3e-6, 3e-3 * after.delay_std) if after.settled else 3e-6
        assert found.eta == pytest.approx(after.timeline.arrival, abs=bound)
        assert found.settled == after.settled
        assert found.std == pytest.approx(after.delay_std, rel=1e-2)
    assert after.settled
