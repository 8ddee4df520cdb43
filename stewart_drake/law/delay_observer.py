"""State, parameters and a delay that nobody knows: a Gaussian sum over its arrival.

Until the first of the controller's torques arrives, nothing tells of the delay but that it did not.
A *master* filter assumes just this. At t_k a *cell* is taken from it, as it was at t_{k-1}, for an
arrival in between: eta uniform in (t_{k-1}, t_k]. With Phi the distribution of the prior,

    p = [Phi(t_k) - Phi(t_{k-1})] / [1 - Phi(t_{k-1})]

of the master's weight goes to the cell, 1 - p stays. Each measurement multiplies all weights by
its likelihood. When one cell, and what lies within `near` of it, has all but e^-LEAD of the weight
and knows the delay to `near`, it is the delay: the search is over, and one filter goes on.

Two outliers in a row may be a jump of the delay. Then state and parameters are known, and what was
measured last is compared with what every delay of a grid would have done; filters are begun at the
best few, and one that fits alone takes over.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from stewart_drake.law.arrivals import Arrivals
from stewart_drake.law.belief import Belief
from stewart_drake.law.delay_filter import (
    NEVER,
    DelayFilter,
    DelayModel,
    DelaySettings,
    Guess,
)
from stewart_drake.law.filter_settings import FilterSettings
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import told
from stewart_drake.law.parameter_filter import MIDPOINT, PATIENCE
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array

LEAD = 7.0
"""Log of the odds at which the search is over."""
FORGOTTEN = 14.0
"""Log of the odds at which a cell is dropped."""
NEAR = 0.2
"""Periods; what is nearer is one hypothesis."""
LEAST_SHARE = 1e-4
"""Of the master's weight that goes to a cell, and that stays."""
SUSPICIOUS = 2
"""Outliers in a row that may be a jump."""
GRID = 0.5
"""Periods between the delays that are tried after a jump."""
BEST = 2
"""Of them, from which filters are begun."""
HOPELESS = 100.0
"""Squared distance by which it is not worth to begin one."""
SETTLED = 5.0
"""Log of the odds at which one of those takes over."""
AT_ONCE = 2
"""Cells that leave time for a plan at the same sample."""
CAUTION = 10.0
"""Times the weight of torques while the delay is sought: a slow loop bears a wrong one."""
LOOSENED = 0.05
"""Standard deviations of the prior by which parameters may have changed with the delay."""


@dataclass(frozen=True)
class Cell:
    """A hypothesis and the log of its weight."""

    guess: Guess
    weight: float


@dataclass(frozen=True)
class DelayBelief(Belief):
    """A belief with what is thought possible of the delay.

    Attributes:
        guess: that the law goes on; None before the first measurement.
        master: nothing has arrived; None once the search is over.
        cells: what else may be; none once the search is over.
        fresh: whether the delay was found at this sample with so much work that what follows from
            it, planning above all, waits for the next, which has time for it.
        silent: whether nothing is fed back until then.
        past: (2, m) the last two measurements, NaN for none.
    """

    guess: Guess | None = None
    master: Cell | None = None
    cells: tuple[Cell, ...] = ()
    fresh: bool = False
    silent: bool = False
    past: Array | None = None

    @property
    def locked(self) -> bool:
        """Whether the search is over."""
        return self.guess is not None and self.master is None


@dataclass(frozen=True)
class DelayObserver:
    """Estimates state, parameters and delay.

    Attributes:
        settings: of state and parameters.
        delay: of the delay.
        believed: s, mean of the prior.
        quiet: whether nothing is fed back before the delay is found.
    """

    settings: FilterSettings
    delay: DelaySettings
    believed: float
    quiet: bool

    def kept(self, period: float) -> int:
        """Torques that have to be kept in flight."""
        return math.ceil(self.delay.longest / period) + 2

    def start(self, timeline: Timeline, sensing: Sensing, plant: NominalPlant) -> Belief:
        """The delay is what is believed."""
        none = np.zeros((0, 6))
        first = Arrivals(timeline.period, Delay(0), self.believed, before=none)
        sensing, _ = sensing.now(Measurement.of(np.full(sensing.size, np.nan)))
        nothing = Belief.nothing(first, sensing.size, self.settings.parameters.prior)
        return DelayBelief(nothing.estimate, first, nothing.measured, silent=self.quiet)

    def observe(
        self,
        belief: Belief,
        measurement: Measurement,
        in_flight: Array,
        sensing: Sensing,
        plant: NominalPlant,
    ) -> Belief:
        """See `law.observers.Observer.observe`."""
        assert isinstance(belief, DelayBelief) and isinstance(belief.timeline, Arrivals)
        sensing, measurement = sensing.now(measurement)
        after = replace(told(belief, measurement, sensing, plant), found=belief.fresh, fresh=False)
        if after.fault is None and not measurement.complete:
            after = replace(after, fault="measurements_missing")
        y = measurement.values if after.fault is None else None
        filtering = DelayFilter(plant, sensing, self.settings, self.delay)
        if len(belief.timeline.before) == 0:  # the first sample: all in flight is others'
            # Without a queue the torque of the last period goes on.
            before = in_flight[1:] if len(in_flight) > 1 else in_flight
            since = now = replace(belief.timeline, before=before)
        else:
            now = belief.timeline.later(len(in_flight))
            since = replace(belief.timeline, sent=now.sent)
        search = _Search(self, filtering, since, now, in_flight)
        if belief.guess is None:
            after = after if y is None else search.begun(after, measurement)
        elif belief.locked:
            after = search.tracked(after, y)
        else:
            after = search.searched(after, y)
        if after.guess is not None and after.guess.outliers >= PATIENCE and y is not None:
            after = search.restarted(after, measurement)
        values = np.full(sensing.size, np.nan) if y is None else y
        past = np.full((1, sensing.size), np.nan) if belief.past is None else belief.past[-1:]
        return search.told_to_law(replace(after, past=np.vstack([past, values])), y is not None)


