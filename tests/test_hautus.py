"""The Hautus test against pairs whose answer is known, and Drake's rank of matrix powers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.primitives import IsControllable, LinearSystem
from scipy.linalg import block_diag, expm

from stewart_drake.law.delay_model import (
    chain,
    delayed_model,
    double_integrators,
    sample,
    with_integral,
)
from stewart_drake.mechanism.assembly import torque_map
from stewart_drake.studies.hautus import (
    TOLERANCE,
    cluster,
    describe,
    hautus,
    scaled,
)
from tests.mechanisms import PAPER

PAPER_MODEL = double_integrators(torque_map(PAPER, PAPER.home))


def test_margin_of_a_scalar_pair_is_that_of_the_formula():
    """[a - a, b] has the singular value |b|, ||[a, b]|| is hypot(a, b)."""
    (mode,) = hautus([[3.0]], [[4.0]], discrete=False).modes
    assert mode.eigenvalue == 3
    assert mode.margin == pytest.approx(4 / 5, rel=1e-14)


def test_an_uncontrollable_mode_is_named_with_its_direction():
    test = hautus(np.diag([-1.0, 2.0, -3.0]), [[1.0], [0.0], [1.0]], discrete=False)
    (mode,) = test.deficient
    assert mode.eigenvalue == 2
    assert not mode.decays
    assert np.abs(mode.directions[:, 0]) == pytest.approx([0, 1, 0])
    assert test.lasting_margin < TOLERANCE
    assert hautus(np.diag([-1.0, -2.0]), [[1.0], [0.0]], discrete=False).lasting_margin > TOLERANCE


def test_an_unobservable_mode_is_found_by_transposition():
    """The output shows a decaying mode only, and nothing of the rotation."""
    A = block_diag([[0.0, 1.0], [-4.0, 0.0]], [[-1.0]])
    C = np.array([[0.0, 0.0, 1.0]])
    test = hautus(A.T, C.T, discrete=False)
    (mode,) = test.deficient
    assert mode.eigenvalue == pytest.approx(2j)
    assert test.lasting_margin < TOLERANCE
    # The motion itself: A v = lambda v, C v = 0.
    v = mode.directions[:, 0]
    assert pytest.approx(mode.eigenvalue * v, abs=1e-12) == A @ v
    assert np.abs(C @ v) < 1e-12


@pytest.mark.parametrize(("half_turns", "fails"), [(1.0, True), (2.0, True), (0.5, False)])
def test_pathological_sampling_of_an_oscillator(half_turns, fails):
    """x'' = -w^2 x + u, held for half a period, reaches one direction only: exp(A dt) = -1."""
    A, B = np.array([[0.0, 1.0], [-9.0, 0.0]]), np.array([[0.0], [1.0]])
    assert not hautus(A, B, discrete=False).deficient
    sampled = hautus(*sample(A, B, half_turns * np.pi / 3), discrete=True)
    assert bool(sampled.deficient) is fails
    assert (sampled.lasting_margin < TOLERANCE) is fails  # |lambda| = 1 does not decay


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    reached=st.integers(1, 5),
    hidden=st.integers(1, 3),
    growing=st.booleans(),
    discrete=st.booleans(),
)
def test_hidden_modes_are_found_in_any_coordinates(seed, reached, hidden, growing, discrete):
    rng = np.random.default_rng(seed)
    A1, B1 = rng.normal(size=(reached, reached)) / 2, rng.normal(size=(reached, 2))
    A2 = np.diag(rng.permutation(np.linspace(1.2, 2.0, hidden) if growing else -np.ones(hidden)))
    A2 = A2 if growing or not discrete else A2 / 2
    T = np.linalg.qr(rng.normal(size=(reached + hidden,) * 2))[0] @ np.diag(
        rng.uniform(0.5, 2, reached + hidden)
    )
    A = T @ np.block([[A1, rng.normal(size=(reached, hidden))], [np.zeros((hidden, reached)), A2]])
    A = A @ np.linalg.inv(T)
    test = hautus(A, T @ np.vstack([B1, np.zeros((hidden, 2))]), discrete=discrete)
    found = sorted(mode.eigenvalue.real for mode in test.deficient)
    assert found == pytest.approx(sorted(set(np.diag(A2))), rel=1e-6)
    assert sum(mode.directions.shape[1] for mode in test.deficient) == hidden
    assert (test.lasting_margin < TOLERANCE) is growing


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_margin_is_the_size_of_the_change_that_makes_a_mode_fail(seed):
    """Taking the least singular value out of the pencil leaves an uncontrollable pair (Eising)."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(4, 4)), rng.normal(size=(4, 1))
    test = hautus(A, B, discrete=False)
    mode = next(mode for mode in test.modes if mode.eigenvalue.imag == 0 or mode.margin > 0)
    pencil = np.hstack([mode.eigenvalue * np.eye(4) - A, B])
    U, s, V = np.linalg.svd(pencil, full_matrices=False)
    change = s[-1] * np.outer(U[:, -1], V[-1])
    size = np.linalg.norm(np.hstack([A, B]), 2)
    assert np.linalg.norm(change, 2) / size == pytest.approx(mode.margin, rel=1e-6)
    assert np.linalg.matrix_rank(pencil - change, tol=1e-12 * size) == 3


