"""A platform in a user's diagram."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import FixedOffsetFrame
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

import stewart_drake as sd
from stewart_drake.files.errors import ConfigError

ROOT = Path(__file__).resolve().parents[1] / "diagrams"
PAPER = sd.load_mechanism("paper")
ELSEWHERE = RigidTransform(RollPitchYaw(0.1, -0.2, 0.7), [1.0, -0.5, 0.3])
TORQUE = np.array([0.02, -0.01, 0.03, 0.01, -0.02, 0.01])


def example():
    spec = importlib.util.spec_from_file_location("box_on_plate", ROOT / "box_on_plate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("X_WB", [None, RigidTransform([1.0, -0.5, 0.3])])
def test_a_box_stays_on_the_plate_while_it_moves(X_WB, capsys):
    module = example()
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


def run(build, until=0.1, state=None):
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
    diagram.GetInputPort("torque").FixValue(context, TORQUE)
    simulator.AdvanceTo(until)
    return diagram.GetOutputPort("state").Eval(context)


def test_both_kinds_in_a_diagram_of_ones_own_agree():
    state = np.concatenate([PAPER.home + 0.02, np.full(6, 0.05)])
    loads = {"gravity": True, "payload_mass": 0.2, "torque_bias": [0.3] * 6}
    loads |= {"payload_position": [0.1, 0.0, 0.05], "coulomb_friction": 0.05, "coulomb_speed": 0.5}
    exact, coarse, fine = (
        run(
            lambda b, c=c: sd.AddStewartPlatform(b, PAPER, sd.PlantConfig(**c, **loads)), 0.1, state
        )
        for c in (
            {"kind": "exact"},
            {"time_step": 1e-3},
            {"time_step": 5e-4},
        )
    )
    moved = np.abs(exact - state).max()
    errors = [np.abs(found - exact).max() for found in (coarse, fine)]
    assert errors[0] < 0.1 * moved and errors[0] / errors[1] == pytest.approx(2, rel=0.2)


def test_without_gravity_it_does_not_matter_where_the_base_is_welded():
    """Pose and rates are relative to the base, which here is turned over and far away."""
    state = np.concatenate([PAPER.home + 0.02, np.full(6, 0.05)])

    def welded(builder):
        plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
        frame = plant.AddFrame(FixedOffsetFrame("there", plant.world_frame(), ELSEWHERE))
        platform = sd.AddStewartPlatform(builder, PAPER, plant=plant, parent=frame, X_PB=ELSEWHERE)
        plant.Finalize()
        return platform

    here = run(lambda builder: sd.AddStewartPlatform(builder, PAPER), 0.1, state)
    np.testing.assert_allclose(run(welded, 0.1, state), here, atol=1e-9)


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


def own_plant(builder, finalized):
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    if finalized:
        plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda b: sd.AddStewartPlatform(b, PAPER, plant=own_plant(b, True)), "is finalized; exp"),
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
        (lambda b: sd.AddStewartPlatform(b, PAPER).GetInputPort("force"), "expected torque or wre"),
        (lambda b: sd.AddStewartPlatform(b, PAPER, start=[0.0]), "start: got shape (1,)"),
        (lambda b: sd.AddStewartPlatform(b, "no_such_machine"), "no_such_machine"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(use, message):
    with pytest.raises(ConfigError) as refused:
        use(DiagramBuilder())
    assert message in str(refused.value)
