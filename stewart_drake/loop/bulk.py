"""Many runs without Drake: loop, link, law and tuner in C (theory.md, section 32).

A scenario that core/plant.h does not cover runs in Drake's loop, with the same results. A law or a
tuner with parts in Python is called by the loop in C at each sample.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.core.library import core
from stewart_drake.core.link import Link
from stewart_drake.dynamics.native_functions import one_blas_thread
from stewart_drake.dynamics.open_loop import Ended, IntegrationError, NativePlant
from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.law.channel import Packets, Report
from stewart_drake.law.compiled import Compiled
from stewart_drake.law.counts import Counts
from stewart_drake.law.coverage import backend, uncovered_part
from stewart_drake.law.motion import KnownMotion
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import ServoPreview
from stewart_drake.loop.law_design import (
    catch_up_of,
    compose_law,
    first_queue,
    sizing_of,
    white_errors,
    with_catch_up,
)
from stewart_drake.loop.link import begun, buffer_of, wire_of
from stewart_drake.loop.preparation import Experiment, network_of, prepare, prepare_unchecked
from stewart_drake.loop.results import Figures, SimulationResult, accumulated_error, figures
from stewart_drake.loop.sensor import white_noises
from stewart_drake.loop.servos import (
    command_sent_last,
    commands_in_flight,
    position_servo,
    servo_law,
)
from stewart_drake.loop.simulation import simulate
from stewart_drake.loop.tuner import weights_source
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import Accepted, differing
from stewart_drake.scenario.link import (
    forward_times,
    measurement_times,
    number_sent,
    torque_delays,
)
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import (
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    TUNER_INPUTS,
    WEIGHTS,
)
from stewart_drake.scenario.timing import event_time, instants, look_time
from stewart_drake.tuner.network import WINDOW
from stewart_drake.tuner.source import Decision, WeightsSource
from stewart_drake.types import Array, Flags

SHARE: Final = 0.1
"""Tolerance of an integration step over the scenario's accuracy. With steps of order 8, one more
digit costs a sixth more time."""
COVERED: Final[Accepted] = {
    "plant.kind": "exact",
    "actuator.kind": ("torque", "position_servo"),
    "sensor.kind": "state",
    "sensor.faults": [],
}
"""Values of the fields that the loop in C covers."""
_COVERED_SERVOS: Final[Accepted] = {
    "link.kind": "wire",
    "controller.estimate": [],
    "controller.learned": None,
    "sensor.delay": 0.0,  # the servos' reports come with the measurements
    "sensor.loss": 0.0,
}
_OF_A_RUN: Final = (
    *(("plant", name) for name in ("payload_mass", "torque_bias", "joint_damping")),
    *(("plant", name) for name in ("coulomb_friction", "push")),
    *(("sensor", name) for name in ("noise_std", "seed", "loss")),
    ("actuator", "torque_limit"),
    *(("controller", name) for name in ("w_Q", "w_R", "delay_steps", "delay_fraction")),
)
"""Fields of a scenario without effect on a `Preparation`, apart from the believed delay."""
_PREPARATIONS: Final = 16
"""Largest number of preparations that a process keeps."""

Made = TypeVar("Made")
MakeTuner = Callable[[Experiment, PredictiveLqi], WeightsSource | None]
"""Returns the tuner of an experiment with a law, or None for fixed weights."""


class Instants(NamedTuple):
    """Instants of a run at which Drake's simulator records and samples."""

    nominal: Array  # (n,) s, times in the record
    looks: Array  # (n,) s, times at which the state is recorded
    on_grid: Flags  # (n,) whether the metric counts each
    sampled: Flags  # (n,) whether the controller samples at each
    samples: Array  # (k,) s, of the controller's samples


def instants_of(duration: float, period: float) -> Instants:
    """Return the instants of a run, for its duration and the controller's period in s."""
    recorded = list(instants(duration, period, None))
    nominal = np.array([one.time for one in recorded])
    early = event_time(period)
    samples = np.append(0.0, early + early * np.arange(int(duration / period) + 2))
    return Instants(
        nominal=nominal,
        looks=look_time(1.0) * nominal,
        on_grid=np.array([one.on_grid for one in recorded]),
        sampled=np.array([one.sampled for one in recorded]),
        samples=samples[samples <= look_time(duration)],
    )


