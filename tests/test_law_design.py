"""A law without a scenario, in a user's diagram."""

import warnings

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.trajectories import PiecewisePolynomial

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.law_design import control_law
from stewart_drake.loop.preparation import prepare
from stewart_drake.mechanism.geometry import fingerprint
from stewart_drake.mechanism.trajectories import make_reference
from stewart_drake.scenario.calibration import Calibration, save_calibration
from stewart_drake.scenario.signals import POSE

PAPER = sd.load_mechanism("paper")


def law_of(scenario, **changes):
    dynamics = sd.StewartDynamics(PAPER, scenario.plant.gravity)
    delay = (scenario.delay.steps + scenario.delay.fraction) * scenario.controller.period
    reference = make_reference(scenario.reference, scenario.duration)
    start = np.concatenate([reference.value(0.0)[:, 0], np.zeros(6)])
    given = {"start": start, "horizon": scenario.duration, "options": scenario.controller}
    period = scenario.controller.period
    return sd.design_law(dynamics, reference, period, delay, **(given | changes))


@pytest.mark.parametrize(
    ("engine", "options"),
    [
        ({"kind": "exact"}, sd.ControllerConfig()),
        ({"time_step": 1e-3}, sd.ControllerConfig()),
        ({"time_step": 4e-3}, sd.ControllerConfig(estimate=["payload"])),
    ],
)
def test_a_law_for_a_platform_knows_its_engine(engine, options):
    """The estimator takes the errors of a step neither for a payload nor for outliers.

    Two loops in one diagram get names of their own, without which Drake ends the process.
    """
    builder = DiagramBuilder()
    config = sd.PlantConfig(gravity=True, **engine)
    platforms = [sd.AddStewartPlatform(builder, "paper", config) for _ in range(2)]
    moves = PAPER.home + np.array([np.zeros(6), [0.1, 0, 0.2, 0.02, 0, 0.02], np.zeros(6)])
    motion = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 1.0, 2.0], moves.T, np.zeros(6), np.zeros(6)
    )
    if config.step == 1e-3:
        with pytest.raises(ConfigError, match=r"^delay: got 0.0996; .* nearest 0.1$"):
            sd.design_law(platforms[0], motion, 0.02, 0.0996)
    law = sd.design_law(platforms[0], motion, 0.02, 0.1, queue="reference", options=options)
    for platform in platforms:
        controller, chain = law.AddToBuilder(builder), builder.AddSystem(law.delay_chain())
        builder.Connect(platform.GetOutputPort("state"), controller.GetInputPort("measurement"))
        builder.Connect(controller.GetOutputPort("torque"), chain.get_input_port())
        builder.Connect(chain.get_output_port(), platform.GetInputPort("torque"))
    builder.ExportOutput(platforms[1].GetOutputPort("state"), "state")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    sd.set_accuracy(simulator)
    simulator.AdvanceTo(2.0)
    state = diagram.GetOutputPort("state").Eval(simulator.get_context())
    np.testing.assert_allclose(state[POSE], PAPER.home, atol=2e-3)


@pytest.mark.parametrize("port", ["torque", "torque_commanded"])
def test_a_plant_that_reads_the_torque_between_the_samples_is_warned_of(port):
    builder = DiagramBuilder()
    platform = sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig())
    motion = PiecewisePolynomial(PAPER.home.reshape(6, 1))
    controller = sd.design_law(platform, motion, 0.02, 0.0).AddToBuilder(builder)
    builder.Connect(platform.GetOutputPort("state"), controller.GetInputPort("measurement"))
    builder.Connect(controller.GetOutputPort(port), platform.GetInputPort("torque"))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("default")
        Simulator(builder.Build()).AdvanceTo(0.06)
    messages = [str(one.message) for one in warned]
    assert len(messages) == (port == "torque"), messages
    assert all(one.startswith("delay_lqi: got a reader of the port torque b") for one in messages)


@pytest.mark.parametrize("every", [1, 2])
def test_a_delay_chain_that_leaves_out_torques_is_warned_of(every):
    """It reads every torque, or only some at the samples."""
    builder = DiagramBuilder()
    platform = sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig(kind="exact"))
    motion = PiecewisePolynomial(PAPER.home.reshape(6, 1))
    controller = sd.design_law(platform, motion, 0.02, 0.04).AddToBuilder(builder)
    chain = builder.AddSystem(sd.systems.DelayChain(0.02 * every, 2))
    builder.Connect(platform.GetOutputPort("state"), controller.GetInputPort("measurement"))
    builder.Connect(controller.GetOutputPort("torque"), chain.get_input_port())
    builder.Connect(chain.get_output_port(), platform.GetInputPort("torque"))
    simulator = Simulator(builder.Build())
    sd.set_accuracy(simulator)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("default")
        simulator.AdvanceTo(0.1)
        simulator.Initialize()
        simulator.AdvanceTo(0.2)
    assert any("that skips samples" in str(one.message) for one in warned) == (every == 2), warned
    assert bool(warned) == (every == 2)


