"""The delayed LQI gain against theory: residual, cost, closed forms, extended precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law import riccati
from stewart_drake.law.delay_model import (
    DelayedModel,
    chain,
    delayed_model,
    double_integrators,
    linear_model,
)
from stewart_drake.law.riccati import RiccatiError, full_gain, lqr, reduced_gain
from stewart_drake.law.stability import is_stable
from stewart_drake.mechanism.assembly import torque_map
from tests.mechanisms import PAPER
from tests.oracles import augmented_gain, relative

Extended = NDArray[np.longdouble]

STEPS = (0, 1, 5, 8, 10, 20, 30)
FRACTIONS = (0.0, 0.5)
PLATFORMS = {
    "paper": double_integrators(torque_map(PAPER, PAPER.home)),
    "gravity": linear_model(*StewartDynamics(PAPER, gravity=True).linearize(PAPER.home)),
}
UNIT = (np.eye(12), np.eye(6))
"""The paper's weights (41): Q on pose error and integral, R on the torques."""


def delayed(name, steps, fraction, integral=True):
    return delayed_model(PLATFORMS[name], 0.1, steps, fraction, integral=integral)


# The oracle: the whole chain's Riccati equation in extended precision (19 digits).


def solve_extended(A, b):
    """A^-1 b: the double-precision inverse, refined."""
    inverse = np.linalg.inv(A.astype(np.float64)).astype(np.longdouble)
    x = inverse @ b
    for _ in range(3):
        x = x + inverse @ (b - A @ x)
    return x


def riccati_gain(P, A, B, R):
    PB = P @ B
    return solve_extended(R + B.T @ PB, PB.T @ A)


def undelayed_solution(model, Q, R):
    """P of the chain without its mu steps, by value iteration down to extended precision."""
    short = chain(DelayedModel(model.A, model.B_old, model.B_new, model.C, 0, model.fraction))
    A, B, C, R_ = (np.asarray(x, np.longdouble) for x in (short.A, short.B, short.C, R))
    Q_ = C.T @ np.asarray(Q, np.longdouble) @ C
    P = np.asarray(lqr(short.A, short.B, short.C.T @ Q @ short.C, R)[1], np.longdouble)
    for _ in range(10_000):
        after = Q_ + A.T @ P @ (A - B @ riccati_gain(P, A, B, R_))
        after = (after + after.T) / 2
        if np.abs(after - P).max() < 1e-18 * np.abs(P).max():
            return after
        P = after
    raise AssertionError("value iteration does not converge")


def true_solution(model, Q, R):
    """K and P of the whole chain, P put together from costs, and that it solves the equation.

    Until the torque of now acts, the chain runs by itself: its cost over mu steps, and the cost
    from there on by the undelayed solution, are x'Px. That P solves (44) of the whole chain, which
    is checked, and stabilises, so it is the one that is looked for.
    """
    augmented = chain(model)
    A, B, C, Q_, R_ = (
        np.asarray(x, np.longdouble) for x in (augmented.A, augmented.B, augmented.C, Q, R)
    )
    size = len(model.A) + (model.B_new.shape[1] if model.fraction > 0 else 0)
    P = np.zeros_like(A)
    seen, ahead = C, np.eye(len(A), dtype=np.longdouble)[:size]
    for _ in range(model.steps):
        P = P + seen.T @ Q_ @ seen
        seen, ahead = seen @ A, ahead @ A
    P = P + ahead.T @ undelayed_solution(model, Q, R) @ ahead
    K = riccati_gain(P, A, B, R_)
    residual = C.T @ Q_ @ C + A.T @ P @ (A - B @ K) - P
    assert np.linalg.norm(residual.astype(float)) < 1e-15 * np.linalg.norm(P.astype(float))
    assert spectral_radius(augmented.A - augmented.B @ K.astype(float)) < 1
    return K, P


def spectral_radius(matrix):
    return float(np.abs(np.linalg.eigvals(matrix)).max())


# The gain and its reduction.


