"""The multibody plant: the generated SDFormat in Drake's engine, with ball constraints."""

from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
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

from stewart_drake.lifetime import weak
from stewart_drake.mechanism.assembly import joint_state
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import angle_rate_map
from stewart_drake.mechanism.sdformat import to_sdformat
from stewart_drake.plant.workspace import margin
from stewart_drake.signals import (
    ANGLES,
    LEGS,
    NUM_STATE,
    NUM_TORQUES,
    POSITION,
)

Array = NDArray[np.float64]


def add_mechanism(
    plant: MultibodyPlant,
    mechanism: Mechanism,
    *,
    gravity: bool = True,
    payload_mass: float = 0.0,
    joint_damping: float = 0.0,
) -> None:
    """Add the mechanism's SDFormat to `plant`, which is not finalized yet, and finalize it.

    The plate floats on a roll-pitch-yaw joint, so that positions of that joint are the pose.
    `payload_mass` in kg is a point mass at the plate's COM, `joint_damping` in N m s/rad acts on
    the six crank shafts.
    """
    (model,) = Parser(plant).AddModelsFromString(to_sdformat(mechanism), "sdf")
    plate = plant.GetBodyByName("plate", model)
    plant.AddJoint(RpyFloatingJoint("plate", plant.world_frame(), plate.body_frame()))
    if payload_mass > 0:
        payload = plant.AddRigidBody(
            "payload", model, SpatialInertia(payload_mass, np.zeros(3), UnitInertia(0, 0, 0))
        )
        plant.WeldFrames(plate.body_frame(), payload.body_frame())
    for leg in LEGS:
        motor = cast(RevoluteJoint, plant.GetJointByName(f"motor_{leg}", model))
        motor.set_default_damping(joint_damping)
    if not gravity:
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()


def set_pose(
    plant: MultibodyPlant, context: Context, mechanism: Mechanism, pose: Array, rates: Array
) -> None:
    """Set all positions and velocities of the tree so that every loop is closed.

    Raises:
        UnreachablePoseError: the pose is out of reach.
        SingularPoseError: the plate moves at the dead centre of a leg.
    """
    joints = joint_state(mechanism, pose, rates)
    floating = cast(RpyFloatingJoint, plant.GetJointByName("plate"))
    floating.set_angles(context, pose[ANGLES])
    floating.SetTranslation(context, pose[POSITION])
    floating.set_angular_velocity(context, angle_rate_map(pose[ANGLES]) @ rates[ANGLES])
    floating.set_translational_velocity(context, rates[POSITION])
    for i, leg in enumerate(LEGS):
        crank = cast(RevoluteJoint, plant.GetJointByName(f"motor_{leg}"))
        crank.set_angle(context, joints.crank[i])
        crank.set_angular_rate(context, joints.crank_rate[i])
        universal = cast(UniversalJoint, plant.GetJointByName(f"universal_{leg}"))
        universal.set_angles(context, joints.universal[i])
        universal.set_angular_rates(context, joints.universal_rate[i])


class PlateState(LeafSystem):
    """Picks pose and rates of the plate out of the tree's state, and watches the workspace.

    Output:  state = [pose; rates], rates of the angles from the angular velocity, E^-1 w.
    Publish: after every step the crank angles and the pose are looked at; the simulation ends when
             a crank passes its dead centre, the cranks no longer hold the plate, or the pitch
             passes 85 degrees (`plant.workspace`).

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | tree_state | input | positions and velocities of the tree | mixed |
    | state | output | 12 | rad, m, rad/s, m/s |
    | crank_angles | output | 6 | rad |
    """

    def __init__(self, plant: MultibodyPlant, mechanism: Mechanism) -> None:
        super().__init__()
        self._mechanism = mechanism
        self._home_angles = mechanism.crank_angles(mechanism.home)
        floating = plant.GetJointByName("plate")
        motors = [plant.GetJointByName(f"motor_{leg}") for leg in LEGS]
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