@pytest.mark.parametrize("delay", [0.04, 0.1])
def test_a_shipped_law_estimates_the_delay_of_a_chain(delay):
    """The chain has the torques in flight for its own delay, which is not the assumed one."""
    moves = PAPER.home + np.array([np.zeros(6), [0.1, 0, 0.2, 0.02, 0, 0.02], np.zeros(6)])
    motion = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 1.0, 2.0], moves.T, np.zeros(6), np.zeros(6)
    )
    builder = DiagramBuilder()
    platform = sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig(kind="exact", gravity=True))
    law = sd.design_law(platform, motion, 0.02, 0.06, queue="reference", options="adaptive_lqi")
    controller, chain = law.AddToBuilder(builder), builder.AddSystem(law.delay_chain(delay))
    builder.Connect(platform.GetOutputPort("state"), controller.GetInputPort("measurement"))
    builder.Connect(controller.GetOutputPort("torque"), chain.get_input_port())
    builder.Connect(chain.get_output_port(), platform.GetInputPort("torque"))
    simulator = Simulator(builder.Build())
    sd.set_accuracy(simulator)
    simulator.AdvanceTo(1.0)
    root = simulator.get_context()
    at, context = platform.plant.GetMyContextFromRoot(root), controller.GetMyContextFromRoot(root)
    pose = platform.GetOutputPort("state").Eval(at)[POSE]
    assert np.abs(pose - motion.value(1.0)[:, 0]).max() < 2e-3
    assert controller.GetOutputPort("delay_estimate").Eval(context) == pytest.approx(
        delay, abs=1e-5
    )
    assert controller.memory(context).counts.bad_measurements == 0


@pytest.mark.parametrize("delay", [0.0, 0.1, 0.11])
def test_the_delay_of_a_law_that_estimates_it_begins_as_that_of_the_known_one(delay):
    moves = PAPER.home + np.array([np.zeros(6), [0.1, 0, 0.2, 0.02, 0, 0.02], np.zeros(6)])
    motion = PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
        [0.0, 0.5, 1.0], moves.T, np.zeros(6), np.zeros(6)
    )
    dynamics = sd.StewartDynamics(PAPER, gravity=True)
    known, found = (
        sd.design_law(dynamics, motion, 0.02, delay, queue="reference", options=options)
        for options in (sd.ControllerConfig(), sd.ControllerConfig(delay_estimator="constant"))
    )
    assert len(found.queue) > len(known.queue)
    first, second = (
        chain.GetOutputPort("torque").Eval(chain.CreateDefaultContext())
        for chain in (known.delay_chain(), found.delay_chain())
    )
    np.testing.assert_allclose(second, first, atol=1e-12)


