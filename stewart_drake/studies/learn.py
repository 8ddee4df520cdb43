"""Learning a torque, or setpoints, from repetitions of a motion (theory.md, section 43).

Each repetition simulates the scenario for some periods of its motion. What the model or the cranks
lacked in the last period is fitted by harmonics of the motion. From the fit follow the coefficients
g(c) of a learned signal that would have made up for it, where c are those that were used.
`Anderson` solves c = g(c).
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.learned import LearnedSignal, harmonics, with_learned
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.loop.learned import HARMONICS, determined_by, harmonics_below, motion_period
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.loop.results import SimulationResult, accumulated_error
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import ControllerConfig, Scenario
from stewart_drake.scenario.link import number_sent
from stewart_drake.scenario.signals import CONSTANTS, NUM_PARAMETERS, POSE, RATES
from stewart_drake.studies.jobs import Progress
from stewart_drake.studies.study_options import LearnOptions
from stewart_drake.types import Array

_NEWTON: Final = 2
"""Steps of Newton's method for a lacking torque, which is nearly linear in the rates."""
_SETTLING: Final = 5.0
"""Time before the last period of a repetition, in delays."""
_DEPTH: Final = 3
"""Largest number of differences of repetitions in a step of Anderson's method."""
_POINTS: Final = 100
"""Instants of a period at which a learned torque or angle is looked at."""
_CAUSES: Final = ("payload_position", "coulomb")
"""What an estimator finds better than a repetition does."""
_PATIENCE: Final = 2
"""Repetitions without a smaller error, one after the other, that end learning."""


@dataclass(frozen=True, eq=False)
class Repetition:
    learned: LearnedSignal | None  # torque or angles that were used, or None in the first one
    result: SimulationResult
    error: float  # see `Measure`; infinite if it did not complete

    @property
    def largest(self) -> float:
        """Largest learned torque or angle, N m or rad."""
        if self.learned is None:
            return 0.0
        times = np.linspace(0.0, self.learned.period, _POINTS)
        return float(np.abs(self.learned(times)).max())


class Measure(NamedTuple):
    """Error of a repetition by which the best one is chosen."""

    name: str
    unit: str


PERIOD_ERROR: Final = Measure("E of one period", "% s")


@dataclass(frozen=True)
class LearnStudy:
    experiment: Experiment  # of the scenario
    period: float  # of the motion, s
    repetitions: Sequence[Repetition]  # in order
    asked: int  # number of repetitions that were asked for
    interrupted: bool  # whether it ended early for another reason than its errors
    lacking: bool = False  # whether the last repetition had too few measurements to learn from
    measure: Measure = PERIOD_ERROR
    file: str = "learned.npz"  # with the learned torque or angles

    @property
    def best(self) -> Repetition:
        return min(self.repetitions, key=lambda one: one.error)

    @property
    def setpoints(self) -> bool:
        """Whether setpoints are learned, rather than torques."""
        return self.experiment.scenario.controller.command == "cranks"

    @property
    def competing(self) -> list[str]:
        """Settings that keep the controller from taking a part of the lacking torque.

        None with encoders, where rates need the estimator, and the integral alone hardly matters.
        """
        sc = self.experiment.scenario
        controller = sc.controller
        estimator = ["controller.estimate=[]"] if controller.estimate else []
        integral = ["controller.integral=false"] if controller.integral else []
        return estimator + integral if sc.sensor.measures_state and not self.setpoints else []

    @property
    def estimable(self) -> str | None:
        """Setting by which an estimator that encoders need finds friction and payload, or None."""
        sc = self.experiment.scenario
        present = sc.controller.estimate or ControllerConfig().estimate
        more = [one for one in _CAUSES if one not in present]
        if self.setpoints or sc.sensor.measures_state or not more:
            return None
        return f"controller.estimate=[{','.join([*present, *more])}]"

    @property
    def stopped(self) -> bool:
        """Whether it ended because the error no longer fell."""
        early = len(self.repetitions) < self.asked
        return early and not (self.interrupted or self.lacking or self.lost)

    @property
    def lost(self) -> bool:
        """Whether the last repetition did not complete, so that nothing is learned from it."""
        return self.repetitions[-1].result.stopped is not None

    @property
    def summary(self) -> dict[str, Any]:
        return {
            "period": self.period,
            "errors": [one.error for one in self.repetitions],
            "statuses": [one.result.status for one in self.repetitions],
            "best": 1 + list(self.repetitions).index(self.best),
            "stopped": self.stopped,
            "interrupted": self.interrupted,
            "lacking_measurements": self.lacking,
        }


