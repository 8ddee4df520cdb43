"""Identification of a machine from its logs: all steps, and the result.

A fit predicts the motion in segments of the logs. Its start needs a delay that is nearly right, so
`identify` tries several delays and lengths of segments. For each it first fits the half of the
segments that the start predicts best, then all of them, and takes the first fit that is not wrong.
If all are far from it, it fits the beginning of the logs: their ends may tremble or be lost.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
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
from stewart_drake.identification.logs import ANGLES, POSE, Log
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
from stewart_drake.mechanism.kinematics import SingularPoseError, UnreachablePoseError
from stewart_drake.scenario.calibration import Calibration
from stewart_drake.scenario.signals import BIAS, COULOMB, DAMPING, PAYLOAD, PAYLOAD_POSITION
from stewart_drake.types import Array

WRONG: Final = 1.5  # chi^2 per value above which a fit is wrong and its intervals have no meaning
USUAL_DELAY: Final = 0.1  # believed delay without any other information, s
_FIRST_STEP: Final = 0.02  # longest integration step of the first fit, s
_FIRST_ITERATIONS: Final = 15  # largest number of iterations of a first fit
_COARSE_ERROR: Final = 0.1  # error of the coarse delay, s
_SHORT_SHARE: Final = 0.2  # length of the segments that are tried last, by the usual length


@dataclass(frozen=True)
class Identification:
    logs: Sequence[Log]  # of the machine
    unknowns: Unknowns  # prior
    fit: Solution
    middle: Array  # (6,) median of the measured poses, rad and m
    ends: Sequence[float]  # of the logs in s, before their ends were left out

    @cached_property
    def chi2(self) -> dict[str, float]:
        """chi^2 per value: by kind of measurement, of the prior, and of all."""
        return chi2_per_value(self.fit.residuals, self.fit.problem)

    @property
    def right(self) -> bool:
        """Whether the fit explains the logs; otherwise its intervals have no meaning."""
        return self.chi2["all"] <= WRONG

    @cached_property
    def values(self) -> Array:
        """Estimated values; a negative friction is 0."""
        found = self.fit.guess.values.copy()
        found[[*ONE_SIDED]] = np.maximum(0.0, found[[*ONE_SIDED]])
        return found

    @cached_property
    def covariance(self) -> Array:
        """Covariance of all unknowns, 0 for known ones; of the prior if the fit is wrong.

        The steps of a multibody plant shift the delay, by up to one step. It is added to the
        standard deviation of the delay.
        """
        if not self.right:
            return np.diag(self.unknowns.std**2)
        found = self.unknowns.whole(self.fit.covariance)
        if self.unknowns.std[DELAY] > 0:
            found[DELAY, DELAY] += max(log.step for log in self.logs) ** 2
        return found

    @property
    def std(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    @property
    def mechanism(self) -> Mechanism:
        """Estimated machine; the drawing's if the fit is wrong."""
        return self.unknowns.machine(self.values if self.right else self.unknowns.mean)

    def calibration(self, mechanism: Mechanism) -> Calibration:
        """Return the values that a controller reads besides the geometry.

        If the fit is wrong, that is the delay alone, with its prior variance. `mechanism` is as
        read from its file.
        """
        places = np.r_[DYNAMIC, OFFSETS, DELAY] if self.right else np.array([DELAY])
        names = tuple(NAMES[k] for k in places)
        P = self.covariance[np.ix_(places, places)]
        return Calibration(fingerprint(mechanism), names, self.values[places], P)

    @property
    def plant(self) -> dict[str, float | list[float]]:
        """Fields of a scenario's plant that is like the machine."""
        value = [float(f"{x:.6g}") for x in self.values[DYNAMIC]]
        return {
            "torque_bias": value[BIAS],
            "payload_mass": max(value[PAYLOAD], 0.0),
            "payload_position": value[PAYLOAD_POSITION],
            "joint_damping": max(value[DAMPING], 0.0),
            "coulomb_friction": max(value[COULOMB], 0.0),
        }

    @property
    def sensor(self) -> dict[str, str | list[float]] | None:
        """Fields of a scenario's sensor that is like the machine's; None without found offsets."""
        if any(log.measures(POSE) for log in self.logs) or not self.unknowns.std[OFFSETS].any():
            return None
        offset = [float(f"{x:.6g}") for x in self.values[OFFSETS]]
        return {"kind": "encoders", "offset": offset}

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
            "fitted_until_s": [float(log.times[-1]) for log in self.logs],
            "iterations": self.fit.iterations,
        }


