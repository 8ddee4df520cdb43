"""Stability and margins: the open loop under a delay, and the delayed LQI loop.

Open loop: an error of the predicted state grows by e^(p eta) before any torque can answer it, with
p the fastest pole.

Closed loop: near the reference, every variant of the law multiplies the error, its integral and the
torques in flight by a constant matrix K (`law.cost.law_gain`):

    T_k = -K [e_k; z_k; T_{k-L} ... T_{k-1}] = -K_e [e_k; z_k] - sum_i K_i T_{k-i}.      (law)

The loop is (law) around the sampled plant with its true A, B and delay. It is stable if all
eigenvalues of `closed_loop` lie inside the unit circle. Cut where the torques leave for the motors,
it is

    L(z) = (1 + sum_i K_i z^-i)^-1 K_e (z - A)^-1 (B_old z^-(mu+1) + B_new z^-mu),
    S = (1 + L)^-1,   T = L (1 + L)^-1.

All torques have the same unit, so the singular values of S and T have a meaning: the loop is stable
for every relative error of the motors below 1 / max |T|.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from stewart_drake.law.delay_model import DelayedModel, LinearModel, chain, delayed_model
from stewart_drake.scenario.timing import Delay
from stewart_drake.types import Array, Complex

SLOWEST_POLE: Final = 1e-3
"""1/s; a slower pole is the rounding of a double integrator's zero."""
FREQUENCIES: Final = 600
_LOWEST: Final = 1e-3
"""Lowest frequency of a grid, as a share of the Nyquist frequency."""
_EDGE: Final = 1e-9
"""Distance from the unit circle up to which a loop counts as unstable."""
_SQUARINGS: Final = 16
_OVERFLOW: Final = 1e100
"""Norm of a power of a matrix that is not squared again."""
_BISECTIONS: Final = 10
"""Within a factor of two: 0.1 % of the margin."""
_LONGEST_ERROR: Final = 30
"""Largest error of the delay in a search, periods."""
_GAIN_LIMIT: Final = 100.0
"""Largest gain of the motors in a search."""
_FINEST_DELAY: Final = 1e-4
"""Error of the delay at which a search begins, periods."""
_FINEST_GAIN: Final = 1e-3
"""Error of the motors' gain at which a search begins."""


def fastest_pole(A: Array) -> float:
    """Return the largest real part of the eigenvalues of A (n, n), 1/s; 0 if nothing grows."""
    pole = float(np.linalg.eigvals(A).real.max())
    return pole if pole > SLOWEST_POLE else 0.0


def amplification(pole: float, delay: float) -> float:
    """Return e^(pole delay), infinite on overflow; `pole` in 1/s, `delay` in s."""
    exponent = pole * delay
    return math.exp(exponent) if exponent < math.log(np.finfo(float).max) else math.inf


def largest_delay(pole: float, tolerable: float) -> float:
    """Return the time in s in which errors grow by the factor `tolerable`, 1 or more."""
    return math.log(tolerable) / pole if pole > 0 else math.inf


def spectral_radius(A: Array) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max())


def is_stable(A: Array, edge: float = _EDGE) -> bool:
    """Return whether all |lambda| < 1 - edge; eigenvalues are computed only near the circle.

    |A^k| < 1 proves stability, and |trace A^k| > n, the number of eigenvalues, instability. With k
    doubled again and again one of them holds soon, unless an eigenvalue is at the circle.
    """
    power = A / (1 - edge)
    for _ in range(_SQUARINGS):
        size = float(np.linalg.norm(power))
        if size < 1:
            return True
        if abs(float(np.trace(power))) > len(A):
            return False
        if not size < _OVERFLOW:
            break
        power = power @ power
    return spectral_radius(A) < 1 - edge


# ---------------------------------------------------------------- closed loop


def closed_loop(plant: DelayedModel, K: Array, gain: float = 1.0) -> Array:
    """Return the matrix of the loop over [e; torques sent, oldest first].

    Args:
        plant: the true plant, with its own delay.
        K: (m, n + m L) of (law).
        gain: factor on the torques of all motors.
    """
    n, m = plant.B_new.shape
    believed = (K.shape[1] - n) // m
    driven = replace(plant, B_old=gain * plant.B_old, B_new=gain * plant.B_new)
    line = chain(driven, believed)
    unused = np.zeros((m, len(line.A) - K.shape[1]))
    return line.A - line.B @ np.hstack([K[:, :n], unused, K[:, n:]])


