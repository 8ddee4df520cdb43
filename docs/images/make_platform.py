"""Renders the picture of a mechanism in the README: `python make_platform.py [MECHANISM]`."""

import sys
from pathlib import Path

import matplotlib.image
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from stewart_drake.loop.platforms import add_mechanism, set_pose
from stewart_drake.mechanism.files import load_mechanism

OFFSET = np.array([0.14, -0.16, 0.12, 0.02, 0.01, 0.03])
"""From the home pose, so that one sees that the plate moves: roll, pitch, yaw in rad, xyz in m."""
LIGHTS = [
    LightParameter(type="directional", frame="world", direction=[-0.3, 0.6, -1.0], intensity=0.95),
    LightParameter(type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=0.6),
]


def looking_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> RigidTransform:
    """Pose of a camera at `eye`: z forwards, y down, x level."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), eye)


def render(mechanism_name: str, width: int = 1000, height: int = 900) -> NDArray[np.uint8]:
    """Image (height, width, 4) of the mechanism, `OFFSET` away from home."""
    mechanism = load_mechanism(mechanism_name)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
    add_mechanism(plant, mechanism)
    background = RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=LIGHTS)
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(background))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyContextFromRoot(context)
    set_pose(plant, plant_context, mechanism, mechanism.home + OFFSET, np.zeros(6))

    core = RenderCameraCore(
        "vtk", CameraInfo(width, height, 0.45), ClippingRange(0.1, 10.0), RigidTransform()
    )
    z = mechanism.home[5]
    camera_pose = looking_at(z * np.array([3.0, -2.3, 2.1]), np.array([0.0, 0.0, 0.48 * z]))
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    camera = ColorRenderCamera(core, False)
    return query.RenderColorImage(camera, scene_graph.world_frame_id(), camera_pose).data


if __name__ == "__main__":
    image = render(*(sys.argv[1:] or ["paper"]))
    matplotlib.image.imsave(Path(__file__).with_name("platform.png"), image)
