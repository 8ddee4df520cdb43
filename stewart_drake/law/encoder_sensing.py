"""Motor encoders, y = h(q) + o: what six crank angles, sampled N times a period, tell of a motion.

Between two controller samples the legs are read N times. All of them against the model would be
6 N equations per sample; three per leg do as well. With r_n = y_n - h(q^(t_n)) the residuals of the
N samples beside a predicted motion, which the model makes small and smooth, a parabola holds what
they say. It is told by its values at the M = 3 Gauss nodes of the N samples,

    e_j = sum_n G_jn r_n,   G = V(s) V(t)^+,   V of Legendre polynomials of degrees 0 to M - 1,

s_j the roots of the polynomial of degree M that is orthogonal on the samples: eigenvalues of the
Jacobi matrix of its recurrence (Golub and Welsch). At these nodes, and no others, the M values of
white noise of variance sigma^2 are independent, of variance sigma^2 / (N w_j), w_j their Gauss
weights. Angles themselves must not be projected: a parabola through them is no motion of the plate.

Rounding to codes of width q is no white noise. Its variance is q^2 / 12, but a leg that does not
reach the next code says the same however often it is asked: what N samples are worth is the number
of code changes among them; without one, after c periods without any, 1 / (1 + c)^2 of a sample.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from stewart_drake.law.measurement import Measurement
from stewart_drake.law.sensing import FirstState, Sensing
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import (
    ForwardKinematicsError,
    SingularPoseError,
    crank_angles_along,
)
from stewart_drake.scenario.signals import NUM_LEGS, POSE, RATES
from stewart_drake.types import Array

NODES = 3
"""Of a period, at the most."""
FINEST = 1e-7
"""rad; to so much the crank angles of the model itself are right, its standard deviation."""
ENOUGH = 0.3
"""Share of a leg's samples that are needed for it to count."""
STANDS_OUT = 8.0
"""Median absolute deviations from the median by which a residual is not of its period (Hampel)."""
CURVED = 3.0
"""The same in spans from the 10th to the 90th percentile, where residuals are no noise alone."""
LAST_FEW = 9
"""Samples that the angle at the last of them is told from."""


class Projection(NamedTuple):
    """Of the samples of a period on its nodes."""

    shares: Array
    """(M,) of the period, where the nodes are."""
    G: Array
    """(M, N)."""


@cache
def projection(samples: int) -> Projection:
    """For N samples at 1/N, 2/N, ..., 1 of a period, onto at most NODES nodes."""
    number = min(NODES, samples)
    t = 2 * np.arange(1, samples + 1) / samples - 1
    if samples <= number:
        return Projection((t + 1) / 2, np.eye(samples))
    # Stieltjes: p_{k+1} = (t - a_k) p_k - b_k p_{k-1}, orthogonal on the samples.
    a, b = np.empty(number), np.empty(number)
    before, p, norm = np.zeros(samples), np.ones(samples), 1.0
    for k in range(number):
        square = float(np.mean(p * p))
        a[k], b[k], norm = float(np.mean(t * p * p)) / square, square / norm, square
        before, p = p, (t - a[k]) * p - (b[k] if k else 0.0) * before
    off = np.sqrt(b[1:])
    nodes = np.linalg.eigvalsh(np.diag(a) + np.diag(off, 1) + np.diag(off, -1))
    return Projection((nodes + 1) / 2, onto(nodes, t))


def onto(nodes: Array, t: Array) -> Array:
    """G (M, N) from residuals at t (N,) to values at nodes (M,), both in [-1, 1]."""
    degree = len(nodes) - 1
    return legendre.legvander(nodes, degree) @ np.linalg.pinv(legendre.legvander(t, degree))


class Reading(NamedTuple):
    """What a measurement says, and for how much that counts, beside a motion of its period."""

    angles: Array
    """(N, 6) rad, 0 where they are left out."""
    used: NDArray[np.bool_]
    """(N, 6) those that are not."""
    G: Array
    """(6, M, N) of each leg."""
    variance: Array
    """(M, 6) rad^2 of the values at the nodes, infinite where a leg is left out."""
    odd: NDArray[np.bool_]
    """(6,) legs of which samples stand out of their period."""

    def beside(self, shown: Array) -> Array:
        """e (M, 6), the values at the nodes of measured minus shown angles (N, 6)."""
        residuals = np.where(self.used, self.angles - shown, 0.0)
        return np.asarray(np.einsum("lmn,nl->ml", self.G, residuals))


