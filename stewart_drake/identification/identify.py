"""Identification of a machine from its logs: all steps, and the result."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import progress, short_logs, start
from stewart_drake.identification.fit import (
    UNEXPLAINED,
    Guess,
    Problem,
    Solution,
    chi2_per_value,
    nearest_half,
    solve,
    with_half_step,
    without_diverged,
)
from stewart_drake.identification.judgement import PoseUncertainty, pose_uncertainty, unseen
from stewart_drake.identification.logs import ANGLES, Log
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

WRONG: Final = 1.5  # chi^2 per value above which a fit is wrong and its intervals have no meaning
USUAL_DELAY: Final = 0.1  # believed delay without any other information, s
_FEW: Final = 15  # iterations over the segments that are fitted first
_COARSE: Final = 0.1  # error of the coarse delay, s
_SHORT: Final = 0.2  # share of a segment's length that is tried last


@dataclass(frozen=True)
class Identification:
    """Machine identified from logs."""

    logs: Sequence[Log]  # of the machine
    unknowns: Unknowns  # before the logs
    fit: Solution
    middle: Array  # median of the measured poses (6,)

    @cached_property
    def chi2(self) -> dict[str, float]:
        """chi^2 per value: by kind of measurement, of the prior, and of all."""
        return chi2_per_value(self.fit.residuals, self.fit.problem)

    @property
    def right(self) -> bool:
        """Whether the fit explains the logs, so that its intervals mean something."""
        return self.chi2["all"] <= WRONG

    @cached_property
    def values(self) -> Array:
        """Values found, with friction not below zero."""
        found = self.fit.guess.values.copy()
        found[[*ONE_SIDED]] = np.maximum(0.0, found[[*ONE_SIDED]])
        return found

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all unknowns, 0 for known ones; of the prior if the fit is wrong."""
        if not self.right:
            return np.diag(self.unknowns.std**2)
        return self.unknowns.whole(self.fit.covariance)

    @property
    def std(self) -> Array:
        found: Array = np.sqrt(np.diag(self.covariance))
        return found

    @property
    def mechanism(self) -> Mechanism:
        """Machine found; as drawn if the fit is wrong."""
        return self.unknowns.machine(self.values if self.right else self.unknowns.mean)

    def calibration(self, mechanism: Mechanism) -> Calibration:
        """Return all values for a controller but the geometry, for the mechanism as read from file.

        If the fit is wrong, that is the delay alone, as uncertain as before.
        """
        places = np.r_[DYNAMIC, OFFSETS, DELAY] if self.right else np.array([DELAY])
        names = tuple(NAMES[k] for k in places)
        P = self.covariance[np.ix_(places, places)]
        return Calibration(fingerprint(mechanism), names, self.values[places], P)

    @cached_property
    def unseen(self) -> tuple[int, list[str]]:
        """Number and names of the directions that the logs do not show."""
        return unseen(self.unknowns, self.fit.covariance)

    @cached_property
    def pose_uncertainty(self) -> PoseUncertainty | None:
        """Accuracy over the workspace; None if the fit is wrong or `middle` is out of reach."""
        if not self.right:
            return None
        return pose_uncertainty(self.unknowns, self.values, self.fit.covariance, self.middle)

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`; intervals are null if the fit is wrong."""
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
            "segments": len(self.fit.problem.segments),
            "left_out": self.fit.left_out,
            "iterations": self.fit.iterations,
        }


def identify(
    logs: Sequence[Log],
    mechanism: Mechanism,
    tolerances: Tolerances | None = None,
    delay: float | None = None,
) -> Identification:
    """Return the machine that explains its logs best.

    The mechanism is as drawn; the believed delay in s is by default that of the first log.
    """
    if len({log.gravity for log in logs}) > 1:
        raise ConfigError(
            "LOG: got logs with gravity and without; expected one machine in one place"
        )
    tolerances = Tolerances() if tolerances is None else tolerances
    delays = (delay, *(log.delay for log in logs), USUAL_DELAY)
    believed = next(one for one in delays if one is not None)
    pairs = [(log, start.measured_poses(log, mechanism)) for log in logs]
    unknowns = _unknowns(pairs, mechanism, tolerances, believed)
    middle = np.nanmedian(np.vstack([poses for _, poses in pairs]), axis=0)
    lasting = max(float(log.times[-1] - log.times[0]) for log in logs)
    if tolerances.delay > 0 and lasting < short_logs.length_needed(unknowns):
        return Identification(logs, unknowns, short_logs.fit_short(pairs, unknowns, WRONG), middle)
    starts = [(believed, 1.0)]
    if tolerances.delay > 0:
        longest = max(pairs, key=lambda pair: len(pair[0].times))
        coarse = start.coarse_delay(*longest, mechanism, believed, tolerances.delay)
        # Long trajectories lead nowhere after a loss of the plate; and the coarse delay may err.
        starts = [(coarse, 1.0), (coarse, 0.5), (believed, 0.5), (coarse, _SHORT)]
    tried = list[_Begun]()
    for number, (first_delay, share) in enumerate(starts, start=1):
        progress.phase(f"start {number} of at most {len(starts)}")
        begun = _begin(unknowns.at_delay(first_delay), share, pairs, unknowns)
        if share == _SHORT:  # a wrong drawing explains short segments, too
            begun = _begin(begun.guess.values, 1.0, pairs, unknowns)
        tried.append(begun)
        if begun.chi2 <= WRONG and (found := _grown(begun)).chi2 <= WRONG:
            break
    else:
        found = _grown(min(tried, key=lambda one: one.chi2))
    progress.phase("shorter steps")
    while (halved := with_half_step(found.problem, found.guess)) is not None:
        found = found.refitted(halved)
    return Identification(logs, unknowns, found, middle)


class _Begun(NamedTuple):
    chi2: float  # per value of the segments that were fitted first
    whole: Problem
    guess: Guess  # values found, and the measured first states of all segments


def _begin(values: Array, share: float, pairs: Sequence[start.Pair], unknowns: Unknowns) -> _Begun:
    """Fit the nearest segments, from values of the unknowns, with a share of the usual length."""
    late = _COARSE if unknowns.std[DELAY] > 0 else 0.0
    whole, first = start.problem_of(pairs, unknowns, values, late, share=share)
    problem, guess = without_diverged(whole, first)
    if not problem.segments:
        return _Begun(np.inf, whole, first)
    near, guess = nearest_half(problem, guess)
    fit = solve(near, guess, _FEW)
    return _Begun(fit.chi2, whole, Guess(fit.guess.values, first.first))


def _grown(begun: _Begun) -> Solution:
    """Return the fit of all segments, without those that nothing fits.

    If the nearest segments are explained and all of them are not, a trajectory may have diverged,
    such as the last before a plate was lost. Such segments are left out, as long as more than the
    nearest remain.
    """
    progress.phase("whole log")
    problem, guess = without_diverged(begun.whole, begun.guess)
    if not problem.segments:
        raise ConfigError(
            "LOG: got no stretch that the mechanism could have moved through under these torques; "
            "expected a log of this machine, torques in N m as they were commanded"
        )
    if begun.chi2 > WRONG:
        return solve(problem, guess, whole=begun.whole)
    fewest = len(problem.segments) // 2 + 1
    found = solve(problem, guess, _FEW, begun.whole)
    while found.chi2 > WRONG and len(found.problem.segments) > fewest:
        if found.misfit.max() < UNEXPLAINED:
            break
        found = found.without_worst(_FEW)
    return found if found.iterations < _FEW else found.refitted(found.problem)


def _unknowns(
    pairs: Sequence[start.Pair], mechanism: Mechanism, tolerances: Tolerances, believed: float
) -> Unknowns:
    """Return the prior, with the largest torque and the largest crank speed of the logs."""
    speeds = []
    for log, poses in pairs:
        known = np.isfinite(poses).all(axis=1)
        J = mechanism.jacobian(np.median(poses[known], axis=0))
        turns, spans = np.diff(poses[known] @ J.T, axis=0), np.diff(log.times[known])
        speeds.append(float(np.abs(turns / spans[:, None]).max()))
    if not max(speeds) > 0:
        raise ConfigError("LOG: got a plate that does not move; expected one that does")
    torque = max(float(np.abs(log.torques).max()) for log, _ in pairs)
    unknowns = unknowns_of(mechanism, tolerances, believed, torque, max(speeds))
    has_encoders = any(log.measures(ANGLES) for log, _ in pairs)
    return unknowns if has_encoders else unknowns.without(OFFSETS)
