"""A scenario made concrete: mechanism, reference, and the control law that it asks for."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.frozen_map import Band, FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import Failure, Limits, Workspace, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.law.catch_up import CatchUp
from stewart_drake.law.channel import Channel, Packets, Wire
from stewart_drake.law.cost import QuadraticCost
from stewart_drake.law.delay_filter import delay_settings
from stewart_drake.law.delay_observer import DelayObserver
from stewart_drake.law.design_models import DesignModel, MultibodyModel, PaperModel
from stewart_drake.law.encoder_observers import DifferencesObserver, EncoderObserver
from stewart_drake.law.encoder_sensing import EncoderSensing
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    Feedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.filter_settings import (
    ParameterSet,
    filter_settings,
    usual_parameters,
)
from stewart_drake.law.gaps import GapObserver
from stewart_drake.law.late import LateObserver
from stewart_drake.law.motors import TorqueLimit
from stewart_drake.law.nominal import NominalPlant
from stewart_drake.law.observers import NoObserver, Observer, ParameterObserver
from stewart_drake.law.planner import NoPlanner, Rejoin
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import (
    ArrivalPredictor,
    LinearPredictor,
    NonlinearPredictor,
    Predictor,
)
from stewart_drake.law.sensing import Sensing, StateSensing
from stewart_drake.law.startup import (
    STILL,
    choose_substeps,
    initial_queue,
    machine_torque,
    reference_torque,
    turning_substeps,
    weight_scales,
)
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.controller import reported
from stewart_drake.loop.own import NOTHING, Own, take
from stewart_drake.loop.own_motion import own_motion
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Mechanism, fingerprint
from stewart_drake.mechanism.rotors import with_rotors
from stewart_drake.native.layout import plate_radius
from stewart_drake.scenario.calibration import DELAY, OFFSETS, Calibration, load_calibration
from stewart_drake.scenario.config import (
    AnnTunerConfig,
    EncoderSensorConfig,
    FixedTunerConfig,
    NetworkConfig,
    Scenario,
    ServoActuatorConfig,
)
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.field_types import MOST_PERIODS
from stewart_drake.scenario.packets import BurstChain, in_time, times_under_way
from stewart_drake.scenario.signals import (
    BIAS,
    COULOMB,
    DAMPING,
    PARAMETERS,
    PAYLOAD,
    PLANT_PARAMETERS,
    POSE,
    POSITION,
)
from stewart_drake.scenario.trajectories import evaluate, make_reference, moved, peak_to_peak
from stewart_drake.tuner.network import DEFAULT, Network, load_network
from stewart_drake.types import Array

GENTLE = 3.0
"""Torques up to so many times the reference's are predicted with the usual steps."""
_MOST = 0.999
"""Share of the measurements that are waited for."""
_PATIENCE = 10
"""Periods by which a measurement may be later than that, or lost, before the model goes on."""
_REPORTS = 10
"""Reports in a row that may be lost without losing what they said."""
LOST = 10.0
"""Peak-to-peaks by which a plant without a workspace, the paper's, may be off its reference."""
REACH_CHECK_PERIOD = 0.02
"""s between the instants at which a reference is checked against the workspace."""


class Experiment(NamedTuple):
    """A scenario made concrete: what the loop and everything that judges it are built from."""

    scenario: Scenario
    mechanism: Mechanism
    """As the controller knows it."""
    truth: Mechanism
    """The machine that is simulated."""
    reference: Trajectory
    peak_to_peak: Array
    """(6,) of the reference, rad and m, 0 where it is constant."""
    nominal: StewartDynamics
    """The plant as the controller knows it."""
    start: Array
    """(12,) state at t = 0."""
    network: Network | None
    """What sets the weights, or None."""
    own: Own = NOTHING
    """What takes the place of the scenario's."""
    calibration: Calibration | None = None
    """Parameters of the machine that the controller knows beside its drawing."""

    def __repr__(self) -> str:
        return f"Experiment({self.mechanism}, {self.scenario})"

    @property
    def torque_limit(self) -> float:
        """Of each motor, N m, infinite for none: the scenario's, else that of the true machine."""
        own = self.scenario.actuator.torque_limit
        frozen = self.scenario.plant.kind == "paper"  # has none of its own
        limit = (None if frozen else self.truth.effort_limit) if own is None else own
        return math.inf if limit is None or limit == "none" else limit

    @property
    def tuned(self) -> bool:
        """Whether a tuner of the scenario sets the weights."""
        return not isinstance(self.scenario.tuner, FixedTunerConfig)

    @property
    def scale(self) -> Array:
        """(6,) A_i of equation (47): the peak to peak, 1 where the reference is constant."""
        return np.where(self.peak_to_peak > 0, self.peak_to_peak, 1.0)


