"""A scenario with its machine, plant, reference and start state, checked against each other."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.frozen_map import Band, FrozenDynamics
from stewart_drake.dynamics.stewart import StewartDynamics, plant_parameters
from stewart_drake.dynamics.workspace import Failure, Limits, Workspace, diagnose
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.law.startup import STILL, initial_queue, reference_torque, sizes
from stewart_drake.loop.own import NOTHING, Own, own_motion, take
from stewart_drake.machines import reachy_mini  # noqa: F401 registers its kind of reference
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Mechanism, fingerprint, with_rotors
from stewart_drake.mechanism.trajectories import (
    PlateTrajectory,
    evaluate,
    make_reference,
    motion_range,
    peak_to_peak,
    poses_along,
)
from stewart_drake.scenario.calibration import (
    OFFSETS,
    Calibration,
    believed_delay,
    calibration_file,
)
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import as_scenario
from stewart_drake.scenario.signals import (
    ANGLES,
    BIAS,
    COORDINATE_NAMES,
    COULOMB,
    DAMPING,
    PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    PLANT_PARAMETERS,
    POSE,
    POSITION,
    SHAFTS,
    WRENCHES,
)
from stewart_drake.scenario.timing import Delay
from stewart_drake.tuner.network import DEFAULT, Network, load_network
from stewart_drake.types import Array

MAX_FROZEN_ERROR = 10.0
"""Largest error of the paper's plant, which has no workspace, in peak-to-peaks of the reference."""
REACH_CHECK_PERIOD = 0.02
"""s between the instants at which a reference is checked against the workspace."""
_FAR = 20
"""Reaches of a leg from which a position counts as one in another unit."""
_ESTIMATED = {
    "torque_bias": PARAMETERS[BIAS],
    "payload": (PARAMETERS[PAYLOAD],),
    "damping": (PARAMETERS[DAMPING],),
    "payload_position": PLANT_PARAMETERS[PAYLOAD_POSITION],
    "coulomb": (PLANT_PARAMETERS[COULOMB],),
    "wrench": WRENCHES,
    "offsets": OFFSETS,
}
"""Parameters for each word of `controller.estimate`."""


