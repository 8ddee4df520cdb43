"""Renders the animation of the README, *delay.gif*: `python -m docs.images.make_animation`.

Two controllers on the paper's experiment, from rest, with every torque 0.8 s late: one that knows
of no delay, and `predictor_lqi`. The ring is where the plate should be.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from pydrake.common import MemoryFile
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    InMemoryMesh,
    MakeRenderEngineVtk,
    Mesh,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo

import stewart_drake as sd
from docs.images.make_platform import LIGHTS, looking_at
from stewart_drake.loop.platforms import add_mechanism, set_pose
from stewart_drake.loop.scene import pointer, ring

Array = NDArray[np.float64]

SHOWN: Final = {"lqi": "a controller that ignores the delay", "predictor_lqi": "predictor_lqi"}
SECONDS: Final = 7.0
FRAMES_PER_S: Final = 10
SIZE: Final = (400, 330)
"""Pixels of one picture, of which there are two beside each other."""
CAPTION: Final = 30
COLORS: Final = 40
GREEN: Final = [0.0, 0.62, 0.45, 0.9]
PLATE_RADIUS: Final = 0.125
"""m, of the drawn plate; the ring is larger."""


class Studio:
    """A mechanism and the ring of its reference before a camera.

    Args:
        mechanism: that is drawn.
        radius: of the ring, m; the plate is smaller.
        distance: of the camera, relative to that for `paper`.
    """

    def __init__(
        self, mechanism: sd.Mechanism, radius: float = PLATE_RADIUS, distance: float = 1.0
    ) -> None:
        self.mechanism = mechanism
        builder = DiagramBuilder()
        self.plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=1e-3)
        add_mechanism(self.plant, mechanism)
        self.wanted = builder.AddSystem(MultibodyPlant(time_step=1e-3))
        self.wanted.RegisterAsSourceForSceneGraph(scene_graph)
        self.ring = self.wanted.AddRigidBody("ring")
        for name, shape in (("ring", ring(radius)), ("pointer", pointer(radius))):
            self.wanted.RegisterVisualGeometry(
                self.ring, RigidTransform(), mesh(*shape), name, GREEN
            )
        self.wanted.Finalize()
        builder.Connect(
            self.wanted.get_geometry_pose_output_port(),
            scene_graph.get_source_pose_port(self.wanted.get_source_id()),
        )
        white = RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=LIGHTS)
        scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(white))
        self.scene_graph, self.diagram = scene_graph, builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        core = RenderCameraCore(
            "vtk", CameraInfo(*SIZE, 0.5), ClippingRange(0.1, 10.0), RigidTransform()
        )
        self.camera = ColorRenderCamera(core, False)
        z = mechanism.home[5]
        target = np.array([0.0, 0.0, 0.62 * z])
        away = z * np.array([3.0, -2.3, 2.1]) - target
        self.eye = looking_at(target + distance * away, target)

    def picture(self, pose: Array, wanted: Array) -> Image.Image:
        """Return the plate at a pose (6,) and the ring at another, rad and m."""
        context = self.plant.GetMyContextFromRoot(self.context)
        set_pose(self.plant, context, self.mechanism, pose, np.zeros(6))
        place = RigidTransform(RollPitchYaw(wanted[:3]), wanted[3:])
        self.wanted.SetFreeBodyPose(
            self.wanted.GetMyContextFromRoot(self.context), self.ring, place
        )
        context = self.scene_graph.GetMyContextFromRoot(self.context)
        query = self.scene_graph.get_query_output_port().Eval(context)
        frame = self.scene_graph.world_frame_id()
        return Image.fromarray(query.RenderColorImage(self.camera, frame, self.eye).data[:, :, :3])


def mesh(vertices: Array, faces: NDArray[np.int32]) -> Mesh:
    """Of vertices (3, n) in m and triangles (3, m)."""
    corners = vertices.T[faces.T]  # triangle, corner, axis
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    lines = ["v {} {} {}".format(*vertex) for vertex in vertices.T]
    lines += ["vn {} {} {}".format(*normal) for normal in normals]
    lines += [f"f {a}//{k} {b}//{k} {c}//{k}" for k, (a, b, c) in enumerate(faces.T + 1, 1)]
    return Mesh(InMemoryMesh(mesh_file=MemoryFile("\n".join(lines), ".obj", "ring")))


def film(name: str) -> list[Image.Image]:
    """Return a run of a controller; once the plate has left its workspace it stays where it did."""
    settings = ("plant.kind=exact", f"duration={SECONDS}", f"log_period={1 / FRAMES_PER_S}")
    scenario = sd.load_scenario("paper", name, settings)
    whole = sd.simulate(sd.load_scenario("paper", "predictor_lqi", settings), judge_stability=False)
    run = sd.simulate(scenario, judge_stability=False)
    studio, font = Studio(sd.load_mechanism("paper")), lettering(15)
    pictures = []
    for time in np.arange(0, SECONDS, 1 / FRAMES_PER_S):
        wanted = whole.signals.reference.sel(time=time, method="nearest").values[:6]
        pose = run.signals.pose.sel(time=time, method="nearest").values
        picture = Image.new("RGB", (SIZE[0], SIZE[1] + CAPTION), "white")
        picture.paste(studio.picture(pose, wanted), (0, CAPTION))
        draw = ImageDraw.Draw(picture)
        draw.text((12, 8), SHOWN[name], fill="#222222", font=font)
        end = run.signals.time.values[-1]
        if run.status != "completed" and time >= end:
            draw.text((12, CAPTION), f"lost after {end:.1f} s", fill="#c03000", font=font)
        pictures.append(picture)
    return pictures


def lettering(size: int) -> ImageFont.FreeTypeFont:
    """Return the letters of matplotlib's figures."""
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)


def write(path: Path, films: Iterable[list[Image.Image]]) -> None:
    """Write two films beside each other."""
    frames = []
    for k, (left, right) in enumerate(zip(*films, strict=True)):
        frame = Image.new("RGB", (2 * SIZE[0], left.height), "white")
        frame.paste(left, (0, 0))
        frame.paste(right, (SIZE[0], 0))
        time = f"{k / FRAMES_PER_S:.1f} s"
        ImageDraw.Draw(frame).text((2 * SIZE[0] - 60, 8), time, fill="#222222", font=lettering(15))
        frames.append(frame)
    # One palette for all, of a frame in which everything is there, and no dithering: small files.
    palette = frames[len(frames) // 2].quantize(COLORS)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first.save(path, save_all=True, append_images=others, duration=1000 // FRAMES_PER_S, loop=0)


if __name__ == "__main__":
    write(Path(__file__).with_name("delay.gif"), map(film, SHOWN))
