"""Design of an experiment: an exciting motion, and the covariance after its log.

The motion is a sum of sines in all coordinates, inside the workspace. Coordinate i of six moves by

    q_i(t) = q_0i + w(t) a_i sum_j cos(2 pi f_ij t + phi_ij) / f_ij.

Its frequencies f_ij = low + (j + i/6) (high - low) / n are its own. Phases are spread evenly over
the turn by the golden sequence, so that no two coordinates move alike. The window w rises from rest
and falls to rest, and a_i gives the peak asked for.

The scenario's loop is simulated along the motion; one that it loses is made smaller.

The information of measurements does not depend on their values: along the motion, under the torques
that follow it, J'J is known before anything has moved (Fisher's information).
"""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, margin, margins
from stewart_drake.files.csvio import csv_text
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.fit import Guess, Problem, covariance, without_diverged
from stewart_drake.identification.judgement import PoseUncertainty, pose_uncertainty, unseen
from stewart_drake.identification.logs import ANGLES, NUM_MEASURED, POSE, Log
from stewart_drake.identification.start import segment_length, segments_of
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.identification.unknowns import (
    DELAY,
    NAMES,
    OFFSETS,
    UNITS,
    Unknowns,
    unknowns_of,
)
from stewart_drake.law.feedforward import mean_torques
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.controller_margin import ControllerMargin, controller_margin
from stewart_drake.loop.preparation import Experiment
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.trajectories import poses_along, rows_along
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import number_sent
from stewart_drake.scenario.reference_config import CsvConfig
from stewart_drake.scenario.signals import COORDINATE_NAMES, COORDINATE_UNITS, NUM_STATE
from stewart_drake.types import Array

MOTION: Final = "motion.csv"
_EVERY: Final = 0.02  # time between two measurements of the predicted log, s
GRID: Final = 0.02  # time between two samples of the motion, s
_LINES: Final = 5  # sines of a coordinate
_LOW: Final = 0.1  # Hz
_HIGH: Final = 0.7
_GOLDEN: Final = (np.sqrt(5) - 1) / 2
_RISE: Final = 2.0  # s
_ROOM: Final = 0.5  # least share of the workspace's margin at the middle of the motion
_LEAST_SHARE: Final = 0.05
_SMALLER: Final = 0.7  # factor on the amplitude of a motion that the loop loses
_AMPLITUDE: Final = 0.5  # share of the scenario's motion
_DURATION: Final = 20.0  # s


@dataclass(frozen=True)
class Plan:
    """Experiment and the expected accuracy of its identification."""

    scenario: Scenario  # with the motion of the file `MOTION`
    share: float  # part of the requested amplitude that fits the workspace and the loop
    lost: Failure | None  # how the scenario's loop loses a larger motion, or None
    kept: bool  # whether it keeps this one
    margin: ControllerMargin  # of the scenario's loop along this one
    times: Array  # (n,) s, of the motion
    poses: Array  # (n, 6) rad and m
    measured: Array  # (18,) standard deviations of its measurements, infinite for missing ones
    unknowns: Unknowns  # before the log
    covariance: Array  # (k, k) of the free ones after the log

    @cached_property
    def unseen(self) -> tuple[int, list[str]]:
        """Number and names of the directions that the log will not show."""
        return unseen(self.unknowns, self.covariance)

    @cached_property
    def pose_uncertainty(self) -> PoseUncertainty:
        middle = np.median(self.poses, axis=0)
        found = pose_uncertainty(self.unknowns, self.unknowns.mean, self.covariance, middle)
        assert found is not None, "a planned motion stays inside the workspace"
        return found

    @property
    def std(self) -> Array:
        """Standard deviations of all unknowns after the log, 0 for known ones."""
        return np.sqrt(np.diag(self.unknowns.whole(self.covariance)))

    @property
    def summary(self) -> dict[str, Any]:
        free = self.unknowns.free
        return {
            "mechanism": self.unknowns.mechanism.name,
            "share": self.share,
            "lost": None if self.lost is None else str(self.lost),
            "kept": self.kept,
            "controller_margin": self.margin.summary,
            "delay_std_s": float(self.std[DELAY]),
            "parameters": {
                NAMES[k]: {
                    "unit": UNITS[k],
                    "before_std": float(self.unknowns.std[k]),
                    "std": float(self.std[k]),
                }
                for k in free
            },
            "pose_uncertainty": self.pose_uncertainty.summary,
            "unseen": {"directions": self.unseen[0], "names": self.unseen[1]},
        }


def motion_csv(times: Array, poses: Array) -> str:
    """Return a motion, times (n,) in s and poses (n, 6), as a file for a reference of kind csv."""
    names = zip(COORDINATE_NAMES, COORDINATE_UNITS, strict=True)
    heads = ["time[s]", *(f"{name}[{unit}]" for name, unit in names)]
    return csv_text(heads, np.column_stack([times, poses]))


