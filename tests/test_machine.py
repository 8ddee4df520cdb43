"""The simulated machine behind its socket, on a clock that the tests turn."""

import random
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from stewart_drake.files.errors import ConfigError
from stewart_drake.live.endpoint import Endpoint
from stewart_drake.live.machine import Machine, Settings, check_scenario
from stewart_drake.live.protocol import (
    MISSING,
    NEVER,
    NOTHING,
    SECOND,
    VERSION,
    ControllerFlags,
    ControllerMessage,
    MachineFlags,
    MachineMessage,
    Refusal,
    encode,
)
from stewart_drake.live.simulated import Motors, Plan
from stewart_drake.loop.peer import Fault
from stewart_drake.loop.simulation import simulate
from stewart_drake.scenario.loading import load_scenario
from tests.live_driver import Driver, Together
from tests.test_protocol import KEY, damaged

EXACT = "plant.kind=exact"
NETWORK = (
    "link={kind: network, low: 0.3, high: 0.32, loss: 0.02, "
    "return: {low: 0.3, high: 0.32, loss: 0.02}}"
)
BURSTS = "link={kind: network, loss: 0.4, burst: 4}"
NOISE = "sensor.noise_std=[1e-5,1e-5,1e-5,1e-6,1e-6,1e-6,1e-4,1e-4,1e-4,1e-5,1e-5,1e-5]"
BIAS = "plant.torque_bias=[1e-3,-1e-3,2e-3,0,0,0]"


def together(*settings, name="paper", key=None, **own):
    scenario = load_scenario(name, settings=settings)
    return Together(scenario, Settings(**own), key)