class Experiment(NamedTuple):
    """A scenario with all objects that the loop is built from."""

    scenario: Scenario
    mechanism: Mechanism  # machine that the controller assumes
    truth: Mechanism  # machine that is simulated
    reference: Trajectory  # 6 x 1 trajectory of the pose
    peak_to_peak: Array  # (6,) of the reference, rad and m, 0 where it is constant
    nominal: StewartDynamics  # dynamics that the controller assumes
    start: Array  # (12,) state at t = 0
    network: Network | None  # network that sets the weights, or None
    own: Own = NOTHING  # systems, reference and law of the user
    # calibrated parameters of the machine, known to the controller, or None
    calibration: Calibration | None = None

    def __repr__(self) -> str:
        return f"Experiment({self.mechanism}, {self.scenario})"

    @property
    def torque_limit(self) -> float:
        """Limit of each motor, N m, infinite for none: the scenario's, else the true machine's."""
        own = self.scenario.actuator.torque_limit
        frozen = self.scenario.plant.kind == "paper"  # a plant without motors
        limit = (None if frozen else self.truth.effort_limit) if own is None else own
        return math.inf if limit is None or limit == "none" else limit

    @property
    def planned_limit(self) -> float | None:
        """Limit in N m for plans and priors, or None.

        Only the scenario's limit counts: that of a mechanism clips torques without changing plans.
        """
        asked = self.scenario.actuator.torque_limit
        return None if asked == "none" else asked

    @property
    def tuned(self) -> bool:
        return self.scenario.tuner.kind != "fixed"

    @property
    def scale(self) -> Array:
        """(6,) A_i of equation (47): the peak to peak, 1 where the reference is constant."""
        return np.where(self.peak_to_peak > 0, self.peak_to_peak, 1.0)

    @property
    def motion_scale(self) -> Array:
        """(6,) rad and m: half the reference's peak to peak, STILL where it is constant."""
        return motion_scale(self.peak_to_peak, self.mechanism)

    @property
    def limits(self) -> Limits:
        if self.scenario.plant.kind != "paper":
            return Workspace(self.truth)
        reference = self.reference
        return Band(lambda time: reference.value(time)[:, 0], MAX_FROZEN_ERROR * self.scale)

    def true_dynamics(self, *, biased: bool = True) -> StewartDynamics:
        """Return the dynamics of the simulated plant, exact for any engine.

        Without the torque bias, `biased=False`, they are those of the loop's plant: there the bias
        is added before the plant, after the torques are recorded.
        """
        plant = self.scenario.plant
        parameters = np.array(self.scenario.plant_parameters)
        parameters[BIAS] *= biased
        return type(self.nominal)(self.truth, plant.gravity, parameters)

    def weak_motors(self, machine: float = math.inf) -> str | None:
        """Return a warning about a motion that takes more torque than the motors give, or None.

        A `machine` may have a tighter limit than the scenario, N m.
        """
        sc, limit = self.scenario, min(self.torque_limit, machine)
        if math.isinf(limit) or sc.actuator.kind == "servo":
            return None
        true, rest = self.true_dynamics(), np.zeros(6)
        needed = reference_torque(true, self.reference, sc.duration)
        if not needed > limit:  # NaN beyond the reach, where the law keeps the limits
            return None
        factor, unit = (1e3, "mN m") if needed < 1 else (1.0, "N m")
        source = (
            "motor.effort_limit" if sc.actuator.torque_limit is None else "actuator.torque_limit"
        )
        if limit < self.torque_limit:
            source = "the machine's limit"
        holding = np.abs(true.inverse_dynamics(self.truth.home, rest, rest)).max()
        falls = f" and cannot hold the plate at home, which takes {factor * holding:.3g} {unit}"
        return (
            f"the motion takes up to {factor * needed:.3g} {unit}, the motors give "
            f"{factor * limit:.3g} ({source})"
        ) + (falls if holding > limit else "")

    def torques_in_flight(self, delay: Delay) -> Array:
        """Return the torques (L, 6) in N m in flight at t = 0 for a delay, within the limit."""
        sc, limit = self.scenario, self.torque_limit
        period = sc.controller.period
        queue = initial_queue(sc.queue, self.nominal, self.reference, period, delay)
        return np.clip(queue, -limit, limit)

    def reference_failure(self) -> Failure | None:
        """Return the first failure of the reference to stay in the workspace, or None."""
        for t in check_instants(self.scenario.duration):
            failure = diagnose(self.mechanism, t, self.reference.value(t)[:, 0])
            if failure is not None:
                return failure
        return None


def motion_scale(peak_to_peak: Array, mechanism: Mechanism) -> Array:
    """Return half the peak to peak (6,), rad and m, or STILL where that is 0."""
    still = STILL * np.repeat([1.0, mechanism.crank_lengths.min()], 3)
    return np.where(peak_to_peak > 0, peak_to_peak / 2, still)


def check_instants(duration: float) -> Array:
    """Return instants for checks of the workspace, s: every REACH_CHECK_PERIOD, and the last."""
    return np.append(np.arange(0.0, duration - 1e-9, REACH_CHECK_PERIOD), duration)


def first_pose_text(pose: Array, mechanism: Mechanism) -> str:
    """Return the first position of a reference and home, which shows a wrong unit or origin."""
    first, home = (
        ", ".join(f"{1e3 * value:.6g}" for value in where[POSITION])
        for where in (pose, mechanism.home)
    )
    return f"it begins at x, y, z = {first} mm, home is at {home} mm"


