"""The closed loop as a Drake diagram, built from a scenario. Here its systems are connected."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    InputPort,
    OutputPort,
    System,
)
from pydrake.systems.primitives import Adder, ConstantVectorSource, Saturation

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.loop.controller import DelayLqiController
from stewart_drake.loop.delay_chain import DelayChain
from stewart_drake.loop.density import DensityWindow
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.experiment import (
    Experiment,
    control_law,
    first_queue,
    followed_motion,
    motion_scale,
    prepare,
    torques_in_flight,
)
from stewart_drake.loop.multibody_stewart import MultibodyStewart
from stewart_drake.loop.own import OwnReference, OwnSystem, take
from stewart_drake.loop.own_controller import SampledController
from stewart_drake.loop.platforms import add_to_torque
from stewart_drake.loop.reference import Reference
from stewart_drake.loop.sensor import Sensor
from stewart_drake.loop.start_check import StartCheck
from stewart_drake.loop.tuner import AnnTuner
from stewart_drake.loop.varying_delay import VaryingDelay, declare_constant
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.link import torque_delays
from stewart_drake.scenario.signals import (
    DAMPING,
    NUM_PARAMETERS,
    NUM_TORQUES,
    PACKETS,
    PAYLOAD,
    POSE,
    RATES,
    exported_ports,
)

Array = NDArray[np.float64]


class ClosedLoop(Diagram):
    """The whole loop; output ports are named after the signals.

    Subsystems: `reference`, `sensor`, `weights` or `tuner`, `controller`, `saturation`,
    `delay_chain`, `torque_bias`, `plant`, `density`; with the user's own `own_controller`,
    `disturbance`, `disturbed_torque`. Output ports: `state`, `reference`,
    `torque_commanded` (what the law asks for), `torque_applied` (what arrives of it: within the
    motors' limit, late, before the bias), `integral`, `weights_used`, `parameters`,
    `parameter_std`, `density`, `measurement` (held, as the controller read it), `state_estimate`,
    `delay_true` (of the torque sent last), `packets`.

    Attributes:
        experiment: what it was built from.
        catch_up: s, length of the blend onto the reference, 0 if there is none.
    """

    experiment: Experiment
    catch_up: float

    def CreateDefaultContext(self) -> Context:
        """A root context at t = 0 in the scenario's start state, all loops closed.

        A `Simulator` that makes its own context has the start's pose too, but where the plant is
        the multibody one it begins at rest: Drake knows no default of velocities. It says so, see
        `StartCheck`.
        """
        context = super().CreateDefaultContext()
        plant: Any = self.GetSubsystemByName("plant")
        plant.set_state(plant.GetMyMutableContextFromRoot(context), self.experiment.start)
        return context


def build_closed_loop(
    scenario: Scenario | Experiment,
    *,
    controller: OwnSystem | None = None,
    reference: OwnReference | None = None,
    disturbance: OwnSystem | None = None,
    meshcat: Meshcat | None = None,
) -> ClosedLoop:
    """The diagram of a scenario: reference, controller, limit, delay chain, plant, sensor.

    Args:
        scenario: what to build, or what `prepare` made of it.
        controller, reference, disturbance: of one's own, see `simulate`; not with an Experiment,
            which has them.
        meshcat: where the multibody plant is shown while it is simulated, or None.

    Raises:
        ConfigError: bad input, an unreachable reference.
    """
    if isinstance(scenario, Experiment):
        experiment = scenario
    else:
        experiment = prepare(scenario, own=take(controller, reference, disturbance))
    experiment.own.claim()
    builder = DiagramBuilder()
    _add_surroundings(builder, experiment, meshcat)
    if experiment.own.controller is None:
        catch_up = _add_law(builder, experiment)
    else:
        catch_up = 0.0
        _add_own_controller(builder, experiment, experiment.own.controller)
    _connect_loop(builder, experiment)
    loop = ClosedLoop()
    builder.BuildInto(loop)
    loop.set_name("closed_loop")
    loop.experiment, loop.catch_up = experiment, catch_up
    return loop


def _add_surroundings(
    builder: DiagramBuilder, experiment: Experiment, meshcat: Meshcat | None
) -> None:
    """Everything but reference and controller."""
    sc = experiment.scenario
    period = sc.controller.period
    noise, s = np.array(sc.sensor.noise_std), sc.sensor
    builder.AddNamedSystem(
        "sensor", Sensor(noise, s.seed, period, s.faults, motion_scale(experiment))
    )
    limit = np.full(NUM_TORQUES, experiment.torque_limit)
    builder.AddNamedSystem("saturation", Saturation(-limit, limit))
    builder.AddNamedSystem("delay_chain", _link(experiment))
    builder.AddNamedSystem("torque_bias", add_to_torque(np.array(sc.plant.torque_bias)))
    builder.AddNamedSystem("plant", _plant(experiment, meshcat))
    kind = "magnitude" if experiment.network is None else experiment.network.density
    builder.AddNamedSystem("density", DensityWindow(period, kind))


def _connect_loop(builder: DiagramBuilder, experiment: Experiment) -> None:
    """Connect what every loop has, and name its outputs."""

    def out(source: str, port: str) -> OutputPort:
        return builder.GetSubsystemByName(source).GetOutputPort(port)

    def into(target: str, port: str) -> InputPort:
        return builder.GetSubsystemByName(target).GetInputPort(port)

    saturation, bias = (builder.GetSubsystemByName(name) for name in ("saturation", "torque_bias"))
    builder.Connect(out("sensor", "measurement"), into("controller", "measurement"))
    builder.Connect(out("controller", "torque"), saturation.get_input_port())
    builder.Connect(saturation.get_output_port(), into("delay_chain", "commanded"))
    builder.Connect(out("delay_chain", "torque"), bias.get_input_port())
    _disturb(builder, experiment, bias.get_output_port())
    builder.Connect(out("plant", "state"), into("sensor", "state"))
    builder.Connect(out("sensor", "measurement"), into("density", "measurement"))
    builder.Connect(out("reference", "reference"), into("density", "reference"))
    builder.Connect(out("controller", "torque"), into("density", "torque"))
    if experiment.network is not None:
        builder.Connect(out("density", "density"), into("tuner", "density"))
    if experiment.start[RATES].any() and experiment.scenario.plant.kind == "multibody":
        builder.AddNamedSystem("start_check", StartCheck(experiment.start))
        builder.Connect(out("plant", "state"), into("start_check", "state"))
    for name, (source, port) in exported_ports().items():
        builder.ExportOutput(out(source, port), name)


def _add_law(builder: DiagramBuilder, experiment: Experiment) -> float:
    """The shipped controller behind its reference and weights; the length of its catch-up, s."""
    law, planned, catch_up = control_law(experiment)
    reference = builder.AddNamedSystem(
        "reference", Reference(experiment.reference, planned, law.preview_times)
    )
    weights = _weights(builder, experiment)
    controller = builder.AddNamedSystem(
        "controller",
        DelayLqiController(
            law, first_queue(experiment, law), followed_motion(experiment, law, planned)
        ),
    )
    builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
    builder.Connect(weights.get_output_port(), controller.GetInputPort("weights"))
    return catch_up


def _add_own_controller(builder: DiagramBuilder, experiment: Experiment, system: System) -> None:
    """The user's controller behind its reference, and what samples it."""
    sc = experiment.scenario
    if experiment.network is not None:
        raise ConfigError(
            f"tuner.kind: got {sc.tuner.kind!r} with a controller of your own; expected 'fixed'"
        )
    motion = experiment.reference
    reference = builder.AddNamedSystem("reference", Reference(motion, motion, np.zeros(1)))
    builder.AddNamedSystem("own_controller", system)
    sampled = builder.AddNamedSystem(
        "controller", SampledController(sc.controller.period, experiment.torque_limit)
    )
    builder.Connect(system.GetOutputPort("torque"), sampled.GetInputPort("own_torque"))
    sensor = builder.GetSubsystemByName("sensor")
    builder.Connect(sensor.GetOutputPort("measurement"), system.GetInputPort("measurement"))
    if system.HasInputPort("reference"):
        builder.Connect(reference.GetOutputPort("reference"), system.GetInputPort("reference"))


def _disturb(builder: DiagramBuilder, experiment: Experiment, torque: OutputPort) -> None:
    """Connect the torque that arrives with the plant, through a disturbance if there is one."""
    disturbance, plant = experiment.own.disturbance, builder.GetSubsystemByName("plant")
    if disturbance is not None:
        builder.AddNamedSystem("disturbance", disturbance)
        if disturbance.HasOutputPort("wrench"):
            builder.Connect(disturbance.GetOutputPort("wrench"), plant.GetInputPort("wrench"))
        if disturbance.HasOutputPort("torque"):
            total = builder.AddNamedSystem("disturbed_torque", Adder(2, NUM_TORQUES))
            builder.Connect(torque, total.get_input_port(0))
            builder.Connect(disturbance.GetOutputPort("torque"), total.get_input_port(1))
            torque = total.get_output_port()
    builder.Connect(torque, plant.GetInputPort("torque"))


def _weights(builder: DiagramBuilder, experiment: Experiment) -> ConstantVectorSource | AnnTuner:
    c = experiment.scenario.controller
    fixed = np.array([c.w_Q, c.w_R])
    if experiment.network is None:
        return builder.AddNamedSystem("weights", ConstantVectorSource(fixed))
    return builder.AddNamedSystem("tuner", AnnTuner(experiment.network, fixed, c.period))


def _link(experiment: Experiment) -> DelayChain | VaryingDelay:
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period, queue = sc.controller.period, torques_in_flight(experiment, delay)
    if sc.delay.constant:
        chain = DelayChain(period, delay.steps, delay.fraction, queue)
        declare_constant(chain, "delay", np.array([sc.eta]))  # for the record alone
        declare_constant(chain, "packets", np.full(len(PACKETS), np.nan))
        return chain
    return VaryingDelay(period, torque_delays(sc), delay, queue)


def _plant(experiment: Experiment, meshcat: Meshcat | None) -> ExactPlant | MultibodyStewart:
    plant, disturbance = experiment.scenario.plant, experiment.own.disturbance
    wrench = disturbance is not None and disturbance.HasOutputPort("wrench")
    if plant.kind == "multibody":
        return MultibodyStewart(
            experiment.truth,
            plant.time_step,
            gravity=plant.gravity,
            payload_mass=plant.payload_mass,
            joint_damping=plant.joint_damping,
            meshcat=meshcat,
            start=experiment.start[POSE],
            wrench=wrench,
        )
    parameters = np.zeros(NUM_PARAMETERS)
    parameters[PAYLOAD], parameters[DAMPING] = plant.payload_mass, plant.joint_damping
    truth = StewartDynamics(experiment.truth, plant.gravity, parameters)
    return ExactPlant(truth, experiment.start, wrench)
