"""The closed loop as a Drake diagram, built from a scenario. Only this module connects systems."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantVectorSource, PassThrough, Saturation

from stewart_drake.config import Scenario
from stewart_drake.design.startup import initial_queue
from stewart_drake.experiment import Experiment, believed_queue, control_law, prepare
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.exact import ExactPlant
from stewart_drake.plant.multibody import PlateState, add_mechanism, set_pose
from stewart_drake.signals import (
    BIAS,
    DAMPING,
    NUM_PARAMETERS,
    NUM_TORQUES,
    PAYLOAD,
    POSE,
    RATES,
)
from stewart_drake.systems.controller import DelayLqiController
from stewart_drake.systems.delay_chain import DelayChain
from stewart_drake.systems.density import DensityWindow
from stewart_drake.systems.reference import Reference
from stewart_drake.systems.sensor import Sensor
from stewart_drake.systems.tuner import AnnTuner

Array = NDArray[np.float64]


class MultibodyStewart(Diagram):
    """The machine in Drake's multibody engine (SAP), with the ports of `ExactPlant`.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m |
    | state | output | 12 | rad, m, rad/s, m/s |
    | crank_angles | output | 6 | rad |
    | query | output | SceneGraph query object | - |

    Args:
        mechanism: the machine.
        time_step: s.
        gravity: whether it acts.
        torque_bias: (6,) N m, added to the torque.
        payload_mass: kg, a point mass at the plate's COM.
        joint_damping: N m s/rad on each crank shaft.
        meshcat: where to show it, or None.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        time_step: float = 1e-3,
        *,
        gravity: bool = True,
        torque_bias: ArrayLike = (0, 0, 0, 0, 0, 0),
        payload_mass: float = 0.0,
        joint_damping: float = 0.0,
        meshcat: Meshcat | None = None,
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(time_step=time_step, discrete_contact_approximation="sap")
        plant, scene_graph = AddMultibodyPlant(config, builder)
        add_mechanism(
            plant,
            mechanism,
            gravity=gravity,
            payload_mass=payload_mass,
            joint_damping=joint_damping,
        )
        bias = builder.AddNamedSystem("torque_bias", ConstantVectorSource(np.array(torque_bias)))
        total = builder.AddNamedSystem("shaft_torque", Adder(2, NUM_TORQUES))
        plate = builder.AddNamedSystem("plate_state", PlateState(plant, mechanism))
        builder.Connect(bias.get_output_port(), total.get_input_port(1))
        builder.Connect(total.get_output_port(), plant.get_actuation_input_port())
        builder.Connect(plant.get_state_output_port(), plate.get_input_port())
        builder.ExportInput(total.get_input_port(0), "torque")
        for name in ("state", "crank_angles"):
            builder.ExportOutput(plate.GetOutputPort(name), name)
        builder.ExportOutput(scene_graph.get_query_output_port(), "query")
        if meshcat is not None:
            MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
        builder.BuildInto(self)
        self.mechanism, self.tree = mechanism, plant

    def set_state(self, context: Context, state: Array) -> None:
        """Put the machine, in its own context, into [pose; rates] (12,), all loops closed.

        Raises:
            UnreachablePoseError, SingularPoseError: see `plant.multibody.set_pose`.
        """
        tree_context = self.GetMutableSubsystemContext(self.tree, context)
        set_pose(self.tree, tree_context, self.mechanism, state[POSE], state[RATES])


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


class ClosedLoop(Diagram):
    """The whole loop; output ports are named after the signals.

    Subsystems: `reference`, `sensor`, `weights` or `tuner`, `controller`, `saturation`,
    `delay_chain`, `plant`, `density`. Output ports: `state`, `reference`, `torque_commanded`,
    `torque_applied`, `integral`, `weights_used`, `parameters`, `parameter_std`, `density`.

    Attributes:
        experiment: what it was built from.
        catch_up: s, length of the blend onto the reference, 0 if there is none.
    """

    experiment: Experiment
    catch_up: float

    def initial_context(self) -> Context:
        """A root context at t = 0 in the scenario's start state.

        `CreateDefaultContext` alone leaves the multibody plant at its home pose, at rest.
        """
        context = self.CreateDefaultContext()
        plant: Any = self.GetSubsystemByName("plant")
        plant.set_state(plant.GetMyMutableContextFromRoot(context), self.experiment.start)
        return context