def prepare(scenario: Scenario, truth: Mechanism | None = None, own: Own = NOTHING) -> Experiment:
    """Prepare a scenario and check that its reference stays in the workspace.

    Args:
        scenario: what to run.
        truth: the machine to simulate, that of the scenario's plant if None.
        own: systems, reference and law of the user.

    Raises:
        ConfigError: one line; also where the reference leaves the workspace, with time and leg.
    """
    experiment = prepare_unchecked(scenario, truth, own)
    check_reach(experiment)
    outside = diagnose(experiment.truth, 0.0, experiment.start[POSE])
    if outside is not None:
        raise ConfigError(
            f"plant.mechanism: got {experiment.truth.name}, which does not reach the first pose "
            f"({outside.reason}); expected a machine that does"
        )
    return experiment


def check_reach(experiment: Experiment) -> None:
    """Check that a reference stays in the workspace, except where the law keeps the limits."""
    failure = experiment.reference_failure()
    governed = experiment.scenario.controller.limits == "qp"
    if failure is not None and not (governed and failure.time > 0):
        first = experiment.reference.value(0.0)[:, 0]
        file = getattr(experiment.scenario.reference, "file", None)
        short = failure.leg is not None and failure.margin < 0
        raise ConfigError(
            (f"{file}: " if file and experiment.own.reference is None else "reference: ")
            + f"{failure.reason} at t = {failure.time:.2f} s"
            + (f", short by {-1e3 * failure.margin:.3g} mm" if short else "")
            + "; expected a motion within reach"
            + (
                (", edit the file or move lower" if file else ", such as one of smaller amplitude")
                if failure.time > 0
                else f": {first_pose_text(first, experiment.mechanism)}"
            )
            + _units_hint(experiment)
        )


def _units_hint(experiment: Experiment) -> str:
    """Return the end of a message about a motion out of reach that may be in deg or mm, or ''."""
    poses = poses_along(experiment.reference, check_instants(experiment.scenario.duration))
    largest = np.abs(poses).max(axis=0)
    for part, most, unit, units in (
        (ANGLES, math.pi, "rad", "degrees"),
        (POSITION, _FAR * sizes(experiment.mechanism)[-1], "m", "millimetres"),
    ):
        name, value = COORDINATE_NAMES[part][largest[part].argmax()], largest[part].max()
        if value > most:
            return f"; {name} reaches {value:.3g} {unit} (are these {units}?)"
    return ""


def as_experiment(
    scenario: Scenario | str | Path | Experiment,
    true_mechanism: Mechanism | None = None,
    settings: Iterable[str] = (),
    **own: Any,
) -> Experiment:
    """Prepare a scenario with the user's systems, or return an Experiment as it is.

    Args:
        scenario: a scenario, prepared or not, or a shipped name or a path.
        true_mechanism: the machine to simulate, that of the scenario's plant if None.
        settings: as `load_scenario` takes them.
        **own: see `loop.own.OwnSystems`.

    Raises:
        ConfigError: bad input, an unreachable reference.
        TypeError: settings or systems of the user with an Experiment, which has its own.
    """
    if not isinstance(scenario, Experiment):
        chosen = own.get("controller")
        name = chosen if isinstance(chosen, str | Path) else None
        own |= {"controller": None} if name is not None else {}
        return prepare(as_scenario(scenario, name, settings), true_mechanism, take(own))
    given = {"true_mechanism": true_mechanism, "settings": settings or None}
    for name, thing in (given | own).items():
        if thing is not None:
            raise TypeError(f"{name}: got one with a loop that has its own; expected none")
    return scenario


