"""The link as it is: a delay that drifts, swings, jumps and jitters, against brute force."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from scipy.integrate import solve_ivp

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.loop.bulk import preparation_of
from stewart_drake.loop.cautions import idle_delay
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.link import DelayChain, VaryingDelay
from stewart_drake.loop.preparation import prepare
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.config import DelayConfig
from stewart_drake.scenario.link import (
    delay_at,
    forward_times,
    link_text,
    takes_effect,
    torque_delays,
)
from stewart_drake.scenario.link_config import NetworkConfig
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.scenario.timing import Delay
from stewart_drake.studies.uncertainty import MACHINE, apply_draw

PERIOD = 0.1
LONG = ("plant.kind=exact", "start=on_reference", "queue=reference")


class Numbers(LeafSystem):
    """Puts out the number of the sample, and 1000 before t = 0."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorOutputPort("number", 6, self._output, {self.time_ticket()})

    def _output(self, context, output):
        output.SetFromVector(np.full(6, round(context.get_time() / PERIOD)))


def scenario(*more):
    return sd.load_scenario("paper", settings=(*LONG, *more))


def bare(delays, before):
    """Return a link alone; the torque of sample k is k, also where it was sent before t = 0."""
    builder = DiagramBuilder()
    source = builder.AddSystem(Numbers())
    queue = np.repeat(np.arange(-before.queue_length, 0.0)[:, None], 6, axis=1)
    link = builder.AddSystem(VaryingDelay(PERIOD, delays, before, queue))
    builder.Connect(source.get_output_port(), link.GetInputPort("commanded"))
    return Simulator(builder.Build()), link


def newest(arrivals, t):
    """Return the newest torque that has arrived by t, 0 if none."""
    return max((k for k, arrival in arrivals.items() if arrival <= t), default=0)


# What acts when.


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), kind=st.sampled_from(["walk", "white", "short", "grid"]))
def test_what_acts_is_the_newest_torque_that_has_arrived(seed, kind):
    """Overtaking, arrivals at samples and no delay at all among them."""
    rng = np.random.default_rng(seed)
    n = 25
    before = Delay(int(rng.integers(0, 5)), float(rng.choice([0.0, 0.3])))
    eta = before.eta(PERIOD)
    delays = {
        "walk": eta + np.cumsum(0.05 * rng.standard_normal(n)),
        "white": eta + 0.2 * rng.standard_normal(n),
        "short": 0.05 * rng.standard_normal(n),
        "grid": PERIOD * rng.integers(0, 6, n),
    }[kind]
    delays = np.maximum(delays, 0.0)
    arrivals = {k: k * PERIOD + float(delays[k]) for k in range(n)}
    arrivals |= {k: k * PERIOD + eta for k in range(-before.queue_length, 0)}
    simulator, link = bare(delays, before)
    context = link.GetMyContextFromRoot(simulator.get_context())
    simulator.Initialize()
    near = 1e-9
    for t in sorted({a for a in arrivals.values() if 0 < a < n * PERIOD}):
        for at in (t - near, t + near):
            if at >= simulator.get_context().get_time():
                simulator.AdvanceTo(at)
                torque = link.GetOutputPort("torque").Eval(context)
                expected = newest(arrivals, simulator.get_context().get_time())
                if before.queue_length or expected:
                    assert torque == pytest.approx(np.full(6, expected), abs=0)
        sent = min(int((t + near) / PERIOD + 1e-9), n - 1)
        assert link.GetOutputPort("delay").Eval(context) == pytest.approx(delays[sent], abs=1e-10)


