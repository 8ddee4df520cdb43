"""Results of a run: its figures of merit, its summary and its files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
import xarray as xr

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.arrayio import write_netcdf
from stewart_drake.files.fileio import remove_partials
from stewart_drake.files.jsonio import write_json
from stewart_drake.scenario.config import (
    ControllerConfig,
    Scenario,
)
from stewart_drake.types import Array


class Figures(NamedTuple):
    """What a run comes to, see `loop.results.RunSummary`; NaN where it has no value."""

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
    """The figures of merit of a run.

    Args:
        time, error: on the metric's grid, as of `accumulated_error`.
        scale: (6,) as of `accumulated_error`.
        errors: (k, 6) pose error at the controller's samples.
        asked: (k, 6) torques that the law asked for there, N m.
        sent: (k, 6) what the limit let through, N m.
        controller: of the scenario.
        completed: whether the run did; otherwise it has no error and no cost.
    """
    c, nan, some = controller, float("nan"), len(asked) > 0
    cost = quadratic_cost(errors, sent, c.period, c.w_Q, c.w_R, c.integral) if completed else nan
    return Figures(
        accumulated_error=accumulated_error(time, error, scale) if completed else nan,
        cost=cost,
        peak_torque=float(np.abs(asked).max()) if some else nan,
        rms_torque=float(np.sqrt(np.mean(asked**2))) if some else nan,
        torque_variation=total_variation(asked) if some else nan,
    )


def accumulated_error(time: Array, error: Array, scale: Array) -> float:
    """E_ac in % s, equation (47): mean over the coordinates of integral |e_i| / A_i * 100 dt.

    Args:
        time: (n,) s; the trapezoid rule runs on it.
        error: (n, 6) pose error against the true reference.
        scale: (6,) A_i, peak to peak of the reference, 1 where it is constant.
    """
    return float(np.mean(np.trapezoid(np.abs(error) / scale * 100, time, axis=0)))


def quadratic_cost(
    error: Array, torque: Array, period: float, w_Q: float, w_R: float, integral: bool
) -> float:
    """Equation (40) on samples: sum of w_Q (|e|^2 + |z|^2) + w_R |T|^2, unscaled as in (41).

    Args:
        error: (n, 6) pose error at the controller's samples.
        torque: (n, 6) sent there, within the motors' limit, N m.
        period: s; z follows from the errors by the trapezoid rule.
        w_Q, w_R: the weights.
        integral: whether the cost sees z, (28).
    """
    cost = w_Q * float(np.sum(error**2)) + w_R * float(np.sum(torque**2))
    if integral:
        z = np.vstack([np.zeros(6), np.cumsum((error[1:] + error[:-1]) * period / 2, axis=0)])
        cost += w_Q * float(np.sum(z**2))
    return cost


def total_variation(torque: Array) -> float:
    """Mean over the motors of sum |T_{k+1} - T_k| in N m: the paper's trembling."""
    return float(np.mean(np.abs(np.diff(torque, axis=0)).sum(axis=0)))


def peak_error(error: Array, scale: Array) -> Array:
    """(6,) largest |error| in percent of peak to peak."""
    return 100 * np.abs(error).max(axis=0) / scale


def delay_floor(time: Array, reference: Array, scale: Array, eta: float) -> float:
    """E_ac in % s that a plate which waits at rest collects before any torque acts.

    Args:
        time: (n,) s.
        reference: (n, 6) poses; the plate stays at the first one until eta.
        scale: (6,) as in `accumulated_error`.
        eta: total delay in s.
    """
    waiting = time <= eta + 1e-9
    return accumulated_error(time[waiting], (reference - reference[0])[waiting], scale)


def waits_at_rest(scenario: Scenario) -> bool:
    """Whether the nominal plate stays where it is until the first torque of the controller acts.

    The floor of E_ac (`loop.results.delay_floor`) supposes that.
    """
    held = scenario.queue == "equilibrium"
    return scenario.start == "rest" and (
        held or (scenario.queue == "zero" and not scenario.plant.gravity)
    )


class StepTimes(TypedDict):
    """Computing time of the controller's step, ms; NaN where there was none."""

    median: float
    worst: float


