"""A platform in a user's diagram."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import FixedOffsetFrame, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import stewart_drake as sd
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.files.errors import ConfigError
from stewart_drake.scenario.signals import PLANT_PARAMETERS
from tests.test_analysis_scripts import script

DIAGRAMS = Path(__file__).resolve().parents[1] / "diagrams"
PAPER = sd.load_mechanism("paper")
ELSEWHERE = RigidTransform(RollPitchYaw(0.1, -0.2, 0.7), [1.0, -0.5, 0.3])
TORQUE = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.01])


@pytest.mark.parametrize("X_WB", [None, RigidTransform([1.0, -0.5, 0.3])])
def test_a_box_stays_on_the_plate_while_it_moves(X_WB, capsys):
    module = script("box_on_plate", DIAGRAMS)
    places = module.main(X_WB)
    heights = [float(line.split()[-1]) for line in capsys.readouterr().out.splitlines()[1:]]
    assert len(places) == len(heights) == 20
    assert np.ptp(heights) > 15, "the plate did not move by mm"
    assert np.abs(places[:, :2]).max() < 1e-3, "it slid"
    resting = deck_height(PAPER) + module.SIDE / 2
    np.testing.assert_allclose(places[1:, 2], resting, atol=1e-4, err_msg="it fell or bounced")


def deck_height(mechanism):
    """Return the height of the plate's upper side above its COM, from the model's disc."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 1e-3)
    sd.AddStewartPlatform(builder, mechanism, plant=plant)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    (disc,) = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("plate"))
    placed = inspector.GetPoseInFrame(disc).translation()[2]
    return placed + inspector.GetShape(disc).length() / 2


def run(build, until=0.1, state=None, change=None, look=None):
    builder = DiagramBuilder()
    platform = build(builder)
    builder.ExportInput(platform.GetInputPort("torque"), "torque")
    builder.ExportOutput(platform.GetOutputPort("state"), "state")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    if platform.model is None:
        sd.set_accuracy(simulator, 1e-10)
    if state is not None:
        platform.SetState(context, state)
    if change is not None:
        platform.SetParameters(context, **change)
    diagram.GetInputPort("torque").FixValue(context, TORQUE)
    simulator.AdvanceTo(until)
    if look is not None:
        look(context)
    return diagram.GetOutputPort("state").Eval(context)


MOVING = np.concatenate([PAPER.home + 0.02, np.full(6, 0.05)])


def test_both_kinds_in_a_diagram_of_ones_own_agree():
    loads = {"gravity": True, "payload_mass": 0.2, "torque_bias": [0.3] * 6}
    loads |= {"payload_position": [0.1, 0.0, 0.05], "coulomb_friction": 0.05, "coulomb_speed": 0.5}
    configs = [
        sd.PlantConfig(**c, **loads)
        for c in ({"kind": "exact"}, {"time_step": 1e-3}, {"time_step": 5e-4})
    ]
    exact, coarse, fine = (
        run(lambda b, c=c: sd.AddStewartPlatform(b, PAPER, c), state=MOVING) for c in configs
    )
    moved = np.abs(exact - MOVING).max()
    errors = [np.abs(found - exact).max() for found in (coarse, fine)]
    assert errors[0] < 0.1 * moved and errors[0] / errors[1] == pytest.approx(2, rel=0.2)


def test_without_gravity_it_does_not_matter_where_the_base_is_welded():
    """Pose and rates are relative to the base, which here is turned over and far away."""

    def welded(builder):
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
        frame = plant.AddFrame(FixedOffsetFrame("there", plant.world_frame(), ELSEWHERE))
        platform = sd.AddStewartPlatform(builder, PAPER, plant=plant, parent=frame, X_PB=ELSEWHERE)
        plant.Finalize()
        return platform

    here = run(lambda builder: sd.AddStewartPlatform(builder, PAPER), state=MOVING)
    np.testing.assert_allclose(run(welded, state=MOVING), here, atol=1e-9)


def test_two_machines_in_one_plant_move_on_their_own():
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    pair = [
        sd.AddStewartPlatform(builder, PAPER, plant=plant, X_PB=RigidTransform([x, 0, 0]))
        for x in (0.0, 2.0)
    ]
    plant.Finalize()
    for name, platform in zip("ab", pair, strict=True):
        builder.ExportInput(platform.GetInputPort("torque"), f"torque_{name}")
        builder.ExportOutput(platform.GetOutputPort("state"), f"state_{name}")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.GetInputPort("torque_a").FixValue(context, TORQUE)
    diagram.GetInputPort("torque_b").FixValue(context, np.zeros(6))
    simulator.AdvanceTo(0.1)
    moved, still = (diagram.GetOutputPort(f"state_{name}").Eval(context) for name in "ab")
    alone = run(lambda builder: sd.AddStewartPlatform(builder, PAPER))
    np.testing.assert_allclose(moved, alone, atol=1e-9)
    np.testing.assert_allclose(still, [*PAPER.home, *np.zeros(6)], atol=1e-9)


