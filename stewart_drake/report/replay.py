"""A finished run shown again in Meshcat, through the SDFormat model."""

import numpy as np
import xarray as xr
from pydrake.geometry import Meshcat, MeshcatParams

from stewart_drake.diagram import build_viewer
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.plant.multibody import set_pose


def replay(signals: xr.Dataset, mechanism: Mechanism, meshcat: Meshcat | None = None) -> Meshcat:
    """Put the animation of a run, of either plant, into Meshcat, with its play bar.

    Args:
        signals: of a `SimulationResult`; poses and rates over time.
        mechanism: the machine that was run.
        meshcat: where to; a new one, on any free local port, if None.

    Returns:
        The Meshcat; `StaticHtml()` of it is a file that plays without a server.
    """
    if meshcat is None:
        meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    diagram, plant, visualizer = build_viewer(mechanism, meshcat)
    context = diagram.CreateDefaultContext()
    tree = plant.GetMyMutableContextFromRoot(context)
    visualizer.StartRecording()
    for t, pose in zip(signals.time.values, signals.pose.values, strict=True):
        try:
            set_pose(plant, tree, mechanism, pose, np.zeros(6))
        except UnreachablePoseError:
            break  # a multibody run may end a hair outside
        context.SetTime(t)
        diagram.ForcedPublish(context)
    visualizer.StopRecording()
    visualizer.PublishRecording()
    return meshcat
