"""A plant that is not what the controller knows: friction, an eccentric payload, other lengths."""

import dataclasses

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.servos import crank_mobility
from stewart_drake.loop.cautions import cautions_before
from stewart_drake.loop.diagram import build_closed_loop
from stewart_drake.loop.law_design import compose_law
from stewart_drake.loop.platforms import MultibodyStewart
from stewart_drake.loop.preparation import prepare, simulated_machine
from stewart_drake.loop.simulation import make_simulator
from stewart_drake.mechanism.files import mechanism_yaml
from stewart_drake.scenario.signals import COULOMB, NUM_PARAMETERS, PARAMETERS, PAYLOAD
from tests.mechanisms import PAPER

ON_REFERENCE = ("start=on_reference", "queue=reference")
ROUGH = (
    "plant.coulomb_friction=1e-3",
    "plant.payload_mass=0.4",
    "plant.payload_position=[0.03, -0.02, 0.05]",
)


def run(*settings, controller="delay_lqi", **more):
    scenario = sd.load_scenario("paper", controller, (*ON_REFERENCE, *settings))
    return sd.simulate(scenario, judge_stability=False, **more)


def test_both_plants_go_the_same_way():
    """Multibody is of first order in its step; without friction and payload it goes elsewhere."""
    exact = run("plant.kind=exact", "duration=1.5", *ROUGH).signals.pose
    errors = [
        np.abs(run(f"plant.time_step={h}", "duration=1.5", *ROUGH).signals.pose - exact)
        for h in (1e-3, 5e-4)
    ]
    coarse, fine = (float(error.max()) for error in errors)
    plain = run("plant.kind=exact", "duration=1.5")
    assert float(np.abs(plain.signals.pose - exact).max()) > 30 * coarse
    assert coarse / fine == pytest.approx(2, rel=0.2)


@pytest.mark.parametrize("stiffness", [0.5, 1.5, 1.9, 2.1, 2.5])
def test_friction_in_steps_of_the_engine_is_a_factor_per_step(stiffness):
    """Slow cranks in the direction of the least inertia: rates go by 1 - h c / s H^-1."""
    h, speed = 1e-3, 0.02
    dynamics = sd.StewartDynamics(PAPER, gravity=False)
    mobility, modes = np.linalg.eigh(crank_mobility(dynamics, PAPER.home))
    friction = stiffness * speed / (h * mobility[-1])
    plant = MultibodyStewart(
        PAPER, h, gravity=False, coulomb_friction=friction, coulomb_speed=speed
    )
    simulator, J = Simulator(plant), PAPER.jacobian(PAPER.home)
    context = simulator.get_mutable_context()
    plant.GetInputPort("torque").FixValue(context, np.zeros(6))
    slow = 1e-2 * speed * modes[:, -1]
    plant.set_state(context, np.concatenate([PAPER.home, np.linalg.solve(J, slow)]))
    simulator.AdvanceTo(4 * h)
    rates = J @ plant.GetOutputPort("state").Eval(context)[6:]
    np.testing.assert_allclose(modes[:, -1] @ rates, (1 - stiffness) ** 4 * 1e-2 * speed, rtol=0.03)


def test_a_step_in_which_friction_makes_cranks_tremble_is_reported():
    def said(*settings):
        return cautions_before(prepare(sd.load_scenario("paper", settings=settings)), None)

    heavy = "plant.coulomb_friction=0.06"
    (line,) = said(heavy)
    assert line.startswith("plant.time_step of 1 ms is too coarse for Coulomb friction of 0.06 N m")
    step = next(word for word in line.split() if word.startswith("plant.time_step="))
    assert said(heavy, step) == said(heavy, "plant.coulomb_speed=0.1") == []
    assert said(heavy, "plant.kind=exact") == said("plant.coulomb_friction=2e-3") == said() == []
    stuck, told = ("plant.coulomb_friction=10", "plant.kind=exact"), "takes minutes"
    (line,) = (one for one in said(*stuck) if told in one)
    assert line.endswith("; plant.coulomb_speed of 0.06 or more takes less than one")
    for shorter in ("plant.coulomb_speed=0.06", "duration=3"):
        assert not any(told in one for one in said(*stuck, shorter))


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["predictor_lqi", "adaptive_lqi"])
def test_friction_is_found_where_it_is_asked_for(controller):
    """Otherwise friction is taken for bias and damping, and the run is lost or bad."""
    settings = ("plant.kind=exact", "duration=6", "plant.coulomb_friction=1e-3", *ON_REFERENCE)
    asked = "controller.estimate=[torque_bias,payload,damping,coulomb]"
    loop = build_closed_loop(sd.load_scenario("paper", controller, (*settings, asked)))
    simulator = make_simulator(loop)
    simulator.AdvanceTo(6.0)
    held = loop.GetSubsystemByName("controller")
    context = held.GetMyContextFromRoot(simulator.get_context())
    belief = held.memory(context).belief
    assert belief.parameters[COULOMB] == pytest.approx(1e-3, rel=0.05)
    found, without = (
        run(*settings, *more, controller=controller).accumulated_error for more in ((asked,), ())
    )
    assert found < 4
    assert not without < 5 * found  # or lost


