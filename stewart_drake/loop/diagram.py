"""The closed loop as a Drake diagram, built from a scenario. Here its systems are connected."""

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
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.channel import Channel, Packets, Wire
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.controller import DelayLqiController, reported
from stewart_drake.loop.delay_chain import DelayChain
from stewart_drake.loop.density import DensityWindow
from stewart_drake.loop.encoders import Encoders
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.loop.experiment import (
    Experiment,
    concrete,
    control_law,
    first_queue,
    followed_motion,
    limits_of,
    motion_scale,
    torques_in_flight,
    true_dynamics,
)
from stewart_drake.loop.late_measurements import LateMeasurements
from stewart_drake.loop.multibody_stewart import MultibodyStewart
from stewart_drake.loop.own_controller import SampledController
from stewart_drake.loop.platforms import add_to_torque
from stewart_drake.loop.playout import PlayoutBuffer
from stewart_drake.loop.reference import Reference
from stewart_drake.loop.sensor import Sensor
from stewart_drake.loop.servo_controller import ServoController
from stewart_drake.loop.servo_design import commands_in_flight, servo_law, servo_loop
from stewart_drake.loop.servos import Servos
from stewart_drake.loop.start_check import StartCheck
from stewart_drake.loop.tuner import AnnTuner, LawTuner
from stewart_drake.loop.varying_delay import VaryingDelay, declare_constant
from stewart_drake.loop.weights import weights_source
from stewart_drake.scenario.config import (
    EncoderSensorConfig,
    NetworkConfig,
    Scenario,
    ServoActuatorConfig,
)
from stewart_drake.scenario.link import (
    forward_times,
    measurement_times,
    number_sent,
    torque_delays,
)
from stewart_drake.scenario.signals import (
    NUM_TORQUES,
    PACKETS,
    POSE,
    RATES,
    SIGNALS,
    Carried,
    exported_ports,
)
from stewart_drake.tuner.features import DensityFeatures
from stewart_drake.tuner.source import PaperPolicy
from stewart_drake.types import Array

_TOLD: Final = ("density", "reference")
"""What a tuner may ask for beside the state, and the systems whose outputs of their name it is."""


class ClosedLoop(Diagram):
    """The whole loop; output ports are named after the signals.

    Subsystems: `reference`, `sensor`, `weights` or `tuner`, `controller`, `saturation`,
    `delay_chain`, `torque_bias`, `plant`, `density`; with servos `servos`, without `weights` and
    `saturation`; with the user's own `own_controller`, `disturbance`, `disturbed_torque`. Output
    ports: `state`, `reference`, `torque_commanded` (what the law asks for, or the servos did),
    `torque_applied` (what acts of it: within the motors' limit, late, before the bias),
    `integral`, `weights_used`, `parameters`, `parameter_std`, `density`, `measurement` (held, as
    the controller read it), `state_estimate`, `delay_estimate`, `delay_std`, `delay_true` (of the
    torque sent last), `packets`.

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
    meshcat: Meshcat | None = None,
    **own: Any,
) -> ClosedLoop:
    """The diagram of a scenario: reference, controller, limit, delay chain, plant, sensor.

    Args:
        scenario: what to build, or what `prepare` made of it.
        meshcat: where the multibody plant is shown while it is simulated, or None.
        **own: controller, reference, disturbance, modify_law, sensor, link, tuner, true_mechanism,
            as of `simulate`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: systems of one's own beside an Experiment, which has its own.
    """
    experiment = concrete(scenario, **own)
    experiment.own.claim()
    builder = DiagramBuilder()
    _add_surroundings(builder, experiment, meshcat)
    if isinstance(experiment.scenario.actuator, ServoActuatorConfig):
        catch_up = _add_servos(builder, experiment)
    else:
        catch_up = _add_torques(builder, experiment)
    _connect_loop(builder, experiment)
    loop = ClosedLoop()
    builder.BuildInto(loop)
    loop.set_name("closed_loop")
    loop.experiment, loop.catch_up = experiment, catch_up
    return loop


def build_machine(experiment: Experiment) -> Diagram:
    """Plant and sensor alone, for torques that come from elsewhere.

    | port | direction | size | unit |
    | --- | --- | --- | --- |
    | torque | input | 6 | N m, at the shafts: what acts, and the bias |
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
    """A controller that sends torques, their limit and their delay; the law's catch-up, s."""
    channel: Channel = Wire()
    reports, catch_up = 1, 0.0
    if "controller" in experiment.own.systems:
        _add_own_controller(builder, experiment)
    else:
        law, catch_up = _add_law(builder, experiment)
        channel, reports = law.channel, reported(law.kept)
    link = _link(experiment, channel, reports)
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
    """The law for servos, the delay of its commands, and the servos; its catch-up, s.

    Raises:
        ConfigError: a controller or a link of the user's own, which are for torques.
    """
    for role in ("controller", "link"):
        if role in experiment.own.systems:
            raise ConfigError(
                f"actuator.kind: got 'servo' with a {role} of your own; expected 'torque'"
            )
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
    chain = builder.AddNamedSystem("delay_chain", _wire(experiment, flying, "command"))
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


