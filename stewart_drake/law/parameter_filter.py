"""Extended Kalman filter over the state and constant parameters of the plant.

The parameters theta (torque bias, payload, joint damping; `law.filter_settings.ParameterSet`)
never change, the state obeys the exact dynamics under the torques that are known to act:

    [x_{k+1}; theta] = [f(x_k, T, theta); theta] + noise,    y_k = h(x_k) + measurement noise.

Linearised, F = [[Phi, S], [0, 1]] with Phi = df/dx and S = df/dtheta. One-step prediction errors
drive the filter: y_k corrects x_{k-1} and theta, and x_k follows by the model. The error of one
step of the model counts as noise of y_k there, and widens the covariance of x_k. h is that of the
`sensing.Sensing`.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag, expm
from scipy.special import chdtri

from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.law.belief import THETA, Estimate
from stewart_drake.law.filter_settings import FilterSettings, ParameterSet
from stewart_drake.law.holds import GAUSS_NODES, cubic
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.sensing import FirstState, Sensing
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.types import Array

OUTLIER = 1e-6
"""Share of the measurements, were all as the filter believes, that are taken for outliers."""
ITERATIONS = 4
"""At the most; one does once the parameters are roughly known."""
MIDPOINT = np.array([0.5])
SMALL = 0.1
"""A correction so many standard deviations long needs no second look."""
KNOWN = 0.01
"""A parameter is known when its standard deviation is this share of the prior's."""
LEARNT = 0.3
"""As KNOWN, for parameters good enough to go on with over a few periods without measurements."""
PATIENCE = 3
"""After so many outliers in a row that bear each other out the plate must be where they say."""


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


@cache
def gate(size: int) -> float:
    """Squared innovation of so many values, in units of its covariance, that makes an outlier."""
    return float(chdtri(size, OUTLIER))


@dataclass(frozen=True)
class ParameterFilter:
    """The filter for one plant and sensor.

    Attributes:
        dynamics: of the plant.
        sensing: what is measured of it.
        settings: what else is assumed.
    """

    dynamics: StewartDynamics
    sensing: Sensing
    settings: FilterSettings

    def start(
        self, measurement: Measurement, parameters: Array, near: Array | None = None
    ) -> Estimate | None:
        """The estimate from one measurement alone, or None where it tells of no state.

        Args:
            measurement: without a fault.
            parameters: (p,) for a guess.
            near: (12,) as of `Sensing.start`.
        """
        first = self.sensing.start(measurement, near)
        return None if first is None else self._from(first, parameters)

    def advance(
        self, estimate: Estimate, period: Period, measurement: Measurement | None
    ) -> Estimate:
        """One period, then a measurement at its end, or none.

        The first steps move the parameters far: linearising once is not enough. The mean xi of
        [previous state; parameters] is found by Gauss-Newton iterations of

            min (xi - mean)' P^-1 (xi - mean) + (y - h(f(xi)))' R^-1 (y - h(f(xi))),

        the iterated filter over one transition; one iteration is the extended Kalman filter. A
        measurement that does not fit (an outlier, iterations that diverge) is left out and the
        model goes on alone. The plate may have been moved by hand, though: outliers that follow
        from one another as the model has it tell of a plate, not of a broken sensor, and after
        PATIENCE of them, or where the model cannot go on, the measurement is believed. So is the
        first one that fits after PATIENCE or more periods without any, if little of the parameters
        was known by then: linearised along a way that is only guessed, the covariance is worth
        nothing.
        """
        if measurement is None:
            alone = self._attempt(estimate, period, None)
            return replace(estimate if alone is None else alone, unseen=estimate.unseen + 1)
        y = measurement.values
        after = self._attempt(estimate, period, y)
        if after is not None:
            lost = estimate.unseen >= PATIENCE and not self._known(estimate, LEARNT)
            anew = self.start(measurement, estimate.parameters, after.state) if lost else None
            return after if anew is None else anew
        alone = self._attempt(estimate, period, None)
        outliers = 1
        if estimate.outliers > 0:
            said = Measurement.of(estimate.outlier)
            before = self.start(said, estimate.parameters, estimate.state)
            if before is not None and self._attempt(before, period, y) is not None:
                outliers += estimate.outliers
        if alone is None or outliers >= PATIENCE:
            near = estimate.state if alone is None else alone.state
            anew = self.start(measurement, estimate.parameters, near)
            if anew is not None:
                return anew
        alone = estimate if alone is None else alone
        return replace(alone, outliers=outliers, outlier=y, unseen=estimate.unseen + 1)

    def _from(self, first: FirstState, parameters: Array) -> Estimate:
        mean = np.concatenate([first.state, parameters])
        covariance = block_diag(first.covariance, self.settings.parameters.covariance)
        return Estimate(mean, covariance, self._no_outlier())

    def _no_outlier(self) -> Array:
        return np.full(self.sensing.size, np.nan)

    def _known(self, estimate: Estimate, share: float = KNOWN) -> bool:
        return bool(np.all(estimate.parameter_std <= share * self.settings.parameters.usual_std))

    def _attempt(self, estimate: Estimate, period: Period, y: Array | None) -> Estimate | None:
        """`advance` for values (m,) that fit; None for an outlier, or without a finite result."""
        try:
            with np.errstate(all="ignore"):
                after = self._filter(estimate, period, y)
        except (np.linalg.LinAlgError, ArithmeticError):
            return None
        if after is None or not np.all(np.isfinite(after.covariance)):
            return None
        return after if np.all(np.isfinite(after.mean)) else None

    def _filter(self, estimate: Estimate, period: Period, y: Array | None) -> Estimate | None:
        dynamics, sensing, settings = self.dynamics, self.sensing, self.settings
        prior, P = estimate.mean, estimate.covariance
        xi = prior
        # Corrections of parameters that are known already are too small to need F to fourth order.
        nodes = MIDPOINT if self._known(estimate) else GAUSS_NODES
        after, F = transition(dynamics, xi, period, nodes)
        early = kicks(dynamics, after, xi[THETA], period)
        drift = np.diag(settings.model_std**2 + settings.timing_std**2 * np.sum(early**2, axis=0))
        if y is not None:
            R = np.diag(sensing.noise_std**2)
            R = R + sensing.through(after, sensing.through(after, drift).T)
            small = SMALL * np.sqrt(np.diag(R))
            for _ in range(ITERATIONS):
                H = sensing.through(after, F[:NUM_STATE])
                innovation = y - sensing.seen(after) - H @ (prior - xi)
                S = H @ P @ H.T + R
                gain = np.linalg.solve(S, H @ P).T
                keep = np.eye(len(xi)) - gain @ H
                posterior = keep @ P @ keep.T + gain @ R @ gain.T  # Joseph's form stays positive
                moved = within_bounds(prior + gain @ innovation, posterior, settings.parameters)
                shift, xi = F[:NUM_STATE] @ (moved - xi), moved
                linear = after + shift
                # What linearising leaves out is of second order: nothing beside a small correction.
                if np.all(np.abs(sensing.through(after, shift)) <= small):
                    after = linear
                    break
                after = integrate(dynamics, xi, period)[-1]
                if np.all(np.abs(sensing.through(after, after - linear)) <= small):
                    break
                after, F = transition(dynamics, xi, period, nodes)
            if not innovation @ np.linalg.solve(S, innovation) <= gate(len(y)):  # or NaN
                return None
            P = posterior
        P = F @ P @ F.T
        P[:NUM_STATE, :NUM_STATE] += drift
        return Estimate(np.concatenate([after, xi[THETA]]), (P + P.T) / 2, self._no_outlier())


