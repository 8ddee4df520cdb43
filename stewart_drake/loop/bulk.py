"""One run of many: how it ended, and no record of it.

It takes the loop of native/plant.c where that has all that the scenario asks for, and Drake's where
it has not; both come to the same.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.open_loop import IntegrationError
from stewart_drake.dynamics.threads import one_blas_thread
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law import native_law
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts
from stewart_drake.law.motion import KnownMotion, Motion, Preview
from stewart_drake.loop.experiment import Experiment, assemble, first_queue, followed_motion
from stewart_drake.loop.metrics import Figures, figures
from stewart_drake.loop.native_loop import (
    Course,
    InC,
    InPython,
    Instants,
    run_loop,
    uncovered,
)
from stewart_drake.loop.preparation import Preparation, Prepared, preparation_of
from stewart_drake.loop.results import SimulationResult
from stewart_drake.loop.simulation import simulate
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario, StateSensorConfig
from stewart_drake.scenario.signals import POSE, TUNER_INPUTS

Array = NDArray[np.float64]


class Ending(NamedTuple):
    """How a run ended.

    Attributes:
        status: as of `loop.results.RunSummary`.
        stopped: when and why it did not complete, or None.
        figures: what it came to.
        counts: what went wrong and was survived, by name, as in the summary.
        samples: (k, 18) at the controller's samples [measurement - reference (12); torque that the
            law asked for (6)], in rad, m, rad/s, m/s and N m.
        loop: what ran it: `native`, or what else, and what of the scenario made it necessary;
            nothing where the true machine cannot stand where the run begins.
    """

    status: str
    stopped: Failure | None
    figures: Figures
    counts: dict[str, int]
    samples: Array
    loop: str


def run_in_bulk(scenario: Scenario, truth: Mechanism | None = None) -> Ending:
    """Run a scenario, without a judgement beforehand.

    Args:
        scenario: what to run.
        truth: the machine to simulate where it is not the one that the controller knows.

    Raises:
        ConfigError: bad input, an unreachable reference.
        KeyboardInterrupt: Ctrl-C.
    """
    only_drake = uncovered(scenario)
    if only_drake is not None:
        outside = _outside(assemble(scenario, truth))
        return outside or _in_drake(scenario, truth, only_drake)
    preparation = preparation_of(scenario)
    experiment = preparation.experiment(scenario, truth)
    try:
        return _outside(experiment) or _in_c(preparation, preparation.prepared(experiment))
    except IntegrationError:
        return _in_drake(scenario, truth, "plant.accuracy")


def _outside(experiment: Experiment) -> Ending | None:
    """The end of a run whose true machine cannot stand where it begins."""
    failure = diagnose(experiment.truth, 0.0, experiment.start[POSE])
    if failure is None:
        return None
    counts = Counts().summary() | {"tuner_fallbacks": 0}
    nothing = Figures(*[np.nan] * len(Figures._fields))
    return Ending("left_workspace", failure, nothing, counts, np.empty((0, len(TUNER_INPUTS))), "")


class PythonLaw:
    """The law of a prepared run, sample by sample.

    Attributes:
        memory: as of the last sample.
    """

    def __init__(self, prepared: Prepared, when: Instants) -> None:
        experiment, law = prepared.experiment, prepared.law
        c = experiment.scenario.controller
        self._law, self._previews, self._when = law, prepared.previews, when
        self._weights = np.array([c.w_Q, c.w_R])
        self._followed = followed_motion(experiment, law, prepared.planned)
        self.memory = law.initial_memory(first_queue(experiment, law))

    def torque(self, sample: int, measurement: Array) -> Array:
        """The torque (6,) of a sample."""
        motion: Motion = Preview(self._law.preview_times, self._previews[sample])
        if self._followed is not None:
            motion = KnownMotion(*self._followed, self._when.samples[sample])
        measured = Measurement.of(measurement)
        self.memory = self._law.step(self.memory, measured, motion, self._weights)
        return self.memory.torque


def _in_c(preparation: Preparation, prepared: Prepared) -> Ending:
    experiment, law, when = prepared.experiment, prepared.law, preparation.when
    only_python = native_law.uncovered(law)
    if only_python is None:
        c = experiment.scenario.controller
        queue = first_queue(experiment, law)
        in_c = InC(law, queue, prepared.previews, np.array([c.w_Q, c.w_R]))
        course = run_loop(experiment, when, in_c)
        return _ending(preparation, prepared, course, in_c.counts, "native")
    in_python = PythonLaw(prepared, when)
    with one_blas_thread:
        course = run_loop(experiment, when, InPython(in_python.torque))
    loop = f"native, law in Python ({only_python})"
    return _ending(preparation, prepared, course, in_python.memory.counts, loop)


def _ending(
    preparation: Preparation, prepared: Prepared, course: Course, counts: Counts, loop: str
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
    told = counts.summary() | {"tuner_fallbacks": 0}
    return Ending(status, course.stopped, found, told, samples, loop)


def _in_drake(scenario: Scenario, truth: Mechanism | None, field: str) -> Ending:
    # A log of one's own period need not hold the samples.
    result = simulate(dataclasses.replace(scenario, log_period=None), truth=truth, margin=False)
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
    samples = samples_of(result)
    return Ending(result.status, result.stopped, found, summary["counts"], samples, loop)


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
    measures_state = isinstance(sc.sensor, StateSensorConfig)
    state = kept.measurement if measures_state else kept.state_estimate
    return np.hstack([state - wanted, kept.torque_commanded])
