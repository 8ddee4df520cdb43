"""Results of a run: its figures of merit, its summary and its files."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypedDict

import numpy as np
import xarray as xr
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.arrayio import write_netcdf
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.jsonio import write_json
from stewart_drake.mechanism.kinematics import turns_between
from stewart_drake.mechanism.trajectories import poses_along
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.signals import ANGLES, POSITION
from stewart_drake.types import Array

STILL: Final = 1e-9
"""Motion below which a coordinate counts as still, rad or m."""


class Figures(NamedTuple):
    """Figures of merit of a run, see `RunSummary`; NaN without a value."""

    accumulated_error: float
    cost: float
    peak_torque: float
    rms_torque: float
    torque_variation: float


def figures(
    time: Array,
    error: Array,
    scale: Array,
    errors: Array,
    asked: Array,
    sent: Array,
    controller: ControllerConfig,
    completed: bool,
) -> Figures:
    """Compute the figures of merit of a run.

    Args:
        time: (n,) of the metric's grid, s.
        error: (n, 6) on that grid, as of `accumulated_error`.
        scale: (6,) as of `accumulated_error`.
        errors: (k, 6) pose error at the controller's samples.
        asked: (k, 6) torques of the law there, N m; NaN if servos did not report theirs.
        sent: (k, 6) the same within the limit, N m.
        controller: section of the scenario.
        completed: whether the run completed; error and cost are NaN otherwise.
    """
    c, nan = controller, float("nan")
    cost = quadratic_cost(errors, sent, c.period, *c.weights, c.integral) if completed else nan
    asked = asked[np.isfinite(asked).all(axis=1)]
    some = len(asked) > 0
    return Figures(
        accumulated_error=accumulated_error(time, error, scale) if completed else nan,
        cost=cost,
        peak_torque=float(np.abs(asked).max()) if some else nan,
        rms_torque=float(np.sqrt(np.mean(asked**2))) if some else nan,
        torque_variation=total_variation(asked) if some else nan,
    )


def accumulated_error(time: Array, error: Array, scale: Array) -> float:
    """Return E_ac in % s, (47): mean over the coordinates of integral |e_i| / A_i * 100 dt.

    Args:
        time: (n,) s, for the trapezoid rule.
        error: (n, 6) pose error against the true reference.
        scale: (6,) A_i, peak to peak of the reference, 1 where it is constant.
    """
    return float(np.mean(np.trapezoid(np.abs(error) / scale * 100, time, axis=0)))


def quadratic_cost(
    error: Array, torque: Array, period: float, w_Q: float, w_R: float, integral: bool
) -> float:
    """Return (40) on samples: sum of w_Q (|e|^2 + |z|^2) + w_R |T|^2, unscaled as in (41).

    Args:
        error: (n, 6) pose error at the controller's samples.
        torque: (n, 6) within the motors' limit, N m.
        period: s; z follows from the errors by the trapezoid rule.
        w_Q: weight of the errors.
        w_R: weight of the torques.
        integral: whether the cost includes z, (28).
    """
    cost = w_Q * float(np.sum(error**2)) + w_R * float(np.sum(torque**2))
    if integral:
        z = np.vstack([np.zeros(6), np.cumsum((error[1:] + error[:-1]) * period / 2, axis=0)])
        cost += w_Q * float(np.sum(z**2))
    return cost


def total_variation(torque: Array) -> float:
    """Return the mean over the motors of sum |T_{k+1} - T_k|, N m: the paper's trembling."""
    return float(np.mean(np.abs(np.diff(torque, axis=0)).sum(axis=0)))


def peak_error(error: Array, scale: Array) -> Array:
    """Return the largest |error| (6,) in percent of peak to peak."""
    return 100 * np.abs(error).max(axis=0) / scale


