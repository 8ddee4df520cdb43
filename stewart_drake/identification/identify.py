"""Identification of a machine from its logs: all steps, and the result."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.identification import short_logs, start
from stewart_drake.identification.fit import (
    ASTRAY,
    Fit,
    Guess,
    Problem,
    Solution,
    chi2_per_value,
    finer,
    followed,
    nearest,
    solve,
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
"""chi^2 per value above which a fit is wrong and its intervals have no meaning."""
USUAL_DELAY: Final = 0.1
"""Believed delay without any other information, s."""
_FEW: Final = 15
"""Number of iterations over the segments that are fitted first."""
_COARSE: Final = 0.1
"""Error of the coarse delay, s."""


@dataclass(frozen=True)
class Identification:
    """Machine identified from logs.

    Attributes:
        logs: of the machine.
        unknowns: before the logs.
        solution: the fit.
        middle: median of the measured poses (6,).
    """

    logs: Sequence[Log]
    unknowns: Unknowns
    solution: Solution
    middle: Array

    @property
    def problem(self) -> Problem:
        return self.solution.problem

    @property
    def fit(self) -> Fit:
        return self.solution.fit

    @cached_property
    def chi2(self) -> dict[str, float]:
        """chi^2 per value: by kind of measurement, of the prior, and of all."""
        return chi2_per_value(self.fit.residuals, self.problem)

    @property
    def right(self) -> bool:
        """Whether the fit explains the logs, so that its intervals mean something."""
        return self.chi2["all"] <= WRONG

    @cached_property
    def values(self) -> Array:
        """Values found, with friction not below zero."""
        found = self.fit.guess.values.copy()
        for place in ONE_SIDED:
            found[place] = max(0.0, found[place])
        return found

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all unknowns, 0 for known ones; of the prior if the fit is wrong."""
        unknowns = self.unknowns
        if not self.right:
            return np.diag(unknowns.std**2)
        return unknowns.whole(self.fit.covariance)

    @property
    def std(self) -> Array:
        """Standard deviations of all unknowns."""
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
        return Calibration(
            fingerprint(mechanism),
            tuple(NAMES[k] for k in places),
            self.values[places],
            self.covariance[np.ix_(places, places)],
        )

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
            "segments": len(self.problem.segments),
            "left_out": self.solution.left_out,
            "iterations": self.fit.iterations,
        }


def identify(
    logs: Sequence[Log],
    mechanism: Mechanism,
    tolerances: Tolerances | None = None,
    delay: float | None = None,
) -> Identification:
    """Return the machine that explains the logs best.

    Args:
        logs: of one machine.
        mechanism: as drawn.
        tolerances: of the drawing, the defaults if None.
        delay: believed one, s; None is that of the first log.

    Raises:
        ConfigError: one line; a log does not suit the mechanism or is too short.
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
        return Identification(logs, unknowns, short, middle)
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
    found = _grown(min(tried, key=lambda one: one.chi2))
    while (halved := finer(found.problem, found.fit.guess)) is not None:
        found = found.refitted(halved)
    return Identification(logs, unknowns, found, middle)


class _Begun(NamedTuple):
    """Result of a start."""

    chi2: float
    """Per value of the segments that were fitted first."""
    whole: Problem
    guess: Guess
    """Values found, and the measured first states of all segments."""


def _begin(
    delay: float,
    share: float,
    logs: Sequence[Log],
    poses: Sequence[Array],
    unknowns: Unknowns,
) -> _Begun:
    """Fit the nearest segments, from a delay in s, with a share of the usual length."""
    segments, states, values = list[Segment](), list[Array](), unknowns.mean.copy()
    late = _COARSE if unknowns.std[DELAY] > 0 else 0.0
    for log, own in zip(logs, poses, strict=True):
        parts = start.segments_and_states(log, own, unknowns.mechanism, delay, late, share)
        segments += parts[0]
        states += parts[1]
    first, values[DELAY] = np.array(states), delay
    whole = Problem(segments, unknowns)
    problem, guess = followed(whole, Guess(values, first))
    if not problem.segments:
        return _Begun(np.inf, whole, Guess(values, first))
    near, guess = nearest(problem, guess)
    fit = solve(near, guess, _FEW)
    chi2 = chi2_per_value(fit.residuals, near)["all"]
    return _Begun(chi2, whole, Guess(fit.guess.values, first))


def _grown(begun: _Begun) -> Solution:
    """Return the fit of all segments, without those that nothing fits.

    If the nearest segments are explained and all of them are not, a trajectory may have gone
    astray, such as the last before a plate was lost. Such segments are left out, as long as more
    than the nearest remain.
    """
    problem, guess = followed(begun.whole, begun.guess)
    if not problem.segments:
        raise ConfigError(
            "LOG: got no stretch that the mechanism could have moved through under these torques; "
            "expected a log of this machine, torques in N m as they were commanded"
        )
    if begun.chi2 > WRONG:
        return Solution(begun.whole, problem, guess, solve(problem, guess))
    fewest = len(problem.segments) // 2 + 1
    found = Solution(begun.whole, problem, guess, solve(problem, guess, _FEW))
    while found.chi2 > WRONG and len(found.problem.segments) > fewest:
        if found.misfit.max() < ASTRAY:
            break
        found = found.without_worst(_FEW)
    return found if found.fit.iterations < _FEW else found.refitted(found.problem)


def _unknowns(
    logs: Sequence[Log],
    poses: Sequence[Array],
    mechanism: Mechanism,
    tolerances: Tolerances,
    believed: float,
) -> Unknowns:
    """Return the prior, with the largest torque and the largest crank speed of the logs."""
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
