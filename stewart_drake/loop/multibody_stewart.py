"""The multibody plant as a system with the ports of the exact one, and the model in a viewer."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from stewart_drake.dynamics.workspace import Failure, diagnose
from stewart_drake.loop.multibody import add_mechanism, set_pose
from stewart_drake.loop.platforms import AddStewartPlatform
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import PlantConfig
from stewart_drake.scenario.signals import POSE, RATES
from stewart_drake.types import Array


class MultibodyStewart(Diagram):
    """The machine in Drake's multibody engine (SAP), with the ports of `ExactPlant`.

    Like `ExactPlant` it takes every torque as it is: what motors can do is decided before it.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m |
    | wrench | input | 6, only if asked for | N m, N, in W at the plate's COM |
    | state | output | 12 | rad, m, rad/s, m/s |
    | crank_angles | output | 6 | rad |
    | query | output | SceneGraph query object | - |

    Args:
        mechanism: the machine.
        time_step: s.
        gravity: whether it acts.
        meshcat: where to show it, or None.
        start: (6,) pose by default, home if None.
        wrench: whether there is an input for a wrench on the plate; unconnected it is zero.
        **loads: what loads the machine: fields of `PlantConfig`.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        time_step: float = 1e-3,
        *,
        gravity: bool = True,
        meshcat: Meshcat | None = None,
        start: ArrayLike | None = None,
        wrench: bool = False,
        **loads: Any,
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        config = PlantConfig(kind="multibody", gravity=gravity, time_step=time_step, **loads)
        platform = AddStewartPlatform(builder, mechanism, config, start=start)
        for name in ("torque", "wrench") if wrench else ("torque",):
            builder.ExportInput(platform.GetInputPort(name), name)
        for name in ("state", "crank_angles"):
            builder.ExportOutput(platform.GetOutputPort(name), name)
        assert platform.scene_graph is not None
        builder.ExportOutput(platform.scene_graph.get_query_output_port(), "query")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, platform.scene_graph, meshcat)
        builder.BuildInto(self)
        self.mechanism, self.tree = mechanism, platform.plant

    def set_state(self, context: Context, state: Array) -> None:
        """Put the machine, in its own context, into [pose; rates] (12,), all loops closed.

        Raises:
            UnreachablePoseError, SingularPoseError: see `loop.multibody.set_pose`.
        """
        tree_context = self.GetMutableSubsystemContext(self.tree, context)
        set_pose(self.tree, tree_context, self.mechanism, state[POSE], state[RATES])

    def diagnose(self, context: Context) -> Failure | None:
        """Why the plate, in its own context, is not inside its workspace, or None."""
        state, cranks = (
            np.asarray(self.GetOutputPort(name).Eval(context)) for name in ("state", "crank_angles")
        )
        return diagnose(self.mechanism, context.get_time(), state[POSE], cranks)


def build_viewer(
    mechanism: Mechanism, meshcat: Meshcat
) -> tuple[Diagram, MultibodyPlant, MeshcatVisualizer]:
    """The SDFormat model alone, shown in Meshcat wherever its context puts it."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=1e-3, discrete_contact_approximation="sap")
    plant, scene_graph = AddMultibodyPlant(config, builder)
    add_mechanism(plant, mechanism)
    visualizer = MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    return builder.Build(), plant, visualizer
