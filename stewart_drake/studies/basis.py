"""What every analysis of a scenario starts from, also where its motion cannot be followed."""

from typing import NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.startup import least_torque, reference_torques
from stewart_drake.loop.experiment import (
    REACH_CHECK_PERIOD,
    Experiment,
    assemble,
    motion_scale,
    reference_failure,
)
from stewart_drake.scenario.config import Scenario
from stewart_drake.types import Array


class Basis(NamedTuple):
    """A scenario made concrete, judged, and measured."""

    experiment: Experiment
    failure: Failure | None
    """Where and why the reference leaves the workspace, or None."""
    home_failure: Failure | None
    """Why the home pose is no place to work at, or None; its time means nothing."""
    motion: Array
    """(6,) usual size of the pose, rad and m: half the reference's peak to peak."""
    torque: float
    """Usual size of a torque, N m: the largest that following the reference takes; where it cannot
    be followed, that of a median instant, since torques may grow without bound on the way out."""

    @property
    def obstacles(self) -> tuple[str, ...]:
        """What stands in the way, in sentences; none where everything is well."""
        sentences = []
        if self.home_failure is not None:
            sentences.append(f"At the home pose: {self.home_failure.reason}.")
        if self.failure is not None:
            short = -1e3 * self.failure.margin
            sentences.append(
                "The reference cannot be followed: "
                f"{self.failure.reason} at t = {self.failure.time:.2f} s"
                + (f", short by {short:.3g} mm." if short > 0 and self.failure.leg else ".")
            )
        return tuple(sentences)

    @property
    def followed_until(self) -> float:
        """s, the last instant at which the reference is known to be in the workspace."""
        return _end(self.experiment.scenario.duration, self.failure)


def basis(scenario: Scenario) -> Basis:
    """Make a scenario concrete without insisting that it can be run.

    Raises:
        ConfigError: one line.
        UnreachablePoseError: the mechanism cannot be assembled at its home pose.
    """
    experiment = assemble(scenario)
    mechanism, reference = experiment.mechanism, experiment.reference
    failure = reference_failure(experiment)
    end, torque = _end(scenario.duration, failure), 0.0
    if end > 0:
        torques = reference_torques(experiment.nominal, reference, end)
        torque = float(torques.max() if failure is None else np.median(torques))
    return Basis(
        experiment=experiment,
        failure=failure,
        home_failure=diagnose(mechanism, 0.0, mechanism.home),
        motion=motion_scale(experiment),
        torque=max(torque, least_torque(experiment.nominal)),
    )


def _end(duration: float, failure: Failure | None) -> float:
    return duration if failure is None else max(0.0, failure.time - REACH_CHECK_PERIOD)
