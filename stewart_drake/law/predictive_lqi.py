"""The predictive LQI control law as a pure function: memory and measurement in, memory out.

At t = k dt the torques in flight are known. They give the state at the instant at which the next
torque begins to act, and (42) is applied there:

    T_k = T_ff - K [e; z; ...],   e = predicted pose and rate error, z = predicted integral,

with K from `law.riccati.reduced_gain` and T_ff the feedforward of the hold interval
[t + eta, t + eta + dt), see `law.feedforward`. Linear prediction multiplies [e_k; z_k; queue] by
`prediction_matrix`, which is the paper's K_aug e_dis; nonlinear prediction integrates the exact
dynamics through the queue. Torques enter the linear parts as deviations from their feedforward.
"""

import math
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Channel, Report, Wire
from stewart_drake.law.cost import Cost
from stewart_drake.law.feedforward import Feedforward
from stewart_drake.law.memory import Counts, Memory
from stewart_drake.law.motion import Course, Motion
from stewart_drake.law.nominal import DesignModel, NominalPlant
from stewart_drake.law.observers import CoreObserver, Observer
from stewart_drake.law.planner import NoPlanner, Planner, Replan
from stewart_drake.law.predictors import PredictedState, Predictor
from stewart_drake.law.sensing import Measurement, Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_STATE, NUM_TORQUES, POSE, RATES
from stewart_drake.types import Array


class StepResult(NamedTuple):
    """Torque of one sample and its origin.

    Attributes:
        torque: (6,) N m.
        error: (6,) of the pose, for the integral.
        integral: (6,) of the pose error.
        predicted: where the torque acts.
        gain: (6, g), NaN without feedback.
        cause: of a missing model or gain, as the name of a count, or None.
        feedforward: (6,) N m, share of the torque without feedback.
    """

    torque: Array
    error: Array
    integral: Array
    predicted: PredictedState
    gain: Array
    cause: str | None
    feedforward: Array