@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("steps", STEPS)
def test_the_papers_gain_solves_its_riccati_equation(steps, fraction):
    model, (Q, R) = delayed("paper", steps, fraction), UNIT
    K, P = full_gain(model, Q, R)
    augmented = chain(model)
    A, B, C = augmented.A, augmented.B, augmented.C
    residual = C.T @ Q @ C + A.T @ P @ A - A.T @ P @ B @ K - P
    assert np.linalg.norm(residual) < 1e-10 * np.linalg.norm(P)
    assert np.allclose(P, P.T, rtol=0, atol=1e-9 * np.abs(P).max())
    assert spectral_radius(A - B @ K) < 1
    assert relative(augmented_gain(model, Q, R), K) < 1e-8
    assert relative(K, true_solution(model, Q, R)[0].astype(float)) < 1e-8


@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("steps", STEPS)
def test_under_gravity_the_reduced_gain_is_right_and_the_full_solve_gives_up(steps, fraction):
    """Open-loop poles of 5 /s make P of the chain grow like e^(2 p eta), 1e13 over 3 s.

    Up to mu = 8 both gains agree to 1e-8. At mu = 10 the full solve still has seven digits. At
    mu = 20 and 30 Drake's solution of the whole chain leaves a residual as large as itself (its
    gain is off by more than its own size, and at 30 unstable); it is refused. The gain by the
    delay-free equation is right throughout: extended precision confirms it to 1e-10.
    """
    model, (Q, R) = delayed("gravity", steps, fraction), UNIT
    truth = true_solution(model, Q, R)[0].astype(float)
    K = augmented_gain(model, Q, R)
    augmented = chain(model)
    assert relative(K, truth) < 1e-10
    assert spectral_radius(augmented.A - augmented.B @ K) < 1
    if steps <= 10:
        assert relative(full_gain(model, Q, R)[0], K) < (1e-8 if steps <= 8 else 1e-6)
    else:
        with pytest.raises(RiccatiError, match="did not solve"):
            full_gain(model, Q, R)


@pytest.mark.parametrize("name", PLATFORMS)
@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (8, 0.0), (5, 0.5)])
def test_simulated_cost_is_the_quadratic_form_of_the_solution(name, steps, fraction):
    model, (Q, R) = delayed(name, steps, fraction), UNIT
    _, P = full_gain(model, Q, R)
    K = augmented_gain(model, Q, R)
    augmented, rng = chain(model), np.random.default_rng(steps)
    X = rng.normal(0, 1, (len(P), 4))
    start, cost = X, np.zeros(4)
    while np.abs(X).max() > 1e-8 * np.abs(start).max():
        Y, T = augmented.C @ X, -K @ X
        cost += np.einsum("ij,ij->j", Y, Q @ Y) + np.einsum("ij,ij->j", T, R @ T)
        X = augmented.A @ X + augmented.B @ T
    assert cost == pytest.approx(np.einsum("ij,ij->j", start, P @ start), rel=1e-8)


@settings(max_examples=100, deadline=None)
@given(
    a=st.floats(-3, 3),
    b=st.floats(0.1, 3),
    q=st.floats(0.01, 100),
    r=st.floats(0.01, 100),
    steps=st.integers(0, 6),
)
def test_gain_of_one_delayed_state_is_in_closed_form(a, b, q, r, steps):
    """b^2 p^2 + (r - a^2 r - q b^2) p - q r = 0, k = a b p / (r + b^2 p)."""
    half = (r - a**2 * r - q * b**2) / 2
    p = (-half + np.sqrt(half**2 + b**2 * q * r)) / b**2
    k = a * b * p / (r + b**2 * p)
    one = np.ones((1, 1))
    model = DelayedModel(a * one, 0 * one, b * one, one, steps, 0.0)
    expected = [[k * a**steps, *(k * b * a**j for j in reversed(range(steps)))]]
    assert reduced_gain(model, q * one, r * one) == pytest.approx(k, rel=1e-7, abs=1e-12)
    assert np.allclose(augmented_gain(model, q * one, r * one), expected, rtol=1e-7, atol=1e-10)
    assert np.allclose(full_gain(model, q * one, r * one)[0], expected, rtol=1e-5, atol=1e-8)


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(PLATFORMS)),
    integral=st.booleans(),
    fraction=st.sampled_from([0.0, 0.3]),
    ratio=st.floats(-2, 2).map(lambda x: 10**x),
    scale=st.floats(-4, 4).map(lambda x: 10**x),
)
def test_gain_depends_on_the_ratio_of_the_weights_only(name, integral, fraction, ratio, scale):
    model = delayed(name, 3, fraction, integral)
    Q, R = np.eye(len(model.C)), np.eye(6)
    once = augmented_gain(model, ratio * Q, R)
    assert relative(augmented_gain(model, scale * ratio * Q, scale * R), once) < 1e-7
    assert relative(augmented_gain(model, 2 * ratio * Q, R), once) > 1e-4


