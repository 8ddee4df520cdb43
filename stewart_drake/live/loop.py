"""The law in real time: one step for each measurement of a machine at the other end of a link.

A step that ends more than a period after its sample was due misses its deadline. Late steps are
taken all the same, one after the other, until the loop has caught up.
"""

import math
import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import margins
from stewart_drake.law.channel import Report
from stewart_drake.law.gaps import LONGEST_GAP, within_reach
from stewart_drake.law.sensing import Measurement
from stewart_drake.live.checks import DelayCheck, recovered, replanned, until_next
from stewart_drake.live.contact import Contact
from stewart_drake.live.design import Design
from stewart_drake.live.endpoint import now
from stewart_drake.live.exchange import Exchange, Watch
from stewart_drake.live.governor import Request, Steering, Way
from stewart_drake.live.learned import LearnedSetpoints, LearnedTorques
from stewart_drake.live.log import LiveRecord
from stewart_drake.live.protocol import NEVER, SECOND, ControllerFlags, MachineMessage
from stewart_drake.live.viewer import End, Snapshot, Viewer
from stewart_drake.loop.recording import has_measured
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.mechanism.trajectories import catch_up, evaluate
from stewart_drake.scenario.run_log import RunLog
from stewart_drake.scenario.signals import (
    ANGLES,
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PACKETS,
    POSE,
    POSITION,
    RATES,
)
from stewart_drake.types import Array

START_ERROR: Final = 0.02
"""Distance up to which the plate is where it should rest, as a share of the motion."""
REST_RATE: Final = 0.005
"""Rate up to which a reference is at rest, in the same unit per s."""
_REST_TIME: Final = 0.5
"""Time within which a plate at rest moves by at most START_ERROR, s.

Its rate alone says less: coarse encoders let it tremble.
"""
RESTING: Final = 8.0
"""Longest time for coming to rest, s."""
_SOFT_STARTS: Final = (1.0, 2.0, 4.0, 8.0)
"""Durations of a path from elsewhere onto the reference, s, tried in this order."""