def prepare(scenario: Scenario, truth: Mechanism | None = None, own: Own = NOTHING) -> Experiment:
    """Check a scenario against its mechanism.

    Args:
        scenario: what to run.
        truth: the machine to simulate, that of the scenario's plant if None.
        own: what takes the place of the scenario's.

    Raises:
        ConfigError: one line; also where the reference leaves the workspace, with time and leg.
    """
    experiment = assemble(scenario, truth, own)
    failure = reference_failure(experiment)
    if failure is not None:
        first = experiment.reference.value(0.0)[:, 0]
        short = failure.leg is not None and failure.margin < 0
        raise ConfigError(
            f"reference: {failure.reason} at t = {failure.time:.2f} s"
            + (f", short by {-1e3 * failure.margin:.3g} mm" if short else "")
            + "; expected a motion within reach"
            + (
                ", such as one of smaller amplitude"
                if failure.time > 0
                else f": {first_pose_text(first, experiment.mechanism)}"
            )
        )
    outside = diagnose(experiment.truth, 0.0, experiment.start[POSE])
    if outside is not None:
        raise ConfigError(
            f"plant.mechanism: got {experiment.truth.name}, which does not reach the first pose "
            f"({outside.reason}); expected a machine that does"
        )
    return experiment


def concrete(
    scenario: Scenario | Experiment, true_mechanism: Mechanism | None = None, **own: Any
) -> Experiment:
    """What `prepare` makes of a scenario and of what is the user's own, or an Experiment as it is.

    Args:
        scenario: either.
        true_mechanism: the machine to simulate, that of the scenario's plant if None.
        **own: see `loop.simulation.simulate`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: something of one's own beside an Experiment, which has its own.
    """
    if not isinstance(scenario, Experiment):
        return prepare(scenario, true_mechanism, take(own))
    for name, thing in ({"true_mechanism": true_mechanism} | own).items():
        if thing is not None:
            raise TypeError(f"{name}: got one with an Experiment, which has its own; expected None")
    return scenario


def first_pose_text(pose: Array, mechanism: Mechanism) -> str:
    """Where a reference begins, and home: a wrong unit shows, and a height counted from home."""
    first, home = (
        ", ".join(f"{1e3 * value:.6g}" for value in where[POSITION])
        for where in (pose, mechanism.home)
    )
    return f"it begins at x, y, z = {first} mm, home is at {home} mm"


def check_instants(duration: float) -> Array:
    """Where a reference is checked against the workspace, s: every REACH_CHECK_PERIOD, and last."""
    return np.append(np.arange(0.0, duration - 1e-9, REACH_CHECK_PERIOD), duration)


def reference_failure(experiment: Experiment) -> Failure | None:
    """Where and why the reference first leaves the workspace, or None."""
    for t in check_instants(experiment.scenario.duration):
        failure = diagnose(experiment.mechanism, t, experiment.reference.value(t)[:, 0])
        if failure is not None:
            return failure
    return None


def assemble(scenario: Scenario, truth: Mechanism | None = None, own: Own = NOTHING) -> Experiment:
    """What `prepare` returns, whether or not the reference stays in the workspace.

    Raises:
        ConfigError: one line.
    """
    scenario.check()
    network = network_of(scenario)
    drawn = load_mechanism(scenario.mechanism)
    calibration = calibration_of(scenario, drawn)
    mechanism = with_motors(drawn, scenario)
    if own.reference is None:
        reference = make_reference(scenario.reference, scenario.duration)
        span = peak_to_peak(scenario.reference, reference, scenario.duration)
    else:
        reference = own_motion(own.reference, scenario.duration)
        span = moved(reference, scenario.duration)
    start = evaluate(reference, 0.0)[:12]
    if scenario.start == "rest":
        start[6:] = 0.0
    return Experiment(
        scenario=scenario,
        mechanism=mechanism,
        truth=with_motors(simulated_machine(scenario) if truth is None else truth, scenario),
        reference=reference,
        peak_to_peak=span,
        nominal=_equations(scenario)(
            mechanism, scenario.plant.gravity, known_values(calibration), estimated(scenario)
        ),
        start=start,
        network=network,
        own=own,
        calibration=calibration,
    )