def prepare_unchecked(
    scenario: Scenario, truth: Mechanism | None = None, own: Own = NOTHING
) -> Experiment:
    """Prepare a scenario without the check of its reference."""
    scenario.check()
    network = network_of(scenario)
    drawn = load_mechanism(scenario.mechanism)
    calibration = calibration_of(scenario, drawn)
    rotors = scenario.actuator.reflected_inertia
    mechanism = with_rotors(drawn, rotors)
    reference: Trajectory
    if own.reference is None:
        reference = make_reference(scenario.reference, scenario.duration)
        if not isinstance(reference, PlateTrajectory):
            kind = f"{scenario.reference.kind}: got a {type(reference).__name__}"
            raise TypeError(f"make_reference for {kind}; expected a PlateTrajectory")
        span = peak_to_peak(scenario.reference, reference, scenario.duration)
    else:
        reference = own_motion(own.reference, scenario.duration)
        span = motion_range(reference, scenario.duration)
    start = evaluate(reference, 0.0)[:12]
    if scenario.start == "rest":
        start[6:] = 0.0
    parameters = plant_parameters()
    if scenario.actuator.shafts is not None:
        parameters[SHAFTS] = scenario.actuator.shafts
    parameters = _calibrated(parameters, calibration)
    dynamics = FrozenDynamics if scenario.plant.kind == "paper" else StewartDynamics
    return Experiment(
        scenario=scenario,
        mechanism=mechanism,
        truth=with_rotors(simulated_machine(scenario) if truth is None else truth, rotors),
        reference=reference,
        peak_to_peak=span,
        nominal=dynamics(mechanism, scenario.plant.gravity, parameters, estimated_names(scenario)),
        start=start,
        network=network,
        own=own,
        calibration=calibration,
    )


def known_dynamics(experiment: Experiment) -> StewartDynamics:
    """Return the dynamics with the numbers of the scenario's plant, or of its calibration."""
    scenario = experiment.scenario
    known = np.array(scenario.plant_parameters)
    parameters = _calibrated(known, experiment.calibration)
    names = estimated_names(scenario)
    return StewartDynamics(experiment.mechanism, scenario.plant.gravity, parameters, names)


def knowing(experiment: Experiment) -> Experiment:
    """Return the experiment with a controller that knows the numbers of the plant."""
    return experiment._replace(nominal=known_dynamics(experiment))


def _calibrated(parameters: Array, calibration: Calibration | None) -> Array:
    """Return parameters (n,), the first n of `PLANT_PARAMETERS`, with calibrated values."""
    pairs = zip(PLANT_PARAMETERS, parameters, strict=False)
    values = [(calibration and calibration.value(name), own) for name, own in pairs]
    return np.array([own if value is None else value for value, own in values])


def estimated_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of the estimated parameters, those of the plant first.

    Without any, return the eight recorded ones, which linear models then take as known.
    """
    chosen = scenario.controller.estimate
    return tuple(name for group in chosen for name in _ESTIMATED[group]) or PARAMETERS


def simulated_machine(scenario: Scenario) -> Mechanism:
    """Return the machine of the scenario's plant, by default that of the controller."""
    name = scenario.plant.mechanism
    if name is None:
        return load_mechanism(scenario.mechanism)
    try:
        return load_mechanism(resolve("mechanism", name))
    except ConfigError as error:
        raise ConfigError(f"plant.{error}") from None


def calibration_of(scenario: Scenario, mechanism: Mechanism) -> Calibration | None:
    """Return the calibration that the controller uses, checked against its machine."""
    own, calibration = fingerprint(mechanism), calibration_file(scenario)
    if calibration is None:
        return None
    if calibration.mechanism != own:
        raise ConfigError(
            f"controller.calibration: got {scenario.controller.calibration}, of another machine "
            f"({calibration.mechanism}); expected one of {mechanism.name} ({own}), or the "
            "mechanism.yaml that identify wrote with it as `mechanism`"
        )
    if problem := scenario.delay_max_problem(believed_delay(scenario)):
        raise ConfigError(problem)
    return calibration


def network_of(scenario: Scenario) -> Network | None:
    """Return the network of the scenario's tuner, or None for a tuner of another kind."""
    tuner = scenario.tuner
    if tuner.kind != "ann":
        return None
    try:
        path = resolve("weights", tuner.weights or DEFAULT)
    except ConfigError as error:
        raise ConfigError(f"tuner.{error}") from None
    return load_network(path)
