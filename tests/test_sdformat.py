"""The SDFormat that is written, as Drake reads it back."""

import dataclasses
import logging
import re
from xml.etree import ElementTree

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from stewart_drake.files.resources import data_root, shipped
from stewart_drake.loop.platforms import add_mechanism, set_pose
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.sdformat import to_sdformat
from tests.mechanisms import PAPER, random_mechanism, random_pose
from tests.singular import parallel_rods

MODELS = data_root() / "models"
LEGS = range(1, 7)


def parse(mechanism):
    """Return the document alone, at the positions it gives."""
    plant = MultibodyPlant(time_step=1e-3)
    Parser(plant).AddModelsFromString(to_sdformat(mechanism), "sdf")
    plant.Finalize()
    return plant, plant.CreateDefaultContext()


def any_machine(seed):
    """Return the paper's mechanism for seed 0, else a random one that uses either crank branch."""
    rng = np.random.default_rng(seed)
    if seed == 0:
        return PAPER
    return dataclasses.replace(random_mechanism(rng), branches=rng.choice([-1, 1], 6))


def vertical_cranks():
    """All cranks vertical at home: a pitch of 90 degrees. Crank angles are zero."""
    rods = parallel_rods()
    out, up = rods.R_WS[:, :, 2], np.array([0.0, 0.0, 1.0])
    p_WS, crank = 0.2 * out, np.tile(up, (6, 1))
    R_WS = np.stack([crank, np.cross(out, crank), out], axis=2)
    p_SQ = PAPER.home[3:] + rods.p_PQ - p_WS
    return dataclasses.replace(
        rods,
        p_WS=p_WS,
        R_WS=R_WS,
        rod_lengths=np.linalg.norm(p_SQ - 0.1 * crank, axis=1),
        branches=-np.sign(np.einsum("li,li->l", p_SQ, R_WS[:, :, 1])),
    )


def gaps(mechanism, plant, context):
    """Largest distance and relative velocity between a rod's end and its plate joint."""

    def at(name):
        frames = [plant.GetFrameByName(f"{name}_{leg}") for leg in LEGS]
        places = [frame.CalcPoseInWorld(context).translation() for frame in frames]
        return np.array(
            [places, [f.CalcSpatialVelocityInWorld(context).translational() for f in frames]]
        )

    return np.abs(at("rod_end") - at("plate_joint")).max(axis=(1, 2))


# ------------------------------------------------------------------ the document


@pytest.mark.parametrize("name", shipped("mechanism"))
def test_the_generated_file_is_what_the_writer_writes_and_its_package_url_resolves(name):
    """Up to the last digit, in which platforms may differ."""
    plant = MultibodyPlant(time_step=1e-3)
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
    parser.AddModelsFromUrl(f"package://stewart_drake_models/{name}.sdf")
    assert plant.HasModelInstanceNamed(name)
    number = re.compile(r"-?\d+(\.\d+)?(e[+-]\d+)?")
    generated = (MODELS / f"{name}.sdf").read_text()
    written = to_sdformat(load_mechanism(name))
    assert number.sub("#", generated) == number.sub("#", written)
    values = [[float(n.group()) for n in number.finditer(text)] for text in (generated, written)]
    np.testing.assert_allclose(*values, rtol=1e-13, atol=1e-15)


def test_the_plate_is_drawn_at_its_joints():
    """Also where its centre of mass, the frame's origin, is elsewhere."""
    mechanism = load_mechanism("motion_base")
    deck = mechanism.p_PQ[0, 2]
    plate = ElementTree.fromstring(to_sdformat(mechanism)).find(".//link[@name='plate']")
    assert plate is not None
    for name in ("disc", "x_axis", "x_axis_tip"):
        pose = plate.findtext(f"visual[@name='{name}']/pose")
        assert pose is not None
        assert 0 < float(pose.split()[2]) - deck < 0.1 * mechanism.rod_lengths[0]


def test_parser_only_warns_of_the_inertia_that_the_paper_prints(caplog):
    """Hence the mechanism's own check; and the warnings that do not come would arrive."""
    with caplog.at_level(logging.WARNING, logger="drake"):
        for seed in range(3):
            parse(any_machine(seed))
        assert caplog.messages == []
        printed = to_sdformat(PAPER).replace("5.9e-05", "6e-05")
        plant = MultibodyPlant(time_step=1e-3)
        Parser(plant).AddModelsFromString(printed, "sdf")
    assert sum("triangle inequality" in message for message in caplog.messages) == 6