def _add_surroundings(
    builder: DiagramBuilder, experiment: Experiment, meshcat: Meshcat | None
) -> None:
    """Everything but reference and controller."""
    sc = experiment.scenario
    period = sc.controller.period
    builder.AddNamedSystem("sensor", _sensor(experiment))
    builder.AddNamedSystem("torque_bias", add_to_torque(np.array(sc.plant.torque_bias)))
    builder.AddNamedSystem("plant", _plant(experiment, meshcat))
    kind = "magnitude" if experiment.network is None else experiment.network.density
    builder.AddNamedSystem("density", DensityWindow(period, kind))


def _sensor(experiment: Experiment) -> System:
    """The user's own, or the scenario's.

    Raises:
        ConfigError: encoders, with a sensor or a controller of the user's own.
    """
    s, own, period = (
        experiment.scenario.sensor,
        experiment.own.systems,
        experiment.scenario.controller.period,
    )
    motion = motion_scale(experiment)
    if not isinstance(s, EncoderSensorConfig):
        sensor = Sensor(np.array(s.noise_std), s.seed, period, s.faults, motion)
        return own.get("sensor", sensor)
    for role in ("sensor", "controller"):
        if role in own:
            raise ConfigError(
                f"sensor.kind: got 'encoders' with a {role} of your own; expected 'state'"
            )
    cranks = np.abs(experiment.truth.jacobian(experiment.start[POSE])) @ motion
    return Encoders(experiment.truth, s.bits, s.samples, s.offset, s.seed, period, s.faults, cranks)


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
    encoders = isinstance(experiment.scenario.sensor, EncoderSensorConfig)
    state = out("controller", "estimate") if encoders else measured
    builder.Connect(state, into("density", "measurement"))
    builder.Connect(out("reference", "reference"), into("density", "reference"))
    builder.Connect(out("controller", "torque"), into("density", "torque"))
    if builder.HasSubsystemNamed("tuner"):
        # Weights come before the estimate of their sample, so that theirs is of the one before.
        state = out("controller", "state_estimate") if encoders else out("sensor", "measurement")
        _connect_tuner(builder, builder.GetSubsystemByName("tuner"), state)
    if experiment.start[RATES].any() and experiment.scenario.plant.kind == "multibody":
        builder.AddNamedSystem("start_check", StartCheck(experiment.start))
        builder.Connect(out("plant", "state"), into("start_check", "state"))
    for name, (source, port) in exported_ports().items():
        system = motors if name == "torque_applied" else builder.GetSubsystemByName(source)
        if system.HasOutputPort(port):
            builder.ExportOutput(system.GetOutputPort(port), name)
        else:  # of a system of one's own
            size = sum(s.size for s in SIGNALS.values() if s.exported == name)
            unknown = ConstantVectorSource(np.full(size, np.nan))
            builder.AddNamedSystem(f"no_{name}", unknown)
            builder.ExportOutput(unknown.get_output_port(), name)


def _motors(builder: DiagramBuilder) -> System:
    """Whose torque acts: the servos' where there are some, else what comes over the link."""
    servos = builder.HasSubsystemNamed("servos")
    return builder.GetSubsystemByName("servos" if servos else "delay_chain")


def _measured(builder: DiagramBuilder, experiment: Experiment) -> OutputPort:
    """Where the controller has its measurements from: the sensor, or what they are delayed by."""
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
    told = not isinstance(sc.link, NetworkConfig) or sc.link.acknowledged
    if report is not None and told and controller.HasInputPort("report"):
        builder.Connect(report, controller.GetInputPort("report"))
    return measured


def _add_law(builder: DiagramBuilder, experiment: Experiment) -> tuple[PredictiveLqi, float]:
    """The shipped controller behind its reference and weights; its law, and its catch-up, s."""
    law, planned, catch_up = control_law(experiment)
    reference = builder.AddNamedSystem(
        "reference", Reference(experiment.reference, planned, law.preview_times)
    )
    queue, motion = first_queue(experiment, law), followed_motion(experiment, law, planned)
    controller = builder.AddNamedSystem("controller", DelayLqiController(law, queue, motion))
    weights = _weights(builder, experiment, law)
    builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
    builder.Connect(weights, controller.GetInputPort("weights"))
    return law, catch_up


