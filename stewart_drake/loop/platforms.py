"""Platforms in a diagram: the multibody plant, and `AddStewartPlatform`."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Unpack, cast

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import Meshcat, MeshcatVisualizer, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    Frame,
    ModelInstanceIndex,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
    WeldJoint,
)
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
    System,
)
from pydrake.systems.primitives import AffineSystem

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import Failure, diagnose, measures_at
from stewart_drake.files.arguments import fixed, of_kind
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.exact import ExactPlant, Loads, checked_loads, plate_of_mass
from stewart_drake.loop.sampling import ONCE, free_name, weak
from stewart_drake.mechanism.assembly import joint_state
from stewart_drake.mechanism.files import as_mechanism
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.scenario.config import PlantConfig, PushConfig
from stewart_drake.scenario.signals import (
    ANGLES,
    LEGS,
    NUM_STATE,
    NUM_TORQUES,
    POSE,
    POSITION,
    RATES,
)
from stewart_drake.scenario.timing import event_time
from stewart_drake.types import Array, ArrayLike

_LARGEST_TILT = 1e-6
"""Of gravity from the base's z that counts as rounding, rad."""


def add_scene(
    builder: DiagramBuilder, time_step: float = 1e-3
) -> tuple[MultibodyPlant, SceneGraph]:
    """Add an empty plant with a time step in s, and its scene."""
    config = MultibodyPlantConfig(time_step=time_step, discrete_contact_approximation="sap")
    names = [free_name(builder, name) for name in ("plant", "scene_graph")]
    plant, scene_graph = AddMultibodyPlant(config, builder)
    for system, name in zip((plant, scene_graph), names, strict=True):
        system.set_name(name)
    return plant, scene_graph


def add_mechanism(plant: MultibodyPlant, mechanism: Mechanism, collision: bool = False) -> None:
    """Add the mechanism to an otherwise empty `plant`, and finalize it."""
    add_model(plant, mechanism, PlantConfig(), collision=collision)
    plant.Finalize()


def add_model(
    plant: MultibodyPlant,
    mechanism: Mechanism,
    config: PlantConfig,
    *,
    collision: bool = False,
    parent: Frame | None = None,
    X_PB: RigidTransform | None = None,
    start: Array | None = None,
) -> ModelInstanceIndex:
    """Add the mechanism's SDFormat to a `plant` that is not finalized.

    The plate floats on a roll-pitch-yaw joint with the pose as its positions.

    Args:
        mechanism: the machine; the name of a second one gets a number.
        config: of which payload and joint damping are used here.
        collision: whether its shapes collide with other bodies of `plant`; the search for contacts
            takes a fifth of the time.
        parent: frame of the base's weld, the world's if None.
        X_PB: pose of the base in that frame, identity if None.
        start: (6,) pose of the plate by default, home if None.
    """
    welded = parent is not None or X_PB is not None
    document = to_sdformat(mechanism, collision=collision, weld=not welded)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    (model,) = parser.AddModelsFromString(document, "sdf")
    plate, under = plant.GetBodyByName("plate", model), plant.world_frame()
    if welded:
        # The pose of the plate is relative to the base.
        under = plant.GetBodyByName("base", model).body_frame()
        plant.WeldFrames(parent or plant.world_frame(), under, X_PB or RigidTransform())
    joint = plant.AddJoint(RpyFloatingJoint("plate", under, plate.body_frame()))
    floating = cast(RpyFloatingJoint, joint)
    # Also without mass, which a context may change.
    point_mass = _point_mass(config.payload_mass, config.payload_position)
    payload = plant.AddRigidBody("payload", model, point_mass)
    plant.WeldFrames(plate.body_frame(), payload.body_frame())
    pose = mechanism.home if start is None else start
    joints = joint_state(mechanism, pose, np.zeros(6))
    floating.set_default_angles(pose[ANGLES])
    floating.set_default_translation(pose[POSITION])
    for i, leg in enumerate(LEGS):
        motor = cast(RevoluteJoint, plant.GetJointByName(f"motor_{leg}", model))
        motor.set_default_damping(config.joint_damping)
        motor.set_default_angle(joints.crank[i])
        universal = cast(UniversalJoint, plant.GetJointByName(f"universal_{leg}", model))
        universal.set_default_angles(joints.universal[i])
    return model