class LiveLoop:
    """Runs a law against a machine that has offered a session.

    Args:
        max_missing: longest gap of usable measurements, s. By default as long as the estimator's
            uncertainty allows (`live.checks`).
        log: CSV file of the record, written as the run goes on; a temporary one by default.
        hold: whether to hold the plate at rest after the run, until Ctrl-C.

    Attributes:
        memory: memory of the law after the last sample.
        recoveries: number of new references that were planned.
        taken_over: whether the plate was not at the scenario's start.
        missed: number of steps whose delay exceeded a period and the usual jitter.
        resting: delays of the steps that bring the plate to rest, which are not recorded, s. A
            delay is from the earliest arrival of the measurement until its torques were sent. It
            includes the jitter of the link and the wait for a lost datagram.
    """

    _compared = slice(0, NUM_STATE)
    """Part of the state that is compared with the scenario's start."""
    _led_from = 0.1
    """Distance from there above which the plate is led there first, as a share of the motion.

    Without a path to the start the law is faster.
    """

    def __init__(
        self,
        design: Design,
        steering: Steering,
        contact: Contact,
        viewer: Viewer,
        say: Callable[[str], None],
        max_missing: float | None = None,
        log: Path | None = None,
        logs: Sequence[RunLog] = (),
        hold: bool = False,
    ) -> None:
        self._design, self._steering, self._viewer, self._say = design, steering, viewer, say
        self._law: Any = design.law
        self.memory: Any = self._law.initial_memory(design.queue)
        self._period = design.experiment.scenario.controller.period
        self._horizon, self._size = design.horizon, 2 * design.experiment.motion_scale
        self.exchange = Exchange(contact, self._period, design.law.sensing.size)
        self._watch = Watch(self.exchange, self._period, say)
        self.record = LiveRecord(design.experiment, design.torque_limit, log, say, logs)
        limit = math.inf if design.cranks else design.torque_limit
        self._check = DelayCheck(limit, design.law.timeline.eta, self._period, design.sends)
        sc = design.experiment.scenario
        self._knows_delay = sc.delay.constant and sc.controller.delay_estimator == "none"
        self._parked = self._leads = False
        self._recording, self._hold = True, hold
        self._max_missing = max_missing
        self._measured, self._known = -1, self.memory  # last usable measurement: sample, memory
        self._late = 0  # number of overtaken measurements before it
        part = LearnedSetpoints if design.cranks else LearnedTorques
        self._learned: Any = None if design.learned is None else part(design)
        self.recoveries, self.taken_over = 0, False
        self.missed, self.resting = 0, list[float]()
        self._poses = deque[Array](maxlen=1 + math.ceil(_REST_TIME / self._period))

    def begin(self, flags: ControllerFlags) -> None:
        """Agree with the machine on the begin of the run; see `Exchange.begin`."""
        self._parked = self.exchange.begin(flags)

    # -------------------------------------------------------------- run

    def run(self, duration: float, ending: Callable[[], bool] = lambda: False) -> End:
        """Run for `duration` s, which may be infinite, or until `ending`; then stop the plate.

        A stop of the viewer, Ctrl-C or a failure ends the run at once. After `duration` the first
        `ending` does, too.
        """
        end, k = End("completed", None), 0
        try:
            while not self._complete(k, duration) and not ending():
                end = self._step(k)
                if end.status != "completed":
                    break
                k += 1
            if end.status == "completed":
                if not self._complete(k, duration):
                    end = self._watch.end("interrupted", k, "ended")
                end = self._come_to_rest(k, ending) or end
        except KeyboardInterrupt:
            if not self._complete(k, duration):
                end = self._watch.end("interrupted", k, "stopped")
        self.exchange.stop()
        if end.status != "left_workspace":
            since = "without commands" if end.status == "lost_machine" else "now"
            alone = self._design.left_alone(self.exchange.contact.machine)
            end = end._replace(then=f"{since} {alone}")
            self._say(end.then)
        self._viewer.ended(end)
        return end

    def _complete(self, k: int, duration: float) -> bool:
        return k * self._period >= duration - 1e-9 or self._viewer.finished()

    def _step(self, k: int) -> End:
        if self._viewer.stopped():
            raise KeyboardInterrupt
        message = self.exchange.wait(k)
        return self._watch.ended(k, message) or self._sample(k, message) or End("completed", None)

    def _come_to_rest(self, k: int, ending: Callable[[], bool]) -> End | None:
        """Go on, without a record, until the plate is at rest; return a failure meanwhile."""
        last, asked, held = k + math.ceil(RESTING / self._period), ending(), False
        again = "Ctrl-C again" if asked else "Ctrl-C"
        self._recording = False
        self._watch.report(k, f"coming to rest, within {RESTING:g} s; {again} stops at once")
        while asked or not ending():
            end = self._step(k)
            if end.status != "completed":
                return end
            rests, k = self._rests(k), k + 1
            if not held and (rests or k == last):
                found = "at rest" if rests else f"still in motion, {self._motion()}"
                self._watch.report(k, f"{found}; held until {again}" if self._hold else found)
                held = self._hold
                if not held:
                    break
        return None

    def _rests(self, k: int) -> bool:
        way, t = self._steering.way, k * self._period
        wanted = np.array([way.at(t)[RATES], way.at(t + self._horizon)[RATES]])
        still = np.all(np.abs(wanted) <= REST_RATE * self._size)
        return bool(still and np.all(self._moved() <= START_ERROR * self._size))

    def _moved(self) -> Array:
        """Return by how much each coordinate (6,) has varied during the last _REST_TIME."""
        return np.asarray(np.ptp(self._poses, axis=0))

    def _motion(self) -> str:
        return f"by {turn_and_way(self._moved())} in {_REST_TIME:g} s"

    def _sample(self, k: int, message: MachineMessage | None) -> End | None:
        """Step the law and send its torques; return the end of the run, or None."""
        design, t = self._design, k * self._period
        values = None if message is None else message.values
        missing = np.full(design.law.sensing.size, np.nan)
        measurement, report = Measurement.of(missing if values is None else values), None
        if message is not None:
            acted = self._acted(message)
            problem = self._check.problem(acted)
            if problem is not None and (design.sends or self._knows_delay):
                return self._watch.end("refused", k, problem)
            report = self._heard(k, acted)
        if not self._leads:
            if not measurement.complete and not self._parked:  # the pose is unknown
                self.exchange.send_nothing()
                return self._lost(k)
            refused = self._start(t, measurement, message)
            if refused is not None:
                return self._watch.end("refused", k, refused)
            self._leads = True
        counts = self.memory.counts
        request = self._viewer.request() if self._recording else Request(rest=True)
        self._steering = self._steering.on(t + self._horizon, request)
        started = clock.perf_counter()
        self.memory = self._stepped(t, measurement, report if design.sends else None)
        packet, first = self._packet(k)
        seconds = clock.perf_counter() - started
        self._send(k, packet, first)
        self._poses.append(self.memory.belief.state[POSE])
        late = self.exchange.late(k)
        self.missed += late > self.exchange.real_period + self.exchange.jitter
        wanted = self._steering.way.at(t)
        # A blend onto the motion is judged by the motion, as in a simulation.
        judged = wanted if self._by_hand else evaluate(self._steering.motion, t)
        if self._recording:
            packets = self._packets(k, message)
            self.record.sample(k, self._as_sent(k), measurement, judged, seconds, late, packets)
        else:
            self.resting.append(late)
        self._recover(t)
        if has_measured(self.memory, counts):
            self._measured, self._known, self._late = k, self.memory, self.exchange.overtaken
        self._viewer.show(self._snapshot(k, wanted, judged))
        return self._lost(k)

    def _lost(self, k: int) -> End | None:
        """Return the end of a run without usable measurements for too long, or None."""
        gap = (k - self._measured) * self._period
        if self._may_miss(gap):
            return None
        contact = self.exchange.contact
        silent = contact.machine.rate * (now() - contact.heard) / SECOND
        if silent >= gap - self._period:
            return self._watch.end("lost_machine", k, f"the machine was silent for {silent:.3g} s")
        before, after = self._known.counts._asdict(), self.memory.counts._asdict()
        causes = [
            f"{after[name] - before[name]} {name.removeprefix('measurements_')}"
            for name in after
            if name.startswith("measurements_") and after[name] > before[name]
        ]
        if late := self.exchange.overtaken - self._late:
            causes.append(f"{late} came too late: {contact.late_by()}")
        if self._watch.safe:
            causes.append(f"the machine reports: {self._watch.safe}")
        reason = f"no usable measurement for {gap:.3g} s ({', '.join(causes) or 'none came'})"
        return self._watch.end("lost_contact", k, reason)

    def _may_miss(self, gap: float) -> bool:
        """Return whether the run goes on after `gap` s without a usable measurement."""
        if gap < self._period / 2:
            return True
        if self._max_missing is not None:
            return gap <= self._max_missing + 1e-9
        eta = self._design.law.timeline.eta
        # The start of a parked plate is known, though the first angles of encoders show no rates.
        starts = self._parked and self._measured * self._period < eta
        if gap > LONGEST_GAP + 1e-9 or starts or self._measured < 0:
            return gap <= LONGEST_GAP + 1e-9
        plant, estimate = self._design.law.plant, self._known.belief.estimate
        return gap <= eta or within_reach(plant, estimate, self.record.latest)(gap + eta)

    @property
    def _by_hand(self) -> bool:
        return self._steering.governed is not None

    # -------------------------------------------------------------- torques

    def _stepped(self, t: float, measurement: Measurement, report: Report | None) -> Any:
        """Return the memory after the law's step at t in s."""
        way, weights = self._steering.way, self._design.experiment.scenario.controller.weights

        def ahead(times: Array) -> Array:
            return np.array([way.at(t + one) for one in times])

        return self._law.step(self.memory, measurement, ahead, np.array(weights), report)

    def _packet(self, k: int) -> tuple[Array, int]:
        """Return the rows (n, 6) to send, and the sample that the first one is of."""
        memory = self.memory
        rows = memory.sent.packets[-1] if self._design.sends else memory.in_flight[-1:]
        if self._learned is not None:
            rows = self._learned.packet(k, memory, rows, self._by_hand)
        return rows, k - self._design.repeats

    def _send(self, k: int, packet: Array, first: int) -> None:
        P, timeline = round(self._period * SECOND), self._design.law.timeline
        eta = round(self.memory.belief.timeline.eta * SECOND)
        self.exchange.send(k, packet, first, eta, self._design.cranks)
        self._check.sent(first + round((eta - timeline.fraction * P) / P), packet)

    def _as_sent(self, k: int) -> Any:
        """Return the memory for the record, with the torque as it was sent."""
        return self.memory if self._learned is None else self._learned.as_sent(k, self.memory)

    def _acted(self, message: MachineMessage) -> dict[int, Array]:
        """Return the torques (6,) that have acted by the number of the period that they began."""
        if message.acted_from == NEVER:
            return {}
        P = message.period
        fraction = round(self._design.law.timeline.fraction * P)
        newest = round((message.acted_from - message.begin - fraction) / P)
        return {newest - i: torque for i, torque in enumerate(message.acted)}

    def _heard(self, k: int, acted: dict[int, Array]) -> Report | None:
        """Record the torques that have acted, and return the report on them for the law."""
        self.record.acted(acted)
        law, rows = self._design.law, list[Array]()
        number = law.extra_torques + 1
        for n in range(k - 1, k - 1 - number, -1):
            torque = self.record.applied.get(n)
            if torque is None:
                break
            own = 0 if self._learned is None else self._learned.added(n - law.timeline.steps)
            rows.append(torque - own)
        arrived = self.exchange.arrived(k, number)
        return Report(arrived, np.array(rows).reshape(-1, NUM_TORQUES))

    def _packets(self, k: int, message: MachineMessage | None) -> Array:
        """Return the counts of `scenario.signals.PACKETS`; only the machine knows the late ones."""
        if not self._design.sends:
            return np.full(len(PACKETS), np.nan)
        contact = self.exchange.contact
        periods = contact.periods(message or contact.machine)
        return np.array([k + 1.0, contact.link.packets_lost, math.nan, *periods])

    # -------------------------------------------------------------- reference

    def _start(
        self, t: float, measurement: Measurement, message: MachineMessage | None
    ) -> str | None:
        """Lead a plate that is not at the scenario's start to the motion; return why not, or None.

        A parked machine without a measurement is taken to be at the start.
        """
        design, part = self._design, self._compared
        first = design.law.sensing.start(measurement) if measurement.complete else None
        if first is None:
            return None
        away = np.abs(first.state - design.experiment.start) / np.tile(self._size, 2)
        if away[part].max() <= self._led_from:
            return None
        self.taken_over = True
        problem = self._lead(t, first.state, message)
        if problem is None:
            apart = np.abs(first.state - design.experiment.start)[POSE]
            away = turn_and_way(apart)
            self._say(f"the plate is {away} off the scenario's start: it is led there first")
        return problem

    def _lead(self, t: float, state: Array, message: MachineMessage | None) -> str | None:
        """Lead the plate from a state (12,) at t in s to the motion; return why not, or None."""
        design = self._design
        queue = design.queue if self._parked else np.zeros_like(design.queue)
        if message is not None and len(message.acted):
            queue = np.tile(message.acted[0], (len(queue), 1))
        elif self._parked and design.experiment.scenario.queue == "equilibrium":
            # Those of another pose would make it fall in the model, also where the lengths are off.
            rest, limit = np.zeros(NUM_TORQUES), design.torque_limit
            hold = design.law.plant.dynamics.inverse_dynamics(state[POSE], rest, rest)
            queue = np.tile(np.clip(hold, -limit, limit), (len(queue), 1))
        self._law = replace(design.law, open_loop_samples=0)
        self.memory = self._law.initial_memory(queue)
        schedule = until_next(design.law.timeline, queue)
        steering = replanned(self._steering, design.law.plant, t, state, schedule)
        if isinstance(steering, str):
            return f"no reference from the present pose: {steering}"
        self._steering = steering
        return None

    def _recover(self, t: float) -> None:
        """Lead the plate back from where it is predicted to be, if the law would hardly do it."""
        steering = recovered(self._steering, self._design.law, self.memory, t, self._size)
        if isinstance(steering, Steering):  # otherwise tried again at the next sample
            self._steering, self.memory = steering, self.memory.without_error()
            self.recoveries += 1

    def _snapshot(self, k: int, wanted: Array, judged: Array) -> Snapshot:
        link, memory = self.exchange.contact.link, self.memory
        error = memory.belief.state[POSE] - judged[POSE]
        # Without measurements the model follows the reference, and its error says nothing.
        unmeasured = (k - self._measured) * self._period
        if unmeasured > self._design.law.timeline.eta + self._period / 2:
            error = np.full(error.shape, np.nan)
        return Snapshot(
            time=k * self._period,
            state=np.array(memory.belief.state),
            wanted=wanted,
            torque=self.record.latest,
            error=float(100 * np.mean(np.abs(error) / self._design.experiment.scale)),
            eta=float(memory.belief.delay[0]),
            trip=link.typical,
            spread=link.spread,
            lost=1 - (1 - link.loss_there) * (1 - link.loss_back),
            missed=self.missed,
            unmeasured=unmeasured,
            recoveries=self.recoveries,
            safe=self._watch.safe,
            by_hand=self._by_hand,
            limit=self._steering.limit,
            resting=not self._recording,
            estimates={name: one["value"] for name, one in self.record.estimates.items()},
        )


