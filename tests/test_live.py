"""The controller's side of the loop in real time, against a simulated machine in a thread."""

import io
import itertools
import json
import math
import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydantic import ValidationError

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.cli.live import transit_times
from stewart_drake.dynamics.workspace import Failure
from stewart_drake.files.errors import ConfigError
from stewart_drake.identification.logs import Precision, load_log
from stewart_drake.law.belief import Estimate
from stewart_drake.law.gaps import longest_gap, within_reach
from stewart_drake.law.stability import Margins
from stewart_drake.live import contact as contacts
from stewart_drake.live.checks import check_whole_motion
from stewart_drake.live.contact import Contact, Link, await_free, call, open_endpoint, parse_address
from stewart_drake.live.design import Design, as_seen, check_controller, design
from stewart_drake.live.endpoint import Endpoint, now
from stewart_drake.live.exchange import Watch
from stewart_drake.live.governor import Governor, Request, Steering, Way
from stewart_drake.live.loop import LiveLoop
from stewart_drake.live.machine import Machine
from stewart_drake.live.page import PageRequest, PageViewer, Readouts, serve
from stewart_drake.live.protocol import NEVER, NOTHING, SECOND, ControllerMessage, MachineFlags
from stewart_drake.live.session import (
    _margin,
    _queue_advice,
    check_armed,
    drive,
    plans,
    prepare_session,
    readings,
)
from stewart_drake.live.viewer import End, Snapshot, Viewer
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.peer import Fault, Reason, identity_of
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import load_mechanism, mechanism_yaml
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.mechanism.trajectories import make_reference
from stewart_drake.reporting.run import run_document
from stewart_drake.reporting.style import FACTORS
from stewart_drake.reporting.viewer import slider_range
from stewart_drake.scenario.calibration import Calibration, save_calibration
from stewart_drake.scenario.loading import load_scenario
from stewart_drake.scenario.reference_config import SineConfig
from stewart_drake.scenario.signals import ACCELERATIONS, POSE, RATES
from tests.browser import browser, needs_chromium
from tests.faults import written
from tests.live_driver import Together, Wire, in_real_time, running_machine, until


def network(way, back=None):
    """Return the setting of a link with these fields of the way there, and of the way back."""
    return f"link={{kind: network, {way}, return: {{{back or way}}}}}"


OVER_A_NETWORK = network("low: 0.1, high: 0.12, loss: 0.02")
QUICK = network("low: 0.01, high: 0.02, loss: 0")
FROM_REST = ("start=rest", "queue=zero")
PARKED = ("plant.gravity=true", "start=rest", "queue=equilibrium")
HEAVY = (*PARKED, "actuator.torque_limit=6")
SETTINGS = ("plant.kind=exact", "start=on_reference", "queue=reference")


def paper_machine(*settings, **how):
    """Run the paper's machine in a thread."""
    return running_machine(scenario_of(*settings), **how)


def driven(running, seconds, *settings, **how):
    """Return the result of a run on this machine; any jitter is accepted."""
    ready = prepare_session(scenario_of(*settings), running.address)
    return drive(ready, seconds, accept_jitter=True, say=lambda line: None, **how)


def scenario_of(*settings):
    return load_scenario("paper", settings=(*SETTINGS, *settings))


# ---------------------------------------------------------------- runs


@pytest.fixture
def jumping_clock(monkeypatch):
    """Return a time of day that is an hour off, to either side by turns."""
    true, jumps = time.time, itertools.cycle((3600.0, -3600.0))
    monkeypatch.setattr(time, "time", lambda: true() + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: int(1e9 * time.time()))


@pytest.mark.slow
@in_real_time
def test_on_a_wire_it_does_what_the_simulation_does(jumping_clock):
    with paper_machine() as running:
        ready = prepare_session(scenario_of(), running.address)
        told = "\n".join(plans(ready, 2.5, "paper"))
        assert "a simulation" in told and "assumed delay: 0.8 s" in told
        result = drive(ready, 2.5, accept_jitter=True, say=lambda line: None)
    simulated = sd.simulate(scenario_of("duration=2.4"), judge_stability=False)
    assert result.status == "completed" and result.signals.sizes["time"] == 25
    assert result.accumulated_error < simulated.accumulated_error + 0.05
    assert result.summary["live"]["samples"] >= 25
    assert result.summary["delay"]["estimated_s"] == pytest.approx(0.8)
    assert set(result.signals.data_vars) == set(simulated.signals.data_vars)


@pytest.mark.slow
@in_real_time
def test_over_a_network_packets_bridge_what_is_lost(tmp_path):
    with paper_machine(OVER_A_NETWORK, *FROM_REST) as running:
        ready = prepare_session(scenario_of(*FROM_REST), running.address)
        link = ready.design.experiment.scenario.link
        assert 0.19 < link.low <= 0.24 and link.playout == pytest.approx(0.7)
        result = drive(ready, 5.0, say=lambda line: None)
    simulated = sd.simulate(scenario_of("duration=4.9", *FROM_REST), judge_stability=False)
    assert result.status == "completed"
    assert result.accumulated_error < simulated.accumulated_error + 0.5
    lost = result.signals.packets.sel(packet="lost").values
    assert np.array_equal(lost, np.round(lost)) and np.all(np.diff(lost) >= 0)
    applied = result.signals.torque_applied.values
    assert np.isfinite(applied).all() and result.summary["live"]["periods_played"] > 20
    result.save(tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text())["live"]["deadlines_missed"] >= 0
    log = load_log(tmp_path / "signals.nc", load_mechanism("paper"), Precision())
    # What acted 0.8 s later is what was sent at a sample, as far as it was not lost.
    sent = result.signals.torque_commanded.values[:-10]
    same = np.isclose(log.torques[: len(sent)], sent, atol=1e-9).all(axis=1)
    assert log.delay == pytest.approx(0.8) and same.mean() > 0.6


class Hand(Viewer):
    """Follows the motion or holds the plate at home, and asks for a pose after five samples."""

    def __init__(self, target, rest=False):
        self.seen, self._target, self._rest = list[Snapshot](), target, rest

    def show(self, seen):
        self.seen.append(seen)

    def request(self):
        asks = len(self.seen) >= 5
        return Request(self._target if asks else None, rest=self._rest and not asks)


@pytest.mark.slow
@in_real_time
def test_a_hand_leads_from_the_motion_until_a_leg_is_at_the_end_of_its_reach():
    hand = Hand(load_mechanism("paper").home + [0, 0, 0, 0, 0, 0.3])
    with paper_machine(rate=2.0) as running:
        result = driven(running, 9.0, viewer=hand)
    assert result.status == "completed"
    last = hand.seen[89]  # then it comes to rest
    assert [one.resting for one in hand.seen[88:91]] == [False, False, True]
    assert last.by_hand and "leg" in last.limit and last.state[5] > 0.45
    away = np.array([one.state[POSE] - one.wanted[POSE] for one in hand.seen[:90]])
    assert np.abs(away).max() < 3e-3 and np.abs(away[80:]).max() < 3e-4


