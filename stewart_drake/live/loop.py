"""The law in real time: one step for each measurement of a machine at the other end of a link.

Sample k is the instant t0 + k dt of the machine's clock. Its step begins when its measurement has
come, or when that is later than all of the last ones: then it counts as missing, and the model
replaces it. The step is thus as periodic as the link, and never waits for a lost datagram. A step
that ends more than a period after its sample was due misses its deadline. Late steps are taken all
the same, one after the other, until the loop has caught up.
"""

import math
import time as clock
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.belief import Belief
from stewart_drake.law.channel import Report
from stewart_drake.law.core_law import AnyMemory, serving
from stewart_drake.law.learned import LearnedMemory
from stewart_drake.law.sensing import Measurement
from stewart_drake.law.servos import rise
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.live.checks import LONGEST_GAP, ReportCheck, stays_within_reach
from stewart_drake.live.contact import Contact, await_free
from stewart_drake.live.design import Design
from stewart_drake.live.endpoint import STALL, now
from stewart_drake.live.governor import Request, Steering, Way
from stewart_drake.live.log import LiveRecord
from stewart_drake.live.protocol import (
    NEVER,
    NOTHING,
    SECOND,
    ControllerFlags,
    MachineFlags,
    MachineMessage,
    Refusal,
)
from stewart_drake.loop.controller import reported
from stewart_drake.loop.peer import Fault
from stewart_drake.loop.recording import has_measured
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.run_log import RunLog
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    MODEL_TORQUE,
    NUM_REFERENCE,
    NUM_STATE,
    NUM_TORQUES,
    PACKETS,
    POSE,
    RATES,
)
from stewart_drake.scenario.trajectories import catch_up, evaluate
from stewart_drake.types import Array

REPLAN_ERROR: Final = 0.08
"""Prediction error at which a new reference is planned, as a share of the motion."""
START_ERROR: Final = 0.02
"""Distance from the scenario's start up to which the plate is there, in the same unit."""
REST_RATE: Final = 0.005
"""Rate up to which the plate is at rest, in the same unit per s."""
RESTING: Final = 8.0
"""Longest time for coming to rest, s."""
SILENT: Final = 1.0
"""Silence of the machine that is reported, s; at least ten periods."""
PATIENCE: Final = 10.0
"""Silence of the machine after which the run ends, s."""
_LEAD: Final = 0.05
"""Time from the first request of a begin until then, in addition to a round trip, s."""
_REPEATED: Final = 0.05
"""Time between two such requests, s."""
_ANSWER: Final = 10.0
"""Longest wait for the begin, s."""
_SPARE: Final = 0.002
"""Wait for a measurement in addition to the usual one, s."""
_FURTHEST: Final = 4096
"""Largest number of samples by which a measurement may be ahead of the next one."""
_KEPT: Final = 64
"""Number of past samples whose messages are kept."""
_SOFT_STARTS: Final = (1.0, 2.0, 4.0, 8.0)
"""Durations of a path from elsewhere onto the reference, s, tried in this order."""


_ADVICE: Final = {
    "left_workspace": "Bring the plate back to its start and start live again. With --out the log "
    "shows the loss: stewart-drake replay LOG, stewart-drake identify LOG.",
    "lost_contact": "Check the sensor and its connection: datagrams arrive, usable measurements do "
    "not. --max-missing allows longer gaps.",
    "lost_machine": "Check the machine's process and the network, then start live again. The "
    "machine goes to its safe torque by itself.",
    "refused": "Correct what is named, then start live again.",
}
"""What to do after a run, by its status."""


class End(NamedTuple):
    """How a run ended: its status (`loop.results.RunSummary`) and the failure, if any."""

    status: str
    stopped: Failure | None

    @property
    def words(self) -> str:
        """Status and failure in words."""
        status = self.status.replace("_", " ")
        return status if self.stopped is None else f"{status}: {self.stopped}"

    @property
    def advice(self) -> str:
        """Advice after a run that was lost; else empty."""
        return _ADVICE.get(self.status, "")


