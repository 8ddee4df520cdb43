"""Parts of a law in Python, as tables of functions that the step in C calls back.

Tables and arguments are those of core/observer.h, core/law.h and core/servo.h. Memories of parts in
Python are in `Memory.own`, not in the vector that C passes. Next to each function are the sizes of
its arguments, as `call_back` takes them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.law.belief import Belief
from stewart_drake.law.compiled import Out, call_back, numbers
from stewart_drake.law.counts import Counts
from stewart_drake.law.memory import Memory
from stewart_drake.law.motion import KnownMotion, Motion
from stewart_drake.law.observers import belief_of
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.timeline import Arrivals, Timeline, TorqueSchedule
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import (
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    RATES,
    WEIGHTS,
)
from stewart_drake.types import Array


@dataclass
class Step:
    """Inputs and results of the present step.

    Attributes:
        memory: memory of the law, which C and the parts change in place.
        motion: the caller's motion.
        report: the machine's report, or None.
        followed: motion that the planner chose.
        keep_alive: arrays that C reads until the end of the step.
    """

    memory: Memory
    motion: Motion | None = None
    report: Any = None
    followed: Motion | None = None
    keep_alive: list[Any] = field(default_factory=list)


class OwnParts:
    """Function tables for the parts of a law that are written in Python.

    Args:
        data: its `stewart_law *`, in which each method for a part sets the table of that part.

    Attributes:
        raised: errors of the parts, which C does not see.
        keep_alive: C structures that must outlive `data`.
        now: the present step.
    """

    now: Step

    def __init__(self, law: Any, data: Any) -> None:
        self.law, self._data, self._has_observer = law, data, False
        self.raised: list[BaseException] = []
        self.keep_alive: list[Any] = []

    @cached_property
    def motion(self) -> tuple[Any, Any]:
        """Functions `reference` and `goal` of a `stewart_sample`."""
        sample = core().ffi.new("stewart_sample *")
        sizes = ..., ..., _per(1), Out(_per(1, NUM_REFERENCE))
        functions = {"reference": (self._reference, *sizes), "goal": (self._goal, *sizes)}
        reference, goal = call_back(sample, self.raised, **functions)
        return reference, goal

    def _reference(self, times: Array, rows: Array) -> None:
        rows[:] = np.nan
        rows[:] = self.rows_of(times, self.now.motion)

    def _goal(self, times: Array, rows: Array) -> None:
        assert isinstance(self.now.motion, KnownMotion)
        rows[:] = np.nan
        rows[:] = np.ravel(self.now.motion.goal(times))

    def _table(self, kind: str, **functions: tuple[Any, ...]) -> Any:
        table = core().ffi.new(f"stewart_{kind} *")
        self.keep_alive += [table, *call_back(table, self.raised, **functions)]
        return table

    def rows_of(self, times: Array, motion: Motion | None) -> Array:
        """Return the rows of a motion at times in s from now, as one vector.

        The caller's motion may be known at the law's preview times only, which C computes up to
        rounding.

        Raises:
            ValueError: their shape does not fit.
        """
        assert motion is not None
        law = self.law
        anywhere = isinstance(motion, KnownMotion) or motion is not self.now.motion
        if not anywhere and (self._has_observer or not law.finds_delay):
            timeline = self.timeline()
            exact = law.preview_times if timeline == law.timeline else law.times_for(timeline)
            times = exact if len(exact) == len(times) else times
        return preview_rows(motion(times), len(times)).ravel()

    # -------------------------------------------------------------- observer

    def observer(self) -> None:
        p, m = len(self.law.plant.dynamics.free), self.law.sensing.size
        self._has_observer, state = True, Out(NUM_STATE)
        self._data.observer = self._table(
            "observer",
            memory=(lambda: NUM_STATE, ...),
            scratch=(lambda: 0, ...),
            start=(self._start, ..., state),
            observe=(self._observe, ..., state, ..., _per(2, NUM_TORQUES), m, ...),
            restart=(self._restart, ..., state),
            parameters=(self._parameters, ..., ..., Out(p), Out(p)),
            uncertainty=(self._uncertainty, ..., ..., Out((NUM_STATE + p) ** 2)),
        )

    def _start(self, state: Array) -> None:
        law, state[:] = self.law, np.nan
        belief = law.observer.start(law.timeline, law.sensing, law.plant)
        self.now.memory.own["observer"], state[:] = belief, belief.state

    def _observe(self, state: Array, torques: Array, values: Array) -> int:
        law, belief = self.law, self.now.memory.own["observer"]
        if not np.array_equal(state, belief.state, equal_nan=True):
            belief = belief.at(state.copy())
        in_flight = torques.reshape(-1, NUM_TORQUES)
        measurement = Measurement.of(values)
        after = law.observer.observe(belief, measurement, in_flight, law.sensing, law.plant)
        self.now.memory.own["observer"], state[:] = after, after.state
        return sum(1 << Counts._fields.index(cause) for cause in set(after.faults))

    def _restart(self, state: Array) -> None:
        belief = self.now.memory.own["observer"]
        self._start(state)
        fresh = self.now.memory.own["observer"].assuming(belief.parameters)
        self.now.memory.own["observer"] = replace(fresh, measured=belief.measured)

    def _parameters(self, theta: Array, std: Array) -> None:
        estimate = self.now.memory.own["observer"].estimate
        theta[:], std[:] = estimate.parameters, estimate.parameter_std

    def _uncertainty(self, root: Array | None) -> float:
        belief = self.now.memory.own["observer"]
        if root is not None:
            known = belief.estimate.uncertain
            root[:] = belief.estimate.covariance_root.ravel() if known else 0.0
        return float(belief.timing)

    # -------------------------------------------------------------- prediction and gain

    def design(self, columns: int, *, predicts: bool, designs: bool) -> None:
        """Set the outlook and, if asked for, the prediction and the gain.

        Args:
            columns: largest number of columns of the gain.
            predicts: whether the prediction is in Python.
            designs: whether the gain is in Python.
        """
        functions: dict[str, tuple[Any, ...]] = {"outlook": (self._outlook, ..., None, None)}
        if predicts:
            functions["predict"] = (self._predict, ..., None, _followed, 6, None)
        if designs:
            sizes = (
                len(self.law.plant.dynamics.free),
                _nodes,
                NUM_STATE,
                len(WEIGHTS),
                Out(_feedforward),
                Out(NUM_STATE),
                Out(_gain),
            )
            functions["design"] = (self._design, ..., ..., *sizes)
        self._data.design = self._table("design", **functions)
        self._data.design.columns = columns

    def timeline(self) -> Timeline:
        """Return the clock with the estimated delay."""
        if self._has_observer or self.law.finds_delay:
            return self._observed().timeline
        timeline: Timeline = self.law.timeline
        return timeline

    def _observed(self) -> Belief:
        if self._has_observer:
            found: Belief = self.now.memory.own["observer"]
            return found
        memory = np.array(self.now.memory.field("observer"))
        return belief_of(self.law.observer, self._data, memory, self.law.timeline)

    def _belief(self, outlook: Any) -> Belief:
        return self._observed().at(np.array(list(outlook.state)))

    def _outlook(self, lag: int, outlook: Any) -> None:
        law, c, belief = self.law, core(), self._observed()
        timeline, in_flight = belief.timeline, self.now.memory.in_flight.copy()
        if self._has_observer:
            outlook.feeds_back, outlook.caution = belief.feeds_back, law.caution(belief)
            outlook.settled, outlook.found = belief.settled, belief.found
            outlook.assumed = math.isnan(belief.delay_mean)
        if self._has_observer and timeline != law.timeline:
            queue = timeline.queue(in_flight)
            until = timeline.until_next(queue)
            exact = isinstance(timeline, Arrivals)
            outlook.eta, outlook.fraction = timeline.eta, 0.0 if exact else timeline.fraction
            outlook.until_next = self._schedule(until)
            outlook.horizon = self._schedule(until if exact else timeline.schedule(queue))
            acted = timeline.last_period(in_flight)[0].torques
            outlook.limited = law.plant.motors.reached(acted)
            if lag and belief.has_state:
                late = timeline.last_periods(in_flight, lag)
                state = law.plant.predict(belief.state, late, belief.parameters)[-1]
                outlook.state = state.tolist()
        times, pending = numbers(law.predictor.samples(timeline)), law.predictor.pending(timeline)
        if 1 + len(times) + 2 * (3 + pending) > self._data.rows:
            raise ValueError(f"predictor: got {len(times)} samples and {pending} pending torques")
        self.now.keep_alive.append(times)
        outlook.samples, outlook.times, outlook.pending = len(times), c.at(times), pending

    def _schedule(self, schedule: TorqueSchedule) -> list[Any]:
        """Return the fields of a `stewart_schedule`; C chooses the substeps."""
        arrays = [numbers(part) for part in schedule]
        self.now.keep_alive += arrays
        substeps = 0
        return [len(arrays[0]), *map(core().at, arrays), substeps]

    def _predict(self, outlook: Any, followed: Array, integral: Array, ahead: Any) -> None:
        belief, wanted = self._belief(outlook), followed.reshape(-1, NUM_REFERENCE)[:, :NUM_STATE]
        queue = belief.timeline.queue(self.now.memory.in_flight.copy())
        found = self.law.predictor.predict(belief, integral, queue, wanted, self.law.plant)
        ahead.state, ahead.error, ahead.integral = (np.ravel(part).tolist() for part in found)

    def _design(
        self,
        theta: Array | None,
        nodes: Array,
        state: Array,
        weights: Array | None,
        torques: Array,
        error: Array | None,
        gain: Array,
    ) -> int:
        law, plant, timeline = self.law, self.law.plant, self.timeline()
        known = plant.dynamics.parameters if theta is None else theta
        rows = nodes.reshape(-1, NUM_REFERENCE)
        held = law.feedforward.held(rows, plant.dynamics, known)
        torques[:] = np.ravel(held.torques)
        if error is None:
            return 0
        try:
            model = law.model.at(state, held.torques[-1], known, plant)
            error -= law.feedforward.offset(held.changes, model.B[RATES], timeline)
            if weights is None:
                return 0
            delayed = law.cost.sampled(model, timeline)
            K = law.cost.gain(delayed, weights)
            if not np.all(np.isfinite(K)):
                raise FloatingPointError("gain: is not finite")
            gain[:] = np.ravel(law.predictor.gain(K, delayed))
        except UnreachablePoseError:  # nothing to regulate: the feedforward acts alone
            return int(core().lib.STEWART_UNREACHABLE)
        except (ArithmeticError, np.linalg.LinAlgError):  # such as RiccatiError
            return int(core().lib.STEWART_RICCATI_FAILURE)
        return 0

    def command(self, servo: Any, *, computes: bool) -> None:
        """Set the change of commands of a `stewart_servo`.

        Args:
            servo: `stewart_servo *`.
            computes: whether Python computes the command; otherwise it only adds what was learned.
        """
        p, row = len(self.law.plant.dynamics.free), NUM_REFERENCE
        sizes = ..., p, row, Out(row)
        self.keep_alive += call_back(servo, self.raised, command=(self._command, *sizes))
        self._computes = computes

    def _command(self, theta: Array, row: Array, command: Array) -> int:
        law, sample = self.law, self.now.memory.own["sample"]
        if self._computes:
            try:
                command[:] = law.command(row, theta)
            except UnreachablePoseError:
                return int(core().lib.STEWART_UNREACHABLE)
        if law.learned is not None:
            time = law.timeline.period * sample
            command[POSE] += law.learned(time + law.preview_times)[0]
        return 0

    # -------------------------------------------------------------- planner and channel

    def planner(self) -> None:
        self._data.planner = self._table(
            "planner",
            memory=(lambda: 0, ...),
            scratch=(lambda: 0, ...),
            start=(self._start_planner, ..., ...),
            follow=(self._follow, ..., ..., None, ..., ...),
            rows=(self._rows, ..., ..., ..., ..., _per(3), Out(_per(3, NUM_REFERENCE))),
        )

    def _start_planner(self) -> None:
        self.now.memory.own["planner"] = None

    def _follow(self, outlook: Any) -> int:
        belief = replace(self._belief(outlook), caution=outlook.caution)
        in_flight, path = self.now.memory.in_flight.copy(), self.now.memory.own["planner"]
        followed = self.law.planner.follow(path, belief, in_flight, self.now.motion, self.law.plant)
        self.now.memory.own["planner"], self.now.followed = followed.path, followed.motion
        return int(followed.replanned)

    def _rows(self, times: Array, rows: Array) -> None:
        rows[:] = np.nan
        rows[:] = self.rows_of(times, self.now.followed)

    def channel(self) -> None:
        lib = core().lib
        self._data.channel = self._table(
            "channel",
            memory=(lambda: 0, ...),
            scratch=(lib.stewart_planning_scratch, None),
            torques=(lambda: self.law.channel.torques, ...),
            start=(self._start_channel, ..., ...),
            update=(self._update, ..., ..., ..., Out(_in_flight), ...),
            send=(self._send, None, ..., None, None, _in_flight, None),
        )

    def _start_channel(self) -> None:
        self.now.memory.own["channel"] = self.law.channel.start()
        self.now.memory.own["plan"] = np.zeros((self.law.channel.torques, NUM_TORQUES))

    def _update(self, in_flight: Array) -> None:
        own, before = self.now.memory.own, in_flight.reshape(-1, NUM_TORQUES).copy()
        own["channel"], probable = self.law.channel.in_flight(
            own["channel"], before, self.timeline(), self.now.report
        )
        in_flight[:] = np.ravel(probable)

    def _send(self, law: Any, outlook: Any, ahead: Any, in_flight: Array, scratch: Any) -> None:
        c, plan = core(), np.empty((self.law.channel.torques, NUM_TORQUES))
        pending = in_flight[len(in_flight) - NUM_TORQUES * outlook.pending :].copy()
        c.lib.stewart_plan_torques(law, outlook, ahead, c.at(pending), c.at(plan), scratch)
        sent = self.law.channel.send(
            self.now.memory.own["channel"], plan, in_flight.reshape(-1, NUM_TORQUES)
        )
        self.now.memory.own["channel"], self.now.memory.own["plan"] = sent, plan


def preview_rows(rows: Any, number: int) -> Array:
    """Return rows of a reference (number, 18) for C.

    Raises:
        ValueError: their shape does not fit.
    """
    found = np.ascontiguousarray(rows, np.float64)
    if found.shape != (number, NUM_REFERENCE):
        raise ValueError(f"preview: got shape {found.shape}; expected {(number, NUM_REFERENCE)}")
    return found


# Sizes of arrays, as functions of all arguments of the callback that takes them.


def _per(place: int, each: int = 1) -> Callable[..., int]:
    """Return the size of an array with `each` numbers per unit of the argument at a place."""
    return lambda *given: each * int(given[place])


def _followed(_law: Any, outlook: Any, *_: Any) -> int:
    """Return the size of the rows to follow, now and at the instants of the prediction."""
    return NUM_REFERENCE * (1 + int(outlook.samples))


def _nodes(_law: Any, outlook: Any, *_: Any) -> int:
    """Return the size of the rows at two Gauss nodes in each hold of the feedforward."""
    return 2 * NUM_REFERENCE * (3 + int(outlook.pending))


def _feedforward(_law: Any, outlook: Any, *_: Any) -> int:
    return NUM_TORQUES * (1 + int(outlook.pending))


def _gain(law: Any, outlook: Any, *_: Any) -> int:
    return NUM_TORQUES * int(core().lib.stewart_order([law.cost], outlook.pending))


def _in_flight(law: Any, *_: Any) -> int:
    return NUM_TORQUES * int(law.layout.in_flight.rows)