@pytest.mark.slow
@in_real_time
def test_a_step_is_as_late_as_delay_holds_and_pace():
    """On average by eta + 2 dt + 3 / w, w = 10 / s with 0.66 N m: 1.3 s."""
    home, height = load_mechanism("paper").home, 0.02
    still, limit = "reference.amplitude=[0, 0, 0, 0, 0, 0]", "actuator.torque_limit=0.66"
    hand = Hand(home + [0, 0, 0, 0, 0, height], rest=True)
    with paper_machine(still, limit, rate=2.0) as running:
        result = driven(running, 4.0, still, limit, viewer=hand)
    assert result.status == "completed"
    states = np.array([seen.state for seen in hand.seen[5:41]])
    late = 0.1 * (1 - (states[:, 5] - home[5]) / height).sum() - 0.05  # trapezoid rule
    assert late == pytest.approx(0.8 + 2 * 0.1 + 3 / 10, abs=0.02)
    assert np.abs(result.signals.torque_commanded.values).max() < 0.8 * 0.66
    wanted = np.array([seen.wanted[:6] for seen in hand.seen[5:41]])
    assert np.abs(states[:, :6] - wanted).max() < 0.02 * height
    # The rates of held torques at the samples are no reason for a new reference.
    assert result.summary["live"]["recoveries"] == 0


@pytest.mark.slow
@in_real_time
def test_a_second_controller_takes_over_in_motion():
    said = []
    with paper_machine(restart="motion", watchdog=0.3) as running:
        first = prepare_session(scenario_of(), running.address)
        made = first.design
        governor = Governor(made.law.plant.dynamics, made.torque_limit)
        steering = Steering(governor, made.experiment.reference, Way.along(made.planned))
        loop = LiveLoop(made, steering, first.contact, Viewer(), said.append)
        loop.begin(NOTHING)
        # Rates are smallest where the motion turns back.
        for k in range(15):
            loop._step(k)
        second = prepare_session(scenario_of(), running.address)
        first.endpoint.close()  # as a process that was killed
        result = drive(second, 3.0, accept_jitter=True, say=said.append)
        assert running.machine.failure is None or result.status in ("refused", "left_workspace")
    live = result.summary["live"]
    assert live["periods_played"] + live["periods_dry"] <= live["samples"]
    if result.status == "completed":
        assert result.summary["live"]["taken_over"]
        error = np.abs(result.signals.error.values[-1])
        assert (error / np.repeat([0.52, 0.04, 0.16], [3, 2, 1])).max() < 0.3
    else:  # the plate went too far meanwhile
        assert result.status in ("refused", "left_workspace") and result.stopped.reason


@pytest.mark.slow
@in_real_time
def test_a_parked_plate_that_is_not_at_the_start_is_held_on_the_way_to_it():
    """The torques that hold it there act until the first ones of the law arrive."""
    settings = (*PARKED, "reference.amplitude=[0, 0, 0, 0, 0, 0.02]")
    away = "reference.offset=[0, 0, 0.06, 0, 0, 0.384]"
    with paper_machine(*settings, away, rate=5.0) as running:
        result = driven(running, 4.0, *settings)
    assert result.status == "completed" and result.summary["live"]["taken_over"]


@pytest.mark.slow
@in_real_time
def test_a_plate_that_fell_is_parked_again_for_the_next_session():
    """Its machine would keep a plate in motion, and this one is led from elsewhere to the start."""
    settings = (*HEAVY, "delay.steps=2", "reference.amplitude=[0, 0, 0, 0, 0, 0.02]")
    away = "reference.offset=[0, 0, 0, 0, 0, 0.386]"
    with paper_machine(*settings, away, rate=4.0, restart="motion", watchdog=0.3) as running:
        for _ in range(2):
            result = driven(running, 1.0, *settings)
            assert result.status == "completed", result.failure
            assert result.summary["live"]["taken_over"]
            until(lambda: running.machine.failure)


@pytest.mark.slow
@in_real_time
def test_the_law_leads_a_plate_near_the_start_sooner_than_a_path_does():
    """It is 0.6 mm off: E is 0.18, and 1.0 along a path to the start."""
    timing = "controller.period=0.05", "delay.steps=2"
    settings = (*HEAVY, *timing, "reference.amplitude=[0, 0, 0, 0, 0, 0.01]")
    with paper_machine(*settings, "reference.offset=[0, 0, 0, 0, 0, 0.3806]") as running:
        result = driven(running, 4.0, *settings)
    assert result.status == "completed" and not result.summary["live"]["taken_over"]
    assert result.accumulated_error < 0.3


def test_live_judges_the_loop_with_a_calibrated_machine(tmp_path):
    names, values = ("joint_damping", "coulomb_friction"), np.array([0.05, 0.003])
    save_calibration(
        tmp_path / "found.yaml",
        Calibration(fingerprint(load_mechanism("paper")), names, values, np.zeros((2, 2))),
    )
    known = f"controller.calibration={tmp_path / 'found.yaml'}"
    plant = "plant.joint_damping=0.05", "plant.coulomb_friction=0.003"
    settings = "controller.estimate=[]", "duration=2"
    judged = _margin(prepare(scenario_of(*settings, known)))
    as_plant = sd.controller_margin(scenario_of(*settings, known, *plant))
    assert judged.radius == pytest.approx(as_plant.radius, rel=1e-9)
    without = sd.controller_margin(scenario_of(*settings, known))
    assert abs(judged.radius - without.radius) > 1e-3 * judged.radius


# ---------------------------------------------------------------- measurements that do not come


class Misnumbers(Machine):
    """Numbers every measurement after the first second as that of the begin."""

    def _message(self, time, sampled, *others, **more):
        late = self._running and sampled > self._origin + SECOND
        return super()._message(time, self._origin if late else sampled, *others, **more)


def silent(when):
    """Return a machine that says nothing of the plate at samples of these times of a run, s."""

    class Silent(Machine):
        def _message(self, time, sampled, said, *others, **more):
            quiet = self._running and when((sampled - self._origin) / SECOND)
            return super()._message(time, sampled, {} if quiet else said, *others, **more)

    return Silent


Blind = silent(lambda time: time > 1)


@pytest.fixture
def message():
    """Return a message of a machine with a session."""
    run = Together(scenario_of())
    run.greet(SECOND, 2 * SECOND)
    run.at(2 * SECOND)
    run.driver.receive(2 * SECOND)
    return run.driver.got[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "missing"), [(Misnumbers, None), (Blind, None), (Blind, 0.35)])
@in_real_time
def test_a_run_ends_where_measurements_stay_away(kind, missing):
    with paper_machine(kind=kind, rate=2.0) as running:
        result = driven(running, 5.0, max_missing=missing)
        time.sleep(0.1)
        assert "the controller said stop" in " ".join(running.lines)
        assert not running.machine._motors.torque.any()  # the safe torque
    assert result.status == result.summary["status"] == "lost_contact"
    gap = missing or 1.0
    assert 1.0 + gap - 0.1 <= result.stopped.time <= 1.0 + gap + 0.31
    assert "no usable measurement for" in result.stopped.reason
    assert math.isnan(result.accumulated_error)
    assert 0.4 < result.summary["measured_share"] < 0.8


