"""The predictive LQI control law as a pure function: memory and what is new in, memory out.

At t = k dt the torques in flight are known, so the state at the instant from which the next torque
acts is predicted, and (42) is applied there:

    T_k = T_ff - K [e; z; ...],   e = predicted pose and rate error, z = predicted integral,

with K from `law.riccati.reduced_gain` and T_ff the feedforward of the hold interval
[t + eta, t + eta + dt), see `law.holds`. Linear prediction multiplies [e_k; z_k; queue] by
`prediction_matrix`, which is the paper's K_aug e_dis; nonlinear prediction integrates the exact
dynamics through the queue. Torques enter the linear parts as deviations from their feedforward.
"""

from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from stewart_drake.dynamics.frozen_map import FrozenDynamics
from stewart_drake.law.belief import Belief
from stewart_drake.law.catch_up import DEFAULT_CATCH_UP
from stewart_drake.law.channel import Channel, Report, Wire
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.design_models import DesignModel
from stewart_drake.law.feedforward import Feedforward
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.memory import Counts, Memory
from stewart_drake.law.motion import Motion, Previewed, between, completed, interpolated
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import CoreObserver, Observer
from stewart_drake.law.planner import NoPlanner, Planner
from stewart_drake.law.predictors import Ahead, Predictor
from stewart_drake.law.return_path import ReturnPath
from stewart_drake.law.sensing import Sensing
from stewart_drake.law.timeline import Timeline
from stewart_drake.mechanism.geometry import geometry_of
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import (
    NUM_COORDINATES,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
)
from stewart_drake.types import Array


class Response(NamedTuple):
    """What one sample comes to."""

    torque: Array
    """(6,) N m."""
    error: Array
    """(6,) of the pose, that counts for the integral."""
    integral: Array
    """(6,)."""
    ahead: Ahead
    """Where the torque acts."""
    gain: Array
    """(6, g), NaN for none."""
    trouble: str | None
    """What went wrong, as the name of a count."""
    feedforward: Array
    """(6,) N m, of the torque."""


class Wanted(NamedTuple):
    """Reference of one sample."""

    reference: Previewed
    """As it was given, with numbers for what was missing."""
    followed: Array
    """(p, 18) the same with the way back onto it."""
    missing: bool
    """Whether something was missing in the preview."""
    gap: bool
    """Whether its last row was."""
    back: ReturnPath