def _gravity_in_base(plant: MultibodyPlant, parent: Frame | None, X_PB: RigidTransform) -> float:
    """Return the plant's gravity along -z of a base at X_PB in the parent, m/s^2.

    Raises:
        ConfigError: the base can move, or gravity is not along its z.
    """
    parent = parent or plant.world_frame()
    X_WP = _welded_pose(plant, parent)
    if X_WP is None:
        raise ConfigError(
            f"parent: got {parent.name()}, a frame that can move; expected one that is welded to "
            "the world, or PlantConfig(gravity=False)"
        )
    g_W = plant.gravity_field().gravity_vector()
    g_B = X_WP.rotation().multiply(X_PB.rotation()).inverse().multiply(g_W)
    tilt = np.arctan2(np.hypot(g_B[0], g_B[1]), abs(g_B[2]))
    if tilt > _LARGEST_TILT:
        raise ConfigError(
            f"X_PB: got a base whose z is {np.rad2deg(tilt):.3g} degrees from the plant's gravity; "
            "expected 0 (with any yaw), or PlantConfig(gravity=False)"
        )
    return 0.0 - float(g_B[2])


def _welded_pose(plant: MultibodyPlant, frame: Frame) -> RigidTransform | None:
    """Return X_WF of a frame, also before `plant.Finalize()`; None if its body can move."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    welds = [joint for joint in joints if isinstance(joint, WeldJoint)]
    poses = {plant.world_body().index(): RigidTransform()}
    for _ in welds:  # each pass reaches the bodies that are one weld further from the world
        for weld in welds:
            P, C = weld.parent_body().index(), weld.child_body().index()
            X_PF = weld.frame_on_parent().GetFixedPoseInBodyFrame()
            X_CM = weld.frame_on_child().GetFixedPoseInBodyFrame()
            X_PC = X_PF @ weld.X_FM() @ X_CM.inverse()
            if P in poses:
                poses[C] = poses[P] @ X_PC
            elif C in poses:
                poses[P] = poses[C] @ X_PC.inverse()
    X_WB = poses.get(cast(Any, frame).body().index())  # Drake's stubs have no type of it
    return None if X_WB is None else X_WB @ frame.GetFixedPoseInBodyFrame()


def _point_mass(mass: float, place: Sequence[float]) -> SpatialInertia:
    """Return the inertia of a mass in kg at a place (3,) in m, about the frame's origin."""
    return SpatialInertia(mass, np.array(place), UnitInertia.PointMass(np.array(place)))


def set_pose(
    plant: MultibodyPlant,
    context: Context,
    mechanism: Mechanism,
    pose: Array,
    rates: Array,
    model: ModelInstanceIndex | None = None,
) -> None:
    """Set all positions and velocities of the tree so that every loop is closed.

    `model` is needed for a plant with several machines.

    Raises:
        UnreachablePoseError: the pose is out of reach.
        SingularPoseError: the plate moves at the dead centre of a leg.
    """
    joints = joint_state(mechanism, pose, rates)
    floating = cast(RpyFloatingJoint, plant.GetJointByName("plate", model))
    floating.set_angles(context, pose[ANGLES])
    floating.SetTranslation(context, pose[POSITION])
    floating.set_angular_velocity(context, angle_rate_map(pose[ANGLES]) @ rates[ANGLES])
    floating.set_translational_velocity(context, rates[POSITION])
    for i, leg in enumerate(LEGS):
        crank = cast(RevoluteJoint, plant.GetJointByName(f"motor_{leg}", model))
        crank.set_angle(context, joints.crank[i])
        crank.set_angular_rate(context, joints.crank_rate[i])
        universal = cast(UniversalJoint, plant.GetJointByName(f"universal_{leg}", model))
        universal.set_angles(context, joints.universal[i])
        universal.set_angular_rates(context, joints.universal_rate[i])