class MarginSummary(TypedDict):
    """Whether the loop is stable, linearised along the reference, and what it bears."""

    stable: bool | None
    """None where it could not be judged."""
    spectral_radius: float
    """The largest along the reference; errors grow with it per period where it is above 1."""
    delay_margin_s: list[float]
    """By which the true delay may be shorter, and longer, s."""
    gain_margin: list[float]
    """Factors by which the motors may be weaker, and stronger."""
    growth: float
    """Of an error of the prediction within the delay, e^(p eta), a factor."""


class DelaySummary(TypedDict):
    """The delay at the last sample, s."""

    true_s: float
    estimated_s: float
    """What the law goes by."""
    std_s: float
    """Its standard deviation, measured 1.6 to 2.6 times too large; NaN without an estimator."""


class RunSummary(TypedDict):
    """How a run went: what its `summary.json` holds, with null for NaN.

    NaN where a run that did not complete has no value.
    """

    status: str
    """`completed`, `left_workspace`, `solver_failed` or `interrupted`; in real time also
    `lost_machine`, which fell silent, `lost_contact`, where datagrams came but no usable
    measurements, or `refused`, where there was no way to take it over."""
    accumulated_error: float
    """E_ac in % s, equation (47). NaN for a run in real time with a `measured_share` below 0.9."""
    measured_share: float
    """Share of the controller's samples whose measurement it could use, or a part of it."""
    failure: dict[str, Any] | None
    """What stopped it: `time` in s, `leg`, `margin`, `reason`."""
    cost: float
    """Equation (40) on the samples, of the torques that the limit let through."""
    peak_torque: float
    """Largest that the law asked for, N m."""
    peak_torque_applied: float
    """Largest that acted, N m."""
    rms_torque: float
    """Of what the law asked for, over all motors, N m."""
    torque_variation: float
    """Mean over the motors of sum |T_{k+1} - T_k| of the same, N m."""
    peak_error: list[float]
    """(6,) of the pose, % of peak to peak."""
    delay_floor: float
    """E_ac in % s that a plate at rest collects before any torque acts; 0 where it is not."""
    controller_step_ms: StepTimes
    delay: DelaySummary
    wall_s: float
    """Time that the run took, s."""
    counts: dict[str, int]
    """What went wrong and was survived, by name (`law.memory.Counts`, `tuner_fallbacks`)."""
    link: dict[str, Any]
    """The assumed link with all its numbers (`Scenario.assumed_link`)."""
    own: dict[str, str]
    """The user's own systems in the loop, by their part in it."""
    scenario: dict[str, Any]
    """As run."""
    versions: dict[str, str]
    """What the numbers depend on beside the scenario."""
    controller_margin: MarginSummary | None
    """None where it was not asked for."""
    warnings: list[str]
    """What the user should know of this run, a sentence each."""


class LiveSummary(RunSummary):
    """The same of a run in real time."""

    live: dict[str, Any]
    """How periodic it was, what the link did, and what was done about it."""


@dataclass(frozen=True)
class SimulationResult:
    """A finished run.

    Attributes:
        scenario: as run.
        status: `completed`, `left_workspace`, `solver_failed` or `interrupted`.
        stopped: when and why a run did not complete, or None.
        signals: over `time` (every 20 ms and every sample of the controller, or the scenario's
            `log_period`): pose, rates, reference, reference_rates, error, integral,
            torque_commanded (what the law asked for), torque_applied (what acted of it: within the
            limit, late), weights, parameters and parameter_std (estimated), density (45),
            measurement (12, or 6 crank angles per sample of encoders) and state_estimate (12) of
            the controller. Held signals show the value from that instant on. Units, long names, the
            scenario and versions are attributes.
        summary: what `summary.json` holds.
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
        """Why the run ended early, with the time, or None."""
        return None if self.stopped is None else str(self.stopped)

    def save(self, directory: str | Path) -> None:
        """Write signals.nc and summary.json into a directory, which is made; each whole or not.

        Raises:
            OSError: the directory cannot be written to.
        """
        folder = Path(directory)
        folder.mkdir(parents=True, exist_ok=True)
        remove_partials(folder)
        write_netcdf(folder / "signals.nc", self.signals)
        write_json(folder / "summary.json", self.summary)