@pytest.mark.parametrize(
    ("sent", "came", "words"),
    [
        (0.16, 0.32, "the last by 320 ms, as the machine lags by 160 ms"),
        (0.0, 0.16, "the last by 160 ms, on the way back"),
    ],
)
def test_where_measurements_are_late_is_said(message, sent, came, words):
    contact = Contact(Wire(), ("127.0.0.1", 1), identity_of(scenario_of()))
    for k, (held, under_way) in enumerate([(0.01, 0.02), (0.01 + sent, 0.02 + came)]):
        time = SECOND * (2 + k)
        head = replace(message.head, sequence=k + 1, time=time + round(held * SECOND))
        one = replace(message, head=head, sampled=time, rate=1.0)
        contact._note(one, time + round(under_way * SECOND))
    assert contact.late_by() == words


def test_a_lost_plate_is_said_though_its_measurements_come_too_late(message):
    left = replace(
        message, begin=SECOND, flags=MachineFlags.LEFT, reason=Reason(Fault.REACH, leg=3)
    )
    contact = SimpleNamespace(heard=now(), machine=left)
    watch = Watch(SimpleNamespace(contact=contact, late=lambda k: 0, jitter=0), 0.02, print)
    end = watch.ended(51, None)
    assert end.words.startswith("left workspace: leg 3 reached the end of its reach at t = 1.02")
    contact.machine = replace(left, begin=NEVER)  # an offer, of the run before
    assert watch.ended(51, None) is None


@pytest.mark.slow
@in_real_time
def test_a_gap_after_the_first_measurement_of_encoders_does_not_end_a_run():
    """One set of angles shows no rates, but the plate of a parked machine rests."""
    encoders = ("sensor.kind=encoders", "controller.period=0.02")
    settings = (*PARKED, *encoders, "reference.amplitude=[0, 0, 0, 0, 0, 0.005]", QUICK)
    with paper_machine(*settings, kind=silent(lambda time: 0 < time < 0.3)) as running:
        result = driven(running, 0.6, *settings)
    assert result.status == "completed" or result.stopped.time > 0.6, result.failure


@pytest.mark.slow
@in_real_time
def test_an_error_of_which_half_was_measured_is_none():
    with paper_machine(kind=silent(lambda time: round(10 * time) % 2), rate=2.0) as running:
        result = driven(running, 3.0)
    assert result.status == "completed" and math.isnan(result.accumulated_error)
    assert result.summary["measured_share"] == pytest.approx(0.5, abs=0.1)
    share = f"{100 * (1 - result.summary['measured_share']):.1f} % of the samples without a usable"
    said = " ".join(run_document(result).plain().split())
    assert (
        share in said
        and "none: it needs measurements at 90 %" in said
        and "bad measurements" not in said
    )


@pytest.mark.slow
@in_real_time
def test_measurements_may_take_longer_than_a_period():
    """The step waits for as long as the round trips of the call varied."""
    link = network("low: 0.02, high: 0.03, loss: 0", "low: 0.02, high: 0.17, loss: 0")
    with paper_machine(link, *FROM_REST) as running:
        result = driven(running, 4.0, *FROM_REST, "link.kind=network")
    assert result.status == "completed"
    assert result.summary["measured_share"] > 0.85  # 0.65 without the wait


@pytest.mark.slow
@in_real_time
def test_coarse_encoders_over_a_lossy_link_come_to_rest():
    """Their rates are uncertain, which is no reason for a new reference."""
    way = "low: 0.005, high: 0.03, loss: 0.05"
    link = network(f"{way}, burst: 3", way)
    encoders = ("sensor={kind: encoders, bits: 12, samples: 8}", "controller.period=0.02")
    settings = (*HEAVY, *encoders, "reference.amplitude=[0, 0, 0, 0, 0, 0.01]", link)
    said = []
    with paper_machine(*settings) as running:
        ready = prepare_session(scenario_of(*settings), running.address)
        result = drive(ready, 3.0, accept_jitter=True, say=said.append)
    assert result.status == "completed" and any("at rest" in line for line in said), said
    assert result.accumulated_error < 0.5 and result.summary["live"]["recoveries"] == 0


FAR_OFF = (*HEAVY, "reference.amplitude=[0, 0, 0, 0, 0, 0.02]")
NEAR = (
    *HEAVY, "controller.period=0.05", "delay.steps=4",
    "reference.amplitude=[0.05, 0.05, 0.05, 0.004, 0.004, 0.015]",
)  # fmt: skip
PUSHED = ("delay.steps=3",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "unknown", "recoveries", "error"),
    [
        (FAR_OFF, "payload_mass=0.15", 1, 46),  # the law alone loses it at 2 s
        (FAR_OFF, "payload_mass=0.3", 1, 57),
        (NEAR, "payload_mass=0.05", 0, 4.5),  # 12 with a new reference
        (PUSHED, "push={wrench: [0, 0, 0, 0.1, 0, 0], from: 1.0, to: 100}", 0, 16),  # 23
    ],
)
@in_real_time
def test_a_plate_is_led_back_where_the_law_would_hardly_do_it(settings, unknown, recoveries, error):
    with paper_machine(*settings, f"plant.{unknown}", rate=4.0) as running:
        result = driven(running, 8.0, *settings)
    assert result.status == "completed"
    assert result.summary["live"]["recoveries"] == recoveries
    assert result.accumulated_error < error


