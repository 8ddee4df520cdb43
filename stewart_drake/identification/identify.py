"""From logs to a machine: all steps, and what is told of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import short_logs, start
from stewart_drake.identification.fit import (
    Fit,
    Guess,
    Problem,
    chi2_per_value,
    finer,
    followed,
    misfit,
    nearest,
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
    NAMES,
    OFFSETS,
    ONE_SIDED,
    UNITS,
    Unknowns,
    unknowns_of,
)
from stewart_drake.mechanism.geometry import Mechanism, fingerprint
from stewart_drake.scenario.calibration import Calibration
from stewart_drake.types import Array

WRONG: Final = 1.5
"""chi^2 per value from which on a fit is wrong and its intervals mean nothing."""
USUAL_DELAY: Final = 0.1
"""s, believed where nobody says anything."""
_FEW: Final = 15
"""Iterations over the segments that are looked at first."""
_ASTRAY: Final = 1e3
"""chi^2 per value of a segment that is not explained by any machine like this one; drawings that
are off by a millimetre make some fifty."""
_COARSE: Final = 0.1
"""s by which the delay that is begun with may be off."""


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
        """What was found of the unknowns, friction not below zero."""
        found = self.fit.guess.values.copy()
        for place in ONE_SIDED:
            found[place] = max(0.0, found[place])
        return found

    @cached_property
    def covariance(self) -> Array:
        """Of all unknowns, 0 where they are known; where the fit is wrong what it was before."""
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

    def calibration(self, mechanism: Mechanism) -> Calibration:
        """Return what a controller of this machine may use: all but the geometry.

        Where the fit is wrong that is the delay alone, as uncertain as before.

        Args:
            mechanism: the one that was found, as it was written and read.
        """
        places = np.r_[DYNAMIC, OFFSETS, DELAY] if self.right else np.array([DELAY])
        return Calibration(
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
        """What `summary.json` holds: intervals are null where the fit is wrong."""
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
    for log, own in zip(logs, poses, strict=True):
        start.check_poses(log, own)
    # The longest log has most to say.
    longest = max(range(len(logs)), key=lambda i: len(logs[i].times))
    unknowns = _unknowns(logs, poses, mechanism, tolerances, believed)
    middle = np.nanmedian(np.vstack(poses), axis=0)
    lasting = max(float(log.times[-1] - log.times[0]) for log in logs)
    if tolerances.delay > 0 and lasting < short_logs.length_needed(unknowns):
        short = short_logs.fit_short(logs, poses, unknowns, WRONG)
        return Identification(logs, unknowns, short.problem, short.fit, short.left_out, middle)
    starts = [(believed, 1.0)]
    if tolerances.delay > 0:
        coarse = start.coarse_delay(
            logs[longest], poses[longest], mechanism, believed, tolerances.delay
        )
        # Where the plate was lost, long trajectories lead nowhere; and the coarse delay may err.
        starts = [(coarse, 1.0), (coarse, 0.5), (believed, 0.5)]
    tried = list[_Begun]()
    for delay_at_first, share in starts:
        tried.append(_begin(delay_at_first, share, logs, poses, unknowns))
        if tried[-1].chi2 <= WRONG:
            break
    best = min(tried, key=lambda one: one.chi2)
    whole = best.whole
    problem, fit = _grown(best)
    while (halved := finer(problem, fit.guess)) is not None:
        problem, fit = halved, _solved(halved, fit.guess)
    left_out = len(whole.segments) - len(problem.segments)
    return Identification(logs, unknowns, problem, fit, left_out, middle)


class _Begun(NamedTuple):
    """Where a start leads; chi^2 per value, of the segments that were looked at first."""

    chi2: float
    whole: Problem
    values: Array
    first: Array
    """(n, 12) states of all n segments, as measured."""


def _begin(
    delay: float,
    share: float,
    logs: Sequence[Log],
    poses: Sequence[Array],
    unknowns: Unknowns,
) -> _Begun:
    """A delay in s and segments of a share of their usual length, and what the nearest say."""
    segments, states, values = list[Segment](), list[Array](), unknowns.mean.copy()
    late = _COARSE if unknowns.std[DELAY] > 0 else 0.0
    for log, own in zip(logs, poses, strict=True):
        length = share * start.segment_length(log, own, unknowns.mechanism, delay)
        parts = start.segments_of(log, float(log.sent[0]) + delay + late, length)
        segments += parts
        states += [start.first_state(log, own, int(part.rows[0])) for part in parts]
    first, values[DELAY] = np.array(states), delay
    whole = Problem(segments, unknowns)
    problem, guess = followed(whole, Guess(values, first))
    if not problem.segments:
        return _Begun(np.inf, whole, values, first)
    near, guess = nearest(problem, guess)
    fit = solve(near, guess, _FEW)
    chi2 = chi2_per_value(fit.residuals, near)["all"]
    return _Begun(chi2, whole, fit.guess.values, first)


def _grown(begun: _Begun) -> tuple[Problem, Fit]:
    """The fit of all segments, without those that nothing fits.

    Where the nearest segments are explained, and all of them are not, a trajectory may have gone
    astray, such as the last before a plate was lost. One that is off by more than a machine that
    is not quite this one can make it is left out then, as long as more than the nearest are left.
    """
    problem, guess = followed(begun.whole, Guess(begun.values, begun.first))
    if begun.chi2 > WRONG:
        return problem, _solved(problem, guess)
    fewest = len(problem.segments) // 2 + 1
    fit = solve(problem, guess, _FEW)
    while chi2_per_value(fit.residuals, problem)["all"] > WRONG and len(problem.segments) > fewest:
        off = misfit(fit.residuals, problem)
        if off.max() < _ASTRAY:
            break
        problem, guess = without(problem, guess, int(off.argmax()))
        fit = solve(problem, guess, _FEW)
    return problem, fit if fit.iterations < _FEW else solve(problem, fit.guess)


def _solved(problem: Problem, guess: Guess) -> Fit:
    if not problem.segments:
        raise ConfigError(
            "LOG: got no stretch that the mechanism could have moved through under these torques; "
            "expected a log of this machine, torques in N m as they were commanded"
        )
    return solve(problem, guess)


def _unknowns(
    logs: Sequence[Log],
    poses: Sequence[Array],
    mechanism: Mechanism,
    tolerances: Tolerances,
    believed: float,
) -> Unknowns:
    """With scales of the logs: the largest torque, and the largest speed of a crank."""
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
