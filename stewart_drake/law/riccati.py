"""The delayed LQI gain, equations (40)-(44), and its reduction to a delay-free Riccati equation."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import DiscreteAlgebraicRiccatiEquation

from stewart_drake.core.library import core
from stewart_drake.law.delay_model import DelayedModel, chain
from stewart_drake.law.stability import is_stable
from stewart_drake.types import Array, Complex

Solver = Callable[[Array, Array, Array, Array], tuple[Array, Array]]
"""Function with the arguments and results of `lqr`."""


MAX_ORDER = 24
"""States in `lqr_by_doubling`: error, integral, and a torque that still acts."""
RESIDUAL = 1e-4
"""Largest residual of the Riccati equation, relative to its solution."""


class RiccatiError(ArithmeticError):
    """The Riccati equation has no stabilising solution, or the solver did not find it.

    It concerns values. Shapes that do not fit raise a ValueError.
    """


def lqr(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return the gain K (m, n) of T = -K x that minimises sum x'Qx + T'RT, and P (n, n).

    (43)-(44) by Drake's DiscreteAlgebraicRiccatiEquation. That function can end the process on bad
    input, and can return NaN or a matrix that solves nothing, so both sides of it are checked here.

    Raises:
        RiccatiError: naming the matrix and what is wrong with it, or that no solution was found.
        ValueError: naming the matrix whose shape does not fit.
    """
    _check(A, B, Q, R)
    try:
        # Drake wants column order, and exactly symmetric weights.
        P = DiscreteAlgebraicRiccatiEquation(
            *(np.asfortranarray(matrix) for matrix in (A, B, (Q + Q.T) / 2, (R + R.T) / 2))
        )
        K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    except SystemExit as error:  # what Drake demands and `_check` does not look at
        raise RiccatiError(
            f"(A, Q): has an unstable mode that the cost hardly sees, if at all: {error}"
        ) from None
    except RuntimeError as error:
        raise RiccatiError(f"Riccati equation: {error}") from None
    except np.linalg.LinAlgError:
        raise RiccatiError("Riccati equation: R + B'PB is singular") from None
    if not (np.all(np.isfinite(P)) and np.all(np.isfinite(K))):
        raise RiccatiError("Riccati equation: Drake's solver returned NaN; rescale Q and R")
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        closed = A - B @ K
        residual, size = np.linalg.norm(Q + A.T @ P @ closed - P), np.linalg.norm(P)
        solved = residual <= RESIDUAL * size < np.inf and is_stable(closed, edge=0.0)
    if not solved:
        raise RiccatiError("Riccati equation: Drake's solver did not solve it; rescale Q and R")
    return K, P


