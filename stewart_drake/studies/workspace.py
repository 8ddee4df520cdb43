"""A reference against the workspace: margins, singularity, the largest amplitude, motor sizing."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.preparation import (
    Experiment,
    check_instants,
    first_pose_text,
    prepare_unchecked,
)
from stewart_drake.mechanism.geometry import plate_radius
from stewart_drake.mechanism.trajectories import poses_along, rows_along
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import COORDINATES, LEGS, POSE, RATES
from stewart_drake.studies.clearance import ClearanceStudy, study_clearance
from stewart_drake.studies.workspace_map import (
    LARGEST_FACTOR,
    Measures,
    Section,
    Travel,
    first_exit,
    largest_factor,
    measure,
    sections,
    travel,
)
from stewart_drake.types import Array


class Sizing(NamedTuple):
    """Motor torque (N m) and crank rate (rad/s) along a motion, (n, 6); `time` (n,) in s."""

    time: Array
    torque: Array
    speed: Array

    @property
    def power(self) -> Array:
        """W, positive where the motor drives, negative where it brakes."""
        return self.torque * self.speed

    def summary(self, torque_limit: float | None) -> list[dict[str, Any]]:
        """Return peak and rms of torque (N m), speed (rad/s) and power (W) of each leg.

        `use_of_limit` is the peak's share of the torque limit in N m.
        """
        torque, speed, power = np.abs(self.torque), np.abs(self.speed), self.power
        return [
            {
                "leg": LEGS[i],
                "peak_torque": torque[:, i].max(),
                "rms_torque": rms(torque[:, i]),
                "peak_speed": speed[:, i].max(),
                "rms_speed": rms(speed[:, i]),
                "peak_power": power[:, i].max(),
                "least_power": power[:, i].min(),
                "rms_power": rms(power[:, i]),
                "use_of_limit": torque[:, i].max() / (torque_limit or np.nan),
            }
            for i in range(len(LEGS))
        ]


def rms(values: Array) -> float:
    """Return the root mean square of evenly spaced values."""
    return float(np.sqrt(np.mean(np.square(values))))


def size_motors(dynamics: StewartDynamics, reference: Trajectory, time: Array) -> Sizing:
    """Return torques and crank rates that follow a reference exactly, at `time` (n,) in s.

    T = inverse dynamics of (X, X', X''), crank rates = J X'.
    """
    wanted = rows_along(reference, time)
    speed = [dynamics.mechanism.jacobian(x[POSE]) @ x[RATES] for x in wanted]
    return Sizing(np.asarray(time), dynamics.torques_along(wanted), np.array(speed))


@dataclass(frozen=True)
class WorkspaceStudy:
    experiment: Experiment  # of the scenario, reachable or not
    home: Failure | None  # why the home pose is unusable, or None
    exit: Failure | None  # when and why the reference first leaves the workspace, or None
    time: Array  # (n,) instants of the reference, s
    poses: Array  # (n, 6) of the reference
    margins: Measures  # along the reference
    factor: float  # largest amplitude factor that fits, see `largest_factor`
    travel: list[Travel]  # per coordinate from home; empty with a bad home pose
    sections: list[Section]  # through home; empty with a bad home pose
    sizing: Sizing | None  # of the motors, or None if the reference leaves the workspace
    clearance: ClearanceStudy  # whether links touch, along the reference and around home

    @property
    def torque_limit(self) -> float | None:
        """The scenario's, else the mechanism's, N m."""
        limit = self.experiment.torque_limit
        return limit if math.isfinite(limit) else None

    @property
    def worst(self) -> tuple[float, int, float]:
        """Time in s, leg and margin in m at the least reach margin of all legs and instants."""
        row, leg = np.unravel_index(self.margins.reach.argmin(), self.margins.reach.shape)
        return float(self.time[row]), LEGS[leg], float(self.margins.reach[row, leg])

    @property
    def verdict(self) -> str:
        opening = "" if self.home is None else f"the home pose is singular ({self.home.reason}); "
        time, leg, margin = self.worst
        parts = [self._amplitude, self.clearance.verdict]
        if self.exit is None:
            inside = f"yes: {opening}the reference stays in the workspace"
            if self.clearance.along.touching:
                inside += f", but {parts.pop()}"
            nearest = (
                f"leg {leg} is nearest to the end of its reach with {1e3 * margin:.3g} mm left at "
                f"t = {time:.2f} s"
            )
            return "; ".join([inside, nearest, *parts])
        short = ""
        if margin < 0:
            short = f", at worst leg {leg} is short by {-1e3 * margin:.3g} mm at t = {time:.2f} s"
        return (
            f"no: {opening}the reference leaves the workspace at t = {self.exit.time:.3f} s, "
            f"{self.exit.reason}{short}; {'; '.join(parts)}"
        )

    @property
    def factor_text(self) -> str:
        """The factor, rounded down so that this motion does fit."""
        more = "" if self.factor < LARGEST_FACTOR else "more than "
        return f"{more}{np.floor(1e3 * self.factor) / 1e3:g}"

    @property
    def _amplitude(self) -> str:
        if np.isnan(self.factor):
            return "it does not move"
        if self.factor == 0:
            pose = first_pose_text(self.poses[0], self.experiment.mechanism)
            return f"not even its first pose is inside: {pose}"
        if self.factor == LARGEST_FACTOR:
            return f"{self.factor:g} times the amplitude fits, more was not tried"
        return f"the largest amplitude that fits is {self.factor_text} times this one"

    @property
    def summary(self) -> dict[str, Any]:
        """Content of `summary.json`, SI units; NaN for a missing value."""
        m, (time, leg, margin) = self.margins, self.worst
        mechanism = self.experiment.mechanism
        return {
            "verdict": self.verdict,
            "fits": self.home is None and self.exit is None,
            "home_failure": None if self.home is None else self.home._asdict(),
            "exit": None if self.exit is None else self.exit._asdict(),
            "worst": {"time": time, "leg": leg, "reach_margin": margin},
            "largest_factor": self.factor,
            "largest_factor_limited": self.factor < LARGEST_FACTOR,
            "legs": [
                {
                    "leg": LEGS[i],
                    "least_reach_margin": m.reach[:, i].min(),
                    "time": self.time[m.reach[:, i].argmin()],
                    "least_sine": m.sines[:, i].min(),
                    "least_transmission": least(m.transmission[:, i]),
                }
                for i in range(len(LEGS))
            ],
            "characteristic_length": plate_radius(mechanism),
            "least_parallel": m.parallel.min(),
            "least_held": least(m.held),
            "worst_condition": -least(-m.condition),
            "worst_play": -least(-m.play),
            "home": measure(mechanism, mechanism.home)._asdict(),
            "travel": [t._asdict() for t in self.travel],
            "sections": [_bounds(section) for section in self.sections],
            "clearance": self.clearance.summary,
            "torque_limit": np.nan if self.torque_limit is None else self.torque_limit,
            "motors": [] if self.sizing is None else self.sizing.summary(self.torque_limit),
            "scenario": dataclasses.asdict(self.experiment.scenario),
        }


def study_workspace(scenario: Scenario) -> WorkspaceStudy:
    """Judge a scenario's reference; one that leaves the workspace is analysed, not refused."""
    experiment = prepare_unchecked(scenario)
    mechanism, reference = experiment.mechanism, experiment.reference
    time = check_instants(scenario.duration)
    left = first_exit(mechanism, reference, time)
    poses = poses_along(reference, time)
    ways, around = travel(mechanism), sections(mechanism)
    return WorkspaceStudy(
        experiment=experiment,
        home=diagnose(mechanism, 0.0, mechanism.home),
        exit=left,
        time=time,
        poses=poses,
        margins=measure(mechanism, poses),
        factor=largest_factor(mechanism, reference, time),
        travel=ways,
        sections=around,
        sizing=size_motors(experiment.nominal, reference, time) if left is None else None,
        clearance=study_clearance(mechanism, time, poses, ways, around),
    )


def _bounds(section: Section) -> dict[str, Any]:
    """Return the extent of a section and its best condition number."""
    inside = np.isfinite(section.condition)

    def ends(values: Array, used: Any) -> list[float]:
        return [float(values[used][k]) if used.any() else np.nan for k in (0, -1)]

    return {
        "coordinates": [COORDINATES[section.first], COORDINATES[section.second]],
        "x": ends(section.x, inside.any(axis=0)),
        "y": ends(section.y, inside.any(axis=1)),
        "best_condition": least(section.condition),
    }


def least(values: Array) -> float:
    """Return the least of the numbers in an array, NaN for none."""
    numbers = values[np.isfinite(values)]
    return float(numbers.min()) if len(numbers) else np.nan
