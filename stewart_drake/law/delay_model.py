"""The error model, equations (20)-(28), and its sampling with a delayed input, (29)-(39).

About a reference, e_bar = [X - X_d; d(X - X_d)/dt] obeys  e_bar_dot = A e_bar + B T + d,  with d
gravity minus the desired acceleration (21). States are in the order e = [pose error; rate error;
integral].

The torque T_k computed at t = k dt acts during [(k + mu) dt + eta0, (k + 1 + mu) dt + eta0). Over
one period the old torque acts for eta0, the new one for the rest:

    e_{k+1} = A e_k + B_old T_{k-mu-1} + B_new T_{k-mu},
    A = exp(A_c dt),  B_old = int_0^eta0 exp(A_c (dt - s)) B_c ds,
    B_new = int_eta0^dt exp(A_c (dt - s)) B_c ds.                                      (32), (35)

Integral states are not sampled from (24) but follow the recurrence that the controller itself can
compute, the trapezoid rule z_{k+1} = z_k + dt/2 (y_k + y_{k+1}), y = C_bar e_bar.

The chain appends the torques in flight, oldest first (33)-(39). T_{k-mu-1} is a state only when
eta0 > 0; the paper always carries it, which adds an unobservable block when eta0 = 0.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, POSE, RATES
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array


class LinearModel(NamedTuple):
    """e_dot, or the next e, is A e + B T, A (n, n), B (n, m); the cost sees y = C e, C (p, n)."""

    A: Array
    B: Array
    C: Array


def double_integrators(torque_map: Array) -> LinearModel:
    """Return (20)-(23), a double integrator per coordinate.

    Its accelerations are torque_map (6, 6) times the torques; C selects the pose error.
    """
    A = np.zeros((NUM_STATE, NUM_STATE))
    A[POSE, RATES] = np.eye(NUM_COORDINATES)
    B = np.zeros((NUM_STATE, torque_map.shape[1]))
    B[RATES] = torque_map
    return linear_model(A, B)


def linear_model(A: Array, B: Array) -> LinearModel:
    """Return a model whose cost has the pose error, from A (12, 12), B (12, 6) of [pose; rates]."""
    return LinearModel(A, B, np.eye(NUM_COORDINATES, NUM_STATE))


def with_integral(model: LinearModel) -> LinearModel:
    """Return (24)-(28): 18 states with z_dot = pose error; C selects pose error and integral."""
    n, m = model.B.shape
    p = model.C.shape[0]
    A = np.block([[model.A, np.zeros((n, p))], [model.C, np.zeros((p, p))]])
    B = np.vstack([model.B, np.zeros((p, m))])
    C = np.block([[model.C, np.zeros((p, p))], [np.zeros((p, n)), np.eye(p)]])
    return LinearModel(A, B, C)


@dataclass(frozen=True)
class DelayedModel:
    """e_{k+1} = A e_k + B_old T_{k-mu-1} + B_new T_{k-mu}; the cost sees y = C e.

    A (n, n), B_old and B_new (n, m), C (p, n); `steps` is mu; `fraction` is eta0 / dt in [0, 1).
    """

    A: Array
    B_old: Array
    B_new: Array
    C: Array
    steps: int
    fraction: float

    @property
    def queue_length(self) -> int:
        """Torques in flight at a sampling instant."""
        return Delay(self.steps, self.fraction).queue_length


def sample(A: Array, B: Array, duration: float) -> tuple[Array, Array]:
    """Return exp(A t) (n, n) and int_0^t exp(A s) B ds (n, m) by one exponential (Van Loan).

    Raises:
        FloatingPointError: the exponential overflows.
    """
    n, m = B.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = A * duration, B * duration
    # Next to a dead centre A grows without bound; an overflow is an error, not a warning.
    with np.errstate(over="raise", invalid="raise"):
        exponential = expm(block)
    return exponential[:n, :n], exponential[:n, n:]


def sample_in_steps(A: Array, B: Array, duration: float, step: float) -> tuple[Array, Array]:
    """Return the same as `sample`, for an engine that takes steps of semi-implicit Euler.

    With x = [pose error; rate error], A (2k, 2k) and B (2k, m), one step h advances the rates first
    and then the pose with the new rates,

        v' = v + h (A_v x + B_v u),   p' = p + h v',

    so that the pose of a plate under constant acceleration runs h/2 ahead of the truth.
    """
    n, m = B.shape
    once = np.eye(n + m)
    once[n // 2 : n, :n] += step * A[n // 2 :]
    once[n // 2 : n, n:] += step * B[n // 2 :]
    once[: n // 2] += step * once[n // 2 : n]
    many = np.linalg.matrix_power(once, round(duration / step))
    return many[:n, :n], many[:n, n:]


def delayed_model(
    model: LinearModel,
    period: float,
    steps: int,
    fraction: float = 0.0,
    *,
    integral: bool,
    step: float | None = None,
) -> DelayedModel:
    """Sample [pose error; rate error] with its delayed torque; append the integral's recurrence.

    Args:
        model: A (n, n), B (n, m), C (p, n) without integral states.
        period: dt in s.
        steps: mu, whole periods of delay.
        fraction: eta0 / dt, in [0, 1).
        integral: append z (p), whose rows the cost sees too (28).
        step: of an engine that moves the plant by semi-implicit Euler, s; period and fraction are
            multiples of it. None: exact sampling.

    Raises:
        ValueError: a negative delay, or a period that is not positive.
    """
    if not 0 < period < np.inf:
        raise ValueError(f"period: got {period}; expected a positive time in s")
    Delay(steps, fraction)  # checks them
    eta0 = fraction * period

    def sampled(duration: float) -> tuple[Array, Array]:
        if step is None:
            return sample(model.A, model.B, duration)
        return sample_in_steps(model.A, model.B, duration, step)

    A, B_new = sampled(period - eta0)
    B_old = np.zeros_like(B_new)
    if eta0 > 0:
        A_eta0, B_eta0 = sampled(eta0)
        A, B_old = A @ A_eta0, A @ B_eta0
    C = model.C
    if integral:
        n, p = A.shape[0], C.shape[0]
        half = period / 2 * C
        # z_{k+1} = z_k + dt/2 C (e_k + A e_k + B_old T_{k-mu-1} + B_new T_{k-mu})
        A_without, A = A, np.eye(n + p)
        A[:n, :n], A[n:, :n] = A_without, half + half @ A_without
        C = np.zeros((2 * p, n + p))
        C[:p, :n], C[p:, n:] = model.C, np.eye(p)
        B_old, B_new = (np.concatenate([B, half @ B]) for B in (B_old, B_new))
    return DelayedModel(A, B_old, B_new, C, steps, fraction)


def chain(model: DelayedModel, carried: int = 0) -> LinearModel:
    """Return the delay chain (37)-(39) as one undelayed system of [e; queue, oldest torque first].

    Args:
        carried: torques in the queue, if more than are in flight; the paper always has mu + 1.
    """
    n, m = model.B_new.shape
    length = max(model.queue_length, carried)
    A, B = np.zeros((n + m * length, n + m * length)), np.zeros((n + m * length, m))
    A[:n, :n] = model.A
    if length:
        A[n:-m, n + m :] = np.eye(m * (length - 1))
        B[-m:] = np.eye(m)
    for age, B_of_torque in ((model.steps + 1, model.B_old), (model.steps, model.B_new)):
        if age == 0:  # acts at once
            B[:n] += B_of_torque
        elif age <= length:
            place = n + m * (length - age)
            A[:n, place : place + m] += B_of_torque
    C = np.hstack([model.C, np.zeros((model.C.shape[0], m * length))])
    return LinearModel(A, B, C)