def _equations(scenario: Scenario) -> type[StewartDynamics]:
    """Whose the plant's are, in the controller and out of it."""
    return FrozenDynamics if scenario.plant.kind == "paper" else StewartDynamics


def true_dynamics(experiment: Experiment, *, biased: bool = True) -> StewartDynamics:
    """The plant as it is simulated, closed exactly whatever engine moves it.

    In a loop it is not `biased`: there the bias is added before, where the record of torques ends.
    """
    scenario, plant = experiment.scenario, experiment.scenario.plant
    parameters = np.array(plant.parameters)
    parameters[BIAS] *= biased
    return _equations(scenario)(experiment.truth, plant.gravity, parameters)


def limits_of(experiment: Experiment) -> Limits:
    """Where its plate may be."""
    if experiment.scenario.plant.kind != "paper":
        return Workspace(experiment.truth)
    reference = experiment.reference
    return Band(lambda time: reference.value(time)[:, 0], LOST * experiment.scale)


def estimated(scenario: Scenario) -> tuple[str, ...]:
    """Names of what the estimator finds, if there is one; the eight of the record first."""
    chosen = scenario.controller.estimate
    coulomb = [PLANT_PARAMETERS[COULOMB]] * ("coulomb" in chosen)
    return (*PARAMETERS, *coulomb, *OFFSETS * ("offsets" in chosen))


def with_motors(mechanism: Mechanism, scenario: Scenario) -> Mechanism:
    """The machine with the rotors of its servos."""
    actuator = scenario.actuator
    if not isinstance(actuator, ServoActuatorConfig):
        return mechanism
    return with_rotors(mechanism, actuator.reflected_inertia)


def simulated_machine(scenario: Scenario) -> Mechanism:
    """That of the scenario's plant, else the one that the controller knows.

    Raises:
        ConfigError: one line.
    """
    name = scenario.plant.mechanism
    if name is None:
        return load_mechanism(scenario.mechanism)
    try:
        path = resolve("mechanism", name)
    except ConfigError as error:
        raise ConfigError(f"plant.{error}") from None
    return load_mechanism(path)


def _read_calibration(scenario: Scenario) -> Calibration | None:
    """Return the content of the file `controller.calibration`, None without one.

    Raises:
        ConfigError: one line.
    """
    c = scenario.controller
    if c.calibration is None:
        return None
    try:
        return load_calibration(c.calibration)
    except ConfigError as error:
        raise ConfigError(f"controller.calibration: {error}") from None


def calibration_of(scenario: Scenario, mechanism: Mechanism) -> Calibration | None:
    """Return the calibration that the controller uses, checked against its machine.

    Raises:
        ConfigError: one line.
    """
    c, own, calibration = scenario.controller, fingerprint(mechanism), _read_calibration(scenario)
    if calibration is None:
        return None
    if calibration.mechanism != own:
        raise ConfigError(
            f"controller.calibration: got {c.calibration}, of another machine "
            f"({calibration.mechanism}); expected one of {mechanism.name} ({own})"
        )
    believed = believed_delay(scenario).eta(c.period)
    if c.delay_estimator != "none" and believed > c.delay_max:
        raise ConfigError(
            f"controller.delay_max: got {c.delay_max:g} s, less than the {believed:g} s that are "
            "believed in; expected as much or more"
        )
    return calibration


def known_values(calibration: Calibration | None) -> Array:
    """Return the parameters of the plant (13,) that the controller assumes at first."""
    values = plant_parameters()
    for i, name in enumerate(PLANT_PARAMETERS):
        found = None if calibration is None else calibration.value(name)
        values[i] = values[i] if found is None else found
    return values


def offsets_of(calibration: Calibration | None) -> Array:
    """Return the calibrated mounting offsets (6,) of the encoders, rad."""
    found = [None if calibration is None else calibration.value(name) for name in OFFSETS]
    return np.array([0.0 if value is None else value for value in found])


