"""The closed loop of a scenario as a Drake diagram."""

from pathlib import Path
from typing import Any, Final, Unpack

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import Adder, ConstantVectorSource, Saturation

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.files.errors import ConfigError
from stewart_drake.law.channel import Channel, Packets, Wire
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.loop.controller import (
    DelayLqiController,
    Reference,
    SampledController,
    ServoController,
)
from stewart_drake.loop.exact import ExactPlant, Loads
from stewart_drake.loop.kinds import make_link, make_plant, make_sensor, wire
from stewart_drake.loop.law_design import control_law, first_queue, followed_motion
from stewart_drake.loop.link import LateMeasurements
from stewart_drake.loop.own import OwnSystems
from stewart_drake.loop.platforms import Push, StartCheck, add_to_torque
from stewart_drake.loop.preparation import Experiment, as_experiment
from stewart_drake.loop.servos import (
    PositionServos,
    Servos,
    command_sent_last,
    commands_in_flight,
    position_servo,
    servo_law,
    servo_loop,
)
from stewart_drake.loop.tuner import AnnTuner, DensityWindow, LawTuner, weights_source
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.link import measurement_times
from stewart_drake.scenario.signals import NUM_TORQUES, RATES, SIGNALS, exported_ports
from stewart_drake.tuner.source import DensityFeatures, PaperPolicy

_TUNER_INPUTS: Final = {
    "density": "density.density",
    "reference": "reference.reference",
    "memory": "controller.memory",
}
"""Outputs for the optional inputs of a tuner."""


class PlantDiagram(Diagram):
    """A diagram with the plant of an experiment."""

    experiment: Experiment

    def CreateDefaultContext(self) -> Context:
        """Return a root context at t = 0 in the scenario's start state, all loops closed.

        A `Simulator` without a context starts a multibody plant at rest, since Drake has no default
        velocities. `StartCheck` warns about this.
        """
        context = super().CreateDefaultContext()
        plant: Any = self.GetSubsystemByName("plant")
        plant.set_state(plant.GetMyMutableContextFromRoot(context), self.experiment.start)
        return context


class ClosedLoop(PlantDiagram):
    """The closed loop; output ports are named after the signals.

    Subsystems, by name: `reference`, `sensor`, `controller`, `delay_chain`, `torque_bias`, `plant`,
    `density`, and as the scenario needs them:

    - `weights` (constant) or `tuner`, and `saturation`: for torques, not for servos
    - `servos`
    - `push`: of `plant.push`
    - `own_controller`, `disturbance`: systems of the user's own
    - `disturbed_torque`, `wrench`: sums of the torques and of the wrenches that act on the plant

    Output ports: `state`, `reference`, `torque_commanded` (of law or servos, without limit),
    `torque_applied` (limited and delayed, before the bias), `integral`, `weights_used`,
    `parameters`, `parameter_std`, `wrench_estimate`, `wrench_std`, `density`, `measurement` (held,
    as the controller read it), `state_estimate`, `delay_estimate`, `delay_std`, `delay_true` (of
    the newest torque), `packets`.

    Attributes:
        experiment: scenario, machines, reference and initial state of the loop.
        catch_up: length of the blend onto the reference, s; 0 without one.
    """

    catch_up: float

    def SetParameters(
        self, context: Context, *, plate_mass: float | None = None, **loads: Unpack[Loads]
    ) -> None:
        """Change mass, payload and friction of the plant in the root context.

        The controller does not know of it. Arguments and errors are those of
        `StewartPlatform.SetParameters`.

        Raises:
            ConfigError: also for a plant of kind `paper`, which has none of them.
        """
        plant: Any = self.GetSubsystemByName("plant")
        if (kind := self.experiment.scenario.plant.kind) == "paper":
            raise ConfigError(f"plant.kind: got {kind}; expected exact or multibody")
        if isinstance(plant, ExactPlant):
            own = plant.GetMyMutableContextFromRoot(context)
            plant.set_parameters(own, plate_mass=plate_mass, **loads)
        else:
            plant.platform.SetParameters(context, plate_mass=plate_mass, **loads)


