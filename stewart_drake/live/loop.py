"""The law in real time: a step for each measurement of a machine at the other end of a link.

Sample k is the instant t0 + k dt of the machine's clock. Its step begins when its measurement is
there, or when that is later than any of the last ones was: then it counts as lost, and the model
stands in. So the step is as periodic as what comes over the link, and never waits for what does not
come. A step that is sent more than a period after its sample was due has missed its deadline; it is
taken all the same, one after the other, until the loop has caught up.
"""

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.law.channel import Packets, Report, Wire
from stewart_drake.law.core_law import AnyMemory, serving
from stewart_drake.law.measurement import Measurement
from stewart_drake.law.timeline import Timeline, TorqueSchedule
from stewart_drake.live.blind import LONGEST_GAP, stays_within_reach
from stewart_drake.live.connect import await_free
from stewart_drake.live.contact import Contact
from stewart_drake.live.design import Design
from stewart_drake.live.endpoint import STOOD, now
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
from stewart_drake.live.reports import ReportCheck
from stewart_drake.live.steering import Steering, Wish
from stewart_drake.loop.controller import reported
from stewart_drake.loop.peer import Fault
from stewart_drake.loop.recording import has_measured
from stewart_drake.scenario.signals import NUM_STATE, NUM_TORQUES, PACKETS, POSE, RATES
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array

OFF: Final = 0.08
"""Share of the motion by which a prediction is off the way, so that a new one is planned."""
AT_START: Final = 0.02
"""The same, by which a plate is where the scenario begins."""
STANDS: Final = 0.005
"""The same, per s, by which it moves that has come to rest."""
RESTING: Final = 8.0
"""s in which it must."""
SILENT: Final = 1.0
"""Silence that is reported, s, or ten periods."""
PATIENCE: Final = 10.0
"""s of silence after which the controller gives up."""
_LEAD: Final = 0.05
"""s, beside a round trip, from asking for a begin until then."""
_REPEATED: Final = 0.05
"""s after which it is asked for again."""
_ANSWER: Final = 10.0
"""s in which the machine must have begun."""
_SPARE: Final = 0.002
"""s for which a measurement is waited for beside the usual."""
_FURTHEST: Final = 4096
"""Samples ahead of the next one whose measurements are kept."""
_GONE: Final = 64
"""Number of past samples whose messages are kept."""


class End(NamedTuple):
    """How a run ended: a status as of `loop.results.RunSummary`, and what stopped it."""

    status: str
    stopped: Failure | None

    @property
    def words(self) -> str:
        """The status, and what stopped the run."""
        status = self.status.replace("_", " ")
        return status if self.stopped is None else f"{status}: {self.stopped}"


class Viewer(Protocol):
    """Who watches, and may ask for something."""

    def show(self, seen: "Seen") -> None:
        """The loop as it is now; never waits."""
        ...

    def wish(self) -> Wish:
        """What is asked for."""
        ...

    def stopped(self) -> bool:
        """Whether the end is asked for."""
        ...

    def ended(self, words: str) -> None:
        """Show how the run ended; the last call."""
        ...


class Nobody:
    """No viewer."""

    def show(self, seen: "Seen") -> None:
        """Nothing."""

    def wish(self) -> Wish:
        """The scenario's motion."""
        return Wish()

    def stopped(self) -> bool:
        """Never."""
        return False

    def ended(self, words: str) -> None:
        """Nothing."""


class Seen(NamedTuple):
    """The loop at a sample.

    Attributes:
        time: s since the begin.
        state: (12,) of the plate.
        wanted: (18,) of the reference.
        torque: (6,) N m, that acts.
        error: mean pose error, % of peak to peak.
        eta: s, from a measurement to its torque, as the law believes.
        trip: s, median round trip of the link.
        spread: s, standard deviation of those.
        lost: share of the datagrams that are lost, there and back.
        missed: deadlines.
        safe: why the machine is at its safe torque, or None.
        by_hand: whether a hand leads.
        limit: what keeps the plate from what is asked for, or None.
    """

    time: float
    state: Array
    wanted: Array
    torque: Array
    error: float
    eta: float
    trip: float
    spread: float
    lost: float
    missed: int
    safe: str | None
    by_hand: bool
    limit: str | None


