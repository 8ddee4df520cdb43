"""Identification of a machine from its logs: all steps and the result."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import start
from stewart_drake.identification.fit import (
    Fit,
    Guess,
    Problem,
    chi2_per_value,
    followed,
    misfit,
    nearest,
    refined,
    solve,
    without,
)
from stewart_drake.identification.judgement import PoseUncertainty, pose_uncertainty, unseen
from stewart_drake.identification.logs import ANGLES, Log
from stewart_drake.identification.shooting import Segment
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.identification.unknowns import (
    DELAY,
    DYNAMIC,
    GEOMETRY,
    NAMES,
    OFFSETS,
    ONE_SIDED,
    UNITS,
    Unknowns,
    unknowns_of,
)
from stewart_drake.mechanism.geometry import Mechanism, fingerprint
from stewart_drake.scenario.known import Known
from stewart_drake.scenario.signals import NUM_STATE

Array = NDArray[np.float64]

WRONG: Final = 1.5
"""chi^2 per value from which on a fit is wrong and its intervals mean nothing."""
ENOUGH_RESPONSE: Final = 1.0
"""s of motion after the torques of a log first change; a shorter log is refused if its delay is
VAGUE."""
VAGUE: Final = 1e-3
"""s, least standard deviation of a delay that was not found well."""
USUAL_DELAY: Final = 0.1
"""Believed delay by default, s."""
_FEW: Final = 15
"""Iterations over the segments that are looked at first."""
_ASTRAY: Final = 1e3
"""chi^2 per value of a segment that is not explained by any machine like this one; drawings that
are off by a millimetre make some fifty."""
_COARSE: Final = 0.1
"""s by which the delay that is begun with may be off,"""
_NEAR: Final = 0.02
"""s, alike where a scan found it."""
_GRID: Final = 0.1
"""s between delays of the scan."""
_SCANNED: Final = 0.3
"""s of a segment of the scan, at most."""
_MOST_SCANNED: Final = 12
"""Segments of the scan."""
_FEW_SCANNED: Final = 4
"""Iterations of the scan at each delay."""
_RIVAL: Final = 30.0
"""Times the least chi^2 of the scan, at most, where another delay is tried too."""
_STARTS: Final = 3
"""Delays of the scan that are begun with."""


@dataclass(frozen=True)
class Identification:
    """A machine as its logs tell it.

    Attributes:
        logs: that were read.
        unknowns: what was known before.
        problem, fit: what was solved, and how it came out.
        left_out: stretches of the logs in which no trajectory could be followed.
        middle: pose (6,) in the middle of what was measured.
    """

    logs: Sequence[Log]
    unknowns: Unknowns
    problem: Problem
    fit: Fit
    left_out: int
    middle: Array

    @cached_property
    def chi2(self) -> dict[str, float]:
        """Per value: by kind of measurement, of the prior, and of all."""
        return chi2_per_value(self.fit.residuals, self.problem)

    @property
    def right(self) -> bool:
        """Whether the fit explains the logs, so that its intervals mean something."""
        return self.chi2["all"] <= WRONG

    @cached_property
    def values(self) -> Array:
        """Values found, friction not below zero."""
        found = self.fit.guess.values.copy()
        for place in ONE_SIDED:
            found[place] = max(0.0, found[place])
        return found

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all unknowns, 0 where known; the prior's where the fit is wrong."""
        unknowns = self.unknowns
        if not self.right:
            return np.diag(unknowns.std**2)
        whole = np.zeros((len(unknowns.mean), len(unknowns.mean)))
        whole[np.ix_(unknowns.free, unknowns.free)] = self.fit.covariance
        return whole

    @property
    def std(self) -> Array:
        """Standard deviations of all unknowns."""
        found: Array = np.sqrt(np.diag(self.covariance))
        return found

    @property
    def mechanism(self) -> Mechanism:
        """The machine that was found; as it was drawn where the fit is wrong."""
        return self.unknowns.machine(self.values if self.right else self.unknowns.mean)

    def known(self, mechanism: Mechanism) -> Known:
        """Return what a controller of this machine may use: all but the geometry.

        Where the fit is wrong that is the delay alone, as uncertain as before.

        Args:
            mechanism: the one that was found, as it was written and read.
        """
        places = np.r_[DYNAMIC, OFFSETS, DELAY] if self.right else np.array([DELAY])
        return Known(
            fingerprint(mechanism),
            tuple(NAMES[k] for k in places),
            self.values[places],
            self.covariance[np.ix_(places, places)],
        )

    @cached_property
    def unseen(self) -> tuple[int, list[str]]:
        """How many directions the logs do not see, and what they are."""
        return unseen(self.unknowns, self.fit.covariance)

    @cached_property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Over the workspace; None if the fit is wrong or `middle` is out of reach."""
        if not self.right:
            return None
        return pose_uncertainty(self.unknowns, self.values, self.fit.covariance, self.middle)

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`; intervals are null where the fit is wrong."""
        std = self.std if self.right else np.full(len(self.values), np.nan)
        poses = self.pose_uncertainty
        return {
            "logs": [log.name for log in self.logs],
            "mechanism": self.unknowns.mechanism.name,
            "delay_s": float(self.values[DELAY]),
            "delay_std_s": float(std[DELAY]),
            "chi2": self.chi2,
            "intervals": self.right,
            "parameters": {
                NAMES[k]: {
                    "value": float(self.values[k]),
                    "std": float(std[k]),
                    "unit": UNITS[k],
                    "before": float(self.unknowns.mean[k]),
                    "before_std": float(self.unknowns.std[k]),
                }
                for k in self.unknowns.free
            },
            "pose_uncertainty": None if poses is None else poses.summary,
            "unseen": {"directions": self.unseen[0], "names": self.unseen[1]},
            "segments": len(self.problem.segments),
            "left_out": self.left_out,
            "iterations": self.fit.iterations,
        }