@pytest.mark.slow
@in_real_time
def test_a_loss_with_more_jitter_than_the_loop_is_stable_for_says_so(capsys):
    """Here the steps of the engine lose it, which the controller cannot know."""
    margin = 1e3 * min(sd.controller_margin("gravity").summary["delay_margin_s"])
    with running_machine(load_scenario("gravity", settings=("plant.kind=multibody",))) as running:
        machine = "{}:{}".format(*running.address)
        words = ["--yes", "--no-browser", "--duration", "4", "--machine", machine]
        assert main(["live", "gravity", *words]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert f"(standard deviation), and the loop is stable for {margin:.2g} ms" in said


# ---------------------------------------------------------------- the end


class Holds(Viewer):
    """Counts samples, and those at which the plate is held; then asks for the end."""

    def __init__(self, machine):
        self.said, self.seen, self.held, self._machine = [], 0, 0, machine

    def show(self, seen):
        self.seen += 1
        held = any("at rest; held until Ctrl-C" in line for line in self.said)
        self.held += held and self._machine.failure is None

    def stopped(self):
        return self.held >= 10


@pytest.mark.slow
@pytest.mark.parametrize(("duration", "status"), [(0.5, "completed"), (math.inf, "interrupted")])
@in_real_time
def test_at_the_end_the_plate_is_held_until_it_is_asked_to_end(duration, status):
    """Without torques it falls within tenths of a second, as is said before and after."""
    settings = (*PARKED, "reference.amplitude=[0, 0, 0, 0, 0, 0.005]", QUICK)
    with paper_machine(*settings) as running:
        viewer = Holds(running.machine)
        ready = prepare_session(scenario_of(*settings), running.address)
        told = plans(ready, duration, "paper")
        how = {"hold": True, "viewer": viewer, "say": viewer.said.append, "accept_jitter": True}
        result = drive(
            ready, duration, ending=lambda: math.isinf(duration) and viewer.seen > 6, **how
        )
    falls = "the motors have no torque: the plate falls unless brakes or a support hold it"
    assert any(f"without a word, {falls} (--hold" in line for line in told)
    assert viewer.said[-1] == f"now {falls}" and viewer.held >= 10
    assert result.status == status


@pytest.mark.slow
@in_real_time
def test_a_run_that_is_lost_while_it_comes_to_rest_is_not_completed():
    with paper_machine(kind=Blind, rate=2.0) as running:
        result = driven(running, 1.1, max_missing=0.35)
    assert result.status == "lost_contact" and result.stopped.time > 1.3


def test_advice_after_a_loss_begins_with_what_becomes_of_the_plate():
    end = End("lost_contact", None, "now the motors have no torque: the plate falls")
    assert end.advice.startswith("Now the motors have no torque: the plate falls. Datagrams arrive")
    assert "2 s longer than the delay" in End("left_workspace", None).advice  # else it is refused


@pytest.mark.parametrize(
    ("cranks", "flags", "gravity", "expected"),
    [
        (True, MachineFlags.SAFE_HOLDS, True, "the servos hold their last setpoint"),
        (False, MachineFlags.SAFE_HOLDS, True, "keep their last torque, which holds the plate for"),
        (False, 0, True, "the plate falls unless brakes or a support hold it"),
        (False, 0, False, "the motors have no torque"),
    ],
)
def test_what_becomes_of_the_plate_is_said(cranks, flags, gravity, expected):
    experiment = SimpleNamespace(scenario=scenario_of(f"plant.gravity={gravity}"))
    made = SimpleNamespace(cranks=cranks, experiment=experiment)
    assert expected in Design.left_alone(made, SimpleNamespace(flags=MachineFlags(flags)))


def test_measurements_that_a_simulation_lacks_are_counted_and_leave_its_error():
    lossy = scenario_of("sensor.loss=0.5", "duration=2")
    result = sd.simulate(lossy, judge_stability=False)
    missing = result.summary["counts"]["measurements_missing"]
    assert missing > 5 and result.summary["measured_share"] == pytest.approx(1 - missing / 21)
    assert math.isfinite(result.accumulated_error)
    # Where a leg is silent the others are used.
    one_leg = "sensor={kind: encoders, faults: [{kind: missing, leg: 2, from: 0, to: 2}]}"
    result = sd.simulate(scenario_of(one_leg, "duration=1"), judge_stability=False)
    assert result.summary["counts"]["bad_measurements"] >= 10
    assert result.summary["measured_share"] == 1


@pytest.mark.parametrize("gravity", [False, True])
def test_what_is_uncertain_grows_until_a_leg_may_be_out_of_reach(gravity):
    made = law_of(gravity)
    home = made.plant.mechanism.home
    mean = np.concatenate([home, np.zeros(14)])
    torque = made.plant.dynamics.equilibrium_torque(home)

    def safe(std, span):
        covariance = np.diag(np.concatenate([np.full(12, std), np.full(8, 1e-9)]) ** 2)
        return within_reach(made.plant, Estimate(mean, covariance), torque)(span)

    assert safe(1e-6, 1.0) and not safe(0.1, 0.01)
    spans = np.linspace(0.0, 3.0, 31)
    held = [safe(1e-3, span) for span in spans]
    assert held[0] and held == sorted(held, reverse=True)
    # A covariance of nothing is that of a law without an estimator.
    unknown = np.full((20, 20), np.nan)
    assert within_reach(made.plant, Estimate(mean, unknown), torque)(9.0)


def test_without_forces_the_limit_is_where_three_deviations_of_a_rate_lead():
    made = law_of(False)
    mechanism, rate = made.plant.mechanism, 0.02
    mean = np.concatenate([mechanism.home, np.zeros(14)])
    covariance = np.zeros((20, 20))
    covariance[11, 11] = rate**2  # of the height
    left = mechanism.reach_margins(mechanism.home)
    higher = mechanism.reach_margins(mechanism.home + [0, 0, 0, 0, 0, 1e-6])
    longest = np.min(left / (3 * rate * np.abs(higher - left) / 1e-6))
    for share in (0.99, 1.01):
        estimate = Estimate(mean, covariance)
        within = within_reach(made.plant, estimate, np.zeros(6))(share * longest)
        assert within == (share < 1)
    twice = Estimate(mean, 4 * covariance)
    found = longest_gap(made.plant, twice, np.zeros(6), 0.2)
    assert longest / 2 - 0.2 - 0.8 / 20 < found <= longest / 2 - 0.2 < 1.0
    assert longest_gap(made.plant, estimate, np.zeros(6), 0.2) == 1.0


def law_of(gravity):
    return control_law(prepare(scenario_of(f"plant.gravity={gravity}")))[0]


# ---------------------------------------------------------------- the way


def test_the_way_has_no_jumps_whoever_leads_and_what_is_fixed_does_not_change():
    experiment = prepare(scenario_of())
    motion = make_reference(SineConfig(), 60.0)
    steering = Steering(Governor(experiment.nominal, 10.0), motion, Way.along(motion))
    home = experiment.mechanism.home
    times, states = [], []
    for k in range(160):
        t = 0.1 * k
        target = home + [0.1, 0, 0, 0.01, 0, 0.02] if 40 <= k < 90 else None
        if 40 <= k < 60:
            target += 0.01 * np.sin(k * np.arange(6.0))
        soon = np.linspace(t, t + 0.99, 12)
        before = [steering.way.at(x) for x in soon]
        steering = steering.on(t + 1.0, Request(target))
        np.testing.assert_array_equal(before, [steering.way.at(x) for x in soon])
        fine = t + np.linspace(0, 0.1, 20, endpoint=False)
        times.extend(fine)
        states.extend(steering.way.at(one) for one in fine)
    states = np.array(states)
    steps = np.diff(states, axis=0)
    h = times[1] - times[0]
    assert np.abs(steps[:, POSE] - h * states[:-1, RATES]).max() < 1e-4
    assert np.abs(steps[:, RATES] - h * states[:-1, ACCELERATIONS]).max() < 0.05
    np.testing.assert_allclose(states[1900, POSE], home + [0.1, 0, 0, 0.01, 0, 0.02], atol=1e-3)
    np.testing.assert_allclose(states[-1, POSE], motion.value(times[-1])[:, 0], atol=1e-9)


# ---------------------------------------------------------------- what is refused


@pytest.fixture(scope="module")
def offer():
    """Return a machine's offer, with the link that it came over."""
    with pytest.MonkeyPatch.context() as patch, paper_machine(OVER_A_NETWORK) as running:
        patch.setattr(contacts, "_ENOUGH_TRIPS", 100)
        endpoint = open_endpoint(running.address, None)
        contact = Contact(endpoint, running.address, identity_of(scenario_of()))
        message = call(contact)
        endpoint.close()
        yield message, contact.link


SERVO = ("actuator.kind=servo", "controller.command=cranks")


@pytest.mark.parametrize(
    ("settings", "parts"),
    [
        (("sensor.kind=encoders",), ("sensor state", "sensor encoders, 1 samples, 14 bits")),
        (SERVO, ("actuator torque", "actuator servo")),
        (
            ("mechanism=paper_clear", "controller.period=0.05"),
            ("mechanism paper, period 0.1 s", "mechanism paper_clear, period 0.05 s"),
        ),
    ],
)
def test_a_scenario_of_another_machine_is_refused_by_both_sides(settings, parts):
    with paper_machine() as running:
        with pytest.raises(ConfigError) as refused:
            prepare_session(scenario_of(*settings), running.address)
        host, port = running.address
    machine, controller = parts
    assert str(refused.value) == (
        f"machine at {host}:{port} has {machine}; the controller is designed for {controller}: "
        "expected the same at both ends"
    )
    (said,) = running.lines
    assert said.endswith(f"designed for {controller}; this machine has {machine}")
    assert running.machine.session is None


def test_what_was_identified_does_not_change_the_identity(tmp_path):
    drawing, path = load_mechanism("paper"), tmp_path / "mechanism.yaml"
    found = replace(drawing, rod_lengths=drawing.rod_lengths + 1e-4, drawn=fingerprint(drawing))
    path.write_text(mechanism_yaml(found))
    for settings in (
        ("plant.mechanism=paper_clear", "plant.gravity=true", "delay.steps=3"),
        (f"mechanism={path}",),
    ):
        assert identity_of(scenario_of(*settings)) == identity_of(scenario_of())
    path.write_text(mechanism_yaml(replace(found, drawn=None)))
    assert identity_of(scenario_of(f"mechanism={path}")) != identity_of(scenario_of())


@pytest.mark.parametrize(
    ("name", "setting", "message"),
    [
        ("paper", "tuner.kind=ann", r"^tuner\.kind: got"),
        ("reachy_mini", "controller.estimate=[payload]", r"^controller\.estimate: got .* for live"),
        ("reachy_mini", "actuator.kind=servo", r"^actuator\.kind: got 'servo' for live"),
    ],
)
def test_what_live_cannot_do_is_refused_by_its_field(name, setting, message):
    with pytest.raises(ConfigError, match=message) as said:
        check_controller(load_scenario(name, settings=(setting,)))
    assert "\n" not in str(said.value)


def test_a_link_that_takes_longer_than_the_delay_is_refused(offer):
    message, link = offer
    link = replace(link, trips=deque([0.21, 0.25]))
    with pytest.raises(ConfigError, match=r"^delay\.steps: got 0\.1 s .* delay\.steps=4$"):
        as_seen(scenario_of("delay.steps=1"), link, message)
    network = ("link.kind=network", "link.burst=3")
    with pytest.raises(
        ConfigError, match=r"^link\.playout: got 0\.1 s, with 1 repetition 0\.2 s, .*=0\.3$"
    ):
        as_seen(scenario_of(*network, "link.playout=0.1"), link, message)
    # Where many packets are lost, the default bound leaves out the longest trips.
    link = replace(link, trips=deque([0.01, 0.38]), sent=100, lost=40)
    assert as_seen(scenario_of(*network), link, message).eta >= 0.38


def test_a_delay_estimator_needs_a_wire(offer):
    message, link = offer
    aware = scenario_of("controller.delay_estimator=constant")
    with pytest.raises(ConfigError, match=r"^controller\.delay_estimator: got 'constant'"):
        as_seen(aware, link, message)
    assert as_seen(aware, link, replace(message, flags=message.flags | MachineFlags.WIRE))


def test_a_network_is_refused_for_a_machine_that_simulates_a_wire(offer):
    message, link = offer
    wired = replace(message, flags=message.flags | MachineFlags.WIRE)
    with pytest.raises(ConfigError, match=r"^link\.kind: got 'network' .* link\.kind=network$"):
        as_seen(scenario_of("link.kind=network"), link, wired)


def test_the_tighter_torque_limit_counts(offer):
    message, link = offer
    seen = as_seen(scenario_of(), link, message)
    made = design(seen, replace(message, torque_limit=0.5))
    assert made.torque_limit == made.law.plant.motors.limit == 0.5


@pytest.mark.slow
@in_real_time
def test_a_law_that_is_too_slow_for_its_period_says_so_before_it_starts():
    with paper_machine(OVER_A_NETWORK) as running:
        ready = prepare_session(scenario_of(), running.address)
        took, in_python = ready.design.step
        assert 1e-5 < took < 1.0 and in_python is None
        ready.endpoint.close()
    for seconds in (0.004, 0.0512):
        slow = ready._replace(design=ready.design._replace(step=(seconds, "controller.replan")))
        (told,) = [line for line in plans(slow, 1.0, "paper") if line.startswith("law: ")]
        assert told.startswith(f"law: a step takes {1e3 * seconds:.1f} ms of a period of 100 ms")
        assert "controller.replan is in Python" in told
        assert ("more than 50%: expect missed deadlines" in told) == (seconds > 0.05)
    weak = ready._replace(design=ready.design._replace(torque_limit=1e-3))
    (told,) = [line for line in plans(weak, 1.0, "paper") if line.startswith("warning: the motion")]
    assert "the motors give 1 (the machine's limit)" in told
    # One slow round trip, which decides the delay, is named as an exception.
    link = ready.contact.link
    for longest, named in ((max(link.trips), False), (3 * link.usual, True)):
        link.trips[-1] = longest
        told = " ".join(plans(ready, 1.0, "paper"))
        assert ("the longest is an exception, 95 % take less than" in told) == named
    # Its torques in flight end too soon, too.
    assert any(line.startswith("queue: reference") for line in plans(ready, 1.0, "paper"))


@pytest.mark.parametrize(
    ("settings", "better"),
    [
        (("link.kind=network",), "zero"),
        (("link.kind=network", "plant.gravity=true"), "equilibrium"),
        (("link.kind=network", *FROM_REST), None),
        ((), None),
    ],
)
def test_the_advised_queue_holds_the_plate(settings, better):
    advised = _queue_advice(scenario_of(*settings))
    assert advised is None if better is None else f"--set queue={better}," in advised


def test_a_real_machine_wants_to_be_armed():
    with paper_machine() as running:
        ready = prepare_session(scenario_of(), running.address)
        ready.contact.last = replace(ready.contact.last, flags=MachineFlags.PARKED)
        assert "A REAL MACHINE" in plans(ready, math.inf, "paper")[0]
        with pytest.raises(
            ConfigError, match=r"^--arm: not given, so nothing moved: the link is m"
        ):
            check_armed(ready, False)
        assert readings(ready).startswith("the plate is 0 deg and ")
        assert running.machine.counts["runs"] == 0
        check_armed(ready, True)  # the check has closed nothing
        assert ready.endpoint.fileno() >= 0
        ready.endpoint.close()


def test_the_readings_of_a_parked_machine_stand_beside_those_of_the_start():
    settings = (*PARKED, "sensor.kind=encoders", "sensor.samples=2", "sensor.offset=[1,0,0,0,0,0]")
    with paper_machine(*settings) as running:
        ready = prepare_session(scenario_of(*settings), running.address)
        support = "support the plate: brakes open at the begin, and for 0.8 s"
        assert support not in "\n".join(plans(ready, 1.0, "paper"))
        real = replace(ready.contact.machine, flags=MachineFlags.PARKED)
        ready.contact.last = real
        assert support in "\n".join(plans(ready, 1.0, "paper"))
        read, known = (
            [float(angle) for angle in part.split(" deg")[0].split(", ")]
            for part in re.split("read |are at ", readings(ready))[1:]
        )
        ready.endpoint.close()
        until(lambda: any("said stop" in line for line in running.lines))
    assert np.subtract(read, known) == pytest.approx([57.3, 0, 0, 0, 0, 0], abs=0.11)
    assert running.machine.counts["runs"] == 0


def test_a_machine_that_is_not_parked_is_not_asked_for_its_readings():
    with paper_machine() as running:
        ready = prepare_session(scenario_of(), running.address)
        running.machine._running = True
        assert "not parked" in readings(ready)
        ready.endpoint.close()
        assert running.machine.counts["sessions"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "asks"), [((), True), ((OVER_A_NETWORK,), False), (None, True)]
)
def test_the_jitter_stands_beside_the_margin_and_asks(settings, asks):
    """Late torques act late on a wire; a play-out buffer absorbs jitter. None: an unstable loop."""
    with paper_machine(*(settings or ())) as running:
        ready = prepare_session(scenario_of(*FROM_REST), running.address)
        trips = deque([0.001] * 50 + [0.012])
        ready.contact.link.trips = trips
        if settings is None:
            trips.clear()
            stiff = replace(ready.margin, margins=Margins(math.inf, 0.044, 1.0, 1.0))
            assert "errors from any below 0 to +44 ms;" in " ".join(
                plans(ready._replace(margin=stiff), 1.0, "paper")
            )
            lost = replace(ready.margin, radius=1.1, margins=Margins(0.0, 0.0, 1.0, 1.0))
            ready = ready._replace(margin=lost)
        told = " ".join(plans(ready, 1.0, "paper"))
        if settings is not None:
            assert "stable for delay errors from -1.72 ms to +1.51 ms" in told
            assert "round trips vary by 11 ms (standard deviation 1.53 ms)" in told
            assert "the delay of 0.8 s (8 periods) can be compensated: under any controller" in told
        else:
            assert "this loop is unstable; " in told
        assert ("play-out buffer absorbs" in told) == (not asks)
        assert ("ms: --set delay.steps sets a shorter delay" in told) == (not asks)
        assert ("Remedies: " in told) == asks
        if asks:
            expected = r"^--yes: not given, so nothing moved: (round trips|the loop) .*; expected a"
            with pytest.raises(ConfigError, match=expected):
                drive(ready, 1.0, say=lambda line: None)
        else:
            assert ready.jitter_problem is None
            ready.endpoint.close()
        assert running.machine.counts["runs"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "answer", "status"),
    [((), None, 2), ((), "n\n", 2), ((), "y\n", 0), (("--yes",), None, 0)],
)
def test_live_goes_on_after_an_answer_or_with_yes(monkeypatch, capsys, words, answer, status):
    monkeypatch.setattr(Link, "spread", 0.011)
    stdin = io.StringIO(answer)
    stdin.isatty = lambda: answer is not None
    monkeypatch.setattr("sys.stdin", stdin)
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    with paper_machine() as running:
        where = f"127.0.0.1:{running.address[1]}"
        command = ["live", "paper", "--machine", where, "--no-browser", "--duration", "0.5"]
        assert main([*command, *settings, *words]) == status
        assert running.machine.counts["runs"] == (status == 0)
    lines = capsys.readouterr().err.splitlines()
    assert [line.startswith("error: --yes: not given") for line in lines] == (
        [False] * (answer is not None) + [True] * (status != 0)
    )


