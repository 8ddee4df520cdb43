"""What a tuner decides by: numbers made of what the law remembers, by the name of their kind.

Features keep a window of rows, one for each of the last 31 samples, the newest last. A row is made
of two memories of the law, before and after a sample, so that whatever steps the law, in Drake, in
the loop without it, in Python or in C, gives the same numbers.

The paper's densities (45) divide each signal by its own mean, so that no scale survives in them: a
loop that is being lost looks like one in good order. The features `health` relate timing, surprise,
error and feedback to their usual size instead.

*Timing.* A torque that arrives tau late leaves the rates off by -tau kappa at the next sample,
kappa the change of the accelerations with which it arrives. With the innovation nu of the rates
and its floor f, sums over the six rates,

    n = sum nu kappa / f^2,   d = sum kappa^2 / f^2,   E n^2 = tau^2 d^2 + d,

hence over a window tau^2 = sum (n^2 - d) / sum d^2, where that is positive, whatever the sign and
however much it changes from torque to torque. Its standard deviation is about 1 / sqrt(sum d). One
that comes early acts by the change at the end of the period instead: `late` and `early`.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from stewart_drake.law.core_law import AnyMemory
from stewart_drake.law.filter_settings import MODEL_ERROR
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, POSE, RATES
from stewart_drake.tuner.network import NUM_INPUTS, WINDOW, Kind, density
from stewart_drake.types import Array


class Features(Protocol):
    """What becomes of memories, and what becomes of that."""

    @property
    def size(self) -> int:
        """Of a row."""

    def row(
        self, last: Array, before: AnyMemory, after: AnyMemory, wanted: Array, ratio: float
    ) -> Array:
        """(size,) of a sample.

        Args:
            last: (size,) of the sample before.
            before: what the law remembered at the sample before.
            after: what it remembers since this one.
            wanted: (12,) pose and rates of the reference at the sample.
            ratio: log10(w_Q / w_R) that was used.
        """

    def values(self, window: Array) -> Array:
        """(18,) of a window (31, size), whose rows are NaN before the first sample."""


@dataclass(frozen=True)
class DensityFeatures:
    """The paper's densities (45), `tuner.network`.

    Attributes:
        kind: of density.
    """

    kind: Kind = "magnitude"

    @property
    def size(self) -> int:
        """12 errors and 6 torques."""
        return NUM_INPUTS

    def row(
        self, last: Array, before: AnyMemory, after: AnyMemory, wanted: Array, ratio: float
    ) -> Array:
        """[y - r; T]; where the state is not measured, its estimate stands for it."""
        measured = after.measurement
        state = measured if len(measured) == NUM_STATE else after.belief.state
        return np.concatenate([state - wanted, after.torque])

    def values(self, window: Array) -> Array:
        """Of the newest sample."""
        return density(window, self.kind)


LOWEST: Final = -6.0
HIGHEST: Final = 4.0
"""Bounds of a logarithm among the features: those of runs that are being lost grow without any."""


def log10_within(value: float) -> float:
    """log10 of a number of at least 0, within the bounds; the lower one for NaN."""
    return min(max(math.log10(value), LOWEST), HIGHEST) if value > 0 else LOWEST


def empty_window(features: Features) -> Array:
    """Before the first sample."""
    return np.full((WINDOW, features.size), np.nan)


# ---------------------------------------------------------------- health

NAMES: Final = (
    "timing_31", "timing_10", "timing_bound", "timing_detectable",
    "error_10", "error_31", "feedback_4", "feedback_20", "surprise_3", "surprise_15",
    "surprise_of_tolerance", "surprise_peak", "ratio", "noise", "delay", "doubt",
    "feedback_change", "feedback_growth",
)  # fmt: skip
"""Of the 18; numbers say over how many samples a root mean square is taken."""
PEAK: Final = NAMES.index("surprise_peak")
HUGE: Final = 1e6
"""Where what is being lost has no limit, in units of what is usual."""
LONGEST_DETECTABLE: Final = 0.1
"""s; what cannot be told is no more than that."""


class Row(NamedTuple):
    """Of one sample; mean squares over the values that are known, else NaN.

    Beside it a window keeps the torque that acted last, (6,) N m.
    """

    error: float
    """Pose error over what is tolerable."""
    feedback: float
    """Torque that is fed back over the reference's peak."""
    change: float
    """Of that since the last sample."""
    surprise: float
    """Innovation over its floor."""
    missed: float
    """Innovation over what is tolerable."""
    late: float
    """n, see above; 0 where it is not known."""
    late_weight: float
    """d."""
    early: float
    early_weight: float
    ratio: float
    """log10(w_Q / w_R)."""
    doubt: float
    """Variance of the estimated parameters over that of their prior, 0 where there are none."""


