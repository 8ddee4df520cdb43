"""The machine's end: a simulated machine in real time, behind the link of its scenario.

All events have a time of the machine's clock: arrivals of datagrams, measurements, changes of the
torque, the watchdog. `Machine.advance` processes those that are due, in order of time, and
integrates the plate exactly up to each. A process that runs late thus simulates the same motion.
The only wait is in `select`.
"""

import heapq
import math
import select
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.endpoint import STALL, Address, Endpoint, Offers, Session, now
from stewart_drake.live.options import Settings
from stewart_drake.live.protocol import (
    NEVER,
    SECOND,
    VERSION,
    ControllerFlags,
    ControllerMessage,
    Head,
    MachineFlags,
    MachineMessage,
    Refusal,
)
from stewart_drake.live.simulated import (
    Body,
    LinkTimes,
    MeasurementFields,
    Motors,
    Plan,
    body_of,
    first_rows,
)
from stewart_drake.loop.peer import Fault, Reason, check_samples, identity_of, in_words
from stewart_drake.loop.preparation import Experiment
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.run_log import RunLog
from stewart_drake.scenario.signals import NUM_TORQUES, POSE, RATES
from stewart_drake.types import Array

RECENT: Final = 10 * SECOND
"""Time for which a past fault counts as preceding the next one, ns."""
LAST_DATAGRAMS: Final = 3
"""Number of datagrams that announce the end."""
FURTHEST: Final = 3600 * SECOND
"""Longest time ahead for a begin or a plan, ns."""
ARRIVES, MEASURES, CHANGES, SENDS, DRIVES = range(5)
"""Order of events at equal instants: datagrams, measurements, torques, what is sent or written, and
a robot's setpoints."""


def check_scenario(scenario: Scenario) -> None:
    """Refuse a scenario that the protocol does not cover."""
    if found := differing(scenario, {"actuator.kind": ("torque", "position_servo")}):
        raise ConfigError(found.problem("for a machine", ", which a controller sends"))
    check_samples(scenario)


def reason_of(failure: Failure) -> Reason:
    """Return the reason in a datagram for a plate that has left its workspace."""
    if failure.leg is not None:
        return Reason(Fault.REACH, failure.leg)
    known = (fault for fault in Fault if fault.text == failure.reason)
    return Reason(next(known, Fault.LEFT))


