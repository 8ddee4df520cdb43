"""Servos over a network: plans of setpoints between `live` and a machine."""

from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest

import stewart_drake as sd
from stewart_drake.live.design import design
from stewart_drake.live.endpoint import now
from stewart_drake.live.exchange import Watch
from stewart_drake.live.machine import Machine, Settings
from stewart_drake.live.protocol import (
    ControllerFlags,
    ControllerMessage,
    Head,
    MachineFlags,
    Refusal,
)
from stewart_drake.live.session import drive, plans, prepare_session
from stewart_drake.loop.peer import Fault, Reason
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.servos import servo_law
from stewart_drake.mechanism.trajectories import evaluate
from stewart_drake.reporting.run import run_document
from stewart_drake.scenario.run_log import open_log, read_log
from stewart_drake.scenario.signals import POSE
from tests.live_driver import Clock, Wire, in_real_time, running_machine

NETWORK = "link={kind: network, low: 0, high: 0, loss: 0, playout: 0.1}"
SESSION, NONCE, ADDRESS = 7, 9, ("127.0.0.1", 50000)
STEPS = 5  # of delay
SETTINGS = (f"delay.steps={STEPS}", "plant.accuracy=1e-9")


class Fed:
    """A machine that is fed plans by hand, at the instants of its samples."""

    def __init__(self, *settings, rows=16):
        scenario = sd.load_scenario("reachy_mini", settings=(*SETTINGS, *settings))
        self.experiment = prepare(scenario)
        known = prepare(sd.load_scenario("reachy_mini", settings=SETTINGS))
        self.law, self.motion, _ = servo_law(known)
        self.clock, self.wire, self.rows = Clock(), Wire(), rows
        self.machine = Machine(
            self.experiment, self.wire, Settings(), lambda line: None, self.clock
        )
        self.period, self.sequence, self.zero = self.machine.period, 0, self.clock.time
        self.machine.offers.nonce = lambda *_: NONCE
        self.begin = 2 * self.period
        self.say(0, np.empty((0, 6)))

    def say(self, sampled, rows, cranks=True):
        self.sequence += 1
        head = Head(SESSION, NONCE, self.sequence, 0, 1, 0, 0)
        playout = sampled + STEPS * self.period
        numbers = (sampled, playout, self.begin, rows)
        message = ControllerMessage(head, ControllerFlags(0), *numbers, cranks=cranks)
        self.machine._arrive(message, ADDRESS, self.clock.time - self.zero)

    def plan(self, k):
        """Return the setpoints (n, 6) of sample k, and of those after it."""
        first = float(self.law.preview_times[0])
        times = 0.02 * (k + np.arange(self.rows)) + first
        none = self.law.plant.dynamics.parameters
        return np.array([self.law.command(evaluate(self.motion, t), none)[POSE] for t in times])

    def run(self, samples, lost=()):
        """Return the states (n, 12) at the samples, without the plans of some of them."""
        states = []
        for k in range(samples):
            time = self.begin + k * self.period
            self.clock.time = self.zero + time
            self.machine.advance(time)
            states.append(np.array(self.machine._body.state))
            if k not in lost:
                self.say(time, self.plan(k))
        return np.array(states)


@pytest.mark.parametrize("link", [(), (NETWORK,)])
def test_a_machine_with_servos_moves_as_in_the_simulation(link):
    signals = sd.simulate(
        sd.load_scenario("reachy_mini", settings=(*SETTINGS, "duration=1")),
        judge_stability=False,
    ).signals
    kept = signals.sel(time=0.02 * np.arange(50), method="nearest")
    states = Fed(*link).run(50)
    assert np.ptp(states[:, 0]) > 0.02
    assert states[:, :6] == pytest.approx(kept.pose.values, abs=1e-5)
    assert states[:, 6:] == pytest.approx(kept.rates.values, abs=1e-4)


def test_a_plan_replaces_those_that_are_lost():
    """All but each eighth plan lost, up to 15 in a row, change nothing."""
    lost = {k for k in range(100) if k % 8} | set(range(65, 80))
    fed = Fed(NETWORK)
    assert fed.run(100, lost) == pytest.approx(Fed(NETWORK).run(100), abs=1e-12)
    assert fed.machine.summary()["dry"] == 0