def multisine(middle: Array, peak: Array, duration: float) -> tuple[Array, Array]:
    """Return times (n,) in s and poses (n, 6) of the motion around a pose (6,).

    `peak` (6,) is the largest departure of each coordinate.
    """
    time = GRID * np.arange(round(duration / GRID) + 1)
    line, coordinate = np.arange(_LINES)[:, None], np.arange(6) / 6
    frequency = _LOW + (line + coordinate) * (_HIGH - _LOW) / _LINES
    phase = 2 * np.pi * _GOLDEN * (line + _LINES * np.arange(6))
    waves = np.cos(2 * np.pi * frequency * time[:, None, None] + phase) / frequency
    rise = min(_RISE, duration / 4)
    y = np.clip(np.minimum(time, time[-1] - time) / rise, 0, 1)[:, None]
    window = y**4 * (35 - 84 * y + 70 * y**2 - 20 * y**3)  # three derivatives vanish at both ends
    moved = window * waves.sum(axis=1)
    poses: Array = middle + peak * moved / np.abs(moved).max(axis=0)
    return np.asarray(time, np.float64), poses


def fitted_multisine(
    mechanism: Mechanism, middle: Array, peak: Array, duration: float
) -> tuple[Array, Array, float]:
    """Return a multisine that stays well inside the workspace, and its share of `peak`."""
    least, share = _ROOM * margin(mechanism, middle), 1.0
    while share > _LEAST_SHARE:
        time, poses = multisine(middle, share * peak, duration)
        if margins(mechanism, poses).min() > least:
            return time, poses, share
        share *= 0.9
    raise ConfigError(
        f"plan: got a motion too large for the workspace even at {100 * _LEAST_SHARE:g} %; "
        "expected a smaller one, around a pose with room on all sides"
    )


@contextmanager
def following(scenario: Scenario, times: Array, poses: Array) -> Iterator[Scenario]:
    """Yield the scenario with the exact plant along a motion, whose file exists meanwhile."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / MOTION
        file.write_text(motion_csv(times, poses), encoding="utf-8")
        yield dataclasses.replace(
            scenario,
            reference=CsvConfig(file=str(file)),
            duration=float(times[-1]),
            plant=scenario.plant.without_engine,
        )


def loss_along(scenario: Scenario, times: Array, poses: Array) -> Failure | None:
    """Return how the scenario's loop loses the plate along a motion, or None."""
    with following(scenario, times, poses) as followed:
        return run_in_bulk(followed).stopped


def plan(experiment: Experiment, std: Array, tolerances: Tolerances | None = None) -> Plan:
    """Plan an experiment with a motion around the scenario's.

    `std` (18,) is that of the measurements, as of a log; infinite for values that will be missing.
    """
    sc, mechanism = experiment.scenario, experiment.mechanism
    instants = np.linspace(0, sc.duration, 200)
    seen = poses_along(experiment.reference, instants)
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    peak = _AMPLITUDE * experiment.motion_scale
    times, poses, share = fitted_multisine(mechanism, middle, peak, _DURATION)
    whole, lost = (times, poses, share), loss_along(sc, times, poses)
    kept = lost is None
    while not kept and share > _LEAST_SHARE:
        share *= _SMALLER
        times, poses = multisine(middle, share * peak, _DURATION)
        kept = loss_along(sc, times, poses) is None
    if not kept:
        times, poses, share = whole
    with following(sc, times, poses) as followed:
        judged = controller_margin(followed)
    motion = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(times, poses.T)
    log = _predicted(experiment, motion, times[-1], std)
    states = log.values[:, POSE.start :]
    torque = float(np.abs(log.torques).max())
    speeds = np.einsum("ij,nj->ni", mechanism.jacobian(middle), states[:, 6:])
    speed = float(np.abs(speeds).max())
    unknowns = unknowns_of(mechanism, tolerances or Tolerances(), sc.eta, torque, speed)
    if not np.isfinite(std[ANGLES]).all():
        unknowns = unknowns.without(OFFSETS)
    length = segment_length(log, log.values[:, POSE], mechanism, sc.eta)
    segments = segments_of(log, sc.eta, length)
    first = np.array([states[segment.rows[0]] for segment in segments])
    problem, guess = without_diverged(Problem(segments, unknowns), Guess(unknowns.mean, first))
    if not problem.segments:
        raise ConfigError(
            "plan: got a motion along which the plate cannot be followed; expected one that "
            "stays off the edge of the workspace"
        )
    spread = covariance(problem.normal(guess)[1])
    reference = CsvConfig(file=MOTION)
    changed = dataclasses.replace(sc, reference=reference, duration=float(times[-1]))
    return Plan(changed, share, lost, kept, judged, times, poses, std, unknowns, spread)


def _predicted(experiment: Experiment, motion: PiecewisePolynomial, end: float, std: Array) -> Log:
    """Return the log of perfect tracking of the motion, with crank angles and states."""
    sc, mechanism = experiment.scenario, experiment.mechanism
    dynamics = StewartDynamics(mechanism, experiment.nominal.gravity)
    period, eta = sc.controller.period, sc.eta
    sent: Array = period * np.arange(number_sent(end, period), dtype=np.float64)
    # The motion rests after its end.
    starts = np.minimum(sent + eta, end)
    torques = mean_torques(dynamics, motion, starts, np.minimum(starts + period, end))
    times = np.arange(0, end + _EVERY / 2, _EVERY)
    states = rows_along(motion, np.minimum(times, end))[:, :NUM_STATE]
    values = np.full((len(times), NUM_MEASURED), np.nan)
    values[:, ANGLES] = [mechanism.crank_angles(pose) for pose in states[:, :6]]
    values[:, POSE.start :] = states
    return Log("plan", sent, torques, times, values, std, dynamics.gravity)