def _add_own_controller(builder: DiagramBuilder, experiment: Experiment) -> None:
    """The user's controller behind its reference, and what samples it."""
    sc, system = experiment.scenario, experiment.own.systems["controller"]
    if experiment.tuned:
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
    """What the controller's weights come from: a `tuner`, or constant `weights`."""
    c, own = experiment.scenario.controller, experiment.own.systems.get("tuner")
    fixed = np.array([c.w_Q, c.w_R])
    if own is None and not experiment.tuned:
        return builder.AddNamedSystem("weights", ConstantVectorSource(fixed)).get_output_port()
    tuner = _tuner(builder, experiment, law) if own is None else own
    return builder.AddNamedSystem("tuner", tuner).GetOutputPort("weights")


def _tuner(builder: DiagramBuilder, experiment: Experiment, law: PredictiveLqi) -> System:
    """The scenario's, that of a network of the paper's kind by the densities in the diagram."""
    c, source = experiment.scenario.controller, weights_source(experiment, law)
    assert source is not None
    if isinstance(source.policy, PaperPolicy) and isinstance(source.features, DensityFeatures):
        return AnnTuner(source.policy.network, source.policy.first, c.period)
    controller: Any = builder.GetSubsystemByName("controller")
    first = controller.sample(controller.CreateDefaultContext())
    return LawTuner(source, first, c.period)


def _connect_tuner(builder: DiagramBuilder, tuner: System, state: OutputPort) -> None:
    """Give it of what the loop can tell, the state among it, those that it has ports for."""
    told = {name: builder.GetSubsystemByName(name).GetOutputPort(name) for name in _TOLD}
    controller = builder.GetSubsystemByName("controller")
    if controller.HasOutputPort("memory"):
        told["memory"] = controller.GetOutputPort("memory")
    for name, port in (told | {"measurement": state}).items():
        if tuner.HasInputPort(name):
            builder.Connect(port, tuner.GetInputPort(name))


def _link(experiment: Experiment, channel: Channel, reports: int) -> System:
    """What is between limit and motors, for a law's channel and reports of so many periods."""
    own = experiment.own.systems.get("link")
    if own is not None:
        if isinstance(experiment.scenario.link, NetworkConfig):
            raise ConfigError("link.kind: got 'network' with a link of your own; expected 'wire'")
        return own
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period, queue = sc.controller.period, torques_in_flight(experiment, delay)
    if isinstance(sc.link, NetworkConfig):
        repeats = channel.repeats if isinstance(channel, Packets) else 0
        times = forward_times(sc, number_sent(sc.duration, period))
        return PlayoutBuffer(
            period,
            times,
            delay,
            queue,
            rows=repeats + channel.torques,
            repeats=repeats,
            dry=sc.link.dry,
            history=reports,
        )
    return _wire(experiment, queue, "torque")


def _wire(experiment: Experiment, queue: Array, carries: Carried) -> System:
    """A wire, with what is under way on it at t = 0, (L, n)."""
    sc, delay = experiment.scenario, experiment.scenario.true_delay
    period = sc.controller.period
    if not sc.delay.constant:
        return VaryingDelay(period, torque_delays(sc), delay, queue, carries)
    chain = DelayChain(period, delay.steps, delay.fraction, queue, carries)
    declare_constant(chain, "delay", np.array([sc.eta]))  # for the record alone
    declare_constant(chain, "packets", np.full(len(PACKETS), np.nan))
    return chain


def _plant(experiment: Experiment, meshcat: Meshcat | None) -> ExactPlant | MultibodyStewart:
    plant, disturbance = experiment.scenario.plant, experiment.own.systems.get("disturbance")
    wrench = disturbance is not None and disturbance.HasOutputPort("wrench")
    if plant.kind == "multibody":
        return MultibodyStewart(
            experiment.truth,
            plant.time_step,
            gravity=plant.gravity,
            meshcat=meshcat,
            start=experiment.start[POSE],
            wrench=wrench,
            payload_mass=plant.payload_mass,
            payload_position=plant.payload_position,
            joint_damping=plant.joint_damping,
            coulomb_friction=plant.coulomb_friction,
            coulomb_speed=plant.coulomb_speed,
        )
    truth = true_dynamics(experiment, biased=False)
    return ExactPlant(truth, experiment.start, wrench, limits_of(experiment))
