"""The closed loop of a scenario as a Drake diagram."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
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
from stewart_drake.law.channel import Channel, Wire
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.controller import (
    DelayLqiController,
    Reference,
    SampledController,
    ServoController,
    reported,
)
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.kinds import LINKS, PLANTS, SENSORS, wire
from stewart_drake.loop.law_design import control_law, first_queue, followed_motion
from stewart_drake.loop.link import LateMeasurements
from stewart_drake.loop.platforms import MultibodyStewart, StartCheck, add_to_torque
from stewart_drake.loop.preparation import Experiment, concrete
from stewart_drake.loop.servos import Servos, commands_in_flight, servo_law, servo_loop
from stewart_drake.loop.tuner import AnnTuner, DensityWindow, LawTuner, weights_source
from stewart_drake.scenario.config import (
    Scenario,
    ServoActuatorConfig,
    TorqueActuatorConfig,
)
from stewart_drake.scenario.link import (
    measurement_times,
)
from stewart_drake.scenario.signals import (
    NUM_TORQUES,
    RATES,
    SIGNALS,
    exported_ports,
)
from stewart_drake.tuner.source import DensityFeatures, PaperPolicy

_TOLD: Final = ("density", "reference")
"""Optional inputs of a tuner; each is connected to the same output of the same-named system."""


class ClosedLoop(Diagram):
    """The closed loop; output ports are named after the signals.

    Subsystems: `reference`, `sensor`, `weights` or `tuner`, `controller`, `saturation`,
    `delay_chain`, `torque_bias`, `plant`, `density`; with servos `servos`, without `weights` and
    `saturation`; with the user's own `own_controller`, `disturbance`, `disturbed_torque`. Output
    ports: `state`, `reference`, `torque_commanded` (of law or servos, without limit),
    `torque_applied` (limited and delayed, before the bias), `integral`, `weights_used`,
    `parameters`, `parameter_std`, `density`, `measurement` (held, as the controller read it),
    `state_estimate`, `delay_estimate`, `delay_std`, `delay_true` (of the newest torque), `packets`.

    Attributes:
        experiment: the experiment.
        catch_up: length of the blend onto the reference, s; 0 without one.
    """

    experiment: Experiment
    catch_up: float

    def CreateDefaultContext(self) -> Context:
        """Return a root context at t = 0 in the scenario's start state, all loops closed.

        A `Simulator` without a context starts a multibody plant at rest, since Drake has no default
        velocities. `StartCheck` warns about this.
        """
        context = super().CreateDefaultContext()
        plant: Any = self.GetSubsystemByName("plant")
        plant.set_state(plant.GetMyMutableContextFromRoot(context), self.experiment.start)
        return context


def build_closed_loop(
    scenario: Scenario | Experiment,
    *,
    meshcat: Meshcat | None = None,
    **own: Any,
) -> ClosedLoop:
    """Build the diagram of a scenario: reference, controller, limit, link, plant, sensor.

    Args:
        scenario: a scenario, or a prepared one.
        meshcat: shows the multibody plant during the simulation, or None.
        **own: controller, reference, disturbance, modify_law, sensor, link, tuner, true_mechanism,
            as of `simulate`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: systems of the user with a prepared scenario, which has its own.
    """
    experiment = concrete(scenario, **own)
    experiment.own.claim(experiment.scenario)
    builder = DiagramBuilder()
    _add_surroundings(builder, experiment, meshcat)
    catch_up = _ACTUATORS[type(experiment.scenario.actuator)](builder, experiment)
    _connect_loop(builder, experiment)
    loop = ClosedLoop()
    builder.BuildInto(loop)
    loop.set_name("closed_loop")
    loop.experiment, loop.catch_up = experiment, catch_up
    return loop


def build_machine(experiment: Experiment) -> Diagram:
    """Build plant and sensor alone, for torques from elsewhere.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m, at the shafts, with the bias |
    | state | output | 12 | rad, m, rad/s, m/s |
    | measurement | output | 12, or 6 N of encoders | the same; rad |

    Args:
        experiment: of a scenario whose motors take torques.
    """
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", _plant(experiment, None))
    sensor = builder.AddNamedSystem("sensor", _sensor(experiment))
    builder.Connect(plant.GetOutputPort("state"), sensor.GetInputPort("state"))
    builder.ExportInput(plant.GetInputPort("torque"), "torque")
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    builder.ExportOutput(sensor.GetOutputPort("measurement"), "measurement")
    machine = builder.Build()
    machine.set_name("machine")
    return machine


def _add_torques(builder: DiagramBuilder, experiment: Experiment) -> float:
    """Add a controller of torques, their limit and link; return its catch-up, s."""
    channel: Channel = Wire()
    reports, catch_up = 1, 0.0
    if "controller" in experiment.own.systems:
        _add_own_controller(builder, experiment)
    else:
        law, catch_up = _add_law(builder, experiment)
        channel, reports = law.channel, reported(law.kept)
    link, config = experiment.own.systems.get("link"), experiment.scenario.link
    if link is None:
        link = LINKS[type(config)].system(config, experiment, channel, reports)
    limit = np.full(link.GetInputPort("commanded").size(), experiment.torque_limit)
    builder.AddNamedSystem("saturation", Saturation(-limit, limit))
    builder.AddNamedSystem("delay_chain", link)
    sends = builder.GetSubsystemByName("controller").HasOutputPort("plan")
    wanted = builder.GetSubsystemByName("controller").GetOutputPort("plan" if sends else "torque")
    limited = builder.GetSubsystemByName("saturation")
    builder.Connect(wanted, limited.get_input_port())
    builder.Connect(limited.get_output_port(), link.GetInputPort("commanded"))
    return catch_up


def _add_servos(builder: DiagramBuilder, experiment: Experiment) -> float:
    """Add the law for servos, the delay of its commands, and the servos; return its catch-up, s."""
    sc, machine = experiment.scenario, StewartDynamics(experiment.truth)
    law, planned, catch_up = servo_law(experiment)
    first, believed = commands_in_flight(experiment, law, law.timeline.delay)
    last = believed[-1] if len(believed) else first
    controller = builder.AddNamedSystem("controller", ServoController(law, last))
    reference = builder.AddNamedSystem(
        "reference", Reference(experiment.reference, planned, law.preview_times)
    )
    builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
    _, flying = commands_in_flight(experiment, law, sc.true_delay)
    chain = builder.AddNamedSystem("delay_chain", wire(experiment, flying, "command"))
    builder.Connect(controller.GetOutputPort("command"), chain.GetInputPort("commanded"))
    servos = builder.AddNamedSystem(
        "servos",
        Servos(servo_loop(experiment), machine, first, sc.controller.period, law.reports),
    )
    for port in ("command", "arrived"):
        builder.Connect(chain.GetOutputPort(port), servos.GetInputPort(port))
    plant = builder.GetSubsystemByName("plant")
    builder.Connect(plant.GetOutputPort("state"), servos.GetInputPort("state"))
    return catch_up


_ACTUATORS: Final[Mapping[type, Callable[[DiagramBuilder, Experiment], float]]] = {
    TorqueActuatorConfig: _add_torques,
    ServoActuatorConfig: _add_servos,
}
"""Functions that add controller, link and motors to a loop, and return its catch-up in s."""


def _add_surroundings(
    builder: DiagramBuilder, experiment: Experiment, meshcat: Meshcat | None
) -> None:
    """Add sensor, bias, plant and density window."""
    sc = experiment.scenario
    period = sc.controller.period
    builder.AddNamedSystem("sensor", _sensor(experiment))
    builder.AddNamedSystem("torque_bias", add_to_torque(np.array(sc.plant.torque_bias)))
    builder.AddNamedSystem("plant", _plant(experiment, meshcat))
    kind = "magnitude" if experiment.network is None else experiment.network.density
    builder.AddNamedSystem("density", DensityWindow(period, kind))


def _sensor(experiment: Experiment) -> System:
    """Return the user's own, or the scenario's."""
    own, config = experiment.own.systems.get("sensor"), experiment.scenario.sensor
    return SENSORS[type(config)].system(config, experiment) if own is None else own


def _plant(experiment: Experiment, meshcat: Meshcat | None) -> ExactPlant | MultibodyStewart:
    disturbance = experiment.own.systems.get("disturbance")
    wrench = disturbance is not None and disturbance.HasOutputPort("wrench")
    return PLANTS[experiment.scenario.plant.kind](experiment, wrench, meshcat)


def _connect_loop(builder: DiagramBuilder, experiment: Experiment) -> None:
    """Connect what every loop has, and name its outputs."""

    def out(source: str, port: str) -> OutputPort:
        return builder.GetSubsystemByName(source).GetOutputPort(port)

    def into(target: str, port: str) -> InputPort:
        return builder.GetSubsystemByName(target).GetInputPort(port)

    bias, motors = builder.GetSubsystemByName("torque_bias"), _motors(builder)
    measured = _measured(builder, experiment)
    builder.Connect(measured, into("controller", "measurement"))
    if "controller" in experiment.own.systems:
        builder.Connect(measured, into("own_controller", "measurement"))
    builder.Connect(motors.GetOutputPort("torque"), bias.get_input_port())
    _disturb(builder, experiment, bias.get_output_port())
    builder.Connect(out("plant", "state"), into("sensor", "state"))
    measured_state = experiment.scenario.sensor.measures_state
    state = measured if measured_state else out("controller", "estimate")
    builder.Connect(state, into("density", "measurement"))
    builder.Connect(out("reference", "reference"), into("density", "reference"))
    builder.Connect(out("controller", "torque"), into("density", "torque"))
    if builder.HasSubsystemNamed("tuner"):
        # Weights precede the estimate of their sample, so that a tuner reads the one before.
        told = ("sensor", "measurement") if measured_state else ("controller", "state_estimate")
        state = out(*told)
        _connect_tuner(builder, builder.GetSubsystemByName("tuner"), state)
    if experiment.start[RATES].any() and experiment.scenario.plant.kind == "multibody":
        builder.AddNamedSystem("start_check", StartCheck(experiment.start))
        builder.Connect(out("plant", "state"), into("start_check", "state"))
    for name, (source, port) in exported_ports().items():
        system = motors if name == "torque_applied" else builder.GetSubsystemByName(source)
        if system.HasOutputPort(port):
            builder.ExportOutput(system.GetOutputPort(port), name)
        else:  # a system of the user lacks the port
            size = sum(s.size for s in SIGNALS.values() if s.exported == name)
            unknown = ConstantVectorSource(np.full(size, np.nan))
            builder.AddNamedSystem(f"no_{name}", unknown)
            builder.ExportOutput(unknown.get_output_port(), name)


def _motors(builder: DiagramBuilder) -> System:
    """Return the system whose torque acts: the servos, or the link where there are none."""
    servos = builder.HasSubsystemNamed("servos")
    return builder.GetSubsystemByName("servos" if servos else "delay_chain")


def _measured(builder: DiagramBuilder, experiment: Experiment) -> OutputPort:
    """Return the output that the controller measures: of the sensor, or of its delay."""
    sc, controller = experiment.scenario, builder.GetSubsystemByName("controller")
    measured = builder.GetSubsystemByName("sensor").GetOutputPort("measurement")
    motors = _motors(builder)
    report = motors.GetOutputPort("report") if motors.HasOutputPort("report") else None
    times = measurement_times(sc)
    if np.any(times != 0):

        def late(name: str, port: OutputPort) -> System:
            way = LateMeasurements(sc.controller.period, times, port.size())
            builder.AddNamedSystem(name, way)
            builder.Connect(port, way.GetInputPort("measured"))
            return way

        way = late("late_measurements", measured)
        measured = way.GetOutputPort("measurement")
        if controller.HasInputPort("age"):
            builder.Connect(way.GetOutputPort("age"), controller.GetInputPort("age"))
        if report is not None:
            report = late("late_report", report).GetOutputPort("measurement")
    if report is not None and sc.link.acknowledged and controller.HasInputPort("report"):
        builder.Connect(report, controller.GetInputPort("report"))
    return measured


def _add_law(builder: DiagramBuilder, experiment: Experiment) -> tuple[PredictiveLqi, float]:
    """Add the shipped controller, its reference and weights; return law and catch-up, s."""
    law, planned, catch_up = control_law(experiment)
    reference = builder.AddNamedSystem(
        "reference", Reference(experiment.reference, planned, law.preview_times)
    )
    queue, motion = (
        first_queue(experiment, law),
        followed_motion(law, planned, experiment.reference),
    )
    controller = builder.AddNamedSystem("controller", DelayLqiController(law, queue, motion))
    weights = _weights(builder, experiment, law)
    builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
    builder.Connect(weights, controller.GetInputPort("weights"))
    return law, catch_up


def _add_own_controller(builder: DiagramBuilder, experiment: Experiment) -> None:
    """Add the user's controller, its reference, and the system that samples it."""
    sc, system = experiment.scenario, experiment.own.systems["controller"]
    motion = experiment.reference
    reference = builder.AddNamedSystem("reference", Reference(motion, motion, np.zeros(1)))
    builder.AddNamedSystem("own_controller", system)
    sampled = builder.AddNamedSystem(
        "controller", SampledController(sc.controller.period, experiment.torque_limit)
    )
    builder.Connect(system.GetOutputPort("torque"), sampled.GetInputPort("own_torque"))
    if system.HasInputPort("reference"):
        builder.Connect(reference.GetOutputPort("reference"), system.GetInputPort("reference"))