def test_what_is_no_number_is_null_on_the_page():
    """JSON has no NaN: a browser's JSON.parse refuses the whole message."""
    board = Readouts()
    board.put({"error": math.nan, "pose": [1.0, math.inf], "limit": None, "missed": 3})
    refused = pytest.fail  # called for NaN and Infinity only
    said = json.loads(next(board.events()), parse_constant=refused)
    assert said == {"error": None, "pose": [1.0, None], "limit": None, "missed": 3}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="PR_SET_PDEATHSIG is Linux's")
def test_the_machine_of_a_demo_ends_with_a_killed_controller():
    parent = """
import multiprocessing, time
from stewart_drake.cli.common import Chosen
from stewart_drake.cli.live import _demo_machine
with _demo_machine(Chosen(), 0.8):
    print(multiprocessing.active_children()[0].pid, flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        group = os.getpgid(child)
        process.kill()
    assert group == child, "a signal to the controller's group does not reach it"
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or " Z " in state.read_text():
            return
        time.sleep(0.05)
    os.kill(child, signal.SIGKILL)
    pytest.fail("the child is still there 5 s after its parent was killed")


@pytest.mark.slow
def test_the_demo_runs_unattended_and_shows_its_jitter(capsys, tmp_path):
    """The name of the scenario's file may be anything."""
    named = tmp_path / "machine paper at 127.0.0.1:7: x.yaml"
    named.write_text("mechanism: paper")
    log = tmp_path / "l.csv"
    words = ["--demo", "--no-browser", "--duration", "1", "--log", str(log)]
    assert main(["live", str(named), *words]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "round trips vary by" in said and "play-out buffer absorbs" in said
    assert "at 1.0 s: coming to rest, within 8 s; Ctrl-C stops at once" in said
    shown = f"log written to {log}: stewart-drake replay {log}"
    assert f"now the motors have no torque {shown} status completed" in said
    packets = re.search(r"packets (\d+) sent, \d+ lost, \d+ played, \d+ dry", said)
    assert packets is not None and int(packets[1]) == 10


def test_the_duration_of_a_simulation_is_refused(capsys):
    assert main(["live", "paper", "--demo", "--set", "duration=1"]) == 2
    said = "error: --set: duration: got '1'; expected --duration SECONDS\n"
    assert capsys.readouterr().err == said


MOTIONS = {
    "out of reach": "0,0.38 1,0.39 2,0.38 3,0.38 9,0.6 12,0.6",
    "still moving": "0,0.38 0.5,0.375 1,0.37 2,0.36",
    "sines": "reference={amplitude: [0, 0, 0, 0, 0.07, 0.09], frequency: [1, 1, 1, 1, 0.31, 1]}",
}


@pytest.mark.parametrize(
    ("motion", "seconds", "problem"),
    [
        ("out of reach", 2.0, None),
        ("out of reach", 8.0, "reached the end of its reach at t = "),
        ("still moving", 1.5, None),
        ("still moving", 2.5, "expected samples that come to rest"),
        ("still moving", math.inf, "expected samples that come to rest"),
        ("sines", 10.0, None),
        ("sines", math.inf, "reached the end of its reach at t = "),
    ],
)
def test_a_motion_is_checked_up_to_the_end_of_the_run(tmp_path, motion, seconds, problem):
    """The scenario's duration is shorter."""
    setting = MOTIONS[motion]
    if motion != "sines":
        heads = "time[s],roll[rad],pitch[rad],yaw[rad],x[m],y[m],z[m]\n"
        rows = setting.replace(",", ",0,0,0,0,0,").replace(" ", "\n")
        path = written(tmp_path / "motion.csv", heads + rows)
        setting = f"reference={{kind: csv, file: {path}}}"
    experiment = prepare(scenario_of("duration=1.5", setting))
    if problem is None:
        check_whole_motion(experiment, seconds)
        return
    design = SimpleNamespace(experiment=experiment)
    with pytest.raises(ConfigError, match=problem):
        drive(SimpleNamespace(design=design, simulated=True, jitter_problem=None), seconds)


def test_a_demo_that_cannot_start_says_why(capsys):
    wrong = ("--set", "sensor={kind: encoders, samples: 20}")
    assert main(["live", "paper", "--demo", "--no-browser", *wrong]) == 2
    assert capsys.readouterr().err.startswith("error: sensor.samples: got 20; expected at most 16")


@pytest.mark.parametrize(("eta", "room"), [(0.8, 0.159), (0.08, 0.049), (0.03, 0.03)])
def test_a_demo_leaves_time_for_computing(eta, room):
    low, high = transit_times(eta)
    assert 0 <= low <= high < 0.401 * eta and eta - 2 * high >= room


@pytest.mark.parametrize("text", ["localhost", "127.0.0.1:", "127.0.0.1:0", ":7000", "a b:7000"])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match=r"^--machine: got"):
        parse_address(text)