def build_closed_loop(
    scenario: Scenario | str | Path | Experiment,
    *,
    meshcat: Meshcat | None = None,
    true_mechanism: Mechanism | None = None,
    **own: Unpack[OwnSystems],
) -> ClosedLoop:
    """Build the diagram of a scenario: reference, controller, limit, link, plant, sensor.

    Args:
        scenario: a scenario, prepared or not, or a shipped name or a path.
        meshcat: shows the multibody plant during the simulation, or None.
        true_mechanism: as of `simulate`.
        **own: `controller`, `reference`, `disturbance`, `modify_law`, `sensor`, `link`, `tuner`, as
            of `simulate`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: systems of the user with a prepared scenario, which has its own.
    """
    experiment = as_experiment(scenario, true_mechanism, **own)
    experiment.own.claim(experiment.scenario)
    builder = DiagramBuilder()
    sc, network = experiment.scenario, experiment.network
    own_sensor = experiment.own.systems.get("sensor")
    builder.AddNamedSystem("sensor", own_sensor or make_sensor(experiment))
    builder.AddNamedSystem("torque_bias", add_to_torque(np.array(sc.plant.torque_bias)))
    builder.AddNamedSystem("plant", make_plant(experiment, meshcat))
    kind = "magnitude" if network is None else network.density
    builder.AddNamedSystem("density", DensityWindow(sc.controller.period, kind))
    add = _add_torques if sc.actuator.kind == "torque" else _add_servos
    catch_up = add(builder, experiment)
    _connect_loop(builder, experiment)
    loop = ClosedLoop()
    builder.BuildInto(loop)
    loop.set_name("closed_loop")
    loop.experiment, loop.catch_up = experiment, catch_up
    return loop


def build_machine(experiment: Experiment) -> PlantDiagram:
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
    plant = builder.AddNamedSystem("plant", make_plant(experiment))
    builder.AddNamedSystem("sensor", make_sensor(experiment))
    _push(builder, experiment)
    _connect(builder, "plant.state", "sensor.state")
    builder.ExportInput(plant.GetInputPort("torque"), "torque")
    builder.ExportOutput(_output(builder, "plant.state"), "state")
    builder.ExportOutput(_output(builder, "sensor.measurement"), "measurement")
    machine = PlantDiagram()
    builder.BuildInto(machine)
    machine.set_name("machine")
    machine.experiment = experiment
    return machine


def _output(builder: DiagramBuilder, name: str) -> OutputPort:
    """Return the output `system.port`."""
    system, port = name.split(".")
    return builder.GetSubsystemByName(system).GetOutputPort(port)


def _connect(builder: DiagramBuilder, source: OutputPort | str, target: str) -> None:
    """Connect an output with the input `system.port`."""
    system, port = target.split(".")
    source = _output(builder, source) if isinstance(source, str) else source
    builder.Connect(source, builder.GetSubsystemByName(system).GetInputPort(port))


def _add_torques(builder: DiagramBuilder, experiment: Experiment) -> float:
    """Add a controller of torques, their limit and link; return its catch-up, s."""
    channel: Channel | Wire | Packets = Wire()
    catch_up = 0.0
    if "controller" in experiment.own.systems:
        _add_own_controller(builder, experiment)
    else:
        law, catch_up = _add_law(builder, experiment)
        channel = law.channel
    link = experiment.own.systems.get("link") or make_link(experiment, channel)
    limit = np.full(link.GetInputPort("commanded").size(), experiment.torque_limit)
    limited = builder.AddNamedSystem("saturation", Saturation(-limit, limit))
    builder.AddNamedSystem("delay_chain", link)
    packets = builder.GetSubsystemByName("controller").HasOutputPort("plan")
    wanted = _output(builder, "controller.plan" if packets else "controller.torque")
    builder.Connect(wanted, limited.get_input_port())
    _connect(builder, limited.get_output_port(), "delay_chain.commanded")
    return catch_up