def identify(
    logs: Sequence[Log],
    mechanism: Mechanism,
    tolerances: Tolerances | None = None,
    delay: float | None = None,
) -> Identification:
    """Return the machine that explains its logs best.

    Args:
        logs: of one machine, with the same gravity.
        mechanism: as drawn.
        tolerances: prior standard deviations; the defaults if None.
        delay: prior mean of the delay, s; by default that of the first log which has one.

    Raises:
        ConfigError: a plate that does not move, or logs that the mechanism does not fit at all.
    """
    if len({log.gravity for log in logs}) > 1:
        raise ConfigError(
            f"{_files(logs)}: got logs with gravity and without; expected one machine in one place"
        )
    tolerances = Tolerances() if tolerances is None else tolerances
    delays = (delay, *(log.delay for log in logs), USUAL_DELAY)
    believed = next(one for one in delays if one is not None)
    pairs = [(log, start.measured_poses(log, mechanism)) for log in logs]
    unknowns = _unknowns(pairs, mechanism, tolerances, believed)
    middle = np.nanmedian(np.vstack([poses for _, poses in pairs]), axis=0)
    ends = [float(log.times[-1]) for log in logs]
    if tolerances.delay > 0 and _longest(pairs) < short_logs.length_needed(unknowns):
        short = short_logs.fit_short(pairs, unknowns, WRONG)
        return Identification(logs, unknowns, short, middle, ends)
    found = _search(pairs, unknowns)
    # A drawing that is off explains nothing as badly, but perhaps a half of the log.
    if found.chi2 > UNEXPLAINED and (beginning := _beginning(pairs, unknowns)) is not None:
        pairs, found = beginning
    return Identification([log for log, _ in pairs], unknowns, found, middle, ends)


class _FirstFit(NamedTuple):
    chi2: float  # per value of the fitted segments; infinite if all of them diverge
    whole: Problem  # all segments
    guess: Guess  # fitted values, and the measured first states of all segments
    step: float  # longest integration step of the next fit, s


def _search(pairs: Sequence[start.Pair], unknowns: Unknowns, part: str = "") -> Solution:
    """Return the first fit that explains the logs, else that from the best start.

    `part` begins the names of its phases.
    """
    believed, std = float(unknowns.mean[DELAY]), float(unknowns.std[DELAY])
    starts = [(believed, 1.0)]
    if std > 0:
        longest = max(pairs, key=lambda pair: len(pair[0].times))
        coarse = start.coarse_delay(*longest, unknowns.mechanism, believed, std)
        # Where the plate was lost, long trajectories diverge. The coarse delay may be wrong.
        starts = [(coarse, 1.0), (coarse, 0.5), (believed, 0.5), (coarse, _SHORT_SHARE)]
    first_fits, step = list[_FirstFit](), _FIRST_STEP
    for number, (first_delay, share) in enumerate(starts, start=1):
        name = f"{part}start {number} of at most {len(starts)}"
        progress.phase(name)
        first_fit = _fit_nearest(unknowns.at_delay(first_delay), share, pairs, unknowns, step)
        if share == _SHORT_SHARE:  # a wrong drawing explains short segments, too
            progress.phase(f"{name}, whole segments")
            values, step = first_fit.guess.values, first_fit.step
            first_fit = _fit_nearest(values, 1.0, pairs, unknowns, step)
        first_fits.append(first_fit)
        progress.phase(f"{name}, whole log")
        if first_fit.chi2 <= WRONG and (found := _fit_all(first_fit)).chi2 <= WRONG:
            break
        step = first_fit.step
    else:
        progress.phase(f"{part}best start, whole log")
        found = _fit_all(min(first_fits, key=lambda one: one.chi2))
    while (halved := with_half_step(found.problem, found.guess)) is not None:
        progress.phase(f"{part}steps of {1e3 * halved.longest_step:.2g} ms")
        found = found.refitted(halved)
    return found


def _beginning(
    pairs: Sequence[start.Pair], unknowns: Unknowns
) -> tuple[list[start.Pair], Solution] | None:
    """Return the first half or quarter of the logs with its fit, if one explains it."""
    for share in (0.5, 0.25):
        parts = [_until(*pair, share) for pair in pairs]
        if _longest(parts) < short_logs.length_needed(unknowns):
            break
        with suppress(ConfigError):  # one of several logs is too short
            found = _search(parts, unknowns, f"first {100 * share:g} %, ")
            if found.chi2 <= WRONG:
                return parts, found
    return None


