"""The machine's end: a simulated one in real time, behind the link of its scenario.

Everything happens at an instant of the machine's clock: datagrams arrive, measurements are taken,
torques change, silence is noticed. `Machine.advance` goes through what is due by now, in this
order, and the plate follows exactly, however late the process gets to it. Nothing waits but in
`select`.
"""

import heapq
import select
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.live.body import Body, body_of
from stewart_drake.live.endpoint import STALL, Address, Endpoint, Offers, Session, now, read_key
from stewart_drake.live.motors import Motors, Plan
from stewart_drake.live.options import MachineOptions, Settings
from stewart_drake.live.protocol import (
    MISSING,
    MOST_SAMPLES,
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
from stewart_drake.loop.peer import FAULTS, Fault, Reason, code_bits, identity_of, in_words
from stewart_drake.loop.preparation import Experiment, prepare
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.link import (
    forward_times,
    return_times,
    sensor_times,
    torque_delays,
)
from stewart_drake.scenario.signals import NUM_LEGS, NUM_TORQUES
from stewart_drake.types import Array

DRAWN: Final = 1 << 17
"""Datagrams each way for which times and losses are drawn; then they begin anew, but for a wire,
which from then on takes what it took last."""
RECENT: Final = 10 * SECOND
"""ns for which a fault that is over counts as what came before the next one."""
LAST_WORDS: Final = 3
"""Datagrams at the end, which say that it is one: some may be lost."""
FURTHEST: Final = 3600 * SECOND
"""ns ahead that a run may begin, or torques be planned."""


class Drawn(NamedTuple):
    """What happens to what is sent, by its number: ns, or None for what is lost."""

    forward: Callable[[int], int | None]
    back: Callable[[int], int | None]
    sensor: Callable[[int], int | None]


def drawn(scenario: Scenario) -> Drawn:
    """As the scenario's simulation has it, sample by sample."""
    every = (forward_times, return_times, sensor_times)
    return Drawn(*(_by_number(times(scenario, DRAWN)) for times in every))


def _by_number(times: Array) -> Callable[[int], int | None]:
    def time(number: int) -> int | None:
        seconds = times[number % len(times)]
        return round(seconds * SECOND) if np.isfinite(seconds) else None

    return time


def check_scenario(scenario: Scenario) -> None:
    """That the protocol can say what the machine does.

    Raises:
        ConfigError: servos, too many samples of encoders.
    """
    if found := differing(scenario, {"actuator.kind": "torque"}):
        raise ConfigError(found.problem("for a machine", ", which is what a controller sends"))
    samples = scenario.sensor.samples
    if samples is not None and samples > MOST_SAMPLES:
        raise ConfigError(
            f"sensor.samples: got {samples}; expected at most {MOST_SAMPLES}, which a datagram "
            "holds"
        )


@contextmanager
def open_machine(
    scenario: Scenario, options: MachineOptions, say: Callable[[str], None] = print
) -> "Iterator[tuple[Machine, Address]]":
    """Yield a machine that listens, and where.

    Raises:
        ConfigError: a scenario that the protocol does not cover, or an address in use.
    """
    check_scenario(scenario)
    experiment = prepare(scenario)
    key = read_key(options.key)
    endpoint = Endpoint(ControllerMessage, options.host, options.port, key)
    try:
        yield Machine(experiment, endpoint, options, say), endpoint.address
    finally:
        endpoint.close()


def motors_of(experiment: Experiment) -> Motors:
    """What the link makes of torques: a buffer behind a network, or the end of a wire."""
    sc, limit = experiment.scenario, experiment.torque_limit
    period = round(sc.controller.period * SECOND)
    if sc.link.kind == "network":
        return Motors(limit, period, sc.link.dry == "hold")
    longer = replace(sc, duration=DRAWN * sc.controller.period)
    delays = torque_delays(longer)
    last = len(delays) - 1
    return Motors(limit, period, delay_of=lambda k: round(delays[min(k, last)] * SECOND))


def reason_of(failure: Failure) -> Reason:
    """Return how a plate left its workspace as a datagram says it."""
    if failure.leg is not None:
        return Reason(Fault.REACH, failure.leg)
    known = (fault for fault, words in FAULTS.items() if words == failure.reason)
    return Reason(next(known, Fault.LEFT))


class Measured:
    """What a sensor has read, as a datagram says it."""

    def __init__(self, scenario: Scenario) -> None:
        self.bits = code_bits(scenario.sensor)
        self._zeros: Array = np.full(NUM_LEGS, np.nan)

    def said(self, values: Array) -> dict[str, Any]:
        """The fields of a `MachineMessage`.

        A code of the simulated encoders is a whole number of quanta from any other, so that the
        first one says where code 0 is.
        """
        if not self.bits:
            return {"state": values}
        quantum = 2 * np.pi / 2**self.bits
        angles = values.reshape(-1, NUM_LEGS)
        for leg in np.flatnonzero(np.isnan(self._zeros)):
            there = angles[np.isfinite(angles[:, leg]), leg]
            if len(there):
                self._zeros[leg] = there[0] - quantum * np.round(there[0] / quantum)
        zeros = np.nan_to_num(self._zeros)
        codes = np.nan_to_num(np.round((angles - zeros) / quantum), nan=MISSING)
        codes = np.clip(codes, MISSING, -MISSING - 1).astype(np.int32)
        return {"codes": codes, "bits": self.bits, "zeros": zeros}


class Machine:
    """A simulated machine and who drives it.

    Args:
        experiment: whose scenario passes `check_scenario`.
        endpoint: where it is heard.
        settings: see `Settings`.
        say: is told in a line what happens.
        clock: ns, monotonic.

    Attributes:
        session: of the controller that drives, or did last.
        begin: ns, when the run began or will begin, or NEVER.
        failure: how the plate left its workspace, or None.
        identity: what a controller must be designed for.
        offers: of sessions.
        reason: why torques do not act any more, and `before`, what preceded it.
        counts: what happened, by name.
        goes_by: what computes the plate, see `live.body.body_of`.
        longest_lag: ns by which something was done late while the plate moved.
    """

    def __init__(
        self,
        experiment: Experiment,
        endpoint: Endpoint,
        settings: Settings | None = None,
        say: Callable[[str], None] = print,
        clock: Callable[[], int] = now,
    ) -> None:
        self._experiment, self._endpoint = experiment, endpoint
        self._settings, self._say, self._clock = settings or Settings(), say, clock
        self._started = clock()
        sc = experiment.scenario
        self.period = round(sc.controller.period * SECOND)
        self.watchdog = round(self._settings.watchdog * SECOND)
        self._drawn, self._measured = drawn(sc), Measured(sc)
        self._make, self.goes_by = body_of(experiment)
        self.session: Session | None = None
        self.identity, self.offers = identity_of(sc), Offers()
        self._told_refusal = 0
        self._due: list[tuple[int, int, int, Callable[[int], None]]] = []
        self._number = self.sample = 0
        self.counts: Counter[str] = Counter()
        self.longest_lag, self._told_until = 0, -1
        self._safe = self._stopped = False
        self._at_rest()
        self._at(0, 1, self._take_sample)

    def _at_rest(self) -> None:
        """The plate at the scenario's start, brakes on."""
        self._body: Body = self._make()
        self._motors: Motors = motors_of(self._experiment)
        self.begin = self._origin = NEVER
        self.failure: Failure | None = None
        self._running = False
        self.reason = self.before = Reason()
        self._preceded = 0

    # -------------------------------------------------------------- time

    def time(self) -> int:
        """ns of the machine's clock."""
        return round((self._clock() - self._started) * self._settings.rate)

    def _at(self, time: int, order: int, do: Callable[[int], None]) -> None:
        self._number += 1
        heapq.heappush(self._due, (time, order, self._number, do))

    def run(self, duration: float = float("inf")) -> None:
        """Go on for so many s of the machine's clock, or until Ctrl-C, which is raised."""
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
        """The safe torque, and a last datagram that says so."""
        time = self.time()
        if self._running and not self._safe:
            self._go_safe(time)
        if self.session is None:
            return
        if self.failure is None:
            self._fail(Reason(Fault.ENDED), time)
        for _ in range(LAST_WORDS):
            self._endpoint.send(self._message(time, time, {}), self.session.address)

    def poll(self, time: int) -> None:
        """Read what has come; it arrives when the link says."""
        for message, address in self._endpoint.receive():
            assert isinstance(message, ControllerMessage)
            number = message.head.sequence
            if self.begin != NEVER and len(message.torques):
                number = max(0, round((message.sampled - self.begin) / self.period))
            under_way = self._drawn.forward(number)
            self.counts["received"] += 1
            if under_way is None:
                self.counts["lost"] += 1
                continue
            self._at(time + under_way, 0, partial(self._arrive, message, address))
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
        if session != self._told_refusal:
            self._told_refusal = session
            self._say(line)

    def advance(self, time: int) -> int:
        """Do all that is due by a time; when there is something next."""
        while True:
            when, do = self._next()
            if when > time:
                return when
            lag = time - when
            if self._running:
                self.longest_lag = max(lag, self.longest_lag)
                if lag > STALL and do != self._silence:
                    self._tell_lag(lag, when)
            do(when)

    def _next(self) -> tuple[int, Callable[[int], None]]:
        when, order, _, do = self._due[0]
        change, silent = self._motors.next_change, self._deadline()
        if self.failure is None and (change, 2) < (when, order):
            when, do = change, self._change
        else:
            do = self._pop
        return (silent, self._silence) if silent < when else (when, do)

    def _pop(self, time: int) -> None:
        heapq.heappop(self._due)[3](time)

    def _tell_lag(self, lag: int, when: int) -> None:
        if when > self._told_until:
            self.counts["stood still"] += 1
            self._precede(Reason(Fault.STOOD, lasted=lag), when)
            self._say(f"{when / SECOND:.3f} s: {self.before}; the plate went on by its buffer")
        self._told_until = when + lag

    # -------------------------------------------------------------- the plate

    def _follow(self, time: int) -> None:
        """Take the plate to a time, under the torque that acts."""
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
        self._say(
            f"{left / SECOND:.3f} s: the plate left its workspace: {why}; stopped, a new session "
            "begins at rest"
        )

    def _fail(self, reason: Reason, time: int) -> None:
        """Note why torques do not act any more."""
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
            self.begin = NEVER
            self._say("nobody was heard when the run should have begun: still parked")
            return
        sc, delay = self._experiment.scenario, self._experiment.scenario.true_delay
        queue = self._experiment.torques_in_flight(delay)
        early = delay.fraction - 1 if delay.fraction > 0 else 0.0
        playout = self.begin + round(early * sc.controller.period * SECOND)
        self._running, self._origin, self._safe = True, time, False
        self._motors.begin(Plan(0, time, 0, playout, queue))
        self.counts["runs"] += 1
        self._say(f"{time / SECOND:.3f} s: the run began")

    def _change(self, time: int) -> None:
        self._follow(time)
        self._motors.change(time)
        if self._safe and self._motors.fed:
            self._precede(self.reason, time)
            self._safe, self.reason = False, Reason()
            self._say(f"{time / SECOND:.3f} s: torques act again")

    def _take_sample(self, time: int) -> None:
        self._follow(time)
        values = self._body.measurement()
        number = 0
        if self._running:
            number = max(0, round((time - self._origin) / self.period))
        waits = self._drawn.sensor(number)
        said = {} if waits is None else self._measured.said(values)
        self._at(time + (waits or 0), 1, lambda t: self._answer(t, time, said, number))
        self._at(time + self.period, 1, self._take_sample)

    # -------------------------------------------------------------- who drives

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
        self._go_safe(time)
        self._fail(Reason(Fault.SILENCE, lasted=self.watchdog), time)
        self._say(
            f"{time / SECOND:.3f} s: {self.reason}: the safe torque ({self._settings.safe}) acts"
        )

    def _go_safe(self, time: int) -> None:
        self._follow(time)
        self._motors.safe(time, self._settings.safe == "hold")
        self._safe = True

    def _refuse(self, refusal: Refusal | None, detail: str = "") -> bool:
        if refusal is not None:
            self._endpoint.refuse(refusal, detail)
        return refusal is not None

    def _arrive(self, message: ControllerMessage, address: Address, time: int) -> None:
        head, driving = message.head, self.session
        if message.identity is not None:
            self._greet(message, address, time)
            return
        if driving is not None and (head.session, head.nonce) == (driving.number, driving.nonce):
            if self._refuse(driving.refusal(head, address, time)):
                return
        elif self._alive(time) or head.nonce != self.offers.nonce(head.session, address):
            self._refuse(Refusal.FOREIGN)
            return
        else:
            self._adopt(Session.confirmed(head, address, time), time)
        if not self._stopped:
            self._obey(message, time)

    def _greet(self, request: ControllerMessage, address: Address, time: int) -> None:
        """Answer a request for a session; nothing is remembered of it."""
        head, nonce = request.head, self.offers.nonce(request.head.session, address)
        assert request.identity is not None
        if self.session is not None and head.session == self.session.number:
            self._refuse(Refusal.LATE)  # it was overtaken, or is replayed
            return
        if head.nonce != nonce and not self.offers.may_answer(self._clock()):
            self._refuse(Refusal.RATE)
            return
        differs = self.identity.differing(request.identity)
        if differs is not None:
            host, port = address
            self._refuse_aloud(
                head.session,
                f"refused a controller at {host}:{port}, which is designed for {differs[1]}; this "
                f"machine has {differs[0]}",
            )
        said = {"identity": self.identity}
        offer = self._message(time, time, said, Session(head.session, address))
        answer = Head(
            *(head.session, 0 if differs else nonce, head.sequence, head.sequence),
            *(time, head.time, 0),
        )
        flags = offer.flags | (MachineFlags.BUSY if self._alive(time) else MachineFlags(0))
        there = np.arange(64) == 0
        self._send(replace(offer, head=answer, flags=flags, arrived=there), address)

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
        self.begin = NEVER
        self._say(
            f"{time / SECOND:.3f} s: session {self.counts['sessions']}, of {host}:{port}, {where}"
        )

    def _obey(self, message: ControllerMessage, time: int) -> None:
        if ControllerFlags.STOP in message.flags:
            self._stopped = True
            if self._running:
                self._go_safe(time)
            if self.failure is None:
                self._fail(Reason(Fault.STOP), time)
            self._say(f"{time / SECOND:.3f} s: {FAULTS[Fault.STOP]}")
            return
        if max(message.begin % NEVER, message.playout) > time + FURTHEST:
            self._refuse(Refusal.MALFORMED)
            return
        if message.begin != NEVER and self.begin == NEVER:
            asked = max(message.begin, time + 1)
            self.begin = -(-asked // self.period) * self.period
            if not self._running:
                self._at(self.begin, 0, self._begin)
        if self.failure is None and self.begin != NEVER and len(message.torques):
            sample = max(0, round((message.sampled - self.begin) / self.period))
            rows = message.torques
            plan = Plan(message.head.sequence, message.sampled, sample, message.playout, rows)
            self._refuse(self._motors.take(plan, time))

    # -------------------------------------------------------------- what is said

    def _answer(self, time: int, sampled: int, said: dict[str, Any], number: int) -> None:
        """To who drives; `number` is that of the sample."""
        if self.session is not None:
            message = self._message(self.time(), sampled, said)
            self._send(message, self.session.address, number)

    def _send(self, message: MachineMessage, to: Address, number: int | None = None) -> None:
        under_way = self._drawn.back(message.head.sequence if number is None else number)
        if under_way is None:
            self.counts["measurements lost"] += 1
        else:
            self.counts["sent"] += 1
            self._at(message.head.time + under_way, 3, lambda _: self._put(message, to))

    def _put(self, message: MachineMessage, address: Address) -> None:
        self._endpoint.send(message, address)

    def _flags(self) -> MachineFlags:
        flags = MachineFlags.SIMULATION
        states = {
            MachineFlags.PARKED: not self._running,
            MachineFlags.RUNNING: self._running,
            MachineFlags.SAFE: self._safe,
            MachineFlags.LEFT: self.failure is not None,
            MachineFlags.HOLDS: self._motors.holds,
            MachineFlags.WIRE: self._motors.is_wire,
            MachineFlags.RESETS: self._settings.restart == "rest",
            MachineFlags.SAFE_HOLDS: self._settings.safe == "hold",
        }
        for flag, there in states.items():
            if there:
                flags |= flag
        return flags

    def _message(
        self,
        time: int,
        sampled: int,
        said: dict[str, Any],
        offered: Session | None = None,
    ) -> MachineMessage:
        to = offered or self.session
        assert to is not None
        told = not offered and self._experiment.scenario.link.acknowledged
        acted = self._motors.acted if told else []
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
            arrived=np.array([bool(seen >> i & 1) for i in range(64)]),
            acted_from=acted[0][0] if acted else NEVER,
            acted=np.array(rows).reshape(-1, NUM_TORQUES),
            played=self._motors.played,
            dry=self._motors.dry,
            refused=sum(self._endpoint.refused.values()),
            reason=self.reason,
            before=self.before,
            **said,
        )

    def summary(self) -> dict[str, Any]:
        """What happened, for the end."""
        counted = ("sessions", "runs", "received", "lost", "sent", "measurements lost", "silences")
        return {
            "machine": self._experiment.truth.name,
            "goes_by": self.goes_by,
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