@dataclass(frozen=True)
class LinearLoop:
    """True plant with the linearised law."""

    plant: LinearModel  # the true one, without integral states
    K: Array  # (m, n + m L) of (law)
    period: float  # s
    delay: Delay  # the true one
    integral: bool  # whether the law integrates the error

    def sampled(self, longer: float = 0.0, step: float | None = None) -> DelayedModel:
        """Return the plant over one period, with a delay that is `longer` by a time in s.

        `step` as of `delayed_model`.
        """
        delay = self.delay
        if longer:
            delay = Delay.of(delay.eta(self.period) + longer, self.period)
        return delayed_model(
            self.plant, self.period, delay.steps, delay.fraction, integral=self.integral, step=step
        )

    def matrix(self, longer: float = 0.0, gain: float = 1.0, step: float | None = None) -> Array:
        """Return `closed_loop` with a factor on the motors' torques; see `sampled`."""
        return closed_loop(self.sampled(longer, step), self.K, gain)


# ---------------------------------------------------------------- sensitivities


class Peak(NamedTuple):
    """Largest singular value over all frequencies, and its frequency in rad/s."""

    value: float
    frequency: float


def frequency_grid(period: float, number: int = FREQUENCIES) -> Array:
    """Return frequencies (number,) in rad/s, logarithmic up to Nyquist's, pi / period."""
    return np.pi / period * np.geomspace(_LOWEST, 1.0, number)


def loop_gain(plant: DelayedModel, K: Array, z: Complex) -> Complex:
    """Return L (k, m, m) at points z (k,), none of them a pole of the loop.

    Args:
        plant: the true plant.
        K: (m, n + m L) of (law).
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
    """Return S = (1 + L)^-1 (k, m, m)."""
    return np.linalg.inv(np.eye(gain.shape[1]) + gain)


def peaks(plant: DelayedModel, K: Array, period: float) -> tuple[Peak, Peak]:
    """Return the peaks of S and T = 1 - S of a stable loop with a period in s.

    A grid of frequencies brackets each peak, and a bounded search refines it.
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


# ---------------------------------------------------------------- margins


class Margins(NamedTuple):
    """Errors of delay and motors at which the loop becomes unstable; 0 and 1 if it is already."""

    shorter: float  # error of a true delay that is shorter, s; infinite if it may be 0
    longer: float  # error of a true delay that is longer, s; infinite beyond 30 periods
    gain_down: float  # factor on the torques of all motors, < 1; 0 if they may fail
    gain_up: float  # factor on the torques of all motors, > 1


def first_instability(loop: Callable[[float], Array], start: float, limit: float) -> float:
    """Return the least disturbance at which a loop becomes unstable, by doubling and bisection.

    Args:
        loop: the closed loop's matrix under a disturbance.
        start: first disturbance, > 0.
        limit: largest disturbance.

    Returns:
        0 if the loop is unstable undisturbed, infinity if it is stable up to `limit`. A loss of
        stability within a factor of two, regained in it, goes unnoticed.
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


def worst_margins(loops: Sequence[LinearLoop]) -> Margins:
    """Return the least margins of several loops of the same period and delay."""
    if not all(is_stable(loop.matrix()) for loop in loops):
        return Margins(0.0, 0.0, 1.0, 1.0)
    period = loops[0].period
    eta = loops[0].delay.eta(period)
    finest = _FINEST_DELAY * period

    def least(disturbed: Callable[[LinearLoop, float], Array], start: float, limit: float) -> float:
        found = math.inf
        for loop in loops:
            if math.isfinite(found) and is_stable(disturbed(loop, found)):
                continue  # another loop has a smaller margin
            up_to = min(limit, found)
            found = min(found, first_instability(partial(disturbed, loop), start, up_to))
        return found

    longer = least(lambda loop, by: loop.matrix(longer=by), finest, _LONGEST_ERROR * period)
    shorter = least(lambda loop, by: loop.matrix(longer=-by), finest, eta) if eta else math.inf
    up = least(lambda loop, by: loop.matrix(gain=1 + by), _FINEST_GAIN, _GAIN_LIMIT)
    down = least(lambda loop, by: loop.matrix(gain=1 - by), _FINEST_GAIN, 1.0)
    return Margins(shorter, longer, max(0.0, 1 - down), 1 + up)