def turn_and_way(change: Array) -> str:
    """Return the largest turn and the largest way of a change (6,) of the pose in words."""
    return f"{math.degrees(change[ANGLES].max()):.2g} deg and {1e3 * change[POSITION].max():.2g} mm"


class CrankLoop(LiveLoop):
    """Runs the law for servos given by their stiffness, which sends plans of setpoints.

    Row i of a plan is the setpoint that the plan of i samples later will begin with.
    """

    _compared = POSE
    _led_from = START_ERROR  # servos would jump
    _last: Array | None = None
    """Setpoint (6,) that was sent last, rad."""

    def _heard(self, k: int, acted: dict[int, Array]) -> None:
        self.record.latest = self.memory.command[MODEL_TORQUE]  # the servos' own is not known

    def _stepped(self, t: float, measurement: Measurement, report: Report | None) -> Any:
        wanted = self._steering.way.at(t + self._horizon)[None]
        nothing = np.full(self._design.law.reports.size, np.nan)
        return self._law.step(self.memory, measurement, lambda _: wanted, nothing)

    def _packet(self, k: int) -> tuple[Array, int]:
        law, command, t = self._design.law, self.memory.command, k * self._period + self._horizon
        rows, number = [command[POSE]], self._design.rows
        learned: Array = np.zeros((number, NUM_TORQUES))
        if self._learned is not None:
            learned = self._learned.plan(t, number, self._by_hand)
            before = rows[0] if self._last is None else self._last
            rows = [law.servo.limited(rows[0] + learned[0], before)]
        self._last = rows[0]
        for i in range(1, number):
            wanted = self._steering.way.at(t + i * self._period)
            try:
                further = law.command(wanted, self.memory.belief.parameters)[POSE]
            except UnreachablePoseError:
                break  # the plan ends before
            rows.append(law.servo.limited(further + learned[i], rows[-1]))
        return np.array(rows), k

    def _as_sent(self, k: int) -> Any:
        return self.memory

    def _lead(self, t: float, state: Array, message: MachineMessage | None) -> str | None:
        begins, motion, pose = t + self._horizon, self._steering.motion, state[POSE]
        for duration in _SOFT_STARTS:
            way = Way.along(catch_up(pose, np.zeros(len(pose)), motion, begins, duration))
            if self._keeps_limits(way, begins, duration):
                law = self._design.law
                begun = np.concatenate([pose, np.zeros(NUM_REFERENCE - len(pose))])
                command = law.command(begun, law.plant.dynamics.parameters)
                self.memory = self._law.initial_memory(command)
                self._steering = replace(self._steering, way=way)
                return None
        return "no motion of up to 8 s from the present pose to the reference keeps the limits"

    def _keeps_limits(self, way: Way, begins: float, duration: float) -> bool:
        """Return whether the start of a way is within reach and torque."""
        plant, times = self._design.law.plant, np.arange(begins, begins + duration, self._period)
        rows = np.array([way.at(t) for t in times])
        if not margins(plant.mechanism, rows[:, POSE]).min() > 0:
            return False
        torques = plant.dynamics.torques_along(rows)
        return not np.abs(torques).max() > self._design.torque_limit

    def _recover(self, t: float) -> None:
        """Do nothing: servos follow the reference by themselves."""
