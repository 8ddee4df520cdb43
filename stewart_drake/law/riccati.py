"""The delayed LQI gain, equations (40)-(44), and its reduction to a delay-free Riccati equation."""

from dataclasses import replace

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.delay_model import DelayedModel, chain
from stewart_drake.law.stability import is_stable
from stewart_drake.scenario.signals import NUM_TORQUES
from stewart_drake.types import Array

ORDERS = (6, 12, 18, 24)
"""Numbers of states that the solver in C takes."""


class RiccatiError(ArithmeticError):
    """The Riccati equation has no stabilising solution, or the solver did not find it.

    It concerns values. Shapes that do not fit raise a ValueError.
    """


def lqr(A: Array, B: Array, Q: Array, R: Array) -> tuple[Array, Array]:
    """Return the gain K (6, n) of T = -K x that minimises sum x'Qx + T'RT, and P (n, n).

    (43)-(44) by core/riccati.c, which also gives the law its gain. Q and R are symmetric, n is in
    ORDERS.

    Raises:
        RiccatiError: no stabilising solution was found.
        ValueError: naming the matrix whose shape does not fit.
    """
    c, n, m = core(), len(A), NUM_TORQUES
    if n not in ORDERS:
        raise ValueError(f"A: got {n} states; expected one of {ORDERS}")
    expected = {"A": (A, (n, n)), "B": (B, (n, m)), "Q": (Q, (n, n)), "R": (R, (m, m))}
    for name, (matrix, shape) in expected.items():
        if matrix.shape != shape:
            raise ValueError(f"{name}: got shape {matrix.shape}; expected {shape}")
    given = [np.ascontiguousarray(matrix, np.float64) for matrix, _ in expected.values()]
    K, P = np.empty((m, n)), np.empty((n, n))
    scratch = c.scratch(c.lib.stewart_lqr_scratch(n))
    found = c.lib.stewart_lqr(n, *map(c.at, given), c.at(K), c.at(P), scratch)
    if not (found and is_stable(A - B @ K, edge=0.0)):
        raise RiccatiError(
            "Riccati equation: found no stabilising gain; the torques do not reach an unstable "
            "mode, or the cost does not see one"
        )
    return K, P


def reduced_gain(model: DelayedModel, Q: Array, R: Array) -> Array:
    """Return K (6, n) on the state predicted to the instant at which the next torque acts.

    T_k cannot change e_k ... e_{k+mu}, and the cost puts no weight on the queue. The rest to
    minimise is the cost from e_{k+mu} on, with mu = 0 and an immediate T_k. Where eta0 > 0 the
    last part of T_{k-1} is still to act by then, so the predicted state is [e_{k+mu}; T_{k-1}] and
    K is (6, n + 6).

    Raises:
        RiccatiError: see `lqr`.
    """
    free = chain(replace(model, steps=0))
    u = _units(np.zeros_like(R), R)
    x = _units(model.A, model.C.T @ Q @ model.C)
    x = np.concatenate([x, u]) if model.fraction > 0 else x
    Q = free.C.T @ Q @ free.C
    scaled = free.A * x / x[:, None], free.B * u / x[:, None]
    K, _ = lqr(*scaled, Q * np.outer(x, x), R * np.outer(u, u))
    return K * u[:, None] / x


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
