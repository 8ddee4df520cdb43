"""analysis/own_machine.py: a machine end in plain Python, driven by `live` over loopback."""

import socket
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.live.protocol import (
    NEVER,
    ControllerFlags,
    ControllerMessage,
    Head,
    MachineFlags,
    decode,
    encode,
)
from stewart_drake.loop.peer import identity_of

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
own_machine = __import__("own_machine")


@pytest.fixture
def machine():
    """Return a machine that runs, and its port."""
    made = own_machine.Machine(sd.load_scenario("paper"), 0)
    running = threading.Thread(target=made.run, args=(20.0,), daemon=True)
    running.start()
    yield made, made.socket.getsockname()[1]
    made.started -= 10**12  # its clock is over
    running.join(5)
    made.socket.close()


@pytest.mark.slow
def test_live_drives_it_along_the_motion(machine):
    made, port = machine
    scenario = sd.load_scenario("paper", None, ("plant.kind=exact",))
    run = sd.run_live(scenario, f"127.0.0.1:{port}", duration=5.0, accept_jitter=True)
    assert run.status == "completed" and made.refused == 0
    assert run.summary["live"]["periods_played"] >= 40
    error = np.abs(run.signals.error.values) / np.array(scenario.reference.amplitude)
    assert np.isfinite(error).any() and np.nanmax(error[-15:]) < 0.02
    expected = sd.simulate(scenario, judge_stability=False).signals.torque_commanded
    sent = run.signals.torque_commanded.sel(time=slice(2.0, 4.0))
    same = expected.sel(time=sent.time, method="nearest")
    assert np.abs(sent.values - same.values).max() < 0.05 * np.abs(same).max()


def test_periods_are_dry_from_the_first_torque_on():
    made = own_machine.Machine(sd.load_scenario("paper"), 0)
    made.begin = made.heard = 0
    for k in range(6):
        made.plans = {1: (3 * made.period, np.full((1, 6), 0.1))} if k == 3 else {}
        made.step(k * made.period)
        assert (made.played, made.dry) == (k >= 3, max(0, k - 3))
    made.socket.close()


class Controller:
    """A controller of single datagrams."""

    def __init__(self, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(5.0)
        self.number = 0

    def send(self, session=77, nonce=0, flags=0, number=None, **fields):
        self.number += 1
        head = Head(session, nonce, self.number if number is None else number, 0, 1, 0, 0)
        message = {"sampled": 0, "playout": 0, "begin": NEVER, "torques": np.empty((0, 6))}
        message |= fields
        data = encode(ControllerMessage(head=head, flags=ControllerFlags(flags), **message))
        self.socket.send(data)
        return data

    def answer(self):
        return decode(self.socket.recv(2048))


def greeted(port):
    one = Controller(port)
    scenario = sd.load_scenario("paper")
    one.send(identity=identity_of(scenario))
    offer = one.answer()
    assert offer.identity.packed == sd.machine_identity(scenario)
    return one, offer


def test_its_bytes_are_those_of_the_protocol(machine):
    made, port = machine
    one, offer = greeted(port)
    assert offer.identity == identity_of(sd.load_scenario("paper")) and offer.head.nonce
    assert offer.begin == NEVER and offer.period == 10**8
    one.send(nonce=offer.head.nonce)
    first = one.answer()
    assert first.head.sequence == 2 and MachineFlags.PARKED in first.flags
    assert np.array_equal(first.state, made.plate.state)
    later = one.answer()
    assert (later.head.sequence, later.sampled - first.sampled) == (3, 10**8)
    assert later.arrived & 1


def test_a_plan_acts_period_by_period_and_then_the_buffer_is_dry(machine):
    _, port = machine
    one, offer = greeted(port)
    one.send(nonce=offer.head.nonce)
    begin = one.answer().sampled + 3 * 10**8
    rows = np.arange(12.0).reshape(2, 6) / 100
    one.send(nonce=offer.head.nonce, begin=begin, playout=begin + 10**8, torques=rows)
    seen = {}
    while max(seen, default=0) < begin + 4 * 10**8:
        message = one.answer()
        if len(message.acted):
            seen[message.acted_from] = message.acted[0]
    for period, torque in enumerate([np.zeros(6), *rows, np.zeros(6)]):
        assert np.array_equal(seen[begin + period * 10**8], torque)
    assert message.begin == begin and message.played == 2


def test_silence_and_stop_are_safe_and_strangers_are_refused(machine):
    made, port = machine
    one, offer = greeted(port)
    data = one.send(nonce=offer.head.nonce)
    assert MachineFlags.SAFE not in one.answer().flags
    for wrong in (data, data[:50], b"", b"STWC" + bytes(84), data[:-1]):
        one.socket.send(wrong)
    other = Controller(port)
    other.send(session=5, nonce=offer.head.nonce)
    time.sleep(0.3)
    assert made.refused == 6 and made.session == 77
    busy = Controller(port)
    busy.send(session=6, identity=identity_of(sd.load_scenario("paper")))
    assert MachineFlags.BUSY in busy.answer().flags
    one.send(nonce=offer.head.nonce, flags=ControllerFlags.STOP)
    end = time.monotonic() + 5
    while MachineFlags.SAFE not in one.answer().flags:
        assert time.monotonic() < end


def test_a_controller_of_another_machine_gets_no_session(machine):
    _, port = machine
    one = Controller(port)
    one.send(identity=identity_of(sd.load_scenario("desktop")))
    assert one.answer().head.nonce == 0