class PlateState(LeafSystem):
    """Pose and rates of the plate from the tree's state, with a check of the workspace.

    Output:  state = [pose; rates], rates of the angles from the angular velocity, E^-1 w.
    Publish: after every step; the simulation ends when a crank passes its dead centre, the cranks
             no longer hold the plate, or the pitch passes 85 degrees (`dynamics.workspace`).

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | tree_state | input | positions and velocities of the tree | mixed |
    | state | output | 12 | rad, m, rad/s, m/s |
    | crank_angles | output | 6 | rad |
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        mechanism: Mechanism,
        model: ModelInstanceIndex | None = None,
    ) -> None:
        super().__init__()
        self._mechanism = mechanism
        self._home_angles = mechanism.crank_angles(mechanism.home)
        floating = plant.GetJointByName("plate", model)
        motors = [plant.GetJointByName(f"motor_{leg}", model) for leg in LEGS]
        q, v = floating.position_start(), plant.num_positions() + floating.velocity_start()
        self._pose, self._twist = slice(q, q + 6), slice(v, v + 6)
        self._cranks = [motor.position_start() for motor in motors]
        size = plant.num_multibody_states()
        self._tree = self.DeclareVectorInputPort("tree_state", size)
        self.DeclareVectorOutputPort("state", NUM_STATE, weak(self._state))
        self.DeclareVectorOutputPort("crank_angles", NUM_TORQUES, weak(self._angles))
        self.DeclarePerStepPublishEvent(weak(self._watch))

    def _state(self, context: Context, output: BasicVector) -> None:
        tree = np.asarray(self._tree.Eval(context))
        pose, twist = tree[self._pose], tree[self._twist]
        angle_rates = np.linalg.solve(angle_rate_map(pose[ANGLES]), twist[:3])
        output.SetFromVector(np.concatenate([pose, angle_rates, twist[3:]]))

    def _angles(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._home_angles + np.asarray(self._tree.Eval(context))[self._cranks])

    def _watch(self, context: Context) -> EventStatus:
        tree = np.asarray(self._tree.Eval(context))
        angles = self._home_angles + tree[self._cranks]
        if measures_at(self._mechanism, tree[self._pose], angles).margin > 0:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(self, "the plate left its workspace")


class CoulombFriction(LeafSystem):
    """Coulomb friction: actuation = torque - friction tanh(crank rate / speed).

    A discrete plant reads it at the beginning of a step, which is stable near rest if
    friction / speed times the step is less than twice the least inertia of the cranks. Otherwise
    `loop.cautions.stiff_friction` warns.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m |
    | tree_state | input | positions and velocities of the tree | mixed |
    | actuation | output | 6 | N m |

    Args:
        plant: finalized.
        model: the machine in it, needed for several.
        friction: N m, element 0 of the numeric parameter.
        speed: rad/s, element 1.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        model: ModelInstanceIndex | None,
        friction: float,
        speed: float,
    ) -> None:
        super().__init__()
        self.DeclareNumericParameter(BasicVector([friction, speed]))
        motors = [plant.GetJointByName(f"motor_{leg}", model) for leg in LEGS]
        self._rates = [plant.num_positions() + motor.velocity_start() for motor in motors]
        self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
        self._tree = self.DeclareVectorInputPort("tree_state", plant.num_multibody_states())
        self.DeclareVectorOutputPort("actuation", NUM_TORQUES, weak(self._actuation))

    def _actuation(self, context: Context, output: BasicVector) -> None:
        rates = np.asarray(self._tree.Eval(context))[self._rates]
        size, speed = context.get_numeric_parameter(0).value()
        friction = size * np.tanh(rates / speed)
        output.SetFromVector(np.asarray(self._torque.Eval(context)) - friction)


