"""One run of many: how it ended, and no record of it.

It takes the loop of core/plant.c where that has all that the scenario asks for, and Drake's where
it has not; both come to the same.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law import core_law
from stewart_drake.law.core_law import AnyMemory
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts
from stewart_drake.law.motion import KnownMotion, Motion, Preview
from stewart_drake.loop.experiment import Experiment, assemble
from stewart_drake.loop.law_design import first_queue, followed_motion
from stewart_drake.loop.metrics import Figures, accumulated_error, figures
from stewart_drake.loop.native_loop import (
    Course,
    InC,
    InPython,
    Instants,
    run_loop,
    uncovered,
)
from stewart_drake.loop.preparation import MakeTuner, Preparation, Prepared, preparation_of
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import POSE, TUNER_INPUTS, WEIGHTS
from stewart_drake.tuner.compiled import compiled_tuner
from stewart_drake.tuner.source import Decision
from stewart_drake.types import Array


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
