"""Runs in several threads of one process give, bit for bit, what each gives alone."""

import itertools
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from threadpoolctl import OpenBLASController, threadpool_info, threadpool_limits

import stewart_drake as sd
from stewart_drake.dynamics.native_functions import functions_of
from stewart_drake.loop import simulation

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


def blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_linear_algebra_stays_on_one_thread_until_the_last_run_ends(monkeypatch):
    """Of two runs that overlap, neither the first to begin nor the first to end decides alone."""
    begun, both = threading.Event(), threading.Event()
    seen = []

    def run(experiment, *_):
        seen.append(blas_threads())
        if experiment.scenario.duration == 1.0:
            begun.set()
            assert both.wait(10)
        else:
            both.set()
            first.result(10)  # it has ended meanwhile
            seen.append(blas_threads())

    monkeypatch.setattr(simulation, "_run", run)
    with ThreadPoolExecutor(2) as pool:
        pool.submit(set_blas_threads, 2).result(10)
        assert blas_threads() == {2}
        first = pool.submit(simulation.simulate, sd.Scenario(duration=1.0), judge_stability=False)
        assert begun.wait(10)
        pool.submit(simulation.simulate, sd.Scenario(duration=2.0), judge_stability=False).result(
            10
        )
        assert seen == [{1}] * 3
        assert blas_threads() == {2}


def set_blas_threads(number):
    threadpool_limits(number, user_api="blas")
    OpenBLASController.clear_controlling_thread()