def test_powers_of_the_matrix_are_wrong_where_the_margin_is_right():
    """Six masses on a line joined by springs, pushed at one end, sampled: controllable."""
    stiffness = 2 * np.eye(6) - np.eye(6, k=1) - np.eye(6, k=-1)
    A = np.block([[np.zeros((6, 6)), np.eye(6)], [-stiffness, np.zeros((6, 6))]])
    B = np.zeros((12, 1))
    B[6] = 1
    sampled = sample(A, B, 0.05)
    assert not IsControllable(LinearSystem(*sampled, np.eye(1, 12), np.zeros((1, 1)), 0.05))
    test = hautus(*sampled, discrete=True)
    assert not test.deficient
    assert test.margin > 1e5 * TOLERANCE
    # The proof: no mode's left vector is orthogonal to B, frequencies being distinct, and no two
    # of them are joined by the sampling.
    frequencies, shapes = np.linalg.eigh(stiffness)
    assert np.abs(shapes[0]).min() > 0.1
    assert np.sqrt(frequencies.max()) * 0.05 < np.pi


@pytest.mark.parametrize("steps", [0, 1, 8, 30])
def test_only_the_papers_chain_has_modes_that_no_output_shows(steps):
    """T(k-mu-1) acts on nothing without a fraction: six zero modes, gone after one step."""
    model = delayed_model(PAPER_MODEL, 0.1, steps, 0.0, integral=True)
    minimal, extra = chain(model), chain(model, steps + 1)
    assert not hautus(minimal.A.T, minimal.C.T, discrete=True).deficient
    test = hautus(extra.A.T, extra.C.T, discrete=True)
    (mode,) = test.deficient
    assert mode.eigenvalue == 0
    assert mode.directions.shape[1] == 6
    assert np.count_nonzero(np.abs(np.linalg.eigvals(extra.A)) < 1e-6) == 6 * (steps + 1)
    # They span the oldest torque, which the errors come before and the others after.
    inside = np.abs(mode.directions[18:24])
    assert np.linalg.norm(inside) == pytest.approx(np.sqrt(6))
    assert test.lasting_margin > TOLERANCE
    assert not np.any(extra.A[:18, 18:24])
    assert not hautus(extra.A, extra.B, discrete=True).deficient
    # With a fraction of a period it is the minimal chain.
    broken = delayed_model(PAPER_MODEL, 0.1, steps, 0.5, integral=True)
    extra = chain(broken, steps + 1)
    assert np.array_equal(extra.A, chain(broken).A)
    assert not hautus(extra.A.T, extra.C.T, discrete=True).deficient


def test_answers_do_not_depend_on_units_but_margins_do():
    A, B, C = with_integral(PAPER_MODEL)
    rng = np.random.default_rng(0)
    sizes = [10.0 ** rng.uniform(-1, 1, n) for n in (18, 6, 12)]
    A1, B1, C1 = scaled(A, B, C, *sizes)
    x, u = rng.normal(size=18), rng.normal(size=6)
    # d(S x')/dt = A S x' + B U u', y = Y y'
    assert sizes[0] * (A1 @ x + B1 @ u) == pytest.approx(
        A @ (sizes[0] * x) + B @ (sizes[1] * u), rel=1e-12, abs=1e-12
    )
    assert sizes[2] * (C1 @ x) == pytest.approx(C @ (sizes[0] * x))
    plain, other = hautus(A, B, discrete=False), hautus(A1, B1, discrete=False)
    assert not plain.deficient
    assert not other.deficient
    assert plain.margin != pytest.approx(other.margin, rel=0.01)


@pytest.mark.parametrize("size", [2, 3, 5])
def test_a_spread_defective_eigenvalue_is_one_mode(size):
    rng = np.random.default_rng(size)
    T = np.linalg.qr(rng.normal(size=(size, size)))[0]
    A = T @ (np.eye(size) * 2 + np.eye(size, k=1)) @ T.T
    values = np.linalg.eigvals(A).astype(complex)
    (group,) = cluster(values, 0.01)
    assert abs(group.mean() - 2) < 1e-12
    b = T[:, [size - 1]]
    assert not hautus(A, b, discrete=False).deficient
    (mode,) = hautus(A, T[:, [0]], discrete=False).deficient  # reaches the end of the chain only
    assert mode.multiplicity == size
    assert mode.margin < 1e-12


def test_a_slowly_decaying_mode_is_distinguished_from_one_that_stays():
    for value, decays in ((1 - 1e-4, True), (1 - 1e-9, False), (1.0, False), (-1.0, False)):
        assert (hautus([[value]], [[0.0]], discrete=True).lasting_margin > TOLERANCE) is decays
    system = np.diag([-1e-9, -1.0])
    assert hautus(system, np.zeros((2, 1)), discrete=False).lasting_margin < TOLERANCE
    assert hautus(expm(-np.eye(2)), np.zeros((2, 1)), discrete=True).lasting_margin > TOLERANCE


def test_directions_in_words():
    some = np.eye(30, dtype=complex)
    assert describe(some[:, 18:24]) == "6 directions in torque T(k-2)"
    assert describe(some[:, [3]]) == "1 direction in pose error (x)"
    assert describe(some[:12, [6, 11]]) == "2 directions in rate error (roll, z)"
    every = np.full((30, 1), 30**-0.5, dtype=complex)
    errors = "pose error and rate error and integral"
    assert describe(every) == f"1 direction in {errors} and torques T(k-2) to T(k-1)"
