"""The way back onto a reference after a gap in it."""

import numpy as np
import pytest

from stewart_drake.law.return_path import ReturnPath
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import ACCELERATIONS, NUM_STATE


def path(period, seed=1):
    offset = np.random.default_rng(seed).normal(0, 1, NUM_STATE)
    return ReturnPath.of(offset, Timeline(period, Delay(8, 0.0)))


@pytest.mark.parametrize(("period", "holds"), [(0.1, 3), (0.02, 15), (0.15, 2), (0.5, 2)])
def test_it_takes_the_time_of_a_catch_up_or_two_holds(period, holds):
    assert path(period).holds == holds


@pytest.mark.parametrize("period", [0.02, 0.1, 0.5])
def test_it_ends_at_rest_relative_to_the_reference(period):
    back, size = path(period), np.abs(path(period).offset).max()
    n = back.holds
    assert np.abs(back.at(n * period, period)[:NUM_STATE]).max() < 1e-12 * size / period
    assert not np.any(back.at((n + 0.01) * period, period))
    for _ in range(n + back.samples):
        assert back.active
        back = back.after(period)
    assert not back.active


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_its_accelerations_are_the_least(period):
    """The solution of least norm of the 2 equations per coordinate, by lstsq."""
    back, h = path(period), period
    n = back.holds
    A = np.array([h * h * (n - np.arange(n) - 0.5), np.full(n, h)])
    pose, rates = back.offset[:6], back.offset[6:]
    least = np.linalg.lstsq(A, -np.array([pose + n * h * rates, rates]))[0]
    found = [back.at((i + 0.5) * h, h)[ACCELERATIONS] for i in range(n)]
    assert np.allclose(found, least, rtol=1e-9)


def test_the_rest_of_a_path_is_the_same_path():
    back, h = path(0.1), 0.1
    for time in (0.0, 0.03, 0.1, 0.17):
        assert np.allclose(back.after(h).at(time, h)[:12], back.at(time + h, h)[:12], atol=1e-12)
