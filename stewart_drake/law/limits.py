"""What a delay does to the open loop, and how much the delayed LQI loop can bear.

Open loop: an error of the predicted state grows by e^(p eta) before any torque can answer it, with
p the fastest pole. Closed loop: T_k = -K_e e_k - sum_i K_i T_{k-i} over the torques in flight makes
the controller a filter, and cut where the torques leave it for the motors the loop is

    L(z) = (1 + sum_i K_i z^-i)^-1 K_e (z - A)^-1 (B_old z^-(mu+1) + B_new z^-mu),
    S = (1 + L)^-1,   T = L (1 + L)^-1.

All torques have one unit, so the singular values of S and T mean something: 1 / max |T| is the
relative error of the motors, of any kind, that the loop bears for certain. The plant's delay and
the one believed in may differ.
"""

import math
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from stewart_drake.law.delay_model import DelayedModel
from stewart_drake.types import Array, Complex

SLOWEST_POLE: Final = 1e-3
"""1/s; below it a pole is the rounding of a double integrator's zero."""
FREQUENCIES: Final = 600
_LOWEST: Final = 1e-3
"""Of the Nyquist frequency, where a grid of frequencies begins."""
_EDGE: Final = 1e-9
"""Distance from the unit circle up to which a loop counts as unstable."""
_SQUARINGS: Final = 16
_OVERFLOW: Final = 1e100
"""Where powers are squared no further."""
_BISECTIONS: Final = 10
"""After a bracket of a factor of two: 0.1 % of the margin."""


class Peak(NamedTuple):
    """Largest singular value over all frequencies, and where, rad/s."""

    value: float
    frequency: float


def fastest_pole(A: Array) -> float:
    """Largest real part of the eigenvalues of A (n, n), 1/s; 0 where nothing grows."""
    pole = float(np.linalg.eigvals(A).real.max())
    return pole if pole > SLOWEST_POLE else 0.0


def amplification(pole: float, delay: float) -> float:
    """e^(pole delay), infinite where that overflows; `pole` in 1/s, `delay` in s."""
    exponent = pole * delay
    return math.exp(exponent) if exponent < math.log(np.finfo(float).max) else math.inf


def largest_delay(pole: float, tolerable: float) -> float:
    """s, over which errors grow by no more than `tolerable`: ln(tolerable) / pole.

    Raises:
        ValueError: `tolerable` below 1.
    """
    if not tolerable >= 1:
        raise ValueError(f"tolerable: got {tolerable}; expected a factor of 1 or more")
    return math.log(tolerable) / pole if pole > 0 else math.inf


def frequency_grid(period: float, number: int = FREQUENCIES) -> Array:
    """(number,) rad/s, logarithmic up to the Nyquist frequency pi / period."""
    return np.pi / period * np.geomspace(_LOWEST, 1.0, number)


def loop_gain(plant: DelayedModel, K: Array, z: Complex) -> Complex:
    """L (k, m, m) of the loop cut at the motors, for points z (k,) that are no poles of the loop.

    Args:
        plant: as it is.
        K: (m, n + m L), a gain that knows the last L torques.
        z: on the unit circle, e^(j omega dt).
    """
    n, m = plant.B_new.shape
    to_state = np.linalg.solve(
        z[:, None, None] * np.eye(n) - plant.A, np.hstack([plant.B_old, plant.B_new])
    )
    last = z[:, None, None] ** -plant.steps
    states = to_state[:, :, :m] * last / z[:, None, None] + to_state[:, :, m:] * last
    length = (K.shape[1] - n) // m
    memory = np.broadcast_to(np.eye(m), (len(z), m, m))
    for place in range(length):  # the oldest first
        block = K[:, n + m * place : n + m * (place + 1)]
        memory = memory + block * z[:, None, None] ** -(length - place)
    return np.linalg.solve(memory, K[:, :n] @ states)