def kicks(dynamics: StewartDynamics, state: Array, theta: Array, period: Period) -> Array:
    """(n, 12) change of the last state per s by which one of the n changes of torque comes early.

    To first order: for that time the acceleration differs by B dT, which stays in the rates, and
    moves the pose for what is left of the period.
    """
    pose, rates = state[POSE], state[RATES]
    torques = (*period.torques, period.following)
    changes = np.diff([dynamics.accelerations(pose, rates, T, theta) for T in torques], axis=0)
    left = period.durations.sum() - np.cumsum(period.durations)
    return np.hstack([left[:, None] * changes, changes])


def integrate(dynamics: StewartDynamics, xi: Array, period: Period) -> Array:
    """States (n, 12) after each of n torques, from [state; parameters] (12 + p,)."""
    torques, durations, substeps = period.torques, period.durations, period.substeps
    return dynamics.predict(xi[:NUM_STATE], torques, durations, substeps, xi[THETA])


def transition(
    dynamics: StewartDynamics, xi: Array, period: Period, nodes: Array = GAUSS_NODES
) -> tuple[Array, Array]:
    """State (12,) after the torques, and F (12 + p, 12 + p) of [state; parameters].

    F = exp(Omega) solves F_dot = [[A, G], [0, 0]] F to fourth order with A and G at the two Gauss
    nodes: Omega = h/2 (L_1 + L_2) + sqrt(3)/12 h^2 [L_2, L_1] (Magnus); MIDPOINT is of second. The
    filter divides tiny innovations by F: such an error would already look like a disturbance.
    """
    states, F = transitions(dynamics, xi, period, nodes)
    return states[-1], F[-1]


def transitions(
    dynamics: StewartDynamics, xi: Array, period: Period, nodes: Array = GAUSS_NODES
) -> tuple[Array, Array]:
    """`transition` after each of the n torques: states (n, 12), F (n, 12 + p, 12 + p)."""
    x, theta = xi[:NUM_STATE], xi[THETA]
    total, totals = np.eye(len(xi)), []
    ends = integrate(dynamics, xi, period)
    for torque, h, end in zip(period.torques, period.durations, ends, strict=True):
        L = np.zeros((len(nodes), *total.shape))
        for place, node in zip(L, nodes, strict=True):
            pose, rates = cubic(x, end, h, node)
            derivatives = dynamics.derivatives(pose, rates, torque, theta)
            place[:NUM_STATE, :NUM_STATE], place[:NUM_STATE, THETA] = derivatives.A, derivatives.G
        omega = h * L.mean(axis=0)
        if len(nodes) == 2:
            omega += np.sqrt(3) / 12 * h**2 * (L[1] @ L[0] - L[0] @ L[1])
        x, total = end, expm(omega) @ total
        totals.append(total)
    return ends, np.array(totals)


def within_bounds(mean: Array, covariance: Array, parameters: ParameterSet) -> Array:
    """The mean nearest to `mean`, as the covariance measures it, with each parameter in bounds.

    Raises:
        LinAlgError: the covariance is not positive, or numbers are not finite.
    """
    c, n = core(), len(mean)
    free = np.full(NUM_STATE, np.inf)
    lower = np.concatenate([-free, parameters.lower])
    upper = np.concatenate([free, parameters.upper])
    mean, root, moved = np.array(mean), np.array(covariance), np.empty(n)
    scratch = c.scratch(n + c.lib.STEWART_MAX_BOUNDED**2)
    given = (c.at(mean), c.at(root), c.at(lower), c.at(upper), c.at(moved))
    if not (c.lib.stewart_root(n, c.at(root)) and c.lib.stewart_within_bounds(n, *given, scratch)):
        raise np.linalg.LinAlgError("the covariance is not positive definite")
    return moved