class PlateWrench(LeafSystem):
    """A wrench on the plate as a list of forces on bodies for MultibodyPlant.

    The plate's frame has its origin at the COM, where the wrench acts.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | wrench | input | 6, moment then force, in W; unconnected it is zero | N m, N |
    | spatial_forces | output | list of ExternallyAppliedSpatialForce | - |
    """

    def __init__(self, plant: MultibodyPlant, model: ModelInstanceIndex | None = None) -> None:
        super().__init__()
        self._plate = plant.GetBodyByName("plate", model).index()
        self._wrench = self.DeclareVectorInputPort("wrench", 6)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: Value[list[ExternallyAppliedSpatialForce]](),
            weak(self._forces),
            {self._wrench.ticket()},
        )

    def _forces(self, context: Context, output: AbstractValue) -> None:
        forces = []
        if self._wrench.HasValue(context):
            wrench = np.asarray(self._wrench.Eval(context))
            force = ExternallyAppliedSpatialForce()
            force.body_index = self._plate
            force.F_Bq_W = SpatialForce(tau=wrench[:3], f=wrench[3:])
            forces.append(force)
        output.set_value(forces)


class StewartPlatform:
    """Ports of a platform that `AddStewartPlatform` added to a diagram.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m, at the shafts |
    | wrench | input | 6, moment then force, at the plate's COM | N m, N, in the world |
    | state | output | 12, pose and rates relative to the base | rad, m, rad/s, m/s |
    | crank_angles | output | 6, of a multibody plant only | rad |

    An unconnected wrench is zero, and so is an unconnected torque of a multibody plant. The torque
    has no limit: add a `Saturation` for that of the motors. A multibody plant ends the simulation
    where the plate leaves its workspace, as the exact one does, if one of the outputs is used.

    Attributes:
        mechanism: the machine.
        plant: an `ExactPlant` or a `MultibodyPlant`.
        model: its model in the MultibodyPlant, None for an exact plant.
        scene_graph: added with a MultibodyPlant, else None.
    """

    def __init__(
        self,
        builder: DiagramBuilder,
        mechanism: Mechanism,
        config: PlantConfig,
        dynamics: StewartDynamics | ConfigError,
        plant: Any,
        model: ModelInstanceIndex | None = None,
        scene_graph: SceneGraph | None = None,
    ) -> None:
        self.mechanism, self.plant, self.model = mechanism, plant, model
        self.scene_graph, self._dynamics = scene_graph, dynamics
        self._builder, self._config = builder, config
        self._added: dict[str, Any] = {}
        self._gravity: Any = (
            None if model is None else plant.gravity_field().gravity_vector().copy()
        )

    def __repr__(self) -> str:
        engine = "exact" if self.model is None else "multibody"
        return f"StewartPlatform({self.mechanism}, {engine})"

    @property
    def dynamics(self) -> StewartDynamics:
        """Equations of motion, with gravity and the loads of `PlantConfig`, which a law then knows.

        Raises:
            ConfigError: gravity, and a base that is tilted or can move.
        """
        if isinstance(self._dynamics, ConfigError):
            raise self._dynamics
        return self._dynamics

    @property
    def engine(self) -> dict[str, Any]:
        """Fields `kind` and, of a MultibodyPlant, `time_step` of a scenario's `plant`."""
        if self.model is None:
            return {"kind": "exact"}
        return {"kind": "multibody", "time_step": self.plant.time_step()}

    def GetInputPort(self, name: str) -> InputPort:
        """Return the port `torque` or `wrench`.

        Raises:
            ConfigError: another name, a MultibodyPlant that is not finalized, or one whose gravity
                was changed since the platform was added.
        """
        if name not in ("torque", "wrench"):
            raise ConfigError(f"input port: got {name!r}; expected torque or wrench")
        if self.model is None:
            return self.plant.GetInputPort(name)
        self._check_finalized()
        if name == "wrench":
            forces = self.plant.get_applied_spatial_force_input_port()
            return self._before(forces, name, lambda: PlateWrench(self.plant, self.model))
        port, c = self.plant.get_actuation_input_port(self.model), self._config
        if c.coulomb_friction > 0:
            shafts = (self.plant, self.model, c.coulomb_friction, c.coulomb_speed)
            port = self._before(port, "coulomb_friction", lambda: CoulombFriction(*shafts))
        if any(c.torque_bias):
            bias = np.array(c.torque_bias)
            port = self._before(port, "torque_bias", lambda: add_to_torque(bias))
        return port

    def GetOutputPort(self, name: str) -> OutputPort:
        """Return the port `state`, or `crank_angles` of a multibody plant.

        Raises:
            ConfigError: as `GetInputPort`.
        """
        names = ("state",) if self.model is None else ("state", "crank_angles")
        if name not in names:
            raise ConfigError(f"output port: got {name!r}; expected {' or '.join(names)}")
        if self.model is None:
            return self.plant.GetOutputPort(name)
        system = self._added_once(
            "plate_state", lambda: PlateState(self.plant, self.mechanism, self.model)
        )
        return system.GetOutputPort(name)

    def SetState(self, context: Context, state: ArrayLike) -> None:
        """Put the platform, in its diagram's root context, into [pose; rates] (12,).

        Raises:
            ConfigError: another shape.
            UnreachablePoseError, SingularPoseError: see `loop.platforms.set_pose`.
        """
        x = fixed("state", state, (NUM_STATE,))
        self.mechanism.crank_angles(x[POSE])  # raises if out of reach
        own = self.plant.GetMyMutableContextFromRoot(context)
        if self.model is None:
            self.plant.set_state(own, x)
        else:
            set_pose(self.plant, own, self.mechanism, x[POSE], x[RATES], self.model)

    def SetParameters(
        self, context: Context, *, plate_mass: float | None = None, **loads: Unpack[Loads]
    ) -> None:
        """Change mass, payload and friction in the diagram's root context; others stay.

        A multibody plant has them as parameters of its bodies `plate` and `payload`, of its joints
        `motor_1` to `motor_6`, and of `CoulombFriction`.

        Args:
            context: root context.
            plate_mass: kg; the plate's moments of inertia stay.
            **loads: payload_mass (kg), payload_position ((3,) m), joint_damping (N m s/rad),
                coulomb_friction (N m), coulomb_speed (rad/s).

        Raises:
            ConfigError: another name, a value out of its bounds, or Coulomb friction of a multibody
                plant that was built without it.
        """
        own = self.plant.GetMyMutableContextFromRoot(context)
        if self.model is None:
            self.plant.set_parameters(own, plate_mass=plate_mass, **loads)
            return
        new = checked_loads(loads)
        shafts = [name for name in loads if name.startswith("coulomb")]
        if shafts and "coulomb_friction" not in self._added:
            raise ConfigError(
                f"{shafts[0]}: got a platform without Coulomb friction; expected one built with "
                "PlantConfig(coulomb_friction=...) above 0"
            )
        if plate_mass is not None:
            body, centre = plate_of_mass(self.mechanism, plate_mass), np.zeros(3)
            inertia = SpatialInertia(body.mass, centre, UnitInertia(*body.inertia / body.mass))
            plate = self.plant.GetBodyByName("plate", self.model)
            plate.SetSpatialInertiaInBodyFrame(own, inertia)
        payload = self.plant.GetBodyByName("payload", self.model)
        if "payload_position" in loads:
            point_mass = _point_mass(payload.get_mass(own), new.payload_position)
            payload.SetSpatialInertiaInBodyFrame(own, point_mass)
        if "payload_mass" in loads:
            payload.SetMass(own, new.payload_mass)
        if "joint_damping" in loads:
            for leg in LEGS:
                motor = self.plant.GetJointByName(f"motor_{leg}", self.model)
                motor.SetDamping(own, new.joint_damping)
        for name in shafts:
            shaft: Context = self._added["coulomb_friction"].GetMyMutableContextFromRoot(context)
            parameter = shaft.get_mutable_numeric_parameter(0)
            parameter.SetAtIndex(int(name == "coulomb_speed"), getattr(new, name))

    def _check_finalized(self) -> None:
        if not self.plant.is_finalized():
            raise ConfigError(
                "plant: got one that is not finalized; expected GetInputPort and GetOutputPort "
                "after plant.Finalize()"
            )
        gravity = self.plant.gravity_field().gravity_vector()
        if self._config.gravity and not np.array_equal(gravity, self._gravity):
            raise ConfigError(
                f"plant: got gravity {gravity.tolist()}, {self._gravity.tolist()} when the "
                "platform was added; expected it to be set before AddStewartPlatform"
            )

    def _added_once(self, name: str, make: Callable[[], System]) -> Any:
        if name in self._added:
            return self._added[name]
        self._check_finalized()
        system = make()
        name_there = f"{self.plant.GetModelInstanceName(self.model)}_{name}"
        self._builder.AddNamedSystem(free_name(self._builder, name_there), system)
        if system.HasInputPort("tree_state"):
            tree = self.plant.get_state_output_port()
            self._builder.Connect(tree, system.GetInputPort("tree_state"))
        self._added[name] = system
        return system

    def _before(self, port: InputPort, name: str, make: Callable[[], System]) -> InputPort:
        """Return the input of a system, made once, with its output connected to `port`."""
        if name not in self._added:
            if self._builder.IsConnectedOrExported(port):
                raise ConfigError(
                    f"{name}: got a plant whose {port.get_name()} is connected; "
                    "expected it to be free"
                )
            self._builder.Connect(self._added_once(name, make).get_output_port(), port)
        return self._added[name].get_input_port(0)


