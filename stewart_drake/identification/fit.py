"""The most probable machine: multiple shooting, Gauss-Newton, Levenberg's damping.

Minimised over the unknowns p and the first state x_i of every segment is

    chi^2 = sum |(y - h(x(t); p)) / sigma|^2 + |(p - p_0) / sigma_0|^2,

measurements and prior. A step d from a guess decreases chi^2 + lambda d'D d, where D_p = sigma_0^-2
and D_i = 1e-6 diag(N_ii): directions that the log shows are hardly damped, and first states follow
the unknowns. A first state affects the measurements of one segment only, so that J'J is an arrow,

    J'J = [N_pp, N_pi; N_ip, N_ii],   d_i = -N_ii^-1 (g_i + N_ip d_p),
    (N_pp - sum N_pi N_ii^-1 N_ip) d_p = -(g_p - sum N_pi N_ii^-1 g_i),

and the inverse of the last matrix, without damping, is the covariance of p for any x_i.

The valley of chi^2 is curved: along directions that the log hardly shows, residuals are far from
linear. So the gradient at the end of a step gives a correction of it, with the same J. A damped
step can gain little far from the minimum: iterations end when an undamped step promises little.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.identification import progress
from stewart_drake.identification.logs import ANGLES, KINDS, NUM_MEASURED, POSE
from stewart_drake.identification.model import (
    DELAY_COLUMN,
    FIRST_COLUMNS,
    NUM_DYNAMIC,
    PARAMETER_COLUMNS,
    MachineModel,
    Segment,
    integrate,
    plan_steps,
)
from stewart_drake.identification.unknowns import DELAY, GEOMETRY, NUM_UNKNOWNS, OFFSETS, Unknowns
from stewart_drake.mechanism.kinematics import turned
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.types import Array, Flags

MAX_DELAY_CHANGE: Final = 0.1  # in one iteration, s
CONVERGED: Final = 0.01  # promised gain of chi^2 below which iterations end
MOST_ITERATIONS: Final = 100
# chi^2 per value above which no similar machine explains a segment; a drawing that is a millimetre
# off causes some fifty
UNEXPLAINED: Final = 1e3
_SENSITIVITY_STEP: Final = 0.02  # longest step of the integration of sensitivities, s
_STEP_ERROR: Final = 0.05  # RMS error of the integration in standard deviations of a measurement
_SHORTEST_STEP: Final = 1e-3  # s
_DAMPING: Final = (1.0, 1e-9, 1e12)  # first, least and largest
_OF_FIRST: Final = 1e-6  # damping of the first states, relative to that of the unknowns
_CORRECTED: Final = 2  # largest number of corrections of a step


class Guess(NamedTuple):
    """Values of the unknowns and of the first states."""

    values: Array  # (NUM_UNKNOWNS,)
    first: Array  # (n, 12)


class Residuals(NamedTuple):
    measured: Array  # (m, n, 18) of n segments in standard deviations, 0 for missing measurements
    prior: Array  # (free unknowns,)

    @property
    def chi2(self) -> float:
        """Sum of squares, infinite for a diverged trajectory."""
        with np.errstate(over="ignore"):
            total = float(np.sum(self.measured**2) + np.sum(self.prior**2))
        return total if np.isfinite(total) else np.inf


class Change(NamedTuple):
    unknown: Array  # (k,) of the free unknowns
    first: Array  # (n, 12) of the first states


class Normal(NamedTuple):
    """J'J and J'r, segment by segment; columns: k free unknowns, then a first state."""

    slopes: Array  # J' (n, k + 12, values)
    of_segments: Array  # (n, k + 12, k + 12)
    gradients: Array  # (n, k + 12)
    of_prior: Array  # (k,) on the diagonal
    prior_gradient: Array  # (k,)

    @property
    def joined(self) -> tuple[Array, Array]:
        """N_pp (k, k) and g_p (k,)."""
        k = len(self.of_prior)
        N_pp = self.of_segments[:, :k, :k].sum(0) + np.diag(self.of_prior)
        return N_pp, self.gradients[:, :k].sum(0) + self.prior_gradient

    @property
    def of_first(self) -> tuple[Array, Array]:
        """N_ip (n, 12, k) and N_ii (n, 12, 12)."""
        k = len(self.of_prior)
        return self.of_segments[:, k:, :k], self.of_segments[:, k:, k:]

    def with_residuals(self, residuals: Residuals) -> "Normal":
        """Return these equations with the gradient of other residuals, with the same J."""
        gradients = (self.slopes @ _columns_of(residuals))[:, :, 0]
        prior_gradient = np.sqrt(self.of_prior) * residuals.prior
        return self._replace(gradients=gradients, prior_gradient=prior_gradient)

    def step(self, damping: float, so_far: Change | None = None) -> Change:
        """Return the next part of a damped step that follows `so_far`."""
        k, (N_pp, g) = len(self.of_prior), self.joined
        N_ip, N_ii = self.of_first
        scales = np.einsum("nii->ni", N_ii) * damping * _OF_FIRST
        g_first = self.gradients[:, k:]
        if so_far is not None:
            g = g + damping * self.of_prior * so_far.unknown
            g_first = g_first + scales * so_far.first
        damped = N_ii + scales[:, :, None] * np.eye(NUM_STATE)
        eliminated = np.linalg.solve(damped, np.dstack([N_ip, g_first[:, :, None]]))
        N_pi = N_ip.transpose(0, 2, 1)
        reduced = N_pp + damping * np.diag(self.of_prior) - (N_pi @ eliminated[:, :, :k]).sum(0)
        right = g - (N_pi @ eliminated[:, :, k:]).sum(0)[:, 0]
        std = 1 / np.sqrt(self.of_prior)
        unknown = -std * np.linalg.solve(std[:, None] * reduced * std, std * right)
        return Change(unknown, -(eliminated[:, :, k] + eliminated[:, :, :k] @ unknown))

    def promised(self, change: Change) -> float:
        """Return the gain of chi^2 by a step."""
        k = len(self.of_prior)
        of_first = float(np.sum(self.gradients[:, k:] * change.first))
        return -float(self.joined[1] @ change.unknown) - of_first


def _columns_of(residuals: Residuals) -> Array:
    """Return the residuals (n, values, 1) of each segment."""
    measured = residuals.measured.transpose(1, 0, 2)
    return measured.reshape(len(measured), -1, 1)


@dataclass(frozen=True)
class Problem:
    """Segments of logs under the same gravity, unknowns, and the longest integration step in s."""

    segments: list[Segment]
    unknowns: Unknowns
    longest_step: float = 0.02

    @cached_property
    def model(self) -> MachineModel:
        """Machine of all segments."""
        gravity, free_legs = self.segments[0].log.gravity, bool(self.unknowns.std[GEOMETRY].any())
        return MachineModel(self.unknowns.mechanism, gravity, free_legs)

    @cached_property
    def values(self) -> Array:
        """Measurements (m, n, 18) of the segments, NaN for missing ones."""
        longest = max(len(s.rows) for s in self.segments)
        values = np.full((longest, len(self.segments), NUM_MEASURED), np.nan)
        for i, s in enumerate(self.segments):
            values[: len(s.rows), i] = s.log.values[s.rows]
        return values

    @cached_property
    def there(self) -> Flags:
        """(m, n, 18) of those that are not missing."""
        return np.isfinite(self.values)

    def kept(self, start: Guess, kept: NDArray[np.intp]) -> "tuple[Problem, Guess]":
        """Return the problem and a guess of it with these segments only."""
        segments = [self.segments[k] for k in kept]
        return replace(self, segments=segments), Guess(start.values, start.first[kept])

    def residuals(self, guess: Guess) -> Residuals:
        return self._evaluate(guess, self.longest_step)[0]

    def normal(self, guess: Guess) -> tuple[Residuals, Normal]:
        """Return the residuals and the normal equations of a guess.

        Slopes are integrated with longer steps than trajectories: they cost ten times as much.
        Twice as long ones are stable with the Coulomb friction for which the steps were halved.
        """
        residuals = self.residuals(guess)
        sensitivity_step = min(_SENSITIVITY_STEP, 2 * self.longest_step)
        _, J = self._evaluate(guess, sensitivity_step, sensitive=True)
        # Points and values of a segment in one column.
        _, n, _, columns = J.shape
        rows = J.transpose(1, 0, 2, 3).reshape(n, -1, columns)
        slopes = rows.transpose(0, 2, 1)
        weight = 1 / self.unknowns.std[self.unknowns.free]
        normal = Normal(
            slopes,
            slopes @ rows,
            (slopes @ _columns_of(residuals))[:, :, 0],
            weight**2,
            weight * residuals.prior,
        )
        return residuals, normal

    def _evaluate(
        self, guess: Guess, longest_step: float, sensitive: bool = False
    ) -> tuple[Residuals, Array]:
        """Return the residuals and J (m, n, 18, columns) at m samples of n segments."""
        unknowns, free = self.unknowns, self.unknowns.free
        numbers = unknowns.numbers(guess.values)
        delay = float(guess.values[DELAY])
        steps = [plan_steps(one, delay, longest_step) for one in self.segments]
        states, state_sensitivities = integrate(self.model, numbers, guess.first, steps, sensitive)
        m, n, _ = states.shape
        predicted = np.empty((m, n, NUM_MEASURED))
        J = np.zeros((m, n, NUM_MEASURED, len(free) + NUM_STATE if sensitive else 0))
        predicted[:, :, POSE.start :] = states
        any_angle = bool(self.there[:, :, ANGLES].any())
        with np.errstate(all="ignore"):
            if any_angle:
                alpha, by_pose, by_geometry = self.model.crank_angles(states[:, :, :6], numbers)
                predicted[:, :, ANGLES] = alpha + guess.values[OFFSETS]
                if sensitive:
                    legs = slice(NUM_STATE + NUM_DYNAMIC, PARAMETER_COLUMNS.stop)
                    sensitivities = by_pose @ state_sensitivities[:, :, :6]
                    sensitivities[..., legs] += by_geometry
                    J[:, :, ANGLES] = self._columns(sensitivities, np.eye(6))
            residual = self.values - predicted
            residual[:, :, ANGLES] = turned(residual[:, :, ANGLES], 0.0)
            std = np.array([s.log.std for s in self.segments])
            residual /= std
        if sensitive:
            J[:, :, POSE.start :] = self._columns(state_sensitivities, np.zeros((NUM_STATE, 6)))
            J *= -1 / std[:, :, None]
            J[~self.there] = 0.0
        residual[~self.there] = 0.0
        prior = ((guess.values - unknowns.mean)[free]) / unknowns.std[free]
        return Residuals(residual, prior), J

    def _columns(self, sensitivities: Array, offsets: Array) -> Array:
        """Return derivatives by free unknowns and first state from those of the integration."""
        whole = np.empty((*sensitivities.shape[:-1], NUM_UNKNOWNS))
        whole[..., : OFFSETS.start] = sensitivities[..., PARAMETER_COLUMNS]
        whole[..., OFFSETS] = offsets
        whole[..., DELAY] = sensitivities[..., DELAY_COLUMN]
        return np.concatenate(
            [whole[..., self.unknowns.free], sensitivities[..., FIRST_COLUMNS]], axis=-1
        )


def without_diverged(problem: Problem, start: Guess) -> tuple[Problem, Guess]:
    """Return a problem without the segments whose first trajectory leaves the workspace."""
    measured = problem.residuals(start).measured
    with np.errstate(over="ignore"):
        finite = np.isfinite(np.sum(measured**2, axis=(0, 2)))
    return problem.kept(start, np.flatnonzero(finite))


def nearest_half(problem: Problem, start: Guess) -> tuple[Problem, Guess]:
    """Return the half of the segments whose first trajectories are nearest to the measurements.

    The others, such as the last one before a plate was lost, would pull all unknowns towards
    shorter trajectories. From the values of this half they start near, too.
    """
    away = misfit(problem.residuals(start), problem)
    return problem.kept(start, np.sort(np.argsort(away)[: (len(away) + 1) // 2]))


def misfit(residuals: Residuals, problem: Problem) -> Array:
    """Return chi^2 per value (n,) of each segment."""
    return np.asarray(np.sum(residuals.measured**2, axis=(0, 2)) / problem.there.sum(axis=(0, 2)))


class Solution(NamedTuple):
    """End of the iterations for segments of logs, without those that were left out."""

    whole: Problem  # all segments
    problem: Problem  # segments that were fitted
    begun: Guess  # start of the iterations
    guess: Guess
    residuals: Residuals
    covariance: Array  # (k, k) of the free unknowns
    iterations: int
    promised: float  # gain of chi^2 that a further step promises

    @property
    def delay(self) -> float:
        return float(self.guess.values[DELAY])  # s

    @property
    def delay_std(self) -> float:
        """Standard deviation of the delay, s, the last of the unknowns."""
        return float(np.sqrt(self.covariance[-1, -1]))

    @property
    def left_out(self) -> int:
        return len(self.whole.segments) - len(self.problem.segments)

    @property
    def share(self) -> float:
        """Share of the values of all segments that was fitted."""
        return float(self.problem.there.sum() / self.whole.there.sum())

    @property
    def chi2(self) -> float:
        """chi^2 per value that was fitted."""
        return chi2_per_value(self.residuals, self.problem)["all"]

    @property
    def misfit(self) -> Array:
        """chi^2 per value (n,) of each segment that was fitted."""
        return misfit(self.residuals, self.problem)

    def without_worst(self, most: int = MOST_ITERATIONS) -> "Solution":
        """Return the fit from the same start without the segment of the largest misfit."""
        kept = np.delete(np.arange(len(self.problem.segments)), self.misfit.argmax())
        return solve(*self.problem.kept(self.begun, kept), most, self.whole)

    def refitted(self, problem: Problem) -> "Solution":
        """Return the fit of a problem with other steps, from the end of this fit."""
        return solve(problem, self.guess, whole=self.whole)


def solve(
    problem: Problem, start: Guess, most: int = MOST_ITERATIONS, whole: Problem | None = None
) -> Solution:
    """Return the most probable guess after up to `most` iterations from a finite start.

    `whole` has the segments that were left out, too.
    """
    guess, damping, iterations = start, _DAMPING[0], 0
    residuals, normal = problem.normal(guess)
    while iterations < most and not normal.promised(normal.step(_DAMPING[1])) < CONVERGED:
        iterations += 1
        progress.iteration(iterations, most)
        before = guess
        while damping < _DAMPING[2] and guess is before:
            guess = _best_of_step(problem, guess, residuals, normal, damping)
            damping *= 10
        if guess is before:
            break
        damping = max(damping / 100, _DAMPING[1])
        residuals, normal = problem.normal(guess)
    promised = normal.promised(normal.step(_DAMPING[1]))
    found = guess, residuals, covariance(normal), iterations, promised
    return Solution(problem if whole is None else whole, problem, start, *found)


def with_half_step(problem: Problem, guess: Guess, residual: float = 1.0) -> Problem | None:
    """Return the problem with half the step, or None if that hardly changes its residuals.

    The change is compared with `residual` standard deviations. The necessary step depends on the
    machine: Coulomb friction changes its sign within some hundredths of a second. Steps end at
    samples, so that dense samples already shorten them.
    """
    delay, longest = float(guess.values[DELAY]), problem.longest_step
    steps = [plan_steps(one, delay, longest) for one in problem.segments]
    halved = replace(problem, longest_step=max(float(one.h.max()) for one in steps) / 2)
    if halved.longest_step < _SHORTEST_STEP:
        return None
    coarse, fine = (one.residuals(guess).measured for one in (problem, halved))
    return halved if np.sqrt(np.mean((coarse - fine) ** 2)) > _STEP_ERROR * residual else None


def _best_of_step(
    problem: Problem, guess: Guess, residuals: Residuals, normal: Normal, damping: float
) -> Guess:
    """Return the best guess along a step and its corrections; the same one if none is better."""
    best, least = guess, residuals.chi2
    change = normal.step(damping)
    enough = residuals.chi2 - normal.promised(change) / 2
    for _ in range(1 + _CORRECTED):
        trial = _moved(guess, change, problem.unknowns.free)
        tried = problem.residuals(trial)
        if tried.chi2 < least:
            best, least = trial, tried.chi2
        if least <= enough or not np.isfinite(tried.chi2):
            break
        more = normal.with_residuals(tried).step(damping, change)
        change = Change(change.unknown + more.unknown, change.first + more.first)
    return best


def _moved(guess: Guess, change: Change, free: NDArray[np.intp]) -> Guess:
    values, before = guess.values.copy(), guess.values[DELAY]
    values[free] += change.unknown
    values[DELAY] = np.clip(
        values[DELAY], max(0.0, before - MAX_DELAY_CHANGE), before + MAX_DELAY_CHANGE
    )
    return Guess(values, guess.first + change.first)


def covariance(normal: Normal) -> Array:
    """Return the covariance (k, k) of the free unknowns, for any first states."""
    N_ip, N_ii = normal.of_first
    information = normal.joined[0]
    information = information - (N_ip.transpose(0, 2, 1) @ np.linalg.solve(N_ii, N_ip)).sum(0)
    scale = np.sqrt(1 / normal.of_prior)  # prior standard deviations
    found: Array = scale[:, None] * np.linalg.inv(scale[:, None] * information * scale) * scale
    return (found + found.T) / 2


def chi2_per_value(residuals: Residuals, problem: Problem) -> dict[str, float]:
    """Return chi^2 / n by kind of measurement, of the prior, and of all ("all").

    Each fitted first state takes twelve degrees of freedom, in equal shares of all values. The
    prior's terms make up for the unknowns.
    """
    there = problem.there
    fitted = NUM_STATE * len(problem.segments)
    share = 1 - fitted / there.sum()
    found = {
        name: float(np.sum(residuals.measured[:, :, kind] ** 2) / (share * there[:, :, kind].sum()))
        for name, kind in KINDS.items()
        if there[:, :, kind].any()
    }
    found["prior"] = float(np.mean(residuals.prior**2))
    found["all"] = float(residuals.chi2 / (there.sum() - fitted))
    return found