def test_a_robot_beside_it_does_not_change_its_motion():
    def beside(builder):
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
        platform = sd.AddStewartPlatform(
            builder, PAPER, plant=plant, X_PB=RigidTransform([2.0, 0, 0])
        )
        url = "package://drake/examples/acrobot/Acrobot.urdf"
        scene["plant"], (scene["robot"],) = plant, Parser(plant).AddModels(url=url)
        plant.Finalize()
        plant.GetJointByName("shoulder", scene["robot"]).set_default_angle(1.0)
        return platform

    def look(context):
        plant = scene["plant"]
        angle = plant.GetPositions(plant.GetMyContextFromRoot(context), scene["robot"])[0]
        assert abs(angle - 1.0) > 0.1, "the robot hangs still"

    scene = {}
    simulated = run(beside, 0.3, look=look)
    np.testing.assert_allclose(simulated, run(lambda b: sd.AddStewartPlatform(b, PAPER), 0.3))
    assert np.abs(simulated[:6] - PAPER.home).max() > 1e-3


YAWED = RigidTransform(RollPitchYaw(0, 0, 0.7), [1.0, 0, 0])
HANGING = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0, 0, 2.0])
TILTED = RigidTransform(RollPitchYaw(0.5, 0, 0), [0, 0, 0])


def with_gravity(builder, g=None, X_PB=None, parent=None, gravity=True):
    """Add a platform to a plant with gravity g along -z of the world, Drake's default if None."""
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    if g is not None:
        plant.mutable_gravity_field().set_gravity_vector([0, 0, -g])
    parent = parent and parent(plant)
    config = sd.PlantConfig(gravity=gravity)
    return sd.AddStewartPlatform(builder, PAPER, config, plant=plant, X_PB=X_PB, parent=parent)


def test_a_base_may_tilt_under_gravity():
    """It moves as an upright one does under gravity that is turned the other way round."""

    def welded(builder, g_W, X_WB):
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
        plant.mutable_gravity_field().set_gravity_vector(g_W)
        config = sd.PlantConfig(gravity=True)
        platform = sd.AddStewartPlatform(builder, PAPER, config, plant=plant, X_PB=X_WB)
        plant.Finalize()
        return platform

    down = np.array([0, 0, -9.81])
    turned = TILTED.rotation().inverse().multiply(down)
    tilted = run(lambda b: welded(b, down, TILTED), state=MOVING)
    np.testing.assert_allclose(tilted, run(lambda b: welded(b, turned, None), state=MOVING))
    assert np.abs(tilted - run(lambda b: welded(b, down, None), state=MOVING)).max() > 1e-2


def on_a_table(plant, X_WT=TILTED, weld=True):
    """Return a frame, upright again, of a table that is welded to the world, as its parent."""
    table = plant.AddRigidBody("table", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    if weld:
        plant.WeldFrames(table.body_frame(), plant.world_frame(), X_WT.inverse())
    return plant.AddFrame(FixedOffsetFrame("top", table.body_frame(), TILTED.inverse()))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({}, 9.81),
        ({"g": 1.62}, 1.62),
        ({"g": 0.0}, 0.0),
        ({"g": 1.62, "X_PB": YAWED}, 1.62),
        ({"X_PB": HANGING}, -9.81),
        ({"g": 3.7, "parent": on_a_table}, 3.7),
        ({"gravity": False}, 0.0),
        ({"gravity": False, "g": 1.62, "X_PB": TILTED}, 0.0),
    ],
)
def test_the_dynamics_have_the_gravity_of_the_plant(given, expected):
    """The torques that hold the plate by `dynamics` hold it in the plant."""
    builder = DiagramBuilder()
    platform = with_gravity(builder, **given)
    assert platform.dynamics.gravity == pytest.approx(expected, abs=1e-12)
    platform.plant.Finalize()
    holding = platform.dynamics.equilibrium_torque(PAPER.home)
    builder.ExportInput(platform.GetInputPort("torque"), "torque")
    builder.ExportOutput(platform.GetOutputPort("state"), "state")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.GetInputPort("torque").FixValue(context, holding)
    simulator.AdvanceTo(0.1)
    state = diagram.GetOutputPort("state").Eval(context)
    np.testing.assert_allclose(state[:6], PAPER.home, atol=1e-6)