def _until(log: Log, poses: Array, share: float) -> start.Pair:
    """Return this share of a log, its beginning."""
    kept = log.times <= log.times[0] + share * (log.times[-1] - log.times[0])
    return replace(log, times=log.times[kept], values=log.values[kept]), poses[kept]


def _longest(pairs: Sequence[start.Pair]) -> float:
    """Return the length of the longest log in s."""
    return max(float(log.times[-1] - log.times[0]) for log, _ in pairs)


def _fit_nearest(
    values: Array, share: float, pairs: Sequence[start.Pair], unknowns: Unknowns, step: float
) -> _FirstFit:
    """Fit the half of the segments that the start predicts best.

    The segments have a share of the usual length; `values` are those of the unknowns at the start.
    Strong Coulomb friction needs steps shorter than `step` from the start on, as nothing is
    explained without them.
    """
    late = _COARSE_ERROR if unknowns.std[DELAY] > 0 else 0.0
    whole, first = start.problem_of(pairs, unknowns, values, late, share=share, step=step)
    problem, guess = without_diverged(whole, first)
    if not problem.segments:
        return _FirstFit(np.inf, whole, first, step)
    near, guess = nearest_half(problem, guess)
    fit = solve(near, guess, _FIRST_ITERATIONS)
    if fit.chi2 > WRONG and (halved := with_half_step(near, fit.guess)) is not None:
        step = halved.longest_step
    return _FirstFit(fit.chi2, whole, Guess(fit.guess.values, first.first), step)


def _fit_all(first_fit: _FirstFit) -> Solution:
    """Return the fit of all segments, without those that no values explain.

    A trajectory may diverge, such as the last one before the plate was lost. If the first fit is
    right and that of all segments is wrong, the worst segments are left out one by one, as long as
    more than half remain.
    """
    problem, guess = without_diverged(first_fit.whole, first_fit.guess)
    if not problem.segments:
        name = first_fit.whole.unknowns.mechanism.name
        logs = [s.log for s in first_fit.whole.segments]
        field = "with gravity" if logs[0].gravity else "without gravity"
        raise ConfigError(
            f"{_files(logs)}: got no stretch that the mechanism {name} could have moved through "
            f"under these torques {field}; expected a log of this machine, torques in N m "
            "as they were commanded, gravity as it acted"
        )
    if first_fit.chi2 > WRONG:
        return solve(problem, guess, whole=first_fit.whole)
    fewest = len(problem.segments) // 2 + 1
    found = solve(problem, guess, _FIRST_ITERATIONS, first_fit.whole)
    while found.chi2 > WRONG and len(found.problem.segments) > fewest:
        if found.misfit.max() < UNEXPLAINED:
            break
        found = found.without_worst(_FIRST_ITERATIONS)
    return found if found.iterations < _FIRST_ITERATIONS else found.refitted(found.problem)


def _files(logs: Iterable[Log]) -> str:
    return ", ".join(dict.fromkeys(log.name for log in logs))


def _unknowns(
    pairs: Sequence[start.Pair], mechanism: Mechanism, tolerances: Tolerances, believed: float
) -> Unknowns:
    """Return the prior, with the largest torque and the largest crank speed of the logs."""
    speeds = []
    for log, poses in pairs:
        known = np.isfinite(poses).all(axis=1)
        try:
            J = mechanism.jacobian(np.median(poses[known], axis=0))
        except (UnreachablePoseError, SingularPoseError) as error:
            raise ConfigError(
                f"{log.name}: its poses do not suit the mechanism {mechanism.name} ({error}); "
                "expected a log of this machine"
            ) from None
        turns, spans = np.diff(poses[known] @ J.T, axis=0), np.diff(log.times[known])
        speeds.append(float(np.abs(turns / spans[:, None]).max()))
    if not max(speeds) > 0:
        raise ConfigError(
            f"{_files(log for log, _ in pairs)}: got a plate that does not move; expected one that "
            "does"
        )
    torque = max(float(np.abs(log.torques).max()) for log, _ in pairs)
    unknowns = unknowns_of(mechanism, tolerances, believed, torque, max(speeds))
    has_encoders = any(log.measures(ANGLES) for log, _ in pairs)
    return unknowns if has_encoders else unknowns.without(OFFSETS)