def test_beyond_loopback_a_key_is_needed():
    with pytest.raises(ConfigError, match="without a key"):
        open_endpoint(("192.0.2.1", 7000), None)


@pytest.mark.slow
def test_nobody_there_is_reported(monkeypatch):
    monkeypatch.setattr(contacts, "_PATIENCE", 0.3)
    endpoint = Endpoint(ControllerMessage, "127.0.0.1", 0)
    try:
        with pytest.raises(
            ConfigError, match="where nothing answers, or a machine with another key"
        ):
            prepare_session(scenario_of(), endpoint.address)
    finally:
        endpoint.close()


@pytest.mark.slow
@in_real_time
def test_what_came_while_nobody_looked_is_not_lost():
    with paper_machine(OVER_A_NETWORK.replace("loss: 0.02", "loss: 0")) as running:
        endpoint = open_endpoint(running.address, None)
        contact = Contact(endpoint, running.address, identity_of(scenario_of()))
        call(contact)
        time.sleep(0.5)  # a round trip takes 0.2 s: some ten answers are on their way
        await_free(contact)
        endpoint.close()
    assert contact.link.loss_back < 0.01


def test_round_trips_and_losses_are_those_of_the_link(offer):
    link = offer[1]
    assert isinstance(link, Link)
    assert 0.2 <= link.shortest <= link.typical <= link.longest
    assert link.typical == pytest.approx(0.22, abs=0.03)
    assert 0 <= link.loss_there < 0.2 and 0 <= link.loss_back < 0.2
    assert link.packets_lost == 0, "a request counts as a packet"