def uncovered(scenario: Scenario) -> str | None:
    """Return the field of a scenario that needs Drake's loop, or None."""
    found = differing(scenario, COVERED)
    if found is None and scenario.actuator.kind == "position_servo":
        found = differing(scenario, _COVERED_SERVOS)
    return found and found.field


class Ending(NamedTuple):
    status: str  # as of `loop.results.RunSummary`
    stopped: Failure | None  # when and why it did not complete, or None
    figures: Figures
    counts: dict[str, int]  # number of survived problems by name, as in the summary
    # (k, 18) at the controller's samples [measurement - reference (12); torque that the law asked
    # for (6)], in rad, m, rad/s, m/s and N m
    samples: Array
    error_so_far: float  # E_ac in % s up to the end, complete or not; NaN for a run without samples
    weights: Array  # (k, 2) w_Q and w_R at the samples
    # (k, n) row of the tuner's window for each sample (core/tuner.c); n = 0 without a tuner, and in
    # Drake's loop
    rows: Array
    # `native`, or the other loop and the field that made it necessary; empty if the true machine
    # cannot take the start pose
    loop: str


# ---------------------------------------------------------------- shared by runs


class Prepared(NamedTuple):
    experiment: Experiment
    law: PredictiveLqi | ServoPreview
    planned: Trajectory  # motion that the law follows
    tuner: WeightsSource | None  # tuner of the weights, None for fixed ones

    def motion(self, time: float) -> KnownMotion:
        """Return what the law follows and leads back to, at a sample at `time` s."""
        return KnownMotion(self.planned, self.experiment.reference, time)


class Preparation:
    """Common part of the runs of scenarios that differ in `_OF_A_RUN` and the true machine only.

    Attributes:
        when: instants of a run.
        references: (n, 12) pose and rates of the reference at `when.looks`.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._base = prepare(scenario)
        self._made: dict[tuple[Any, ...], Any] = {}
        self.when: Instants = instants_of(scenario.duration, scenario.controller.period)
        self.references = rows_along(self._base.reference, self.when.looks)[:, :NUM_STATE]

    def experiment(self, scenario: Scenario, truth: Mechanism | None = None) -> Experiment:
        scenario.check()
        true = self._base.truth if truth is None else truth
        return self._base._replace(scenario=scenario, truth=true, network=network_of(scenario))

    def prepared(self, experiment: Experiment, tuner: MakeTuner | None = None) -> Prepared:
        """Compose law, motion and tuner of a run; `tuner` replaces the scenario's."""
        if experiment.scenario.controller.command == "cranks":
            servos, motion, _ = servo_law(experiment)
            return Prepared(experiment, servos, motion, None)
        white = white_errors(experiment.scenario)
        law = compose_law(experiment, self._once(sizing_of, experiment, key=white))
        queue = experiment.torques_in_flight(law.timeline.delay).tobytes()
        decisive = queue, law.plant.substeps, experiment.scenario.controller.weights
        way = self._once(catch_up_of, experiment, law, key=decisive)
        law, motion, _ = with_catch_up(law, experiment, way)
        source = (tuner or weights_source)(experiment, law)
        return Prepared(experiment, law, motion, source)

    def _once(self, make: Callable[..., Made], *arguments: Any, key: Any) -> Made:
        """Return a result that is made once for all runs with the same key."""
        if (make.__name__, key) not in self._made:
            self._made[make.__name__, key] = make(*arguments)
        made: Made = self._made[make.__name__, key]
        return made


_prepared: dict[tuple[Any, ...], Preparation] = {}


def preparation_of(scenario: Scenario) -> Preparation:
    """Return the preparation of a scenario, made once for all scenarios that share it."""
    key = _key(scenario)
    if key not in _prepared:
        with one_blas_thread:
            made = Preparation(scenario)
        while len(_prepared) >= _PREPARATIONS:
            _prepared.pop(next(iter(_prepared)), None)
        _prepared[key] = made
    return _prepared[key]