@dataclass(frozen=True)
class HealthFeatures:
    """The 18 of NAMES, of a law that measures the state.

    Attributes:
        plant: the machine as the law knows it.
        noise: (12,) standard deviation of a measurement.
        motion: (12,) half the peak to peak of the reference, and the same per second.
        tolerance: (12,) error that is tolerable, of the pose and per second of the rates.
        torque: largest that the reference takes, N m.
        prior: (p,) standard deviations of the estimated parameters, None where there are none.
        delay: believed delay times the reference's angular frequency.
    """

    plant: NominalPlant
    noise: Array
    motion: Array
    tolerance: Array
    torque: float
    prior: Array | None
    delay: float

    @property
    def size(self) -> int:
        """Of a `Row` and a torque."""
        return len(Row._fields) + NUM_TORQUES

    def row(
        self, last: Array, before: AnyMemory, after: AnyMemory, wanted: Array, ratio: float
    ) -> Array:
        """See `tuner.features.Features.row`; a `Row` and a torque."""
        acted = last[len(Row._fields) :]
        innovation, late, early, acted = self._innovation(acted, before, after)
        floor = self._floor
        innovation = np.clip(innovation, -HUGE * floor, HUGE * floor)
        scaled = innovation[RATES] / floor[RATES]
        late, early = (np.clip(a / floor[RATES], -HUGE, HUGE) for a in (late, early))
        fed_back, before_that = (
            np.clip((m.torque - m.feedforward) / self.torque, -HUGE, HUGE) for m in (after, before)
        )
        error = (after.measurement[POSE] - wanted[POSE]) / self.tolerance[POSE]
        error = np.clip(error, -HUGE, HUGE)
        row = Row(
            error=_mean_square(error),
            feedback=_mean_square(fed_back),
            change=_mean_square(fed_back - before_that),
            surprise=_mean_square(innovation / floor),
            missed=_mean_square(innovation / self.tolerance),
            late=_known(scaled @ late),
            late_weight=_known(late @ late),
            early=_known(scaled @ early),
            early_weight=_known(early @ early),
            ratio=ratio,
            doubt=self._doubt(after),
        )
        return np.concatenate([row, acted])

    def values(self, window: Array) -> Array:
        """See `tuner.features.Features.values`; finite once there is a sample."""
        past = Past(window[:, : len(Row._fields)])
        late_31, late_10 = (past.timing("late", "late_weight", n) for n in (31, 10))
        early = past.timing("early", "early_weight", 31)
        information = past.sum("late_weight", WINDOW)
        detectable = min(LONGEST_DETECTABLE, 1 / math.sqrt(max(information, 1e-30)))
        bound = math.hypot(max(late_31, late_10, early), 2 * detectable)
        growth = 1.0
        if past.number("feedback", 5, 15):
            growth = (past.rms("feedback", 5) + 1e-5) / (past.rms("feedback", 5, 15) + 1e-5)
        return np.array(
            [
                log10_within(1e3 * late_31 + 0.05),
                log10_within(1e3 * late_10 + 0.05),
                log10_within(1e3 * bound + 0.05),
                log10_within(1e3 * detectable),
                log10_within(past.rms("error", 10) + 1e-3),
                log10_within(past.rms("error", 31) + 1e-3),
                log10_within(past.rms("feedback", 4) + 1e-4),
                log10_within(past.rms("feedback", 20) + 1e-4),
                log10_within(past.rms("surprise", 3) + 0.1),
                log10_within(past.rms("surprise", 15) + 0.1),
                log10_within(past.rms("missed", 10) + 1e-4),
                log10_within(past.peak("surprise") + 0.1),
                past.last("ratio"),
                self._told,
                self.delay,
                log10_within(math.sqrt(past.last("doubt")) + 1e-3),
                log10_within(past.rms("change", 10) + 1e-4),
                log10_within(growth),
            ]
        )

    @cached_property
    def _told(self) -> float:
        """The noise that the law knows of."""
        return log10_within(math.sqrt(np.mean((self.noise / self.motion) ** 2)) + 1e-4)

    @cached_property
    def _floor(self) -> Array:
        """(12,) standard deviation of an innovation where all is as the law believes."""
        return np.sqrt(2 * self.noise**2 + (MODEL_ERROR * self.motion) ** 2)

    def _innovation(
        self, acted: Array, before: AnyMemory, after: AnyMemory
    ) -> tuple[Array, Array, Array, Array]:
        """Measurement less prediction (12,), changes (6,) of the accelerations, late and early,
        and the torque (6,) that acted last; `acted` is that of the period before."""
        belief = before.belief
        if not belief.has_state:
            nothing = np.zeros(NUM_TORQUES)
            return np.full(NUM_STATE, np.nan), nothing, nothing, np.full(NUM_TORQUES, np.nan)
        schedule, following = belief.timeline.last_period(before.in_flight)
        state, theta = belief.state, belief.parameters
        predicted = self.plant.predict(state, schedule, theta)[-1]
        newest = schedule.torques[-1]
        older = schedule.torques[-2] if len(schedule.torques) > 1 else acted
        torques = (newest if np.isnan(older).any() else older, newest, following)
        a = [
            self.plant.dynamics.accelerations(state[POSE], state[RATES], T, theta) for T in torques
        ]
        return after.measurement - predicted, a[1] - a[0], a[2] - a[1], newest

    def _doubt(self, after: AnyMemory) -> float:
        if self.prior is None:
            return 0.0
        return _mean_square(after.belief.estimate.parameter_std / self.prior)


