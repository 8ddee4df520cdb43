"""One run of many: how it ended, and no record of it.

It takes the loop of core/plant.c where that has all that the scenario asks for, and Drake's where
it has not; both come to the same.
"""

import dataclasses
import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.files.schema import plain
from stewart_drake.law import core_law
from stewart_drake.law.catch_up import CatchUp
from stewart_drake.law.core_law import AnyMemory
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts
from stewart_drake.law.motion import KnownMotion, Motion, Preview
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.law_design import (
    compose_law,
    first_queue,
    followed_motion,
    sizing_of,
    way_onto,
)
from stewart_drake.loop.native_loop import (
    Course,
    InC,
    InPython,
    Instants,
    instants_of,
    run_loop,
    uncovered,
)
from stewart_drake.loop.preparation import Experiment, assemble, network_of, prepare
from stewart_drake.loop.results import Figures, SimulationResult, accumulated_error, figures
from stewart_drake.loop.simulation import simulate
from stewart_drake.loop.tuner import weights_source
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import NUM_STATE, POSE, TUNER_INPUTS, WEIGHTS
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.tuner.compiled import compiled_tuner
from stewart_drake.tuner.source import Decision, WeightsSource
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
        queue = experiment.torques_in_flight(law.timeline.delay).tobytes()
        if queue not in self._ways:
            self._ways[queue] = way_onto(experiment, law)
        way, motion = self._ways[queue], experiment.reference
        if way is not None:
            sc = experiment.scenario
            motion, _ = way.plan(sc.controller.catch_up, experiment.planned_limit)
        source = (tuner or weights_source)(experiment, law)
        return Prepared(experiment, law, motion, self._preview(motion, law), source)

    def _preview(self, motion: Trajectory, law: PredictiveLqi) -> Array:
        """(k, p, 18), as of `loop.controller.Reference`."""
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


class Ending(NamedTuple):
    """How a run ended.

    Attributes:
        status: as of `loop.results.RunSummary`.
        stopped: when and why it did not complete, or None.
        figures: what it came to.
        counts: what went wrong and was survived, by name, as in the summary.
        samples: (k, 18) at the controller's samples [measurement - reference (12); torque that the
            law asked for (6)], in rad, m, rad/s, m/s and N m.
        error_so_far: E_ac in % s up to the end, wherever that was; NaN where nothing ran.
        weights: (k, 2) w_Q and w_R at the samples.
        rows: (k, n) what a tuner's features keep of each sample (`tuner.features`); n = 0 where
            there is no tuner, or Drake ran it.
        loop: what ran it: `native`, or what else, and what of the scenario made it necessary;
            nothing where the true machine cannot stand where the run begins.
    """

    status: str
    stopped: Failure | None
    figures: Figures
    counts: dict[str, int]
    samples: Array
    error_so_far: float
    weights: Array
    rows: Array
    loop: str


def run_in_bulk(
    scenario: Scenario, truth: Mechanism | None = None, tuner: MakeTuner | None = None
) -> Ending:
    """Run a scenario, without a judgement beforehand.

    Args:
        scenario: what to run.
        truth: the machine to simulate where it is not the one that the controller knows.
        tuner: what sets the weights, in the place of the scenario's; not for Drake's loop.

    Raises:
        ConfigError: bad input, an unreachable reference.
        KeyboardInterrupt: Ctrl-C.
        ValueError: a tuner of one's own where only Drake's loop can run the scenario.
    """
    only_drake = uncovered(scenario)
    if only_drake is not None and tuner is not None:
        raise ValueError(f"tuner: got one for Drake's loop ({only_drake}); expected None")
    if only_drake is not None:
        outside = _outside(assemble(scenario, truth))
        return outside or _in_drake(scenario, truth, only_drake)
    preparation = preparation_of(scenario)
    experiment = preparation.experiment(scenario, truth)
    try:
        return _outside(experiment) or _in_c(preparation, preparation.prepared(experiment, tuner))
    except IntegrationError:
        if tuner is not None:
            raise
        return _in_drake(scenario, truth, "plant.accuracy")


def _outside(experiment: Experiment) -> Ending | None:
    """The end of a run whose true machine cannot stand where it begins."""
    failure = diagnose(experiment.truth, 0.0, experiment.start[POSE])
    if failure is None:
        return None
    counts = Counts().summary() | {"tuner_fallbacks": 0}
    nothing = Figures(*[np.nan] * len(Figures._fields))
    samples, weights, rows = (np.empty((0, n)) for n in (len(TUNER_INPUTS), len(WEIGHTS), 0))
    return Ending("left_workspace", failure, nothing, counts, samples, np.nan, weights, rows, "")


class SampledLaw:
    """The law of a prepared run, sample by sample, and the tuner that sets its weights, if any.

    Attributes:
        memory: as of the last sample.
        tuner: what the tuner remembers, None where weights are fixed.
        weights: (2,) of each sample.
        rows: what the tuner's features keep of each, see `Ending`.
    """

    def __init__(self, prepared: Prepared, when: Instants, wanted: Array) -> None:
        experiment, law = prepared.experiment, prepared.law
        c = experiment.scenario.controller
        self._law, self._previews, self._when = law, prepared.previews, when
        self._wanted, self._fixed = wanted, Decision(np.array([c.w_Q, c.w_R]), False)
        self._followed = followed_motion(law, prepared.planned, experiment.reference)
        self._served = core_law.serving(law).law
        self.memory: AnyMemory = self._served.initial_memory(first_queue(experiment, law))
        self._source = prepared.tuner
        self.tuner = None if self._source is None else self._source.start(self.memory)
        self.weights: list[Array] = []
        self.rows: list[Array] = []

    def torque(self, sample: int, measurement: Array) -> Array:
        """The torque (6,) of a sample."""
        motion: Motion = Preview(self._law.preview_times, self._previews[sample])
        if self._followed is not None:
            motion = KnownMotion(*self._followed, self._when.samples[sample])
        measured, decision = Measurement.of(measurement), self._fixed
        if self._source is not None and self.tuner is not None:
            decision = self._source.decide(self.tuner)
        after = self._served.step(self.memory, measured, motion, decision.weights)
        if self._source is not None and self.tuner is not None:
            wanted = self._wanted[sample]
            self.tuner = self._source.observe(self.tuner, decision, after, wanted)
            self.rows.append(self.tuner.window[-1])
        self.weights.append(decision.weights)
        self.memory = after
        return after.torque


