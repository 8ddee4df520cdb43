"""What a network takes for granted: its times, its bound, and where they are stated."""

import json

import pytest

import stewart_drake as sd
from stewart_drake.cli import main
from stewart_drake.loop.bulk import preparation_of
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.scenario.link import forward_times, link_text
from stewart_drake.scenario.link_config import NetworkConfig
from stewart_drake.scenario.loading import scenario_yaml
from stewart_drake.studies.uncertainty import MACHINE, apply_draw

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


def test_what_runs_have_in_common_knows_the_times():
    """Two networks with one bound, so that only the weighing of packets differs."""
    one, other = (network(f"delay.steps={n}", "link.playout=0.9") for n in (4, 8))
    assert preparation_of(one) is preparation_of(one)
    assert preparation_of(one) is not preparation_of(other)


def test_a_controller_without_a_delay_may_drive_a_network():
    assert network(controller="lqi").controller.delay_steps == 0


WORDS = ["--set", "link.kind=network", "--set", "plant.kind=exact", "--set", "duration=0.3"]


def check_stated(command, out, capsys):
    """Run a command, and find the link in what it prints and in each summary."""
    text = "link: network, packets take 0.64 to 0.96 s (0.8 to 1.2 times the delay of 0.8 s, as"
    stated = {"kind": "network", "low": 0.64, "high": 0.96, "loss": 0.05, "burst": 1, "playout": 1}
    assert main([*command, "paper", *WORDS, "--out", str(out)]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count(text) == 1 and "5 % lost, play-out bound 1 s" in printed
    summary = json.loads((out / "summary.json").read_text())
    for found in summary.get("controllers", {"": summary}).values():
        assert stated.items() <= found["link"].items() and found["link"]["seed"] == 0


def test_simulate_states_the_link(tmp_path, capsys):
    check_stated(["simulate"], tmp_path, capsys)


@pytest.mark.slow
@pytest.mark.parametrize("command", [["compare"], ["analyze", "link", "--runs", "1"]])
def test_studies_state_the_link(command, tmp_path, capsys):
    check_stated(command, tmp_path, capsys)


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
