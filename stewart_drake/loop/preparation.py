"""What many runs of one scenario have in common, computed once in a process.

Runs differ in what a machine is, in its disturbances, its noise, its torque limit. Mechanism and
motion, their check, the sizes that the law takes from them, the ways onto the reference and its
previews stay.
"""

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.files.schema import plain
from stewart_drake.law.catch_up import CatchUp
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.experiment import (
    Experiment,
    believed_delay,
    network_of,
    planned_limit,
    prepare,
    torques_in_flight,
)
from stewart_drake.loop.law_design import compose_law, sizing_of, way_onto
from stewart_drake.loop.native_loop import Instants, instants_of
from stewart_drake.loop.tuner import weights_source
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import NUM_STATE
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.tuner.source import WeightsSource
from stewart_drake.types import Array

MakeTuner = Callable[[Experiment, PredictiveLqi], WeightsSource | None]
"""What sets the weights of an experiment with such a law, None where they are fixed."""

_DRAWN: Final = (
    ("plant", "payload_mass"),
    ("plant", "torque_bias"),
    ("plant", "joint_damping"),
    ("plant", "coulomb_friction"),
    ("sensor", "noise_std"),
    ("sensor", "seed"),
    ("actuator", "torque_limit"),
    ("controller", "w_Q"),
    ("controller", "w_R"),
)
"""Fields of a scenario that nothing here depends on; of the delay only what is believed counts."""


class Prepared(NamedTuple):
    """One run, ready to begin.

    Attributes:
        experiment: what is run.
        law: of its torques.
        planned: the motion that it follows.
        previews: (k, p, 18) of it, for each sample.
        tuner: what sets its weights, None where they are fixed.
    """

    experiment: Experiment
    law: PredictiveLqi
    planned: Trajectory
    previews: Array
    tuner: WeightsSource | None


class Preparation:
    """Of one scenario and all that differ from it in `_DRAWN` and in the true machine.

    Args:
        scenario: one of them.

    Attributes:
        when: the instants of a run.
        references: (n, 12) pose and rates that are wanted at its looks.

    Raises:
        ConfigError: as `prepare`.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._base = prepare(scenario)
        self._sizing = sizing_of(self._base)
        self._ways: dict[bytes, CatchUp | None] = {}
        self._previews: dict[int, tuple[Trajectory, Array]] = {}
        self.when: Instants = instants_of(scenario.duration, scenario.controller.period)
        reference = self._base.reference
        self.references = np.array([evaluate(reference, t)[:NUM_STATE] for t in self.when.looks])

    def experiment(self, scenario: Scenario, truth: Mechanism | None = None) -> Experiment:
        """What `prepare` would return.

        Raises:
            ConfigError: the scenario's fields do not go together.
        """
        scenario.check()
        true = self._base.truth if truth is None else truth
        return self._base._replace(scenario=scenario, truth=true, network=network_of(scenario))

    def prepared(self, experiment: Experiment, tuner: MakeTuner | None = None) -> Prepared:
        """Law and previews as of `control_law`, which says what may go wrong.

        A tuner takes the place of the scenario's.
        """
        law = compose_law(experiment, self._sizing)
        queue = torques_in_flight(experiment, law.timeline.delay).tobytes()
        if queue not in self._ways:
            self._ways[queue] = way_onto(experiment, law)
        way, motion = self._ways[queue], experiment.reference
        if way is not None:
            sc = experiment.scenario
            motion, _ = way.plan(sc.controller.catch_up, planned_limit(sc))
        source = (tuner or weights_source)(experiment, law)
        return Prepared(experiment, law, motion, self._preview(motion, law), source)

    def _preview(self, motion: Trajectory, law: PredictiveLqi) -> Array:
        """(k, p, 18), as of `loop.reference.Reference`."""
        if id(motion) not in self._previews:
            times = np.maximum(0.0, self.when.samples[:, None] + law.preview_times)
            rows = [[evaluate(motion, t) for t in ahead] for ahead in times]
            self._previews[id(motion)] = motion, np.array(rows)  # kept, so that its id is
        return self._previews[id(motion)][1]


def preparation_of(scenario: Scenario) -> Preparation:
    """That of a scenario, made once for all with which it has it in common.

    Raises:
        ConfigError: as `prepare`.
    """
    return _preparation(_Key(scenario))


class _Key:
    """A scenario that is equal to others where they have their preparation in common."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        fields, believed = scenario_to_dict(scenario), believed_delay(scenario)
        for section, name in _DRAWN:
            del fields[section][name]
        del fields["tuner"]
        fields["delay"] = believed.steps, believed.fraction
        fields["link"] = plain(scenario.assumed_link)
        fields["controller"] |= {"delay_steps": None, "delay_fraction": None}
        machines = scenario.mechanism, scenario.plant.mechanism
        files = [resolve("mechanism", name) for name in machines if name is not None]
        named = getattr(scenario.reference, "file", None), scenario.controller.calibration
        files += [Path(name) for name in named if name is not None]
        self._key = json.dumps(fields, default=str), *(_stamp(file) for file in files)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


def _stamp(path: Path) -> tuple[int, int]:
    """By which another content of a file shows."""
    try:
        found = path.stat()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; expected a file") from None
    return found.st_mtime_ns, found.st_size


@lru_cache(maxsize=16)
def _preparation(key: _Key) -> Preparation:
    with one_blas_thread:
        return Preparation(key.scenario)
