"""A scenario made concrete: mechanism, reference, and the control law that it asks for."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import Trajectory

from stewart_drake.config import Scenario
from stewart_drake.design.catch_up import plan_catch_up
from stewart_drake.design.control_law import DelayLqi
from stewart_drake.design.filter_settings import filter_settings
from stewart_drake.design.law_types import LawOptions
from stewart_drake.design.startup import (
    choose_substeps,
    initial_queue,
    reference_torque,
    weight_scales,
)
from stewart_drake.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.plant.dynamics import StewartDynamics
from stewart_drake.plant.workspace import Failure, diagnose
from stewart_drake.resources import resolve
from stewart_drake.signals import POSITION
from stewart_drake.trajectories import evaluate, make_reference, peak_to_peak
from stewart_drake.tuner.network import DEFAULT, Network, load_network

Array = NDArray[np.float64]

GENTLE = 3.0
"""Torques up to so many times the reference's are predicted with the usual steps."""
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

    @property
    def scale(self) -> Array:
        """(6,) A_i of equation (47): the peak to peak, 1 where the reference is constant."""
        return np.where(self.peak_to_peak > 0, self.peak_to_peak, 1.0)


def prepare(scenario: Scenario, truth: Mechanism | None = None) -> Experiment:
    """Check a scenario against its mechanism.

    Args:
        scenario: what to run.
        truth: the machine to simulate where it is not the one that the controller knows.

    Raises:
        ConfigError: one line; also where the reference leaves the workspace, with time and leg.
    """
    experiment = assemble(scenario, truth)
    failure = reference_failure(experiment)
    if failure is not None:
        first = experiment.reference.value(0.0)[:, 0]
        raise ConfigError(
            f"reference: {failure.reason} at t = {failure.time:.2f} s"
            + (f", short by {-1e3 * failure.margin:.3g} mm" if failure.margin < 0 else "")
            + "; expected a motion within reach"
            + (
                ", such as one of smaller amplitude"
                if failure.time > 0
                else f": {first_pose_text(first, experiment.mechanism)}"
            )
        )
    return experiment


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


def assemble(scenario: Scenario, truth: Mechanism | None = None) -> Experiment:
    """What `prepare` returns, whether or not the reference stays in the workspace.

    Raises:
        ConfigError: one line.
    """
    scenario.check()
    network = _network(scenario)
    mechanism = load_mechanism(scenario.mechanism)
    reference = make_reference(scenario.reference, scenario.duration)
    start = evaluate(reference, 0.0)[:12]
    if scenario.start == "rest":
        start[6:] = 0.0
    return Experiment(
        scenario=scenario,
        mechanism=mechanism,
        truth=mechanism if truth is None else truth,
        reference=reference,
        peak_to_peak=peak_to_peak(scenario.reference, reference, scenario.duration),
        nominal=StewartDynamics(mechanism, gravity=scenario.plant.gravity),
        start=start,
        network=network,
    )


def _network(scenario: Scenario) -> Network | None:
    if scenario.tuner.kind == "fixed":
        return None
    try:
        path = resolve("weights", scenario.tuner.weights or DEFAULT)
    except ConfigError as error:
        raise ConfigError(f"tuner.{error}") from None
    return load_network(path)


def waits_at_rest(scenario: Scenario) -> bool:
    """Whether the nominal plate stays where it is until the first torque of the controller acts.

    The floor of E_ac (`metrics.delay_floor`) supposes that.
    """
    held = scenario.queue == "equilibrium"
    return scenario.start == "rest" and (
        held or (scenario.queue == "zero" and not scenario.plant.gravity)
    )


def believed_delay(scenario: Scenario) -> tuple[int, float]:
    """Delay steps and fraction that the controller assumes; null means the true ones."""
    controller, true = scenario.controller, scenario.delay
    if controller.delay_steps is None:
        return true.steps, true.fraction
    return controller.delay_steps, controller.delay_fraction or 0.0


def believed_queue(experiment: Experiment, options: LawOptions) -> Array:
    """The torques in flight at t = 0 that the controller believes in."""
    sc = experiment.scenario
    return initial_queue(
        sc.queue,
        experiment.nominal,
        experiment.reference,
        options.period,
        options.steps,
        options.fraction,
    )


def motion_scale(experiment: Experiment) -> Array:
    """(6,) rad and m: half the reference's peak to peak, 0.1 rad or 0.1 cranks where constant."""
    still = np.repeat([0.1, 0.1 * experiment.mechanism.crank_lengths.min()], 3)
    return np.where(experiment.peak_to_peak > 0, experiment.peak_to_peak / 2, still)


def control_law(experiment: Experiment) -> tuple[DelayLqi, Trajectory, float]:
    """The control law, the motion it follows, and the length of the blend onto the reference."""
    sc, nominal = experiment.scenario, experiment.nominal
    c = sc.controller
    steps, fraction = believed_delay(sc)
    substeps = choose_substeps(nominal, experiment.reference, c.period, steps, sc.duration)
    peak_torque = reference_torque(nominal, experiment.reference, sc.duration)
    torque_scale = max(0.1, peak_torque)
    error_weights, integral_weights, torque_weights = weight_scales(
        c.weight_scaling, experiment.peak_to_peak, peak_torque
    )
    options = LawOptions(
        period=c.period,
        steps=steps,
        fraction=fraction,
        integral=c.integral,
        prediction=c.prediction,
        feedforward=c.feedforward,
        model=c.model,
        torque_map=c.torque_map,
        substeps=substeps,
        gentle_torque=GENTLE * torque_scale,
        error_weights=error_weights,
        integral_weights=integral_weights,
        torque_weights=torque_weights,
        torque_limit=sc.actuator.torque_limit,
        filter=filter_settings(
            np.array(sc.sensor.noise_std),
            motion_scale(experiment),
            experiment.mechanism.plate.mass,
            torque_scale,
            sc.actuator.torque_limit,
            c.period,
        )
        if c.estimator == "parameters"
        else None,
    )
    law = DelayLqi(options, nominal)
    if sc.start != "rest" or c.catch_up == 0:
        return law, experiment.reference, 0.0
    state = experiment.start
    queue, eta = believed_queue(experiment, options), (steps + fraction) * c.period
    if len(queue):
        holds = np.full(len(queue), c.period)
        if fraction > 0:
            holds[0] = fraction * c.period
        state = nominal.predict(state, queue, holds, substeps)[-1]
    planned, span = plan_catch_up(
        nominal,
        experiment.reference,
        state,
        eta,
        c.period,
        c.catch_up,
        sc.actuator.torque_limit,
    )
    return law, planned, span