def network_of(scenario: Scenario) -> Network | None:
    """What the scenario's tuner decides with, where that is a network.

    Raises:
        ConfigError: there is no such file, or it holds none; one line.
    """
    tuner = scenario.tuner
    if not isinstance(tuner, AnnTunerConfig):
        return None
    try:
        path = resolve("weights", tuner.weights or DEFAULT)
    except ConfigError as error:
        raise ConfigError(f"tuner.{error}") from None
    return load_network(path)


def waits_at_rest(scenario: Scenario) -> bool:
    """Whether the nominal plate stays where it is until the first torque of the controller acts.

    The floor of E_ac (`loop.metrics.delay_floor`) supposes that.
    """
    held = scenario.queue == "equilibrium"
    return scenario.start == "rest" and (
        held or (scenario.queue == "zero" and not scenario.plant.gravity)
    )


def believed_delay(scenario: Scenario) -> Delay:
    """Return the delay that the controller assumes; null is the known one, else the true one.

    Over a network the play-out bound sets the delay, whatever is known of the machine.
    """
    controller = scenario.controller
    if controller.delay_steps is not None:
        return Delay(controller.delay_steps, controller.delay_fraction or 0.0)
    known = None if isinstance(scenario.link, NetworkConfig) else _read_calibration(scenario)
    if known is not None and (seconds := known.value(DELAY)) is not None:
        return Delay.of(seconds, controller.period)
    return scenario.true_delay


def torques_in_flight(experiment: Experiment, delay: Delay) -> Array:
    """Torques (L, 6) in N m that are under way at t = 0 with such a delay, within the limit."""
    sc, limit = experiment.scenario, experiment.torque_limit
    queue = initial_queue(
        sc.queue, experiment.nominal, experiment.reference, sc.controller.period, delay
    )
    return np.clip(queue, -limit, limit)


def believed_queue(experiment: Experiment, timeline: Timeline) -> Array:
    """The torques in flight at t = 0 that the controller believes in."""
    return torques_in_flight(experiment, timeline.delay)


def first_queue(experiment: Experiment, law: PredictiveLqi) -> Array:
    """The torques in flight at t = 0 that a law begins with.

    One that does not know the delay has more: what acts in each period until its own do, up to the
    longest delay.
    """
    if not isinstance(law.observer, DelayObserver):
        return believed_queue(experiment, law.timeline)
    return torques_in_flight(experiment, Delay(law.observer.kept(law.timeline.period)))


def followed_motion(
    experiment: Experiment, law: PredictiveLqi, planned: Trajectory
) -> tuple[Trajectory, Trajectory] | None:
    """What a law that changes its mind has to know: what it follows, and the reference."""
    if not isinstance(law.observer, DelayObserver):
        return None
    return planned, experiment.reference


def motion_scale(experiment: Experiment) -> Array:
    """(6,) rad and m: half the reference's peak to peak, STILL where constant."""
    still = STILL * np.repeat([1.0, experiment.mechanism.crank_lengths.min()], 3)
    return np.where(experiment.peak_to_peak > 0, experiment.peak_to_peak / 2, still)


def planned_limit(scenario: Scenario) -> float | None:
    """The limit in N m that plans and priors keep to, or None.

    One that nobody asked for only clips: it makes no plan shorter and no prior narrower.
    """
    asked = scenario.actuator.torque_limit
    return None if asked == "none" else asked


def quadratic_cost(experiment: Experiment, peak_torque: float) -> QuadraticCost:
    """What the scenario's gain minimises; the torque in N m is what the reference takes."""
    c = experiment.scenario.controller
    errors, integrals, torques = weight_scales(
        c.weight_scaling, experiment.nominal, experiment.peak_to_peak, peak_torque
    )
    return QuadraticCost(errors, c.integral_weight * integrals if c.integral else None, torques)


class Sizing(NamedTuple):
    """What a law takes from the machine and the motion as they are known, found by computing.

    Attributes:
        substeps: of the prediction, per period.
        reference_torque: largest along the reference, N m.
        machine_torque: see `law.startup.machine_torque`, N m.
    """

    substeps: int
    reference_torque: float
    machine_torque: float