def _disturb(builder: DiagramBuilder, experiment: Experiment, torque: OutputPort) -> None:
    """Connect the torque that arrives with the plant, through a disturbance if there is one."""
    disturbance = experiment.own.systems.get("disturbance")
    plant = builder.GetSubsystemByName("plant")
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


def _weights(builder: DiagramBuilder, experiment: Experiment, law: PredictiveLqi) -> OutputPort:
    """Return the output that sets the weights: of a `tuner`, or of constant `weights`."""
    c, own = experiment.scenario.controller, experiment.own.systems.get("tuner")
    fixed = np.array([c.w_Q, c.w_R])
    if own is None and not experiment.tuned:
        return builder.AddNamedSystem("weights", ConstantVectorSource(fixed)).get_output_port()
    tuner = _tuner(builder, experiment, law) if own is None else own
    return builder.AddNamedSystem("tuner", tuner).GetOutputPort("weights")


def _tuner(builder: DiagramBuilder, experiment: Experiment, law: PredictiveLqi) -> System:
    """Return the scenario's tuner; a network of the paper's kind reads the diagram's densities."""
    c, source = experiment.scenario.controller, weights_source(experiment, law)
    assert source is not None
    if isinstance(source.policy, PaperPolicy) and isinstance(source.features, DensityFeatures):
        return AnnTuner(source.policy.network, source.policy.first, c.period)
    controller: Any = builder.GetSubsystemByName("controller")
    first = controller.sample(controller.CreateDefaultContext())
    return LawTuner(source, first, c.period)


def _connect_tuner(builder: DiagramBuilder, tuner: System, state: OutputPort) -> None:
    """Connect the inputs that a tuner has, `measurement` with `state`."""
    told = {name: builder.GetSubsystemByName(name).GetOutputPort(name) for name in _TOLD}
    controller = builder.GetSubsystemByName("controller")
    if controller.HasOutputPort("memory"):
        told["memory"] = controller.GetOutputPort("memory")
    for name, port in (told | {"measurement": state}).items():
        if tuner.HasInputPort(name):
            builder.Connect(port, tuner.GetInputPort(name))
