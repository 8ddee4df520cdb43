"""A mechanism in Meshcat, put anywhere by six sliders; poses out of reach are shown as such."""

import time
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.platforms import build_viewer, set_pose
from stewart_drake.loop.sampling import let_go
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.reporting.style import FACTORS
from stewart_drake.scenario.signals import LEGS
from stewart_drake.studies.workspace_map import travel
from stewart_drake.types import Array

SLIDERS: Final = ("roll [deg]", "pitch [deg]", "yaw [deg]", "x [mm]", "y [mm]", "z [mm]")
STOP: Final = "Stop viewing"
_BEYOND: Final = 1.25
"""Sliders go beyond the travel by this factor, so that one sees where it ends."""
_NARROW: Final = 0.15
"""Of the crank: a leg with a smaller margin is marked."""
_GOOD, _CLOSE, _SHORT = (
    Rgba(0.0, 0.62, 0.45, 1.0),
    Rgba(0.90, 0.62, 0.0, 1.0),
    Rgba(0.80, 0.10, 0.10, 1.0),
)
_GHOST: Final = Rgba(0.80, 0.10, 0.10, 0.35)
_PERIOD: Final = 0.03
"""s"""
_VIEW: Final = (2.0, -1.6, 0.6)
"""From the machine to the camera, in its radii."""


class Placement(NamedTuple):
    """What slider values mean for a mechanism."""

    pose: Array
    """(6,) rad and m."""
    reach: Array
    """(6,) m, negative where a leg is short."""
    failure: Failure | None
    """Why it cannot be there, or None."""

    def __str__(self) -> str:
        short = [
            f"leg {leg} short by {-1e3 * margin:.3g} mm"
            for leg, margin in zip(LEGS, self.reach, strict=True)
            if margin < 0
        ]
        if short:
            return "out of reach: " + ", ".join(short)
        if self.failure is not None:
            return f"outside the workspace: {self.failure.reason}"
        leg = int(self.reach.argmin())
        return f"reach margin {1e3 * self.reach[leg]:.3g} mm, leg {LEGS[leg]}"


def place(mechanism: Mechanism, values: ArrayLike) -> Placement:
    """Slider values (6,) in degrees and mm as a pose, with its reach margins."""
    pose = np.asarray(values, dtype=np.float64) / FACTORS
    return Placement(pose, mechanism.reach_margins(pose), diagnose(mechanism, 0.0, pose))


