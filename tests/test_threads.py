"""Runs in several threads of one process give, bit for bit, what each gives alone."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import pytest

import stewart_drake as sd
from stewart_drake.dynamics.native_functions import functions_of

ON_REFERENCE = ("start=on_reference", "queue=reference")


def variants(duration):
    """Both plants, delays of whole periods and parts, with and without noise, four gains."""
    delays = (("delay.steps=2",), ("delay.steps=1", "delay.fraction=0.5"))
    noises = ((), ("sensor.noise_std=[1e-4,1e-4,1e-4,1e-5,1e-5,1e-5,0,0,0,0,0,0]",))
    plants = (("plant.kind=exact",), ("plant.kind=multibody",))
    # The plants turn over first: neighbours, which run at the same time, are as unlike as can be.
    for w_R, delay, noise, plant in itertools.product(range(1, 6), delays, noises, plants):
        own = (f"duration={duration}", f"controller.w_R={w_R}", f"sensor.seed={w_R}")
        yield (*plant, *delay, *noise, *own, *ON_REFERENCE)


def run(settings):
    return sd.simulate(sd.load_scenario("paper", settings=settings), judge_stability=False).signals


def differing(settings, threads):
    """Of the runs, those whose signals are not the same in threads as alone."""
    functions_of.cache_clear()  # so that the threads also make them at the same time
    with ThreadPoolExecutor(threads) as pool:
        together = list(pool.map(run, settings))
    alone = [run(one) for one in settings]
    pairs = zip(settings, alone, together, strict=True)
    return [one for one, a, b in pairs if not a.identical(b)]


def test_runs_in_threads_are_those_alone():
    assert differing(list(itertools.islice(variants(0.4), 6)), threads=3) == []


@pytest.mark.soak
def test_forty_runs_in_eight_threads_are_those_alone():
    settings = list(variants(1.0))
    assert len(settings) == 40
    assert differing(settings, threads=8) == []