def sizing_of(experiment: Experiment) -> Sizing:
    """It depends on mechanism, reference, duration, period and the believed delay."""
    sc, nominal, reference = experiment.scenario, experiment.nominal, experiment.reference
    period, steps = sc.controller.period, believed_delay(sc).steps
    substeps = choose_substeps(nominal, reference, period, steps, sc.duration)
    return Sizing(
        max(substeps, turning_substeps(nominal, reference, period, sc.duration)),
        reference_torque(nominal, reference, sc.duration),
        machine_torque(nominal),
    )


def _check_sends_torques(scenario: Scenario) -> None:
    command = scenario.controller.command
    if command != "torque":
        raise ConfigError(
            f"controller.command: got {command!r}; expected 'torque', for a law that closes its "
            "loop across the delay"
        )


def compose_law(experiment: Experiment, sizing: Sizing | None = None) -> PredictiveLqi:
    """The parts that a scenario asks for; the only place that knows their names in it.

    Args:
        experiment: of the scenario.
        sizing: `sizing_of` it, where that is known.

    Raises:
        ConfigError: it asks for no law that sends torques; see `loop.servo_design`.
    """
    sc, nominal = experiment.scenario, experiment.nominal
    _check_sends_torques(sc)
    c, motion = sc.controller, motion_scale(experiment)
    timeline = Timeline(c.period, believed_delay(sc))
    substeps, peak_torque, least = sizing or sizing_of(experiment)
    torque_scale = max(least, peak_torque)
    plate, asked = experiment.mechanism.plate.mass, planned_limit(sc)
    parameters = estimated_parameters(experiment, torque_scale)
    settings = filter_settings(motion, plate, torque_scale, asked, c.period, parameters)
    encoders = isinstance(sc.sensor, EncoderSensorConfig)
    filters = GapObserver if sc.sensor.loss > 0 else ParameterObserver
    observer: Observer
    if c.estimate:
        observer = EncoderObserver(settings) if encoders else filters(settings)
    else:
        observer = DifferencesObserver() if encoders else NoObserver()
    predictors: dict[str, Predictor] = {
        "linear": LinearPredictor(),
        "nonlinear": NonlinearPredictor(),
    }
    feedforwards: dict[str, Feedforward] = {
        "none": NoFeedforward(),
        "equilibrium": EquilibriumFeedforward(),
        "inverse_dynamics": InverseDynamicsFeedforward(),
    }
    models: dict[str, DesignModel] = {
        "paper": PaperModel(c.torque_map),
        "multibody": MultibodyModel(),
    }
    motors = TorqueLimit(experiment.torque_limit)
    quiet = c.open_loop_start and sc.start == "rest"
    waits = longest_wait(sc)
    if waits:
        observer = LateObserver(observer, waits)
    channel = _channel(sc, timeline, waits)
    law = PredictiveLqi(
        timeline=timeline,
        plant=NominalPlant(nominal, substeps, GENTLE * torque_scale, motors),
        sensing=_sensing(experiment, motion),
        observer=observer,
        predictor=predictors[c.prediction],
        feedforward=feedforwards[c.feedforward],
        model=models[c.model],
        cost=quadratic_cost(experiment, peak_torque),
        channel=channel,
        kept=waits + (_REPORTS if isinstance(channel, Packets) else 0),
        silence=_until_seen(timeline.delay, waits) if quiet else 0,
    )
    if c.delay_estimator != "none":
        delay = delay_settings(c.delay_estimator, c.delay_std, c.delay_max)
        law = replace(
            law,
            observer=DelayObserver(settings, delay, timeline.eta, quiet),
            predictor=ArrivalPredictor(),
            planner=Rejoin(c.replan, experiment.scale) if c.replan > 0 else NoPlanner(),
            silence=0,  # until the delay is found
        )
    return experiment.own.revised(law)


def estimated_parameters(experiment: Experiment, torque_scale: float) -> ParameterSet:
    """What the estimator is to find, and what is known of that; the torque in N m is the motion's.

    Raises:
        ConfigError: what is known is beyond the bounds of such a machine.
    """
    sc, machine = experiment.scenario, experiment.mechanism
    found = usual_parameters(
        machine.plate.mass,
        torque_scale,
        planned_limit(sc),
        plate_radius(machine),
        experiment.nominal.free,
    )
    if experiment.calibration is not None:
        try:
            found = found.knowing(experiment.calibration)
        except ValueError as error:
            raise ConfigError(f"controller.calibration: {error}") from None
    prior = sc.controller.prior
    said = {
        **dict.fromkeys(PARAMETERS[BIAS], prior.torque_bias),
        PARAMETERS[PAYLOAD]: prior.payload,
        PARAMETERS[DAMPING]: prior.damping,
        **dict.fromkeys(OFFSETS, prior.offsets),
    }
    return found.trusting({name: std for name, std in said.items() if std is not None})