def identify(
    logs: Sequence[Log],
    mechanism: Mechanism,
    tolerances: Tolerances | None = None,
    delay: float | None = None,
) -> Identification:
    """The machine that explains logs best.

    Args:
        logs: of one machine.
        mechanism: as drawn.
        tolerances: how far off it may be, the defaults if None.
        delay: that is believed in, s; None is what the first log believed.

    Raises:
        ConfigError: one line; a log that does not suit the mechanism or is too short.
    """
    if len({log.gravity for log in logs}) > 1:
        raise ConfigError(
            "LOG: got logs with gravity and without; expected one machine, as it stands"
        )
    tolerances = Tolerances() if tolerances is None else tolerances
    told = [log.delay for log in logs if log.delay is not None]
    believed = delay if delay is not None else told[0] if told else USUAL_DELAY
    poses = [start.measured_poses(log, mechanism) for log in logs]
    inside = [start.well_inside(*pair, mechanism) for pair in zip(logs, poses, strict=True)]
    logs, poses = [log for log, _ in inside], [own for _, own in inside]
    for log, own in zip(logs, poses, strict=True):
        start.check_poses(log, own)
    unknowns = _unknowns(logs, poses, mechanism, tolerances, believed)
    best = min(_tried(logs, poses, unknowns), key=lambda one: one.rank)
    problem, fit = refined(best.problem, best.fit)
    middle = np.nanmedian(np.vstack(poses), axis=0)
    found = Identification(logs, unknowns, problem, fit, best.left_out, middle)
    if tolerances.delay > 0:
        _check_response(found)
    return found


def _check_response(found: Identification) -> None:
    """Refuse logs that end too soon after their torques first change to show the delay.

    Raises:
        ConfigError: names the length that is missing.
    """
    delay, std = found.values[DELAY], found.std[DELAY]
    lasted = [float(log.times[-1] - max(log.times[0], log.sent[1] + delay)) for log in found.logs]
    longest = int(np.argmax(lasted))
    if lasted[longest] >= ENOUGH_RESPONSE or std <= VAGUE:
        return
    raise ConfigError(
        f"{found.logs[longest].name}: got {max(0.0, lasted[longest]):.2g} s of motion after the "
        f"torques first changed, at the likeliest delay of {delay:.2g} s; expected at least "
        f"{ENOUGH_RESPONSE:g} s to find the delay to {1e3 * VAGUE:g} ms, or an earlier row with "
        "the torques that acted before"
    )


class _Start(NamedTuple):
    """Where iterations begin."""

    values: Array
    """(NUM_UNKNOWNS,)."""
    share: float
    """Length of the segments as a share of the usual one."""
    late: float
    """s by which the delay may be longer."""