@dataclass
class Pace:
    """How periodic the loop was.

    Attributes:
        samples: number of steps.
        late: s, of the last one: from the soonest that its measurement could have come until its
            torques went out: what the link adds, the wait for what is lost, the step.
        resting: the same of the steps that bring the plate to rest, which are not recorded.
        missed: how many of them took a period longer than measurements usually do.
        overtaken: measurements that came after their step.
    """

    samples: int = 0
    late: float = math.nan
    resting: list[float] = field(default_factory=list)
    missed: int = 0
    overtaken: int = 0

    def summary(self, recorded: Array) -> dict[str, Any]:
        """Return entries of summary.json, from `late` (n,) of the recorded steps."""
        late = np.append(recorded, self.resting)
        late = late if len(late) else np.array([math.nan])
        median = float(np.median(late))
        return {
            "samples": self.samples,
            "deadlines_missed": self.missed,
            "measurements_overtaken": self.overtaken,
            "sent_after_due_ms": {
                "median": 1e3 * median,
                "p99": 1e3 * float(np.quantile(late, 0.99)),
                "worst": 1e3 * float(late.max()),
            },
            "jitter_std_ms": 1e3 * float(np.std(np.clip(late, None, np.quantile(late, 0.99)))),
        }


class LiveLoop:
    """Runs a law against a machine.

    Args:
        design: what to run.
        steering: of the reference, from t = 0 on.
        contact: a session that the machine has offered.
        viewer: who watches.
        say: prints a line.
        max_missing: s without a usable measurement after which the run ends; None is as long as the
            estimator's uncertainty allows (`live.blind`).
        log: CSV file that the rows of the record are written to as they come; None is a temporary
            one.

    Attributes:
        record: of the run.
        pace: see `Pace`.
        memory: of the law, as of the last sample.
        recoveries: how often a new way was planned.
        taken_over: whether the plate was anywhere else than at the scenario's start.
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
    ) -> None:
        self._design, self._steering, self._contact = design, steering, contact
        self._viewer, self._say, self._max_missing = viewer, say, max_missing
        self._law: Any
        self._law = serving(design.law).law
        self.record = LiveRecord(design.experiment, design.torque_limit, log, say)
        self.pace = Pace()
        self.memory: AnyMemory = self._law.initial_memory(design.queue)
        self.recoveries, self.taken_over = 0, False
        self._measured, self._known = -1, self.memory
        c = design.experiment.scenario.controller
        self._period, self._weights = c.period, np.array([c.w_Q, c.w_R])
        self._size = 2 * design.experiment.motion_scale
        self._sends = isinstance(design.law.channel, Packets)
        # The next torque alone: what a plan goes on with may still change.
        self._horizon = float(replace(design.law, channel=Wire()).preview_times.max())
        self._began, self._came = 0, dict[int, MachineMessage]()
        self._sequences = dict[int, int]()
        self._flags, self._silent_since = MachineFlags(0), 0
        self._asked, self._recording = NOTHING, True
        self._parked = self._leads = self._late = False
        self._safe: str | None = None
        self._check = ReportCheck(design.torque_limit)

    # -------------------------------------------------------------- the begin

    def begin(self, flags: ControllerFlags) -> None:
        """Agree with the machine on when the run begins, and wait until then.

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
        # Of the machine's clock, or earlier by the way back.
        here = (clock.monotonic() - contact.soonest) * last.rate
        lead = _LEAD + contact.link.longest
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

    def _take(self, message: MachineMessage) -> None:
        """Keep a measurement until its sample."""
        if message.begin == NEVER or message.sampled < message.begin:
            return
        values, size = message.values, self._design.law.sensing.size
        if values is not None and values.size != size:
            found = f"a measurement of {values.size} numbers; expected {size}"
            self._contact.refuse(Refusal.MALFORMED, found)
            return
        k = round((message.sampled - message.begin) / message.period)
        if k > self.pace.samples + _FURTHEST:
            self._contact.refuse(Refusal.MALFORMED)
            return
        if k < self.pace.samples:
            self.pace.overtaken += 1
            self._contact.refuse(Refusal.LATE)
        self._came.setdefault(k, message)

    # -------------------------------------------------------------- the run

    def run(self, duration: float, ending: Callable[[], bool] = lambda: False) -> End:
        """Go on for so many s, which may be infinite, then bring the plate to rest.

        Args:
            duration: s, that are recorded.
            ending: whether to come to rest before that.

        Returns:
            How it ended. A viewer's stop, Ctrl-C, and whatever goes wrong end it at once.
        """
        end, k = End("completed", None), 0
        try:
            while k * self._period < duration - 1e-9 and not ending():
                end = self._step(k)
                if end.status != "completed":
                    break
                k += 1
            if end.status == "completed":
                if k * self._period < duration - 1e-9:
                    end = End("interrupted", Failure(k * self._period, None, math.nan, "ended"))
                self._come_to_rest(k)
        except KeyboardInterrupt:
            end = End("interrupted", Failure(k * self._period, None, math.nan, "stopped"))
        self.stop()
        self._viewer.ended(end.words)
        return end

    def _step(self, k: int) -> End:
        if self._viewer.stopped():
            raise KeyboardInterrupt
        message = self._await(k)
        self._tell_lag(k)
        return self._over(k, message) or self._sample(k, message) or End("completed", None)

    def _come_to_rest(self, k: int) -> None:
        """Go on until the plate stands, without a record."""
        self._recording, last = False, k + math.ceil(RESTING / self._period)
        while k < last and self._step(k).status == "completed":
            way, t = self._steering.way, k * self._period
            wanted = np.array([way.at(t)[RATES], way.at(t + self._horizon)[RATES]])
            rates = np.vstack([wanted, self.memory.belief.state[RATES]])
            if np.all(np.abs(rates) <= STANDS * self._size):
                return
            k += 1

    def stop(self) -> None:
        """Order the safe torque, in three datagrams."""
        for _ in range(3):
            self._contact.send(flags=ControllerFlags.STOP | self._asked)
            clock.sleep(0.01)

    def _due(self, k: int) -> int:
        """ns of the own clock at which the measurement of a sample may come at the soonest."""
        last = self._contact.last
        assert last is not None
        sampled = self._began + round(k * self._period * SECOND)
        return round(self._contact.due(sampled, last.rate) * SECOND)

    def _await(self, k: int) -> MachineMessage | None:
        """The message with a sample's measurement, or None once it is too late."""
        for message in self._contact.receive():
            self._take(message)
        usual = self._contact.lateness(self._period) + _SPARE
        while self._came.get(k) is None:
            until = self._due(k) + round(usual * SECOND)
            if now() >= until:
                break
            for message in self._contact.wait(until):
                self._take(message)
        for old in [n for n in self._came if n < k - _GONE]:
            del self._came[old]
        return self._came.get(k)

    def _tell_lag(self, k: int) -> None:
        """Report once that this process is late by more than the link adds."""
        lag = now() - self._due(k) - self._contact.lateness(self._period) * SECOND
        if lag > STOOD and not self._late:
            self._say(
                f"at {k * self._period:.1f} s: stood still for {lag / SECOND:.1f} s; the machine "
                "went on by its buffer"
            )
        self._late = lag > STOOD

    def _over(self, k: int, message: MachineMessage | None) -> End | None:
        """Why it does not go on, or None; what changes about the machine is said."""
        time = k * self._period
        silent = (now() - self._contact.heard) / SECOND
        if silent > max(SILENT, 10 * self._period):
            if not self._silent_since:
                self._silent_since = self._contact.heard
                self._say(f"at {time:.1f} s: the machine is silent since {silent:.1f} s; waiting")
            if silent > PATIENCE:
                reason = f"the machine was silent for {PATIENCE:g} s"
                return End("lost_machine", Failure(time, None, math.nan, reason))
        elif self._silent_since:
            gone = (self._contact.heard - self._silent_since) / SECOND
            self._silent_since = 0
            self._say(f"at {time:.1f} s: the machine is heard again, after {gone:.1f} s")
        last = self._contact.last
        if last is not None and last.reason.fault == Fault.ENDED:
            return End("lost_machine", Failure(time, None, math.nan, last.why))
        if message is None:
            return None
        before, self._flags = self._flags, message.flags
        if MachineFlags.LEFT in message.flags:
            leg = message.reason.leg or None
            return End("left_workspace", Failure(time, leg, math.nan, message.why))
        self._safe = message.why if MachineFlags.SAFE in message.flags else None
        if MachineFlags.SAFE in message.flags & ~before:
            self._say(f"at {time:.1f} s: the machine is at its safe torque: {self._safe}")
        if MachineFlags.SAFE in before & ~message.flags:
            self._say(f"at {time:.1f} s: torques act again")
        return None

    def _sample(self, k: int, message: MachineMessage | None) -> End | None:
        design, t = self._design, k * self._period
        measured = None if message is None else message.values
        nothing = np.full(design.law.sensing.size, np.nan)
        measurement, report = Measurement.of(nothing if measured is None else measured), None
        if message is not None:
            acted = self._acted(message)
            problem = self._check.problem(acted) if self._sends else None
            if problem is not None:
                return End("refused", Failure(t, None, math.nan, problem))
            self.record.acted(acted)
            report = self._report(k)
        if not self._leads:
            if not measurement.complete and not self._parked:  # who knows where it is
                self._contact.send(begin=self._began, flags=self._asked)
                return self._lost(k)
            refused = self._start(t, measurement, message)
            if refused is not None:
                return End("refused", Failure(t, None, math.nan, refused))
            self._leads = True
        counts = self.memory.counts
        wish = self._viewer.wish() if self._recording else Wish(rest=True)
        self._steering = self._steering.on(t + self._horizon, wish)
        way = self._steering.way
        started = clock.perf_counter()
        self.memory = self._law.step(
            self.memory,
            measurement,
            lambda times: np.array([way.at(t + ahead) for ahead in times]),
            self._weights,
            report if self._sends else None,
        )
        seconds = clock.perf_counter() - started
        self._send(k)
        self._note_pace(k)
        wanted = way.at(t)
        if self._recording:
            # A way onto the motion is judged by the motion, as in a simulation.
            judged = wanted if self._by_hand else evaluate(self._steering.motion, t)
            packets = self._packets(k, message)
            late = self.pace.late
            self.record.sample(k, self.memory, measurement, judged, seconds, late, packets)
        self._recover(k)
        self._viewer.show(self._seen(k, wanted))
        if has_measured(self.memory, counts):
            self._measured, self._known = k, self.memory
        return self._lost(k)

    def _lost(self, k: int) -> End | None:
        """Return the end of a run whose measurements have been missing for too long, or None."""
        gap = (k - self._measured) * self._period
        if self._may_miss(gap):
            return None
        last = self._contact.last
        assert last is not None
        silent = last.rate * (now() - self._contact.heard) / SECOND
        before, after = self._known.counts._asdict(), self.memory.counts._asdict()
        causes = [
            f"{after[name] - before[name]} {name.removeprefix('measurements_')}"
            for name in after
            if name.startswith("measurements_") and after[name] > before[name]
        ]
        status = "lost_contact"
        reason = f"no usable measurement for {gap:.3g} s ({', '.join(causes) or 'none came'})"
        if silent >= gap - self._period:
            status, reason = "lost_machine", f"the machine was silent for {silent:.3g} s"
        return End(status, Failure(k * self._period, None, math.nan, reason))

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

    def _send(self, k: int) -> None:
        packet = self.memory.in_flight[-1:]
        first = k
        if self._sends:
            packet, first = self.memory.sent.packets[-1], k - self._design.repeats
        P = round(self._period * SECOND)
        eta = round(self.memory.belief.timeline.eta * SECOND)
        self._sequences[k] = self._contact.send(
            packet,
            sampled=self._began + k * P,
            playout=self._began + first * P + eta,
            begin=self._began,
            flags=self._asked,
        )
        self._sequences.pop(k - 2 * _GONE, None)
        timeline = self._design.law.timeline
        self._check.sent(first + round((eta - timeline.fraction * P) / P), packet)

    def _note_pace(self, k: int) -> None:
        late = (now() - self._due(k)) / SECOND
        self.pace.samples, self.pace.late = self.pace.samples + 1, late
        if not self._recording:
            self.pace.resting.append(late)
        self.pace.missed += late > self._period + self._contact.lateness(self._period)

    # -------------------------------------------------------------- reports

    def _acted(self, message: MachineMessage) -> dict[int, Array]:
        """Torques (6,) that have acted, by the number of the period that they began."""
        if message.acted_from == NEVER:
            return {}
        P = message.period
        fraction = round(self._design.law.timeline.fraction * P)
        newest = round((message.acted_from - message.begin - fraction) / P)
        return {newest - i: torque for i, torque in enumerate(message.acted)}

    def _report(self, k: int) -> Report:
        """What the law is told of its packets and torques at a sample."""
        number = reported(self._design.law.kept)
        packets = [self._sequences.get(k - 1 - i) for i in range(number)]
        arrived = np.array([n is not None and self._contact.has_arrived(n) for n in packets])
        acted = list[Array]()
        for i in range(number):
            torque = self.record.applied.get(k - 1 - i)
            if torque is None:
                break
            acted.append(torque)
        return Report(arrived, np.array(acted).reshape(-1, NUM_TORQUES))

    def _packets(self, k: int, message: MachineMessage | None) -> Array:
        """Counts as of `scenario.signals.PACKETS`; which were late only the machine knows."""
        last = message or self._contact.last
        if last is None or not self._sends:
            return np.full(len(PACKETS), np.nan)
        return np.array([k + 1.0, self._contact.link.lost, math.nan, last.played, last.dry])

    # -------------------------------------------------------------- the way

    def _start(
        self, t: float, measurement: Measurement, message: MachineMessage | None
    ) -> str | None:
        """Lead the plate from where it is, if not at the scenario's start; why not, or None."""
        design, law = self._design, self._design.law
        first = law.sensing.start(measurement) if measurement.complete else None
        if first is None:
            return None  # put there, as it says
        away = np.abs(first.state - design.experiment.start) / np.tile(self._size, 2)
        if away.max() <= AT_START:
            return None
        self.taken_over = True
        acts = np.zeros(NUM_TORQUES)
        if message is not None and len(message.acted):
            acts = message.acted[0]
        queue = np.tile(acts, (len(design.queue), 1))
        self._law = serving(replace(law, silence=0)).law
        self.memory = self._law.initial_memory(queue)
        anew = self._anew(t, first.state, _until_next(law.timeline, queue), None)
        if isinstance(anew, str):
            return f"there is no way from where the plate is: {anew}"
        self._steering = anew
        self._say("the plate is not where the scenario begins: it is led there first")
        return None

    def _recover(self, k: int) -> None:
        """Plan a new way where the prediction is off the old one."""
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
        wanted = self._steering.way.at(t + belief.timeline.eta + self._period)[:NUM_STATE]
        away = np.abs(ahead - wanted) / np.tile(self._size, 2)
        if not away.max() > OFF:  # or NaN
            return
        anew = self._anew(t, belief.state, schedule, belief.parameters)
        if isinstance(anew, str):
            return  # the next sample may see another
        self._steering, self.memory = anew, self.memory.without_error()
        self.recoveries += 1

    def _anew(
        self, t: float, state: Array, schedule: TorqueSchedule, parameters: Array | None
    ) -> Steering | str:
        plant = self._design.law.plant
        dynamics = plant.dynamics if parameters is None else plant.dynamics.assuming(parameters)
        states = np.vstack([state, plant.predict(state, schedule, parameters)])
        if not np.all(np.isfinite(states)):
            return "the plate leaves its workspace before a torque can act"
        for x in states:
            failure = diagnose(plant.mechanism, t, x[POSE])
            if failure is not None:
                return f"{failure.reason} before a torque can act"
        torques = (
            np.vstack([schedule.torques[:1], schedule.torques]) if len(schedule.torques) else None
        )
        if torques is None:
            torques = np.zeros((1, NUM_TORQUES))
        full = np.array(
            [
                np.append(x, dynamics.accelerations(x[POSE], x[RATES], torque))
                for x, torque in zip(states, torques, strict=True)
            ]
        )
        times = t + np.append(0.0, np.cumsum(schedule.durations))
        return self._steering.anew(times, full)

    def _seen(self, k: int, wanted: Array) -> Seen:
        link, memory = self._contact.link, self.memory
        error = memory.belief.state[POSE] - wanted[POSE]
        return Seen(
            time=k * self._period,
            state=np.array(memory.belief.state),
            wanted=wanted,
            torque=self.record.latest,
            error=float(100 * np.mean(np.abs(error) / self._design.experiment.scale)),
            eta=float(memory.belief.delay[0]),
            trip=link.typical,
            spread=link.spread,
            lost=1 - (1 - link.loss_there) * (1 - link.loss_back),
            missed=self.pace.missed,
            safe=self._safe,
            by_hand=self._by_hand,
            limit=self._steering.limit,
        )


def _until_next(timeline: Timeline, flying: Array) -> TorqueSchedule:
    """What acts from now until the next torque does, of torques (n >= L, 6) that are under way."""
    return timeline.until_next(timeline.queue(np.vstack([np.zeros(NUM_TORQUES), flying])))