def begun(*settings, samples=0, **own):
    """Return a machine whose run began at 2 s, on the exact plant."""
    found = together(EXACT, *settings, **own)
    period = found.driver.period
    found.greet(3 * period, -(-2 * SECOND // period) * period)
    found.drive(samples)
    return found


# ---------------------------------------------------------------- the same as the simulation


@pytest.mark.parametrize(
    ("name", "settings", "samples"),
    [
        ("paper", (EXACT,), 60),
        ("paper", (EXACT, NOISE, BIAS, "start=on_reference", "queue=reference"), 40),
        ("paper", (EXACT, NETWORK, NOISE), 60),
        ("paper", (EXACT, "link={kind: network, dry: zero, loss: 0.2}"), 60),
        ("paper", (EXACT, "delay.fraction=0.37", "sensor={kind: encoders, samples: 4}"), 40),
        ("paper", ("plant.kind=multibody",), 40),
        ("motion_base", (EXACT, "sensor.delay=0.06", "sensor.loss=0.1"), 60),
        ("paper", (EXACT, "delay.drift=0.002", "delay.jitter_std=0.0005"), 25),
        ("gravity", (EXACT, "sensor.faults=[{kind: missing, from: 0.1, to: 0.14}]"), 50),
        ("paper", (EXACT, BURSTS, "controller.packet_torques=2"), 31),
    ],
)
def test_a_run_over_the_socket_is_the_simulated_one(name, settings, samples):
    """The same seeds, delays, losses: states of Drake's loop at every sample, counts of packets."""
    scenario = load_scenario(name, settings=settings)
    scenario = replace(scenario, duration=samples * scenario.controller.period)
    run = Together(scenario, Settings(watchdog=5))
    period = run.driver.period
    run.greet(3 * period, 60 * period)
    states = np.array(run.drive(samples))
    result = simulate(scenario, judge_stability=False)
    assert result.status == "completed"
    at = scenario.controller.period * np.arange(samples)
    kept = result.signals.sel(time=at, method="nearest")
    expected = np.hstack([kept.pose.values, kept.rates.values])
    scale = np.abs(expected).max(axis=0) + 1e-9
    moved = np.abs(expected - expected[0]).max(axis=0) / scale
    assert moved.max() > 0.5
    np.testing.assert_allclose(states / scale, expected / scale, atol=2e-5)
    said = kept.torque_commanded.values
    np.testing.assert_allclose(run.driver.torques, said, atol=1e-4 * np.abs(said).max())
    if "link" in str(settings):
        *_, played, dry = result.signals.packets.values[-1]
        machine = run.machine.summary()
        assert (machine["played"], machine["dry"]) == (played, dry)
        assert (dry > 0) == (BURSTS in settings)


def test_encoders_send_codes():
    run = begun(
        "sensor={kind: encoders, bits: 12, samples: 3, offset: [0.01,0,0,0,0,0]}", samples=5
    )
    told = [m for m in run.driver.got if m.codes is not None]
    assert told and all(m.codes.shape == (3, 6) and m.bits == 12 for m in told)
    run = begun(
        "sensor={kind: encoders, faults: [{kind: missing, leg: 2, from: 0.3, to: 0.4}]}", samples=5
    )
    lost = [m for m in run.driver.got if m.codes is not None and MISSING in m.codes]
    assert [m.sampled for m in lost] == [run.driver.begin + 3 * run.driver.period]
    assert np.flatnonzero(lost[0].codes[0] == MISSING).tolist() == [1]


# ---------------------------------------------------------------- safety


def torque_of(run):
    return run.machine._motors.torque


@pytest.mark.parametrize("safe", ["zero", "hold"])
@pytest.mark.parametrize("settings", [(), (NETWORK,)])
def test_silence_ends_in_the_safe_torque_in_time(safe, settings):
    """The safe torque acts `watchdog` after the last datagram, with any buffer."""
    run = begun(*settings, samples=20, safe=safe, watchdog=0.35)
    run.at(run.machine.time() + round(0.33 * SECOND) * bool(settings))  # what is under way is heard
    heard = run.machine.session.heard
    run.at(heard + round(0.35 * SECOND))
    before = torque_of(run)
    assert np.any(before) and not run.machine._safe
    run.at(heard + round(0.35 * SECOND) + 2)
    assert run.machine._safe
    expected = before if safe == "hold" else np.zeros(6)
    np.testing.assert_array_equal(torque_of(run), expected)
    run.at(heard + 2 * SECOND)
    np.testing.assert_array_equal(torque_of(run), expected)
    assert run.machine.counts["silences"] == 1
    said = "nothing was heard from the controller for 0.35 s: the safe torque"
    assert sum(said in line for line in run.said) == 1
    last = messages(run)[-1]
    assert MachineFlags.SAFE in last.flags
    assert (MachineFlags.SAFE_HOLDS in last.flags) == (safe == "hold")


def messages(run):
    run.driver.receive(run.machine.time())
    return run.driver.got


def test_a_controller_that_was_suspended_goes_on_in_its_session():
    run = begun(samples=20, watchdog=0.3)
    time = run.driver.begin + 30 * run.driver.period
    run.at(time)
    assert run.machine._safe and not torque_of(run).any()
    driver = run.driver
    driver.say(time, sampled=time, playout=time + driver.period, torques=np.full((1, 6), 0.1))
    run.at(time + 9 * driver.period)
    assert "torques act again" in "".join(run.said)
    assert run.machine.counts["silences"] == 2  # and silence again
    assert any(np.all(m.acted == 0.1, axis=1).any() for m in messages(run))


def test_a_suspended_machine_was_safe_in_time_and_no_torque_acts_in_the_past():
    run = begun(samples=20, watchdog=0.3)
    driver, heard = run.driver, run.machine.session.heard
    for k in range(20, 30):  # sent while the machine does not read
        driver.step(driver.begin + k * driver.period)
    run.clock.time = run.zero + driver.begin + 30 * driver.period
    woken = run.machine.time()
    run.machine.poll(woken)
    run.machine.advance(woken)
    times = [float(line.split(" s: ")[0]) for line in run.said[-3:]]
    assert "stood still for" in run.said[-3] and "nothing was heard" in run.said[-2]
    assert times[1] == pytest.approx((heard + run.machine.watchdog) / SECOND, abs=1e-3)
    assert "torques act again" in run.said[-1] and times[2] >= woken / SECOND - 1e-3


@pytest.mark.parametrize(("safe", "held"), [("zero", 0.0), ("hold", 1e-4)])
def test_rows_that_are_always_late_end_in_the_safe_torque(safe, held):
    """A row in time acts again, also one that waited while the buffer was dry."""
    run = begun("link={kind: network, low: 0, high: 0, loss: 0}", safe=safe, watchdog=0.5)
    driver, machine = run.driver, run.machine
    for k in range(40):
        time = driver.begin + k * driver.period
        rows = np.full((1, 6), 1e-4)
        ahead = 2 if k < 10 else 5 if k == 16 else -5
        driver.say(time, sampled=time, playout=time + ahead * driver.period, torques=rows)
        run.at(time + driver.period - 1)
        assert machine._safe == (17 <= k < 21 or k >= 27), k
        if machine._safe:
            assert str(machine.reason) == "no torque or setpoint came in time for 0.5 s"
            np.testing.assert_array_equal(torque_of(run), held)
    assert run.ear.refused == {Refusal.LATE: 29} and machine.counts["silences"] == 0
    times = [m.acted_from for m in messages(run) if m.begin <= m.sampled and len(m.acted)]
    assert not np.any(np.array(times) % driver.period)


def test_a_machine_that_lags_says_so_once():
    run = begun("controller.period=0.02", samples=10)
    lines = len(run.said)
    for _ in range(3):
        run.clock.time += 90_000_000
        run.machine.advance(run.machine.time())
    lagged = [line for line in run.said[lines:] if "behind real time" in line]
    assert len(lagged) == 1 and " ms behind real time: measurements are sent late" in lagged[0]
    assert run.machine.counts["stood still"] == 0


def test_rows_for_times_before_the_begin_do_nothing():
    run = together(EXACT, "link={kind: network, low: 0, high: 0, loss: 0}", "queue=equilibrium")
    driver, period = run.driver, run.driver.period
    run.greet(3 * period, 20 * period)
    for k in range(run.machine.time() // period + 1, 20):
        run.at(k * period)
        driver.say(k * period, playout=(k + 2) * period, torques=np.full((3, 6), 1e-4))
    run.at(26 * period)
    early = [m for m in messages(run) if m.sampled < driver.begin]
    assert early and not any(len(m.acted) for m in early)
    last = driver.got[-1]
    assert last.played == 4 and last.before.fault == Fault.NONE
    assert len(last.acted) == 6 and np.all(last.acted == 1e-4)
    assert run.ear.refused[Refusal.LATE] > 0 and run.machine.counts["stood still"] == 0


def test_rows_off_the_grid_of_those_before_are_malformed():
    run = begun("link={kind: network, low: 0, high: 0, loss: 0}")
    driver, period = run.driver, run.driver.period
    for k, shift in enumerate([0.25, 0.25, 0.75, 0.0, 0.25]):
        time = driver.begin + k * period
        playout = time + round((1 + shift) * period)
        driver.say(time, sampled=time, playout=playout, torques=np.full((1, 6), 1e-4))
        run.at(time + period)
    assert run.ear.refused == {Refusal.MALFORMED: 2}
    run.at(time + 3 * period)
    assert messages(run)[-1].played == 3


def test_stop_is_the_safe_torque_and_the_end_of_the_session():
    run = begun(samples=20)
    time, driver = run.machine.time(), run.driver
    assert torque_of(run).any()
    driver.say(time, ControllerFlags.STOP)
    run.at(time + 1)
    assert not torque_of(run).any()
    driver.say(time, sampled=time, playout=time + driver.period, torques=np.ones((1, 6)))
    run.at(time + 20 * driver.period)
    assert not torque_of(run).any()
    assert run.machine.summary()["sessions"] == 1
    assert any("the controller said stop: the safe torque (zero) acts" in one for one in run.said)
    run.at(time + 10 * SECOND)  # it drifts out of its workspace
    number, run.machine.longest_lag = len(run.said), 0
    run.clock.time += 10 * SECOND  # an idle machine that stands still has nothing to report
    run.machine.advance(run.machine.time())
    assert len(run.said) == number and run.machine.longest_lag == 0


def test_limits_are_kept_to_here():
    run = begun("actuator.torque_limit=0.25", "link.kind=network", "link.loss=0", samples=1)
    driver, period = run.driver, run.driver.period
    time = driver.begin + period
    rows = np.array([[100.0, -1e300, 0.2, 0, 0, 0]])
    driver.say(time, sampled=time, playout=time + 10 * period, torques=rows)
    run.at(time + 10 * period + 1)
    np.testing.assert_array_equal(torque_of(run), [0.25, -0.25, 0.2, 0, 0, 0])
    assert messages(run)[-1].torque_limit == 0.25


def test_a_real_machine_begins_for_armed_controllers_only(monkeypatch):
    real = Machine._flags
    monkeypatch.setattr(Machine, "_flags", lambda one: real(one) & ~MachineFlags.SIMULATION)
    run = together(EXACT)
    driver, period = run.driver, run.driver.period
    time = 0
    while not driver.session.nonce:
        driver.say(time)
        time += period
        run.at(time)
        driver.receive(time)
    for flags, begun in ((NOTHING, False), (NOTHING, False), (ControllerFlags.ARMED, True)):
        driver.begin = time + 10 * period
        driver.say(time, flags)
        time += period
        run.at(time)
        assert (run.machine.begin != NEVER) == begun
    assert sum("not armed" in line for line in run.said) == 1


def test_a_plate_that_leaves_stops_and_a_new_session_begins_at_rest():
    run = begun("queue=equilibrium", "plant.gravity=true", samples=25)
    machine = run.machine
    assert machine.failure is not None
    assert [line for line in run.said if "left its workspace" in line and "new session" in line]
    left, state = machine.time(), np.array(machine._body.state)
    run.at(left + 2 * SECOND)
    np.testing.assert_array_equal(machine._body.state, state)
    assert MachineFlags.LEFT in messages(run)[-1].flags
    # The same session cannot move it; another one finds it back at its start.
    run.driver = Driver(run.scenario, run.ear.address)
    period = run.driver.period
    now = -(-machine.time() // period) * period
    run.greet(now + period, now + 30 * period)
    assert machine.failure is None
    np.testing.assert_array_equal(machine._body.state, run.driver.experiment.start)
    run.drive(3)
    assert machine.counts["runs"] == 2


def test_a_run_does_not_begin_for_nobody():
    run = together(EXACT, watchdog=0.5)
    period = run.driver.period
    run.greet(3 * period, 60 * period)
    run.at(80 * period)
    assert run.machine.counts["runs"] == 0
    assert "still parked" in run.said[-1]
    np.testing.assert_array_equal(run.machine._body.state, run.driver.experiment.start)


def test_a_beginning_in_the_past_or_off_the_grid_is_the_next_one():
    run = together(EXACT)
    driver, period = run.driver, run.driver.period
    run.at(0)
    driver.say(0)
    run.at(1)
    driver.receive(1)
    run.at(5 * period)
    driver.begin = 2 * period + 17
    driver.say(5 * period)
    run.at(5 * period + 1)
    assert run.machine.begin == 6 * period
    run.at(7 * period)
    assert messages(run)[-1].begin == 6 * period


# ---------------------------------------------------------------- who drives


def test_another_controller_has_to_wait():
    run = begun(samples=10)
    time, other = run.machine.time(), Driver(run.scenario, run.ear.address)
    other.say(time)
    run.at(time + 1)
    (offer,) = other.receive(time)
    assert MachineFlags.BUSY in offer.flags and offer.begin == NEVER
    other.begin = 0
    other.say(time, sampled=time, playout=time + other.period, torques=np.ones((1, 6)))
    run.at(time + 2)
    assert run.ear.refused == {Refusal.FOREIGN: 1}
    # Once the first one is silent the same offer holds.
    run.at(time + 2 * SECOND)
    other.begin = NEVER
    other.say(time)
    run.at(time + 2 * SECOND + 1)
    assert run.machine.session.number == other.session.number
    assert run.machine.counts["sessions"] == 2


@pytest.mark.parametrize("restart", ["rest", "motion"])
def test_a_new_session_begins_where_it_is_said(restart):
    run = begun(samples=15, restart=restart)
    period, machine = run.driver.period, run.machine
    moving = np.array(machine._body.state)
    assert np.abs(moving[6:]).max() > 0.01
    run.driver.say(machine.time(), ControllerFlags.STOP)
    old = run.driver.session
    run.driver = Driver(run.scenario, run.ear.address)
    now = -(-machine.time() // period) * period
    run.at(now)
    run.driver.say(now)
    run.at(now + 1)
    (offer,) = run.driver.receive(now)
    assert (MachineFlags.RESETS in offer.flags) == (restart == "rest")
    run.driver.begin = now + 3 * period
    run.driver.say(now)
    run.at(now + 2)
    assert old.number != machine.session.number
    if restart == "rest":
        np.testing.assert_array_equal(machine._body.state, run.driver.experiment.start)
        assert run.said[-1].endswith("at rest")
    else:
        np.testing.assert_allclose(machine._body.state, moving, atol=0.05)
        assert run.said[-1].endswith("in motion")
        assert machine.begin == now + 3 * period
        # Its torques act when they are due.
        time = now + period
        torques = np.full((1, 6), 0.05)
        run.driver.say(time, sampled=time, playout=time + period, torques=torques)
        run.at(time + 10 * period)
        assert any(np.all(m.acted == 0.05, axis=1).any() for m in messages(run))


def test_a_machine_says_once_that_a_controller_has_another_key():
    run = together(EXACT, key=KEY)
    for key in (None, b"another key, as long"):
        run.driver = Driver(run.scenario, run.ear.address, key)
        run.driver.say(run.machine.time())
        run.at(run.machine.time() + SECOND)
    assert run.ear.refused == {Refusal.KEY: 2}
    (line,) = [line for line in run.said if "key" in line]
    assert "another key or without one; expected the same --key on both sides" in line


def test_what_was_recorded_of_an_earlier_session_is_foreign():
    """Replay every datagram of a session after its end, while another session drives."""
    run = together(EXACT, key=KEY)
    period = run.driver.period
    recorded = []
    say = run.driver.endpoint.send

    def send(message, to):
        recorded.append(encode(message, KEY))
        return say(message, to)

    run.driver.endpoint.send = send
    run.greet(3 * period, 20 * period)
    run.drive(12)
    run.driver.say(run.machine.time(), ControllerFlags.STOP)
    replayer = run.driver.endpoint._socket
    run.driver = Driver(run.scenario, run.ear.address, KEY)
    now = -(-run.machine.time() // period) * period
    run.greet(now + period, now + 20 * period)
    run.drive(12)
    before = Counter(run.ear.refused)
    sessions, played = run.machine.counts["sessions"], run.machine.summary()["played"]
    torque = np.array(torque_of(run))
    for data in recorded:
        replayer.sendto(data, run.ear.address)
    run.at(run.machine.time() + 1)
    refused = run.ear.refused - before
    # The requests for a session, which have no nonce, are answered; nothing else is done.
    asked = sum(data[16:24] == bytes(8) for data in recorded)
    assert refused == {Refusal.FOREIGN: len(recorded) - asked} and 0 < asked < 5
    assert run.machine.counts["sessions"] == sessions
    assert run.machine.summary()["played"] == played
    np.testing.assert_array_equal(torque_of(run), torque)
    # A recorded confirmation begins no session after the end of the last one either.
    run.driver.say(run.machine.time(), ControllerFlags.STOP)
    run.at(run.machine.time() + 2 * SECOND)
    for data in recorded:
        replayer.sendto(data, run.ear.address)
    run.at(run.machine.time() + 1)
    assert run.ear.refused[Refusal.FOREIGN] - before[Refusal.FOREIGN] == 2 * (len(recorded) - asked)
    assert run.machine.counts["sessions"] == sessions


# ---------------------------------------------------------------- what nobody should act upon


def attack(rng, run, attacker, recorded):
    """Return a datagram that must not do anything."""
    driver, time = run.driver, run.machine.time()
    if recorded and rng.random() < 0.3:
        data = rng.choice(recorded)  # from another address: foreign; from its own: replayed
        mouth = attacker if rng.random() < 0.5 else driver.endpoint
        mouth._socket.sendto(data, run.ear.address)
        return
    head = driver.session.head(time)
    driver.session._c.sent -= 1
    head = replace(head, sequence=head.sequence + rng.randrange(3))
    rows = np.full((rng.randrange(1, 5), 6), rng.uniform(-9, 9))
    plan = ControllerMessage(head, sampled=time, playout=time, begin=driver.begin, torques=rows)
    kind = rng.randrange(4)
    if kind == 0:
        other = replace(head, session=rng.randrange(1, 2**64))
        data = encode(replace(plan, head=other), KEY)
    elif kind == 1:
        data = encode(plan, rng.choice([None, b"another key, as long"]))
    elif kind == 2:
        data = bytearray(encode(plan, KEY))
        data[4] = rng.randrange(VERSION + 1, 256)
        data = bytes(data)
    else:
        data = damaged(rng, encode(plan, KEY))
        while data == encode(plan, KEY):
            data = damaged(rng, data)
    mouth = attacker if rng.random() < 0.5 else driver.endpoint
    mouth._socket.sendto(data[:1600], run.ear.address)


def attacked(seed, samples, most):
    """Return a run among such datagrams: what was refused, how many there were, the states."""
    rng = random.Random(seed)
    run = together(EXACT, NETWORK, key=KEY)
    attacker = Endpoint(MachineMessage, key=KEY)
    period, number, recorded, states = run.driver.period, 0, list[bytes](), list[np.ndarray]()
    run.greet(3 * period, 60 * period)
    run.drive(0)
    for k in range(samples):
        time = run.driver.begin + k * period
        run.at(time)
        for i in range(rng.randrange(most + 1)):
            attack(rng, run, attacker, recorded)
            number += 1
            if i % 20 == 0:  # before the socket's buffer is full
                run.machine.poll(time)
        run.machine.poll(time)
        states.append(np.array(run.machine._body.state))
        recorded.append(encode(run.driver.step(time), KEY))
    run.at(run.driver.begin + (samples + 20) * period)
    attacker.close()
    return Counter(run.ear.refused), number, run, states


def check_attack(seed, samples=25, most=30):
    """Nothing differs from the run without them, but what is counted."""
    peace, nothing, calm, expected = attacked(seed, samples, 0)
    assert nothing == 0 and not peace
    refused, number, run, states = attacked(seed, samples, most)
    np.testing.assert_array_equal(states, expected)
    lost = run.machine.counts["lost"] - calm.machine.counts["lost"]
    assert sum(refused.values()) + lost == number
    for name in ("sessions", "runs", "silences"):
        assert run.machine.counts[name] == calm.machine.counts[name]
    for name in ("played", "dry"):
        assert run.machine.summary()[name] == calm.machine.summary()[name]
    return refused


def test_nothing_that_is_refused_is_acted_upon():
    refused = check_attack(20261122)
    assert set(refused) == {
        *(Refusal.MALFORMED, Refusal.VERSION, Refusal.KEY, Refusal.FOREIGN, Refusal.REPLAYED),
    }


@pytest.mark.soak
def test_nothing_that_is_refused_is_acted_upon_for_five_minutes():
    import time

    end, total, seed = time.monotonic() + 300, Counter[Refusal](), random.randrange(10**9)
    while time.monotonic() < end:
        total += check_attack(seed, samples=60, most=200)
        seed += 1
    print(dict(total))


def test_a_flooded_socket_is_survived():
    """More than its buffer takes: what is lost is lost, and the rest goes on."""
    run = begun(samples=10)
    attacker = Endpoint(MachineMessage)
    for _ in range(20_000):
        attacker._socket.sendto(b"x" * 1000, run.ear.address)
    time = run.machine.time()
    run.at(time + 1)
    run.driver.say(time)
    while run.machine.session.heard < time:
        before = run.ear.refused[Refusal.MALFORMED]
        run.machine.poll(time + 1)
        run.machine.advance(time + 1)
        if run.ear.refused[Refusal.MALFORMED] == before:
            run.driver.say(time)
    assert run.ear.refused[Refusal.MALFORMED] > 50


# ---------------------------------------------------------------- motors, settings


def test_the_newest_plan_of_a_period_acts_and_a_dry_buffer_holds_or_not():
    for holds in (True, False):
        motors = Motors(1.0, 10, holds)
        motors.begin(Plan(0, 0, 0, 100, np.full((2, 6), 0.5)))
        assert motors.take(Plan(5, 0, 0, 110, np.full((2, 6), 0.2)), 50) is None
        assert motors.take(Plan(4, 0, 0, 110, np.full((3, 6), 9.0)), 50) is None
        seen = []
        while motors.next_change < 160:
            time = motors.next_change
            motors.change(time)
            seen.append((time, motors.torque[0]))
        after = 1.0 if holds else 0.0
        assert seen == [(100, 0.5), (110, 0.2), (120, 0.2), (130, 1.0), (140, after), (150, after)]
        assert (motors.played, motors.dry) == (3, 2)
        assert motors.take(Plan(6, 0, 0, 120, np.zeros((4, 6))), 155) == Refusal.LATE
        assert motors.take(Plan(6, 0, 0, 120, np.zeros((5, 6))), 155) is None
        assert motors.take(Plan(7, 0, 0, 120, np.zeros((1 << 16, 6))), 155) == Refusal.MALFORMED


def test_over_a_wire_what_was_overtaken_never_acts():
    delays = {0: 50, 1: 20, 2: 30}
    motors = Motors(1.0, 10, delay_of=delays.__getitem__)
    motors.begin(Plan(0, 0, 0, 0, np.array([[0.1] * 6, [0.2] * 6])))
    for k in range(3):
        plan = Plan(k + 1, 10 * k, k, 0, np.full((1, 6), 0.5 + k))
        assert motors.take(plan, 10 * k) is None
    seen = []
    while motors.next_change != NEVER:
        time = motors.next_change
        motors.change(time)
        seen.append((time, motors.torque[0]))
    assert seen == [(0, 0.1), (10, 0.2), (30, 1.0), (50, 1.0)]  # the newer one of those at 50
    assert motors.played == 2
    assert motors.take(Plan(1, 0, 0, 0, np.ones((1, 6))), 60) == Refusal.LATE


def test_what_the_protocol_cannot_say_is_refused():
    """tests/test_live.py has the samples of encoders."""
    servo = ("actuator.kind=servo", "controller.command=cranks")
    with pytest.raises(ConfigError, match=r"^actuator\.kind: got 'servo'"):
        check_scenario(load_scenario("paper", settings=servo))


def test_half_the_rate_takes_twice_the_time():
    run = together(EXACT, rate=0.5)
    start = run.clock.time
    run.clock.time = start + 2 * SECOND
    assert run.machine.time() == SECOND
