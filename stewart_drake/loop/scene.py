"""A machine in Meshcat with its reference and its torques.

The reference is a ring with a pointer along its x axis, at the plate's wanted place. Each crank has
the colour of its motor's torque, blue or orange by its sign.
"""

from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Meshcat, Rgba, Role, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from stewart_drake.loop.diagram import ClosedLoop
from stewart_drake.loop.platforms import build_viewer, set_pose
from stewart_drake.loop.sampling import dispose
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError, rotation
from stewart_drake.scenario.signals import ANGLES, LEGS, POSE, POSITION
from stewart_drake.types import Array

Progress = Callable[[float, float], None]
"""Called with simulated time in s and the current pose error in % of peak to peak."""
CRANK_PARTS: Final = ("arm", "hub")
"""Parts of the SDFormat model in the torque's colour."""
TORQUE_COLORS: Final = ("#0072b2", "#dadada", "#d55e00")
"""Colours of a large negative torque, none, and a large positive one."""
_VISUALIZER: Final = ("drake", "visualizer")
"""Path of a model of Drake's MeshcatVisualizer."""
_GHOST: Final = "/reference"
_GHOST_COLOR: Final = Rgba(0.0, 0.62, 0.45, 0.55)
_USUAL: Final = 95
"""Percentile, over time, of the largest torque, for the full colour: with the maximum a short peak,
such as a catch-up's, would fade all others."""
_VIEW: Final = np.array([0.62, -0.70, 0.36])
"""Direction from the machine to the camera."""
_DISTANCE: Final = 1.3
"""Distance of the camera in units of the machine's extent."""
_FLOOR: Final = -0.06
"""Height of the floor's lines in the same units, below the base."""
_RING: Final = (1.14, 0.022)
"""Radius of the ring and of its wire, in units of the drawn plate's radius."""


class Scene:
    """The SDFormat model of a mechanism and the ring of its reference.

    Attributes:
        disc: pose of the drawn plate in the plate's frame, whose origin may be far from it.
    """

    def __init__(self, mechanism: Mechanism, meshcat: Meshcat) -> None:
        self._mechanism, self._meshcat = mechanism, meshcat
        meshcat.Delete("/" + "/".join(_VISUALIZER))  # removes the colours of an earlier scene
        self._diagram, self._plant = build_viewer(mechanism, meshcat)
        self._context = self._diagram.CreateDefaultContext()
        self._tree = self._plant.GetMyMutableContextFromRoot(self._context)
        self.disc, radius = _drawn_plate(self._diagram, self._plant)
        self._diagram.ForcedPublish(self._context)
        arrange(meshcat, mechanism)
        shapes: dict[str, Any] = {"ring": ring(radius), "pointer": pointer(radius)}
        for name, (vertices, faces) in shapes.items():
            meshcat.SetTriangleMesh(f"{_GHOST}/{name}", vertices, faces, _GHOST_COLOR)
        self._place_ring(mechanism.home)

    def show(self, pose: Array, wanted: Array, time: float = 0.0) -> bool:
        """Put the plate at a pose (6,) and the ring at another; return False if out of reach.

        The ring moves also then.

        Args:
            pose, wanted: rad and m.
            time: s, of the frame of a Meshcat recording.
        """
        self._place_ring(wanted, time)
        try:
            set_pose(self._plant, self._tree, self._mechanism, pose, np.zeros(6))
        except UnreachablePoseError:
            return False  # a multibody run may end slightly outside
        self._context.SetTime(time)
        self._diagram.ForcedPublish(self._context)
        return True

    def _place_ring(self, wanted: Array, time: float = 0.0) -> None:
        angles, position = cast(Any, wanted[ANGLES]), cast(Any, wanted[POSITION])
        placed = RigidTransform(RollPitchYaw(angles), position)
        self._meshcat.SetTransform(_GHOST, placed @ self.disc, time)

    def close(self) -> None:
        """Dispose of the diagram; the scene is unusable afterwards.

        Otherwise garbage collection may free Meshcat in another thread, which ends the process.
        """
        dispose(self._diagram)

    def paint(self, shares: Array) -> None:
        """Set the colours of the cranks by torques (6,) as shares of the full colour, -1 to 1."""
        for share, parts in zip(shares, crank_paths(self._mechanism.name), strict=True):
            color = [*_linear(torque_color(share)), 1.0]
            for part in parts:
                self._meshcat.SetProperty("/" + "/".join(part) + "/<object>", "color", color)