# Bad input. `lqr` raises RiccatiError, which pytest.raises tells from SystemExit; a shape that does
# not fit is a mistake in a program and a plain ValueError.

A, B, Q, R = np.array([[1.0, 0.1], [0, 1]]), np.array([[0.0], [0.1]]), np.eye(2), np.eye(1)
NAN, INF = np.nan, np.inf
ONE_INPUT = np.array([[1.0], [1]])
TURNING = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 0.5]])
"""A mode on the unit circle that goes round in four steps, and a stable one."""

BAD = {
    "A not square": ("A", (np.ones((2, 3)), B, Q, R)),
    "A a vector": ("A", (np.ones(2), B, Q, R)),
    "A a number": ("A", (np.array(1.0), B, Q, R)),
    "nothing": ("A", (np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((0, 0)), R)),
    "no input": ("B", (A, np.zeros((2, 0)), Q, np.zeros((0, 0)))),
    "B too long": ("A|B", (A, np.ones((3, 1)), Q, R)),
    "B a vector": ("B", (A, np.ones(2), Q, R)),
    "B a stack": ("B", (A, np.ones((2, 1, 1)), Q, R)),
    "Q too large": ("Q", (A, B, np.eye(3), R)),
    "R too large": ("R", (A, B, Q, np.eye(2))),
    "NaN in A": ("A", (A * NAN, B, Q, R)),
    "infinite B": ("B", (A, np.array([[0.0], [INF]]), Q, R)),
    "NaN in Q": ("Q", (A, B, np.diag([1.0, NAN]), R)),
    "infinite Q": ("Q", (A, B, np.diag([1.0, INF]), R)),
    "NaN in R": ("R", (A, B, Q, NAN * R)),
    "R zero": ("R", (A, B, Q, 0 * R)),
    "R negative": ("R", (A, B, Q, -R)),
    "R indefinite": ("R", (A, np.eye(2), Q, np.diag([1.0, -1]))),
    "R singular": ("R", (A, np.eye(2), Q, np.diag([1.0, 0]))),
    "R asymmetric": ("R", (A, np.eye(2), Q, np.array([[1.0, 0.5], [0, 1]]))),
    "Q negative": ("Q", (A, B, -Q, R)),
    "Q indefinite": ("Q", (A, B, np.diag([1.0, -1e-3]), R)),
    "Q asymmetric": ("Q", (A, B, np.array([[1.0, 0.5], [0, 1]]), R)),
    "no way to an unstable mode": ("(A, B)", (np.diag([2.0, 0.5]), np.eye(2)[:, 1:], Q, R)),
    "no way to a mode at one": ("(A, B)", (np.diag([1.0, 0.5]), np.eye(2)[:, 1:], Q, R)),
    "no torque at all": ("(A, B)", (A, 0 * B, Q, R)),
    "a mode at one unseen": ("(A, Q)", (np.diag([1.0, 0.5]), ONE_INPUT, np.diag([0.0, 1]), R)),
    "an unstable mode unseen": ("(A, Q)", (np.diag([2.0, 0.5]), ONE_INPUT, np.diag([0.0, 1]), R)),
    "a turning mode unseen": ("(A, Q)", (TURNING, np.ones((3, 1)), np.diag([0.0, 0, 1]), R)),
    "poses unseen": ("(A, Q)", (A, B, np.diag([0.0, 1]), R)),
    "Q zero": ("(A, Q)", (A, B, 0 * Q, R)),
}