def changed_gravity(builder):
    platform = with_gravity(builder)
    platform.plant.mutable_gravity_field().set_gravity_vector([0, 0, -1.62])
    platform.plant.Finalize()
    platform.GetInputPort("torque")


LOADS = {"payload_mass": 0.3, "payload_position": np.array([0.05, -0.03, 0.1])}
LOADS |= {"joint_damping": 0.01}
LOADS |= {"coulomb_friction": 0.02, "coulomb_speed": np.float64(0.5)}
HEAVY = replace(PAPER, plate=replace(PAPER.plate, mass=5.0))


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_changing_parameters_in_a_context_equals_building_with_them(kind):
    """One by one and together; the default values are back in the next context."""

    def built(mechanism, loads):
        config = sd.PlantConfig(kind, gravity=True, **{"coulomb_friction": 1e-3} | loads)
        return lambda builder: sd.AddStewartPlatform(builder, mechanism, config)

    plain = run(built(PAPER, {}))
    changes = [{name: LOADS[name]} for name in ("payload_mass", "joint_damping", "coulomb_speed")]
    for loads in ({}, *changes, LOADS):
        machine = PAPER if loads else HEAVY
        change = loads or {"plate_mass": HEAVY.plate.mass}
        changed = run(built(PAPER, {}), change=change)
        np.testing.assert_allclose(changed, run(built(machine, loads)), rtol=1e-9, atol=1e-12)
        assert np.abs(changed - plain).max() > 1e-6, change
    # Where the payload is, of a payload that is there.
    here, there = ({"payload_mass": 0.3, "payload_position": [0, 0, z]} for z in (0.1, 0.2))
    moved = run(built(PAPER, here), change={"payload_position": there["payload_position"]})
    np.testing.assert_allclose(moved, run(built(PAPER, there)), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_a_closed_loop_takes_parameters_in_its_context(kind):
    settings = (f"plant.kind={kind}", "start=on_reference", "queue=reference", "delay.steps=1")

    def state(change, *more, **own):
        loop = sd.build_closed_loop(sd.load_scenario("paper", settings=(*settings, *more)), **own)
        context = loop.CreateDefaultContext()
        loop.SetParameters(context, **change)
        simulator = Simulator(loop, context)
        if kind == "exact":
            sd.set_accuracy(simulator, 1e-10)
        simulator.AdvanceTo(0.35)
        return loop.GetOutputPort("state").Eval(context)

    loaded = state({"payload_mass": 0.3})
    np.testing.assert_allclose(loaded, state({}, "plant.payload_mass=0.3"), atol=1e-10)
    heavy = state({"plate_mass": 5.0})
    np.testing.assert_allclose(heavy, state({}, true_mechanism=HEAVY), atol=1e-10)
    assert min(np.abs(changed - state({})).max() for changed in (loaded, heavy)) > 1e-6


def test_derivatives_by_parameters_are_exact():
    dynamics = sd.StewartDynamics(PAPER, True, free=PLANT_PARAMETERS)
    plant = sd.systems.ExactPlant(dynamics).ToAutoDiffXd()
    context = plant.CreateDefaultContext()
    values = plant_parameters([*np.full(6, 0.01), 0.3, 0.02, 0.01, 0.5, 0.05, 0.0, 0.1])
    context.SetContinuousState([AutoDiffXd(x) for x in MOVING])
    plant.GetInputPort("torque").FixValue(context, np.array([AutoDiffXd(T) for T in TORQUE]))
    varied = InitializeAutoDiff(values).ravel()
    context.get_mutable_numeric_parameter(0).SetFromVector(varied)
    change = plant.EvalTimeDerivatives(context).CopyToVector()
    found = ExtractGradient(change)
    expected = dynamics.derivatives(MOVING[:6], MOVING[6:], TORQUE, values).G
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())
    plate = context.get_mutable_numeric_parameter(1)
    plate.SetFromVector(InitializeAutoDiff(ExtractValue(plate.CopyToVector())).ravel())
    with pytest.raises(ValueError, match="derivatives by mass or inertia of the plate"):
        plant.EvalTimeDerivatives(context)


