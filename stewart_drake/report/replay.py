"""A finished run shown again in Meshcat, through the SDFormat model, beside its reference.

The reference is a ring with a pointer along its x axis: where the ring is, the plate should be. In
the self-contained page each crank also takes the colour of its motor's torque.
"""

import logging
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from pydrake.geometry import Cylinder, Meshcat, MeshcatParams, Rgba, Role, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram

from stewart_drake.diagram import build_viewer
from stewart_drake.fileio import replacing
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError, rotation
from stewart_drake.plant.multibody import set_pose
from stewart_drake.report.page import environment
from stewart_drake.report.replay_shapes import pointer, ring
from stewart_drake.report.tables import number
from stewart_drake.results import SimulationResult, versions
from stewart_drake.signals import ANGLES, LEGS, POSITION

if TYPE_CHECKING:
    from jinja2 import Template

Array = NDArray[np.float64]

_VISUALIZER: Final = ("drake", "visualizer")
"""Where Drake's MeshcatVisualizer puts a model."""
CRANK_PARTS: Final = ("arm", "hub")
"""Of the SDFormat model, what takes the torque's colour."""
_GHOST: Final = "/reference"
_GHOST_COLOR: Final = Rgba(0.0, 0.62, 0.45, 0.55)
_PATH_COLORS: Final = {"reference": Rgba(0.0, 0.62, 0.45), "plate": Rgba(0.0, 0.45, 0.70)}
_USUAL: Final = 95
"""Percentile, over time, of the largest torque that takes the full colour: a short peak, such as a
catch-up's, would leave nothing of the colours for the rest."""
_MAX_FRAMES: Final = 1500
"""A long run is thinned out to this many frames; Meshcat interpolates between them."""
_VIEW: Final = np.array([0.62, -0.70, 0.36])
"""Where the camera stands as seen from the machine."""
_DISTANCE: Final = 1.3
"""Of the camera, in units of the machine's extent."""
_FLOOR: Final = -0.06
"""Height of the floor's lines in the same units, below what is drawn of the base."""


def replay(signals: xr.Dataset, mechanism: Mechanism, meshcat: Meshcat | None = None) -> Meshcat:
    """Put the animation of a run, of either plant, into Meshcat, with its play bar.

    Args:
        signals: of a `SimulationResult`; poses and references over time.
        mechanism: the machine that was run.
        meshcat: where to; a new one, on any free local port, if None.

    Returns:
        The Meshcat; `StaticHtml()` of it is a file that plays without a server.
    """
    meshcat = meshcat or _quiet_meshcat()
    diagram, plant, _ = build_viewer(mechanism, meshcat)
    disc, radius = _drawn_plate(diagram, plant)
    context = diagram.CreateDefaultContext()
    tree = plant.GetMyMutableContextFromRoot(context)
    diagram.ForcedPublish(context)
    _arrange(meshcat, mechanism)
    shown = _thinned(signals)
    _draw_reference(meshcat, radius, shown)
    period = _period(shown)
    meshcat.StartRecording(1 / period, set_visualizations_while_recording=False)
    frames = zip(shown.time.values, shown.pose.values, shown.reference.values, strict=True)
    for t, pose, wanted in frames:
        try:
            set_pose(plant, tree, mechanism, pose, np.zeros(6))
        except UnreachablePoseError:
            break  # a multibody run may end a hair outside
        # Meshcat rounds down to a frame; a hair later, rounding does not lose one.
        context.SetTime(t + 1e-3 * period)
        diagram.ForcedPublish(context)
        meshcat.SetTransform(_GHOST, _placed(wanted) @ disc, context.get_time())
    meshcat.StopRecording()
    meshcat.PublishRecording()
    return meshcat