SHAPES = {
    *("A not square", "A a vector", "A a number", "nothing", "no input"),
    *("B too long", "B a vector", "B a stack", "Q too large", "R too large"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_an_error_of_its_kind_that_names_the_matrix(case):
    name, arguments = BAD[case]
    assert not issubclass(RiccatiError, ValueError)
    with pytest.raises(ValueError if case in SHAPES else RiccatiError) as caught:
        lqr(*arguments)
    named = str(caught.value).partition(": ")[0]
    assert named in name.split("|")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("solve", [full_gain, reduced_gain, augmented_gain])
@pytest.mark.parametrize(
    ("Q", "R", "error"),
    [
        (1e12 * np.eye(12), 1e-12 * np.eye(6), RiccatiError),
        (np.eye(12), 0 * np.eye(6), RiccatiError),
        (np.diag([0.0] + [1.0] * 5 + [0.0] + [1.0] * 5), np.eye(6), RiccatiError),  # roll unseen
        (np.eye(12), np.eye(5), ValueError),
        (np.eye(11), np.eye(6), ValueError),
    ],
)
@pytest.mark.parametrize("name", PLATFORMS)
def test_every_gain_of_the_platform_refuses_bad_weights(name, Q, R, error, solve):
    with pytest.raises(error):
        solve(delayed(name, 2, 0.0), Q, R)


def test_a_motor_that_cannot_move_the_plate_is_found_out():
    """The torque map next to a parallel singularity: one direction is out of reach."""
    U, s, Vt = np.linalg.svd(torque_map(PAPER, PAPER.home))
    for least in (0.0, 1e-14, 1e-12, 1e-10):
        model = double_integrators(U @ np.diag([*s[:5], least]) @ Vt)
        for integral in (True, False):
            sampled = delayed_model(model, 0.1, 3, 0.5, integral=integral)
            with pytest.raises(RiccatiError):
                reduced_gain(sampled, np.eye(len(sampled.C)), np.eye(6))


@settings(max_examples=150, deadline=None)
@given(
    data=st.data(),
    w_Q=st.floats(-14, 14).map(lambda x: 10**x),
    w_R=st.floats(-14, 14).map(lambda x: 10**x),
    name=st.sampled_from(sorted(PLATFORMS)),
    integral=st.booleans(),
)
def test_whatever_the_weights_a_gain_that_comes_out_stabilises(data, w_Q, w_R, name, integral):
    model = delayed(name, data.draw(st.integers(0, 3)), 0.0, integral)
    try:
        K = augmented_gain(model, w_Q * np.eye(len(model.C)), w_R * np.eye(6))
    except RiccatiError:
        return
    augmented = chain(model)
    assert spectral_radius(augmented.A - augmented.B @ K) < 1 + 1e-9


def test_a_solver_that_answers_nonsense_or_ends_the_process_is_caught(monkeypatch):
    def ends(*_):
        raise SystemExit("condition failed")

    def gives_up(*_):
        raise RuntimeError("no solution")

    answers = {
        "condition failed": ends,
        "no solution": gives_up,
        "NaN": lambda *_: np.full((2, 2), np.nan),
        "did not solve": lambda *_: np.eye(2),
    }
    for message, answer in answers.items():
        monkeypatch.setattr(riccati, "DiscreteAlgebraicRiccatiEquation", answer)
        with pytest.raises(RiccatiError, match=message):
            lqr(A, B, Q, R)


@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.integers(1, 12),
    radius=st.sampled_from([0.0, 0.3, 0.99, 1 - 1e-6, 1 + 1e-6, 1.5, 1e3]),
    shear=st.sampled_from([0.0, 1.0, 1e3]),
)
@settings(deadline=None)
def test_contraction_is_decided_as_by_the_eigenvalues(seed, size, radius, shear):
    """Also where the first powers grow because the eigenvectors are nearly parallel."""
    generator = np.random.default_rng(seed)
    eigenvalues = radius * generator.uniform(-1, 1, size)
    eigenvalues[0] = radius
    triangle = np.diag(eigenvalues) + shear * np.triu(generator.uniform(-1, 1, (size, size)), 1)
    assert is_stable(triangle, edge=0.0) == (radius < 1)