def check_learning(scenario: Scenario) -> None:
    """Refuse a scenario in which nothing can be learned."""
    if scenario.controller.learned is not None:
        raise ConfigError("controller.learned: got a file; expected null, where learning begins")
    motion_period(scenario)
    LearnOptions().check_scenario(scenario)
    # The rules for a file hold for what is learned.
    asking = replace(scenario, controller=replace(scenario.controller, learned="learned.npz"))
    asking.check()


def study_learn(
    scenario: Scenario, options: LearnOptions, progress: Progress | None = None
) -> LearnStudy:
    """Repeat the motion of a scenario, and learn from each repetition.

    Learning ends early after two repetitions without a smaller error, or one that is lost or has
    too few measurements. Each repetition has other noise. The motion is periodic, the link a wire
    of known delay.
    """
    check_learning(scenario)
    lessons = Lessons(scenario)
    period, dt = lessons.period, scenario.controller.period
    eta = believed_delay(scenario).eta(dt)
    periods = 1 + math.ceil(max(1.0, _SETTLING * eta / period))
    run = replace(scenario, duration=dt * math.ceil(periods * period / dt - 1e-9), log_period=None)
    experiment = prepare(run)
    done: list[Repetition] = []
    learned: LearnedSignal | None = None
    interrupted = few = False
    lacking = lacking_torques if lessons.lag is None else lacking_angles
    for k in range(options.repetitions):
        if progress is not None:
            progress(k, options.repetitions)
        sensor = replace(run.sensor, seed=run.sensor.seed + k)
        law = partial(with_learned, learned=learned)
        result = simulate(replace(run, sensor=sensor), modify_law=law, judge_stability=False)
        if interrupted := result.status == "interrupted":
            break
        lessons.errors.append(last_error(result, experiment.scale, period))
        done.append(Repetition(learned, result, lessons.errors[-1]))
        # The samples before a loss are those of another motion, far outside of the model.
        if result.stopped or lessons.ended or len(done) == options.repetitions:
            break
        times, values = lacking(experiment, result, period)
        if few := len(times) < lessons.least:
            break
        learned = lessons.learned(times, values)
    if not done:
        raise KeyboardInterrupt
    return LearnStudy(experiment, period, done, options.repetitions, interrupted, few)


def last_error(result: SimulationResult, scale: Array, period: float) -> float:
    """Return E of the last period of a run, % s, infinite if it did not complete."""
    if result.status != "completed":
        return math.inf
    time, error = result.signals.time.values, result.signals.error.values
    begin = time[-1] - period
    first = [np.interp(begin, time, column) for column in error.T]
    later = time > begin
    at, errors = np.append(begin, time[later]), np.vstack([first, error[later]])
    return accumulated_error(at, errors, scale)


class Fit(NamedTuple):
    """Least-squares fit of torques or angles by harmonics of a motion."""

    coefficients: Array  # (1 + 2 H, 6), as of `law.learned.LearnedSignal`
    variance: float  # sum of the variances of all coefficients


