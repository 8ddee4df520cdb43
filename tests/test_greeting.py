"""Requests, offers, identities and faults, as both sides say them."""

import re
import socket
import threading
import time
import urllib.request
from contextlib import closing, contextmanager
from dataclasses import replace
from itertools import count, repeat
from pathlib import Path

import numpy as np
import pytest

from stewart_drake.core.library import core
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.live import contact as contacts
from stewart_drake.live import session as sessions
from stewart_drake.live.checks import DelayCheck
from stewart_drake.live.contact import Contact, await_free, call, open_endpoint
from stewart_drake.live.machine import Machine
from stewart_drake.live.page import PageViewer
from stewart_drake.live.protocol import (
    NEVER,
    SECOND,
    ControllerFlags,
    ControllerMessage,
    MachineFlags,
    MachineMessage,
    Refusal,
    encode,
)
from stewart_drake.live.session import drive, prepare_session
from stewart_drake.loop.peer import Fault, Part, Reason, identity_of, in_words
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.loading import load_scenario
from tests.live_driver import Driver
from tests.test_live import FROM_REST, OVER_A_NETWORK, driven, paper_machine, scenario_of
from tests.test_machine import begun, messages, together
from tests.test_protocol import HEAD, IDENTITY, KEY, OFFER, PLAN, changed

ROOT = Path(__file__).resolve().parents[1]
EXACT = "plant.kind=exact"
SAMPLED = "sensor={kind: encoders, samples: 16, bits: 30}"


# ---------------------------------------------------------------- requests


def request_of(driver, sequence=1):
    """Return a request for a session, as somebody may record it."""
    driver.session._c.sent = sequence - 1
    return encode(ControllerMessage(driver.session.head(0), identity=driver.identity), KEY)