def _key(scenario: Scenario) -> tuple[Any, ...]:
    """Return a key that is equal for scenarios with the same preparation."""
    fields, believed = scenario_to_dict(scenario), believed_delay(scenario)
    for section, name in _OF_A_RUN:
        del fields[section][name]
    del fields["tuner"]
    fields["delay"] = believed.steps, believed.fraction
    fields["link"] = scenario.link.kind
    machines = scenario.mechanism, scenario.plant.mechanism
    files = [resolve("mechanism", name) for name in machines if name is not None]
    motion = getattr(scenario.reference, "file", None)
    if motion is not None and scenario.reference.kind == "reachy_move":
        motion = resolve("move", motion)
    named = motion, scenario.controller.calibration
    files += [Path(name) for name in named if name is not None]
    return json.dumps(fields, default=str), *(_stamp(file) for file in files)


def _stamp(path: Path) -> tuple[int, int]:
    """Return time and size of a file, to notice a change of its content."""
    try:
        found = path.stat()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; expected a file") from None
    return found.st_mtime_ns, found.st_size


# ---------------------------------------------------------------- the loop in C


class LoopRecord(NamedTuple):
    states: Array  # (n, 12) at the looks up to the end
    measured: Array  # (k, 12) at the samples, as the controller got them
    asked: Array  # (k, 6) torques in N m that the law asked for there
    sent: Array  # (k, 6) the same within the limit
    stopped: Failure | None  # reason of an early end, or None
    saturated: int  # periods in which a servo reached its limit


