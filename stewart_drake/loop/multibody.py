"""The multibody plant: the generated SDFormat in Drake's engine, with ball constraints."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    ModelInstanceIndex,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
    UniversalJoint,
)
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    LeafSystem,
)

from stewart_drake.dynamics.workspace import margin
from stewart_drake.loop.sampling import weak
from stewart_drake.mechanism.assembly import joint_state
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.scenario.signals import (
    ANGLES,
    LEGS,
    NUM_STATE,
    NUM_TORQUES,
    POSITION,
)
from stewart_drake.types import Array


def add_mechanism(
    plant: MultibodyPlant,
    mechanism: Mechanism,
    *,
    gravity: bool = True,
    collision: bool = False,
) -> ModelInstanceIndex:
    """`add_model` to a `plant` that holds nothing else, and finalize it."""
    model = add_model(plant, mechanism, collision=collision)
    if not gravity:
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return model


def add_model(
    plant: MultibodyPlant,
    mechanism: Mechanism,
    *,
    payload_mass: float = 0.0,
    payload_position: Sequence[float] = (0.0, 0.0, 0.0),
    joint_damping: float = 0.0,
    collision: bool = False,
    parent: Frame | None = None,
    X_PB: RigidTransform | None = None,
    start: Array | None = None,
) -> ModelInstanceIndex:
    """Add the mechanism's SDFormat to `plant`, which is not finalized yet.

    The plate floats on a roll-pitch-yaw joint, so that positions of that joint are the pose.

    Args:
        plant: where to.
        mechanism: the machine; a second one of its name gets a number.
        payload_mass: kg, a point mass.
        payload_position: m, in the plate's frame, from its COM.
        joint_damping: N m s/rad on the six crank shafts.
        collision: whether its shapes can touch other bodies of `plant`; alone it has nothing to
            touch, and looking for contacts would take a fifth of the time.
        parent: the frame that the base is welded to, the world's if None.
        X_PB: pose of the base in that frame, none if None.
        start: (6,) pose of the plate by default, home if None.
    """
    welded = parent is not None or X_PB is not None
    document = to_sdformat(mechanism, collision=collision, weld=not welded)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    (model,) = parser.AddModelsFromString(document, "sdf")
    plate, under = plant.GetBodyByName("plate", model), plant.world_frame()
    if welded:
        # Relative to the base, as everything that the mechanism knows of its plate.
        under = plant.GetBodyByName("base", model).body_frame()
        plant.WeldFrames(parent or plant.world_frame(), under, X_PB or RigidTransform())
    joint = plant.AddJoint(RpyFloatingJoint("plate", under, plate.body_frame()))
    floating = cast(RpyFloatingJoint, joint)
    if payload_mass > 0:
        place, point = np.array(payload_position), UnitInertia.PointMass
        payload = plant.AddRigidBody(
            "payload", model, SpatialInertia(payload_mass, place, point(place))
        )
        plant.WeldFrames(plate.body_frame(), payload.body_frame())
    pose = mechanism.home if start is None else start
    joints = joint_state(mechanism, pose, np.zeros(6))
    floating.set_default_angles(pose[ANGLES])
    floating.set_default_translation(pose[POSITION])
    for i, leg in enumerate(LEGS):
        motor = cast(RevoluteJoint, plant.GetJointByName(f"motor_{leg}", model))
        motor.set_default_damping(joint_damping)
        motor.set_default_angle(joints.crank[i])
        universal = cast(UniversalJoint, plant.GetJointByName(f"universal_{leg}", model))
        universal.set_default_angles(joints.universal[i])
    return model


def set_pose(
    plant: MultibodyPlant,
    context: Context,
    mechanism: Mechanism,
    pose: Array,
    rates: Array,
    model: ModelInstanceIndex | None = None,
) -> None:
    """Set all positions and velocities of the tree so that every loop is closed.

    `model` is needed where the plant holds several machines.

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
    """Picks pose and rates of the plate out of the tree's state, and watches the workspace.

    Output:  state = [pose; rates], rates of the angles from the angular velocity, E^-1 w.
    Publish: after every step the crank angles and the pose are looked at; the simulation ends when
             a crank passes its dead centre, the cranks no longer hold the plate, or the pitch
             passes 85 degrees (`dynamics.workspace`).

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
        if margin(self._mechanism, tree[self._pose], angles) > 0:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(self, "the plate left its workspace")


class CoulombFriction(LeafSystem):
    """What reaches the shafts: the torque less friction tanh(crank rate / speed).

    A discrete plant reads it at its steps' beginnings, which is stable near rest as long as
    friction / speed times the step is less than twice the least inertia of the cranks; beyond that
    `loop.cautions.stiff_friction` warns.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m |
    | tree_state | input | positions and velocities of the tree | mixed |
    | actuation | output | 6 | N m |

    Args:
        plant: finalized.
        model: the machine in it, needed where there are several.
        friction: N m.
        speed: rad/s.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        model: ModelInstanceIndex | None,
        friction: float,
        speed: float,
    ) -> None:
        super().__init__()
        self._friction, self._speed = friction, speed
        motors = [plant.GetJointByName(f"motor_{leg}", model) for leg in LEGS]
        self._rates = [plant.num_positions() + motor.velocity_start() for motor in motors]
        self._torque = self.DeclareVectorInputPort("torque", NUM_TORQUES)
        self._tree = self.DeclareVectorInputPort("tree_state", plant.num_multibody_states())
        self.DeclareVectorOutputPort("actuation", NUM_TORQUES, weak(self._actuation))

    def _actuation(self, context: Context, output: BasicVector) -> None:
        rates = np.asarray(self._tree.Eval(context))[self._rates]
        friction = self._friction * np.tanh(rates / self._speed)
        output.SetFromVector(np.asarray(self._torque.Eval(context)) - friction)


class PlateWrench(LeafSystem):
    """A wrench on the plate as MultibodyPlant takes it, a list of forces on bodies.

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