def sensitivity(gain: Complex) -> Complex:
    """S = (1 + L)^-1 (k, m, m)."""
    return np.linalg.inv(np.eye(gain.shape[1]) + gain)


def peaks(plant: DelayedModel, K: Array, period: float) -> tuple[Peak, Peak]:
    """Peaks of the sensitivity S and of the complementary sensitivity T = 1 - S of a stable loop.

    `period` is dt in s. Found on a grid of frequencies, then by a search next to the largest.
    """
    grid = frequency_grid(period)
    identity = np.eye(K.shape[0])

    def sizes(omega: Array) -> tuple[Array, Array]:
        S = sensitivity(loop_gain(plant, K, np.exp(1j * omega * period)))
        top = np.linalg.svd(np.stack([S, identity - S]), compute_uv=False)[:, :, 0]
        return top[0], top[1]

    found = []
    for which, values in enumerate(sizes(grid)):
        at = int(values.argmax())
        low, high = grid[max(at - 1, 0)], grid[min(at + 1, len(grid) - 1)]
        best = minimize_scalar(
            lambda omega, which=which: -sizes(np.array([omega]))[which][0],
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-6 * high},
        )
        on_grid = Peak(float(values[at]), float(grid[at]))
        found.append(max(on_grid, Peak(-float(best.fun), float(best.x))))
    return found[0], found[1]


def closed_loop(plant: DelayedModel, K: Array, gain: float = 1.0) -> Array:
    """The loop as one matrix over [e; torques sent, oldest first].

    Args:
        plant: as it is, with its own delay.
        K: (m, n + m L), a gain that knows the last L torques.
        gain: by which all motors are stronger than they should be.
    """
    n, m = plant.B_new.shape
    believed = (K.shape[1] - n) // m
    length = max(plant.queue_length, believed)
    control = np.hstack([K[:, :n], np.zeros((m, m * (length - believed))), K[:, n:]])
    A = np.zeros((n + m * length, n + m * length))
    A[:n, :n] = plant.A
    if length:
        A[n:-m, n + m :] = np.eye(m * (length - 1))
        A[-m:] = -control
    for age, B in ((plant.steps + 1, plant.B_old), (plant.steps, plant.B_new)):
        if age == 0:  # acts at once
            A[:n] -= gain * B @ control
        elif age <= length:
            A[:n, n + m * (length - age) : n + m * (length - age + 1)] += gain * B
    return A


def spectral_radius(A: Array) -> float:
    """Largest magnitude of the eigenvalues."""
    return float(np.abs(np.linalg.eigvals(A)).max())


def is_stable(A: Array) -> bool:
    """Whether all |lambda| < 1, without eigenvalues where a power of A decides.

    |A^k| < 1 proves that, and |trace A^k| > n, with n eigenvalues, the contrary. Squared again and
    again, either comes soon unless an eigenvalue is right at the circle.
    """
    power = A / (1 - _EDGE)
    for _ in range(_SQUARINGS):
        size = float(np.linalg.norm(power))
        if size < 1:
            return True
        if abs(float(np.trace(power))) > len(A):
            return False
        if not size < _OVERFLOW:
            break
        power = power @ power
    return spectral_radius(A) < 1 - _EDGE


def first_instability(loop: Callable[[float], Array], start: float, limit: float) -> float:
    """The least disturbance at which a loop is no longer stable.

    Args:
        loop: the closed loop's matrix under a disturbance of this size.
        start: the smallest one looked at, > 0; it is doubled until the loop is unstable.
        limit: the largest one looked at.

    Returns:
        0 where the loop is unstable undisturbed, infinity where it is stable up to `limit`.
        Stability that is lost and regained within a factor of two is not seen.
    """

    if not is_stable(loop(0.0)):
        return 0.0
    low, high = 0.0, min(start, limit)
    while is_stable(loop(high)):
        if high >= limit:
            return math.inf
        low, high = high, min(2 * high, limit)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if is_stable(loop(middle)) else (low, middle)
    return (low + high) / 2