# ---------------------------------------------------------------- the page


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"{",
        b'{"target": [1, 2]}',
        b'{"target": [1, 2, 3, 4, 5, NaN]}',
        b'{"target": [1, 2, 3, 4, 5, true]}',
        b'{"stop": 1}',
        b'{"target": "home"}',
        b'{"target": [0, 0, 0, 0, 0, %s]}' % (b"9" * 400),
        b'{"target": [0, 0, 0, 0, 0, %s]}' % (b"9" * 4400),
        b"[" * 3000,
        b'{"target": ' + b"[" * 3000,
    ],
)
def test_what_is_no_wish_is_refused(data):
    with pytest.raises(ValidationError):
        PageRequest.model_validate_json(data, strict=True)


@pytest.fixture
def viewer():
    with closing(PageViewer(load_mechanism("paper"), "live: a test")) as made:
        yield made


@pytest.mark.slow
def test_ctrl_c_while_the_page_starts_ends_only_the_loop(viewer):
    os.kill(viewer._process.pid, signal.SIGINT)
    assert viewer.opened().startswith("http://")


@pytest.mark.slow
def test_the_page_does_what_its_own_buttons_ask_for_and_nobody_else(viewer, capfd):
    """No request causes a traceback, and the loop goes on without a page."""
    url = viewer.opened()
    address, token = url.split("/?token=")
    page = urllib.request.urlopen(url).read().decode()
    assert "live: a test" in page and page.count('type="range"') == 6

    def ask(headers, body=b'{"target": [0, 0, 0, 0, 0, 400]}'):
        request = urllib.request.Request(f"{address}/wish", body, headers)
        try:
            return urllib.request.urlopen(request).status
        except urllib.error.HTTPError as error:
            return error.code

    assert ask({}) == ask({"X-Token": "guess"}) == 403
    assert ask({"X-Token": token, "Host": "elsewhere.example:80"}) == 403
    assert ask({"X-Token": token}, b"nonsense") == 400
    assert viewer.request() == Request() and not viewer.stopped()
    assert ask({"X-Token": token}) == 200
    np.testing.assert_allclose(viewer.request().target, [0, 0, 0, 0, 0, 0.4])
    assert ask({"X-Token": token}, b'{"target": [1e303, -1e303, 0, 0, 0, 400]}') == 200
    low, high = slider_range(load_mechanism("paper")) / FACTORS
    np.testing.assert_allclose(viewer.request().target, [high[0], low[1], 0, 0, 0, 0.4])
    assert ask({"X-Token": token}, b'{"target": [18, 0, 0, 0, 0, 400]}') == 200
    np.testing.assert_allclose(viewer.request().target, [math.pi / 10, 0, 0, 0, 0, 0.4])
    assert ask({"X-Token": token}, b'{"target": null, "stop": true}') == 200
    assert viewer.request() == Request()
    assert viewer.stopped()
    host, port = address.removeprefix("http://").split(":")

    def answer(text):
        with socket.create_connection((host, int(port)), 10.0) as connection:
            connection.sendall(text.encode())
            connection.shutdown(socket.SHUT_WR)
            return connection.recv(4096).split()[1:2]

    known = f"Host: {host}:{port}\r\nX-Token: {token}\r\n"
    for length, body, status in ((3000, "[" * 3000, b"400"), ("9" * 5000, "", b"413")):
        asked = f"POST /wish HTTP/1.0\r\n{known}Content-Length: {length}\r\n\r\n{body}"
        assert answer(asked) == [status]
    assert answer(f"GET http://[ HTTP/1.0\r\n{known}\r\n") == [b"400"]
    viewer.close()
    assert "Traceback" not in capfd.readouterr().err
    for _ in range(3):
        viewer.show(seen_at(0.0))
        assert viewer.request() is not None