def test_replayed_requests_do_not_keep_a_controller_out():
    """Twenty a second, from another address and without the key: 10 of 10 runs connect."""
    run = together(EXACT, key=KEY)
    period, connected = run.driver.period, 0
    attacker = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    recorded = request_of(Driver(run.scenario, run.ear.address, KEY))
    for _ in range(10):
        run.driver = driver = Driver(run.scenario, run.ear.address, KEY)
        start = -(-run.machine.time() // period) * period
        for k in range(20):
            for half in range(2):
                run.at(start + k * period + half * period // 2)
                attacker.sendto(recorded, run.ear.address)
            now = run.machine.time()
            driver.receive(now)
            driver.begin = start + 30 * period if driver.session.nonce else NEVER
            driver.say(now)
        session = run.machine.session
        connected += session is not None and session.number == driver.session.number
        driver.say(run.machine.time(), ControllerFlags.STOP)
        run.at(run.machine.time() + 1)
    attacker.close()
    assert connected == run.machine.counts["sessions"] == 10


def ask(run, time, number=1):
    """Return the answers to `number` requests at a time of the machine's clock."""
    endpoint, said = run.driver.endpoint, []
    run.at(time)
    for _ in range(number):
        run.driver.say(time)
        run.machine.poll(time)
    run.at(time)
    for message, _ in endpoint.receive():
        assert isinstance(message, MachineMessage)
        said.append(message)
    return said


def test_answers_to_unknown_addresses_have_a_rate_and_are_no_longer_than_requests():
    run = together(EXACT)
    asked, offers = 0, list[MachineMessage]()
    for k in range(100):
        offers += ask(run, k * SECOND // 50, number=10)
        asked += 10
    most, at_once = core().lib.STEWART_ANSWERS, core().lib.STEWART_AT_ONCE
    assert 2 * most <= len(offers) <= 2 * most + at_once
    assert run.ear.refused == {Refusal.RATE: asked - len(offers)}
    assert run.machine.session is None
    request = ControllerMessage(HEAD, identity=IDENTITY)
    assert all(len(encode(m)) <= len(encode(request)) for m in offers)
    # Who was answered may ask on.
    known = offers[-1].head.nonce
    driver, time = run.driver, run.machine.time()
    for _ in range(100):
        head = replace(driver.session.head(time), nonce=known)
        driver.endpoint.send(ControllerMessage(head, identity=driver.identity), run.ear.address)
    run.at(time + 1)
    assert len(list(driver.endpoint.receive())) == 100


# ---------------------------------------------------------------- another version


def test_a_controller_of_version_1_is_refused_in_one_line():
    run = together(EXACT)
    old = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    old.settimeout(5)
    run.at(0)
    for _ in range(3):
        old.sendto(changed(encode(PLAN), 4, b"\1"), run.ear.address)
    run.at(1)
    answer = old.recv(2000)
    assert len(answer) == 60 and answer[:5] == b"STWM\3"
    _, port = old.getsockname()
    assert run.said == [
        f"refused a controller at 127.0.0.1:{port}: it speaks protocol version 1; expected 3"
    ]
    old.close()


@contextmanager
def contact_with(replies):
    """Yield a contact with a machine that answers with these bytes in turn."""
    ends = threading.Event()

    def answer():
        while not ends.is_set():
            try:
                data, address = ear.recvfrom(2000)
            except TimeoutError:
                continue
            ear.sendto(changed(next(replies), 8, data[8:16]), address)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ear:
        ear.bind(("127.0.0.1", 0))
        ear.settimeout(0.05)
        thread = threading.Thread(target=answer)
        thread.start()
        with closing(open_endpoint(ear.getsockname(), None)) as endpoint:
            yield Contact(endpoint, ear.getsockname(), IDENTITY)
        ends.set()
        thread.join()


def test_a_machine_of_version_1_is_refused_in_one_line():
    reply = changed(encode(OFFER), 4, b"\1")
    with contact_with(repeat(reply)) as contact, pytest.raises(ConfigError) as refused:
        call(contact)
    assert re.fullmatch(
        r"--machine: machine at 127.0.0.1:\d+ speaks protocol version 1; expected 3, of the same "
        "release on both sides",
        str(refused.value),
    )


# ---------------------------------------------------------------- a machine that is not free


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr(contacts, "_PATIENCE", 0.3)


def not_free(replies):
    """Return what is said of a machine that does not become free."""
    with contact_with(replies) as contact:
        while not contact.ask():
            pass
        with pytest.raises(ConfigError) as refused:
            await_free(contact)
    return str(refused.value)


def test_a_machine_in_use_is_named(impatient):
    head, busy = OFFER.head, OFFER.flags | MachineFlags.BUSY
    used = replace(OFFER, flags=busy, watchdog=SECOND // 2)
    said = not_free(encode(replace(used, head=replace(head, sequence=k))) for k in count(1))
    words = "is in use by another controller (retry 0.5 s after it stops)"
    assert re.fullmatch(rf"machine at 127\.0\.0\.1:\d+ {re.escape(words)}", said), said


def test_a_machine_in_use_is_refused_before_the_design(impatient, monkeypatch):
    """The design takes seconds, and another controller may keep the machine for hours."""
    monkeypatch.setattr(sessions, "design", lambda *given: pytest.fail("designed"))
    head, identity = OFFER.head, identity_of(scenario_of(*FROM_REST))
    busy = replace(OFFER, flags=OFFER.flags | MachineFlags.BUSY, identity=identity)
    replies = (encode(replace(busy, head=replace(head, sequence=k))) for k in count(1))
    with contact_with(replies) as contact, pytest.raises(ConfigError, match="is in use by another"):
        prepare_session(scenario_of(*FROM_REST), contact.session.address)


def test_a_sequence_that_restarts_is_named(impatient):
    """Every answer has sequence 7: only the first is taken."""
    said = not_free(repeat(encode(replace(OFFER, watchdog=SECOND // 10))))
    assert re.fullmatch(
        r"machine at 127.0.0.1:\d+ sent nothing for 0.\d s that could be taken "
        r"\(\d+ of cause replayed refused\); the last was replayed: sequence 7 after 7",
        said,
    ), said


@pytest.mark.parametrize(
    ("sends", "off", "words"),
    [
        (
            True,
            -1,
            "is one period early: its last 8 rows of torques were sent for the period after",
        ),
        (True, 1, "is one period late: its last 8 rows of torques were sent for the period before"),
        (False, -11, "commands act 0.04 s after their measurement, and this end expects 0.26 s"),
        (False, 9, "commands act 0.44 s after their measurement, and this end expects 0.26 s"),
    ],
)
def test_commands_that_act_in_other_periods_are_named(sends, off, words):
    check, right = (DelayCheck(1.0, 0.26, 0.02, sends) for _ in range(2))
    torques = np.random.default_rng(3).uniform(-2, 2, (60, 6))
    rows, found = 3 if sends else 1, []
    for number in range(50):
        for each in (check, right):
            each.sent(number + 13, torques[number : number + rows])
        acted = {n + 13: np.clip(torques[n], -1, 1) for n in range(max(0, number - 2), number + 1)}
        assert right.problem(acted) is None
        found.append(check.problem({n + off: torque for n, torque in acted.items()}))
    assert found[:7] == [None] * 7 and words in found[12]
    at_rest = DelayCheck(1.0, 0.26, 0.02, sends)
    for number in range(50):
        at_rest.sent(number + 13, np.zeros((rows, 6)))
        assert at_rest.problem({number + off: np.zeros(6)}) is None


@pytest.mark.slow
def test_a_machine_that_reports_a_period_too_late_is_refused(monkeypatch):
    message = Machine._message

    def off(self, *given):
        made = message(self, *given)
        shift = 0 if made.acted_from == NEVER else self.period
        return replace(made, acted_from=made.acted_from + shift)

    monkeypatch.setattr(Machine, "_message", off)
    with paper_machine(OVER_A_NETWORK, *FROM_REST) as running:
        result = driven(running, 6.0, *FROM_REST)
    assert result.status == "refused" and result.stopped is not None
    assert "acted_from in the machine's datagrams is one period late" in result.stopped.reason


# ---------------------------------------------------------------- identity


def test_parts_of_one_name_are_distinguished_by_their_numbers():
    other = IDENTITY._replace(mechanism=Part(bytes(8), "paper"))
    assert IDENTITY.differing(IDENTITY) is None
    assert IDENTITY.differing(other) == (
        f"mechanism paper ({IDENTITY.mechanism.digest.hex()})",
        "mechanism paper (0000000000000000)",
    )


def test_long_names_are_cut_to_what_a_datagram_holds(tmp_path):
    scenario = load_scenario("paper", settings=(EXACT, SAMPLED))
    assert identity_of(scenario).sensor.name == "encoders, 16 samples, 30 bits"
    assert all(len(part.name) <= 32 for part in identity_of(scenario))


# ---------------------------------------------------------------- faults


def test_every_way_to_leave_the_workspace_has_its_fault():
    from stewart_drake.live.machine import reason_of

    mechanism = load_mechanism("paper")
    home = mechanism.home
    for change, fault in (
        ([0, 0, 0, 0, 0, 9.0], Fault.REACH),
        ([0, np.nan, 0, 0, 0, 0], Fault.NOT_FINITE),
    ):
        failure = diagnose(mechanism, 1.0, home + change)
        assert failure is not None
        reason = reason_of(failure)
        assert reason.fault == fault and str(reason) == failure.reason
    for fault in (Fault.PITCH, Fault.SINGULAR):
        failure = failure._replace(leg=None, reason=fault.text)
        assert reason_of(failure).fault == fault
    assert reason_of(failure._replace(reason="something else")).fault == Fault.LEFT


def test_the_documented_faults_are_those_of_the_table():
    text = (ROOT / "docs" / "protocol.md").read_text("utf-8").split("## Faults")[1]
    rows = dict(re.findall(r"^- (\d+): (.*)$", text.split("\n## ")[0], re.MULTILINE))
    words = {f: re.sub("{.*?}", "N", f.text) for f in Fault} | {Fault.NONE: "none"}
    assert rows == {str(int(fault)): text for fault, text in words.items()}


def test_a_loss_is_said_with_what_came_before_it():
    """A suspended machine reports the same words in its terminal and its last datagrams."""
    run = begun("queue=equilibrium", "plant.gravity=true", samples=1, watchdog=20)
    machine = run.machine
    run.clock.time += round(0.33 * SECOND)
    machine.advance(machine.time())
    run.at(machine.time() + 9 * SECOND)
    assert machine.failure is not None
    last = messages(run)[-1]
    assert MachineFlags.LEFT in last.flags
    assert last.reason == Reason(Fault.REACH, machine.failure.leg or 0)
    assert last.before.fault == Fault.STOOD
    assert re.fullmatch(
        r"leg \d reached the end of its reach \(before that, the machine stood still for "
        r"0\.\d\d s\)",
        last.why,
    )
    assert sum(last.why in line for line in run.said) == 1


def test_silence_stop_and_end_are_said():
    run = begun(samples=5, watchdog=0.35)
    run.at(run.machine.time() + round(0.6 * SECOND))
    assert messages(run)[-1].why == "nothing was heard from the controller for 0.35 s"
    run.driver.say(run.machine.time(), ControllerFlags.STOP)
    run.at(run.machine.time() + SECOND // 5)
    last = messages(run)[-1]
    assert last.reason.fault == Fault.STOP and last.before.fault == Fault.SILENCE
    run.machine.stop()
    ends = [m.reason.fault for m in run.driver.receive(run.machine.time())]
    assert ends[-3:] == [Fault.ENDED] * 3
    # A new session begins without a fault.
    run.driver = Driver(run.scenario, run.ear.address)
    now = -(-run.machine.time() // run.driver.period) * run.driver.period
    run.greet(now + run.driver.period, now + 9 * run.driver.period)
    run.at(run.machine.time() + SECOND // 5)
    assert messages(run)[-1].why == Fault.NONE.text


@pytest.mark.slow
def test_live_its_page_and_the_machine_say_a_loss_in_the_same_words():
    """A machine falls under gravity that is unknown to the controller."""
    viewer = PageViewer(load_mechanism("paper"), "live: a test")
    events = urllib.request.urlopen(viewer.opened().replace("/?", "/events?"))
    with paper_machine("plant.gravity=true", rate=2.0) as running:
        # Outliers alone would end the run before the plate has fallen.
        result = driven(running, 6.0, viewer=viewer, max_missing=5.0)
        machine = running.machine
    viewer.close()
    first, said = events.readline(), events.read().decode()
    assert result.status == "left_workspace" and result.stopped is not None
    why = in_words(machine.reason, machine.before)
    assert result.stopped.reason == why and machine.failure is not None
    assert result.stopped.leg == machine.failure.leg
    assert any(f"left its workspace: {why}" in line for line in running.lines)
    assert b"ended" not in first and f'"ended": "left workspace: {why} at t = ' in said


@pytest.mark.slow
def test_a_machine_that_is_ended_ends_the_run_with_its_words():
    """At once, and not after ten seconds of silence."""
    said = list[str]()
    with paper_machine() as running:
        machine = running.machine
        ready = prepare_session(scenario_of(), running.address)
        machine._at(machine.time() + SECOND, 4, lambda _: Machine.stop(machine))  # in its thread
        began = time.monotonic()
        result = drive(ready, 8.0, accept_jitter=True, say=said.append)
        took = time.monotonic() - began
    assert result.status == "lost_machine" and result.stopped is not None
    assert result.stopped.reason == Fault.ENDED.text and took < 8
