"""The Kalman update of the core against textbook forms and least squares."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from stewart_drake.core.library import core
from stewart_drake.law.belief import root_of

RNG = np.random.default_rng(11)
N, M = 9, 6
FREE = np.full(N, np.inf)


def update(mean, root, seen, jacobian, y, C, iterations=1, bounds=(-FREE, FREE)):
    """Mean, covariance, squared innovation and spread, for y = seen(xi) + C noise."""
    c = core()
    n, m = len(mean), len(y)

    @c.ffi.callback("int(void *, const real *, real *, real *, stewart_scratch)")
    def rows(_, xi, e, H, scratch):
        at = np.array([xi[i] for i in range(n)])
        whitened = np.linalg.solve(C, np.column_stack([y - seen(at), jacobian(at)]))
        for i in range(m):
            e[i] = whitened[i, 0]
            for j in range(n):
                H[n * i + j] = whitened[i, 1 + j]
        return m

    @c.ffi.callback("int(void *, const real *, const real *, stewart_scratch)")
    def settle(_, xi, better, scratch):
        return 0

    found, P, scalars = mean.copy(), np.empty((n, n)), np.empty(2)
    kept = [np.ascontiguousarray(a) for a in (mean, root, *bounds)]
    pointers = [c.at(a) for a in kept]
    problem = c.ffi.new("stewart_kalman *", [n, m, iterations, *pointers, c.ffi.NULL, rows, settle])
    scratch = c.scratch(c.lib.stewart_kalman_scratch(n, m))
    out = (c.at(found), c.at(P), c.at(scalars), c.at(scalars[1:]))
    if not c.lib.stewart_kalman_update(problem, *out, scratch):
        raise ArithmeticError("no result")
    return found, P @ P.T, float(scalars[0]), float(scalars[1])


@pytest.mark.parametrize("m", [1, M, 15])
@pytest.mark.parametrize("rank", [4, N])
def test_a_linear_update_is_kalmans(m, rank):
    """Also with exact knowledge of some combinations, and with correlated noise."""
    mean, root = RNG.normal(size=N), np.zeros((N, N))
    root[:, :rank] = RNG.normal(size=(N, rank))
    H, C = RNG.normal(size=(m, N)), np.tril(RNG.normal(size=(m, m))) + 3 * np.eye(m)
    y = RNG.normal(size=m)
    found, covariance, distance, spread = update(mean, root, lambda x: H @ x, lambda _: H, y, C)
    P, R = root @ root.T, C @ C.T
    S = H @ P @ H.T + R
    gain = P @ H.T @ np.linalg.inv(S)
    assert found == pytest.approx(mean + gain @ (y - H @ mean), abs=1e-12)
    assert covariance == pytest.approx(P - gain @ S @ gain.T, abs=1e-12)
    assert distance == pytest.approx((y - H @ mean) @ np.linalg.solve(S, y - H @ mean))
    assert spread == pytest.approx(np.linalg.slogdet(S)[1] - np.linalg.slogdet(R)[1])


def test_iterations_end_in_the_least_squares_estimate():
    A, root = RNG.normal(size=(M, N)), np.tril(RNG.normal(size=(N, N))) + 2 * np.eye(N)
    mean, C = 0.1 * RNG.normal(size=N), 0.3 * np.eye(M)
    y = np.sin(A @ (mean + 0.1 * RNG.normal(size=N)))
    found, covariance, _, _ = update(
        mean, root, lambda x: np.sin(A @ x), lambda x: np.cos(A @ x)[:, None] * A, y, C, 40
    )

    def misfit(x):
        return np.concatenate([np.linalg.solve(root, x - mean), (y - np.sin(A @ x)) / 0.3])

    best = least_squares(misfit, mean, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found == pytest.approx(best.x, abs=1e-6)
    assert covariance == pytest.approx(np.linalg.inv(best.jac.T @ best.jac), abs=1e-5)


def test_bounds_hold_in_an_update_and_nan_is_no_result():
    H, y = np.eye(N), np.full(N, 5.0)
    lower, upper = -FREE.copy(), FREE.copy()
    upper[3] = 1.0
    found, *_ = update(
        np.zeros(N), np.eye(N), lambda x: x, lambda _: H, y, 1e-3 * H, bounds=(lower, upper)
    )
    assert found[3] == 1.0 and np.delete(found, 3) == pytest.approx(np.full(N - 1, 5.0), rel=1e-5)
    with pytest.raises(ArithmeticError):
        update(
            np.zeros(N), np.eye(N), lambda x: x, lambda _: H, y * np.nan, H, bounds=(lower, upper)
        )


def test_a_prediction_has_the_sum_of_both_covariances():
    c, n = core(), 20
    H, std, L = RNG.normal(size=(12, n)), RNG.uniform(0, 1, 12), RNG.normal(size=(n, n))
    walk, K = np.linspace(0, 1, n - 12), RNG.normal(size=(3, 12))
    std[3] = 0.0
    F = np.eye(n)
    F[:12], Q = H, np.diag(np.append(std, walk) ** 2)
    Q[:12, :12] += K.T @ K
    expected = F @ L @ L.T @ F.T + Q
    scratch = c.scratch((2 * n + len(K)) * n + n)
    given = c.at(H), c.at(std), c.at(walk), len(K), c.at(K), c.at(L)
    c.lib.stewart_root_of_prediction(n, *given, scratch)
    assert pytest.approx(expected, abs=1e-11) == L @ L.T
    assert not np.triu(L, 1).any()


@pytest.mark.parametrize("rank", [0, 4, N])
def test_a_root_of_a_covariance_that_may_be_singular(rank):
    half = RNG.normal(size=(N, rank))
    root = root_of(half @ half.T)
    assert pytest.approx(half @ half.T, abs=1e-6) == root @ root.T