def fit(times: Array, values: Array, period: float, number: int) -> Fit:
    """Fit values (n, 6) at times (n,) by the first `number` harmonics; the others are 0."""
    basis = harmonics(2 * np.pi / period * times, number)
    found = np.linalg.lstsq(basis, values, rcond=None)[0]
    left = np.sum((values - basis @ found) ** 2) / (len(times) - len(found))
    coefficients = np.zeros((1 + 2 * HARMONICS, 6))
    sines = 1 + HARMONICS
    coefficients[: 1 + number] = found[: 1 + number]
    coefficients[sines : sines + number] = found[1 + number :]
    return Fit(coefficients, float(left * np.trace(np.linalg.inv(basis.T @ basis))))


def corrected_setpoints(used: Array, missed: Fit, period: float, lag: float) -> Fit:
    """Return g(c) of setpoints, rad, for c = `used` (1 + 2 H, 6) and the angles that were missed.

    `lag` in s is that of the servos behind their setpoints.
    """
    e = missed.coefficients
    turns = (lag * 2 * np.pi / period * np.arange(1, 1 + HARMONICS))[:, None]
    cosines, sines = e[1 : 1 + HARMONICS], e[1 + HARMONICS :]
    ahead = np.vstack([e[:1], cosines + turns * sines, sines - turns * cosines])
    return Fit(used + ahead, missed.variance * (1 + float(np.mean(turns**2))))


def lacking_angles(
    experiment: Experiment, result: SimulationResult, period: float
) -> tuple[Array, Array]:
    """Return the samples (n,), s, of the last period of a run, and the angles that the cranks lack.

    These are the angles (n, 6) of the motion less those of the state, rad.
    """
    dt, angles = experiment.scenario.controller.period, experiment.mechanism.crank_angles
    first, _, states = _last_samples(experiment, result, period)
    known = np.flatnonzero(np.isfinite(states[:-1, POSE]).all(axis=1))
    times: Array = dt * (first + known).astype(np.float64)
    found = [
        angles(experiment.reference.value(t)[:, 0]) - angles(pose)
        for t, pose in zip(times, states[known, POSE], strict=True)
    ]
    return times, np.reshape(found, (-1, 6))


def _last_samples(
    experiment: Experiment, result: SimulationResult, period: float
) -> tuple[int, NDArray[np.intp], Array]:
    """Return the number of the first sample of a run's last period, rows and states.

    The rows (first + n,) in the signals are those of all samples up to the last; the states (n, 12)
    are those of the period, measured or else estimated.
    """
    sc, signals = experiment.scenario, result.signals
    dt, time = sc.controller.period, signals.time.values
    wanted = dt * np.arange(number_sent(time[-1], dt))
    rows = np.searchsorted(time, wanted - 1e-6)
    first = max(0, len(rows) - 1 - round(period / dt))
    measured = sc.sensor.measures_state and sc.sensor.delay == 0
    states = (signals.measurement if measured else signals.state_estimate).values
    return first, rows, states[rows[first:]]


def lacking_torques(
    experiment: Experiment, result: SimulationResult, period: float
) -> tuple[Array, Array]:
    """Return the middles (n,), s, of the controller's periods in the last period of a run.

    And the torques (n, 6), N m, that the model lacks there.
    """
    sc = experiment.scenario
    dt, delay = sc.controller.period, believed_delay(sc)
    signals, (first, rows, states) = result.signals, _last_samples(experiment, result, period)
    last = {name: one["value"] for name, one in result.summary["estimates"].items()}
    dynamics = estimated(experiment, signals.parameters.values[rows[first:]], last)
    limit = experiment.torque_limit
    sent = np.clip(signals.torque_commanded.values[rows], -limit, limit)
    in_flight = np.vstack([experiment.torques_in_flight(delay), sent])
    timeline = Timeline(dt, delay)
    times, found = [], []
    for k, (begin, end) in enumerate(itertools.pairwise(states), first):
        if np.all(np.isfinite([begin, end])):
            times.append(dt * (k + 0.5))
            acted = timeline.next_periods(in_flight[k : k + 2])
            found.append(lacking_torque(dynamics, begin, end, acted))
    return np.array(times), np.reshape(found, (-1, 6))


