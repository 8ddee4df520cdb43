"""Measurements that are missing for a while, against a filter that goes on without them."""

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.filter_settings import filter_settings, usual_parameters
from stewart_drake.law.nominal import NominalPlant, TorqueLimit
from stewart_drake.law.observers import CoreObserver
from stewart_drake.law.sensing import Measurement, StateSensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.timing import Delay
from tests.mechanisms import PAPER

DT = 0.1
AMPLITUDES = np.array([0.2617993878] * 3 + [0.02, 0.02, 0.08])
DYNAMICS = StewartDynamics(PAPER, gravity=False)
PLANT = NominalPlant(DYNAMICS, 20, 1.0, TorqueLimit())
# The model is right and no torque is early or late: what is allowed for that is next to nothing.
SETTINGS = filter_settings(np.full(12, 1e-7), DT, usual_parameters(4.0, 0.02, None), 1e-6)
LONGEST = 10  # gap in periods, as in core/filter_observers.c
NOISE = 1e-3 * np.tile(AMPLITUDES, 2)
SENSING = StateSensing(NOISE, AMPLITUDES)
HOME = np.concatenate([PAPER.home, np.zeros(6)])


def watched(observer, theta, there, seed):
    """Return the belief after samples, some of them lost, and the true state."""
    rng, x = np.random.default_rng(seed), HOME
    timeline = Timeline(DT, Delay(0))
    belief, in_flight = observer.start(timeline, SENSING, PLANT), np.zeros((1, 6))
    for k, seen in enumerate(there):
        values = x + NOISE * rng.standard_normal(12) if seen else np.full(12, np.nan)
        belief = observer.observe(belief, Measurement.of(values), in_flight, SENSING, PLANT)
        torque, state = 0.01 * np.sin(1.3 * k + np.arange(6)), x
        if k < len(there) - 1:
            x = DYNAMICS.predict(x, torque, DT, 20, theta)[-1]
        in_flight = torque[None]
    return belief, state


GAP = (True, True, *[False] * 6, True)


def drawn(seed):
    rng = np.random.default_rng([seed, 7])
    return np.concatenate([rng.normal(0, 1e-3, 6), [rng.uniform(0.1, 0.8), 1e-3]])


def test_what_was_learnt_before_a_gap_counts_after_it():
    """The errors are as large as is said, and what is said is far less than without looking back.

    The mean of 40 sums of 20 squares has a standard deviation of 1.
    """
    squares, narrower = [], []
    for seed in range(40):
        theta = drawn(seed)
        looked, x = watched(CoreObserver(SETTINGS, gaps=True), theta, GAP, seed)
        off = looked.estimate.mean - np.concatenate([x, theta])
        squares.append(off @ np.linalg.solve(looked.estimate.covariance, off))
        without, _ = watched(CoreObserver(SETTINGS), theta, GAP, seed)
        narrower.append(without.estimate.parameter_std / looked.estimate.parameter_std)
    assert 16 < np.mean(squares) < 24
    assert np.median(narrower, axis=0).min() > 3


@pytest.mark.parametrize("length", [0, LONGEST + 1])
def test_without_a_gap_nothing_is_other_and_one_that_is_too_long_is_left_to_the_filter(length):
    theta, there = drawn(1), (True, True, *[False] * length, True)
    one, other = (
        watched(CoreObserver(SETTINGS, gaps=gaps), theta, there, 0)[0].estimate
        for gaps in (True, False)
    )
    assert np.array_equal(one.mean, other.mean)
    assert np.array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize("seed", [0, 7])
def test_half_of_the_measurements_suffice(seed):
    """E_ac of these two runs with noise, bias and payload is 4.6 and 3.6 without looking back."""
    settings = ("plant.kind=exact", "start=on_reference", "queue=reference", "overlay=dirty")
    settings += ("sensor.loss=0.5", f"sensor.seed={seed}")
    scenario = sd.load_scenario("paper", "predictor_lqi", settings)
    assert simulate(scenario, judge_stability=False).accumulated_error < 3.0
