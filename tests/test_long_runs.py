"""Long runs and many runs: neither memory nor the loops' gaps grow.

What a run records grows with its length by design, some 1.2 kB per 20 ms of signals; what must not
grow is anything beside that.
"""

import gc
import os
import time
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.simulation import make_simulator, simulate
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.signals import POSE


@pytest.fixture(autouse=True)
def young():
    """Collect only what a test makes: the objects of other tests take tenths of a second."""
    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


ON_REFERENCE = ("start=on_reference", "queue=reference")
STEADY = ("reference.frequency=0.5", "delay.steps=3", *ON_REFERENCE)
MB = 1e6


def memory():
    """Return the resident memory of this process in bytes, after a garbage collection."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return float(pages * os.sysconf("SC_PAGE_SIZE"))


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="memory is read from /proc"
)


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize(
    ("runs", "warm_up", "most"),
    [(18, 6, 0.1 * MB), pytest.param(1000, 100, 0.02 * MB, marks=pytest.mark.soak)],
)
def test_runs_leave_nothing_behind(runs, warm_up, most):
    """A leak of one context or one compiled function per run would be above."""
    settings = ("duration=0.2", "delay.steps=2", *ON_REFERENCE)
    scenarios = [
        load_scenario("paper", None, (f"plant.kind={kind}", *settings))
        for kind in ("exact", "multibody")
    ]
    sizes = []
    for number in range(warm_up + runs):
        run = simulate(scenarios[number % len(scenarios)])
        assert run.status == "completed"
        if number >= warm_up:
            sizes.append(memory())
    assert np.polyfit(np.arange(runs), sizes, 1)[0] < most  # the slope of a line, bytes per run


def follow(kind, duration, *settings):
    """Return memory and share of error every tenth of the way; nothing is recorded."""
    sc = load_scenario(
        "paper", None, (f"plant.kind={kind}", f"duration={duration}", *STEADY, *settings)
    )
    loop = build_closed_loop(sc)
    simulator = make_simulator(loop)
    context = simulator.get_context()
    simulator.Initialize()
    rows = []
    for end in duration * np.arange(1, 11) / 10:
        for t in np.arange(context.get_time(), end, 5.0):
            simulator.AdvanceTo(min(t + 5.0, end))
        state = loop.GetOutputPort("state").Eval(context)
        reference = loop.GetOutputPort("reference").Eval(context)
        error = np.max(np.abs(state[POSE] - reference[POSE]) / loop.experiment.scale)
        rows.append((memory(), float(error)))
    return np.array(rows).T


@pytest.mark.slow
@needs_proc
@pytest.mark.parametrize(
    ("kind", "duration", "settings", "error"),
    [
        ("exact", 10.0, (), 1e-3),
        ("multibody", 5.0, (), 1e-3),
        pytest.param("exact", 3600.0, (), 1e-3, marks=pytest.mark.soak),
        pytest.param(
            *("multibody", 3600.0, ("plant.time_step=0.002",), 5e-3), marks=pytest.mark.soak
        ),
    ],
)
def test_the_second_half_is_as_good_as_the_first(kind, duration, settings, error):
    sizes, errors = follow(kind, duration, *settings)
    assert sizes[-1] - sizes[4] < 5 * MB
    assert errors.max() < error and errors[5:].max() < 2 * errors[:5].max() + 1e-6


@pytest.mark.soak
@needs_proc
def test_an_hour_is_recorded():
    """The record of an hour grows in proportion and is complete."""
    began, before = time.perf_counter(), memory()
    sc = load_scenario("paper", None, ("plant.kind=exact", "duration=3600", *STEADY))
    run = simulate(sc)
    assert run.status == "completed"
    assert run.signals.sizes["time"] == 180_001
    assert memory() - before < 3000 * MB
    assert run.summary["wall_s"] <= time.perf_counter() - began