def lqr_by_doubling(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return K (6, n) and P (n, n) as `lqr` does, by the solver of core/riccati.c.

    Raises:
        RiccatiError: no stabilising solution was found.
        ValueError: more than 24 states.
    """
    c, n = core(), len(A)
    if n > MAX_ORDER:
        raise ValueError(f"A: got {n} states; expected at most {MAX_ORDER}")
    matrices = [np.ascontiguousarray(matrix, np.float64) for matrix in (A, B, Q, R)]
    K, P = np.empty((B.shape[1], n)), np.empty((n, n))
    given = (*map(c.at, matrices), c.at(K), c.at(P), c.scratch(c.lib.stewart_lqr_scratch(n)))
    if not c.lib.stewart_lqr(n, *given):
        raise RiccatiError("Riccati equation: doubling has found no solution")
    return K, P


def full_gain(model: DelayedModel, Q: Array, R: Array, solver: Solver = lqr) -> tuple[Array, Array]:
    """Return (42)-(44) on the whole chain (37)-(39): K (m, n + m L) and P, with Q on y = C e.

    The queue makes the equation large; `law.cost.law_gain` finds the same K without it.

    Raises:
        RiccatiError: see `lqr`.
    """
    augmented = chain(model)
    A, B, C = augmented.A, augmented.B, augmented.C
    u = _units(np.zeros_like(R), R)
    x = np.concatenate([_units(model.A, model.C.T @ Q @ model.C), np.tile(u, model.queue_length)])
    Q = C.T @ Q @ C
    K, P = solver(A * x / x[:, None], B * u / x[:, None], Q * np.outer(x, x), R * np.outer(u, u))
    return K * u[:, None] / x, P / np.outer(x, x)


def _units(A: Array, Q: Array) -> Array:
    """Return the size (n,) of each state that costs one now and at the next sample together.

    With metres and radians, for a machine of 1 mm or of 1 m, the solver finds matrices singular or
    not by their units. With x = diag(units) x~ and T likewise the equation has none:
    P~ = units P units and K~ = K units / units, for any size of the machine.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # `lqr` refuses NaN
        cost = np.diag(Q) + np.einsum("ji,ji->i", A, Q @ A)
    useful = np.isfinite(cost) & (cost > 0)
    return 1 / np.sqrt(np.where(useful, cost, 1.0))


def reduced_gain(model: DelayedModel, Q: Array, R: Array, solver: Solver = lqr) -> Array:
    """Return K (m, n) on the state predicted to the instant at which the next torque acts.

    T_k cannot change e_k ... e_{k+mu}, and the cost puts no weight on the queue. The rest to
    minimise is the cost from e_{k+mu} on, with mu = 0 and an immediate T_k. Where eta0 > 0 the
    last part of T_{k-1} is still to act by then, so the predicted state is [e_{k+mu}; T_{k-1}] and
    K is (m, n + m).

    Raises:
        RiccatiError: see `lqr`.
    """
    return full_gain(replace(model, steps=0), Q, R, solver)[0]


def prediction_matrix(model: DelayedModel) -> Array:
    """Return the map of [e; queue] (n + m L) to the predicted state of `reduced_gain`.

    Without a fraction this is [A^mu, A^(mu-1) B, ..., B], ordered as the queue.
    """
    n, m = model.B_new.shape
    extra, length = model.queue_length - model.steps, m * model.queue_length
    # Read backwards: T_{k-1} acts last, its predecessors one factor A earlier each.
    ahead, columns = np.hstack([np.eye(n), model.B_new, model.B_old]), []
    for _ in range(model.steps):
        columns.append(ahead[:, n:])
        ahead = model.A @ ahead
    power, torques = ahead[:, :n], np.zeros((n, length))
    if columns:
        oldest_first = np.stack(columns[::-1], axis=1)
        torques[:, m * extra :] += oldest_first[:, :, :m].reshape(n, -1)
        torques[:, : m * model.steps] += oldest_first[:, :, m:].reshape(n, -1)
    newest = np.zeros((m * extra, n + length))
    newest[:, n + length - m * extra :] = np.eye(m * extra)
    return np.vstack([np.hstack([power, torques]), newest])


def _check(A: Array, B: Array, Q: Array, R: Array) -> None:
    for name, matrix in (("A", A), ("B", B)):
        if matrix.ndim != 2 or matrix.size == 0:
            raise ValueError(f"{name}: got shape {matrix.shape}; expected rows and columns")
    n, m = B.shape
    expected = {"A": (A, (n, n)), "B": (B, (n, m)), "Q": (Q, (n, n)), "R": (R, (m, m))}
    for name, (matrix, shape) in expected.items():
        if matrix.shape != shape:
            raise ValueError(f"{name}: got shape {matrix.shape}; expected {shape}")
        if not np.isfinite(matrix).all():
            raise RiccatiError(f"{name}: has entries that are not finite")
    for name, matrix in (("Q", Q), ("R", R)):
        if np.abs(matrix - matrix.T).max() > 1e-9 * np.abs(matrix).max():
            raise RiccatiError(f"{name}: is not symmetric")
    if np.linalg.eigvalsh(R)[0] <= 0:
        raise RiccatiError("R: is not positive definite")
    lowest, highest = np.linalg.eigvalsh(Q)[[0, -1]]
    if lowest < -1e-10 * max(highest, -lowest):
        raise RiccatiError(f"Q: has the eigenvalue {lowest:.3g}; expected a semidefinite matrix")
    if not is_stabilizable(A, B):
        raise RiccatiError("(A, B): has an unstable mode that no torque reaches")


def is_stabilizable(A: Array, B: Array) -> bool:
    """Return whether the input reaches every mode with |lambda| >= 1 (up to rounding).

    [B, AB, A^2 B] of full rank proves controllability, at a tenth of the cost of the PBH test,
    which decides where those three do not.
    """
    blocks = [B, A @ B, A @ A @ B]
    K = np.hstack([block / np.maximum(np.linalg.norm(block), 1e-300) for block in blocks])
    if len(A) <= K.shape[1]:
        singular_values = np.linalg.svd(K, compute_uv=False)
        if singular_values[len(A) - 1] > 1e-9 * singular_values[0]:
            return True
    eigenvalues = np.linalg.eigvals(A)
    unstable = distinct(eigenvalues[np.abs(eigenvalues) >= 1 - 1e-6], 1e-5)
    scale = np.linalg.norm(A) + np.linalg.norm(B)
    return bool(np.all(pbh_margins(A, B, unstable) > 1e-13 * scale * len(A)))


def pbh_margins(A: Array, B: Array, eigenvalues: Complex) -> Array:
    """Return the smallest singular value of [lambda I - A, B] for each eigenvalue (k,)."""
    if eigenvalues.size == 0:
        return np.empty(0)
    real = np.all(np.abs(eigenvalues.imag) <= 1e-12 * np.abs(eigenvalues))
    # Real arithmetic takes half the time.
    at = eigenvalues.real if real else eigenvalues
    return np.linalg.svd(pencils(A, B, at), compute_uv=False)[:, -1]


def distinct(values: Complex, resolution: float) -> Complex:
    """Return one value of each group that agrees to `resolution`."""
    grid = np.round(values / resolution)
    _, first = np.unique(grid, return_index=True)
    return values[first]


def pencils(A: Array, B: Array, points: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Return [lambda I - A, B] (k, n, n + m) for points lambda (k,)."""
    shifted = points[:, None, None] * np.eye(len(A)) - A
    return np.concatenate([shifted, np.broadcast_to(B, (len(points), *B.shape))], axis=2)