def add_to_torque(bias: Array) -> AffineSystem:
    """Return the system y = u + bias (6,), Drake's y = C x + D u + y0 without a state x."""
    nothing = np.empty((0, 0)), np.empty((0, NUM_TORQUES)), np.empty(0)
    return AffineSystem(*nothing, np.empty((NUM_TORQUES, 0)), np.eye(NUM_TORQUES), bias)


def AddStewartPlatform(
    builder: DiagramBuilder,
    mechanism: Mechanism | str,
    config: PlantConfig | None = None,
    *,
    plant: MultibodyPlant | None = None,
    parent: Frame | None = None,
    X_PB: RigidTransform | None = None,
    collision: bool = True,
    start: ArrayLike | None = None,
) -> StewartPlatform:
    """Add a platform to a diagram.

    With a `plant` the machine becomes a model in it, among other bodies. The caller calls
    `plant.Finalize()` afterwards, and then the methods for its ports. Without a `plant` one is
    added: an `ExactPlant`, or a finalized MultibodyPlant with a SceneGraph. The simulator of a
    diagram with exact plants needs `sd.set_accuracy`.

    Args:
        mechanism: the machine, or a name or path for `load_mechanism`.
        config: kind, gravity, time step and loads, as a scenario's `plant`, by default without
            gravity; with a `plant`, `time_step` is that plant's, and so is the size of gravity.
            Without gravity, that of the `plant` is switched off for the machine only. `mechanism`
            is ignored.
        plant: a MultibodyPlant that is not finalized, registered with a SceneGraph. Set its gravity
            before: `dynamics` reads it here.
        parent: frame of `plant` for the weld of the base, the world's if None.
        X_PB: pose of the base in that frame, identity if None. With gravity, `dynamics` and thus a
            law need a base that cannot move, with a vertical z.
        collision: whether plate, base, cranks and rods collide with other bodies of a given
            `plant`; never with each other.
        start: (6,) pose by default, home if None.

    Raises:
        ConfigError: bad input, such as a plant that is finalized, or given for kind exact.
        UnreachablePoseError: a start out of reach.
    """
    machine = as_mechanism(mechanism)
    config = PlantConfig() if config is None else config
    of_kind("config", config, PlantConfig)
    if X_PB is not None:
        of_kind("X_PB", X_PB, RigidTransform)
    pose = machine.home if start is None else fixed("start", start, (6,))
    machine.crank_angles(pose)  # raises if out of reach
    if config.kind == "paper":
        raise ConfigError(
            "plant.kind: got 'paper', a model without legs; expected 'multibody' or 'exact'"
        )
    if config.kind == "multibody":
        for name in ("ball_joint_damping", "ball_joint_friction"):
            if value := getattr(config, name):
                raise ConfigError(f"plant.{name}: got {value:g}; expected 0, or plant.kind exact")
    if any(config.push.wrench):
        raise ConfigError(
            f"plant.push.wrench: got {config.push.wrench} for a platform in your own diagram; "
            "expected zeros, and a source for the platform's input wrench"
        )
    if config.kind == "exact":
        for name, given in (("plant", plant), ("parent", parent), ("X_PB", X_PB)):
            if given is not None:
                raise ConfigError(
                    f"{name}: got one for plant.kind exact; expected kind multibody, which can be "
                    "among other bodies"
                )
        equations = StewartDynamics(machine, config.gravity, config.parameters)
        exact = ExactPlant(equations, np.concatenate([pose, np.zeros(6)]), wrench=True)
        exact.set_name(free_name(builder, machine.name))
        return StewartPlatform(builder, machine, config, equations, builder.AddSystem(exact))
    scene_graph = None
    if plant is not None:
        of_kind("plant", plant, MultibodyPlant)
        if plant.is_finalized():
            raise ConfigError(
                "plant: got one that is finalized; expected one before plant.Finalize()"
            )
        if not plant.time_step() > 0:
            raise ConfigError(
                "plant: got a continuous one; expected MultibodyPlant(time_step) above 0, as "
                "constraints close the legs"
            )
    own = plant is None
    if plant is None:
        plant, scene_graph = add_scene(builder, config.time_step)
    dynamics: StewartDynamics | ConfigError
    try:
        g = _gravity_in_base(plant, parent, X_PB or RigidTransform()) if config.gravity else 0.0
    except ConfigError as error:
        dynamics = error  # raised where a law asks for them
    else:
        dynamics = StewartDynamics(machine, g, config.parameters)
    model = add_model(
        plant,
        dataclasses.replace(machine, effort_limit=None),
        config,
        collision=collision and not own,
        parent=parent,
        X_PB=X_PB,
        start=pose,
    )
    if not config.gravity:
        plant.set_gravity_enabled(model, False)
    if own:
        plant.Finalize()
    return StewartPlatform(builder, machine, config, dynamics, plant, model, scene_graph)