def _add_servos(builder: DiagramBuilder, experiment: Experiment) -> float:
    """Add the law for servos, the delay of its commands, and the servos; return its catch-up, s."""
    sc, machine = experiment.scenario, StewartDynamics(experiment.truth)
    if found := differing(sc, {"link.kind": "wire"}):
        hint = ", or a machine and live, which send plans of setpoints over a network"
        raise ConfigError(found.problem("with servos in a simulation", hint))
    law, planned, catch_up = servo_law(experiment)
    last = command_sent_last(experiment, law)
    builder.AddNamedSystem("controller", ServoController(law, last))
    reference = Reference(experiment.reference, planned, law.preview_times)
    builder.AddNamedSystem("reference", reference)
    first, in_flight = commands_in_flight(experiment, law, sc.true_delay)
    builder.AddNamedSystem("delay_chain", wire(experiment, in_flight, "command"))
    rest = machine, first, sc.controller.period, law.reports
    servos: Servos | PositionServos
    if law.servo is None:
        servos = Servos(servo_loop(experiment), *rest)
    else:
        servos = PositionServos(position_servo(experiment), *rest)
    builder.AddNamedSystem("servos", servos)
    for source, target in (
        ("reference.preview", "controller.preview"),
        ("controller.command", "delay_chain.commanded"),
        ("delay_chain.command", "servos.command"),
        ("plant.state", "servos.state"),
    ):
        _connect(builder, source, target)
    if servos.HasInputPort("arrived"):
        _connect(builder, "delay_chain.arrived", "servos.arrived")
    return catch_up


def _connect_loop(builder: DiagramBuilder, experiment: Experiment) -> None:
    """Connect what every loop has, and export its outputs."""
    motors = "servos" if builder.HasSubsystemNamed("servos") else "delay_chain"
    measured, own = _measured(builder, experiment, motors), experiment.own.systems
    _connect(builder, measured, "controller.measurement")
    if "controller" in own:
        _connect(builder, measured, "own_controller.measurement")
    bias = builder.GetSubsystemByName("torque_bias")
    builder.Connect(_output(builder, f"{motors}.torque"), bias.get_input_port())
    _disturb(builder, own.get("disturbance"), bias.get_output_port())
    _push(builder, experiment)
    _connect(builder, "plant.state", "sensor.state")
    measures_state = experiment.scenario.sensor.measures_state
    _connect(builder, measured if measures_state else "controller.estimate", "density.measurement")
    _connect(builder, "reference.reference", "density.reference")
    _connect(builder, "controller.torque", "density.torque")
    if builder.HasSubsystemNamed("tuner"):
        # Weights precede the estimate of their sample, so that a tuner reads the one before.
        state = "sensor.measurement" if measures_state else "controller.state_estimate"
        inputs = _TUNER_INPUTS | {"measurement": state}
        tuner = builder.GetSubsystemByName("tuner")
        for name, source in inputs.items():
            if tuner.HasInputPort(name):
                _connect(builder, source, f"tuner.{name}")
    if experiment.start[RATES].any() and experiment.scenario.plant.kind == "multibody":
        builder.AddNamedSystem("start_check", StartCheck(experiment.start))
        _connect(builder, "plant.state", "start_check.state")
    for name, (source, port) in exported_ports().items():
        system = builder.GetSubsystemByName(motors if name == "torque_applied" else source)
        if system.HasOutputPort(port):
            builder.ExportOutput(system.GetOutputPort(port), name)
        else:  # a system of the user lacks the port
            size = sum(s.size for s in SIGNALS.values() if s.exported == name)
            unknown = ConstantVectorSource(np.full(size, np.nan))
            builder.AddNamedSystem(f"no_{name}", unknown)
            builder.ExportOutput(unknown.get_output_port(), name)


def _measured(builder: DiagramBuilder, experiment: Experiment, motors: str) -> OutputPort:
    """Return the measurement for the controller, with its delay; connect age and report."""
    sc, controller = experiment.scenario, builder.GetSubsystemByName("controller")
    measured, report = _output(builder, "sensor.measurement"), None
    if builder.GetSubsystemByName(motors).HasOutputPort("report"):
        report = _output(builder, f"{motors}.report")
    times = measurement_times(sc)
    if np.any(times != 0):

        def late(name: str, port: OutputPort) -> OutputPort:
            builder.AddNamedSystem(name, LateMeasurements(sc.controller.period, times, port.size()))
            _connect(builder, port, f"{name}.measured")
            return _output(builder, f"{name}.measurement")

        measured = late("late_measurements", measured)
        if controller.HasInputPort("age"):
            _connect(builder, "late_measurements.age", "controller.age")
        if report is not None:
            report = late("late_report", report)
    if report is not None and sc.link.acknowledged and controller.HasInputPort("report"):
        _connect(builder, report, "controller.report")
    return measured