def test_a_gap_holds_the_cranks_and_is_reported():
    fed = Fed(NETWORK)
    states = fed.run(100, set(range(30, 100)))
    assert fed.machine.reason.fault  # silence
    assert MachineFlags.SAFE_HOLDS in fed.wire.said[-1].flags
    held = fed.plan(29)[-1]
    found = fed.experiment.mechanism.crank_angles(states[-1, POSE])
    assert found == pytest.approx(held, abs=0.05)  # the sag of gravity and friction
    assert fed.wire.said[-1].cranks
    assert fed.wire.said[-1].acted[0] == pytest.approx(held, abs=1e-12)


def test_rows_of_the_other_kind_are_refused():
    fed = Fed(NETWORK)
    fed.say(0, np.zeros((1, 6)), cranks=False)
    assert fed.wire.refused == {Refusal.MALFORMED: 1}


def test_the_words_for_a_stop_are_those_of_servos(tmp_path):
    said = []
    contact = SimpleNamespace(heard=now(), machine=SimpleNamespace(reason=Reason()))
    exchange = SimpleNamespace(contact=contact, late=lambda k: 0.0, jitter=0.0)
    watch = Watch(exchange, 0.02, said.append)
    why = str(Reason(Fault.DRIVE))
    for flags in (MachineFlags.SAFE, MachineFlags(0)):
        watch.ended(5, SimpleNamespace(flags=flags, why=why, cranks=True))
    assert said == [
        f"at 0.1 s: the machine holds its cranks: {why}",
        "at 0.1 s: setpoints act again",
    ]
    assert "does not answer" in why
    with closing(open_log(tmp_path / "m.csv", Fed().experiment.scenario, servos=False)):
        assert "setpoint_" not in (tmp_path / "m.csv").read_text()


@pytest.mark.slow
@in_real_time
def test_a_machine_with_another_delay_ends_the_run():
    machine = sd.load_scenario("reachy_mini", settings=("delay.steps=13",))
    with running_machine(machine) as running:
        ready = prepare_session(sd.load_scenario("reachy_mini"), running.address)
        result = drive(ready, 4.0, accept_jitter=True, say=lambda line: None)
    assert result.status == "refused" and "same delay.steps" in result.failure


def test_live_compensates_what_the_scenario_says_of_the_plant():
    """As the command `setpoints` does, which another test compares with MuJoCo."""
    settings = ("plant.ball_joint_friction=0.05", "plant.payload_mass=0.1", "start=on_reference")
    scenario = sd.load_scenario("reachy_mini", settings=settings)
    machine = SimpleNamespace(torque_limit=np.inf, flags=MachineFlags(0))
    law = design(scenario, machine).law
    sent = sd.setpoints(scenario, 50.0).angles
    plain = prepare(sd.load_scenario("reachy_mini"))
    unaware = servo_law(plain)[0]
    for k in (10, 57):
        wanted = evaluate(plain.reference, 0.02 * (k + 0.5))
        angles = law.command(wanted, law.plant.dynamics.parameters)[POSE]
        assert angles == pytest.approx(sent[k], abs=1e-9)
        before = unaware.command(wanted, unaware.plant.dynamics.parameters)[POSE]
        assert np.abs(angles - before).max() > 1e-3


@pytest.mark.slow
@in_real_time
def test_live_drives_servos_over_a_network_that_loses_packets(tmp_path):
    """Measured by the true state in the machine's log."""
    way = "low: 0.02, high: 0.1, loss: 0.1"
    network = f"link={{kind: network, {way}, playout: 0.2, return: {{{way}}}}}"
    wanted = sd.load_scenario("reachy_mini", settings=("delay.steps=13",))
    machine = sd.load_scenario("reachy_mini", settings=(network,))
    log = open_log(tmp_path / "true.csv", machine)
    with closing(log), running_machine(machine, log=log) as running:
        ready = prepare_session(wanted, running.address)
        said = "\n".join(plans(ready, 3.0, "reachy_mini"))
        assert "setpoints act 0.26 s" in said and "plans of 16 setpoints" in said
        result = drive(ready, 3.0, accept_jitter=True, say=lambda line: None)
    assert result.status == "completed"
    assert result.summary["live"]["periods_dry"] < 20
    assert "not reported by servos" in run_document(result).plain()
    true = read_log(tmp_path / "true.csv")
    motion = servo_law(prepare(wanted))[1]
    began = running.machine.begin / 1e9
    late = true.sel(time=slice(began + 1.5, began + 2.9))
    assert late.sizes["time"] > 60
    expected = np.array([evaluate(motion, t - began)[:3] for t in late.time.values])
    assert np.abs(late.pose.values[:, :3] - expected).max() < 0.02