@dataclass(frozen=True)
class EncoderSensing:
    """Crank angles; without an observer that knows of periods, those of the last sample.

    Attributes:
        mechanism: as the controller knows it.
        samples: N per period, the last of them at the controller's sample.
        quantum: q, rad; 0 for exact encoders.
        declared: (12,) pose and rates that the machine is said to begin in: which of the assemblies
            with the measured angles it is.
        rates_std: (6,) rad/s and m/s, of those rates, and of those of any new start.
        motion: (6,) how far each coordinate is expected to move, rad and m.
        offset: (6,) o, rad, as far as it is known beforehand.
    """

    mechanism: Mechanism
    samples: int
    quantum: float
    declared: Array
    rates_std: Array
    motion: Array
    offset: Array

    @property
    def size(self) -> int:
        """6 N; sample by sample, the oldest first."""
        return NUM_LEGS * self.samples

    @property
    def std(self) -> float:
        """rad, of one sample."""
        return max(self.quantum / np.sqrt(12), FINEST)

    @property
    def noise_std(self) -> Array:
        """(6 N,) rad."""
        return np.full(self.size, self.std)

    @cached_property
    def shares(self) -> Array:
        """(M,) of the period, the nodes at which a motion is compared."""
        return projection(self.samples).shares

    @cached_property
    def instants(self) -> Array:
        """(N,) of the period, at which legs are read."""
        return np.arange(1, self.samples + 1) / self.samples

    def angles(self, poses: Array) -> Array:
        """h(q) (n, 6) of poses (n, 6); NaN out of reach."""
        return crank_angles_along(self.mechanism, poses)

    def jacobian(self, pose: Array) -> Array:
        """dh/dq (6, 6); NaN out of reach or at a dead centre."""
        if not np.all(self.mechanism.reach_margins(pose) >= 0):  # or NaN
            return np.full((NUM_LEGS, NUM_LEGS), np.nan)
        try:
            return self.mechanism.jacobian(pose)
        except SingularPoseError:
            return np.full((NUM_LEGS, NUM_LEGS), np.nan)

    def seen(self, state: Array) -> Array:
        """What all samples show of a plate that stands still there."""
        return np.tile(self.angles(state[None, POSE])[0] + self.offset, self.samples)

    def through(self, state: Array, changes: Array) -> Array:
        """See `Sensing.through`."""
        one = self.jacobian(state[POSE]) @ changes[POSE]
        return np.tile(one, (self.samples, *[1] * (one.ndim - 1)))

    def fault(
        self, measurement: Measurement, last: Array, period: float, mechanism: Mechanism
    ) -> str | None:
        """See `Sensing.fault`: a measurement is of use as long as one leg is."""
        there = self._by_sample(measurement.valid)
        enough = there.sum(axis=0) >= max(len(self.shares), ENOUGH * self.samples)
        return None if np.any(enough) else "measurements_missing"

    def stood(self, measurement: Measurement, last: Array, still: Array) -> Array:
        """See `Sensing.stood`: periods, of each leg, without a change of code."""
        still = still if len(still) else np.zeros(NUM_LEGS)
        changes = self._changes(*self._both(measurement), last)
        silent = ~self._by_sample(measurement.valid).any(axis=0)
        return np.where(silent, still, np.where(changes > 0, 0.0, still + 1))

    def now(self, measurement: Measurement) -> tuple[Sensing, Measurement]:
        """See `Sensing.now`."""
        if self.samples == 1:
            return self, measurement
        values, valid = (part[-1] for part in self._both(measurement))
        return replace(self, samples=1), Measurement(values, valid, measurement.age)

    def start(self, measurement: Measurement, near: Array | None = None) -> FirstState | None:
        """Pose by forward kinematics, rates as they are expected.

        To first order the pose is as uncertain as the angles, P = J^-1 R J^-T. A leg that is silent
        is taken to be where it is expected, to within the motion.
        """
        expected = self.declared if near is None or not np.all(np.isfinite(near)) else near
        last, known = self._last(*self._both(measurement))
        angles = np.where(known, last - self.offset, self.angles(expected[None, POSE])[0])
        try:
            pose = self.mechanism.forward_kinematics(angles, expected[POSE])
            J = self.mechanism.jacobian(pose)
            inverse = np.linalg.inv(J)
        except (ForwardKinematicsError, SingularPoseError, np.linalg.LinAlgError):
            return None
        roughly = np.abs(J) @ self.motion
        P = np.diag(np.concatenate([np.zeros(6), self.rates_std**2]))
        P[POSE, POSE] = inverse * np.where(known, self.std, roughly) ** 2 @ inverse.T
        return FirstState(np.concatenate([pose, expected[RATES]]), P)

    def reading(self, measurement: Measurement, shown: Array, last: Array, still: Array) -> Reading:
        """What a measurement says beside a motion, of which it cannot be told what is noise.

        Args:
            measurement: of 6 N values.
            shown: (N, 6) angles that the motion shows at the samples.
            last: (6 N,) the measurement before, NaN for nothing.
            still: (6,) as of `stood`, with this measurement.
        """
        values, used = self._both(measurement)
        values, odd = np.where(used, values, 0.0), np.zeros(NUM_LEGS, dtype=bool)
        if self.samples > NODES:
            regular = self._regular(np.where(used, values - self.offset - shown, np.nan))
            odd = np.any(used & ~regular, axis=0)
            used = used & regular
        number = used.sum(axis=0)
        enough = number >= max(len(self.shares), ENOUGH * self.samples)
        G = np.stack([self._projection(used[:, leg], enough[leg]) for leg in range(NUM_LEGS)])
        worth = self._worth(number, self._changes(values, used, last), still)
        variance = self.std**2 * np.sum(G**2, axis=2).T / worth
        variance[:, ~enough] = np.inf
        return Reading(np.where(used, values - self.offset, 0.0), used, G, variance, odd)

    def _worth(self, number: NDArray[Any], changes: NDArray[Any], still: Array) -> Array:
        """(6,) by which variances are divided: independent samples over samples."""
        if self.quantum == 0:
            return np.ones(NUM_LEGS)
        independent = np.where(changes > 0, np.minimum(number, changes), 1 / (1 + still) ** 2)
        return np.minimum(independent / np.maximum(number, 1), 1.0)

    def _projection(self, used: NDArray[np.bool_], enough: bool) -> Array:
        shares, G = projection(self.samples)
        if np.all(used):
            return G
        some = np.zeros_like(G)
        if enough:
            some[:, used] = onto(2 * shares - 1, 2 * self.instants[used] - 1)
        return some

    def _regular(self, residuals: Array) -> NDArray[np.bool_]:
        """(N, 6) those that are of their period (N, 6), NaN where there are none (Hampel)."""
        regular = np.zeros(residuals.shape, dtype=bool)
        for leg, r in enumerate(residuals.T):
            there = np.isfinite(r)
            if not np.any(there):
                continue
            away = np.abs(r - np.median(r[there]))
            within = away[there]
            spread = np.ptp(np.percentile(r[there], [10, 90]))
            bound = max(
                STANDS_OUT * float(np.median(within)),
                CURVED * float(spread),
                CURVED * max(self.quantum, CURVED * FINEST),
            )
            regular[there, leg] = within <= bound
        return regular

    def _changes(self, values: Array, used: NDArray[np.bool_], last: Array) -> NDArray[Any]:
        """(6,) how often the codes of each leg changed, the last of the period before first."""
        found = np.zeros(NUM_LEGS, dtype=int)
        before = self._by_sample(last)[-1]
        for leg in range(NUM_LEGS):
            codes = values[used[:, leg], leg]
            codes = np.append(before[leg], codes) if np.isfinite(before[leg]) else codes
            found[leg] = np.count_nonzero(np.diff(codes))
        return found

    def _last(self, values: Array, valid: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        """Angles (6,) at the last sample, and which are known, from the last few of each leg.

        With more than NODES of them by the line through them whose slope and height are medians
        (Theil and Sen): a few that are wrong do no harm.
        """
        t, angles = self.instants - 1.0, np.full(NUM_LEGS, np.nan)
        for leg in range(NUM_LEGS):
            some = np.flatnonzero(valid[:, leg])[-LAST_FEW:]
            if len(some) > NODES:
                y, at = values[some, leg], t[some]
                first, second = np.triu_indices(len(some), 1)
                slope = np.median((y[second] - y[first]) / (at[second] - at[first]))
                angles[leg] = np.median(y - slope * at)
            elif len(some) and some[-1] == self.samples - 1:
                angles[leg] = values[-1, leg]
        return angles, np.isfinite(angles)

    def _both(self, measurement: Measurement) -> tuple[Array, NDArray[np.bool_]]:
        """Values and whether they are there, (N, 6)."""
        return self._by_sample(measurement.values), self._by_sample(measurement.valid)

    def _by_sample(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(self.samples, NUM_LEGS)