def _add_law(builder: DiagramBuilder, experiment: Experiment) -> tuple[PredictiveLqi, float]:
    """Add the shipped controller, its reference and weights; return law and catch-up, s."""
    law, planned, catch_up = control_law(experiment)
    reference = Reference(experiment.reference, planned, law.preview_times)
    builder.AddNamedSystem("reference", reference)
    queue = first_queue(experiment, law)
    motion = followed_motion(law, planned, experiment.reference)
    builder.AddNamedSystem("controller", DelayLqiController(law, queue, motion))
    _connect(builder, "reference.preview", "controller.preview")
    c, tuner = experiment.scenario.controller, experiment.own.systems.get("tuner")
    if tuner is None and experiment.tuned:
        tuner = _tuner(builder, experiment, law)
    if tuner is None:
        weights = ConstantVectorSource(np.array(c.weights))
        builder.AddNamedSystem("weights", weights)
        _connect(builder, weights.get_output_port(), "controller.weights")
    else:
        builder.AddNamedSystem("tuner", tuner)
        _connect(builder, "tuner.weights", "controller.weights")
    return law, catch_up


def _add_own_controller(builder: DiagramBuilder, experiment: Experiment) -> None:
    sc, system = experiment.scenario, experiment.own.systems["controller"]
    motion = experiment.reference
    builder.AddNamedSystem("reference", Reference(motion, motion, np.zeros(1)))
    builder.AddNamedSystem("own_controller", system)
    sampled = SampledController(sc.controller.period, experiment.torque_limit)
    builder.AddNamedSystem("controller", sampled)
    _connect(builder, "own_controller.torque", "controller.own_torque")
    if system.HasInputPort("reference"):
        _connect(builder, "reference.reference", "own_controller.reference")


def _disturb(builder: DiagramBuilder, disturbance: System | None, torque: OutputPort) -> None:
    """Connect the arriving torque with the plant, through a disturbance if there is one."""
    if disturbance is not None:
        builder.AddNamedSystem("disturbance", disturbance)
        if disturbance.HasOutputPort("torque"):
            total = builder.AddNamedSystem("disturbed_torque", Adder(2, NUM_TORQUES))
            builder.Connect(torque, total.get_input_port(0))
            builder.Connect(_output(builder, "disturbance.torque"), total.get_input_port(1))
            torque = total.get_output_port()
    _connect(builder, torque, "plant.torque")


def _push(builder: DiagramBuilder, experiment: Experiment) -> None:
    """Connect the plant with the wrenches of the scenario and of the user's disturbance."""
    push, wrenches = experiment.scenario.plant.push, list[System]()
    if any(push.wrench):
        wrenches.append(builder.AddNamedSystem("push", Push(push)))
    if experiment.own.pushes:
        wrenches.append(experiment.own.systems["disturbance"])
    if not wrenches:
        return
    total = builder.AddNamedSystem("wrench", Adder(len(wrenches), len(push.wrench)))
    for i, system in enumerate(wrenches):
        builder.Connect(system.GetOutputPort("wrench"), total.get_input_port(i))
    _connect(builder, total.get_output_port(), "plant.wrench")


def _tuner(builder: DiagramBuilder, experiment: Experiment, law: PredictiveLqi) -> System:
    """Return the scenario's tuner; a network of the paper's kind reads the diagram's densities."""
    c, source = experiment.scenario.controller, weights_source(experiment, law)
    assert source is not None
    if isinstance(source.policy, PaperPolicy) and isinstance(source.features, DensityFeatures):
        return AnnTuner(source.policy.network, source.policy.first, c.period)
    controller: Any = builder.GetSubsystemByName("controller")
    first = controller.sample(controller.CreateDefaultContext())
    return LawTuner(source, first, c.period)