def seen_at(time, error=0.1, torque=0.5, unmeasured=0.0):
    """Return a sample of a plate at home."""
    state = np.concatenate([load_mechanism("paper").home, np.zeros(6)])
    wanted, torques = np.append(state, np.zeros(6)), np.full(6, torque)
    last = 0, unmeasured, 0, None, False, None
    return Snapshot(time, state, wanted, torques, error, *[0.1] * 4, *last)


def test_a_page_whose_loop_has_ended_ends_without_a_traceback(monkeypatch):
    """`live` with a machine that does not answer has ended before its page is there."""
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    loop, page = multiprocessing.Pipe()
    loop.close()
    serve(page, load_mechanism("paper"), "a test")


@pytest.mark.slow
@needs_chromium
def test_after_a_loss_the_page_shows_reason_last_seconds_and_advice(tab, viewer):
    tab.open(viewer.opened(), 400, 800)
    for k in range(30):  # 6 s; the last 5 are shown
        viewer.show(seen_at(0.2 * k, error=10.0 if k < 4 else 0.2 * k, torque=0.5))
        tab.wait(f"window.live !== undefined && window.live.time >= {0.2 * k - 0.3}")
        time.sleep(0.1)
    viewer.show(seen_at(6.0, error=math.nan, unmeasured=0.2))
    tab.wait("window.live.time === 6")
    assert tab.evaluate("document.getElementById('error').textContent") == "unknown"
    note = tab.evaluate("document.getElementById('note').textContent")
    assert "no usable measurement for 0.2 s: the picture is the model's" in note
    failure = Failure(5.8, 3, -0.1, "crank 3 passed its dead centre")
    viewer.ended(End("left_workspace", failure))
    tab.wait("document.body.classList.contains('over') && !document.getElementById('last').hidden")
    note = tab.evaluate("document.getElementById('note').textContent")
    assert "left workspace" in note and "crank 3 passed its dead centre" in note
    assert "Bring the plate back to its start" in note and "identify LOG" in note
    assert "a larger controller.w_R tolerates more" in note
    assert "The picture is of the last sample" in note
    assert not tab.evaluate("document.getElementById('sliders').getClientRects().length")
    assert "last torques before the end" in tab.evaluate(
        "document.getElementById('full').textContent"
    )
    colors = "[...document.querySelectorAll('.bars i')].map(x => getComputedStyle(x).background)"
    assert "rgb(213, 94, 0)" not in " ".join(tab.evaluate(colors))
    last = tab.evaluate("document.getElementById('last').textContent")
    span = float(last.split("last ")[1].split(" s:")[0])
    assert 4.5 < span <= 5.0, "not the last seconds"
    # A busy page may skip one picture, as the loop above does not wait for the last.
    shown = re.search(r"at most (5\.[68])0? %; measured until (5\.[68]) s", last)
    assert shown is not None and shown[1] == shown[2] and "at most 0.500 N m" in last
    points = tab.evaluate("document.querySelector('#last polyline').points.length")
    assert points > 20
    for width in (400, 1280):
        tab.resize(width, 800)
        assert tab.evaluate("document.documentElement.scrollWidth") == width
    assert tab.evaluate("[...document.querySelectorAll('input, button')].every(x => x.disabled)")
    assert tab.errors == []
    viewer.close()  # and with it Meshcat's server
    time.sleep(1.5)
    scene = "document.querySelector('iframe').contentDocument"
    banner = f"getComputedStyle({scene}.getElementById('status-message')).display"
    assert tab.evaluate(banner) == "none"
    assert tab.evaluate(f"{scene}.querySelector('canvas') !== null")


@pytest.mark.slow
@needs_chromium
def test_after_a_run_the_page_says_what_becomes_of_the_plate(tab, viewer):
    tab.open(viewer.opened(), 400, 800)
    viewer.show(seen_at(1.0, error=1e-6))
    tab.wait("window.live !== undefined")
    assert tab.evaluate("document.getElementById('error').textContent") == "< 0.01 %"
    viewer.ended(End("completed", None, "now the motors have no torque"))
    tab.wait("document.body.classList.contains('over')")
    tab.wait("document.querySelector('iframe').style.visibility === 'visible'")
    note = "document.getElementById('note')"
    assert tab.evaluate(f"{note}.textContent") == "completed. Now the motors have no torque."
    assert not tab.evaluate(f"{note}.classList.contains('warn')")
    assert tab.evaluate("document.getElementById('last').hidden") and tab.errors == []


@pytest.mark.slow
@needs_chromium
def test_the_page_is_driven_by_keys_alone_on_a_narrow_screen(tab, viewer):
    tab.open(viewer.opened(), 400, 800)
    viewer.show(seen_at(1.0))
    tab.wait("window.live !== undefined")
    sides = "[...document.querySelectorAll('input, button, dd')]"
    sides += ".map(x => x.getBoundingClientRect())"
    assert tab.evaluate(f"{sides}.every(x => x.left >= 0 && x.right <= 400 && x.width > 20)")

    tab.go_to("document.getElementById('s2')")
    before = float(tab.evaluate("document.activeElement.value"))
    for _ in range(10):
        tab.press("ArrowRight")
    until(lambda: viewer.request().target is not None, 60.0)
    until(lambda: abs(np.rad2deg(viewer.request().target[2]) - before - 1.0) < 0.05, 60.0)
    tab.go_to("document.getElementById('motion')")
    tab.press("Space")
    until(lambda: viewer.request().target is None, 60.0)
    tab.go_to("document.getElementById('stop')")
    tab.press("Enter")
    until(lambda: (viewer.request(), viewer.stopped())[1], 60.0)
    assert tab.errors == []


@pytest.mark.slow
@needs_chromium
def test_a_gamepad_moves_the_reference(viewer):
    """One that the page sees in the place of a true one: a button turns the plate about yaw."""
    ends, results = threading.Event(), []
    with paper_machine() as running, browser() as tab:
        how = {"viewer": viewer, "ending": ends.is_set}
        url = viewer.opened()  # before the loop, which reads from the page, too
        driving = threading.Thread(target=lambda: results.append(driven(running, math.inf, **how)))
        driving.start()
        try:
            tab.call("Page.navigate", url=url)
            tab.wait("window.live !== undefined && window.live.time > 1")
            assert not tab.evaluate("window.live.byHand")
            yaw = "+document.getElementById('s2').value"
            tab.evaluate(  # let go by itself: beyond the reach it would not be followed
                f"window.pressed = () => {yaw} > 16 ? 0 : 1; "
                "navigator.getGamepads = () => [null, { axes: [0, 0, 0, 0], "
                "buttons: [0, window.pressed(), 0, 0, 0, 0, 0, 0].map(value => ({ value })) }]"
            )
            tab.wait(f"window.live.byHand && {yaw} > 16")
            asked = "[...document.querySelectorAll('#sliders input')].map(input => +input.value)"
            tab.wait(f"{asked}.every((x, k) => Math.abs(x - window.live.wanted[k]) < 0.5)")
            assert tab.evaluate("window.live.wanted[2]") > 15.5  # farther than the motion goes
        finally:
            ends.set()
            driving.join()
        assert tab.errors == []
    assert results[0].status == "interrupted"  # it came to rest where it was led