def _sensing(experiment: Experiment, motion: Array) -> Sensing:
    """What is measured, as the controller knows it; `motion` is `motion_scale`."""
    sensor, rates = experiment.scenario.sensor, experiment.scenario.controller.prior.rates
    if not isinstance(sensor, EncoderSensorConfig):
        anywhere = experiment.scenario.plant.kind == "paper"
        return StateSensing(np.array(sensor.noise_std), motion, anywhere)
    finds_offsets = OFFSETS[0] in experiment.nominal.free
    return EncoderSensing(
        mechanism=experiment.mechanism,
        samples=sensor.samples,
        quantum=0.0 if sensor.bits is None else 2 * np.pi / 2**sensor.bits,
        declared=experiment.start,
        rates_std=motion if rates is None else np.array(rates),
        motion=motion,
        offset=np.zeros(len(OFFSETS)) if finds_offsets else offsets_of(experiment.calibration),
    )


def _until_seen(delay: Delay, waits: int) -> int:
    """Samples until a whole hold of the first own torque has been seen.

    Before that the measurements are of a plate on which nothing but its bias acts: what they make
    of payload and friction is noise, and feedback through them puts it on the motors for eta.
    """
    late = max(waits - _PATIENCE, 0)
    return math.ceil(delay.periods + 1 - 1e-9) + late


def longest_wait(scenario: Scenario) -> int:
    """Periods for which the law waits for a late measurement; 0 where none comes late.

    Raises:
        ConfigError: they are more than any delay may have.
    """
    sc, period = scenario, scenario.controller.period
    back = sc.link.back if isinstance(sc.link, NetworkConfig) else None
    if sc.sensor.delay == 0 and back is None:
        return 0
    longest = sc.sensor.delay + (0.0 if back is None else times_under_way(back).ppf(_MOST))
    if longest > MOST_PERIODS * period:
        field = "sensor.delay" if back is None else "link.return"
        raise ConfigError(
            f"{field}: got measurements that take {longest:.4g} s; expected at most "
            f"{MOST_PERIODS} periods"
        )
    return math.ceil(longest / period - 1e-9) + _PATIENCE


def _channel(scenario: Scenario, timeline: Timeline, waits: int) -> Channel:
    link, c = scenario.assumed_link, scenario.controller
    if not isinstance(link, NetworkConfig) or c.delay_steps == 0:
        return Wire()
    rows = c.packet_repeats + c.packet_torques
    due = timeline.eta + (np.arange(rows) - c.packet_repeats) * c.period
    kept = rows + timeline.steps + waits + _REPORTS + 1
    return Packets(
        torques=c.packet_torques,
        repeats=c.packet_repeats,
        in_time=tuple(in_time(link, due).tolist()),
        arrived_by=tuple(in_time(link, c.period * np.arange(kept)).tolist()),
        losses=BurstChain(link.loss, link.burst),
        holds=link.dry == "hold",
        told=reported(waits + _REPORTS),
    )


def control_law(experiment: Experiment) -> tuple[PredictiveLqi, Trajectory, float]:
    """The control law, the motion it follows, and the length of the blend onto the reference."""
    sc, law = experiment.scenario, compose_law(experiment)
    law.warm_up()
    way = way_onto(experiment, law)
    if way is None:
        return law, experiment.reference, 0.0
    return law, *way.plan(sc.controller.catch_up, planned_limit(sc))


def way_onto(experiment: Experiment, law: PredictiveLqi) -> CatchUp | None:
    """The ways onto the reference after a start from rest, or None where there is none."""
    sc, nominal, timeline = experiment.scenario, experiment.nominal, law.timeline
    if sc.start != "rest" or sc.controller.catch_up == 0:
        return None
    state, queue = experiment.start, believed_queue(experiment, timeline)
    if len(queue):
        state = nominal.predict(state, *timeline.until_next(queue), law.plant.substeps)[-1]
    return CatchUp(nominal, experiment.reference, state, timeline.eta, sc.controller.period)
