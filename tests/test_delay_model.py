"""The sampled delay models against the delayed continuous system, simulated event by event."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec, solve_ivp
from scipy.linalg import expm

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.delay_model import (
    LinearModel,
    chain,
    delayed_model,
    double_integrators,
    linear_model,
    sample,
    with_integral,
)
from stewart_drake.mechanism.assembly import torque_map
from tests.mechanisms import PAPER
from tests.oracles import relative

STEPS = (0, 1, 2, 8)
FRACTIONS = (0.0, 0.3, 0.5)
SAMPLES = 12


@st.composite
def continuous_models(draw):
    """Random A, B, C: stable, unstable, singular or nilpotent, with time constants around 1 s."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    n, m, p = (draw(st.integers(1, most)) for most in (5, 3, 2))
    A = rng.normal(0, 1 / np.sqrt(n), (n, n)) + draw(st.sampled_from([-1.0, 0.0, 1.0])) * np.eye(n)
    kind = draw(st.sampled_from(["full", "singular", "nilpotent", "zero"]))
    if kind == "singular":
        A[:, 0] = 0
    elif kind == "nilpotent":
        A = np.triu(A, 1)
    elif kind == "zero":
        A = np.zeros((n, n))
    return LinearModel(A, rng.normal(0, 1, (n, m)), rng.normal(0, 1, (p, n)))


def platforms():
    """Return the paper's double integrators, and the machine under gravity, which is unstable."""
    return {
        "paper": double_integrators(torque_map(PAPER, PAPER.home)),
        "gravity": linear_model(*StewartDynamics(PAPER, gravity=True).linearize(PAPER.home)),
    }


# The oracle.


def flow(A, B, duration):
    """How a state and a constant torque show after `duration`, from the differential equation."""
    n, m = B.shape
    start = np.hstack([np.eye(n), np.zeros((n, m))])

    def derivative(t, flat):
        change = A @ flat.reshape(n, n + m)
        change[:, n:] += B
        return change.ravel()

    tight = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-14}
    end = solve_ivp(derivative, (0, duration), start.ravel(), **tight).y[:, -1].reshape(n, n + m)
    return end[:, :n], end[:, n:]


def simulate_delayed(model, period, steps, fraction, start, torques):
    """Errors (SAMPLES + 1, n) and integrals (SAMPLES + 1, p) at the sampling instants.

    From event to event: the clock runs in ticks of a tenth of a period; at every tick the torque
    that acts is looked up by when it was computed, k dt <= t - eta < (k + 1) dt.
    """
    ticks = 10
    delay = round(ticks * (steps + fraction))
    passed = round(ticks * fraction)
    events = sorted({0, passed, ticks})
    flows = {
        b - a: flow(model.A, model.B, (b - a) / ticks * period)
        for a, b in itertools.pairwise(events)
    }
    errors, integrals, e = [start], [np.zeros(len(model.C))], start
    for k in range(SAMPLES):
        for a, b in itertools.pairwise(events):
            computed_at = (k * ticks + a - delay) // ticks
            transition, push = flows[b - a]
            e = transition @ e + push @ torques[computed_at]
        trapezoid = period / 2 * model.C @ (errors[-1] + e)
        errors.append(e)
        integrals.append(integrals[-1] + trapezoid)
    return np.array(errors), np.array(integrals)


def assert_chain_agrees(model, period, steps, fraction, integral, extra, rng):
    """Check errors, integrals and queue of the chain against the oracle."""
    n, m = model.B.shape
    torques = {k: rng.normal(0, 1, m) for k in range(-steps - 1, SAMPLES + 1)}
    start = rng.normal(0, 1, n)
    errors, integrals = simulate_delayed(model, period, steps, fraction, start, torques)
    delayed = delayed_model(model, period, steps, fraction, integral=integral)
    augmented = chain(delayed, steps + 1 if extra else 0)
    length = steps + (1 if extra or fraction > 0 else 0)
    size = n + (len(model.C) if integral else 0)
    assert augmented.A.shape == (size + m * length, size + m * length)

    def queue(k):
        return np.concatenate([np.empty(0), *(torques[j] for j in range(k - length, k))])

    x = np.concatenate([start, np.zeros(size - n), queue(0)])
    scale = np.abs(errors).max() + np.abs(integrals).max()
    for k in range(SAMPLES + 1):
        expected = np.concatenate([errors[k], integrals[k]]) if integral else errors[k]
        assert np.abs(x[:size] - expected).max() < 1e-9 * scale
        assert np.array_equal(x[size:], queue(k))
        seen = model.C @ errors[k]
        expected = np.concatenate([seen, integrals[k]]) if integral else seen
        assert np.abs(augmented.C @ x - expected).max() < 1e-9 * scale * (1 + np.abs(model.C).sum())
        x = augmented.A @ x + augmented.B @ torques[k]


# Sampling.


