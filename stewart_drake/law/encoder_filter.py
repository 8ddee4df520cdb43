"""The filter of `law.parameter_filter` for encoders: legs at several instants of a period.

xi = [x_{k-1}; theta] is corrected by the residuals e_j (`law.encoder_sensing`) at the M nodes s_j
of the period. With F_j from xi to the state there and J = dh/dq,

    H_j = J(q_j) F_j[pose],   R_j = diag(var_j) + diag(s_j^2 J Q J'),

Q the drift of the pose over a period, which counts as noise here as it does there. With P = L L',

    A = sum H_j' R_j^-1 H_j,   b = sum H_j' R_j^-1 (e_j + H_j (xi - mean)),
    C = 1 + L' A L = W W',   xi <- mean + L C^-1 L' b,   P+ = (W^-1 L')' (W^-1 L'),

which is positive whatever rounding does: exact encoders are 1e7 times as certain as a payload. Each
leg is judged by itself at each node: one with e^2 > GATE S, S = H P H' + R, is left out, and the
step goes on with the rest; if that is less than half, the measurement is an outlier.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.law.belief import THETA, Estimate
from stewart_drake.law.encoder_sensing import EncoderSensing, Reading
from stewart_drake.law.holds import GAUSS_NODES
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.parameter_filter import (
    MIDPOINT,
    SMALL,
    ParameterFilter,
    Period,
    integrate,
    kicks,
    transitions,
    within_bounds,
)
from stewart_drake.scenario.calibration import OFFSETS
from stewart_drake.scenario.signals import NUM_LEGS, NUM_STATE, POSE
from stewart_drake.types import Array

GATE = 30.0
"""Squared residual of a leg, in units of its variance, from which it is left out."""
ITERATIONS = 6
"""At the most."""
TINY = 1e-14
"""Share of its diagonal by which a covariance is kept away from being singular."""


class Legs(NamedTuple):
    """What the legs say beside a motion: one equation per leg and node."""

    residual: Array
    """(6 M,) e, rad."""
    H: Array
    """(6 M, 12 + p)."""
    R: Array
    """(6 M,) variances, infinite where there is nothing."""


@dataclass(frozen=True)
class EncoderFilter(ParameterFilter):
    """The filter for one plant with encoders.

    Attributes:
        last: (6 N,) the measurement before, NaN for nothing.
        still: (6,) as of `Sensing.stood`.
    """

    last: Array
    still: Array

    @cached_property
    def offsets(self) -> slice:
        """Of xi, the offsets of the encoders, if they are estimated."""
        names = self.settings.parameters.names
        first = NUM_STATE + (names.index(OFFSETS[0]) if OFFSETS[0] in names else len(names))
        return slice(first, first + len(OFFSETS))

    def start(
        self, measurement: Measurement, parameters: Array, near: Array | None = None
    ) -> Estimate | None:
        """See `ParameterFilter.start`; a pose is as uncertain as the offsets make it.

        To first order dq = J^-1 (dy - do).
        """
        mean = np.concatenate([np.zeros(NUM_STATE), parameters])
        offset = mean[self.offsets]
        if len(offset) == 0:
            return super().start(measurement, parameters, near)
        values = measurement.values - np.tile(offset, self.encoders.samples)
        first = super().start(replace(measurement, values=values), parameters, near)
        if first is None:
            return None
        P = first.covariance.copy()
        back = -np.linalg.inv(self.dynamics.actuation_map(first.state[POSE]).T)
        P[POSE, self.offsets] = back @ P[self.offsets, self.offsets]
        P[self.offsets, POSE] = P[POSE, self.offsets].T
        P[POSE, POSE] += back @ P[self.offsets, self.offsets] @ back.T
        return replace(first, covariance=P)

    @property
    def encoders(self) -> EncoderSensing:
        """The sensing."""
        assert isinstance(self.sensing, EncoderSensing)
        return self.sensing

    def _filter(self, estimate: Estimate, period: Period, y: Array | None) -> Estimate | None:
        dynamics, settings, prior = self.dynamics, self.settings, estimate.mean
        xi, P = prior, estimate.covariance
        at = self._along(xi, period)
        early = kicks(dynamics, at.end, xi[THETA], period)
        drift = settings.model_std**2 + settings.timing_std**2 * np.sum(early**2, axis=0)
        partly: tuple[str, ...] = ()
        if y is not None:
            said = Measurement.of(y)
            reading = self.encoders.reading(said, at.shown, self.last, self.still)
            L = _root(P)
            kept: NDArray[np.bool_] | None = None
            for _ in range(ITERATIONS):
                legs = self._legs(reading, at, drift)
                HL, wanted = legs.H @ L, legs.residual + legs.H @ (xi - prior)
                if kept is None:
                    there = np.isfinite(legs.R)
                    S = np.sum(HL**2, axis=1) + legs.R
                    kept = there & (wanted**2 <= GATE * S)
                    if not 2 * kept.sum() > there.sum():
                        return None
                    partly = self._left_out(said, reading, there & ~kept)
                R = np.where(kept, legs.R, np.inf)
                W = np.linalg.cholesky(np.eye(len(P)) + (HL / R[:, None]).T @ HL)
                root = np.linalg.solve(W, L.T)
                P = root.T @ root
                b = HL.T @ (np.where(kept, wanted, 0.0) / R)
                mean = prior + root.T @ np.linalg.solve(W, b)
                moved = within_bounds(mean, P, settings.parameters)
                shift, xi = legs.H @ (moved - xi), moved
                if np.all(np.abs(shift[kept]) <= SMALL * np.sqrt(R[kept])):
                    break
                at = self._along(xi, period)
            end = integrate(dynamics, xi, period)[-1]
        else:
            end = at.end
        P = at.F[-1] @ P @ at.F[-1].T
        P[:NUM_STATE, :NUM_STATE] += np.diag(drift)
        mean = np.concatenate([end, xi[THETA]])
        return Estimate(mean, (P + P.T) / 2, self._no_outlier(), partly=partly)

    def _along(self, xi: Array, period: Period) -> "Along":
        """The motion from xi on."""
        encoders, T = self.encoders, float(period.durations.sum())
        coarse, places = cut(period, T * encoders.shares)
        fine, samples = cut(period, T * encoders.instants)
        nodes = GAUSS_NODES if len(coarse.torques) <= 2 else MIDPOINT
        states, F = transitions(self.dynamics, xi, coarse, nodes)
        poses = integrate(self.dynamics, xi, fine)[samples][:, POSE]
        shown = encoders.angles(poses)
        if len(xi[self.offsets]):
            shown = shown + xi[self.offsets]
        return Along(states, F, places, shown)

    def _legs(self, reading: Reading, at: "Along", drift: Array) -> Legs:
        H, spread = [], []
        for share, place in zip(self.encoders.shares, at.places, strict=True):
            J = self.dynamics.actuation_map(at.states[place, POSE]).T
            row = J @ at.F[place, POSE]
            row[:, self.offsets] += np.eye(NUM_LEGS)[:, : row[:, self.offsets].shape[1]]
            H.append(row)
            spread.append(share**2 * J**2 @ drift[POSE])
        R = reading.variance + np.array(spread)
        return Legs(reading.beside(at.shown).ravel(), np.concatenate(H), R.ravel())

    def _left_out(
        self, said: Measurement, reading: Reading, gated: NDArray[np.bool_]
    ) -> tuple[str, ...]:
        """Causes for which legs were left out in part or wholly."""
        legs = gated.reshape(-1, NUM_LEGS).any(axis=0)
        stuck = legs & (self.still > 0) & ~reading.odd
        causes = {
            "measurements_missing": not said.complete,
            "measurements_frozen": bool(np.any(stuck)),
            "measurements_rejected": bool(np.any(reading.odd | (legs & ~stuck))),
        }
        return tuple(cause for cause, there in causes.items() if there)


class Along(NamedTuple):
    """A motion over a period."""

    states: Array
    """(n, 12) where its torque changes and at the nodes; at its end last."""
    F: Array
    """(n, 12 + p, 12 + p) from xi to there."""
    places: NDArray[np.int_]
    """(M,) which of them are at the nodes."""
    shown: Array
    """(N, 6) angles at the samples."""

    @property
    def end(self) -> Array:
        """(12,) state."""
        return np.asarray(self.states[-1])


def cut(period: Period, instants: Array) -> tuple[Period, NDArray[np.int_]]:
    """The same period cut at instants (s,) in s too, and which piece ends at each of them."""
    bounds = np.cumsum(period.durations)
    apart = 1e-9 * bounds[-1]
    ends = np.sort(np.concatenate([bounds, instants]))
    ends = ends[np.append(np.diff(ends) > apart, True)]
    starts = np.concatenate([[0.0], ends[:-1]])
    acting = np.minimum(np.searchsorted(bounds, starts + apart, "right"), len(bounds) - 1)
    pieces = np.diff(ends, prepend=0.0)
    substeps = int(np.ceil(period.substeps * pieces.max() / period.durations.max() - 1e-9))
    cut_up = period._replace(torques=period.torques[acting], durations=pieces, substeps=substeps)
    return cut_up, np.searchsorted(ends, instants - apart)


def _root(P: Array) -> Array:
    """L with L L' = P."""
    return np.asarray(np.linalg.cholesky(P + np.diag(TINY * np.diag(P))))
