"""What a log would tell: a motion that excites, and the covariance that its log will leave.

The information of measurements does not depend on their values: along the motion, under the torques
that hold to it, J'J is known before anything has moved (Fisher's information).
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.excitation import fitted_multisine
from stewart_drake.identification.fit import Evaluator, Guess, Problem, covariance, followed
from stewart_drake.identification.judgement import PoseUncertainty, pose_uncertainty, unseen
from stewart_drake.identification.logs import ANGLES, NUM_MEASURED, POSE, Log
from stewart_drake.identification.start import segment_length, segments_of
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.identification.unknowns import DELAY, NAMES, UNITS, Unknowns, unknowns_of
from stewart_drake.law.holds import mean_torques
from stewart_drake.loop.experiment import Experiment, motion_scale
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.reference_config import CsvConfig
from stewart_drake.scenario.signals import COORDINATE_NAMES, COORDINATE_UNITS, NUM_STATE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

MOTION: Final = "motion.csv"
_EVERY: Final = 0.02
"""s between two measurements of the log that is foreseen."""


@dataclass(frozen=True)
class Plan:
    """An experiment, and what it will tell.

    Attributes:
        scenario: the motion of `MOTION` in the place of the scenario's own.
        share: of the amplitude that was asked for, what fits the workspace.
        times, poses: (n,) s and (n, 6) rad and m, of the motion.
        unknowns: as they are known now.
        covariance: (k, k) of the free ones, after the log.
    """

    scenario: Scenario
    share: float
    times: Array
    poses: Array
    unknowns: Unknowns
    covariance: Array

    @cached_property
    def unseen(self) -> tuple[int, list[str]]:
        """How many directions the log will not see, and what they are."""
        return unseen(self.unknowns, self.covariance)

    @cached_property
    def pose_uncertainty(self) -> PoseUncertainty:
        """Over the workspace, after the log."""
        middle = np.median(self.poses, axis=0)
        found = pose_uncertainty(self.unknowns, self.unknowns.mean, self.covariance, middle)
        assert found is not None, "a planned motion stays inside the workspace"
        return found

    @property
    def std(self) -> Array:
        """Standard deviations of all unknowns after the log, 0 of what is known."""
        found = np.zeros(len(NAMES))
        found[self.unknowns.free] = np.sqrt(np.diag(self.covariance))
        return found

    @property
    def summary(self) -> dict[str, Any]:
        """What `summary.json` holds."""
        free = self.unknowns.free
        return {
            "mechanism": self.unknowns.mechanism.name,
            "share": self.share,
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

    @property
    def motion_csv(self) -> str:
        """The motion as a reference of kind csv reads it."""
        names = zip(COORDINATE_NAMES, COORDINATE_UNITS, strict=True)
        lines = [",".join(["time[s]", *(f"{name}[{unit}]" for name, unit in names)])]
        rows = np.column_stack([self.times, self.poses])
        lines += [",".join(f"{value:.12g}" for value in row) for row in rows]
        return "\n".join(lines) + "\n"


def plan(
    experiment: Experiment,
    std: Array,
    tolerances: Tolerances | None = None,
    amplitude: float = 0.5,
    duration: float = 20.0,
) -> Plan:
    """A motion around the scenario's, and what its log will tell.

    Args:
        experiment: of the scenario whose machine, period and delay they are.
        std: (18,) of the measurements, as of a log, infinite for what will not be measured.
        tolerances: how far the machine may be off, the defaults if None.
        amplitude: share of the scenario's motion.
        duration: s.

    Raises:
        ConfigError: the middle of the scenario's motion leaves no room around it.
    """
    sc, mechanism = experiment.scenario, experiment.mechanism
    instants = np.linspace(0, sc.duration, 200)
    seen = np.array([experiment.reference.value(t)[:, 0] for t in instants])
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    peak = amplitude * motion_scale(experiment)
    times, poses, share = fitted_multisine(mechanism, middle, peak, duration)
    motion = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(times, poses.T)
    log, states = _foreseen(experiment, motion, times[-1], std)
    torque = float(np.abs(log.torques).max())
    speeds = np.einsum("ij,nj->ni", mechanism.jacobian(middle), states[:, 6:])
    unknowns = unknowns_of(
        mechanism,
        Tolerances() if tolerances is None else tolerances,
        sc.eta,
        torque,
        float(np.abs(speeds).max()),
    )
    if not np.isfinite(std[ANGLES]).all():
        unknowns = unknowns.without_encoders()
    length = segment_length(log, log.values[:, POSE], mechanism, sc.eta)
    segments = segments_of(log, sc.eta, length)
    first = np.array([states[segment.rows[0]] for segment in segments])
    problem, guess = followed(Problem(segments, unknowns), Guess(unknowns.mean, first))
    if not problem.segments:
        raise ConfigError(
            "--plan: got a motion along which the plate cannot be followed; expected one that "
            "stays off the edge of the workspace"
        )
    spread = covariance(Evaluator(problem).normal(guess)[1])
    reference = CsvConfig(file=MOTION)
    changed = dataclasses.replace(sc, reference=reference, duration=float(times[-1]))
    return Plan(changed, share, times, poses, unknowns, spread)


def _foreseen(
    experiment: Experiment, motion: PiecewisePolynomial, end: float, std: Array
) -> tuple[Log, Array]:
    """The log that a controller would leave that holds to the motion, and its states (n, 12)."""
    sc, mechanism = experiment.scenario, experiment.mechanism
    dynamics = StewartDynamics(mechanism, experiment.nominal.gravity)
    period, eta = sc.controller.period, sc.eta
    sent: Array = period * np.arange(int(end / period + 1e-9) + 1, dtype=np.float64)
    # The motion rests after its end.
    starts = np.minimum(sent + eta, end)
    torques = mean_torques(dynamics, motion, starts, np.minimum(starts + period, end))
    times = np.arange(0, end + _EVERY / 2, _EVERY)
    states = np.array([evaluate(motion, min(t, end))[:NUM_STATE] for t in times])
    values = np.full((len(times), NUM_MEASURED), np.nan)
    values[:, ANGLES] = [mechanism.crank_angles(pose) for pose in states[:, :6]]
    values[:, POSE.start :] = states
    log = Log("plan", sent, torques, times, values, std, dynamics.gravity)
    return log, states