@pytest.mark.parametrize(("steps", "fraction"), [(0, 0.0), (0, 0.4), (3, 0.0), (8, 0.5)])
def test_a_constant_delay_is_the_delay_chain(steps, fraction):
    before = Delay(steps, fraction)
    simulator, link = bare(np.full(40, before.eta(PERIOD)), before)
    builder = DiagramBuilder()
    source = builder.AddSystem(Numbers())
    queue = np.repeat(np.arange(-before.queue_length, 0.0)[:, None], 6, axis=1)
    chain = builder.AddSystem(DelayChain(PERIOD, steps, fraction, queue))
    builder.Connect(source.get_output_port(), chain.get_input_port())
    plain = Simulator(builder.Build())
    of_chain = chain.GetMyContextFromRoot(plain.get_context())
    of_link = link.GetMyContextFromRoot(simulator.get_context())
    for t in np.arange(1, 300) * 0.01 + 1e-6:
        simulator.AdvanceTo(t)
        plain.AdvanceTo(t)
        expected = chain.get_output_port().Eval(of_chain)
        assert np.array_equal(link.GetOutputPort("torque").Eval(of_link), expected)


def test_a_torque_that_was_overtaken_never_acts():
    # Sent at 0, 1, 2, 3 s: the second comes after the third, the fourth together with the third.
    assert takes_effect(np.array([0.5, 4.0, 3.5, 3.5])).tolist() == [True, False, False, True]
    assert takes_effect(np.array([0.5, np.inf, 3.5])).tolist() == [True, False, True]


# The delay as a function of the sending time.


def test_drift_swing_and_jump_add_up():
    delay = DelayConfig(
        steps=3, drift=0.02, swing=0.05, swing_frequency=2.0, jump=-0.1, jump_time=4.0
    )
    t = np.array([-1.0, 0.0, 1.0, 3.999, 4.0, 7.0])
    expected = [
        0.3,
        0.3,
        0.3 + 0.02 + 0.05 * np.sin(2.0),
        0.3 + 0.02 * 3.999 + 0.05 * np.sin(2 * 3.999),
        0.3 + 0.08 + 0.05 * np.sin(8.0) - 0.1,
        0.3 + 0.14 + 0.05 * np.sin(14.0) - 0.1,
    ]
    assert delay_at(delay, 0.1, t) == pytest.approx(np.array(expected), abs=1e-15)
    assert delay_at(DelayConfig(steps=1, jump=-5.0), 0.1, np.array([1.0])) == 0.0


def test_jitter_is_white_seeded_and_never_before_its_time():
    many = ("duration=1000", "delay.jitter_std=0.01")
    jitter = torque_delays(scenario(*many)) - 0.8
    n = len(jitter)
    assert n == 10001
    assert abs(jitter.mean()) < 4 * 0.01 / np.sqrt(n)
    assert abs(jitter.std() / 0.01 - 1) < 4 / np.sqrt(2 * n)
    assert abs(np.corrcoef(jitter[:-1], jitter[1:])[0, 1]) < 4 / np.sqrt(n)
    assert np.array_equal(torque_delays(scenario(*many)) - 0.8, jitter)
    assert np.array_equal(torque_delays(scenario("duration=10", *many[1:])) - 0.8, jitter[:101])
    assert not np.any(jitter == torque_delays(scenario(*many, "delay.seed=1")) - 0.8)
    clipped = torque_delays(scenario("delay.steps=0", *many))
    assert clipped.min() == 0
    assert abs(np.mean(clipped == 0) - 0.5) < 4 * 0.5 / np.sqrt(n)


# On the plants.