class Machine:
    """A simulated machine and its session.

    Args:
        experiment: prepared scenario that passes `check_scenario`.
        clock: monotonic clock, ns.
        log: of true state, acting torque and measurement at each sample of a run, at times of the
            machine's clock.
        body: makes plant and sensor, and their name; those of the scenario by default.

    Attributes:
        session: present or last session.
        begin: time at which the run began or will begin, ns, or NEVER.
        failure: how the plate left its workspace, or None.
        reason: why torques do not act, or no fault.
        before: fault that preceded it.
        simulated_by: name of the integrator, see `live.simulated.body_of`.
        longest_lag: longest delay of an event while the plate moved, ns.
    """

    def __init__(
        self,
        experiment: Experiment,
        endpoint: Endpoint[ControllerMessage],
        settings: Settings | None = None,
        say: Callable[[str], None] = print,
        clock: Callable[[], int] = now,
        log: RunLog | None = None,
        body: tuple[Callable[[], Body], str] | None = None,
    ) -> None:
        self._log = log
        self._experiment, self._endpoint = experiment, endpoint
        self._settings, self._say, self._clock = settings or Settings(), say, clock
        self._started = clock()
        sc = experiment.scenario
        self.period = round(sc.controller.period * SECOND)
        self.watchdog = round(self._settings.watchdog * SECOND)
        self._times, self._fields = LinkTimes(sc), MeasurementFields(sc)
        self._make, self.simulated_by = body or body_of(experiment)
        self._queue = first_rows(experiment)
        self.session: Session | None = None
        self.identity, self.offers = identity_of(sc), Offers()
        self._refusal_said, self._key_said = 0, False
        self._due: list[tuple[int, int, int, Callable[[int], object]]] = []
        self._number = self.sample = 0
        self.counts: Counter[str] = Counter()
        self.longest_lag, self._stalled_until = 0, -1
        self._safe = self._stopped = False
        self._at_rest()
        self._at(0, MEASURES, self._take_sample)

    def _at_rest(self) -> None:
        """Reset the plate to the scenario's start, with brakes on."""
        self._body: Body = self._make()
        self._motors: Motors = self._new_motors()
        self.begin = self._origin = NEVER
        self._phase: int | None = None
        self.failure: Failure | None = None
        self._running = self._lag_said = False
        self.reason = self.before = Reason()
        self._preceded = 0

    def _new_motors(self) -> Motors:
        return Motors.of(self._experiment)

    def _report(self, time: int, text: str) -> None:
        self._say(f"{time / SECOND:.3f} s: {text}")

    # -------------------------------------------------------------- time

    def time(self) -> int:
        """Return the machine's clock, ns."""
        return round((self._clock() - self._started) * self._settings.rate)

    def _at(self, time: int, order: int, do: Callable[[int], object]) -> None:
        self._number += 1
        heapq.heappush(self._due, (time, order, self._number, do))

    def run(self, duration: float = float("inf")) -> None:
        """Run for `duration` s of the machine's clock, or until Ctrl-C, which is raised."""
        end = duration * SECOND
        try:
            while (time := self.time()) < end:
                self.poll(time)
                wait = min(self.advance(time), end) - self.time()
                seconds = max(0.0, wait / SECOND / self._settings.rate)
                select.select([self._endpoint], [], [], min(seconds, 1.0))
        finally:
            self.stop()

    def stop(self) -> None:
        """Go to the safe torque, and announce the end."""
        time = self.time()
        if self._running and not self._safe:
            self._go_safe(time)
        if self.session is None:
            return
        if self.failure is None:
            self._fail(Reason(Fault.ENDED), time)
        for _ in range(LAST_DATAGRAMS):
            self._endpoint.send(self._message(time, time, {}), self.session.address)

    def poll(self, time: int) -> None:
        """Read the datagrams that have come; each arrives after its transit time."""
        for message, address in self._endpoint.receive():
            number = message.head.sequence
            if self.begin != NEVER and len(message.torques):
                number = max(0, round((message.sampled - self.begin) / self.period))
            under_way = self._times.of("forward", number)
            self.counts["received"] += 1
            if under_way is None:
                self.counts["lost"] += 1
                continue
            self._at(time + under_way, ARRIVES, partial(self._arrive, message, address))
        if self._endpoint.refused[Refusal.KEY] and not self._key_said:
            self._key_said = True
            self._say(
                "refused a controller with another key or without one; expected the same --key on "
                "both sides, or none"
            )
        for other in self._endpoint.versions:
            if self.offers.may_answer(self._clock()):
                self._endpoint.refuse_version(other)
                host, port = other.address
                self._refuse_aloud(
                    other.session,
                    f"refused a controller at {host}:{port}: it speaks protocol version "
                    f"{other.version}; expected {VERSION}",
                )
        self._endpoint.versions = []

    def _refuse_aloud(self, session: int, line: str) -> None:
        if session != self._refusal_said:
            self._refusal_said = session
            self._say(line)

    def advance(self, time: int) -> int:
        """Process all events due by a time, ns; return the time of the next one."""
        while True:
            when, do = self._next()
            if when > time:
                return when
            lag = time - when
            if self._running and not self._stopped and self.failure is None:
                self.longest_lag = max(lag, self.longest_lag)
                if do != self._silence:
                    self._report_lag(lag, when)
            do(when)

    def _next(self) -> tuple[int, Callable[[int], None]]:
        when, order, _, do = self._due[0]
        change, silent = self._motors.next_change, self._deadline()
        if self.failure is None and (change, CHANGES) < (when, order):
            when, do = change, self._change
        else:
            do = self._pop
        return (silent, self._silence) if silent < when else (when, do)

    def _pop(self, time: int) -> None:
        heapq.heappop(self._due)[3](time)

    def _report_lag(self, lag: int, when: int) -> None:
        if lag > STALL:
            if when > self._stalled_until:
                self.counts["stood still"] += 1
                self._precede(Reason(Fault.STOOD, lasted=lag), when)
                self._report(when, f"{self.before}; the plate went on by its buffer")
            self._stalled_until = when + lag
        elif lag > 2 * self.period and not self._lag_said:
            self._lag_said = True
            behind = f"{1e3 * lag / SECOND:.0f} ms behind real time"
            self._report(when, f"{behind}: measurements are sent late; relieve this computer")

    # -------------------------------------------------------------- the plate

    def _follow(self, time: int) -> None:
        """Advance the plate to a time under the torque that acts."""
        if not self._running or self.failure is not None:
            return
        failure = self._body.advance((time - self._origin) / SECOND, self._motors.torque)
        if failure is not None:
            self._leave(failure)

    def _leave(self, failure: Failure) -> None:
        self.failure = failure
        self.counts["left workspace"] += 1
        left = self._origin + round(failure.time * SECOND)
        self._fail(reason_of(failure), left)
        why = in_words(self.reason, self.before)
        self._report(
            left, f"the plate left its workspace: {why}; stopped, a new session begins at rest"
        )

    def _fail(self, reason: Reason, time: int) -> None:
        if self.reason.fault:
            self._precede(self.reason, time)
        if time - self._preceded > RECENT:
            self.before = Reason()
        self.reason = reason

    def _precede(self, reason: Reason, time: int) -> None:
        self.before, self._preceded = reason, time

    def _begin(self, time: int) -> None:
        if time != self.begin or self._running:
            return
        if not self._alive(time):
            self.begin, self._motors = NEVER, self._new_motors()
            self._say("no controller was heard at the begin of the run: still parked")
            return
        sc, delay = self._experiment.scenario, self._experiment.scenario.true_delay
        early = delay.fraction - 1 if delay.fraction > 0 else 0.0
        playout = self.begin + round(early * sc.controller.period * SECOND)
        self._running, self._origin, self._safe = True, time, False
        self._motors.begin(Plan(0, time, 0, playout, self._queue))
        self.counts["runs"] += 1
        self._report(time, "the run began")

    def _change(self, time: int) -> None:
        self._follow(time)
        self._motors.change(time)
        if not self._motors.is_wire and self._motors.dry_for(time) >= self.watchdog:
            self._starve(Fault.DRY, time)
        if self._safe and self._motors.fed:
            self._precede(self.reason, time)
            self._safe, self.reason = False, Reason()
            self._report(time, f"{'setpoints' if self._motors.cranks else 'torques'} act again")

    def _take_sample(self, time: int) -> None:
        self._follow(time)
        values = self._body.measurement()
        number = 0
        if self._running and self._log is not None:
            state = np.array(self._body.state)
            row = {"pose": state[POSE], "rates": state[RATES], "measurement": np.array(values)}
            self._at(time, SENDS, lambda _: self._write_row(time, row))
        if self._running:
            number = max(0, round((time - self._origin) / self.period))
        waits = self._times.of("sensor", number)
        fields = {} if waits is None else self._fields.of(values)
        self._at(time + (waits or 0), MEASURES, lambda _: self._answer(time, fields, number))
        self._at(time + self.period, MEASURES, self._take_sample)

    def _write_row(self, time: int, row: dict[str, Array]) -> None:
        assert self._log is not None
        torque = self._motors.torque
        torque = torque * math.nan if self._motors.cranks else torque  # servos know theirs
        self._log.write(time / SECOND, row | {"torque_applied": torque})

    # -------------------------------------------------------------- session

    def _alive(self, time: int) -> bool:
        return (
            self.session is not None
            and not self._stopped
            and time - self.session.heard <= self.watchdog
        )

    def _deadline(self) -> int:
        idle = self._stopped or self._safe or not self._running or self.failure is not None
        if self.session is None or idle:
            return NEVER
        return self.session.heard + self.watchdog + 1

    def _silence(self, time: int) -> None:
        self.counts["silences"] += 1
        self._starve(Fault.SILENCE, time)

    def _starve(self, fault: Fault, time: int) -> None:
        """Go to the safe torque because nothing usable came for the time of the watchdog."""
        self._go_safe(time, keeps=fault == Fault.DRY)
        self._fail(Reason(fault, lasted=self.watchdog), time)
        self._report_safe(time, str(self.reason))

    def _report_safe(self, time: int, why: str) -> None:
        safe = f"the safe torque ({self._settings.safe}) acts"
        self._report(time, f"{why}: {'the cranks are held' if self._motors.cranks else safe}")

    def _go_safe(self, time: int, keeps: bool = False) -> None:
        self._follow(time)
        self._motors.safe(time, self._settings.safe == "hold", keeps)
        self._safe = True

    def _arrive(self, message: ControllerMessage, address: Address, time: int) -> None:
        head, driving = message.head, self.session
        if message.identity is not None:
            self._greet(message, address, time)
            return
        if driving is not None and (head.session, head.nonce) == (driving.number, driving.nonce):
            if refusal := driving.refusal(head, address, time):
                self._endpoint.refuse(refusal)
                return
        elif self._alive(time) or head.nonce != self.offers.nonce(head.session, address):
            self._endpoint.refuse(Refusal.FOREIGN)
            return
        else:
            self._adopt(Session.confirmed(head, address, time), time)
        if not self._stopped:
            self._obey(message, time)

    def _greet(self, request: ControllerMessage, address: Address, time: int) -> None:
        """Answer a request for a session, without keeping state of it."""
        head, nonce = request.head, self.offers.nonce(request.head.session, address)
        assert request.identity is not None
        if self.session is not None and head.session == self.session.number:
            self._endpoint.refuse(Refusal.LATE)  # overtaken or replayed
            return
        if head.nonce != nonce and not self.offers.may_answer(self._clock()):
            self._endpoint.refuse(Refusal.RATE)
            return
        differs = self.identity.differing(request.identity)
        if differs is not None:
            host, port = address
            self._refuse_aloud(
                head.session,
                f"refused a controller at {host}:{port}, which is designed for {differs[1]}; this "
                f"machine has {differs[0]}",
            )
        fields = {"identity": self.identity}
        offer = self._message(time, time, fields, Session(head.session, address))
        answer = Head(
            *(head.session, 0 if differs else nonce, head.sequence, head.sequence),
            *(time, head.time, 0),
        )
        flags = offer.flags | (MachineFlags.BUSY if self._alive(time) else MachineFlags(0))
        self._send(replace(offer, head=answer, flags=flags, arrived=1), address)

    def _adopt(self, session: Session, time: int) -> None:
        self.session, self._stopped = session, False
        self.offers.taken()
        self.counts["sessions"] += 1
        host, port = session.address
        where = "in motion"
        if self._settings.restart == "rest" or self.failure is not None or not self._running:
            self.counts.update(played=self._motors.played, dry=self._motors.dry)
            self._at_rest()
            where = "at rest"
        else:
            self._go_safe(time)
            self.reason = self.before = Reason()
        self.begin, self._phase = NEVER, None
        self._report(time, f"session {self.counts['sessions']}, of {host}:{port}, {where}")

    def _obey(self, message: ControllerMessage, time: int) -> None:
        if ControllerFlags.STOP in message.flags:
            self._stopped = True
            if self._running:
                self._go_safe(time)
            if self.failure is None:
                self._fail(Reason(Fault.STOP), time)
            self._report_safe(time, Fault.STOP.text)
            return
        if max(message.begin % NEVER, message.playout) > time + FURTHEST:
            self._endpoint.refuse(Refusal.MALFORMED)
            return
        if message.begin != NEVER and self.begin == NEVER:
            real = MachineFlags.SIMULATION not in self._flags()
            if real and ControllerFlags.ARMED not in message.flags:
                why = "refused a controller that is not armed: this machine is real"
                self._refuse_aloud(message.head.session, why)
                return
            asked = max(message.begin, time + 1)
            self.begin = -(-asked // self.period) * self.period
            if not self._running:
                self._at(self.begin, ARRIVES, self._begin)
        if len(message.torques) and message.cranks != self._motors.cranks:
            self._endpoint.refuse(
                Refusal.MALFORMED, "torques for servos, or crank angles for motors"
            )
        elif self.failure is None and self.begin != NEVER and len(message.torques):
            self._take(message, time)

    def _take(self, message: ControllerMessage, time: int) -> None:
        """Take the rows of a message, or refuse them.

        The first rows of a session that are taken set the phase of the changes of the torque.
        """
        phase = message.playout % self.period
        if not self._motors.is_wire and self._phase not in (None, phase):
            self._endpoint.refuse(Refusal.MALFORMED, "a playout off the grid of the rows before it")
            return
        sample = max(0, round((message.sampled - self.begin) / self.period))
        numbers = message.sampled, sample, message.playout, message.torques
        if refusal := self._motors.take(Plan(message.head.sequence, *numbers), time, self.begin):
            self._endpoint.refuse(refusal)
        else:
            self._phase = phase

    # -------------------------------------------------------------- messages

    def _answer(self, sampled: int, fields: dict[str, Any], number: int) -> None:
        """Send the measurement of sample `number` to the controller."""
        if self.session is not None:
            message = self._message(self.time(), sampled, fields)
            self._send(message, self.session.address, number)

    def _send(self, message: MachineMessage, to: Address, number: int | None = None) -> None:
        under_way = self._times.of("back", message.head.sequence if number is None else number)
        if under_way is None:
            self.counts["measurements lost"] += 1
        else:
            self.counts["sent"] += 1
            due = message.head.time + under_way
            self._at(due, SENDS, lambda _: self._endpoint.send(message, to))

    def _flags(self) -> MachineFlags:
        states = {
            MachineFlags.SIMULATION: True,
            MachineFlags.PARKED: not self._running,
            MachineFlags.RUNNING: self._running,
            MachineFlags.SAFE: self._safe,
            MachineFlags.LEFT: self.failure is not None,
            MachineFlags.HOLDS: self._motors.holds,
            MachineFlags.WIRE: self._motors.is_wire,
            MachineFlags.RESETS: self._settings.restart == "rest",
            MachineFlags.SAFE_HOLDS: self._settings.safe == "hold" or self._motors.cranks,
        }
        return MachineFlags(sum(flag for flag, there in states.items() if there))

    def _message(
        self,
        time: int,
        sampled: int,
        fields: dict[str, Any],
        offered: Session | None = None,
    ) -> MachineMessage:
        to = offered or self.session
        assert to is not None
        acknowledged = not offered and self._experiment.scenario.link.acknowledged
        acted = self._motors.acted if acknowledged else []
        rows = [torque for _, torque in acted]
        seen = to.window.seen if to.window.newest else 0
        return MachineMessage(
            head=to.head(time),
            flags=self._flags(),
            sampled=sampled,
            begin=NEVER if offered else self.begin,
            period=self.period,
            watchdog=self.watchdog,
            rate=self._settings.rate,
            torque_limit=self._experiment.torque_limit,
            arrived=seen,
            acted_from=acted[0][0] if acted else NEVER,
            acted=np.array(rows).reshape(-1, NUM_TORQUES),
            played=self._motors.played,
            dry=self._motors.dry,
            refused=sum(self._endpoint.refused.values()),
            reason=self.reason,
            before=self.before,
            cranks=self._motors.cranks,
            **fields,
        )

    def summary(self) -> dict[str, Any]:
        counted = ("sessions", "runs", "received", "lost", "sent", "measurements lost", "silences")
        return {
            "machine": self._experiment.truth.name,
            "goes_by": self.simulated_by,
            "time_s": self.time() / SECOND,
            **{name.replace(" ", "_"): self.counts[name] for name in counted},
            "unsent": self._endpoint.unsent,
            "refused": {cause.value: self._endpoint.refused[cause] for cause in Refusal},
            "played": self.counts["played"] + self._motors.played,
            "dry": self.counts["dry"] + self._motors.dry,
            "stood_still": self.counts["stood still"],
            "longest_lag_s": self.longest_lag / SECOND,
            "left_workspace": None if self.failure is None else str(self.failure),
        }