@dataclass(frozen=True)
class _Search:
    """What one sample makes of a belief."""

    observer: DelayObserver
    filter: DelayFilter
    since: Arrivals
    """Seen from the sample before."""
    now: Arrivals
    in_flight: Array

    @property
    def period(self) -> float:
        return self.now.period

    def begun(self, belief: DelayBelief, measurement: Measurement) -> DelayBelief:
        """From one measurement alone: nothing has arrived, or something in any period so far."""
        observer, sent = self.observer, self.now.sent
        first = self.filter.sensing.start(measurement, belief.state)
        if first is None:
            return belief
        prior = observer.settings.parameters
        mean = np.concatenate([first.state, prior.prior, [NEVER, 0.0]])
        covariance = np.zeros((len(mean), len(mean)))
        covariance[:NUM_STATE, :NUM_STATE] = first.covariance
        covariance[NUM_STATE:-2, NUM_STATE:-2] = prior.covariance
        timing = observer.settings.timing_std**2
        nothing = Guess(mean, covariance, 0.0, observer.delay.longest, timing=timing)
        master = Cell(nothing, 0.0)
        cells = []
        for k in range(1, sent + 1):
            if k * self.period < observer.delay.longest:
                cell, master = self._spawn(master, master, k)
                cells.append(cell)
        return replace(belief, guess=master.guess, master=master, cells=tuple(cells))

    def _spawn(self, master: Cell, before: Cell, k: int) -> tuple[Cell, Cell]:
        """The cell of an arrival within period k, and what stays of the master."""
        begin, end = (k - 1) * self.period, k * self.period
        left = self._left(begin)
        share = 1 - self._left(end) / left if left > 0 else 1.0
        share = min(max(share, LEAST_SHARE), 1 - LEAST_SHARE)
        mean, covariance = before.guess.mean.copy(), before.guess.covariance.copy()
        mean[-2], mean[-1] = (begin + end) / 2, 0.0
        covariance[-2, -2] = self.period**2 / 12
        covariance[-1, -1] = self.observer.delay.rate_std**2
        guess = replace(before.guess, mean=mean, covariance=covariance, low=begin, high=end)
        cell = Cell(guess, before.weight + math.log(share))
        return cell, replace(master, weight=master.weight + math.log1p(-share))

    def _left(self, t: float) -> float:
        """Prior probability of a delay longer than t, up to the longest."""
        mean, std, longest = self.observer.believed, self.observer.delay.std, self._longest
        above, all_of_it = ndtr((mean - t) / std), ndtr((mean - longest) / std)
        return max(float(above - all_of_it), 0.0)

    @property
    def _longest(self) -> float:
        return self.observer.delay.longest

    def searched(self, belief: DelayBelief, y: Array | None) -> DelayBelief:
        """One more measurement for master and cells, and perhaps the end of the search."""
        assert belief.master is not None
        master, cells = belief.master, belief.cells
        k = self.now.sent
        if k < len(self.in_flight) and (k - 1) * self.period < self._longest:
            new, master = self._spawn(master, master, k)
            cells = (*cells, new)
        busy = len(cells) > AT_ONCE
        cells = tuple(self._updated(cell, y) for cell in cells)
        master = self._updated(master, y)
        top = max(cell.weight for cell in (master, *cells))
        master = replace(master, weight=master.weight - top)
        cells = tuple(
            replace(cell, weight=cell.weight - top)
            for cell in cells
            if cell.weight > top - FORGOTTEN
        )
        best = max((master, *cells), key=lambda cell: cell.weight)
        after = replace(belief, guess=best.guess, master=master, cells=cells)
        near = NEAR * self.period
        rivals = [c.weight for c in cells if abs(c.guess.eta - best.guess.eta) > near]
        found = best is not master and best.guess.fits and y is not None
        if found and max([master.weight, *rivals]) < -LEAD and best.guess.std < near:
            guess = replace(best.guess, low=0.0, high=self._longest)
            return replace(after, guess=guess, master=None, cells=(), found=True, fresh=busy)
        return after

    def _updated(self, cell: Cell, y: Array | None) -> Cell:
        guess = self.filter.advance(cell.guess, self.since, self.in_flight, y)
        return Cell(guess, cell.weight + (0.0 if y is None else guess.log_likelihood))

    def tracked(self, belief: DelayBelief, y: Array | None) -> DelayBelief:
        """One more measurement for the only filter."""
        assert belief.guess is not None
        guess = self.filter.advance(belief.guess, self.since, self.in_flight, y)
        if y is not None and guess.outliers >= SUSPICIOUS and belief.past is not None:
            jumped = self._jumped(guess, np.vstack([belief.past, y]))
            if jumped is not None:
                return replace(belief, guess=jumped, fresh=True)
        return replace(belief, guess=guess)

    def _jumped(self, guess: Guess, seen: Array) -> Guess | None:
        """The guess of another delay that explains the last of three measurements (3, m)."""
        if not np.all(np.isfinite(seen)):
            return None
        views = [(self._earlier(1), 1), (self.since, 0)]
        models = [DelayModel(self.filter.plant, v, self.in_flight, n) for v, n in views]
        sensing, settings = self.filter.sensing, self.observer.settings
        told_by = (sensing.start(Measurement.of(y), guess.mean[:NUM_STATE]) for y in seen[:2])
        states = [first for first in told_by if first is not None]
        if len(states) < 2:
            return None
        cost = np.zeros(0)
        tried = np.arange(GRID, self._longest / self.period, GRID) * self.period
        for model, first, y in zip(models, states, seen[1:], strict=True):
            xi = guess.mean.copy()
            xi[:NUM_STATE], xi[-1] = first.state, 0.0
            H = model.at(xi, MIDPOINT).F[:NUM_STATE, :-2]
            spread = sensing.through(first.state, H)
            P = guess.covariance[:-2, :-2].copy()
            P[:NUM_STATE], P[:, :NUM_STATE] = 0.0, 0.0
            P[:NUM_STATE, :NUM_STATE] = first.covariance
            S = spread @ P @ spread.T + np.diag(sensing.noise_std**2)
            S = S + sensing.through(
                first.state, sensing.through(first.state, np.diag(settings.model_std**2)).T
            )
            misses = []
            for eta in tried:
                xi[-2] = eta
                misses.append(y - sensing.seen(model.end(xi)))
            distance = np.sum(np.transpose(misses) * np.linalg.solve(S, np.transpose(misses)), 0)
            cost = distance if not len(cost) else cost + distance
        valleys = _valleys(cost)[:BEST]
        chosen = [i for i in valleys if cost[i] <= HOPELESS + 10 * cost[valleys[0]]]
        if not chosen:  # no number: astray
            return None
        begun = [
            self._begin_at(guess, float(tried[i]), states[0].covariance, states[0].state)
            for i in chosen
        ]
        ended = []
        for candidate in begun:
            total = 0.0
            for (view, newest), y in zip(views, seen[1:], strict=True):
                candidate = self.filter.advance(candidate, view, self.in_flight, y, newest)
                total += candidate.log_likelihood
            ended.append(Cell(candidate, total))
        ended.sort(key=lambda cell: -cell.weight)
        best, near = ended[0], NEAR * self.period
        rivals = [c.weight for c in ended[1:] if abs(c.guess.eta - best.guess.eta) > near]
        sure = best.weight - max(rivals, default=-math.inf) >= SETTLED
        moved = abs(best.guess.eta - guess.eta) > near  # less than that is not a jump
        if best.guess.fits and best.guess.std < near and sure and moved:
            return replace(best.guess, low=0.0, high=self._longest, outliers=0)
        return None

    def _earlier(self, periods: int) -> Arrivals:
        """`since`, so many periods before."""
        before = np.vstack([np.repeat(self.since.before[:1], periods, 0), self.since.before])
        return replace(self.since, before=before)

    def _begin_at(self, guess: Guess, eta: float, covariance: Array, state: Array) -> Guess:
        """A guess from a state on, with the parameters as they are known, and another delay."""
        prior, delay = self.observer.settings.parameters, self.observer.delay
        mean, P = guess.mean.copy(), np.zeros_like(guess.covariance)
        mean[:NUM_STATE], mean[-2], mean[-1] = state, eta, 0.0
        P[:NUM_STATE, :NUM_STATE] = covariance
        theta = slice(NUM_STATE, -2)
        P[theta, theta] = guess.covariance[theta, theta]
        P[theta, theta] += np.diag((0.01 * prior.std) ** 2)
        P[-2, -2], P[-1, -1] = self.period**2 / 12, delay.rate_std**2
        half = self.period
        return replace(
            guess,
            mean=mean,
            covariance=P,
            low=max(eta - half, 0.0),
            high=min(eta + half, self._longest),
            outliers=0,
        )

    def restarted(self, belief: DelayBelief, measurement: Measurement) -> DelayBelief:
        """From the last measurement, after outliers that nothing explains."""
        guess = belief.guess
        assert guess is not None
        if not belief.locked:
            return self.begun(belief, measurement)
        first = self.filter.sensing.start(measurement, guess.mean[:NUM_STATE])
        if first is None:
            return belief
        mean, P = guess.mean.copy(), np.zeros_like(guess.covariance)
        theta = slice(NUM_STATE, -2)
        mean[:NUM_STATE] = first.state
        P[:NUM_STATE, :NUM_STATE] = first.covariance
        P[theta, theta] = guess.covariance[theta, theta]
        P[theta, theta] += np.diag((LOOSENED * self.observer.settings.parameters.std) ** 2)
        P[-2, -2] = max(guess.std, self.period / 10) ** 2
        P[-1, -1] = self.observer.delay.rate_std**2
        return replace(belief, guess=replace(guess, mean=mean, covariance=P, outliers=0))

    def told_to_law(self, belief: DelayBelief, measured: bool) -> DelayBelief:
        """The belief as the law reads it: state, parameters, delay, whether to act on them."""
        guess, believed = belief.guess, self.observer.believed
        if guess is None:
            return replace(belief, timeline=self.now)
        fault = belief.fault
        if measured and not guess.fits:
            fault = "measurements_rejected"
        nothing = np.full(self.filter.sensing.size, np.nan)
        estimate = guess.estimate(nothing)
        arrival, rate, feeds_back = guess.eta, guess.rate, True
        settled = belief.locked and not belief.fresh
        silent = belief.silent and not settled
        if not settled:
            waiting = guess.eta >= NEVER
            late = self.now.sent * self.period >= believed
            feeds_back = not (silent or (waiting and late))
            if waiting or silent:
                arrival, rate = believed, 0.0
        mean, std = (guess.eta, guess.std) if belief.locked else self._mixture(belief)
        return replace(
            belief,
            estimate=estimate,
            timeline=replace(self.now, arrival=max(arrival, 0.0), rate=rate),
            fault=fault,
            feeds_back=feeds_back,
            caution=1.0 if settled else CAUTION,
            settled=settled,
            silent=silent,
            delay_mean=mean,
            delay_std=std,
        )

    def _mixture(self, belief: DelayBelief) -> tuple[float, float]:
        """Mean and standard deviation, s, of the delay while it is sought."""
        assert belief.master is not None
        weights = np.exp([belief.master.weight, *(cell.weight for cell in belief.cells)])
        rest, spread = self._rest()
        means = np.array([rest, *(cell.guess.eta for cell in belief.cells)])
        stds = np.array([spread, *(cell.guess.std for cell in belief.cells)])
        weights = weights / weights.sum()
        mean = float(weights @ means)
        return mean, float(np.sqrt(weights @ (stds**2 + (means - mean) ** 2)))

    def _rest(self) -> tuple[float, float]:
        """Mean and standard deviation, s, of the prior's part that is still to come."""
        mean, std, longest = self.observer.believed, self.observer.delay.std, self._longest
        t = min(self.now.sent * self.period, longest)
        low, high = ndtr((t - mean) / std), ndtr((longest - mean) / std)
        if high - low < 1e-12:
            return (t + longest) / 2, (longest - t) / math.sqrt(12)
        share = low + (high - low) * (np.arange(50) + 0.5) / 50
        values = mean + std * ndtri(share)
        return float(values.mean()), float(values.std())


def _valleys(cost: Array) -> Array:
    """Places of the local minima, the lowest first."""
    padded = np.concatenate([[np.inf], cost, [np.inf]])
    inner = (padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:])
    places = np.flatnonzero(inner)
    return places[np.argsort(cost[places])]