def _in_c(preparation: Preparation, prepared: Prepared) -> Ending:
    experiment, law, when = prepared.experiment, prepared.law, preparation.when
    only_python, wanted = core_law.uncovered(law), preparation.references[when.sampled]
    tuner = None if prepared.tuner is None else compiled_tuner(prepared.tuner)
    known = followed_motion(law, prepared.planned, experiment.reference) is None
    if only_python is None and known and (prepared.tuner is None) == (tuner is None):
        c = experiment.scenario.controller
        weights = np.array([c.w_Q, c.w_R])
        queue = first_queue(experiment, law)
        in_c = InC(law, queue, prepared.previews, weights, tuner, wanted)
        course = run_loop(experiment, when, in_c)
        ending = _ending(preparation, prepared, course, in_c.counts, "native")
        taken = len(course.asked)
        return ending._replace(weights=in_c.weights[:taken], rows=in_c.rows[:taken])
    sampled = SampledLaw(prepared, when, wanted)
    with one_blas_thread:
        course = run_loop(experiment, when, InPython(sampled.torque))
    loop = "native, weights in Python (tuner.kind)"
    if only_python is not None:
        loop = f"native, law in Python ({only_python})"
    elif not known:
        loop = "native, reference in Python (controller.delay_estimator)"
    fallbacks = 0 if sampled.tuner is None else sampled.tuner.fallbacks
    counts = sampled.memory.counts.summary() | {"tuner_fallbacks": fallbacks}
    ending = _ending(preparation, prepared, course, counts, loop)
    if sampled.tuner is None:
        return ending
    return ending._replace(weights=np.array(sampled.weights), rows=np.array(sampled.rows))


def _ending(
    preparation: Preparation,
    prepared: Prepared,
    course: Course,
    counts: dict[str, int],
    loop: str,
) -> Ending:
    when, looked = preparation.when, len(course.states)
    error = course.states[:, POSE] - preparation.references[:looked, POSE]
    grid, sampled = when.on_grid[:looked], when.sampled[:looked]
    taken = int(sampled.sum())
    experiment = prepared.experiment
    found = figures(
        when.nominal[:looked][grid],
        error[grid],
        experiment.scale,
        error[sampled],
        course.asked[:taken],
        course.sent[:taken],
        experiment.scenario.controller,
        course.stopped is None,
    )
    status = "completed" if course.stopped is None else "left_workspace"
    wanted = preparation.references[:looked][sampled]
    samples = np.hstack([course.measured[:taken] - wanted, course.asked[:taken]])
    so_far = accumulated_error(when.nominal[:looked][grid], error[grid], experiment.scale)
    c = experiment.scenario.controller
    weights = np.tile([c.w_Q, c.w_R], (taken, 1))
    rows = np.empty((taken, 0))
    return Ending(status, course.stopped, found, counts, samples, so_far, weights, rows, loop)


def _in_drake(scenario: Scenario, truth: Mechanism | None, field: str) -> Ending:
    # A log of one's own period need not hold the samples.
    result = simulate(
        dataclasses.replace(scenario, log_period=None), true_mechanism=truth, judge_stability=False
    )
    if result.status == "interrupted":
        raise KeyboardInterrupt
    return ending_of(result, f"drake, {field}")


def ending_of(result: SimulationResult, loop: str = "drake") -> Ending:
    """How a simulation ended, whose log holds every sample, as it does by default."""
    summary = result.summary
    found = Figures(
        accumulated_error=summary["accumulated_error"],
        cost=summary["cost"],
        peak_torque=summary["peak_torque"],
        rms_torque=summary["rms_torque"],
        torque_variation=summary["torque_variation"],
    )
    samples, signals = samples_of(result), result.signals
    so_far, weights = np.nan, np.empty((0, len(WEIGHTS)))
    if signals.sizes["time"]:
        scale = assemble(result.scenario).scale
        so_far = accumulated_error(signals.time.values, signals.error.values, scale)
        at = result.scenario.controller.period * np.arange(len(samples))
        weights = signals.weights.sel(time=at, method="nearest").values
    rows, counts = np.empty((len(samples), 0)), summary["counts"]
    return Ending(
        result.status, result.stopped, found, counts, samples, so_far, weights, rows, loop
    )


def samples_of(result: SimulationResult) -> Array:
    """(k, 18), see `Ending`, of a log that holds every sample."""
    signals, sc = result.signals, result.scenario
    if not signals.sizes["time"]:
        return np.empty((0, len(TUNER_INPUTS)))
    # Held signals show the value from an instant on, so that of k dt is T_k.
    number = int(float(signals.time.values[-1]) / sc.controller.period + 1e-9) + 1
    at = sc.controller.period * np.arange(number)
    kept = signals.sel(time=at, method="nearest")
    wanted = np.hstack([kept.reference, kept.reference_rates])
    # Where the state is not measured its estimate stands for it.
    state = kept.measurement if sc.sensor.measures_state else kept.state_estimate
    return np.hstack([state - wanted, kept.torque_commanded])