def estimated(
    experiment: Experiment, parameters: Array, last: Mapping[str, float]
) -> StewartDynamics:
    """Return the controller's model with the mean of estimated parameters (n, p).

    `last` has the last estimate of each, by name, also of those that are not in `parameters`.
    """
    known = experiment.nominal.plant_parameters.copy()
    for name in CONSTANTS[NUM_PARAMETERS:]:
        known[CONSTANTS.index(name)] = last.get(name, known[CONSTANTS.index(name)])
    known[:NUM_PARAMETERS] = np.mean(parameters, axis=0)
    return StewartDynamics(experiment.mechanism, experiment.scenario.plant.gravity, known)


def lacking_torque(
    dynamics: StewartDynamics, begin: Array, end: Array, schedule: TorqueSchedule
) -> Array:
    """Return the constant torque (6,) that explains the rates at the end of a schedule."""
    torques, durations = schedule
    lacking = np.zeros(6)
    for _ in range(_NEWTON):
        missed = end - dynamics.predict(begin, torques + lacking, durations, 4)[-1]
        B = dynamics.derivatives(begin[POSE], begin[RATES], torques[0]).B[RATES]
        lacking = lacking + np.linalg.solve(B * durations.sum(), missed[RATES])
    return lacking


class Anderson:
    """Solution of c = g(c) by Anderson's method, for g with noise.

    With f = g(c) - c, and dF, dG the last differences of f and g,

        c+ = g - dG y,   y = argmin |f - dF y|^2 + s |y|^2,

    s the energy of the noise in a difference, so that noise alone is not extrapolated.
    """

    def __init__(self) -> None:
        self.used: Array = np.zeros((1 + 2 * HARMONICS, 6))
        self._found: list[tuple[Array, Array]] = []

    def after(self, fitted: Fit) -> Array:
        """Return the coefficients of the next repetition, from the fit after the last one."""
        g, f = fitted.coefficients, fitted.coefficients - self.used
        self._found = [*self._found, (g, f)][-1 - _DEPTH :]
        dG, dF = (
            np.diff([one.ravel() for one in column], axis=0).T
            for column in zip(*self._found, strict=True)
        )
        noise = 2 * fitted.variance * np.eye(dF.shape[1])
        y = np.linalg.lstsq(dF.T @ dF + noise, dF.T @ f.ravel(), rcond=None)[0]
        self.used = g - (dG @ y).reshape(g.shape)
        return self.used


class Lessons:
    """State of learning from the repetitions of a scenario's motion.

    Attributes:
        period: of the motion, s.
        least: number of samples that a repetition is learned from, at least.
        lag: time of position servos behind their setpoints, s; None with torques.
        errors: of the repetitions so far.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.period, servo = motion_period(scenario), scenario.actuator
        self._harmonics = harmonics_below(self.period, scenario.controller.period)
        # Half as many again as there are coefficients.
        self.least = math.ceil(1.5 * (1 + 2 * self._harmonics))
        self.lag = servo.lag if servo.kind == "position_servo" else None
        self.errors: list[float] = []
        self._steps = Anderson()

    @property
    def best(self) -> int:
        """Number of the repetition with the least error, from 0."""
        return int(np.argmin(self.errors))

    @property
    def ended(self) -> bool:
        """Whether the error no longer falls."""
        return len(self.errors) - 1 - self.best >= _PATIENCE

    def learned(self, times: Array, lacking: Array) -> LearnedSignal:
        """Return the signal of the next repetition, from what the last one lacked at times (n,)."""
        number = min(self._harmonics, max(1, determined_by(len(times))))  # fewer if some were lost
        if self.lag is None:
            fitted = fit(times, -lacking, self.period, number)
        else:
            missed = fit(times, lacking, self.period, number)
            fitted = corrected_setpoints(self._steps.used, missed, self.period, self.lag)
        return LearnedSignal(self.period, self._steps.after(fitted))