def build_closed_loop(
    scenario: Scenario | Experiment, *, meshcat: Meshcat | None = None
) -> ClosedLoop:
    """The diagram of a scenario: reference -> controller -> delay chain -> plant -> sensor.

    Args:
        scenario: what to build, or what `prepare` made of it.
        meshcat: where the multibody plant is shown while it is simulated, or None.

    Raises:
        ConfigError: bad input, an unreachable reference.
    """
    experiment = scenario if isinstance(scenario, Experiment) else prepare(scenario)
    sc, nominal = experiment.scenario, experiment.nominal
    law, planned, catch_up = control_law(experiment)
    builder = DiagramBuilder()
    reference = builder.AddNamedSystem(
        "reference", Reference(experiment.reference, planned, law.preview_times)
    )
    sensor = builder.AddNamedSystem(
        "sensor", Sensor(np.array(sc.sensor.noise_std), sc.sensor.seed, sc.controller.period)
    )
    weights = _weights(builder, experiment)
    controller = builder.AddNamedSystem(
        "controller", DelayLqiController(law, believed_queue(experiment, law.options))
    )
    limit = sc.actuator.torque_limit
    saturation = builder.AddNamedSystem(
        "saturation",
        PassThrough(NUM_TORQUES)
        if limit is None
        else Saturation(np.full(NUM_TORQUES, -limit), np.full(NUM_TORQUES, limit)),
    )
    true_queue = initial_queue(
        sc.queue,
        nominal,
        experiment.reference,
        sc.controller.period,
        sc.delay.steps,
        sc.delay.fraction,
    )
    delay = builder.AddNamedSystem(
        "delay_chain",
        DelayChain(sc.controller.period, sc.delay.steps, sc.delay.fraction, true_queue),
    )
    plant = builder.AddNamedSystem("plant", _plant(experiment, meshcat))
    kind = "magnitude" if experiment.network is None else experiment.network.density
    density = builder.AddNamedSystem("density", DensityWindow(sc.controller.period, kind))

    def connect(source, out: str, target, into: str) -> None:  # type: ignore[no-untyped-def]
        builder.Connect(source.GetOutputPort(out), target.GetInputPort(into))

    connect(reference, "preview", controller, "preview")
    builder.Connect(weights.get_output_port(), controller.GetInputPort("weights"))
    builder.Connect(controller.GetOutputPort("torque"), saturation.get_input_port())
    builder.Connect(saturation.get_output_port(), delay.GetInputPort("commanded"))
    connect(delay, "torque", plant, "torque")
    connect(plant, "state", sensor, "state")
    connect(sensor, "measurement", controller, "measurement")
    connect(sensor, "measurement", density, "measurement")
    connect(reference, "reference", density, "reference")
    connect(controller, "torque", density, "torque")
    if experiment.network is not None:
        connect(density, "density", weights, "density")

    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    builder.ExportOutput(reference.GetOutputPort("reference"), "reference")
    builder.ExportOutput(delay.GetOutputPort("torque"), "torque_applied")
    builder.ExportOutput(density.GetOutputPort("density"), "density")
    for name in ("torque_commanded", "integral", "weights_used", "parameters", "parameter_std"):
        builder.ExportOutput(controller.GetOutputPort(name), name)
    loop = ClosedLoop()
    builder.BuildInto(loop)
    loop.set_name("closed_loop")
    loop.experiment, loop.catch_up = experiment, catch_up
    return loop


def _weights(builder: DiagramBuilder, experiment: Experiment) -> ConstantVectorSource | AnnTuner:
    c = experiment.scenario.controller
    fixed = np.array([c.w_Q, c.w_R])
    if experiment.network is None:
        return builder.AddNamedSystem("weights", ConstantVectorSource(fixed))
    return builder.AddNamedSystem("tuner", AnnTuner(experiment.network, fixed, c.period))


def _plant(experiment: Experiment, meshcat: Meshcat | None) -> ExactPlant | MultibodyStewart:
    plant = experiment.scenario.plant
    if plant.kind == "multibody":
        return MultibodyStewart(
            experiment.truth,
            plant.time_step,
            gravity=plant.gravity,
            torque_bias=plant.torque_bias,
            payload_mass=plant.payload_mass,
            joint_damping=plant.joint_damping,
            meshcat=meshcat,
        )
    parameters = np.empty(NUM_PARAMETERS)
    parameters[BIAS], parameters[PAYLOAD] = plant.torque_bias, plant.payload_mass
    parameters[DAMPING] = plant.joint_damping
    truth = StewartDynamics(experiment.truth, plant.gravity, parameters)
    return ExactPlant(truth, experiment.start)
