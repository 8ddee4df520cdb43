"""What somebody meets at a prompt: public names, and objects that say in a line what they are."""

import pytest

import stewart_drake as sd
from stewart_drake.loop.experiment import prepare

SETTINGS = ("plant.kind=exact", "duration=0.1")


def test_only_public_names_are_listed():
    assert sorted(dir(sd)) == sorted(sd.__all__)
    for name in dir(sd):
        assert getattr(sd, name) is not None
    assert sorted(dir(sd)) == sorted(sd.__all__), "more of them after they were used"


def test_a_scenario_tells_what_is_not_as_usual():
    assert repr(sd.Scenario()) == "Scenario()"
    scenario = sd.load_scenario("paper", settings=SETTINGS)
    assert repr(scenario) == "Scenario(duration=0.1, plant.kind='exact')"
    long = sd.load_scenario(
        "paper", settings=("sensor.noise_std=[" + "0.00123456789, " * 11 + "0]",)
    )
    assert "sensor.noise_std=[0.00123" in repr(long) and len(repr(long)) < 100


def test_results_tell_how_it_went():
    run = sd.simulate(sd.load_scenario("paper", settings=SETTINGS))
    assert repr(run) == (
        f"SimulationResult(completed, E_ac={run.accumulated_error:.4g}, "
        "Scenario(duration=0.1, plant.kind='exact'))"
    )
    lost = sd.simulate(sd.load_scenario("paper", "delay_lqi", ("plant.kind=exact",)))
    assert lost.failure in repr(lost) and "left_workspace" in repr(lost)


@pytest.mark.parametrize("name", ["paper", "desktop", "motion_base"])
def test_machines_and_what_is_made_of_them_fit_a_line_or_two(name):
    machine = sd.load_mechanism(name)
    assert name in repr(machine) and f"{1e3 * machine.crank_lengths[0]:.4g} mm" in repr(machine)
    assert "gravity 9.81" in repr(sd.StewartDynamics(machine))
    assert repr(machine) in repr(prepare(sd.load_scenario(name)))
    for thing in (machine, sd.StewartDynamics(machine), prepare(sd.load_scenario(name))):
        assert len(repr(thing)) < 400 and "\n" not in repr(thing)