def test_steps_of_a_users_plant_need_to_fit_period_and_delay_only():
    """The grid on which `simulate` records its error is not in the user's diagram."""
    config = sd.PlantConfig(time_step=1.5e-3)
    platform = sd.AddStewartPlatform(DiagramBuilder(), PAPER, config)
    motion = PiecewisePolynomial(PAPER.home.reshape(6, 1))
    law = sd.design_law(platform, motion, 0.015, 0.03)
    assert law.experiment.scenario.plant.step == 1.5e-3
    with pytest.raises(ConfigError, match=r"^delay: got 0.02; .* of plant.time_step"):
        law.delay_chain(0.02)
    for period, delay, field in ((0.02, 0.03, "period: got 0.02"), (0.015, 0.02, "delay: got")):
        with pytest.raises(ConfigError, match=f"^{field}.* of plant.time_step"):
            sd.design_law(platform, motion, period, delay)


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_it_is_the_law_of_the_scenario(fraction):
    """The loop of a scenario, made by hand from public parts, gives the same torques.

    With a fraction the weights come from a system of the diagram.
    """
    settings = ("plant.kind=exact", "duration=2", f"delay.fraction={fraction}", "delay.steps=4")
    scenario = sd.load_scenario("paper", settings=settings)
    # As a trajectory too, whose size is its range within the duration.
    motion = make_reference(scenario.reference, scenario.duration)
    shipped = sd.simulate(scenario, reference=motion, judge_stability=False)

    law = law_of(scenario)
    builder = DiagramBuilder()
    config = sd.PlantConfig(kind="exact")
    start = scenario.reference.offset
    platform = sd.AddStewartPlatform(builder, "paper", config, start=start)
    own = builder.AddSystem(ConstantVectorSource(law.weights)) if fraction else None
    weights = None if own is None else own.get_output_port()
    controller = law.AddToBuilder(builder, weights=weights)
    chain = builder.AddSystem(law.delay_chain())
    builder.Connect(platform.GetOutputPort("state"), controller.GetInputPort("measurement"))
    builder.Connect(controller.GetOutputPort("torque"), chain.get_input_port())
    builder.Connect(chain.get_output_port(), platform.GetInputPort("torque"))
    builder.ExportOutput(controller.GetOutputPort("torque_commanded"), "torque")
    builder.ExportOutput(platform.GetOutputPort("state"), "state")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    sd.set_accuracy(simulator)
    peak = float(np.abs(shipped.signals.torque_commanded).max())
    for t in (0.05, 0.55, 1.05, 1.95):
        simulator.AdvanceTo(t)
        context = simulator.get_context()
        torque = diagram.GetOutputPort("torque").Eval(context)
        expected = shipped.signals.torque_commanded.sel(time=t, method="pad")
        np.testing.assert_allclose(torque, expected, atol=1e-6 * peak)
    wanted = law.reference.value(1.95)[:, 0]
    assert np.abs(diagram.GetOutputPort("state").Eval(context)[POSE] - wanted).max() < 0.1


@pytest.mark.parametrize("gravity", [False, True])
def test_the_plate_stays_where_it_is_until_the_first_torque_acts(gravity):
    """The default queue holds the plate, with gravity too."""
    dynamics = sd.StewartDynamics(PAPER, gravity)
    motion = PiecewisePolynomial(PAPER.home.reshape(6, 1))
    law = sd.design_law(dynamics, motion, period=0.01, delay=0.05)
    rest = np.concatenate([PAPER.home, np.zeros(6)])
    states = dynamics.predict(rest, law.queue, 0.01)
    assert np.abs(states[-1] - rest).max() < 1e-6
    fallen = sd.design_law(dynamics, motion, period=0.01, delay=0.05, queue="zero")
    assert not fallen.queue.any()


def test_what_is_known_of_the_machine_is_the_prior_and_not_the_delay(tmp_path):
    path = tmp_path / "calibration.yaml"
    names, mean = ("payload_mass", "delay"), np.array([0.1, 0.33])
    save_calibration(path, Calibration(fingerprint(PAPER), names, mean, np.diag([1e-4, 1e-4])))
    law = law_of(sd.load_scenario("paper"), options=sd.ControllerConfig(calibration=str(path))).law
    assert law.timeline.eta == pytest.approx(0.8)
    prior = law.observer.settings.parameters
    at = prior.names.index("payload_mass")
    assert prior.prior[at] == 0.1 and prior.std[at] == pytest.approx(0.01)
    save_calibration(path, Calibration("0" * 16, names, mean, np.zeros((2, 2))))
    with pytest.raises(ConfigError, match="of another machine"):
        law_of(sd.load_scenario("paper"), options=sd.ControllerConfig(calibration=str(path)))