class Snapshot(NamedTuple):
    """The loop at a sample."""

    time: float  # time since the begin, s
    state: Array  # estimated state (12,)
    wanted: Array  # reference (18,)
    torque: Array  # torque that acts (6,), N m
    error: float  # mean pose error, % of peak to peak
    eta: float  # delay from a measurement to its torque as the law assumes it, s
    trip: float  # median round trip, s
    spread: float  # standard deviation of the round trips, s
    lost: float  # share of the datagrams that are lost, there and back
    missed: int  # number of missed deadlines
    safe: str | None  # why the safe torque acts, or None
    by_hand: bool  # whether the target is set by hand
    limit: str | None  # limit that prevents the requested motion, or None


class Viewer:
    """Shows a run and passes on requests; this one does neither."""

    def show(self, snapshot: Snapshot) -> None:
        """Show the loop at a sample, without waiting."""

    def request(self) -> Request:
        """Return the present request."""
        return Request()

    def stopped(self) -> bool:
        """Return whether an immediate stop is requested."""
        return False

    def finished(self) -> bool:
        """Return whether the run is complete before its duration."""
        return False

    def ended(self, end: End) -> None:
        """Show how the run ended; the last call."""


@dataclass
class Timing:
    """Timing of the loop."""

    samples: int = 0  # number of steps
    # delay of the last step, s: from the earliest arrival of its measurement until its torques were
    # sent. It includes the jitter of the link and the wait for a lost datagram.
    late: float = math.nan
    # the same of the steps that bring the plate to rest, which are not recorded
    resting: list[float] = field(default_factory=list)
    missed: int = 0  # number of steps whose delay exceeded a period and the usual jitter
    overtaken: int = 0  # number of measurements that came after their step

    def summary(self, recorded: Array) -> dict[str, Any]:
        """Return entries of summary.json, from `late` (n,) of the recorded steps."""
        late = np.append(recorded, self.resting)
        late = late if len(late) else np.array([math.nan])
        p99 = float(np.quantile(late, 0.99))
        return {
            "samples": self.samples,
            "deadlines_missed": self.missed,
            "measurements_overtaken": self.overtaken,
            "sent_after_due_ms": {
                "median": 1e3 * float(np.median(late)),
                "p99": 1e3 * p99,
                "worst": 1e3 * float(late.max()),
            },
            "jitter_std_ms": 1e3 * float(np.std(np.clip(late, None, p99))),
        }


