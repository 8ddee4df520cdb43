"""A mechanism in Meshcat at any pose, set by six sliders; unreachable poses are shown in red."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydrake.geometry import Cylinder, Meshcat, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.platforms import build_viewer, set_pose
from stewart_drake.loop.sampling import dispose
from stewart_drake.loop.scene import arrange
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import rotation
from stewart_drake.reporting.style import FACTORS
from stewart_drake.scenario.signals import LEGS
from stewart_drake.studies.workspace_map import travel
from stewart_drake.types import Array, ArrayLike

SLIDERS: Final = ("roll [deg]", "pitch [deg]", "yaw [deg]", "x [mm]", "y [mm]", "z [mm]")
STOP: Final = "Stop viewing"
_BEYOND: Final = 1.25
"""Range of the sliders, as a factor on the travel."""
_NARROW: Final = 0.15
"""Reach margin of a marked leg, as a share of the crank."""
_GOOD: Final = Rgba(0.0, 0.62, 0.45, 1.0)
_CLOSE: Final = Rgba(0.90, 0.62, 0.0, 1.0)
_SHORT: Final = Rgba(0.80, 0.10, 0.10, 1.0)
_GHOST: Final = Rgba(0.80, 0.10, 0.10, 0.35)


@dataclass(frozen=True)
class Placement:
    pose: Array  # (6,) rad and m
    reach: Array  # reach margins (6,) in m, negative where a leg is short
    failure: Failure | None  # why the pose is impossible, or None

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
    """Return the pose of slider values (6,) in degrees and mm."""
    pose = np.asarray(values, dtype=np.float64) / FACTORS
    return Placement(pose, mechanism.reach_margins(pose), diagnose(mechanism, 0.0, pose))


class PoseViewer:
    """Viewer of a mechanism in Meshcat, first at home.

    The machine follows the sliders to every possible pose. For an impossible one it stays at the
    last possible pose, and a translucent red plate shows the pose of the sliders. The plate joints
    are green, orange with a reach margin below 15 % of a crank, red with a short leg. Meshcat gets
    sliders and a button to stop.
    """

    def __init__(self, mechanism: Mechanism, meshcat: Meshcat) -> None:
        self._mechanism, self.meshcat = mechanism, meshcat
        self._diagram, self._plant = build_viewer(mechanism, meshcat)
        self._context = self._diagram.CreateDefaultContext()
        self._label = ""
        rod, radius = mechanism.rod_lengths.min(), np.linalg.norm(mechanism.p_PQ[:, :2], axis=1)
        meshcat.SetObject("wanted", Cylinder(float(1.08 * radius.max()), 0.03 * rod), _GHOST)
        for leg in LEGS:
            meshcat.SetObject(f"margins/leg_{leg}", Sphere(0.025 * rod), _GOOD)
        meshcat.AddButton(STOP, "Escape")
        self._deck = np.array([0.0, 0.0, mechanism.p_PQ[:, 2].mean() + 0.03 * rod])
        arrange(meshcat, mechanism)
        home = FACTORS * mechanism.home
        for name, low, high, value in zip(SLIDERS, *slider_range(mechanism), home, strict=True):
            meshcat.AddSlider(name, low, high, 0.1, value)
        self.step(home)

    def close(self) -> None:
        dispose(self._diagram)

    def values(self) -> Array:
        """Return the values of the sliders (6,) in degrees and mm."""
        return np.array([self.meshcat.GetSliderValue(name) for name in SLIDERS])

    def step(self, values: ArrayLike) -> Placement:
        """Show the machine at slider values (6,) in degrees and mm."""
        placement = place(self._mechanism, values)
        possible = placement.failure is None
        if possible:
            tree = self._plant.GetMyMutableContextFromRoot(self._context)
            set_pose(self._plant, tree, self._mechanism, placement.pose, np.zeros(6))
        self._diagram.ForcedPublish(self._context)
        R_WP, p_WP = rotation(placement.pose[:3]), placement.pose[3:]
        joints: Any = p_WP + self._mechanism.p_PQ @ R_WP.T
        deck: Any = p_WP + R_WP @ self._deck
        self.meshcat.SetTransform("wanted", RigidTransform(RotationMatrix(R_WP), deck))
        self.meshcat.SetProperty("wanted", "visible", not possible)
        narrow = _NARROW * self._mechanism.crank_lengths
        for i, leg in enumerate(LEGS):
            path = f"margins/leg_{leg}"
            margin = placement.reach[i]
            color = _SHORT if margin < 0 else _CLOSE if margin < narrow[i] else _GOOD
            self.meshcat.SetTransform(path, RigidTransform(joints[i]))
            self.meshcat.SetProperty(path, "color", [color.r(), color.g(), color.b(), color.a()])
        # Meshcat's panel has no text: a button without effect shows it.
        if (text := str(placement)) != self._label:
            if self._label:
                self.meshcat.DeleteButton(self._label)
            self.meshcat.AddButton(text)
            self._label = text
        return placement

    def run(self, say: Callable[[str], None]) -> None:
        """Follow the sliders until the stop button or Escape in the browser."""
        shown = np.full(6, np.nan)
        while self.meshcat.GetButtonClicks(STOP) == 0:
            values = self.values()
            if not np.array_equal(values, shown):
                say(str(self.step(values)))
                shown = values
            time.sleep(0.03)


def slider_range(mechanism: Mechanism) -> tuple[Array, Array]:
    """Return lowest and highest slider values (6,) in degrees and mm, beyond the travel."""
    spans = [(t.low, t.high) for t in travel(mechanism)]
    if not spans:  # of a singular home pose
        rod = float(mechanism.rod_lengths.min())
        spans = [(-0.5, 0.5)] * 3 + [(-0.2 * rod, 0.2 * rod)] * 3
    low, high = FACTORS * (mechanism.home[:, None] + _BEYOND * np.array(spans)).T
    return np.floor(low), np.ceil(high)
