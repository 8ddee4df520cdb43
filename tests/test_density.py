"""Densities (45): against exact arithmetic, bounded, and where nothing is known."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from stewart_drake.tuner.network import NUM_INPUTS, WINDOW
from stewart_drake.tuner.source import densities

SIGNED_LIMIT = 1e6
KINDS = ("magnitude", "signed")


def oracle(column, kind):
    """(45) along one signal, in rational numbers."""
    rho = []
    for k in range(len(column)):
        window = [float(x) for x in column[max(0, k - 30) : k + 1]]
        known = [Fraction(x) for x in window if math.isfinite(x)]
        if kind == "magnitude":
            known = [abs(x) for x in known]
        if not math.isfinite(window[-1]) or not any(known):
            rho.append(1.0)
        elif sum(known) == 0:
            rho.append(math.copysign(SIGNED_LIMIT, known[-1]) if known[-1] else 0.0)
        else:
            exact = len(known) * known[-1] / sum(known)
            rho.append(float(max(min(exact, Fraction(SIGNED_LIMIT)), -Fraction(SIGNED_LIMIT))))
    return rho


@pytest.mark.parametrize("kind", KINDS)
def test_densities_are_those_of_exact_arithmetic(kind):
    rng = np.random.default_rng(1)
    samples = rng.normal(0.3, 1, (90, NUM_INPUTS)) * 10.0 ** rng.integers(-9, 9, NUM_INPUTS)
    samples[rng.random(samples.shape) < 0.1] = 0.0
    samples[rng.random(samples.shape) < 0.1] = np.nan
    samples[rng.random(samples.shape) < 0.02] = -np.inf
    samples[:, 4] = 0.0
    samples[:, 5] = np.nan
    samples[:, 6] = np.repeat([0.0, -0.3, 0.3], [60, 1, 29])  # an impulse reaches the bound
    for column, pair in ((7, [1, -1]), (8, [-1, 1]), (9, [1, -1 + 1e-9]), (10, [1, -1, 0])):
        samples[:, column] = np.resize(pair, 90)  # sums of zero, or next to it
    found = densities(samples, kind)
    expected = np.transpose([oracle(column, kind) for column in samples.T])
    # The signed mean cancels; what is lost there depends on how small it gets.
    np.testing.assert_allclose(found, expected, rtol=1e-13 if kind == "magnitude" else 1e-9)


@pytest.mark.parametrize("kind", KINDS)
@given(
    arrays(
        np.float64,
        st.tuples(st.integers(0, 40), st.just(NUM_INPUTS)),
        elements=st.floats(width=64) | st.sampled_from([0.0, 1.0, -1.0, 5e-324, 1.7e308, np.nan]),
    )
)
def test_densities_are_bounded_whatever_comes(kind, samples):
    rho = densities(samples, kind)
    assert rho.shape == samples.shape
    low, high = (0, WINDOW) if kind == "magnitude" else (-SIGNED_LIMIT, SIGNED_LIMIT)
    assert np.all((low <= rho) & (rho <= high))  # false for NaN


def test_wrong_shapes_and_kinds_are_refused():
    with pytest.raises(ValueError, match=r"samples: got shape \(5, 12\)"):
        densities(np.zeros((5, 12)))
    with pytest.raises(ValueError, match="kind: got 'log'"):
        densities(np.zeros((31, 18)), "log")