def test_without_a_start_it_begins_on_the_reference():
    law = law_of(sd.load_scenario("paper"), start=None)
    np.testing.assert_array_equal(law.planned.value(0.3), law.reference.value(0.3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delay": -0.1}, "delay: got -0.1"),
        ({"delay": np.nan}, "delay: got nan"),
        ({"delay": "late"}, "delay: got 'late'; expected numbers"),
        ({"period": 0.0}, "period: got 0.0"),
        ({"period": "0.1"}, "period: got '0.1'; expected a finite number above 0"),
        ({"horizon": np.inf}, "horizon: got inf; expected a finite number above 0"),
        ({"period": 1e-9}, "period: got 1e-09"),
        ({"dynamics": PAPER}, "expected a StewartPlatform or a StewartDynamics"),
        ({"reference": "paper"}, "reference: got 'paper'; expected a Trajectory"),
        ({"reference": PiecewisePolynomial((PAPER.home + 9.0).reshape(6, 1))}, "reference: leg"),
        ({"options": {}}, "options: got {}; expected a ControllerConfig"),
        ({"options": "no"}, "controller: got 'no'; expected one of adaptive_lqi"),
        ({"start": np.full(12, np.nan)}, "start: got [nan"),
        ({"start": np.full(12, 9.0)}, "start: got a pose where leg"),
        ({"noise_std": "low"}, "noise_std: got 'low'; expected numbers"),
        ({"start": np.zeros(6)}, "start: got shape (6,); expected (12,)"),
        ({"reference": PiecewisePolynomial(np.zeros((3, 1)))}, "got shape (3, 1)"),
        ({"noise_std": [0.0]}, "noise_std"),
        ({"options": sd.ControllerConfig(torque_map="printed")}, "options.torque_map: got"),
        ({"torque_limit": -1.0}, "torque_limit: got -1.0"),
    ],
)
def test_bad_input_is_one_line(changes, message):
    sc = sd.Scenario()
    given = {
        "dynamics": sd.StewartDynamics(PAPER),
        "reference": make_reference(sc.reference, 10.0),
        "period": 0.1,
        "delay": 0.2,
    }
    with pytest.raises(ConfigError) as refused:
        sd.design_law(**(given | changes))
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_the_margins_of_a_design_are_those_of_its_scenario():
    """The design's loop is that of the scenario, with the machine that the dynamics describe."""
    scenario = sd.load_scenario("paper", settings=("plant.kind=exact", "start=on_reference"))
    design, expected = law_of(scenario, start=None), sd.controller_margin(scenario)
    found = sd.controller_margin(design)
    assert found.time == expected.time
    np.testing.assert_allclose(found.margins, expected.margins, rtol=1e-4)
    models = sd.linear_models(design, time=1.0), sd.linear_models(scenario, time=1.0)
    for one, other in zip(*((m.S.A, m.S.B) for m in models), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)

    loaded = sd.load_scenario("gravity", settings=("plant.payload_mass=0.5", "plant.kind=exact"))
    payload = np.append(np.zeros(6), [0.5, 0.0])
    motion = make_reference(loaded.reference, loaded.duration)
    dynamics = sd.StewartDynamics(PAPER, True, payload)
    period, eta = loaded.controller.period, loaded.eta
    found = sd.controller_margin(sd.design_law(dynamics, motion, period, eta))
    assert found.pole == pytest.approx(sd.controller_margin(loaded).pole, rel=1e-6)


def test_the_names_to_estimate_are_those_of_the_options_or_of_the_dynamics():
    """Those of the dynamics where both are given the same, an error where they differ."""

    def free(names, **given):
        options = sd.ControllerConfig(estimate=names)
        dynamics = sd.StewartDynamics(PAPER, **given)
        reference = make_reference(sd.load_scenario("paper").reference, 2.0)
        law = sd.design_law(dynamics, reference, 0.1, 0.8, horizon=2.0, options=options)
        return law.law.plant.dynamics.free

    usual = sd.ControllerConfig().estimate
    assert free([*usual, "coulomb"])[-1] == "coulomb_friction"
    assert free(["payload", "payload_position"])[1] == "payload_position_x"
    assert free(["payload"]) == ("payload_mass",)
    assert free(usual, free=("payload_mass",)) == ("payload_mass",)
    with pytest.raises(ConfigError, match=r"options.estimate: got torque_bias_1, .* are free"):
        free(["torque_bias"], free=("payload_mass",))


def test_motors_that_are_too_weak_for_the_motion_are_warned_of():
    with pytest.warns(UserWarning, match=r"takes up to .* give 0.5 \(torque_limit\)"):
        law_of(sd.load_scenario("gravity"), torque_limit=0.5)


@pytest.mark.parametrize(("delay", "length"), [(0.0, 0.0), (0.2, 0.3)])
def test_a_motion_that_begins_at_rest_where_the_plate_is_needs_no_catch_up(delay, length):
    """It must still be at rest there when the first torque acts."""
    home = PAPER.home.tolist()
    there = [0.05, 0, 0, *home[3:]]
    moves = f"reference={{kind: waypoints, times: [0, 1, 2], poses: [{home}, {there}, {home}]}}"
    settings = (moves, f"delay={{steps: {round(delay / 0.05)}, fraction: 0}}", "start=rest")
    experiment = prepare(sd.load_scenario("paper", settings=(*settings, "duration=2")))
    assert control_law(experiment)[2] == pytest.approx(length)