@pytest.mark.parametrize("kind", ["exact", "multibody"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"payload": 1.0}, "parameter: got 'payload'; expected plate_mass, payload_mass"),
        ({"payload_mass": -1.0}, "payload_mass: got -1"),
        ({"payload_mass": np.nan}, "payload_mass: got nan"),
        ({"payload_position": 0.1}, "payload_position: got 0.1; expected a list"),
        ({"plate_mass": "x"}, "plate_mass: got 'x'; expected numbers"),
        ({"plate_mass": 0.0}, "plate.mass: got 0 kg"),
    ],
)
def test_wrong_parameters_are_refused_and_change_nothing(kind, change, message):
    def build(builder):
        return sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig(kind))

    with pytest.raises(ConfigError) as refused:
        run(build, change={"payload_position": [0, 0, 0.1]} | change)
    assert message in str(refused.value)


def test_friction_that_was_not_built_is_refused():
    with pytest.raises(ConfigError, match="coulomb_friction: got a platform without"):
        run(lambda b: sd.AddStewartPlatform(b, PAPER), change={"coulomb_friction": 0.1})
    loop = sd.build_closed_loop(sd.load_scenario("paper", settings=("plant.kind=paper",)))
    with pytest.raises(ConfigError, match="got paper; expected exact or multibody"):
        loop.SetParameters(loop.CreateDefaultContext(), payload_mass=0.1)


def test_a_platform_begins_at_the_given_state():
    start = PAPER.home + np.array([0.1, -0.1, 0.2, 0.01, 0.02, -0.01])
    for kind in ("exact", "multibody"):
        builder = DiagramBuilder()
        platform = sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig(kind=kind), start=start)
        builder.ExportOutput(platform.GetOutputPort("state"), "state")
        diagram = builder.Build()
        context = Simulator(diagram).get_context()
        state = diagram.GetOutputPort("state").Eval(context)
        np.testing.assert_allclose(state, [*start, *np.zeros(6)], atol=1e-14)
        assert "multibody" in repr(platform) or "exact" in repr(platform)


def set_state(builder, state, kind="exact"):
    platform = sd.AddStewartPlatform(builder, PAPER, sd.PlantConfig(kind=kind))
    platform.SetState(builder.Build().CreateDefaultContext(), state)


@pytest.mark.parametrize("kind", ["exact", "multibody"])
def test_a_state_out_of_reach_is_refused(kind):
    with pytest.raises(sd.UnreachablePoseError):
        set_state(DiagramBuilder(), [0, 0, 5, *np.zeros(9)], kind)


def own_plant(builder, finalized, time_step=1e-3):
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    if finalized:
        plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda b: sd.AddStewartPlatform(b, PAPER, plant=own_plant(b, True)), "is finalized; exp"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, plant=3), "plant: got 3; expected a Multibody"),
        (
            lambda b: sd.AddStewartPlatform(b, PAPER, plant=own_plant(b, False, 0.0)),
            "plant: got a continuous one; expected",
        ),
        (
            lambda b: sd.AddStewartPlatform(
                b, PAPER, sd.PlantConfig(kind="exact"), plant=own_plant(b, False)
            ),
            "plant: got one for plant.kind exact",
        ),
        (
            lambda b: sd.AddStewartPlatform(b, PAPER, plant=own_plant(b, False)).GetOutputPort(
                "state"
            ),
            "not finalized; expected GetInputPort and GetOutputPort after plant.Finalize()",
        ),
        (
            lambda b: with_gravity(b, X_PB=TILTED).dynamics,
            "X_PB: got a base whose z is 28.6 degrees from the plant's gravity; expected 0",
        ),
        (
            lambda b: with_gravity(b, parent=lambda plant: on_a_table(plant, weld=False)).dynamics,
            "parent: got top, a frame that can move; expected one that is welded",
        ),
        (changed_gravity, "[0.0, 0.0, -1.62], [0.0, 0.0, -9.81] when the platform was added"),
        (lambda b: sd.AddStewartPlatform(b, PAPER).GetInputPort("force"), "expected torque or wre"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, start=[0.0]), "start: got shape (1,)"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, start=[np.nan] * 6), "start: got [nan"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, {"kind": "exact"}), "config: got {'kind'"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, X_PB=np.eye(4)), "expected a RigidTransform"),
        (lambda b: set_state(b, [np.nan] * 12), "state: got [nan"),
        (lambda b: set_state(b, [0.0] * 6), "state: got shape (6,)"),
        (lambda b: sd.StewartDynamics("no_such_machine"), "no_such_machine"),
        (lambda b: sd.ExactPlant("paper"), "dynamics: got 'paper'; expected a StewartDynamics"),
        (
            lambda b: sd.AddStewartPlatform(b, PAPER, sd.PlantConfig(ball_joint_friction=0.1)),
            "plant.ball_joint_friction: got 0.1; expected 0, or plant.kind exact",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(use, message):
    with pytest.raises(ConfigError) as refused:
        use(DiagramBuilder())
    assert message in str(refused.value)
