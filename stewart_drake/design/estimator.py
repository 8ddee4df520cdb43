"""Extended Kalman filter over the state and eight constant parameters of the plant.

The parameters theta (torque bias, payload, joint damping; `signals.PARAMETERS`) never change, the
state obeys the exact dynamics under the torques that are known to act:

    [x_{k+1}; theta] = [f(x_k, T, theta); theta] + noise,       y_k = x_k + measurement noise.

Linearised, F = [[Phi, S], [0, 1]] with Phi = df/dx and S = df/dtheta. One-step prediction errors
drive the filter: y_k corrects x_{k-1} and theta, and x_k follows by the model. The error of one
step of the model counts as noise of y_k there, and widens the covariance of x_k.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.special import chdtri

from stewart_drake.design.filter_settings import FilterSettings
from stewart_drake.design.holds import GAUSS_NODES
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.signals import NUM_PARAMETERS, NUM_STATE, POSE, RATES

Array = NDArray[np.float64]
THETA = slice(NUM_STATE, NUM_STATE + NUM_PARAMETERS)
GATE = float(chdtri(NUM_STATE, 1e-6))
"""Squared innovation, in units of its covariance, above which a measurement is an outlier."""
ITERATIONS = 4
"""At the most; one does once the parameters are roughly known."""
MIDPOINT = np.array([0.5])
SMALL = 0.1
"""A correction so many standard deviations long needs no second look."""
KNOWN = 0.01
"""A parameter is known when its standard deviation is this share of the prior's."""
PATIENCE = 3
"""After so many outliers in a row the model must be wrong, and the measurement is believed."""


class Period(NamedTuple):
    """What acted between two samples, as far as the delay is what it is believed to be."""

    torques: Array
    """(n, 6) N m, one after the other."""
    durations: Array
    """(n,) s."""
    following: Array
    """(6,) N m, acts next."""
    substeps: int
    """Integration steps per torque."""


@dataclass(frozen=True)
class Estimate:
    """Mean (20,) and covariance (20, 20) of [state; parameters]; outliers seen in a row."""

    mean: Array
    covariance: Array
    outliers: int = 0

    @property
    def state(self) -> Array:
        """(12,)."""
        return self.mean[:NUM_STATE]

    @property
    def parameters(self) -> Array:
        """(8,)."""
        return self.mean[THETA]

    @property
    def parameter_std(self) -> Array:
        """(8,)."""
        return np.sqrt(np.diag(self.covariance)[THETA])


def start(measurement: Array, settings: FilterSettings) -> Estimate:
    """The estimate from the first measurement (12,) alone."""
    variance = np.concatenate([settings.noise_std**2, settings.prior_std**2])
    mean = np.concatenate([measurement, np.zeros(NUM_PARAMETERS)])
    return Estimate(mean, np.diag(variance))


def advance(
    estimate: Estimate,
    dynamics: StewartDynamics,
    period: Period,
    measurement: Array | None,
    settings: FilterSettings,
) -> Estimate:
    """One period, then a measurement (12,) at its end, or none.

    The first steps move the parameters far: linearising once is not enough. The mean xi of
    [previous state; parameters] is found by Gauss-Newton iterations of

        min (xi - mean)' P^-1 (xi - mean) + (y - f(xi))' R^-1 (y - f(xi)),

    the iterated filter over one transition; one iteration is the extended Kalman filter. A
    measurement that does not fit (an outlier, iterations that diverge) is left out and the model
    goes on alone; after PATIENCE of them, or where the model cannot go on, the measurement does.
    """
    outliers = 0 if measurement is None else estimate.outliers + 1
    if measurement is not None:
        after = _attempt(estimate, dynamics, period, measurement, settings)
        if after is not None:
            return after
    after = _attempt(estimate, dynamics, period, None, settings)
    if after is not None and outliers < PATIENCE:
        return replace(after, outliers=outliers)
    if measurement is None:
        return estimate
    mean = np.concatenate([measurement, estimate.parameters])
    return Estimate(mean, start(measurement, settings).covariance)


def _attempt(
    estimate: Estimate,
    dynamics: StewartDynamics,
    period: Period,
    measurement: Array | None,
    settings: FilterSettings,
) -> Estimate | None:
    """`advance` for a measurement that fits; None for an outlier, or without a finite result."""
    try:
        with np.errstate(all="ignore"):
            after = _filter(estimate, dynamics, period, measurement, settings)
    except (np.linalg.LinAlgError, ValueError):
        return None
    if after is None or not np.all(np.isfinite(after.covariance)):
        return None
    return after if np.all(np.isfinite(after.mean)) else None