class LiveLoop:
    """Runs a law against a machine.

    A learned torque l is added as in `law.learned`. For the instant t of the motion it is

        c + g(s) (l(t) - c),   c the mean of l, g that of a soft start.

    s goes from 0 to 1 within a second on the motion, and back by hand or on the way to rest.

    Args:
        design: law and settings.
        steering: reference from t = 0 on.
        contact: session that the machine has offered.
        viewer: shows the run.
        say: prints a line.
        max_missing: longest gap of usable measurements, s. By default as long as the estimator's
            uncertainty allows (`live.checks`).
        log: CSV file of the record, written as the run goes on; a temporary one by default.
        logs: further logs of the same rows.

    Attributes:
        record: record of the run.
        memory: memory of the law after the last sample.
        recoveries: number of new references that were planned.
        taken_over: whether the plate was not at the scenario's start.
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
    ) -> None:
        self._design, self._steering, self._contact = design, steering, contact
        self._viewer, self._say, self._max_missing = viewer, say, max_missing
        self._law: Any
        self._law = serving(design.law).law
        self._limit = design.torque_limit
        self.record = LiveRecord(design.experiment, design.torque_limit, log, say, logs)
        self.timing = Timing()
        self.memory: AnyMemory = self._law.initial_memory(design.queue)
        self.recoveries, self.taken_over = 0, False
        self._measured, self._known = -1, self.memory
        c = design.experiment.scenario.controller
        self._period, self._weights = c.period, np.array(c.weights)
        self._size = 2 * design.experiment.motion_scale
        self._sends = design.sends
        self._horizon = self._ahead()
        self._began, self._came = 0, dict[int, MachineMessage]()
        self._sequences = dict[int, int]()
        self._flags, self._silent_since = MachineFlags(0), 0
        self._asked, self._recording = NOTHING, True
        self._parked = self._leads = self._stalled = False
        self._safe: str | None = None
        self._check = ReportCheck(self._limit)
        self._share = 0.0
        self._added, self._saturated = dict[int, Array](), 0  # by sample

    def _ahead(self) -> float:
        """Return how far ahead of a sample the reference is fixed, s."""
        # The next torque needs the reference up to the end of the hold after its own. Later torques
        # may still change. Within a hold the reference has no jump of its third derivative.
        return float(self._design.law.timeline.holds(0, 2)[-1])

    # -------------------------------------------------------------- begin

    def begin(self, flags: ControllerFlags) -> None:
        """Agree with the machine on the begin of the run, and wait until then.

        Raises:
            ConfigError: another controller drives it.
            TimeoutError: it does not begin.
        """
        contact = self._contact
        await_free(contact)
        last = contact.last
        assert last is not None
        contact.join()
        self._parked = bool(last.flags & (MachineFlags.PARKED | MachineFlags.RESETS))
        # The machine's clock, or earlier by the way back.
        here = (clock.monotonic() - contact.due(0, last.rate)) * last.rate
        lead = _LEAD + contact.link.longest / last.rate
        asked, until = round((here + lead * last.rate) * SECOND), now() + round(_ANSWER * SECOND)
        step = round(min(self._period / last.rate, _REPEATED) * SECOND)
        self._asked = flags
        while True:
            contact.send(begin=self._began or asked, flags=flags)
            for message in contact.wait(now() + step):
                if message.begin != NEVER and message.head.nonce == contact.session.nonce:
                    self._began = message.begin
                self._take(message)
            if self._began and now() >= self._due(0):
                return
            if now() > until:
                raise TimeoutError("got one that has not begun when it was asked to")

    @property
    def _real_period(self) -> float:
        """Period of the controller, s of the own clock."""
        last = self._contact.last
        return self._period if last is None else self._period / last.rate

    def _take(self, message: MachineMessage) -> None:
        """Keep a measurement until its sample."""
        if message.begin == NEVER or message.sampled < message.begin:
            return
        values, size = message.values, self._design.law.sensing.size
        if values is not None and values.size != size:
            found = f"a measurement of {values.size} numbers; expected {size}"
            self._contact.endpoint.refuse(Refusal.MALFORMED, found)
            return
        k = round((message.sampled - message.begin) / message.period)
        if k > self.timing.samples + _FURTHEST:
            self._contact.endpoint.refuse(Refusal.MALFORMED)
            return
        if k < self.timing.samples:
            self.timing.overtaken += 1
            self._contact.endpoint.refuse(Refusal.LATE)
        self._came.setdefault(k, message)

    # -------------------------------------------------------------- run

    def run(self, duration: float, ending: Callable[[], bool] = lambda: False) -> End:
        """Run for `duration` s, which may be infinite, then bring the plate to rest.

        A stop of the viewer, Ctrl-C or a failure ends the run at once.

        Args:
            duration: recorded time, s.
            ending: returns whether to end before that.
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
                    end = self._end("interrupted", k, "ended")
                self._come_to_rest(k)
        except KeyboardInterrupt:
            end = self._end("interrupted", k, "stopped")
        self.stop()
        self._viewer.ended(end)
        return end

    def _complete(self, k: int, duration: float) -> bool:
        return k * self._period >= duration - 1e-9 or self._viewer.finished()

    def _end(self, status: str, k: int, reason: str, leg: int | None = None) -> End:
        return End(status, Failure(k * self._period, leg, math.nan, reason))

    def _step(self, k: int) -> End:
        if self._viewer.stopped():
            raise KeyboardInterrupt
        message = self._await(k)
        self._report_stall(k)
        return self._watch(k, message) or self._sample(k, message) or End("completed", None)

    def _come_to_rest(self, k: int) -> None:
        """Go on, without a record, until the plate is at rest."""
        self._recording, last = False, k + math.ceil(RESTING / self._period)
        while k < last and self._step(k).status == "completed":
            way, t = self._steering.way, k * self._period
            wanted = np.array([way.at(t)[RATES], way.at(t + self._horizon)[RATES]])
            rates = np.vstack([wanted, self.memory.belief.state[RATES]])
            if np.all(np.abs(rates) <= REST_RATE * self._size):
                return
            k += 1

    def stop(self) -> None:
        """Order the safe torque, in three datagrams."""
        for _ in range(3):
            self._contact.send(flags=ControllerFlags.STOP | self._asked)
            clock.sleep(0.01)

    def _due(self, k: int) -> int:
        """Return the earliest arrival of the measurement of a sample, ns of the own clock."""
        last = self._contact.last
        assert last is not None
        sampled = self._began + round(k * self._period * SECOND)
        return round(self._contact.due(sampled, last.rate) * SECOND)

    def _await(self, k: int) -> MachineMessage | None:
        """Return the message with a sample's measurement, or None once it is too late."""
        for message in self._contact.receive():
            self._take(message)
        usual = self._contact.lateness(self._real_period) + _SPARE
        while self._came.get(k) is None:
            until = self._due(k) + round(usual * SECOND)
            if now() >= until:
                break
            for message in self._contact.wait(until):
                self._take(message)
        for old in [n for n in self._came if n < k - _KEPT]:
            del self._came[old]
        return self._came.get(k)

    def _report_stall(self, k: int) -> None:
        """Report once that this process is late by more than the jitter of the link."""
        lag = now() - self._due(k) - self._contact.lateness(self._real_period) * SECOND
        if lag > STALL and not self._stalled:
            self._say(
                f"at {k * self._period:.1f} s: stood still for {lag / SECOND:.1f} s; the machine "
                "went on by its buffer"
            )
        self._stalled = lag > STALL

    def _watch(self, k: int, message: MachineMessage | None) -> End | None:
        """Report changes of the machine; return the end of the run, or None."""
        time, contact = k * self._period, self._contact
        silent = (now() - contact.heard) / SECOND
        if silent > max(SILENT, 10 * self._period):
            if not self._silent_since:
                self._silent_since = contact.heard
                self._say(f"at {time:.1f} s: the machine is silent since {silent:.1f} s; waiting")
            if silent > PATIENCE:
                return self._end("lost_machine", k, f"the machine was silent for {PATIENCE:g} s")
        elif self._silent_since:
            gone = (contact.heard - self._silent_since) / SECOND
            self._silent_since = 0
            self._say(f"at {time:.1f} s: the machine is heard again, after {gone:.1f} s")
        if contact.last is not None and contact.last.reason.fault == Fault.ENDED:
            return self._end("lost_machine", k, contact.last.why)
        if message is None:
            return None
        before, self._flags = self._flags, message.flags
        if MachineFlags.LEFT in message.flags:
            return self._end("left_workspace", k, message.why, message.reason.leg or None)
        self._safe = message.why if MachineFlags.SAFE in message.flags else None
        if MachineFlags.SAFE in message.flags & ~before:
            self._say(f"at {time:.1f} s: the machine is at its safe torque: {self._safe}")
        if MachineFlags.SAFE in before & ~message.flags:
            self._say(f"at {time:.1f} s: torques act again")
        return None

    def _sample(self, k: int, message: MachineMessage | None) -> End | None:
        """Step the law and send its torques; return the end of the run, or None."""
        design, t = self._design, k * self._period
        values = None if message is None else message.values
        missing = np.full(design.law.sensing.size, np.nan)
        measurement, report = Measurement.of(missing if values is None else values), None
        if message is not None:
            acted = self._acted(message)
            problem = self._check.problem(acted) if self._sends else None
            if problem is not None:
                return self._end("refused", k, problem)
            report = self._heard(k, acted)
        if not self._leads:
            if not measurement.complete and not self._parked:  # the pose is unknown
                self._contact.send(begin=self._began, flags=self._asked)
                return self._lost(k)
            refused = self._start(t, measurement, message)
            if refused is not None:
                return self._end("refused", k, refused)
            self._leads = True
        counts = self.memory.counts
        request = self._viewer.request() if self._recording else Request(rest=True)
        self._steering = self._steering.on(t + self._horizon, request)
        way = self._steering.way
        started = clock.perf_counter()
        self.memory = self._stepped(t, measurement, report if self._sends else None)
        packet, first = self._packet(k)
        seconds = clock.perf_counter() - started
        self._send(k, packet, first)
        self._note_timing(k)
        wanted = way.at(t)
        if self._recording:
            # A blend onto the motion is judged by the motion, as in a simulation.
            judged = wanted if self._by_hand else evaluate(self._steering.motion, t)
            packets = self._packets(k, message)
            late = self.timing.late
            self.record.sample(k, self._as_sent(k), measurement, judged, seconds, late, packets)
        self._recover(k)
        self._viewer.show(self._snapshot(k, wanted))
        if has_measured(self.memory, counts):
            self._measured, self._known = k, self.memory
        return self._lost(k)

    def _lost(self, k: int) -> End | None:
        """Return the end of a run without usable measurements for too long, or None."""
        gap = (k - self._measured) * self._period
        if self._may_miss(gap):
            return None
        last = self._contact.last
        assert last is not None
        silent = last.rate * (now() - self._contact.heard) / SECOND
        if silent >= gap - self._period:
            return self._end("lost_machine", k, f"the machine was silent for {silent:.3g} s")
        before, after = self._known.counts._asdict(), self.memory.counts._asdict()
        causes = [
            f"{after[name] - before[name]} {name.removeprefix('measurements_')}"
            for name in after
            if name.startswith("measurements_") and after[name] > before[name]
        ]
        reason = f"no usable measurement for {gap:.3g} s ({', '.join(causes) or 'none came'})"
        return self._end("lost_contact", k, reason)

    def _may_miss(self, gap: float) -> bool:
        """Return whether the run goes on after `gap` s without a usable measurement."""
        if gap < self._period / 2:
            return True
        if self._max_missing is not None:
            return gap <= self._max_missing + 1e-9
        eta = self._design.law.timeline.eta
        if gap > LONGEST_GAP + 1e-9 or self._measured < 0:
            return gap <= LONGEST_GAP + 1e-9
        plant, estimate = self._design.law.plant, self._known.belief.estimate
        return gap <= eta or stays_within_reach(plant, estimate, self.record.latest, gap + eta)

    @property
    def _by_hand(self) -> bool:
        return self._steering.governed is not None

    def _stepped(self, t: float, measurement: Measurement, report: Report | None) -> Any:
        """Return the memory after the law's step at t in s."""
        way = self._steering.way

        def ahead(times: Array) -> Array:
            return np.array([way.at(t + one) for one in times])

        return self._law.step(self.memory, measurement, ahead, self._weights, report)

    def _packet(self, k: int) -> tuple[Array, int]:
        """Return the rows (n, 6) to send, and the sample that the first one is of."""
        memory, repeats, timeline = self.memory, self._design.repeats, self._design.law.timeline
        rows = memory.sent.packets[-1] if self._sends else memory.in_flight[-1:]
        if self._design.learned is None:
            return rows, k - repeats
        middle = k * self._period + timeline.eta + self._period / 2
        signal = self._design.learned()
        mean = signal.coefficients[0]
        share = self._shares(len(rows) - repeats)
        times = middle + self._period * np.arange(len(share))
        learned = mean + share * (signal(times) - mean)
        self._added[k] = learned[0]
        self._added.pop(k - 2 * _KEPT, None)
        earlier = [self._added_at(n) for n in range(k - repeats, k)]
        asked = rows + np.vstack([*earlier, learned])
        asked[repeats] = memory.torque + learned[0]
        sent = self._design.law.plant.motors.saturate(asked)
        self._saturated += bool(np.any(sent[repeats] != asked[repeats]))
        rows[repeats:] = sent[repeats:] - learned  # the limit is on the sum
        memory.in_flight[-1] = rows[repeats]
        return sent, k - repeats

    def _shares(self, number: int) -> Array:
        """Return g(s) of this sample and those after it, (number, 1)."""
        change = self._period / _SOFT_STARTS[0]
        change = -change if self._by_hand else change  # also on the way to rest
        share: Array = self._share + change * np.arange(number, dtype=np.float64)
        self._share = float(np.clip(self._share + change, 0, 1))
        return rise(share)[:, None]

    def _added_at(self, k: int) -> Array:
        """Return what was added to the torque of a sample, (6,) N m."""
        return self._added.get(k, np.zeros(NUM_TORQUES))

    def _as_sent(self, k: int) -> Any:
        """Return the memory for the record, with the torque as it was sent."""
        if k not in self._added:
            return self.memory
        torque = self.memory.torque + self._added[k]
        return LearnedMemory(self.memory, self.memory.in_flight, torque, k, self._saturated)

    def _send(self, k: int, packet: Array, first: int) -> None:
        P = round(self._period * SECOND)
        eta = round(self.memory.belief.timeline.eta * SECOND)
        self._sequences[k] = self._contact.send(
            packet,
            sampled=self._began + k * P,
            playout=self._began + first * P + eta,
            begin=self._began,
            flags=self._asked,
            cranks=self._design.cranks,
        )
        self._sequences.pop(k - 2 * _KEPT, None)
        timeline = self._design.law.timeline
        self._check.sent(first + round((eta - timeline.fraction * P) / P), packet)

    def _note_timing(self, k: int) -> None:
        timing, late = self.timing, (now() - self._due(k)) / SECOND
        timing.samples, timing.late = timing.samples + 1, late
        if not self._recording:
            timing.resting.append(late)
        timing.missed += late > self._real_period + self._contact.lateness(self._real_period)

    # -------------------------------------------------------------- reports

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
        number = reported(self._design.law.kept)
        packets = [self._sequences.get(k - 1 - i) for i in range(number)]
        arrived = np.array([n is not None and self._contact.has_arrived(n) for n in packets])
        rows = list[Array]()
        for i in range(number):
            torque = self.record.applied.get(k - 1 - i)
            if torque is None:
                break
            rows.append(torque - self._added_at(k - 1 - i - self._design.law.timeline.steps))
        return Report(arrived, np.array(rows).reshape(-1, NUM_TORQUES))

    def _packets(self, k: int, message: MachineMessage | None) -> Array:
        """Return the counts of `scenario.signals.PACKETS`; only the machine knows the late ones."""
        last = message or self._contact.last
        if last is None or not self._sends:
            return np.full(len(PACKETS), np.nan)
        return np.array([k + 1.0, self._contact.link.lost, math.nan, last.played, last.dry])

    # -------------------------------------------------------------- reference

    def _start(
        self, t: float, measurement: Measurement, message: MachineMessage | None
    ) -> str | None:
        """Lead a plate that is not at the scenario's start to the motion; return why not, or None.

        A parked machine without a measurement is taken to be at the start.
        """
        design, law = self._design, self._design.law
        first = law.sensing.start(measurement) if measurement.complete else None
        if first is None:
            return None
        away = np.abs(first.state - design.experiment.start) / np.tile(self._size, 2)
        if away.max() <= START_ERROR:
            return None
        self.taken_over = True
        acts = np.zeros(NUM_TORQUES)
        if message is not None and len(message.acted):
            acts = message.acted[0]
        queue = np.tile(acts, (len(design.queue), 1))
        self._law = serving(replace(law, silence=0)).law
        self.memory = self._law.initial_memory(queue)
        steering = self._replanned(t, first.state, _until_next(law.timeline, queue), None)
        if isinstance(steering, str):
            return f"no reference from the present pose: {steering}"
        self._steering = steering
        self._say("the plate is not where the scenario begins: it is led there first")
        return None

    def _recover(self, k: int) -> None:
        """Plan a new reference if the prediction is too far from the old one."""
        belief, law = self.memory.belief, self._design.law
        if not (
            belief.has_state and belief.feeds_back and belief.settled and not self.memory.silence
        ):
            return
        in_flight = self.memory.in_flight
        until = _until_next(belief.timeline, in_flight[:-1])
        schedule = TorqueSchedule(
            np.vstack([until.torques, in_flight[-1:]]), np.append(until.durations, self._period)
        )
        t = k * self._period
        ahead = law.plant.predict(belief.state, schedule, belief.parameters)[-1]
        wanted = self._held_state(t, in_flight[-1], belief)
        away = np.abs(ahead - wanted) / np.tile(self._size, 2)
        if not away.max() > REPLAN_ERROR:  # or NaN
            return
        steering = self._replanned(t, belief.state, schedule, belief.parameters)
        if isinstance(steering, str):
            return  # tried again at the next sample
        self._steering, self.memory = steering, self.memory.without_error()
        self.recoveries += 1

    def _held_state(self, t: float, torque: Array, belief: Belief) -> Array:
        """Return the state (12,) that the reference asks for at the end of the next torque's hold.

        Held torques meet the poses there. Rates differ by equation (rates) of `law.feedforward`.
        """
        law, way, timeline = self._design.law, self._steering.way, belief.timeline
        end = t + timeline.eta + self._period
        wanted = way.at(end)[:NUM_STATE].copy()
        nodes = [way.at(t + node) for node in law.feedforward.nodes(timeline, 0)]
        dynamics = law.plant.dynamics
        changes = law.feedforward.held(np.array(nodes), dynamics, belief.parameters).changes
        with suppress(ArithmeticError, np.linalg.LinAlgError):
            B = law.model.at(wanted, torque, belief.parameters, law.plant).B[RATES]
            wanted += law.feedforward.offset(changes[1:], B, replace(timeline, delay=Delay(1)))
        return wanted

    def _replanned(
        self, t: float, state: Array, schedule: TorqueSchedule, parameters: Array | None
    ) -> Steering | str:
        """Return a reference from the state after the torques in flight, or why there is none."""
        plant = self._design.law.plant
        dynamics = plant.dynamics if parameters is None else plant.dynamics.assuming(parameters)
        states = np.vstack([state, plant.predict(state, schedule, parameters)])
        if not np.all(np.isfinite(states)):
            return "the plate leaves its workspace before a torque can act"
        for x in states:
            failure = diagnose(plant.mechanism, t, x[POSE])
            if failure is not None:
                return f"{failure.reason} before a torque can act"
        torques = np.zeros((1, NUM_TORQUES))
        if len(schedule.torques):
            torques = np.vstack([schedule.torques[:1], schedule.torques])
        full = np.array(
            [
                np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque))
                for x, torque in zip(states, torques, strict=True)
            ]
        )
        times = t + np.append(0.0, np.cumsum(schedule.durations))
        return self._steering.replan(times, full)

    def _snapshot(self, k: int, wanted: Array) -> Snapshot:
        link, memory = self._contact.link, self.memory
        error = memory.belief.state[POSE] - wanted[POSE]
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
            missed=self.timing.missed,
            safe=self._safe,
            by_hand=self._by_hand,
            limit=self._steering.limit,
        )