class Live:
    """Shows a running loop, with either plant, at most in real time; a `Progress` function."""

    def __init__(
        self, loop: ClosedLoop, simulator: Simulator, meshcat: Meshcat, progress: Progress | None
    ) -> None:
        simulator.set_target_realtime_rate(1.0)
        self._context, self._progress = simulator.get_context(), progress
        self._scene = Scene(loop.experiment.truth, meshcat)
        self._ports: Any = [
            loop.GetOutputPort(name) for name in ("state", "reference", "torque_applied")
        ]
        self._largest: list[float] = []

    def __call__(self, time: float, error: float) -> None:
        state, reference, torque = (np.asarray(port.Eval(self._context)) for port in self._ports)
        self._largest.append(float(np.abs(torque).max()))
        self._scene.show(state[POSE], reference[POSE], self._context.get_time())
        self._scene.paint(torque_shares(torque, full_color(np.array(self._largest))))
        if self._progress is not None:
            self._progress(time, error)

    def close(self) -> None:
        self._scene.close()


def full_color(largest: Array) -> float:
    """Return the torque of the full colour, N m, for the largest torques (n,) at some instants."""
    usual = np.percentile(largest, _USUAL) if len(largest) else 0.0
    return float(usual or largest.max(initial=0.0) or 1.0)


def torque_shares(torque: Array, full: float) -> Array:
    """Return torques in N m, of any shape, as shares of the full colour, -1 to 1."""
    return np.clip(torque / full, -1, 1)


def torque_color(share: float) -> Array:
    """Return the colour (3,) of a share, sRGB, 0 to 1."""
    negative, none, positive = (
        np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255 for color in TORQUE_COLORS
    )
    return np.array(none + abs(share) * ((negative if share < 0 else positive) - none))


def crank_paths(name: str) -> list[list[list[str]]]:
    """Return for each leg the paths of the crank's parts in Meshcat's tree."""
    return [
        [[*_VISUALIZER, name, f"crank_{leg}", name, part] for part in CRANK_PARTS] for leg in LEGS
    ]


def ring(radius: float, around: int = 72, across: int = 8) -> tuple[Array, NDArray[np.int32]]:
    """Return vertices (3, n) and triangles (3, m) of a torus in the plate's plane."""
    reach, wire = (factor * radius for factor in _RING)
    a, b = np.meshgrid(
        2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(across) / across
    )
    distance = reach + wire * np.cos(b)
    vertices = np.array([distance * np.cos(a), distance * np.sin(a), wire * np.sin(b)])
    j, i = np.meshgrid(np.arange(around), np.arange(across))
    corner = [
        (i + di) % across * around + (j + dj) % around
        for di, dj in ((0, 0), (0, 1), (1, 1), (1, 0))
    ]
    faces = np.array(
        [[corner[k].ravel() for k in face] for face in ((0, 1, 2), (0, 2, 3))], dtype=np.int32
    )
    return vertices.reshape(3, -1), np.hstack(list(faces))


def pointer(radius: float) -> tuple[Array, NDArray[np.int32]]:
    """Return an arrowhead outside the ring, along the plate's x axis."""
    reach, wire = (factor * radius for factor in _RING)
    base, tip = reach + wire, 1.3 * reach
    corners = [(base, y, z) for y in (-4 * wire, 4 * wire) for z in (-wire, wire)]
    vertices = np.array([*corners, (tip, 0, -wire), (tip, 0, wire)]).T
    faces = [(0, 2, 4), (1, 5, 3), (0, 1, 3), (0, 3, 2), (0, 4, 5), (0, 5, 1), (2, 3, 5), (2, 5, 4)]
    return vertices, np.array(faces, dtype=np.int32).T


def _linear(color: Array) -> list[float]:
    """Return the linear colour of sRGB, as the browser's material expects."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4).tolist()


def arrange(meshcat: Meshcat, mechanism: Mechanism) -> None:
    """Set a camera that sees the whole machine, and a floor with squares of a round size."""
    joints = mechanism.p_PQ @ rotation(mechanism.home[ANGLES]).T + mechanism.home[POSITION]
    points = np.vstack([mechanism.p_WS, joints])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    meshcat.SetCameraPose(middle + _DISTANCE * extent * _VIEW, middle)
    square = 10.0 ** np.floor(np.log10(extent))
    meshcat.SetProperty("/Grid", "scale", [square] * 3)
    meshcat.SetProperty("/Grid", "position", [0.0, 0.0, _FLOOR * extent])
    meshcat.SetProperty("/Grid", "opacity", 0.25)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetProperty("/Background", "top_color", [1.0, 1.0, 1.0])
    meshcat.SetProperty("/Background", "bottom_color", [0.86, 0.88, 0.91])


def _drawn_plate(diagram: Diagram, plant: MultibodyPlant) -> tuple[RigidTransform, float]:
    """Return the pose of the drawn disc in the plate's frame, and its radius in m."""
    scene_graph = cast(SceneGraph, diagram.GetSubsystemByName("scene_graph"))
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName("plate").index())
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        if inspector.GetName(geometry).endswith("disc"):
            shape = cast(Cylinder, inspector.GetShape(geometry))
            return inspector.GetPoseInFrame(geometry), shape.radius()
    raise AssertionError("the model draws no plate")