def _filter(
    estimate: Estimate,
    dynamics: StewartDynamics,
    period: Period,
    measurement: Array | None,
    settings: FilterSettings,
) -> Estimate | None:
    prior, P = estimate.mean, estimate.covariance
    xi = prior
    # Corrections of parameters that are known already are too small to need F to fourth order.
    known = np.all(estimate.parameter_std <= KNOWN * settings.prior_std)
    nodes = MIDPOINT if known else GAUSS_NODES
    after, F = _transition(dynamics, xi, period, nodes)
    kicks = _kicks(dynamics, after, xi[THETA], period)
    drift = np.diag(settings.model_std**2 + settings.timing_std**2 * np.sum(kicks**2, axis=0))
    R = np.diag(settings.noise_std**2) + drift
    if measurement is not None:
        for _ in range(ITERATIONS):
            H = F[:NUM_STATE]
            innovation = measurement - after - H @ (prior - xi)
            S = H @ P @ H.T + R
            gain = np.linalg.solve(S, H @ P).T
            keep = np.eye(len(xi)) - gain @ H
            posterior = keep @ P @ keep.T + gain @ R @ gain.T  # Joseph's form stays positive
            moved = _within_bounds(prior + gain @ innovation, posterior, settings)
            shift, xi = H @ (moved - xi), moved
            small = SMALL * np.sqrt(np.diag(R))
            linear = after + shift
            # What linearising leaves out is of second order: nothing beside a small correction.
            if np.all(np.abs(shift) <= small):
                after = linear
                break
            after = _integrate(dynamics, xi, period)[-1]
            if np.all(np.abs(after - linear) <= small):
                break
            after, F = _transition(dynamics, xi, period, nodes)
        if not innovation @ np.linalg.solve(S, innovation) <= GATE:  # or NaN
            return None
        P = posterior
    P = F @ P @ F.T
    P[:NUM_STATE, :NUM_STATE] += drift
    return Estimate(np.concatenate([after, xi[THETA]]), (P + P.T) / 2)


def _kicks(dynamics: StewartDynamics, state: Array, theta: Array, period: Period) -> Array:
    """(n, 12) change of the last state per s by which one of the n changes of torque comes early.

    To first order: for that time the acceleration differs by B dT, which stays in the rates, and
    moves the pose for what is left of the period.
    """
    pose, rates = state[POSE], state[RATES]
    torques = (*period.torques, period.following)
    changes = np.diff([dynamics.accelerations(pose, rates, T, theta) for T in torques], axis=0)
    left = period.durations.sum() - np.cumsum(period.durations)
    return np.hstack([left[:, None] * changes, changes])


def _integrate(dynamics: StewartDynamics, xi: Array, period: Period) -> Array:
    """States (n, 12) after each of n torques, from [state; parameters] (20,)."""
    torques, durations, substeps = period.torques, period.durations, period.substeps
    return dynamics.predict(xi[:NUM_STATE], torques, durations, substeps, xi[THETA])


def _transition(
    dynamics: StewartDynamics, xi: Array, period: Period, nodes: Array = GAUSS_NODES
) -> tuple[Array, Array]:
    """State (12,) after the torques, and F (20, 20) of [state; parameters].

    F = exp(Omega) solves F_dot = [[A, G], [0, 0]] F to fourth order with A and G at the two Gauss
    nodes: Omega = h/2 (L_1 + L_2) + sqrt(3)/12 h^2 [L_2, L_1] (Magnus); MIDPOINT is of second. The
    filter divides tiny innovations by F: such an error would already look like a disturbance.
    """
    x, theta = xi[:NUM_STATE], xi[THETA]
    total = np.eye(NUM_STATE + NUM_PARAMETERS)
    ends = _integrate(dynamics, xi, period)
    for torque, h, end in zip(period.torques, period.durations, ends, strict=True):
        L = np.zeros((len(nodes), *total.shape))
        for place, node in zip(L, nodes, strict=True):
            pose, rates = _within_hold(x, end, h, node)
            derivatives = dynamics.derivatives(pose, rates, torque, theta)
            place[:NUM_STATE, :NUM_STATE], place[:NUM_STATE, THETA] = derivatives.A, derivatives.G
        omega = h * L.mean(axis=0)
        if len(nodes) == 2:
            omega += np.sqrt(3) / 12 * h**2 * (L[1] @ L[0] - L[0] @ L[1])
        x, total = end, expm(omega) @ total
    return x, total


def _within_hold(start: Array, end: Array, h: float, s: float) -> tuple[Array, Array]:
    """Pose and rates (6,) when the share s of h seconds is over: the cubic through both states."""
    rise, v_0, v_1 = (end[POSE] - start[POSE]) / h, start[RATES], end[RATES]
    a, b = v_0 - rise, v_1 - rise
    left = 1 - s
    pose = left * start[POSE] + s * end[POSE] + h * s * left * (left * a - s * b)
    return pose, rise + left * (1 - 3 * s) * a + s * (3 * s - 2) * b


def _within_bounds(mean: Array, covariance: Array, settings: FilterSettings) -> Array:
    """The mean nearest to `mean`, as the covariance measures it, with each parameter in bounds.

    Fixing components at bounds moves all that is correlated with them along their columns of P, so
    that what the measurements have told about combinations of parameters is kept. Which ones are
    fixed is found by adding the one furthest out and freeing those that are held back from inside.
    The covariance stays: a parameter at its bound may leave it again.
    """
    fixed: dict[int, float] = {}
    moved = mean
    for _ in range(4 * NUM_PARAMETERS):
        within = np.clip(moved[THETA], settings.lower, settings.upper)
        excess = (moved[THETA] - within) / np.sqrt(np.diag(covariance)[THETA])
        worst = int(np.argmax(np.abs(excess)))
        if np.abs(excess[worst]) <= 1e-9:
            break
        fixed[NUM_STATE + worst] = within[worst]
        while True:
            at = list(fixed)
            push = np.linalg.solve(covariance[np.ix_(at, at)], mean[at] - list(fixed.values()))
            upper = np.array([fixed[i] == settings.upper[i - NUM_STATE] for i in at])
            inwards = np.where(upper, push, -push)
            if inwards.min() >= 0:
                break
            del fixed[at[int(inwards.argmin())]]
        moved = mean - covariance[:, at] @ push
    moved = moved.copy()
    moved[THETA] = np.clip(moved[THETA], settings.lower, settings.upper)
    return moved
