"""The filter over state, parameters and the delay: xi = [x; theta; eta; eta_dot].

As `law.parameter_filter`, with two parameters more. eta is the delay of what arrives now:

    eta_{k+1} = eta_k + dt eta_dot_k + noise,   eta_dot_{k+1} = eta_dot_k + noise,

and what acts between two samples follows from it (`law.arrivals`). A torque that arrives tau later
moves the plate by minus its kick, so dx/deta is minus the sum of the kicks; here it is a central
difference of the whole prediction over DIFFERENCE, which also has what happens after the kick. With
a torque change at a sample itself it is the mean of both sides. An arrival at a within the period
moves by a eta_dot with the rate: to first order dx/deta_dot = dt/2 dx/deta.

The likelihood of a measurement, -1/2 (nu' S^-1 nu + ln |S|) with innovation nu and covariance S,
is kept: the delay is found by comparing filters (`law.delay_observer`).
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import ndtr

from stewart_drake.law.arrivals import Arrivals
from stewart_drake.law.belief import Estimate
from stewart_drake.law.filter_settings import FilterSettings, ParameterSet
from stewart_drake.law.holds import GAUSS_NODES
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.parameter_filter import (
    KNOWN,
    MIDPOINT,
    SMALL,
    Period,
    gate,
    transition,
    within_bounds,
)
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Acting
from stewart_drake.scenario.signals import NUM_STATE, POSE, RATES
from stewart_drake.types import Array

INSTANT = 1e-9
"""s; arrivals closer than this are one."""
DIFFERENCE = 1e-3
"""s."""
FEW = 4
"""Iterations once the delay is known."""
ITERATIONS = 6
"""At the most, while the delay is hardly known; later a few do."""
TRIED = 15
"""Values of the delay that are tried where a filter is to begin with its iterations."""
MEMORY = 5.0
"""s over which the timing of single torques is judged."""
TORQUES = 1.0
"""So many torques are taken to have come early or late by `FilterSettings.timing_std`, what the
filter of a known delay allows for, before any was looked at. Were they taken to have been on time,
the first late ones would be outliers, and the next ones payload and bias."""
UNTIMELY = 0.05
"""Periods by which a single torque may come early or late at the most."""
JERKED = 0.02
"""Periods by which the delay itself may have changed where it did."""
EDGE = 0.1
"""Periods before and after one from which torques may come into it."""
BEFORE = 1 / 120
"""Squared periods; variance of the timing of what was in flight at t = 0, see `DelayModel.late`."""
ASIDE = 0.01
"""Share of the variance that a torque at another time has in every other direction too."""
LARGEST_RATE = 0.5
"""s/s."""
NEVER = 1e6
"""s; the delay of torques that do not arrive."""
UNLIKELY = -1e6
"""Log-likelihood of a measurement that cannot be explained."""


@dataclass(frozen=True)
class DelaySettings:
    """What is assumed of the delay.

    Attributes:
        std: s, of the prior about the delay that is believed in.
        longest: s.
        timing_std: s by which a single torque may come early or late, at the least.
        walk: s per root s, of the delay itself.
        rate_std: s/s, of its rate; 0 for none.
        rate_walk: s/s per root s.
    """

    std: float
    longest: float
    timing_std: float
    walk: float
    rate_std: float
    rate_walk: float


def delay_settings(
    kind: Literal["constant", "drifting"], std: float, longest: float
) -> DelaySettings:
    """For a delay that stays, or one whose rate is to be followed."""
    if kind == "constant":
        return DelaySettings(std, longest, 2e-4, 0.0, 0.0, 0.0)
    return DelaySettings(std, longest, 2e-4, 3e-4, 0.02, 5e-3)


@dataclass(frozen=True)
class Guess:
    """A hypothesis of the delay, with all that follows from it.

    Attributes:
        mean: (12 + p + 2,).
        covariance: of it; the rows of eta and its rate are 0 where nothing has arrived.
        low, high: s, between which eta is.
        log_likelihood: of the last measurement.
        fits: whether that was no outlier.
        outliers: in a row; with those that a torque at another time explains.
        timing: s^2, variance by which single torques come early or late, as it is estimated.
        weight: torques behind that.
        heard: measurements that an own torque had to do with.
    """

    mean: Array
    covariance: Array
    low: float
    high: float
    log_likelihood: float = 0.0
    fits: bool = True
    outliers: int = 0
    timing: float = 0.0
    weight: float = TORQUES
    heard: int = 0

    @property
    def eta(self) -> float:
        """s; NEVER where nothing is to arrive."""
        return float(self.mean[-2])

    @property
    def rate(self) -> float:
        """s/s."""
        return float(self.mean[-1])

    @property
    def std(self) -> float:
        """s, of eta."""
        return float(np.sqrt(max(self.covariance[-2, -2], 0.0)))

    def estimate(self, nothing: Array) -> Estimate:
        """State and parameters alone; `nothing` is (m,) of NaN."""
        return Estimate(self.mean[:-2], self.covariance[:-2, :-2], nothing, self.outliers)


@dataclass(frozen=True)
class DelayFilter:
    """The filter for one plant and sensor.

    Attributes:
        plant: as it is known.
        sensing: what is measured of it.
        settings: of state and parameters.
        delay: of the delay.
    """

    plant: NominalPlant
    sensing: Sensing
    settings: FilterSettings
    delay: DelaySettings

    def advance(
        self, guess: Guess, timeline: Arrivals, in_flight: Array, y: Array | None, newest: int = 0
    ) -> Guess:
        """One period, then a measurement (m,) at its end, or none.

        Args:
            guess: at the sample before.
            timeline: seen from there, whatever its delay.
            in_flight: (n, 6).
            y: what was measured now.
            newest: as of `Arrivals.within`.
        """
        model, period = DelayModel(self.plant, timeline, in_flight, newest), timeline.period
        if y is not None:
            after = self._attempt(model, guess, y)
            if after is None and self._precise(guess, period):
                most = (UNTIMELY * period) ** 2
                after = self._attempt(model, self._jerked(guess, period), y, most)
                if after is not None:  # explained, but one more of these may be a jump
                    after = replace(after, outliers=guess.outliers + 1)
            if after is not None:
                return after
        alone = self._attempt(model, guess, None)
        if alone is None:  # astray: it explains nothing any more
            alone = guess
        if y is None:
            return alone
        return replace(alone, fits=False, outliers=guess.outliers + 1, log_likelihood=UNLIKELY)

    def _attempt(
        self, model: "DelayModel", guess: Guess, y: Array | None, timing: float = 0.0
    ) -> Guess | None:
        """The guess afterwards, with a variance of the timing of at least so many s^2, or None."""
        try:
            with np.errstate(all="ignore"):
                after = self._filter(model, guess, y, max(timing, self._timing(guess)))
        except (np.linalg.LinAlgError, ArithmeticError):
            return None
        if after is None or not np.all(np.isfinite(after.covariance)):
            return None
        return after if np.all(np.isfinite(after.mean)) else None

    def _filter(
        self, model: "DelayModel", guess: Guess, y: Array | None, used: float
    ) -> Guess | None:
        P, xi = guess.covariance, guess.mean
        std = np.sqrt(np.diag(P)[NUM_STATE:-2])
        known = bool(np.all(std <= KNOWN * self.settings.parameters.usual_std))
        nodes, period = MIDPOINT if known else GAUSS_NODES, model.timeline.period
        at = model.at(xi, nodes)
        late = model.late(xi, at.state, np.sqrt(used))
        likelihood, odd = 0.0, guess.outliers
        timed = guess
        if y is not None:
            if guess.std > period / 10:
                xi = self._best_of_many(model, guess, y, at.F[:NUM_STATE, :-2])
                at = model.at(xi, nodes)
                late = model.late(xi, at.state, np.sqrt(used))
            found = self._correct(model, guess, y, (xi, at, late, used), nodes)
            if found is None:
                return None
            xi, at, P, likelihood = found.xi, found.at, found.covariance, found.log_likelihood
            timed, odd = replace(guess, heard=guess.heard + int(guess.eta < NEVER)), 0
            if self._precise(guess, period):
                timed, odd = self._timed(timed, found, used, period)
        mean = np.concatenate([at.state, xi[NUM_STATE:]])
        mean[-2] += period * xi[-1]
        P = at.F @ P @ at.F.T
        P[:NUM_STATE, :NUM_STATE] += self._drift(late, used)
        if timed.heard:
            less_sure = max(0.0, self._timing(timed) - self._timing(guess)) / timed.heard
            P[-2, -2] += less_sure
        if guess.eta < NEVER:
            P[-2, -2] += self.delay.walk**2 * period
            P[-1, -1] += self.delay.rate_walk**2 * period
        return replace(
            timed,
            mean=mean,
            covariance=(P + P.T) / 2,
            log_likelihood=likelihood,
            fits=True,
            outliers=odd,
        )

    def _timing(self, guess: Guess) -> float:
        """s^2, variance by which single torques come early or late."""
        return max(guess.timing, self.delay.timing_std**2)

    def _drift(self, late: "Late", timing: float) -> Array:
        """(12, 12) covariance of what the model itself may be off after the period."""
        return np.diag(self.settings.model_std**2) + timing * _about(late.own) + late.others

    def _precise(self, guess: Guess, period: float) -> bool:
        """Whether what a single torque does can be told from what the delay does."""
        return guess.std < period / 50 and guess.eta < NEVER

    def _jerked(self, guess: Guess, period: float) -> Guess:
        """The same where the delay itself may have changed a little."""
        P = guess.covariance.copy()
        P[-2, -2] += (JERKED * period) ** 2
        return replace(guess, covariance=P)

    def _timed(
        self, guess: Guess, found: "Corrected", used: float, period: float
    ) -> tuple[Guess, int]:
        """The guess with what a measurement tells of the timing, and `outliers` after it.

        With S = S_0 + s M, s the variance, the log-likelihood has the slope and the information

            dL/ds = 1/2 (nu' S^-1 M S^-1 nu - tr S^-1 M),   I = 1/2 tr S^-1 M S^-1 M,

        so that s + (dL/ds) / I is what this measurement alone tells of it (Fisher scoring). One
        torque whose timing is all that is uncertain tells it to I = 1 / (2 s^2): a measurement
        counts as 2 s^2 I torques. The mean over those is the estimate; a weight that is itself
        1 / s^4 would for ever believe the first ones that happened to be on time.
        """
        share = np.linalg.solve(found.S, found.M)
        pull = np.linalg.solve(found.S, found.innovation)
        information = 0.5 * float(np.sum(share * share.T))
        if not information > 0:  # no torque has changed
            return guess, 0
        slope = 0.5 * float(pull @ found.M @ pull - np.trace(share))
        told, torques = used + slope / information, 2 * used**2 * information
        kept = min(guess.weight, MEMORY / period)
        most = (UNTIMELY * period) ** 2
        timing = (kept * guess.timing + torques * told) / (kept + torques)
        timed = replace(guess, timing=min(max(timing, 0.0), most), weight=kept + torques)
        return timed, guess.outliers + 1 if told > 2 * most else 0

    def _correct(
        self,
        model: "DelayModel",
        guess: Guess,
        y: Array,
        start: "tuple[Array, Linearized, Late, float]",
        nodes: Array,
    ) -> "Corrected | None":
        """The iterations of `ParameterFilter.advance`; None for an outlier."""
        sensing, prior, P = self.sensing, guess.mean, guess.covariance
        xi, at, late, timing = start

        def seen(covariance: Array) -> Array:
            return sensing.through(at.state, sensing.through(at.state, covariance).T)

        R = np.diag(sensing.noise_std**2) + seen(self._drift(late, timing))
        M, small = seen(late.own), SMALL * np.sqrt(np.diag(R))
        for _ in range(ITERATIONS if guess.std > model.timeline.period / 100 else FEW):
            H = sensing.through(at.state, at.F[:NUM_STATE])
            innovation = y - sensing.seen(at.state) - H @ (prior - xi)
            S = H @ P @ H.T + R
            gain = np.linalg.solve(S, H @ P).T
            keep = np.eye(len(xi)) - gain @ H
            posterior = keep @ P @ keep.T + gain @ R @ gain.T
            moved = self._bounded(prior + gain @ innovation, posterior, guess)
            shift, xi = at.F[:NUM_STATE] @ (moved - xi), moved
            linear = at.state + shift
            if np.all(np.abs(sensing.through(at.state, shift)) <= small):
                at = replace(at, state=linear)
                break
            end = model.end(xi)
            if np.all(np.abs(sensing.through(end, end - linear)) <= small):
                at = replace(at, state=end)
                break
            at = model.at(xi, nodes)
        distance = float(innovation @ np.linalg.solve(S, innovation))
        if not distance <= gate(len(y)):  # or NaN
            return None
        likelihood = -0.5 * (distance + float(np.linalg.slogdet(S)[1]))
        return Corrected(xi, at, posterior, likelihood, innovation, S, M)

    def _best_of_many(self, model: "DelayModel", guess: Guess, y: Array, H: Array) -> Array:
        """The mean with that eta of TRIED ones that the measurement fits best.

        By nu' S^-1 nu, S of all but the delay: the linearised effect of a torque that has not
        arrived yet is none, and iterations from there would never find one that has.
        """
        sensing, (low, high) = self.sensing, (guess.low, guess.high)
        spread = sensing.through(guess.mean[:NUM_STATE], H)
        S = spread @ guess.covariance[:-2, :-2] @ spread.T
        S = S + np.diag(sensing.noise_std**2 + self._model_variance(guess.mean[:NUM_STATE]))
        reach = 2.5 * guess.std
        best, least = guess.mean, np.inf
        for eta in np.linspace(max(low, guess.eta - reach), min(high, guess.eta + reach), TRIED):
            xi = guess.mean.copy()
            xi[-2] = eta
            miss = y - sensing.seen(model.end(xi))
            cost = float(miss @ np.linalg.solve(S, miss))
            if cost < least:
                best, least = xi, cost
        return best

    def _model_variance(self, state: Array) -> Array:
        seen = self.sensing.through(state, np.diag(self.settings.model_std))
        return np.sum(seen**2, axis=1)

    def _bounded(self, mean: Array, covariance: Array, guess: Guess) -> Array:
        """`within_bounds` of what is uncertain: the parameters, and eta and rate if they are."""
        known = self.settings.parameters
        free = int(np.sum(np.diag(guess.covariance)[-2:] > 0))
        n = len(mean) - 2 + free
        limits = ParameterSet(
            (*known.names, "delay", "delay_rate")[: n - NUM_STATE],
            (*known.units, "s", "s/s")[: n - NUM_STATE],
            np.append(known.prior, [guess.low, 0.0])[: n - NUM_STATE],
            np.append(known.std, [1.0, 1.0])[: n - NUM_STATE],
            np.append(known.lower, [guess.low, -LARGEST_RATE])[: n - NUM_STATE],
            np.append(known.upper, [guess.high, LARGEST_RATE])[: n - NUM_STATE],
        )
        return np.concatenate([within_bounds(mean[:n], covariance[:n, :n], limits), mean[n:]])


class Corrected(NamedTuple):
    """What a measurement made of a guess."""

    xi: Array
    """Mean at the sample before."""
    at: "Linearized"
    """The period from there."""
    covariance: Array
    """Of xi."""
    log_likelihood: float
    innovation: Array
    """(m,)."""
    S: Array
    """(m, m) its covariance."""
    M: Array
    """(m, m) by which that grows with the variance of the timing."""


@dataclass(frozen=True)
class Linearized:
    """One period, linearised."""

    state: Array
    """(12,) at its end."""
    F: Array
    """(12 + p + 2, 12 + p + 2) of xi."""


class Late(NamedTuple):
    """What the state at a period's end owes to torques that come early or late."""

    own: Array
    """(12, 12) covariance per s^2, of the controller's torques, without what lies beside."""
    others: Array
    """(12, 12) covariance, of those that were in flight before."""


@dataclass(frozen=True)
class DelayModel:
    """The motion over one period as a function of xi.

    Attributes:
        plant: as it is known.
        timeline: seen from its beginning.
        in_flight: (n, 6) torques.
        newest: as of `Arrivals.within`.
    """

    plant: NominalPlant
    timeline: Arrivals
    in_flight: Array
    newest: int = 0

    def acting(self, xi: Array, more: float = 0.0) -> Acting:
        """What acts, with eta and its rate of xi; also so many s after the period's end."""
        timeline = replace(self.timeline, arrival=float(xi[-2]), rate=float(xi[-1]))
        end = self.timeline.period + more
        return timeline.within(self.in_flight, 0.0, end, self.newest)

    def end(self, xi: Array) -> Array:
        """State (12,) at the end."""
        return self.plant.predict(xi[:NUM_STATE], self.acting(xi), xi[NUM_STATE:-2])[-1]

    def sensitivity(self, xi: Array) -> Array:
        """(12,) of the state at the end to eta, per s."""
        later, sooner = xi.copy(), xi.copy()
        later[-2] += DIFFERENCE
        sooner[-2] -= DIFFERENCE
        return (self.end(later) - self.end(sooner)) / (2 * DIFFERENCE)

    def at(self, xi: Array, nodes: Array) -> Linearized:
        """Linearised at xi."""
        acting, size = self.acting(xi), len(xi) - 2
        period = Period(*acting, acting.torques[-1], self.plant.substeps_for(acting.torques))
        state, F_known = transition(self.plant.dynamics, xi[:-2], period, nodes)
        F = np.eye(size + 2)
        F[:size, :size] = F_known
        F[-2, -1] = self.timeline.period
        if xi[-2] < NEVER:
            F[:NUM_STATE, -2] = self.sensitivity(xi)
            F[:NUM_STATE, -1] = self.timeline.period / 2 * F[:NUM_STATE, -2]
        return Linearized(state, F)

    def late(self, xi: Array, state: Array, std: float) -> Late:
        """What comes of it when single torques are early or late by a standard deviation, s.

        A change of torque at c that comes a second earlier leaves B dT in the rates at the end and
        moves the pose by that for the rest of the period; it does so in this period if c + j is
        within, j its error: next to a sample with the probability Phi. What was in flight at t = 0
        was held from instants that nobody knows, phi dt off the samples. Held mean torques of
        changes dT per period leave the rates off by B dT dt phi (1 - phi) / 2 at the samples, of
        which the mean square is BEFORE (B dT dt)^2 for phi uniform in [0, 1].
        """
        dt, theta = self.timeline.period, xi[NUM_STATE:-2]
        timeline = replace(self.timeline, arrival=float(xi[-2]), rate=float(xi[-1]))
        torques, durations = timeline.within(
            self.in_flight, -EDGE * dt, (1 + EDGE) * dt, self.newest
        )
        dynamics, pose, rates = self.plant.dynamics, state[POSE], state[RATES]
        changes = np.diff([dynamics.accelerations(pose, rates, T, theta) for T in torques], axis=0)
        at = np.cumsum(durations)[:-1] - EDGE * dt
        left = np.clip(dt - at, 0.0, dt)
        early = np.hstack([left[:, None] * changes, changes])
        within = ndtr((dt - at) / std) - ndtr(-at / std)
        own = at >= timeline.first - INSTANT
        mine = np.sqrt(within[own])[:, None] * early[own]
        return Late(mine.T @ mine, BEFORE * dt**2 * _about(early[~own].T @ early[~own]))


def _about(kicks: Array) -> Array:
    """(12, 12) a covariance of kicks, and a little beside them."""
    return kicks + ASIDE * np.diag(np.diag(kicks))