@pytest.mark.parametrize("controller", ["predictor_lqi", "adaptive_lqi"])
def test_the_position_of_a_payload_is_found_where_it_is_asked_for(controller):
    """It begins 3 standard deviations off; otherwise the plate is lost, or E_ac is above 14."""
    true = [0.03, -0.02, 0.05]
    plant = "plant.kind=exact", "plant.payload_mass=0.4", f"plant.payload_position={true}"
    settings = *plant, "duration=6", *ON_REFERENCE
    asked = "controller.estimate=[torque_bias,payload,payload_position,damping]"
    loop = build_closed_loop(sd.load_scenario("paper", controller, (*settings, asked)))
    simulator = make_simulator(loop)
    simulator.AdvanceTo(6.0)
    held = loop.GetSubsystemByName("controller")
    belief = held.memory(held.GetMyContextFromRoot(simulator.get_context())).belief
    error = np.abs(belief.parameters[-3:] - true)
    assert error.max() < 2e-3
    assert (error < 4 * belief.estimate.parameter_std[-3:]).all()
    found, without = (run(*settings, *more, controller=controller) for more in ((asked,), ()))
    told = found.summary["estimates"]
    assert list(told) == [*PARAMETERS, *(f"payload_position_{x}" for x in "xyz")]
    for value, name in zip(true, [*told][-3:], strict=True):
        assert abs(told[name]["value"] - value) < min(2e-3, 4 * told[name]["std"])
    assert "payload position x" in str(found.table()) and "mm (± two" in str(found.table())
    assert found.accumulated_error < 2.5
    assert not without.accumulated_error < 5 * found.accumulated_error  # or lost


def test_the_law_sees_a_crank_turn_back():
    """While its rate passes coulomb_speed; the paper's cranks accelerate by about 1 rad/s^2."""

    def substeps(*settings):
        return compose_law(prepare(sd.load_scenario("paper", settings=settings))).plant.substeps

    plain = substeps("plant.coulomb_friction=1e-3")  # which nobody told
    asked = substeps("controller.estimate=[torque_bias,payload,damping,coulomb]")
    reference, state = prepare(sd.load_scenario("paper")).reference, []
    for t in np.linspace(0, 10, 2001):
        pose, rates = reference.value(t)[:, 0], reference.EvalDerivative(t, 1)[:, 0]
        state.append(PAPER.jacobian(pose) @ rates)
    fastest = np.abs(np.diff(state, axis=0)).max() / 5e-3
    assert plain == 1
    assert asked == np.ceil(0.1 * fastest / 0.02)


LONGER = dataclasses.replace(PAPER, rod_lengths=PAPER.rod_lengths + 3e-4)


def to_run(folder, machine, *settings):
    """Return the paper's scenario with this machine in the place of the plant's."""
    path = folder / "mine.yaml"
    path.write_text(mechanism_yaml(machine))
    return sd.load_scenario("paper", "delay_lqi", (f"plant.mechanism={path}", *settings))


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_the_plant_is_the_machine_that_the_scenario_says(tmp_path, kind):
    """The result equals `true_mechanism`; the controller knows the other machine."""
    settings = (f"plant.kind={kind}", "duration=0.5")
    scenario = to_run(tmp_path, LONGER, *settings, *ON_REFERENCE)
    found = sd.simulate(scenario, judge_stability=False)
    expected = run(*settings, true_mechanism=LONGER)
    assert np.abs(found.signals.pose - expected.signals.pose).max() < 1e-12
    assert np.abs(found.signals.pose - run(*settings).signals.pose).max() > 1e-6
    experiment = prepare(scenario)
    assert experiment.mechanism == PAPER
    assert experiment.truth == simulated_machine(scenario)
    assert experiment.truth.rod_lengths == pytest.approx(LONGER.rod_lengths, rel=1e-12)
    # One that is given comes first.
    assert prepare(scenario, PAPER).truth is PAPER


def test_its_limit_is_that_of_its_motors(tmp_path):
    weak = dataclasses.replace(LONGER, effort_limit=0.25)
    assert prepare(to_run(tmp_path, weak)).torque_limit == 0.25


def test_a_machine_that_does_not_reach_the_start_is_refused(tmp_path):
    high = PAPER.home + [0, 0, 0, 0, 0, 0.42]
    scenario = to_run(tmp_path, dataclasses.replace(PAPER, rod_lengths=np.full(6, 0.8), home=high))
    with pytest.raises(ConfigError, match=r"^plant\.mechanism: got .* does not reach the first"):
        prepare(scenario)


@pytest.mark.parametrize(
    ("name", "message"),
    [("nothing", r"^plant\.mechanism: got 'nothing'"), ("/no/file.yaml", r"^plant\.mechanism: no")],
)
def test_a_machine_that_is_not_there_names_the_field(name, message):
    with pytest.raises(ConfigError, match=message):
        prepare(sd.load_scenario("paper", settings=[f"plant.mechanism={name}"]))


def test_a_payload_is_found_alone_and_recorded_at_its_place():
    """Parameters that are not estimated are recorded as known, without a standard deviation."""
    settings = ("plant.kind=exact", "duration=3", "plant.payload_mass=0.02")
    found = run(*settings, "controller.estimate=[payload]", controller="predictor_lqi")
    last = found.signals.isel(time=-1)
    others = [i for i in range(NUM_PARAMETERS) if i != PAYLOAD]
    assert last.parameters[PAYLOAD].item() == pytest.approx(0.02, rel=0.005)
    assert 0 < last.parameter_std[PAYLOAD].item() < 0.01
    assert not last.parameters[others].any() and last.parameter_std[others].isnull().all()