class _Tried(NamedTuple):
    """Result from one start."""

    problem: Problem
    fit: Fit
    left_out: int

    @property
    def misfit(self) -> float:
        """chi^2 per value."""
        return chi2_per_value(self.fit.residuals, self.problem)["all"]

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of preference: an explanation of the logs before none, then the better one."""
        if self.misfit > WRONG:
            return True, self.misfit
        return False, self.delay_std

    @property
    def delay_std(self) -> float:
        """Standard deviation of the delay, s; 0 where it is known."""
        place = np.flatnonzero(self.problem.unknowns.free == DELAY)
        return float(np.sqrt(np.diag(self.fit.covariance)[place].sum()))


def _tried(logs: Sequence[Log], poses: Sequence[Array], unknowns: Unknowns) -> list[_Tried]:
    """Return the results from several starts, up to the first that explains the logs."""
    tried = list[_Tried]()
    for one in _starts(logs, poses, unknowns):
        begun = _begin(one, logs, poses, unknowns)
        grown = _grown(begun)
        if grown is None:
            continue
        problem, fit = grown
        tried.append(_Tried(problem, fit, len(begun.whole.segments) - len(problem.segments)))
        if tried[-1].misfit <= WRONG and tried[-1].delay_std <= VAGUE:
            break
    if not tried:
        raise ConfigError(
            "LOG: got no stretch that the mechanism could have moved through under these torques; "
            "expected a log of this machine, torques in N m as they were commanded"
        )
    return tried


def _starts(logs: Sequence[Log], poses: Sequence[Array], unknowns: Unknowns) -> Iterator[_Start]:
    """Yield starts, the most promising first."""
    believed, std = unknowns.mean[DELAY], unknowns.std[DELAY]
    if std == 0:
        yield _Start(unknowns.mean, 1.0, 0.0)
        return
    longest = max(range(len(logs)), key=lambda i: len(logs[i].times))
    log, own = logs[longest], poses[longest]
    coarse = start.coarse_delay(log, own, unknowns.mechanism, believed, std)
    if coarse is not None:
        values = unknowns.mean.copy()
        values[DELAY] = coarse
        # Where the plate was lost, long trajectories lead nowhere; and the coarse delay may err.
        yield _Start(values, 1.0, _COARSE)
        yield _Start(values, 0.5, _COARSE)
    for values in scanned(log, own, unknowns):
        yield _Start(values, 1.0, _NEAR)
        yield _Start(values, 0.25, _NEAR)


def scanned(log: Log, poses: Array, unknowns: Unknowns) -> list[Array]:
    """Return values of the unknowns with the delays that explain the end of a log best.

    The machine is as drawn here, so that one delay of the grid takes some tenths of a second. Of
    delays that explain the log equally well the shortest comes first: it explains most of it.

    Raises:
        ConfigError: the log is too short, or no torque of it shows in the motion.
    """
    believed, std = unknowns.mean[DELAY], unknowns.std[DELAY]
    found = list[_Scanned]()
    for delay in np.arange(max(0.0, believed - 3 * std), believed + 3 * std, _GRID):
        try:
            found += _scan(log, poses, unknowns, delay, float(log.sent[0]) + delay + _NEAR)
        except ConfigError:
            if not found:
                raise
            break  # nothing is left after longer delays either
    if not found:
        return []
    least = min(one.chi2 for one in found)
    _check_torques_show(log, poses, unknowns, least)
    alike = [one for one in found if one.chi2 <= least * (1 + one.spread)]
    best = min(alike, key=lambda one: float(one.values[DELAY]))
    rivals = [one for one in found if one is not best and one.chi2 <= _RIVAL * least]
    rivals.sort(key=lambda one: one.chi2)
    return [one.values for one in (best, *rivals)][:_STARTS]


def _check_torques_show(log: Log, poses: Array, unknowns: Unknowns, least: float) -> None:
    """Refuse a log that a machine explains on which no change of the torques ever acts.

    Args:
        log: with poses (n, 6).
        poses: of its instants.
        unknowns: before the log.
        least: chi^2 per value with the best delay.

    Raises:
        ConfigError: names the length that is missing.
    """
    lasted, std = float(log.times[-1] - log.sent[1]), unknowns.std.copy()
    std[DELAY] = 0.0
    known = replace(unknowns, std=std)
    for still in _scan(log, poses, known, lasted + 1.0, float(log.times[0]), _FEW):
        if still.chi2 <= max(1.0, least) * (1 + still.spread):
            raise ConfigError(
                f"{log.name}: got {lasted:.2g} s of motion from the first change of the torques "
                "on, and none of them shows in it; expected a log that goes on for at least "
                f"{ENOUGH_RESPONSE:g} s after they act"
            )


class _Scanned(NamedTuple):
    """Result of the scan at one delay."""

    chi2: float
    """Per value."""
    spread: float
    """Four relative standard deviations of chi2."""
    values: Array


def _scan(
    log: Log,
    poses: Array,
    unknowns: Unknowns,
    delay: float,
    begin: float,
    most: int = _FEW_SCANNED,
) -> list[_Scanned]:
    """Fit a machine as drawn to the end of a log from a delay on; empty where none moves so."""
    std, values = unknowns.std.copy(), unknowns.mean.copy()
    std[GEOMETRY], values[DELAY] = 0.0, delay
    length = min(_SCANNED, start.segment_length(log, poses, unknowns.mechanism, delay))
    segments = start.segments_of(log, begin, length)[-_MOST_SCANNED:]
    first = [start.first_state(log, poses, int(one.rows[0])) for one in segments]
    whole = Problem(segments, replace(unknowns, std=std))
    problem, guess = followed(whole, Guess(values, np.array(first)))
    if not problem.segments:
        return []
    fit = solve(problem, guess, most)
    spread = 4 * np.sqrt(2 / (problem.count - NUM_STATE * len(problem.segments)))
    chi2 = chi2_per_value(fit.residuals, problem)["all"]
    return [_Scanned(chi2, spread, fit.guess.values)]


class _Begun(NamedTuple):
    """Fit of the first segments from one start, with its chi^2 per value."""

    chi2: float
    whole: Problem
    values: Array
    first: Array
    """(n, 12) states of all n segments, as measured."""


def _begin(one: _Start, logs: Sequence[Log], poses: Sequence[Array], unknowns: Unknowns) -> _Begun:
    """Fit the segments that are nearest to the logs at a start."""
    segments, states, values = list[Segment](), list[Array](), one.values
    delay = float(values[DELAY])
    for log, own in zip(logs, poses, strict=True):
        length = one.share * start.segment_length(log, own, unknowns.mechanism, delay)
        parts = start.segments_of(log, float(log.sent[0]) + delay + one.late, length)
        segments += parts
        states += [start.first_state(log, own, int(part.rows[0])) for part in parts]
    first = np.array(states)
    whole = Problem(segments, unknowns)
    problem, guess = followed(whole, Guess(values, first))
    if not problem.segments:
        return _Begun(np.inf, whole, values, first)
    near, guess = nearest(problem, guess)
    near, fit = refined(near, solve(near, guess, _FEW), _FEW)
    whole = replace(whole, longest_step=near.longest_step)
    chi2 = chi2_per_value(fit.residuals, near)["all"]
    return _Begun(chi2, whole, fit.guess.values, first)


def _grown(begun: _Begun) -> tuple[Problem, Fit] | None:
    """The fit of all segments, without those that nothing fits.

    Where the nearest segments are explained, and all of them are not, a trajectory may have gone
    astray, such as the last before a plate was lost. One that is off by more than a machine that
    is not quite this one can make it is left out then, as long as more than the nearest are left.
    """
    problem, guess = followed(begun.whole, Guess(begun.values, begun.first))
    if not problem.segments:
        return None
    if begun.chi2 > WRONG:
        return refined(problem, solve(problem, guess), _FEW)
    fewest = len(problem.segments) // 2 + 1
    problem, fit = refined(problem, solve(problem, guess, _FEW), _FEW)
    while chi2_per_value(fit.residuals, problem)["all"] > WRONG and len(problem.segments) > fewest:
        off = misfit(fit.residuals, problem)
        if off.max() < _ASTRAY:
            break
        problem, guess = without(problem, fit.guess, int(off.argmax()))
        problem, fit = refined(problem, solve(problem, guess, _FEW), _FEW)
    return problem, fit if fit.iterations < _FEW else solve(problem, fit.guess)


def _unknowns(
    logs: Sequence[Log],
    poses: Sequence[Array],
    mechanism: Mechanism,
    tolerances: Tolerances,
    believed: float,
) -> Unknowns:
    """Return the unknowns, scaled by the largest torque and crank speed of the logs."""
    speeds = []
    for log, own in zip(logs, poses, strict=True):
        known = np.isfinite(own).all(axis=1)
        J = mechanism.jacobian(np.median(own[known], axis=0))
        turned = own[known] @ J.T
        spans = np.diff(log.times[known])
        speeds.append(np.abs(np.diff(turned, axis=0) / spans[:, None]).max())
    if not max(speeds) > 0:
        raise ConfigError("LOG: got a plate that does not move; expected one that does")
    torque = max(float(np.abs(log.torques).max()) for log in logs)
    unknowns = unknowns_of(mechanism, tolerances, believed, torque, float(max(speeds)))
    if not any(log.measures(ANGLES) for log in logs):
        unknowns = unknowns.without_encoders()
    return unknowns