@settings(max_examples=60, deadline=None)
@given(model=continuous_models(), duration=st.floats(1e-3, 2.0))
def test_sample_is_the_integral_of_the_exponential(model, duration):
    transition, push = sample(model.A, model.B, duration)
    expected = flow(model.A, model.B, duration)
    assert relative(transition, expected[0]) < 1e-11
    assert relative(push, expected[1]) < 1e-11
    by_quadrature, _ = quad_vec(lambda s: expm(model.A * s) @ model.B, 0, duration, epsrel=1e-12)
    assert relative(push, by_quadrature) < 1e-11


def test_sample_of_a_double_integrator_is_in_closed_form():
    transition, push = sample(np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [3]]), 0.1)
    assert np.allclose(transition, [[1, 0.1], [0, 1]], rtol=0, atol=1e-16)
    assert np.allclose(push, [[3 * 0.1**2 / 2], [0.3]], rtol=1e-15, atol=0)


# The chain.


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("steps", STEPS)
@settings(max_examples=25, deadline=None)
@given(model=continuous_models(), seed=st.integers(0, 2**32 - 1), integral=st.booleans())
def test_chain_is_the_delayed_continuous_system(steps, fraction, extra, model, seed, integral):
    rng = np.random.default_rng(seed)
    period = rng.uniform(0.05, 0.3)
    assert_chain_agrees(model, period, steps, fraction, integral, extra, rng)


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("name", ["paper", "gravity"])
def test_chain_of_the_platform_is_its_delayed_system(name, steps, fraction, extra):
    rng = np.random.default_rng(steps)
    assert_chain_agrees(platforms()[name], 0.1, steps, fraction, True, extra, rng)


@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("steps", [1, 2, 8])
def test_chain_has_the_blocks_that_the_paper_prints(steps, fraction):
    """(35) and (39), with their zero blocks at the sizes that fit."""
    model = platforms()["gravity"]
    found = chain(delayed_model(model, 0.1, steps, fraction, integral=False), steps + 1)
    N, n, dt, eta0 = 12, 6, 0.1, 0.1 * fraction

    def integral(start, end):
        inside, _ = quad_vec(lambda v: expm(model.A * (dt - v)) @ model.B, start, end)
        return inside

    H, rest = N + n, (steps - 1) * n
    zeros, eye = np.zeros, np.eye
    A_1dis = np.block([[expm(model.A * dt), integral(0, eta0)], [zeros((n, N)), zeros((n, n))]])
    B_1dis = np.vstack([integral(eta0, dt), eye(n)])
    A_dis = np.block(
        [
            [A_1dis, B_1dis, zeros((H, rest))],
            [zeros((rest, H)), zeros((rest, n)), eye(rest)],
            [zeros((n, H)), zeros((n, n)), zeros((n, rest))],
        ]
    )
    B_dis = np.vstack([zeros((H + rest, n)), eye(n)])
    assert np.allclose(found.A, A_dis, rtol=0, atol=1e-12 * np.abs(A_dis).max())
    assert np.array_equal(found.B, B_dis)
    assert np.array_equal(found.C, np.hstack([model.C, zeros((6, n * (steps + 1)))]))


def test_the_papers_extra_block_is_seen_by_nothing_without_a_fraction():
    delayed = delayed_model(platforms()["paper"], 0.1, 3, 0.0, integral=True)
    plain, extra = chain(delayed), chain(delayed, 4)
    kept = np.r_[:18, 24 : 24 + 18]
    assert np.array_equal(extra.A[np.ix_(kept, kept)], plain.A)
    assert not extra.A[:, 18:24].any()
    assert not extra.C[:, 18:24].any()


def test_integral_states_of_the_error_model_integrate_the_error():
    """(24)-(28), unsampled: z_dot = C e, and the cost sees pose error and integral."""
    model = platforms()["gravity"]
    found = with_integral(model)
    rng = np.random.default_rng(1)
    e, z, torque = rng.normal(0, 1, 12), rng.normal(0, 1, 6), rng.normal(0, 1, 6)
    x = np.concatenate([e, z])
    change = found.A @ x + found.B @ torque
    assert np.allclose(change[:12], model.A @ e + model.B @ torque, rtol=1e-14)
    assert np.array_equal(change[12:], e[:6])
    assert np.array_equal(found.C @ x, np.concatenate([e[:6], z]))


# Bad input.


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("period", (0.0, 1, 0.0)),
        ("period", (-0.1, 1, 0.0)),
        ("period", (np.nan, 1, 0.0)),
        ("period", (np.inf, 1, 0.0)),
        ("delay", (0.1, -1, 0.0)),
        ("delay", (0.1, 1, -0.1)),
        ("delay", (0.1, 1, 1.0)),
        ("delay", (0.1, 1, np.nan)),
    ],
)
def test_delays_and_periods_that_cannot_be_are_refused(name, arguments):
    with pytest.raises(ValueError, match=f"{name}: got .* expected"):
        delayed_model(platforms()["paper"], *arguments, integral=True)