class CrankLoop(LiveLoop):
    """Runs the law for servos given by their stiffness, which sends plans of setpoints.

    Row i of a plan is the setpoint that the plan of i samples later will begin with. With w the
    law's setpoint for the instant t of the motion, l what was learned and g as of `LiveLoop`, it
    is w(t) + g(s) l(t).
    """

    def __init__(self, design: Design, *args: Any, **kwargs: Any) -> None:
        super().__init__(design, *args, **kwargs)
        self._servos: Any = design.law
        self.memory: Any
        self._check = ReportCheck(math.inf)
        self._no_report = np.full(self._servos.reports.size, np.nan)
        self._last: Array | None = None

    def _ahead(self) -> float:
        return float(self._design.law.preview_times.max())

    def _heard(self, k: int, acted: dict[int, Array]) -> None:
        self.record.latest = self.memory.command[MODEL_TORQUE]  # the servos' own is not known

    def _stepped(self, t: float, measurement: Measurement, report: Report | None) -> Any:
        wanted = self._steering.way.at(t + self._horizon)[None]
        return self._law.step(self.memory, measurement, lambda times: wanted, self._no_report)

    def _packet(self, k: int) -> tuple[Array, int]:
        law, command, t = self._servos, self.memory.command, k * self._period + self._horizon
        learned = self._learned(t)
        rows = [command[POSE]]
        if self._design.learned is not None:
            before = rows[0] if self._last is None else self._last
            rows = [law.servo.limited(rows[0] + learned[0], before)]
        self._last = rows[0]
        for i in range(1, self._design.rows):
            wanted = self._steering.way.at(t + i * self._period)
            try:
                further = law.command(wanted, self.memory.belief.parameters)[POSE]
            except UnreachablePoseError:
                break  # the plan ends before
            rows.append(law.servo.limited(further + learned[i], rows[-1]))
        return np.array(rows), k

    def _learned(self, t: float) -> Array:
        """Return what was learned for a plan from the instant t of the motion on, (n, 6), rad."""
        rows = self._design.rows
        if self._design.learned is None:
            return np.zeros((rows, NUM_TORQUES))
        times: Array = t + self._period * np.arange(rows, dtype=np.float64)
        return np.asarray(self._shares(rows) * self._design.learned()(times))

    def _start(
        self, t: float, measurement: Measurement, message: MachineMessage | None
    ) -> str | None:
        first = self._servos.sensing.start(measurement) if measurement.complete else None
        if first is None:
            return None
        pose = first.state[POSE]
        away = np.abs(pose - self._design.experiment.start[POSE]) / self._size
        if away.max() <= START_ERROR:
            return None
        begun = np.concatenate([pose, np.zeros(NUM_REFERENCE - len(pose))])
        begins, motion, rest = t + self._horizon, self._steering.motion, np.zeros(len(pose))
        for duration in _SOFT_STARTS:
            way = Way.along(catch_up(pose, rest, motion, begins, duration))
            if self._keeps_limits(way, begins, duration):
                self.taken_over = True
                command = self._servos.command(begun, self._servos.plant.dynamics.parameters)
                self.memory = self._law.initial_memory(command)
                self._steering = replace(self._steering, way=way)
                self._say("the plate is not where the scenario begins: it is led there first")
                return None
        return "no motion of up to 8 s from the present pose to the reference keeps the limits"

    def _keeps_limits(self, way: Way, begins: float, duration: float) -> bool:
        """Return whether the start of a way is within reach and torque."""
        plant = self._servos.plant
        for t in np.arange(begins, begins + duration, self._period):
            x = way.at(t)
            if diagnose(plant.mechanism, t, x[POSE]):
                return False
            torque = plant.dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS])
            if np.abs(torque).max() > self._limit:
                return False
        return True

    def _recover(self, k: int) -> None:
        """Do nothing: servos follow the reference by themselves."""


def _until_next(timeline: Timeline, flying: Array) -> TorqueSchedule:
    """Return the schedule until the next torque acts, of torques (n >= L, 6) in flight."""
    return timeline.until_next(timeline.queue(np.vstack([np.zeros(NUM_TORQUES), flying])))