@dataclass(frozen=True)
class PredictiveLqi:
    """The control law for one machine, made of parts; `dataclasses.replace` swaps one.

    Attributes:
        timeline: the controller's clock, and the delay that it assumes at the start. Later it is
            the observer's belief that counts.
        plant: the machine as it is known.
        sensing: what is measured.
        observer: what it makes of measurements.
        predictor: error and integral where the next torque acts.
        feedforward: what the reference takes.
        model: of the error, for the gain.
        cost: what the gain minimises.
        planner: of the way back, where the prediction is off.
        silence: samples at the start at which nothing is fed back: what they tell is of a plate on
            which nothing of the controller's acts, and noise.
        channel: how torques get to the motors.
        kept: number of torques in flight beyond those of the delay, for late measurements.
        longest_wait: periods to wait for a late measurement before the model continues; 0:
            measurements are of the present.
    """

    timeline: Timeline
    plant: NominalPlant
    sensing: Sensing
    observer: Observer
    predictor: Predictor
    feedforward: Feedforward
    model: DesignModel
    cost: QuadraticCost
    channel: Channel = field(default_factory=Wire)
    kept: int = 0
    longest_wait: int = 0
    planner: Planner = field(default_factory=NoPlanner)
    silence: int = 0

    @property
    def estimates(self) -> bool:
        """Whether the observer estimates parameters."""
        return not (isinstance(self.observer, CoreObserver) and self.observer.settings is None)

    @property
    def finds_delay(self) -> bool:
        """Whether the observer estimates the delay."""
        return isinstance(self.observer, CoreObserver) and self.observer.delay is not None

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
        """Times (p,) from now, s, at which the reference must be known; some may be negative."""
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
        """Before the first sample.

        Args:
            queue: (n >= L, 6) torques in flight, oldest first, L by the delay at the start; more
                of them than that for an observer that may come to believe in a longer one.
        """
        nothing = np.zeros(NUM_TORQUES)
        in_flight = np.vstack([np.zeros((1 + self.kept, NUM_TORQUES)), queue])
        return Memory(
            in_flight=in_flight,
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
            reference=Previewed.nothing(self.preview_times),
            followed=Previewed.nothing(self.preview_times).reference,
            silence=self.silence,
        )

    @np.errstate(over="ignore", invalid="ignore")  # its outcome is checked and counted instead
    def step(
        self,
        memory: Memory,
        measurement: Measurement,
        motion: Motion,
        weights: Array,
        report: Report | None = None,
    ) -> Memory:
        """One sample.

        Args:
            memory: after the last sample.
            measurement: of `sensing`; the model stands in for one that has a fault.
            motion: to follow. It is asked once, for `times_for` the delay that is believed in.
            weights: (2,) w_Q and w_R.
            report: that came with the measurement, or None.

        Returns:
            The new memory; its torque (6,) is finite. What limits it stands behind the law: in
            flight is what that lets through, by which the law also judges the past and the future.

        Raises:
            ValueError: a shape that does not fit. What numbers can do is survived and counted.
        """
        sent, in_flight = self.channel.in_flight(
            memory.sent, memory.in_flight, memory.belief.timeline, report
        )
        memory = replace(memory, in_flight=in_flight)
        belief, delayed, lag = self._observe(memory, measurement)
        followed = self.planner.follow(memory.path, belief, memory.in_flight, motion, self.plant)
        if followed.anew:
            memory = memory.without_error()
        samples = 1 + len(self.predictor.samples(belief.timeline))
        given = self._previewed(memory, belief, followed.motion)
        preview, missing = given.followed, given.missing
        nodes_end = samples + 2 * (self.predictor.pending(belief.timeline) + 3)
        wanted, nodes = preview[:samples, :NUM_STATE], preview[samples:nodes_end]
        waiting = not np.all(np.isfinite(nodes))
        if missing and not (given.gap or waiting):  # which spoils the plan as a limit does
            memory = replace(memory, silence=0)
        if not belief.has_state:  # nothing else to go on with
            belief = belief.at(wanted[0])
        queue = belief.timeline.queue(memory.in_flight)
        guide, response = self._respond(memory, belief, queue, wanted, nodes, weights)
        torque, error, integral, ahead, gain, trouble, feedforward = response
        nonfinite = not np.all(np.isfinite(torque))
        if nonfinite:
            torque = memory.torque
        limited = self.plant.motors.saturate(torque)
        saturated = bool(np.any(limited != torque))
        plan = self._plan(limited, guide, ahead, queue, gain, preview[nodes_end:])
        return Memory(
            in_flight=np.vstack([memory.in_flight[1:], limited]),
            belief=belief,
            delayed=delayed if self.longest_wait else None,
            lag=lag,
            measurement=measurement.values,
            error=error,
            integral=integral,
            gain=gain if _is_there(gain) else memory.gain,
            torque=torque,
            weights=np.array(weights),
            counts=memory.counts.plus(
                *belief.faults,
                trouble,
                "nonfinite_torque" if nonfinite else None,
                "saturated_steps" if saturated else None,
                "references_missing" if missing else None,
            ),
            path=followed.path,
            silence=memory.silence if waiting else max(memory.silence - 1, 0),
            feedforward=feedforward,
            reference=given.reference,
            followed=given.followed,
            gap=given.gap,
            back=given.back,
            plan=plan,
            sent=self.channel.send(sent, plan, memory.in_flight),
        )

    def _observe(self, memory: Memory, measurement: Measurement) -> tuple[Belief, Belief, int]:
        """Return the belief now, the belief at the last measurement, and its age in periods.

        A measurement that is m periods old describes the state m periods ago. The observer runs
        so many periods behind, and its estimate is predicted with the torques that acted since:

            x(t_k) = f(x(t_k - m dt), torques of the last m periods, theta).
        """
        self.require_age(measurement)
        age = round(measurement.age / self.timeline.period)
        valid = bool(np.any(measurement.valid)) and age >= 0
        target = min(age, self.longest_wait) if valid else self.longest_wait
        delayed = memory.belief if memory.delayed is None else memory.delayed
        lag, flown = memory.lag + 1, memory.in_flight
        faults, partial = (() if valid else ("measurements_missing",)), 0
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

    def _previewed(self, memory: Memory, belief: Belief, motion: Motion) -> Wanted:
        """Return the reference to follow now: the given one, and after a gap the way back onto it.

        Up to the instant at which the next torque begins to act, that is what was followed before.
        At the first preview ever, and as long as nothing is fed back, it is the predicted motion of
        the plate, from rest its rest.
        """
        timeline = belief.timeline
        times = self.preview_times if timeline == self.timeline else self.times_for(timeline)
        given, last, h = Previewed(times, motion(times)), memory.reference, timeline.period
        reference = self._completed(given, last, timeline)
        missing = reference is not given.reference
        gap = missing and not np.all(np.isfinite(given.reference[-1]))
        ended, back = memory.gap and not gap, memory.back.after(h)
        if not (ended or back.active):
            return Wanted(Previewed(times, reference), reference, missing, gap, back)
        acts, known = timeline.eta - 1e-6 * h, bool(np.all(np.isfinite(memory.followed[-1])))
        early = ended or 2 * back.holds * h >= DEFAULT_CATCH_UP
        corrected = early and not missing and self._is_quiet(memory)
        if known and not corrected:
            before = np.where(times[:, None] < acts, np.nan, reference)
            followed = Previewed(last.times, memory.followed)
            way = self._completed(Previewed(times, before), followed, timeline)
            if ended:  # without a step in what is followed
                continued = self._completed(Previewed.nothing(times), last, timeline)
                step = [interpolated(times, r, timeline.eta) for r in (continued, reference)]
                offset = back.at(0.0, h) + step[0] - step[1]
                back = ReturnPath.of(offset[:NUM_STATE], timeline)
        elif belief.has_state:
            way, state = self._predicted(memory, belief, times)
            wanted = interpolated(times, reference, timeline.eta)
            offset = state - wanted[:NUM_STATE]
            anew = ended or not known
            back = ReturnPath.of(offset, timeline) if anew else replace(back, offset=offset)
        else:  # nothing else to go on with
            return Wanted(Previewed(times, reference), reference, missing, gap, ReturnPath())
        followed_now = np.array(
            [
                way[i] if t < acts else reference[i] + back.at(t - timeline.eta, h)
                for i, t in enumerate(times)
            ]
        )
        return Wanted(Previewed(times, reference), followed_now, missing, gap, back)

    def _completed(self, given: Previewed, last: Previewed, timeline: Timeline) -> Array:
        return completed(given, last, timeline, self._geometry)

    @cached_property
    def _geometry(self) -> Array | None:
        """Of a machine, None for a plant that has any pose."""
        if isinstance(self.plant.dynamics, FrozenDynamics):
            return None
        return geometry_of(self.plant.mechanism)

    def _predicted(self, memory: Memory, belief: Belief, times: Array) -> tuple[Array, Array]:
        """Return the predicted motion (p, 18), and the state (12,) where the next torque acts."""
        timeline, dynamics, theta = belief.timeline, self.plant.dynamics, belief.parameters
        schedule = timeline.until_next(timeline.queue(memory.in_flight))
        states = np.vstack([belief.state, self.plant.predict(belief.state, schedule, theta)])
        edges = np.append(0.0, np.cumsum(schedule.durations))
        way = np.tile(np.concatenate([states[-1], np.zeros(NUM_COORDINATES)]), (len(times), 1))
        for i, torque in enumerate(schedule.torques):
            start, end = (
                np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque, theta))
                for x in states[i : i + 2]
            )
            h = schedule.durations[i]
            for j in np.flatnonzero((times >= edges[i]) & (times < edges[i + 1])):
                way[j] = between(start, end, h, (times[j] - edges[i]) / h)
        return way, states[-1]

    def _respond(
        self,
        memory: Memory,
        belief: Belief,
        queue: Array,
        wanted: Array,
        nodes: Array,
        weights: Array,
    ) -> tuple[Belief, Response]:
        """What is done, and the belief that it goes by."""
        if not np.all(np.isfinite(nodes)):  # nothing to follow yet: hold the torque
            return belief, self._unregulated(memory.torque, memory, belief, wanted)
        if belief.feeds_back and not self._is_quiet(memory):
            return belief, self._feed_back(memory, belief, queue, wanted, nodes, weights)
        guide = belief.assuming(self.plant.dynamics.parameters)
        return guide, self._go_on_alone(memory, guide, wanted, nodes)

    def _is_quiet(self, memory: Memory) -> bool:
        """Return whether nothing is fed back yet.

        A limit spoils the plan: what it takes away is known without a measurement.
        """
        return memory.silence > 0 and not self.plant.motors.reached(memory.in_flight)

    def _feed_back(
        self,
        memory: Memory,
        belief: Belief,
        queue: Array,
        wanted: Array,
        nodes: Array,
        weights: Array,
    ) -> Response:
        """(42) where the torque acts: torque, error, integral, gain, and what went wrong."""
        error = belief.state[POSE] - wanted[0, POSE]
        integral = self._integrate(memory, error, belief.timeline)
        ahead = self.predictor.ahead(belief, integral, queue, wanted, self.plant)
        held, changes = self.feedforward.held(nodes, self.plant.dynamics, belief.parameters)
        error_ahead, gain, trouble = self._design(memory, belief, ahead, held[-1], changes, weights)
        torque = held[-1]
        if _is_there(gain):
            pending = (queue[len(queue) - len(held) + 1 :] - held[:-1]).ravel()
            seen = self.cost.sees(ahead.integral)
            torque = torque - gain @ np.concatenate([error_ahead, seen, pending])
        return Response(torque, error, integral, ahead, gain, trouble, held[-1])

    def _go_on_alone(self, memory: Memory, belief: Belief, wanted: Array, nodes: Array) -> Response:
        """The feedforward of what is known beforehand; errors do not count."""
        held, _ = self.feedforward.held(nodes, self.plant.dynamics, belief.parameters)
        return self._unregulated(held[-1], memory, belief, wanted)

    def _unregulated(
        self, torque: Array, memory: Memory, belief: Belief, wanted: Array
    ) -> Response:
        """A torque without feedback; errors do not count."""
        nothing = np.zeros(NUM_COORDINATES)
        ahead = Ahead(wanted[-1], np.zeros(NUM_STATE), nothing)
        none = self._no_gain(belief.timeline)
        return Response(torque, nothing, memory.integral, ahead, none, None, torque)

    def _plan(
        self, first: Array, belief: Belief, ahead: Ahead, queue: Array, gain: Array, preview: Array
    ) -> Array:
        """(N, 6) this sample's torque, and what further ones would be if all went as predicted.

        The nominal plant goes on from where the prediction ended, period by period, and is
        regulated by the same gain. `preview` ((N - 1) (1 + s), 18) is the reference there.
        """
        plan, timeline, plant = [first], belief.timeline, self.plant
        state, error, integral = ahead
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
                seen = np.concatenate([error - offset, self.cost.sees(integral), late])
                torque = torque - gain @ seen if _is_there(gain) else torque
            usable = bool(np.all(np.isfinite(torque)))
            plan.append(plant.motors.saturate(torque) if usable else plan[-1])
        return np.array(plan)

    def _design(
        self,
        memory: Memory,
        belief: Belief,
        ahead: Ahead,
        torque: Array,
        changes: Array,
        weights: Array,
    ) -> tuple[Array, Array, str | None]:
        """Error (12,) to be fed back, gain, NaN for no feedback, and what went wrong, or None."""
        error = ahead.error
        try:
            model = self.model.at(ahead.point, torque, belief.parameters, self.plant)
            error = error - self.feedforward.offset(changes, model.B[RATES], belief.timeline)
            delayed = self.cost.sampled(model, belief.timeline)
            K = self.cost.gain(delayed, weights * [1.0, belief.caution])
            return error, self.predictor.gain(K, delayed), None
        except UnreachablePoseError:  # nothing to regulate: the feedforward goes on alone
            return error, self._no_gain(belief.timeline), "unreachable"
        except (ArithmeticError, np.linalg.LinAlgError):  # RiccatiError is one
            none = self._no_gain(belief.timeline)
            last = memory.gain if memory.gain.shape == none.shape else none  # of another delay
            return error, last, "riccati_failures"

    def _no_gain(self, timeline: Timeline) -> Array:
        """NaN in the shape of a gain: on error, integral and pending torques."""
        integral = self.cost.sees(np.zeros(NUM_COORDINATES))
        pending = NUM_TORQUES * self.predictor.pending(timeline)
        return np.full((NUM_TORQUES, NUM_STATE + len(integral) + pending), np.nan)

    def _integrate(self, memory: Memory, error: Array, timeline: Timeline) -> Array:
        """z_k = z_{k-1} + dt/2 (e_{k-1} + e_k), but not while a motor is at its limit."""
        if not self.cost.integrates or not memory.belief.has_state:
            return memory.integral
        schedule, _ = timeline.last_period(memory.in_flight)
        if self.plant.motors.reached(schedule.torques):
            return memory.integral
        return memory.integral + timeline.period / 2 * (memory.error + error)


def _is_there(gain: Array) -> bool:
    """Before there is a gain, or without a model, it is NaN."""
    return not np.all(np.isnan(gain))