class PoseViewer:
    """Shows a mechanism in Meshcat, first at home.

    The machine follows the sliders as far as it can; where it cannot be, it stays at the last pose
    where it could, and a translucent red plate shows what was asked for. The plate joints are
    green, orange where less than 15 % of a crank is left, red where the leg is short.

    Args:
        mechanism: what to show.
        meshcat: where; sliders and a button to stop are added.
    """

    def __init__(self, mechanism: Mechanism, meshcat: Meshcat) -> None:
        self._mechanism, self.meshcat = mechanism, meshcat
        diagram, plant, _ = build_viewer(mechanism, meshcat)
        self._diagram, self._plant = diagram, plant
        self._context = diagram.CreateDefaultContext()
        self._label = ""
        rod, radius = mechanism.rod_lengths.min(), np.linalg.norm(mechanism.p_PQ[:, :2], axis=1)
        meshcat.SetObject("wanted", Cylinder(float(1.08 * radius.max()), 0.03 * rod), _GHOST)
        for leg in LEGS:
            meshcat.SetObject(f"margins/leg_{leg}", Sphere(0.025 * rod), _GOOD)
        meshcat.AddButton(STOP, "Escape")
        self._deck = np.array([0.0, 0.0, mechanism.p_PQ[:, 2].mean() + 0.03 * rod])
        aim_camera(meshcat, mechanism)
        home = FACTORS * mechanism.home
        for name, low, high, value in zip(SLIDERS, *slider_range(mechanism), home, strict=True):
            meshcat.AddSlider(name, low, high, 0.1, value)
        self.step(home)

    def close(self) -> None:
        """See `loop.scene.Scene.close`."""
        let_go(self._diagram)

    def values(self) -> Array:
        """The sliders' values (6,) in degrees and mm."""
        return np.array([self.meshcat.GetSliderValue(name) for name in SLIDERS])

    def step(self, values: ArrayLike) -> Placement:
        """Show the machine, or that it cannot be there, at values (6,) in degrees and mm."""
        placement = place(self._mechanism, values)
        possible = placement.failure is None
        if possible:
            tree = self._plant.GetMyMutableContextFromRoot(self._context)
            set_pose(self._plant, tree, self._mechanism, placement.pose, np.zeros(6))
        self._diagram.ForcedPublish(self._context)
        R_WP, p_WP = rotation(placement.pose[:3]), placement.pose[3:]
        joints: Any = p_WP + self._mechanism.p_PQ @ R_WP.T
        self.meshcat.SetTransform("wanted", _transform(R_WP, p_WP + R_WP @ self._deck))
        self.meshcat.SetProperty("wanted", "visible", not possible)
        narrow = _NARROW * self._mechanism.crank_lengths
        for i, leg in enumerate(LEGS):
            path = f"margins/leg_{leg}"
            margin = placement.reach[i]
            color = _SHORT if margin < 0 else _CLOSE if margin < narrow[i] else _GOOD
            self.meshcat.SetTransform(path, RigidTransform(joints[i]))
            self.meshcat.SetProperty(path, "color", [color.r(), color.g(), color.b(), color.a()])
        self._show(str(placement))
        return placement

    def _show(self, text: str) -> None:
        # Meshcat's panel has no text; a button without effect carries it.
        if text != self._label:
            if self._label:
                self.meshcat.DeleteButton(self._label)
            self.meshcat.AddButton(text)
            self._label = text

    def run(self, say: Callable[[str], None]) -> None:
        """Follow the sliders until the button (or Escape in the browser) stops it.

        Args:
            say: called with the placement in words whenever it changes.
        """
        shown = np.full(6, np.nan)
        while self.meshcat.GetButtonClicks(STOP) == 0:
            values = self.values()
            if not np.array_equal(values, shown):
                say(str(self.step(values)))
                shown = values
            time.sleep(_PERIOD)


def aim_camera(meshcat: Meshcat, mechanism: Mechanism) -> None:
    """Look at a machine of any size so that it fills most of the window, over a fitting grid."""
    joints = mechanism.home[3:] + mechanism.p_PQ
    target = np.array([0.0, 0.0, (joints[:, 2].mean() + mechanism.p_WS[:, 2].mean()) / 2])
    radius = np.linalg.norm(np.vstack([joints, mechanism.p_WS]) - target, axis=1).max()
    eye: Any = target + radius * np.array(_VIEW)
    meshcat.SetCameraPose(eye, target)  # type: ignore[arg-type]
    # Meshcat's own grid has squares of a metre: of a small machine one sees a bar at the horizon.
    meshcat.SetProperty("/Grid", "scale", [10.0 ** np.floor(np.log10(radius))] * 3)
    meshcat.SetProperty("/Grid", "position", [0.0, 0.0, -0.06 * radius])
    meshcat.SetProperty("/Grid", "opacity", 0.25)
    meshcat.SetProperty("/Background", "top_color", [1.0, 1.0, 1.0])
    meshcat.SetProperty("/Background", "bottom_color", [0.86, 0.88, 0.91])


def _transform(R: Any, p: Any) -> RigidTransform:
    return RigidTransform(RotationMatrix(R), p)


def slider_range(mechanism: Mechanism) -> tuple[Array, Array]:
    """Lowest and highest slider values (6,) in degrees and mm, somewhat beyond the travel."""
    spans = [(t.low, t.high) for t in travel(mechanism)]
    if not spans:  # of a singular home pose
        rod = float(mechanism.rod_lengths.min())
        spans = [(-0.5, 0.5)] * 3 + [(-0.2 * rod, 0.2 * rod)] * 3
    low, high = FACTORS * (mechanism.home[:, None] + _BEYOND * np.array(spans)).T
    return np.floor(low), np.ceil(high)