class MultibodyStewart(Diagram):
    """The machine in Drake's multibody engine (SAP), with the ports of `ExactPlant`.

    Like `ExactPlant` it has no torque limit; the limit acts before it.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m |
    | wrench | input | 6, optional | N m, N, in W at the plate's COM |
    | state | output | 12 | rad, m, rad/s, m/s |
    | crank_angles | output | 6 | rad |
    | query | output | SceneGraph query object | - |

    Args:
        time_step: s.
        meshcat: shows it, or None.
        start: (6,) pose by default, home if None.
        wrench: whether there is an input for a wrench on the plate; unconnected it is zero.
        **fields: other fields of `PlantConfig`; with gravity by default.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        time_step: float = 1e-3,
        *,
        meshcat: Meshcat | None = None,
        start: ArrayLike | None = None,
        wrench: bool = False,
        **fields: Any,
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        config = PlantConfig(time_step=time_step, **{"gravity": True} | fields)
        platform = AddStewartPlatform(builder, mechanism, config, start=start)
        for name in ("torque", "wrench") if wrench else ("torque",):
            builder.ExportInput(platform.GetInputPort(name), name)
        for name in ("state", "crank_angles"):
            builder.ExportOutput(platform.GetOutputPort(name), name)
        assert platform.scene_graph is not None
        builder.ExportOutput(platform.scene_graph.get_query_output_port(), "query")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, platform.scene_graph, meshcat)
        builder.BuildInto(self)
        self.mechanism, self.tree, self.platform = mechanism, platform.plant, platform

    def set_state(self, context: Context, state: Array) -> None:
        """Put the machine, in its own context, into [pose; rates] (12,), all loops closed."""
        tree_context = self.GetMutableSubsystemContext(self.tree, context)
        set_pose(self.tree, tree_context, self.mechanism, state[POSE], state[RATES])

    def diagnose(self, context: Context) -> Failure | None:
        state, cranks = (
            np.asarray(self.GetOutputPort(name).Eval(context)) for name in ("state", "crank_angles")
        )
        return diagnose(self.mechanism, context.get_time(), state[POSE], cranks)


def build_viewer(mechanism: Mechanism, meshcat: Meshcat) -> tuple[Diagram, MultibodyPlant]:
    """Build a diagram that shows the SDFormat model in Meshcat."""
    builder = DiagramBuilder()
    plant, scene_graph = add_scene(builder)
    add_mechanism(plant, mechanism)
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    return builder.Build(), plant


class StartCheck(LeafSystem):
    """Warns at initialisation if a plate with a start in motion is at rest.

    A MultibodyPlant has default positions, but no default velocities: a context made in C++, such
    as that of `Simulator(loop)`, is at rest.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | state | input | 12 | rad, m, rad/s, m/s |
    """

    def __init__(self, start: Array) -> None:
        super().__init__()
        self._start = start
        self._state = self.DeclareVectorInputPort("state", NUM_STATE)
        self.DeclareInitializationPublishEvent(weak(self._look))

    def _look(self, context: Context) -> EventStatus:
        state = np.asarray(self._state.Eval(context))
        there = np.allclose(state[POSE], self._start[POSE], rtol=0, atol=1e-9)
        if there and not state[RATES].any():
            warnings.warn(
                "the plate starts at rest, where the scenario starts it in motion: make the "
                "simulator with Simulator(loop, loop.CreateDefaultContext())",
                stacklevel=2,
            )
        return EventStatus.Succeeded()


class Push(LeafSystem):
    """A constant wrench between two times.

    Initialise: u = wrench if the push starts at 0 s, else 0.
    Update:     at `start` u <- wrench, at `end` u <- 0, before a discrete plant's step from there,
                so that integrators stop at both.
    Output:     wrench = u.

    | port | direction | size | unit | rate |
    | --- | --- | --- | --- | --- |
    | wrench | output | 6, moment then force, in W at the plate's COM | N m, N | held |
    """

    def __init__(self, push: PushConfig) -> None:
        super().__init__()
        self._wrench = np.array(push.wrench)
        held = self.DeclareDiscreteState(np.array(push.at(0.0)))
        self.DeclareStateOutputPort("wrench", held)
        for time, share in ((push.start, 1.0), (push.end, 0.0)):
            if 0 < time < math.inf:
                change = weak(self._change, share)
                self.DeclarePeriodicDiscreteUpdateEvent(ONCE, event_time(time), change)

    def _change(self, share: float, context: Context, state: DiscreteValues) -> EventStatus:
        state.get_mutable_vector().SetFromVector(share * self._wrench)
        return EventStatus.Succeeded()
