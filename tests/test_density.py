"""Densities (45): against exact arithmetic, at their bounds, and where nothing is known."""

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


def record(*column):
    """Return samples (N, 18) whose signals are all the same."""
    return np.tile(np.array(column)[:, None], NUM_INPUTS)


@pytest.mark.parametrize("kind", KINDS)
def test_densities_are_those_of_exact_arithmetic(kind):
    rng = np.random.default_rng(1)
    samples = rng.normal(0.3, 1, (90, NUM_INPUTS)) * 10.0 ** rng.integers(-9, 9, NUM_INPUTS)
    samples[rng.random(samples.shape) < 0.1] = 0.0
    samples[rng.random(samples.shape) < 0.1] = np.nan
    samples[rng.random(samples.shape) < 0.02] = -np.inf
    samples[:, 4] = 0.0
    samples[:, 5] = np.nan
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


def test_the_bound_is_reached_by_an_impulse_into_a_window_of_zeros():
    rho = densities(record(*[0.0] * 30, -0.3, 0.3, 0.3))
    np.testing.assert_array_equal(rho[:30], 1.0)
    np.testing.assert_allclose(rho[30:, 0], [31, 31 / 2, 31 / 3], rtol=1e-14)


def test_signed_densities_are_equation_45_on_a_full_window():
    samples = np.random.default_rng(2).normal(0.5, 1, (60, NUM_INPUTS))
    rho = densities(samples, "signed")
    for k in range(30, 60):
        printed = 31 * samples[k] / samples[k - 30 : k + 1].sum(axis=0)
        np.testing.assert_allclose(rho[k], printed, rtol=1e-9)


def test_where_the_sum_is_zero_the_signed_density_is_cut_with_the_sign_of_the_signal():
    assert densities(record(1.0, -1.0), "signed")[1, 0] == -SIGNED_LIMIT
    assert densities(record(-1.0, 1.0), "signed")[1, 0] == SIGNED_LIMIT
    assert densities(record(1.0, -1.0, 0.0), "signed")[2, 0] == 0.0
    assert densities(record(1.0, -1.0 + 1e-9), "signed")[1, 0] == -SIGNED_LIMIT


@pytest.mark.parametrize("kind", KINDS)
def test_a_missed_measurement_is_left_out_and_spoils_nothing(kind):
    samples = np.random.default_rng(4).normal(1, 0.3, (20, NUM_INPUTS))
    missed = samples.copy()
    missed[7, :12] = np.nan
    rho = densities(missed, kind)
    np.testing.assert_array_equal(rho[7, :12], 1.0)
    np.testing.assert_array_equal(rho[:, 12:], densities(samples, kind)[:, 12:])
    shorter = densities(np.delete(samples, 7, axis=0), kind)
    np.testing.assert_allclose(np.delete(rho, 7, axis=0)[:, :12], shorter[:, :12], rtol=1e-12)


def test_wrong_shapes_and_kinds_are_refused():
    with pytest.raises(ValueError, match=r"samples: got shape \(5, 12\)"):
        densities(np.zeros((5, 12)))
    with pytest.raises(ValueError, match="kind: got 'log'"):
        densities(np.zeros((31, 18)), "log")