@dataclass(frozen=True)
class PredictiveLqi:
    """The control law for one machine, made of parts; `dataclasses.replace` swaps one.

    Attributes:
        timeline: clock of the controller, with the delay that is assumed at the start. Later the
            observer's belief has the delay.
        plant: model of the plant.
        sensing: model of the sensor.
        observer: estimates state, parameters and delay.
        predictor: error and integral where the next torque acts.
        feedforward: torque that the reference takes.
        model: of the error, for the gain.
        cost: computes the gain.
        channel: link to the motors.
        kept: number of torques in flight beyond those of the delay, for late measurements.
        longest_wait: periods to wait for a late measurement before the model continues; 0:
            measurements are of the present.
        planner: of the way back, where the prediction is off the reference.
        tolerated_timing: s, standard deviation of the instant of single torques from which on the
            weight of the torques grows with its square; infinite: the weight is given.
        silence: samples at the start without feedback: until an own torque has acted, feedback
            only adds noise.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    predictor: Predictor
    feedforward: Feedforward
    model: DesignModel
    cost: Cost
    channel: Channel = field(default_factory=Wire)
    kept: int = 0
    longest_wait: int = 0
    planner: Planner = field(default_factory=NoPlanner)
    silence: int = 0
    tolerated_timing: float = math.inf

    @property
    def parts(self) -> dict[str, Any]:
        """Attributes of this class by name, without those of a derived one."""
        return {one.name: getattr(self, one.name) for one in fields(PredictiveLqi)}

    @property
    def estimates(self) -> bool:
        """Whether the observer estimates parameters; of a user's own this is assumed."""
        return not (isinstance(self.observer, CoreObserver) and self.observer.settings is None)

    @property
    def finds_delay(self) -> bool:
        """Whether the observer estimates the delay."""
        return isinstance(self.observer, CoreObserver) and self.observer.delay is not None

    @property
    def moves(self) -> bool:
        """Whether the law reads the motion at instants that it chooses itself."""
        return self.finds_delay or not isinstance(self.planner, NoPlanner)

    @property
    def longest_plan(self) -> float:
        """Length of a plan back onto the reference, s; 0 without one."""
        period = self.timeline.period
        return self.planner.lengths(period)[1] * period if isinstance(self.planner, Replan) else 0.0

    def require_age(self, measurement: Measurement) -> None:
        """Check that a measurement is of the present, unless the law waits for late ones.

        Raises:
            ValueError: it is older.
        """
        if measurement.age != 0 and self.longest_wait == 0:
            raise ValueError(f"measurement: got an age of {measurement.age} s; expected 0")

    @cached_property
    def preview_times(self) -> Array:
        """`times_for` the delay that is assumed at the start."""
        return self.times_for(self.timeline)

    def times_for(self, timeline: Timeline) -> Array:
        """Return the times (p,) of a preview, s from now; some may be negative."""
        nodes = self.feedforward.nodes(timeline, self.predictor.pending(timeline))
        at = np.concatenate([[0.0], self.predictor.samples(timeline)])
        further = (
            np.append(at[-1], nodes) + timeline.period * i for i in range(1, self.channel.torques)
        )
        return np.concatenate([at, nodes, *further])

    @property
    def queue_length(self) -> int:
        """Torques in flight at the start."""
        if self.finds_delay:
            assert isinstance(self.observer, CoreObserver)
            return self.observer.kept(self.timeline.period)
        return self.timeline.queue_length

    def initial_memory(self, queue: Array) -> Memory:
        """Return the memory before the first sample.

        Args:
            queue: (n >= L, 6) torques in flight, oldest first, L by the delay at the start; more
                for an observer whose estimate of the delay may grow.
        """
        nothing = np.zeros(NUM_TORQUES)
        before = queue[0] if len(queue) else nothing  # the oldest has acted before, too
        return Memory(
            in_flight=np.vstack([np.tile(before, (1 + self.kept, 1)), queue]),
            belief=self.observer.start(self.timeline, self.sensing, self.plant),
            measurement=np.full(self.sensing.size, np.nan),
            error=np.zeros(NUM_COORDINATES),
            integral=np.zeros(NUM_COORDINATES),
            gain=self._no_gain(self.timeline),
            torque=queue[-1] if len(queue) else nothing,
            weights=np.full(2, np.nan),
            counts=Counts(),
            plan=np.tile(nothing, (self.channel.torques, 1)),
            sent=self.channel.start(),
            course=Course.unknown(self.preview_times),
            silence=self.silence,
        )

    @np.errstate(over="ignore", invalid="ignore")  # the result is checked instead
    def step(
        self,
        memory: Memory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Memory:
        """Compute the torque of one sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; the model replaces one that has a fault.
            motion: to follow. It is evaluated once, at `times_for` the estimated delay.
            weights: (2,) w_Q and w_R.
            report: that came with the measurement, or None.

        Returns:
            The new memory; its torque (6,) is finite. In flight is the torque within the limit.

        Raises:
            ValueError: a shape that does not fit. Bad numbers are survived and counted.
        """
        sent, in_flight = self.channel.in_flight(
            memory.sent, memory.in_flight, memory.belief.timeline, report
        )
        memory = replace(memory, in_flight=in_flight)
        belief, delayed, lag = self._observe(memory, measurement)
        careful = replace(belief, caution=self.caution(belief))
        followed = self.planner.follow(memory.path, careful, in_flight, motion, self.plant)
        if followed.replanned:
            memory = memory.without_error()
        timeline = belief.timeline
        queue = timeline.queue(in_flight)
        times = self.preview_times if timeline == self.timeline else self.times_for(timeline)
        course = memory.course.following(
            *(times, followed.motion(times), belief, timeline.until_next(queue), self.plant),
            self._is_quiet(memory),
        )
        samples = 1 + len(self.predictor.samples(timeline))
        nodes_end = samples + 2 * (self.predictor.pending(timeline) + 3)
        wanted, nodes = course.followed[:samples, :NUM_STATE], course.followed[samples:nodes_end]
        waiting = not np.all(np.isfinite(nodes))
        if course.missing and not (course.gap or waiting):  # the open-loop plan is spoilt
            memory = replace(memory, silence=0)
        if not belief.has_state:
            belief = belief.at(wanted[0])
        guide, result = self._respond(memory, belief, queue, wanted, nodes, weights)
        finite = bool(np.all(np.isfinite(result.torque)))
        torque = result.torque if finite else memory.torque
        limited = self.plant.motors.saturate(torque)
        plan = self._plan(limited, guide, result, queue, course.followed[nodes_end:])
        return Memory(
            in_flight=np.vstack([in_flight[1:], limited]),
            belief=belief,
            delayed=delayed if self.longest_wait else None,
            lag=lag,
            measurement=measurement.values,
            error=result.error,
            integral=result.integral,
            gain=result.gain if _is_there(result.gain) else memory.gain,
            torque=torque,
            weights=np.array(weights),
            counts=memory.counts.plus(
                *belief.faults,
                result.cause,
                None if finite else "nonfinite_torque",
                "saturated_steps" if np.any(limited != torque) else None,
                "references_missing" if course.missing else None,
            ),
            path=followed.path,
            silence=memory.silence if waiting else max(memory.silence - 1, 0),
            feedforward=result.feedforward,
            course=course,
            plan=plan,
            sent=self.channel.send(sent, plan, in_flight),
        )

    def _observe(self, memory: Memory, measurement: Measurement) -> tuple[Belief, Belief, int]:
        """Return the belief now, the belief at the last measurement, and its age in periods.

        A measurement that is m periods old describes the state m periods ago. The observer runs
        that many periods behind, and its estimate is predicted with the torques that acted since:

            x(t_k) = f(x(t_k - m dt), torques of the last m periods, theta).
        """
        self.require_age(measurement)
        age = round(measurement.age / self.timeline.period)
        newest = min(self.longest_wait, memory.lag)  # an older one was used, or overtaken
        valid = bool(np.any(measurement.valid)) and 0 <= age <= newest
        target = age if valid else self.longest_wait
        delayed = memory.belief if memory.delayed is None else memory.delayed
        lag, flown = memory.lag + 1, memory.in_flight
        faults: tuple[str, ...] = () if valid else ("measurements_missing",)
        partial = 0
        while lag > target:
            lag -= 1
            fresh = valid and lag == age
            given = replace(measurement, age=0.0) if fresh else measurement.missing()
            before = flown[: len(flown) - lag]
            delayed = self.observer.observe(delayed, given, before, self.sensing, self.plant)
            if fresh:
                faults, partial = delayed.faults, delayed.partial
        belief = replace(delayed, faults=faults, partial=partial)
        if lag and delayed.has_state:
            schedule = delayed.timeline.last_periods(flown, lag)
            belief = belief.at(self.plant.predict(delayed.state, schedule, delayed.parameters)[-1])
        return belief, delayed, lag

    def _respond(
        self,
        memory: Memory,
        belief: Belief,
        queue: Array,
        wanted: Array,
        nodes: Array,
        weights: Array,
    ) -> tuple[Belief, StepResult]:
        """Compute the response; return it with the belief used."""
        dynamics = self.plant.dynamics
        if not np.all(np.isfinite(nodes)):  # nothing to follow yet: hold the torque
            return belief, self._unregulated(memory.torque, memory, belief, wanted)
        if not belief.feeds_back or self._is_quiet(memory):  # feedforward of the known plant
            guide = belief.assuming(dynamics.parameters)
            held = self.feedforward.held(nodes, dynamics, guide.parameters)
            return guide, self._unregulated(held.torques[-1], memory, guide, wanted)
        error = belief.state[POSE] - wanted[0, POSE]
        integral = self._integrate(memory, error, belief.timeline)
        ahead = self.predictor.predict(belief, integral, queue, wanted, self.plant)
        held = self.feedforward.held(nodes, dynamics, belief.parameters)
        torque = feedforward = held.torques[-1]
        error_ahead, gain, cause = self._design(
            memory, belief, ahead, torque, held.changes, weights
        )
        if _is_there(gain):  # (42)
            pending = (queue[len(queue) - len(held.torques) + 1 :] - held.torques[:-1]).ravel()
            regulated = self.cost.regulated(ahead.integral)
            torque = torque - gain @ np.concatenate([error_ahead, regulated, pending])
        return belief, StepResult(torque, error, integral, ahead, gain, cause, feedforward)

    def _is_quiet(self, memory: Memory) -> bool:
        """Return whether nothing is fed back yet. A torque at the limit ends that."""
        return memory.silence > 0 and not self.plant.motors.reached(memory.in_flight)

    def _unregulated(
        self, torque: Array, memory: Memory, belief: Belief, wanted: Array
    ) -> StepResult:
        nothing = np.zeros(NUM_COORDINATES)
        ahead = PredictedState(wanted[-1], np.zeros(NUM_STATE), nothing)
        none = self._no_gain(belief.timeline)
        return StepResult(torque, nothing, memory.integral, ahead, none, None, torque)

    def _plan(
        self, first: Array, belief: Belief, result: StepResult, queue: Array, preview: Array
    ) -> Array:
        """Return this sample's torque and further ones (N, 6), if all goes as predicted.

        The nominal plant continues from the end of the prediction, period by period, under the
        same gain. `preview` ((N - 1) (1 + s), 18) is the reference there.
        """
        plan, timeline, plant = [first], belief.timeline, self.plant
        state, error, integral = result.predicted
        pending = queue[len(queue) - self.predictor.pending(timeline) :]
        for rows in np.split(preview, self.channel.torques - 1) if len(preview) else ():
            flying = np.vstack([pending, plan[-1:]])
            schedule = timeline.next_period(flying)
            state, pending = plant.predict(state, schedule, belief.parameters)[-1], flying[1:]
            before, error = error, state - rows[0, :NUM_STATE]
            if not plant.motors.reached(schedule.torques):
                integral = integral + timeline.period / 2 * (before[POSE] + error[POSE])
            held, changes = self.feedforward.held(rows[1:], plant.dynamics, belief.parameters)
            torque = held[-1]
            with suppress(UnreachablePoseError, ArithmeticError, np.linalg.LinAlgError):
                model = self.model.at(state, torque, belief.parameters, plant)
                offset = self.feedforward.offset(changes, model.B[RATES], timeline)
                late = (pending - held[:-1]).ravel()
                z = self.cost.regulated(integral)
                regulated = np.concatenate([error - offset, z, late])
                torque = torque - result.gain @ regulated if _is_there(result.gain) else torque
            usable = bool(np.all(np.isfinite(torque)))
            plan.append(plant.motors.saturate(torque) if usable else plan[-1])
        return np.array(plan)

    def _design(
        self,
        memory: Memory,
        belief: Belief,
        ahead: PredictedState,
        torque: Array,
        changes: Array,
        weights: Array,
    ) -> tuple[Array, Array, str | None]:
        """Return the error (12,) to feed back, the gain, NaN for none, and the cause, or None."""
        error = ahead.error
        try:
            model = self.model.at(ahead.state, torque, belief.parameters, self.plant)
            error = error - self.feedforward.offset(changes, model.B[RATES], belief.timeline)
            delayed = self.cost.sampled(model, belief.timeline)
            K = self.cost.gain(delayed, weights * [1.0, self.caution(belief)])
            if not np.all(np.isfinite(K)):
                raise FloatingPointError("gain: is not finite")
            return error, self.predictor.gain(K, delayed), None
        except UnreachablePoseError:  # nothing to regulate: the feedforward acts alone
            return error, self._no_gain(belief.timeline), "unreachable"
        except (ArithmeticError, np.linalg.LinAlgError):  # such as RiccatiError
            none = self._no_gain(belief.timeline)
            last = memory.gain if memory.gain.shape == none.shape else none  # of another delay
            return error, last, "riccati_failures"

    def caution(self, belief: Belief) -> float:
        """Return the factor on w_R for an uncertain delay and uncertain timing."""
        return belief.caution * max(1.0, belief.timing / self.tolerated_timing) ** 2

    def _no_gain(self, timeline: Timeline) -> Array:
        """Return NaN in the shape of a gain: on error, integral and pending torques."""
        integral = self.cost.regulated(np.zeros(NUM_COORDINATES))
        pending = NUM_TORQUES * self.predictor.pending(timeline)
        return np.full((NUM_TORQUES, NUM_STATE + len(integral) + pending), np.nan)

    def _integrate(self, memory: Memory, error: Array, timeline: Timeline) -> Array:
        """Return z_k = z_{k-1} + dt/2 (e_{k-1} + e_k), or z_{k-1} while a motor is at its limit."""
        if not self.cost.integrates or not memory.belief.has_state:
            return memory.integral
        schedule, _ = timeline.last_period(memory.in_flight)
        if self.plant.motors.reached(schedule.torques):
            return memory.integral
        return memory.integral + timeline.period / 2 * (memory.error + error)


def _is_there(gain: Array) -> bool:
    return not np.all(np.isnan(gain))
