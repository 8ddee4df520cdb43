"""A scenario made concrete: mechanism, reference, and the control law that it asks for."""

import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.frozen_map import Band, FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import Failure, Limits, Workspace, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.law.startup import (
    STILL,
    initial_queue,
)
from stewart_drake.loop.own import NOTHING, Own, own_motion, take
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Mechanism, fingerprint, with_rotors
from stewart_drake.scenario.calibration import DELAY, OFFSETS, Calibration, load_calibration
from stewart_drake.scenario.config import (
    Scenario,
)
from stewart_drake.scenario.delay import Delay
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
from stewart_drake.scenario.trajectories import evaluate, make_reference, motion_range, peak_to_peak
from stewart_drake.tuner.network import DEFAULT, Network, load_network
from stewart_drake.types import Array

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
    """Calibrated parameters of the machine, which the controller knows."""

    def __repr__(self) -> str:
        return f"Experiment({self.mechanism}, {self.scenario})"

    @property
    def torque_limit(self) -> float:
        """Limit of each motor, N m, infinite for none: the scenario's, else the true machine's."""
        own = self.scenario.actuator.torque_limit
        frozen = self.scenario.plant.kind == "paper"  # has none of its own
        limit = (None if frozen else self.truth.effort_limit) if own is None else own
        return math.inf if limit is None or limit == "none" else limit

    @property
    def tuned(self) -> bool:
        """Whether a tuner of the scenario sets the weights."""
        return self.scenario.tuner.kind != "fixed"

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
    """Prepare a scenario with the user's systems, or return an Experiment as it is.

    Args:
        scenario: either.
        true_mechanism: the machine to simulate, that of the scenario's plant if None.
        **own: see `loop.simulation.simulate`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: something of the user with an Experiment, which already has it.
    """
    if not isinstance(scenario, Experiment):
        return prepare(scenario, true_mechanism, take(own))
    for name, thing in ({"true_mechanism": true_mechanism} | own).items():
        if thing is not None:
            raise TypeError(f"{name}: got one with an Experiment, which has its own; expected None")
    return scenario


def first_pose_text(pose: Array, mechanism: Mechanism) -> str:
    """Return the first position of a reference and home, which shows a wrong unit or origin."""
    first, home = (
        ", ".join(f"{1e3 * value:.6g}" for value in where[POSITION])
        for where in (pose, mechanism.home)
    )
    return f"it begins at x, y, z = {first} mm, home is at {home} mm"


def check_instants(duration: float) -> Array:
    """Return instants for checks of the workspace, s: every REACH_CHECK_PERIOD, and the last."""
    return np.append(np.arange(0.0, duration - 1e-9, REACH_CHECK_PERIOD), duration)


def reference_failure(experiment: Experiment) -> Failure | None:
    """Return how the reference first leaves the workspace, or None."""
    for t in check_instants(experiment.scenario.duration):
        failure = diagnose(experiment.mechanism, t, experiment.reference.value(t)[:, 0])
        if failure is not None:
            return failure
    return None


def assemble(scenario: Scenario, truth: Mechanism | None = None, own: Own = NOTHING) -> Experiment:
    """Make a scenario concrete, whether or not the reference stays in the workspace.

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
        span = motion_range(reference, scenario.duration)
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
    """Return the class of dynamics of both controller model and simulated plant."""
    return FrozenDynamics if scenario.plant.kind == "paper" else StewartDynamics


def true_dynamics(experiment: Experiment, *, biased: bool = True) -> StewartDynamics:
    """Return the dynamics of the simulated plant, closed exactly for any engine.

    In a loop it is not `biased`: there the bias is added before, where the record of torques ends.
    """
    scenario, plant = experiment.scenario, experiment.scenario.plant
    parameters = np.array(plant.parameters)
    parameters[BIAS] *= biased
    return _equations(scenario)(experiment.truth, plant.gravity, parameters)


def limits_of(experiment: Experiment) -> Limits:
    """Return the limits of the plate's motion."""
    if experiment.scenario.plant.kind != "paper":
        return Workspace(experiment.truth)
    reference = experiment.reference
    return Band(lambda time: reference.value(time)[:, 0], LOST * experiment.scale)


def estimated(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the estimated parameters, those of the plant first.

    Without any they are the eight of the record, which linear models then take as known.
    """
    chosen = scenario.controller.estimate
    groups = {
        "torque_bias": PARAMETERS[BIAS],
        "payload": (PARAMETERS[PAYLOAD],),
        "damping": (PARAMETERS[DAMPING],),
        "coulomb": (PLANT_PARAMETERS[COULOMB],),
        "offsets": OFFSETS,
    }
    return tuple(name for group in chosen for name in groups[group]) or PARAMETERS


def with_motors(mechanism: Mechanism, scenario: Scenario) -> Mechanism:
    """The machine with the rotors of its servos."""
    return with_rotors(mechanism, scenario.actuator.reflected_inertia)


def simulated_machine(scenario: Scenario) -> Mechanism:
    """Return the machine of the scenario's plant, else the one that the controller knows.

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
    if problem := scenario.delay_max_problem(believed_delay(scenario)):
        raise ConfigError(problem)
    return calibration


def known_values(calibration: Calibration | None) -> Array:
    """Return the parameters of the plant (13,) that the controller assumes at first."""
    values = plant_parameters()
    for i, name in enumerate(PLANT_PARAMETERS):
        found = None if calibration is None else calibration.value(name)
        values[i] = values[i] if found is None else found
    return values


def network_of(scenario: Scenario) -> Network | None:
    """Return the network of the scenario's tuner, None of another kind of tuner.

    Raises:
        ConfigError: there is no such file, or it holds none; one line.
    """
    tuner = scenario.tuner
    if tuner.kind != "ann":
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

    Over a network the play-out bound sets the delay, with or without a calibration.
    """
    controller = scenario.controller
    if controller.delay_steps is not None:
        return Delay(controller.delay_steps, controller.delay_fraction or 0.0)
    known = None if scenario.link.kind == "network" else _read_calibration(scenario)
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


def motion_scale(experiment: Experiment) -> Array:
    """(6,) rad and m: half the reference's peak to peak, STILL where constant."""
    still = STILL * np.repeat([1.0, experiment.mechanism.crank_lengths.min()], 3)
    return np.where(experiment.peak_to_peak > 0, experiment.peak_to_peak / 2, still)


def planned_limit(scenario: Scenario) -> float | None:
    """The limit in N m that plans and priors keep to, or None.

    The limit of a mechanism only clips: it makes no plan shorter and no prior narrower.
    """
    asked = scenario.actuator.torque_limit
    return None if asked == "none" else asked