def second_half(reference: Array) -> slice:
    """Return the later half of the rows (n, 6) of a reference, until it rests for good."""
    moves = np.flatnonzero((np.abs(reference - reference[-1:]) > STILL).any(axis=1))
    end = moves[-1] + 2 if len(moves) else len(reference)
    return slice(end // 2, end)


def rms_error(poses: Array, reference: Array) -> "RmsError":
    """Return the error of poses (n, 6) in the `second_half`; NaN if none was measured there."""
    later = np.stack([poses, reference])[:, second_half(reference)]
    there, wanted = later[:, np.isfinite(later).all(axis=(0, 2))]  # live may miss measurements
    if not len(there):
        return {"angle_deg": math.nan, "position_mm": math.nan}
    angles = turns_between(there[:, ANGLES], wanted[:, ANGLES])
    distances = np.linalg.norm(there[:, POSITION] - wanted[:, POSITION], axis=1)
    angle, distance = (math.sqrt(np.mean(error**2)) for error in (angles, distances))
    return {"angle_deg": math.degrees(angle), "position_mm": 1e3 * distance}


def delay_floor(reference: Trajectory, scale: Array, wait: float) -> float:
    """Return E_ac in % s of a plate that rests at the first pose of a reference for `wait` s.

    Args:
        reference: trajectory (6, 1) of the pose.
        scale: (6,) as in `accumulated_error`.
        wait: the total delay eta, or the duration of a shorter run.
    """
    time: Array = np.linspace(0.0, wait, 2001, dtype=np.float64)
    poses = poses_along(reference, time)
    return accumulated_error(time, poses - poses[0], scale)


def waits_at_rest(scenario: Scenario) -> bool:
    """Return whether the nominal plate rests until the first torque acts, as for `delay_floor`."""
    held = scenario.queue == "equilibrium"
    return scenario.start == "rest" and (
        held or (scenario.queue == "zero" and not scenario.plant.gravity)
    )


class RmsError(TypedDict):
    """Root mean square error in the second half of the motion; NaN for a lost run.

    It is the half of the time until the reference rests, or of the run if it always moves.
    """

    angle_deg: float
    """Angle of the rotation between reference and plate, deg."""
    position_mm: float


class StepTimes(TypedDict):
    """Computing time of the controller's step, ms; NaN without steps."""

    median: float
    worst: float


class MarginSummary(TypedDict):
    """Stability and margins of the loop, linearised along the reference."""

    stable: bool | None
    """None if not judged."""
    spectral_radius: float
    """Largest along the reference; above 1 it is the growth of errors per period."""
    delay_margin_s: list[float]
    """Stable for a true delay shorter, and longer, by less than this, s."""
    gain_margin: list[float]
    """Stable for factors of the motor torques between these."""
    growth: float
    """Growth of a prediction error over the delay, e^(p eta)."""


class DelaySummary(TypedDict):
    """The delay at the last sample, s."""

    true_s: float
    estimated_s: float
    """Delay assumed by the law."""
    std_s: float
    """Standard deviation, 1.0 to 1.4 times too large in tests; NaN without an estimator."""


class ConsistencySummary(TypedDict):
    """Whether the estimator's stated uncertainty is right (`law.belief.Innovations`)."""

    nis_ratio: float
    """Mean of nu' S^-1 nu per measured value; 1 is right; NaN without an estimator."""
    verdict: str | None
    """`consistent`, `cautious` or `overconfident`; None with too few measurements."""


class EstimateSummary(TypedDict):
    """An estimated parameter at the last sample, in the unit of the scenario's field."""

    value: float
    std: float
    """Stated standard deviation; NaN where the observer has none."""


LEAST_MEASURED: Final = 0.9
"""Smallest share of measured samples for which a run in real time has E_ac and a cost."""


class RunSummary(TypedDict):
    """Summary of a run: the content of `summary.json`, with null for NaN.

    NaN is a figure that a run which did not complete lacks.
    """

    status: str
    """`completed`, `left_workspace`, `solver_failed` or `interrupted`; in real time also
    `lost_machine` (no datagrams), `lost_contact` (datagrams without usable measurements) or
    `refused` (the machine could not be taken over, or its delay is another)."""
    accumulated_error: float
    """E_ac in % s, equation (47). NaN for a run in real time with a `measured_share` below 0.9."""
    measured_share: float
    """Share of the controller's samples with a usable measurement, at least in part."""
    failure: dict[str, Any] | None
    """Reason of an early end: `time` in s, `leg`, `margin`, `reason`."""
    cost: float
    """Equation (40) on the samples, for torques within the limit."""
    peak_torque: float
    """Largest torque of the law, before the limit, N m; of servos, among those that came with a
    measurement, NaN if none did."""
    peak_torque_applied: float
    """Largest torque that acted, N m."""
    rms_torque: float
    """Of the law's torques over all motors, N m."""
    torque_variation: float
    """Mean over the motors of sum |T_{k+1} - T_k| of the law's torques, N m."""
    peak_error: list[float]
    """(6,) of the pose, % of peak to peak; of 1 rad or 1 m where the reference is constant."""
    rms_error: RmsError
    delay_floor: float
    """E_ac in % s of a plate that rests until a torque acts; 0 without rest."""
    controller_step_ms: StepTimes
    delay: DelaySummary
    estimator_consistency: ConsistencySummary
    estimates: dict[str, EstimateSummary]
    """Estimated parameters by name; empty for none, and for a controller of yours."""
    wall_s: float
    """Computing time of the run, s."""
    counts: dict[str, int]
    """Number of survived problems by name (`law.counts.Counts`, `tuner_fallbacks`)."""
    link: dict[str, Any]
    """The assumed link with all its numbers (`Scenario.assumed_link`)."""
    packets: dict[str, int]
    """Packets `sent`, `lost` and `late`, and periods `played` (with a torque of one) and `dry`
    (without); empty over a wire, without `late` in real time."""
    own: dict[str, str]
    """Classes of the user's systems by role."""
    scenario: dict[str, Any]
    """As run."""
    versions: dict[str, str]
    """Releases of the software."""
    controller_margin: MarginSummary | None
    """None if not requested."""
    warnings: list[str]
    """Warnings about this run, a sentence each."""


class LiveSummary(RunSummary):
    """Summary of a run in real time."""

    live: dict[str, Any]
    """Periodicity, link, and reactions to its faults."""


@dataclass(frozen=True)
class SimulationResult:
    """A finished run.

    Attributes:
        scenario: as run.
        status: as of `RunSummary`: `completed`, `left_workspace`, `solver_failed`, `interrupted`;
            in real time also `lost_machine`, `lost_contact` or `refused`.
        stopped: when and why a run did not complete, or None.
        signals: over `time` (every 20 ms and every sample of the controller, or the scenario's
            `log_period`): pose, rates, reference, reference_rates, error, integral,
            torque_commanded (of the law), torque_applied (limited and delayed), weights, parameters
            and parameter_std (estimated), density (45), measurement (12, or 6 crank angles per
            sample of encoders) and state_estimate (12) of the controller. A held value is that
            from the instant on. Units, long names, the scenario and versions are attributes.
        summary: content of `summary.json`.
    """

    scenario: Scenario
    status: str
    stopped: Failure | None
    signals: xr.Dataset
    summary: RunSummary

    def __repr__(self) -> str:
        status = self.status if self.stopped is None else f"{self.status}: {self.stopped}"
        return f"SimulationResult({status}, E_ac={self.accumulated_error:.4g}, {self.scenario})"

    @property
    def accumulated_error(self) -> float:
        """E_ac in % s, equation (47); NaN for a run that did not complete."""
        return self.summary["accumulated_error"]

    @property
    def failure(self) -> str | None:
        """Reason of an early end, with the time, or None."""
        return None if self.stopped is None else str(self.stopped)

    def save(self, directory: str | Path) -> None:
        """Write signals.nc and summary.json into a directory, made if missing."""
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        remove_partials(folder)
        write_netcdf(folder / "signals.nc", self.signals)
        write_json(folder / "summary.json", self.summary)