@pytest.mark.parametrize("name", ["base", "plate", "crank_1", "model", "static", "my-robot_2"])
def test_names_do_not_collide_with_those_inside(name):
    plant, _ = parse(dataclasses.replace(PAPER, name=name))
    assert plant.HasModelInstanceNamed(name)
    assert plant.num_actuated_dofs() == 6


# ------------------------------------------------------------------ what it says


@pytest.mark.parametrize("seed", range(3))
def test_bodies_have_the_mechanism_s_mass_inertia_and_centre(seed):
    mechanism = any_machine(seed)
    plant, context = parse(mechanism)
    expected = {"base": (mechanism.base, 0.0), "plate": (mechanism.plate, 0.0)}
    for i, leg in enumerate(LEGS):
        crank, rod = mechanism.crank, mechanism.rod
        expected[f"crank_{leg}"] = (crank, crank.center * mechanism.crank_lengths[i])
        expected[f"rod_{leg}"] = (rod, rod.center * mechanism.rod_lengths[i])
    for name, (body, along_x) in expected.items():
        link = plant.GetBodyByName(name)
        M_BBo_B = link.CalcSpatialInertiaInBodyFrame(context)
        about_com = M_BBo_B.Shift(M_BBo_B.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        np.testing.assert_allclose(link.get_mass(context), body.mass, rtol=1e-14)
        np.testing.assert_allclose(M_BBo_B.get_com(), [along_x, 0, 0], atol=1e-15)
        np.testing.assert_allclose(
            about_com, np.diag(body.inertia), atol=1e-12 * body.inertia.max() + 1e-15
        )
    assert plant.num_bodies() == 1 + len(expected)


@pytest.mark.parametrize("seed", range(3))
def test_joints_turn_about_the_mechanism_s_axes(seed):
    """Second axis of the universal joint: perpendicular to the motor axis and to the rod."""
    mechanism = any_machine(seed)
    plant, context = parse(mechanism)

    def origin(frame):
        return plant.GetFrameByName(frame).CalcPoseInWorld(context).translation()

    for i, leg in enumerate(LEGS):
        axis = mechanism.R_WS[i][:, 2]
        motor = plant.GetJointByName(f"motor_{leg}")
        R_WF = motor.frame_on_parent().CalcRotationMatrixInWorld(context)
        np.testing.assert_allclose(R_WF.multiply(motor.revolute_axis()), axis, atol=1e-14)
        universal = plant.GetJointByName(f"universal_{leg}")
        first, second, _ = universal.frame_on_parent().CalcRotationMatrixInWorld(context).matrix().T
        rod = origin(f"rod_end_{leg}") - origin(f"tip_{leg}")
        np.testing.assert_allclose(first, axis, atol=1e-13)
        np.testing.assert_allclose([second @ axis, second @ rod], 0, atol=1e-13)
        np.testing.assert_allclose(np.linalg.norm(rod), mechanism.rod_lengths[i], rtol=1e-13)


@pytest.mark.parametrize("limit", [None, 2.5])
def test_six_degrees_of_freedom_are_actuated_in_the_order_of_the_legs(limit):
    plant, _ = parse(dataclasses.replace(PAPER, effort_limit=limit))
    # 6 cranks, 6 universal joints and a free plate, less three per ball: six degrees of freedom.
    assert plant.num_constraints() == len(plant.GetConstraintIds()) == 6
    assert plant.num_velocities() - 3 * plant.num_constraints() == 6
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    assert [actuator.joint().name() for actuator in actuators] == [f"motor_{leg}" for leg in LEGS]
    assert [actuator.input_start() for actuator in actuators] == list(range(6))
    assert {actuator.effort_limit() for actuator in actuators} == {limit or np.inf}


@pytest.mark.parametrize(
    "mechanism",
    [*map(any_machine, range(4)), vertical_cranks(), parallel_rods()],
    ids=["paper", "random 1", "random 2", "random 3", "vertical cranks", "vertical rods"],
)
def test_frames_stand_where_the_mechanism_has_its_joints(mechanism):
    plant, context = parse(mechanism)

    def pose(frame):
        X_WF = plant.GetFrameByName(frame).CalcPoseInWorld(context)
        return X_WF.translation(), X_WF.rotation().matrix()

    p_WP, R_WP = pose("plate")
    np.testing.assert_allclose(p_WP, mechanism.home[3:], atol=1e-14)
    for i, leg in enumerate(LEGS):
        p_WS, R_WS = pose(f"shaft_{leg}")
        np.testing.assert_allclose(p_WS, mechanism.p_WS[i], atol=1e-14)
        np.testing.assert_allclose(R_WS, mechanism.R_WS[i], atol=1e-13)
        alpha = mechanism.crank_angles(mechanism.home)[i]
        crank = R_WS @ [np.cos(alpha), np.sin(alpha), 0]
        tip = mechanism.p_WS[i] + mechanism.crank_lengths[i] * crank
        p_WT, R_WT = pose(f"tip_{leg}")
        np.testing.assert_allclose(p_WT, tip, atol=1e-12)
        np.testing.assert_allclose(R_WT[:, 0], crank, atol=1e-13)
        p_WQ, _ = pose(f"plate_joint_{leg}")
        np.testing.assert_allclose(p_WQ, p_WP + R_WP @ mechanism.p_PQ[i], atol=1e-13)
    assert gaps(mechanism, plant, context)[0] < 1e-12


# ------------------------------------------------------------------ the loops


@pytest.mark.parametrize("seed", range(25))
def test_loops_close_at_any_pose_and_rates(seed):
    mechanism = any_machine(seed)
    rng = np.random.default_rng(seed)
    plant = MultibodyPlant(time_step=1e-3)
    add_mechanism(plant, mechanism)
    context = plant.CreateDefaultContext()
    plate = plant.GetBodyByName("plate")
    for _ in range(4):
        pose, rates = random_pose(rng, mechanism), rng.normal(size=6)
        set_pose(plant, context, mechanism, pose, rates)
        distance, velocity = gaps(mechanism, plant, context)
        assert distance < 1e-13 * mechanism.rod_lengths.max()
        assert velocity < 1e-12

        rpy = RollPitchYaw(pose[:3])
        X_WP, V_WP = plate.EvalPoseInWorld(context), plate.EvalSpatialVelocityInWorld(context)
        assert X_WP.IsNearlyEqualTo(RigidTransform(rpy, pose[3:]), 1e-14)
        w_WP = rpy.CalcAngularVelocityInParentFromRpyDt(rates[:3])
        np.testing.assert_allclose(V_WP.rotational(), w_WP, atol=1e-13)
        np.testing.assert_allclose(V_WP.translational(), rates[3:], atol=1e-14)
        motors = [plant.GetJointByName(f"motor_{leg}") for leg in LEGS]
        turned = mechanism.crank_angles(pose) - mechanism.crank_angles(mechanism.home)
        found = [motor.get_angle(context) for motor in motors]
        np.testing.assert_allclose(np.exp(1j * np.array(found)), np.exp(1j * turned), atol=1e-13)
        alpha_dot = [motor.get_angular_rate(context) for motor in motors]
        np.testing.assert_allclose(alpha_dot, mechanism.jacobian(pose) @ rates, atol=1e-12)


# ------------------------------------------------------------------ collisions


def scene(documents):
    """Return the documents in a plant of somebody else's, not finalized yet."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    for document in documents:
        Parser(plant).AddModelsFromString(document, "sdf")
    return builder, plant, scene_graph


@pytest.mark.parametrize("name", shipped("mechanism"))
def test_a_box_dropped_on_the_plate_of_a_held_machine_stays_on_it(name):
    """Shafts locked, under gravity, for 2 s; the box ends half its height above the disc.

    Two flat faces touch in one point only, on which the box may still rock a little.
    """
    document = (MODELS / f"{name}.sdf").read_text()
    disc = ElementTree.fromstring(document).find(".//link[@name='plate']/visual[@name='disc']")
    assert disc is not None
    deck = float(disc.findtext("pose", "").split()[2])
    thickness = float(disc.findtext("geometry/cylinder/length", ""))
    radius = float(disc.findtext("geometry/cylinder/radius", ""))
    side = 0.5 * radius

    builder, plant, _ = scene([document])
    inertia = SpatialInertia.SolidBoxWithMass(0.2, side, side, side)
    box = plant.AddRigidBody("box", plant.AddModelInstance("load"), inertia)
    shape, friction = Box(side, side, side), CoulombFriction(0.5, 0.5)
    plant.RegisterCollisionGeometry(box, RigidTransform(), shape, "box", friction)
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for leg in LEGS:
        plant.GetJointByName(f"motor_{leg}").Lock(context)
    plate = plant.GetBodyByName("plate")
    home = plate.EvalPoseInWorld(context).translation()
    above = deck + thickness / 2 + side / 2
    plant.SetFreeBodyPose(context, box, RigidTransform(home + [0, 0, above + 0.02]))
    plant.get_actuation_input_port().FixValue(context, np.zeros(6))
    simulator.AdvanceTo(2.0)
    where = plate.EvalPoseInWorld(context).translation()
    np.testing.assert_allclose(where, home, atol=1e-3 * radius)  # it is held
    found = box.EvalPoseInWorld(context).translation() - where
    np.testing.assert_allclose(found, [0, 0, above], atol=1e-2 * side)
    contacts = plant.get_contact_results_output_port().Eval(context)
    points = map(contacts.point_pair_contact_info, range(contacts.num_point_pair_contacts()))
    pairs = [(point.bodyA_index(), point.bodyB_index()) for point in points]
    touching = {plant.get_body(index).name() for pair in pairs for index in pair}
    assert touching <= {"box", "plate"}  # nothing of the machine touches itself


@pytest.mark.parametrize("seed", range(3))
def test_a_machine_collides_with_everything_but_itself(seed):
    machine = any_machine(seed)
    _, plant, scene_graph = scene([to_sdformat(machine)])
    plant.Finalize()
    assert scene_graph.model_inspector().GetCollisionCandidates() == set()

    pair = [to_sdformat(dataclasses.replace(machine, name=name)) for name in ("left", "right")]
    _, plant, scene_graph = scene(pair)
    plant.Finalize()
    inspector = scene_graph.model_inspector()
    models = [plant.GetModelInstanceByName(name) for name in ("left", "right")]
    candidates = set()
    for pairs in inspector.GetCollisionCandidates():
        bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(shape)) for shape in pairs]
        assert sorted(body.model_instance() for body in bodies) == models
        candidates.add(frozenset(body.name() for body in bodies))
    links = ["base", "plate", *(f"{part}_{leg}" for part in ("crank", "rod") for leg in LEGS)]
    # Every link can touch every other link of the neighbour; but bases are both fixed to the world.
    expected = {frozenset([a, b]) for a in links for b in links} - {frozenset(["base"])}
    assert candidates == expected


def test_what_collides_is_what_is_seen():
    root = ElementTree.fromstring(to_sdformat(PAPER))
    for link in root.iter("link"):
        shapes = link.findall("collision")
        assert shapes
        for shape in shapes:
            seen = link.find(f"visual[@name='{shape.get('name')}']")
            assert seen is not None
            placed = [[x.findtext("pose")] for x in (seen, shape)]
            drawn = [
                [(e.tag, (e.text or "").split()) for e in x.find("geometry").iter()]
                for x in (seen, shape)
            ]
            assert placed[0] == placed[1] and drawn[0] == drawn[1]
    bare = to_sdformat(PAPER, collision=False)
    assert "collision" not in bare and "visual" in bare


def test_shapes_change_no_run_of_the_machine_alone():
    """To the last bit, through a motion in which cranks and rods of the pairs cross."""
    torque = 1e-3 * np.array([1, -1, 1, -1, 1, -1])
    states = []
    for collision in (False, True):
        builder, plant, _ = scene([])
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        add_mechanism(plant, PAPER, collision)
        simulator = Simulator(builder.Build())
        context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        set_pose(plant, context, PAPER, PAPER.home, np.zeros(6))
        plant.get_actuation_input_port().FixValue(context, torque)
        simulator.AdvanceTo(0.3)
        states.append(plant.GetPositionsAndVelocities(context))
    np.testing.assert_array_equal(*states)