@pytest.mark.parametrize(
    "course",
    [
        ("delay.drift=0.05",),
        ("delay.jitter_std=0.03", "delay.swing=0.05"),
        ("delay.jump=-0.23", "delay.jump_time=0.5", "delay.steps=4"),
    ],
)
def test_the_exact_plant_stops_at_every_arrival(course):
    """Against scipy from arrival to arrival, with the torques that the loop sent, to 1e-9."""
    sc = scenario("duration=1.65", "plant.accuracy=1e-11", *course)
    loop = build_closed_loop(sc)
    simulator = make_simulator(loop)
    context = simulator.get_context()
    period, n = sc.controller.period, 17
    simulator.Initialize()
    sent, start = {}, loop.experiment.start
    delays = torque_delays(sc)
    eta, before = sc.eta, sc.true_delay.queue_length
    first = loop.experiment.torques_in_flight(sc.true_delay)
    sent |= {k - before: first[k] for k in range(before)}
    for k in range(n):
        simulator.AdvanceTo(k * period + 1e-12)
        sent[k] = loop.GetOutputPort("torque_commanded").Eval(context)
    simulator.AdvanceTo(1.65)
    arrivals = {k: k * period + float(delays[k]) for k in range(n)}
    arrivals |= {k: k * period + eta for k in range(-before, 0)}
    dynamics, x, t = loop.experiment.nominal, start, 0.0
    for end in sorted({a for a in arrivals.values() if 0 < a < 1.65} | {1.65}):
        torque = sent[int(newest(arrivals, (t + end) / 2))]

        def change(_, x, torque=torque):
            return np.concatenate([x[6:], dynamics.accelerations(x[:6], x[6:], torque)])

        x = solve_ivp(change, (t, end), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        t = end
    assert loop.GetOutputPort("state").Eval(context) == pytest.approx(x, abs=1e-9)


def test_the_multibody_plant_feels_torques_at_its_nearest_step():
    settings = ("plant.kind=multibody", "plant.time_step=0.005", "duration=1.3")
    sc = scenario(*settings, "delay.jitter_std=0.02", "log_period=0.005", "delay.steps=2")
    signals = sd.simulate(sc, judge_stability=False).signals
    exact = torque_delays(scenario("duration=1.3", "delay.jitter_std=0.02", "delay.steps=2"))
    arrivals = 0.005 * np.round((0.1 * np.arange(14) + exact) / 0.005)
    applied = signals.torque_applied.values
    commanded = signals.torque_commanded.values[::20]
    for at, torque in zip(signals.time.values, applied, strict=True):
        here = [k for k in range(14) if arrivals[k] <= at + 1e-9]
        if here:
            assert np.array_equal(torque, commanded[max(here)])
    assert np.allclose(signals.delay_true.values[::20], arrivals - 0.1 * np.arange(14), atol=1e-12)


def test_the_record_shows_the_delay():
    signals = sd.simulate(scenario("duration=1", "delay.drift=0.01"), judge_stability=False).signals
    sent = np.floor(signals.time.values / 0.1 + 1e-9) * 0.1
    assert signals.delay_true.values == pytest.approx(0.8 + 0.01 * sent, abs=1e-12)
    assert signals.delay_true.attrs["units"] == "s"
    plain = sd.simulate(scenario("duration=0.3"), judge_stability=False)
    assert np.all(plain.signals.delay_true.values == 0.8)
    assert np.isnan(plain.signals.packets.values).all() and plain.summary["packets"] == {}


pytestmark = pytest.mark.usefixtures("blank_figures")

EXACT = ("plant.kind=exact", "start=on_reference", "queue=reference")


def network(*settings, controller=None):
    return sd.load_scenario("paper", controller, (*EXACT, "link.kind=network", *settings))


def times(scenario):
    link = scenario.assumed_link
    assert isinstance(link, NetworkConfig)
    return link.low, link.high


def test_without_times_packets_take_about_the_scenarios_delay(tmp_path):
    assert times(network()) == (0.64, 0.96)
    assert times(network("delay.steps=4")) == (0.32, 0.48)
    assert times(network("delay.steps=4", "delay.fraction=0.5")) == pytest.approx((0.36, 0.54))
    assert times(network("link.low=0.5", "link.high=0.9", "delay.steps=4")) == (0.5, 0.9)
    apart = network("link.low=0.5", "link.high=0.9", "link.playout=0.9", "delay.steps=4")
    assert "0.4 s, have no effect" in idle_delay(apart) and "the delay 1 s" in idle_delay(apart)
    assert idle_delay(network("delay.steps=4")) is None
    # The link of an overlay overrides a file's delay.
    file, overlay = tmp_path / "scenario.yaml", tmp_path / "radio.yaml"
    file.write_text("mechanism: paper\ndelay: {steps: 4}\n")
    overlay.write_text("link: {kind: network, low: 0.5, high: 0.9, playout: 0.9}\n")
    assert idle_delay(sd.load_scenario(file, settings=[f"overlay={overlay}"])) is None
    file.write_text(file.read_text() + overlay.read_text())
    assert idle_delay(sd.load_scenario(file)) is not None
    under_way = forward_times(network("link.loss=0"), 2000)
    assert 0.64 <= under_way.min() < 0.645 and 0.955 < under_way.max() <= 0.96
    # They follow the delay wherever it is changed, and in a file that is read back.
    scenario = network("delay.steps=4")
    scenario.delay.steps = 6
    assert times(scenario) == pytest.approx((0.48, 0.72))
    file = tmp_path / "scenario.yaml"
    file.write_text(scenario_yaml(scenario))
    assert times(sd.load_scenario(file)) == times(scenario)
    law = compose_law(prepare(network("delay.steps=4", "link.playout=0.9")))
    other = compose_law(prepare(network("link.playout=0.9")))
    assert law.timeline == other.timeline
    assert law.channel != other.channel


def test_runs_with_one_preparation_know_their_own_times():
    """Two networks with one bound: only the probabilities of the packets differ."""
    one, other = (network(f"delay.steps={n}", "link.playout=0.9") for n in (4, 8))
    common = preparation_of(one)
    assert preparation_of(other) is common
    channels = [common.prepared(common.experiment(each)).law.channel for each in (one, other)]
    assert channels[0] != channels[1]
    assert channels == [compose_law(prepare(each)).channel for each in (one, other)]


def test_a_controller_without_a_delay_may_drive_a_network():
    assert network(controller="lqi").controller.delay_steps == 0


WORDS = ["--set", "link.kind=network", "--set", "plant.kind=exact", "--set", "duration=0.3"]


@pytest.mark.parametrize(
    "command",
    [
        ["simulate"],
        pytest.param(["compare"], marks=pytest.mark.slow),
        pytest.param(["analyze", "link", "--runs", "1"], marks=pytest.mark.slow),
    ],
)
def test_commands_state_the_link_and_count_packets(command, tmp_path, capsys):
    """In what they print and in each summary."""
    text = "link: network, packets take 0.64 to 0.96 s (0.8 to 1.2 times the delay of 0.8 s, as"
    stated = {"kind": "network", "low": 0.64, "high": 0.96, "loss": 0.05, "burst": 1, "playout": 1}
    assert main([*command, "paper", *WORDS, "--out", str(tmp_path)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count(text) == 1 and "5 % lost, play-out bound 1 s" in printed
    summary = json.loads((tmp_path / "summary.json").read_text())
    for found in summary.get("controllers", {"": summary}).values():
        assert stated.items() <= found["link"].items() and found["link"]["seed"] == 0
    if command == ["simulate"]:
        assert summary["packets"] == {"sent": 4, "lost": 0, "late": 0, "played": 0, "dry": 0}
        assert "packets 4 sent, 0 lost, 0 late, 0 played, 0 dry" in printed
        assert "if every packet is in time, this loop is stable: linearised" in printed
    if "link" in command:  # it goes on from its runs
        assert main([*command, "paper", *WORDS, "--out", str(tmp_path)]) == 0
        again = json.loads((tmp_path / "summary.json").read_text())
        assert again == summary and len(list((tmp_path / "runs").glob("bound*.json"))) > 10


def test_a_wire_says_that_it_is_one():
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", "duration=0.2"))
    assert link_text(scenario) is None
    assert sd.simulate(scenario, judge_stability=False).summary["link"] == {"kind": "wire"}


def test_machines_that_are_drawn_keep_the_network():
    """Delay and jitter are of a wire: over a network they neither change nor break the link."""
    scenario = network()
    one = {"delay": 0.02, "jitter": 0.003, "link_seed": 1}
    other = apply_draw(MACHINE, scenario, load_mechanism("paper"), one).as_scenario()
    other.check()
    assert other.assumed_link == scenario.assumed_link