class Past:
    """Sums over the newest rows of a window, of what is known.

    Args:
        rows: (31, n) of `Row`, the newest last.
    """

    def __init__(self, rows: Array) -> None:
        newest_first = rows[::-1]
        known = ~np.isnan(newest_first)
        values = np.where(known, newest_first, 0.0)
        self._values = values
        self._sums = np.vstack([np.zeros(len(Row._fields)), values.cumsum(axis=0)])
        self._known = np.vstack([np.zeros(len(Row._fields), int), known.cumsum(axis=0)])

    def sum(self, name: str, number: int, first: int = 0) -> float:
        """Over so many rows, without the `first` newest."""
        i = Row._fields.index(name)
        return float(self._sums[number, i] - self._sums[first, i])

    def number(self, name: str, first: int, last: int) -> int:
        """How many of the rows `first` to `last`, counted from the newest, are known."""
        i = Row._fields.index(name)
        return int(self._known[last, i] - self._known[first, i])

    def rms(self, name: str, first: int, last: int | None = None) -> float:
        """Of mean squares of the `first` newest rows, or of `first` to `last`; 0 for none known."""
        begin, end = (0, first) if last is None else (first, last)
        number = self.number(name, begin, end)
        return math.sqrt(max(0.0, self.sum(name, end, begin)) / number) if number else 0.0

    def peak(self, name: str) -> float:
        """Root of the largest."""
        return math.sqrt(self._values[:, Row._fields.index(name)].max())

    def last(self, name: str) -> float:
        """The newest, 0 where it is not known."""
        return float(self._values[0, Row._fields.index(name)])

    def timing(self, n: str, d: str, number: int) -> float:
        """tau in s over the newest rows, 0 where it cannot be told from none."""
        late, weight = (self._values[:number, Row._fields.index(name)] for name in (n, d))
        squares, excess = float(weight @ weight), float(late @ late - weight.sum())
        return math.sqrt(excess / squares) if squares > 0 and excess > 0 else 0.0


def _known(value: Any) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _mean_square(x: Array) -> float:
    known = x[np.isfinite(x)]
    return float(known @ known / len(known)) if len(known) else np.nan