def replay_html(result: SimulationResult, mechanism: Mechanism, title: str) -> str:
    """A run as one HTML page that plays without a server or a network.

    Args:
        result: the run.
        mechanism: the machine that was run.
        title: what the page is called.
    """
    meshcat = replay(result.signals, mechanism)
    shown = _thinned(result.signals)
    e = shown.error.values
    torque = shown.torque_applied.values
    largest = np.abs(torque).max(axis=1, initial=0.0)
    full = float(np.percentile(largest, _USUAL)) if largest.any() else 1.0
    outcome = result.status.replace("_", " ")
    if result.stopped is not None:
        outcome += f" at {result.stopped.time:.2f} s"
    else:
        outcome += f", E_ac {number(result.accumulated_error)} % s"
    data = {
        "time": np.round(shown.time.values, 4).tolist(),
        "position": np.round(1e3 * np.linalg.norm(e[:, POSITION], axis=1), 4).tolist(),
        "angle": np.round(np.rad2deg(_turns(shown)), 4).tolist(),
        "share": np.round(np.clip(torque / full, -1, 1), 3).tolist(),
        "cranks": _crank_paths(mechanism.name),
    }
    overlay = _template().render(
        title=title,
        outcome=outcome,
        full=number(full, 2),
        peak=number(float(largest.max(initial=0.0)), 2),
        data=data,
        legs=LEGS,
        drake=versions()["drake"],
    )
    page = meshcat.StaticHtml()
    before, end, after = page.rpartition("</body>")
    assert end, "Meshcat's page has no body"
    return f"{before}{overlay}{end}{after}".replace("Drake MeshCat", "Replay", 1)


def write_replay(result: SimulationResult, mechanism: Mechanism, path: Path, title: str) -> Path:
    """Write `replay_html` whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    text = replay_html(result, mechanism, title)
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
    return path


def _quiet_meshcat() -> Meshcat:
    """A Meshcat that nobody visits, so that its address is not told either."""
    log = logging.getLogger("drake")
    level = log.level
    log.setLevel(logging.WARNING)
    try:
        return Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    finally:
        log.setLevel(level)


def _thinned(signals: xr.Dataset) -> xr.Dataset:
    return signals.isel(time=slice(None, None, -(-signals.sizes["time"] // _MAX_FRAMES) or 1))


def _period(signals: xr.Dataset) -> float:
    """s between two frames."""
    steps = np.diff(signals.time.values)
    return float(np.median(steps)) if len(steps) else 1.0


def _arrange(meshcat: Meshcat, mechanism: Mechanism) -> None:
    """A camera that sees the whole machine, whatever its size, over a floor of round squares."""
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
    """Where in the plate's frame its disc is drawn, and the disc's radius in m."""
    scene_graph = cast(SceneGraph, diagram.GetSubsystemByName("scene_graph"))
    inspector = scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(plant.GetBodyByName("plate").index())
    for geometry in inspector.GetGeometries(frame, Role.kIllustration):
        if inspector.GetName(geometry).endswith("disc"):
            shape = cast(Cylinder, inspector.GetShape(geometry))
            return inspector.GetPoseInFrame(geometry), shape.radius()
    raise AssertionError("the model draws no plate")


def _draw_reference(meshcat: Meshcat, radius: float, signals: xr.Dataset) -> None:
    for name, (vertices, faces) in (("ring", ring(radius)), ("pointer", pointer(radius))):
        meshcat.SetTriangleMesh(f"{_GHOST}/{name}", vertices, faces, _GHOST_COLOR)
    for name, signal in (("reference", "reference"), ("plate", "pose")):
        path = signals[signal].values[:, POSITION].T
        if path.shape[1] > 1:
            meshcat.SetLine(f"/paths/{name}", path, 1.5, _PATH_COLORS[name])


def _placed(pose: Array) -> RigidTransform:
    return RigidTransform(RollPitchYaw(pose[ANGLES]), pose[POSITION])


def _turns(signals: xr.Dataset) -> Array:
    """(n,) rad, the angle by which the plate is turned against its reference."""
    pairs = zip(signals.pose.values, signals.reference.values, strict=True)
    return np.array(
        [
            RotationMatrix(rotation(q[ANGLES]).T @ rotation(p[ANGLES])).ToAngleAxis().angle()
            for p, q in pairs
        ]
    )


def _crank_paths(name: str) -> list[list[list[str]]]:
    """Of every leg the parts of the crank in Meshcat's tree, each as the names that lead there."""
    return [
        [[*_VISUALIZER, name, f"crank_{leg}", name, part] for part in CRANK_PARTS] for leg in LEGS
    ]


@lru_cache(maxsize=1)
def _template() -> "Template":
    return environment().get_template("replay.html.j2")