class CompiledController:
    """Law and tuner in C, or the law for servos without estimates.

    Args:
        prepared: a run with a law that `law.coverage.uncovered_part` accepts.
        tuner: `stewart_tuner`, or None.
        wanted: (k, 12) reference at each sample, for a tuner.

    Attributes:
        weights: (k, 2) of each sample, after the run; NaN for servos.
        rows: (k, n) of the tuner's window, after the run, see `Ending`.
    """

    def __init__(self, prepared: Prepared, tuner: Compiled | None, wanted: Array) -> None:
        c, experiment, law = core(), prepared.experiment, prepared.law
        if isinstance(law, ServoPreview):
            self._memory = law.initial_memory(command_sent_last(experiment, law))
            report, weights = np.full(law.reports.size, np.nan), (np.nan, np.nan)
        else:
            self._memory = law.initial_memory(first_queue(experiment, law))
            report, weights = None, experiment.scenario.controller.weights
        compiled = self._memory.compiled
        samples, scratch = len(wanted), compiled.scratch
        self.weights, self.rows = np.tile(weights, (samples, 1)), np.empty((samples, 0))
        self._tuned = np.zeros(3)  # two weights, fallbacks
        if tuner is not None:
            self._tuned = np.empty(c.lib.stewart_tuner_memory(tuner.pointer))
            c.lib.stewart_tuner_start(tuner.pointer, c.at(self._tuned))
            self.rows = np.empty((samples, (len(self._tuned) - 3) // WINDOW))
            scratch = c.lib.stewart_tuned_step_scratch(compiled.data)
        motion = prepared.motion(0.0).compiled()
        self._kept = prepared, tuner, motion, np.ascontiguousarray(wanted), np.empty(scratch)
        self._report = report
        self.data = c.ffi.new(
            "stewart_law_in_loop *",
            {
                "law" if report is None else "servos": compiled.data,
                "tuner": c.ffi.NULL if tuner is None else tuner.pointer,
                "memory": c.at(self._memory.data),
                "tuner_memory": c.at(self._tuned),
                "scratch": c.at(self._kept[4]),
                "motion": motion[0],
                "period": event_time(law.timeline.period),
                "wanted": c.at(self._kept[3]),
                "weights": c.at(self.weights),
                "tuner_rows": c.at(self.rows),
                "columns": self.rows.shape[1],
                "report": c.at(report),
            },
        )

    @property
    def counts(self) -> Counts:
        return self._memory.counts

    @property
    def fallbacks(self) -> int:
        """Samples at which the tuner failed."""
        return int(self._tuned[2])


Controller = Callable[[int, Measurement, Report | None], tuple[Array, Array]]
"""(sample, measurement, report) -> torque (6,) without limit, torques (n, 6) to send."""


class PythonController:
    """`Controller` whose law or tuner has a part in Python.

    Attributes:
        weights: (2,) of each sample.
        rows: rows of the tuner's window, see `Ending`.
    """

    def __init__(self, prepared: Prepared, when: Instants, wanted: Array) -> None:
        experiment, law = prepared.experiment, prepared.law
        assert isinstance(law, PredictiveLqi)
        c = experiment.scenario.controller
        self._prepared, self._law, self._when, self._wanted = prepared, law, when, wanted
        self._memory: Any = law.initial_memory(first_queue(experiment, law))
        self._fixed = Decision(np.array(c.weights), False)
        source = prepared.tuner
        self._tuned: Any = None if source is None else source.start(self._memory)
        self.weights: list[Array] = []
        self.rows: list[Array] = []

    def __call__(
        self, sample: int, measured: Measurement, report: Report | None
    ) -> tuple[Array, Array]:
        law, source = self._law, self._prepared.tuner
        motion = self._prepared.motion(self._when.samples[sample])
        decision = self._fixed if source is None else source.decide(self._tuned)
        after = law.step(self._memory, measured, motion, decision.weights, report)
        if source is not None:
            self._tuned = source.observe(self._tuned, decision, after, self._wanted[sample])
            self.rows.append(source.row(self._tuned))
        self.weights.append(decision.weights)
        self._memory = after
        packets = isinstance(law.channel, Packets)
        return after.torque, after.sent.packets[-1] if packets else after.torque[None]

    @property
    def counts(self) -> Counts:
        counts: Counts = self._memory.counts
        return counts

    @property
    def fallbacks(self) -> int:
        return 0 if self._tuned is None else int(self._tuned.fallbacks)


def run_loop(
    experiment: Experiment,
    when: Instants,
    controller: CompiledController | Controller,
    law: PredictiveLqi | ServoPreview | None = None,
) -> LoopRecord:
    """Run an experiment to its end.

    Args:
        experiment: with a scenario that is not `uncovered`.
        when: `instants_of` its duration and period.
        law: law of the controller, for packets and reports; if None, single torques are sent.

    Raises:
        IntegrationError: no step is short enough for the accuracy.
        Exception: the exception of a controller in Python.
    """
    sc, sensor, number = experiment.scenario, experiment.scenario.sensor, len(when.samples)
    assert sensor.kind == "state"
    truth, accuracy = experiment.true_dynamics(biased=False), SHARE * sc.plant.accuracy
    plant = NativePlant(truth, experiment.start, when.looks, accuracy)
    noise, c = np.array(sensor.noise_std), core()
    drawn = noise * white_noises(sensor.seed, number) if noise.any() else None
    channel = law.channel if isinstance(law, PredictiveLqi) else None
    packets = channel if isinstance(channel, Packets) else None
    rows, repeats = (1, 0) if packets is None else (len(packets.in_time), packets.repeats)
    history = 1 if packets is None else packets.report_periods
    link, memory, transit = _link(experiment, law, number, rows, history)
    servos = None
    if isinstance(law, ServoPreview):
        rows, servos = NUM_REFERENCE // NUM_TORQUES, position_servo(experiment).compiled
    reports = link.history if packets is not None and sc.link.acknowledged else 0
    late = np.zeros(number)
    if sensor.delay or sensor.loss or sc.link.back is not None:  # drawing takes a millisecond
        late = _padded(measurement_times(sc), number)
    size = NUM_STATE + (1 + NUM_TORQUES) * reports
    back = wire_of(size, sc.controller.period, late)
    back_memory = back.start()
    scratch = np.empty(size + NUM_TORQUES * rows)
    measured, asked = np.empty((number, NUM_STATE)), np.empty((number, NUM_TORQUES))
    loop = c.ffi.new(
        "stewart_loop *",
        {
            "samples": number,
            "sampled": c.at(when.samples),
            "period": sc.controller.period,
            "link": link.data,
            "memory": c.at(memory),
            "transit": c.at(transit),
            "rows": rows,
            "repeats": repeats,
            "delay": sc.true_delay.periods,
            "noise": c.at(drawn),
            "back": back.data if late.any() else c.ffi.NULL,
            "back_memory": c.at(back_memory),
            "back_transit": c.at(late),
            "reported": reports,
            "bias": list(sc.plant.torque_bias),
            "push": sc.plant.push.wrench,
            "push_from": sc.plant.push.start,
            "push_to": sc.plant.push.end,
            "wrench": c.at(plant.wrench),
            "servo": servos or c.ffi.NULL,
            "scratch": c.at(scratch),
            "measured": c.at(measured),
            "asked": c.at(asked),
        },
    )
    if isinstance(controller, CompiledController):
        controller.data.rows = rows
        ended = plant.call("closed_loop_of_law", loop, controller.data)
    else:
        ended = _call_back(plant, loop, controller)
    stopped = plant.failure(ended)
    measured, asked = measured[: loop.taken], asked[: loop.taken]
    sent = np.clip(asked, -experiment.torque_limit, experiment.torque_limit)
    seen = plant.states[: plant.run.recorded]
    return LoopRecord(seen, measured, asked, sent, stopped, loop.saturated)


def _link(
    experiment: Experiment,
    law: PredictiveLqi | ServoPreview | None,
    number: int,
    rows: int,
    history: int,
) -> tuple[Link, Array, Array]:
    """Return the link to the motors, its memory at t = 0, and the transit times (number,) in s.

    Over a network packets have `rows` torques, and reports `history` periods.
    """
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period, size = sc.controller.period, NUM_TORQUES
    if isinstance(law, ServoPreview):
        _, queue = commands_in_flight(experiment, law, delay)
        size, limit = NUM_REFERENCE, np.inf
    else:
        queue, limit = experiment.torques_in_flight(delay), experiment.torque_limit
    if sc.link.kind == "network":
        transit = _padded(forward_times(sc, number), number)
        link = buffer_of(period, delay, rows, sc.link.dry, history, limit)
    else:
        drawn = [delay.eta(period)] if sc.delay.constant else torque_delays(sc)
        transit = np.array(drawn)[np.minimum(np.arange(number), len(drawn) - 1)]
        link = wire_of(size, period, transit, len(queue), limit)
    return link, begun(link, delay, period, queue), transit


def _padded(times: Array, number: int) -> Array:
    """Return the first times (number,); missing ones are infinite."""
    return np.append(times, np.full(number, np.inf))[:number]


def _call_back(plant: NativePlant, loop: Any, controller: Controller) -> Ended:
    """Run with a controller in Python, and raise its exceptions."""
    ffi, raised = core().ffi, list[BaseException]()

    def numbers(pointer: Any, *shape: int) -> Array:
        values = np.frombuffer(ffi.buffer(pointer, 8 * int(np.prod(shape))), np.float64)
        return values.reshape(shape)

    def step(_: object, number: int, sample: Any, torque: Any, command: Any) -> int:
        try:
            age = sample.age * loop.period
            measured = Measurement.of(numbers(sample.measurement, NUM_STATE), age)
            data, report = sample.report, None
            if data != ffi.NULL:
                acted = numbers(data.acted, data.periods, NUM_TORQUES).copy()
                report = Report(numbers(data.arrived, data.packets) > 0, acted, data.age)
            asked, sent = controller(number, measured, report)
            numbers(torque, NUM_TORQUES)[:] = asked
            numbers(command, loop.rows, NUM_TORQUES)[:] = sent
        except BaseException as error:  # it cannot pass through C
            raised.append(error)
            return 1
        return 0

    called = ffi.callback("stewart_controller", step)
    ended = plant.call("closed_loop", loop, called, ffi.NULL)
    if raised:
        raise raised[0]
    return ended


# ---------------------------------------------------------------- one run


def run_in_bulk(
    scenario: Scenario, truth: Mechanism | None = None, tuner: MakeTuner | None = None
) -> Ending:
    """Run a scenario, without a stability verdict.

    Args:
        scenario: to run.
        truth: the machine to simulate; that of the scenario's plant if None.
        tuner: replaces the scenario's tuner; not for Drake's loop.

    Raises:
        ConfigError: bad input, an unreachable reference.
        KeyboardInterrupt: Ctrl-C.
        ValueError: a `tuner` with a scenario that only Drake's loop can run.
    """
    only_drake = uncovered(scenario)
    if only_drake is not None:
        if tuner is not None:
            raise ValueError(f"tuner: got one for Drake's loop ({only_drake}); expected None")
        refused = _refused_start(prepare_unchecked(scenario, truth))
        return refused or _in_drake(scenario, truth, only_drake)
    preparation = preparation_of(scenario)
    experiment = preparation.experiment(scenario, truth)
    try:
        return _refused_start(experiment) or run_prepared(
            preparation, preparation.prepared(experiment, tuner)
        )
    except IntegrationError:
        if tuner is not None:
            raise
        return _in_drake(scenario, truth, "plant.accuracy")


def _refused_start(experiment: Experiment) -> Ending | None:
    """Return the end of a run whose true machine cannot take the start pose, else None."""
    failure = diagnose(experiment.truth, 0.0, experiment.start[POSE])
    if failure is None:
        return None
    counts, unknown = Counts().summary(), Figures(*[np.nan] * len(Figures._fields))
    samples, weights, rows = (np.empty((0, n)) for n in (len(TUNER_INPUTS), len(WEIGHTS), 0))
    return Ending("left_workspace", failure, unknown, counts, samples, np.nan, weights, rows, "")


def run_prepared(preparation: Preparation, prepared: Prepared) -> Ending:
    """Run a prepared run in C, with law and tuner in C if the core has all their parts."""
    law, when, source = prepared.law, preparation.when, prepared.tuner
    wanted, experiment = preparation.references[when.sampled], prepared.experiment
    controller: CompiledController | PythonController
    if uncovered_part(law) is not None:
        controller = PythonController(prepared, when, wanted)
        with one_blas_thread:
            course = run_loop(experiment, when, controller, law)
    else:
        tuner = None if source is None else source.compiled
        controller = CompiledController(prepared, tuner, wanted)
        course = run_loop(experiment, when, controller, law)
    looked = len(course.states)
    error = course.states[:, POSE] - preparation.references[:looked, POSE]
    grid, sampled = when.on_grid[:looked], when.sampled[:looked]
    time, taken, done = when.nominal[:looked][grid], int(sampled.sum()), course.stopped is None
    asked, sent, measured = (x[:taken] for x in (course.asked, course.sent, course.measured))
    weights, rows = (np.array(x[:taken]) for x in (controller.weights, controller.rows))
    found = figures(
        time=time,
        error=error[grid],
        scale=experiment.scale,
        errors=error[sampled],
        asked=asked,
        sent=sent,
        controller=experiment.scenario.controller,
        completed=done,
    )
    counts = controller.counts.plus(*["saturated_steps"] * course.saturated)
    return Ending(
        status="completed" if done else "left_workspace",
        stopped=course.stopped,
        figures=found,
        counts=counts.summary(controller.fallbacks),
        samples=np.hstack([measured - wanted[:taken], asked]),
        error_so_far=accumulated_error(time, error[grid], experiment.scale),
        weights=weights.reshape(taken, len(WEIGHTS)),
        rows=rows.reshape(taken, rows.size // max(taken, 1)),
        loop=backend(law),
    )


def _in_drake(scenario: Scenario, truth: Mechanism | None, field: str) -> Ending:
    logged = dataclasses.replace(scenario, log_period=None)  # a log with all samples
    result = simulate(logged, true_mechanism=truth, judge_stability=False)
    if result.status == "interrupted":
        raise KeyboardInterrupt
    return ending_of(result, f"drake, {field}")


def ending_of(result: SimulationResult, loop: str = "drake") -> Ending:
    """Return the end of a simulation; its log must hold every sample, as it does by default."""
    summary: dict[str, Any] = {**result.summary}
    samples, signals = samples_of(result), result.signals
    so_far, weights = np.nan, np.empty((0, len(WEIGHTS)))
    if signals.sizes["time"]:
        scale = prepare_unchecked(result.scenario).scale
        so_far = accumulated_error(signals.time.values, signals.error.values, scale)
        at = result.scenario.controller.period * np.arange(len(samples))
        weights = signals.weights.sel(time=at, method="nearest").values
    return Ending(
        status=result.status,
        stopped=result.stopped,
        figures=Figures(*(summary[name] for name in Figures._fields)),
        counts=summary["counts"],
        samples=samples,
        error_so_far=so_far,
        weights=weights,
        rows=np.empty((len(samples), 0)),
        loop=loop,
    )


def samples_of(result: SimulationResult) -> Array:
    """Return the samples (k, 18) of an `Ending` from a log that holds every sample."""
    signals, sc = result.signals, result.scenario
    if not signals.sizes["time"]:
        return np.empty((0, len(TUNER_INPUTS)))
    # A logged value holds from its time on, so that at k dt is T_k.
    period = sc.controller.period
    at = period * np.arange(number_sent(signals.time.values[-1], period))
    kept = signals.sel(time=at, method="nearest")
    wanted = np.hstack([kept.reference, kept.reference_rates])
    state = kept.measurement if sc.sensor.measures_state else kept.state_estimate
    return np.hstack([state - wanted, kept.torque_commanded])
