"""Fit of logs that are too short for `identification.start.coarse_delay`, by a scan over delays.

At each delay of a grid, a machine as drawn is fitted to short segments by a few iterations. From
the best of these the machine with free geometry is fitted to segments of full length.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Final

import numpy as np

from stewart_drake.dynamics.workspace import margin, margins
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import progress
from stewart_drake.identification.fit import (
    MOST_ITERATIONS,
    UNEXPLAINED,
    Solution,
    solve,
    with_half_step,
    without_diverged,
)
from stewart_drake.identification.logs import Log
from stewart_drake.identification.start import Pair, problem_of
from stewart_drake.identification.unknowns import DELAY, GEOMETRY, Unknowns
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

_RESPONSE: Final = 1.0  # s of motion after the longest delay, from which on a log is not short
_ROOM: Final = 0.2  # share of the margin at home below which a pose is too near the edge
_LONG_AGO: Final = 1e3  # s before the first torque of a log
_GRID: Final = 0.05  # s between delays of the scan
_SCANNED: Final = 0.3  # longest segment of the scan, s
_FEW: Final = 4  # iterations of the scan at each delay
_LOST: Final = 1e4  # chi^2 per value of a segment that cannot be followed
_RIVAL: Final = 30.0  # largest chi^2 of a fitted delay over the least one of the scan, or over 1
_STARTS: Final = 3  # largest number of delays that are fitted with free geometry
_APART: Final = 0.01  # least difference of two such delays, s
_LATE: Final = 0.02  # s by which a delay may be longer than at the start of a fit
_STEP: Final = 0.01  # longest integration step at first, s
_MOST: Final = 0.5  # least share of the values after the delay that has to be fitted
_CHANGES: Final = 3  # least number of changes of the torques within the segments
_VAGUE: Final = 1e-3  # largest standard deviation of a delay that is accepted, s


def length_needed(unknowns: Unknowns) -> float:
    """Return the length in s from which on a log is not short."""
    return float(unknowns.mean[DELAY] + 3 * unknowns.std[DELAY] + _RESPONSE)


@np.errstate(all="ignore")
def fit_short(pairs: Sequence[Pair], unknowns: Unknowns, worst: float) -> Solution:
    """Return the fit with the only delay that explains the logs.

    `worst` is the largest chi^2 per value of a fit that explains them. If no delay does, or more
    than one, the ConfigError names the length needed.
    """
    pairs = [_inside(*pair, unknowns.mechanism) for pair in pairs]
    right = list[Solution]()
    scanned = _scanned(pairs, unknowns)
    for number, values in enumerate(scanned, start=1):
        progress.phase(f"candidate {number} of {len(scanned)}")
        with suppress(np.linalg.LinAlgError):  # a trajectory grew beyond all bounds
            one = _grown(pairs, unknowns, values)
            if one and _explains(one, worst) and _is_apart(one, right):
                right.append(one)
    if len(right) == 1 and right[0].delay_std <= _VAGUE:
        return right[0]
    found = " and ".join(f"{one.delay:.3g} s (+-{1e3 * one.delay_std:.2g} ms)" for one in right)
    longest, _ = max(pairs, key=lambda pair: len(pair[0].times))
    lasting, delay = longest.times[-1] - longest.times[0], unknowns.mean[DELAY]
    narrower = ", or a narrower tolerance of the delay" if lasting > delay + _RESPONSE else ""
    raise ConfigError(
        f"{longest.name}: got a log of {lasting:.3g} s, "
        f"{'explained by delays of ' + found if found else 'too short, and explained by no delay'}"
        "; expected one delay, known to "
        f"{1e3 * _VAGUE:g} ms: a log of at least {length_needed(unknowns):.3g} s (the longest "
        f"possible delay and {_RESPONSE:g} s of motion){narrower}. If the plate was lost, add "
        "coulomb to controller.estimate, or log a smaller motion"
    )


def _inside(log: Log, poses: Array, mechanism: Mechanism) -> Pair:
    """Return a log with the torques before it, and without instants near the edge.

    A crank angle has no derivative by the pose at a dead centre. Fits of the last samples before a
    loss end in local minima there.
    """
    least = _ROOM * margin(mechanism, mechanism.home)
    kept = ~(margins(mechanism, poses) < least)
    log = replace(log, times=log.times[kept], values=log.values[kept])
    if log.before is not None:
        sent = np.r_[log.sent[0] - _LONG_AGO, log.sent]
        log = replace(log, sent=sent, torques=np.vstack([log.before, log.torques]))
    return log, poses[kept]


def _scanned(pairs: Sequence[Pair], unknowns: Unknowns) -> list[Array]:
    """Return values of the unknowns at the delays that explain the logs best."""
    as_drawn, found = unknowns.without(GEOMETRY), list[Solution]()
    middle, reach = unknowns.mean[DELAY], 3 * unknowns.std[DELAY]
    delays = np.arange(max(0.0, middle - reach), middle + reach + _GRID / 2, _GRID)
    for number, delay in enumerate(delays, start=1):
        progress.phase(f"delay {number} of {len(delays)}")
        with suppress(np.linalg.LinAlgError):
            one = _fitted(pairs, as_drawn, unknowns.at_delay(float(delay)), _SCANNED, _FEW)
            found += [one] if one else []
    found.sort(key=_cost)
    kept = list[Solution]()
    for one in found:
        if _cost(one) <= _RIVAL * max(1.0, _cost(found[0])) and _is_apart(one, kept):
            kept.append(one)
    return [one.guess.values for one in kept[:_STARTS]]


def _is_apart(one: Solution, others: Sequence[Solution]) -> bool:
    return all(abs(one.delay - other.delay) > _APART for other in others)


def _cost(one: Solution) -> float:
    """Return chi^2 per value of all segments, `_LOST` for those that could not be followed."""
    return one.share * one.chi2 + (1 - one.share) * _LOST


def _explains(one: Solution, worst: float) -> bool:
    """Return whether most values are fitted, with a chi^2 of at most `worst` per value."""
    spans = [(s.log.sent[1:] + one.delay, s) for s in one.problem.segments]
    changes = sum(int(np.sum((t > s.start) & (t < s.log.times[s.rows[-1]]))) for t, s in spans)
    return one.chi2 <= worst and one.share > _MOST and changes >= _CHANGES


def _fitted(
    pairs: Sequence[Pair],
    unknowns: Unknowns,
    values: Array,
    longest: float = np.inf,
    most: int = MOST_ITERATIONS,
) -> Solution | None:
    """Return the fit from a start, with segments of `longest` s; None if none can be followed."""
    whole, guess = problem_of(
        pairs, unknowns, values, _LATE, longest=longest, step=_STEP, skip_short=True
    )
    problem, begun = without_diverged(whole, guess) if whole.segments else (whole, guess)
    if not problem.segments:
        return None
    return solve(problem, begun, most, whole)


def _grown(pairs: Sequence[Pair], unknowns: Unknowns, values: Array) -> Solution | None:
    """Return the fit to segments of full length, with steps that are short enough.

    At most one segment of each log is left out, such as the last before the plate was lost.
    """
    one = _fitted(pairs, unknowns, values)
    if one is None:
        return None
    for _ in pairs:
        if one.chi2 <= UNEXPLAINED or len(one.problem.segments) == 1:
            break
        one = one.without_worst()
    while one.chi2 <= UNEXPLAINED:
        away = max(1.0, float(np.sqrt(np.mean(one.residuals.measured**2))))
        halved = with_half_step(one.problem, one.guess, away)
        if halved is None:
            break
        one = one.refitted(halved)
    return one
