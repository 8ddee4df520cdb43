"""A platform and a loose box in a user's MultibodyPlant: the box stays on the moving plate.

python diagrams/box_on_plate.py
"""

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

import stewart_drake as sd

MASS, SIDE = 0.1, 0.05
"""Of the box, kg and m."""
DECK = 0.02
"""Height in m above the plate's COM from which the box is dropped onto its disc."""


class Sway(LeafSystem):
    """Computed torque for a motion from rest about home, the box taken for a payload."""

    def __init__(self, mechanism: sd.Mechanism) -> None:
        super().__init__()
        self.home = mechanism.home
        self.dynamics = sd.StewartDynamics(mechanism, True, [0] * 6 + [MASS, 0])
        self.DeclareVectorInputPort("state", 12)
        self.DeclareVectorOutputPort("torque", 6, self.calc_torque)

    def calc_torque(self, context, output) -> None:
        x, t = self.get_input_port().Eval(context), context.get_time()
        size, w = np.array([0.1, 0.08, 0.3, 0.02, 0.02, 0.02]), 3.0
        pose, rates = self.home + size * (1 - np.cos(w * t)) / 2, size * w * np.sin(w * t) / 2
        wanted = size * w**2 * np.cos(w * t) / 2 + 40 * (rates - x[6:]) + 400 * (pose - x[:6])
        output.SetFromVector(self.dynamics.inverse_dynamics(x[:6], x[6:], wanted))


def build(mechanism: sd.Mechanism, X_WB: RigidTransform | None = None):
    """Return diagram, plant and box; the base of the platform is at X_WB in the world."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 1e-3)
    config = sd.PlantConfig(gravity=True)
    platform = sd.AddStewartPlatform(
        builder, mechanism, config, plant=plant, X_PB=X_WB, collision=True
    )
    inertia = SpatialInertia.SolidBoxWithMass(MASS, SIDE, SIDE, SIDE)
    box = plant.AddRigidBody("box", plant.AddModelInstance("load"), inertia)
    shape, friction = Box(SIDE, SIDE, SIDE), CoulombFriction(0.9, 0.8)
    plant.RegisterCollisionGeometry(box, RigidTransform(), shape, "box", friction)
    plant.Finalize()
    sway = builder.AddSystem(Sway(mechanism))
    builder.Connect(platform.GetOutputPort("state"), sway.get_input_port())
    builder.Connect(sway.get_output_port(), platform.GetInputPort("torque"))
    return builder.Build(), plant, box


def main(X_WB: RigidTransform | None = None) -> np.ndarray:
    """Print and return positions (20, 3) of the box in the plate, every tenth of a second."""
    diagram, plant, box = build(sd.load_mechanism("paper"), X_WB)
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plate, places = plant.GetBodyByName("plate"), []
    above = plate.EvalPoseInWorld(context) @ RigidTransform([0, 0, DECK + SIDE / 2])
    plant.SetFreeBodyPose(context, box, above)
    print("t in s   box in the plate, mm   plate's height, mm")
    for t in np.arange(0.1, 2.05, 0.1):
        simulator.AdvanceTo(t)
        X_WP = plate.EvalPoseInWorld(context)
        places.append((X_WP.inverse() @ box.EvalPoseInWorld(context)).translation())
        x, y, z = 1e3 * places[-1]
        print(f"{t:6.1f}  {x:7.3f} {y:7.3f} {z:7.3f}   {1e3 * X_WP.translation()[2]:7.1f}")
    return np.array(places)


if __name__ == "__main__":
    main()
