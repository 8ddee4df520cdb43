"""Composition of a control law from parts, for a scenario or for a user's diagram."""

import dataclasses
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.files.arguments import fixed, of_kind, positive
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief, validate
from stewart_drake.law.catch_up import HEADROOM, CatchUp
from stewart_drake.law.channel import Packets, Wire
from stewart_drake.law.clear_space import ClearSpace
from stewart_drake.law.cost import Cost, PdGain, QuadraticCost, pd_gains
from stewart_drake.law.feedforward import (
    EquilibriumFeedforward,
    Feedforward,
    InverseDynamicsFeedforward,
    NoFeedforward,
)
from stewart_drake.law.filter_settings import (
    INTEGRATION_ERROR,
    MODEL_ERROR,
    USUAL_PERIOD,
    USUAL_STEP,
    ParameterSet,
    acceleration_noise,
    filter_settings,
    usual_model_error,
    usual_parameters,
)
from stewart_drake.law.learned import with_learned
from stewart_drake.law.least_error import LEAST_ERROR_SHARE, LeastError
from stewart_drake.law.limited import LimitedLqi, QpLimits
from stewart_drake.law.nominal import MultibodyModel, NominalPlant, PaperModel, TorqueLimit
from stewart_drake.law.observers import CoreObserver, DelaySettings
from stewart_drake.law.planner import SURE, Replan
from stewart_drake.law.predictive_lqi import PredictiveLqi
from stewart_drake.law.predictors import (
    ArrivalPredictor,
    LinearPredictor,
    NonlinearPredictor,
    Predictor,
)
from stewart_drake.law.stability import fastest_pole
from stewart_drake.law.startup import (
    STILL,
    TOLERANCE,
    choose_substeps,
    filter_substeps,
    machine_torque,
    reference_torque,
    turning_substeps,
    weight_scales,
)
from stewart_drake.law.timeline import Timeline
from stewart_drake.loop.controller import DelayLqiController, Reference
from stewart_drake.loop.kinds import REPORTS, make_channel, make_sensing
from stewart_drake.loop.learned import learned_signal
from stewart_drake.loop.link import DelayChain
from stewart_drake.loop.own import Own, own_motion
from stewart_drake.loop.platforms import StewartPlatform
from stewart_drake.loop.preparation import (
    Experiment,
    calibration_of,
    check_instants,
    check_reach,
    estimated_names,
)
from stewart_drake.loop.sampling import free_name
from stewart_drake.mechanism.geometry import plate_radius
from stewart_drake.mechanism.trajectories import (
    continues,
    evaluate,
    motion_range,
    poses_along,
    rows_along,
    spread_instants,
)
from stewart_drake.scenario.calibration import OFFSETS, believed_delay
from stewart_drake.scenario.config import ControllerConfig, Scenario, StateSensorConfig
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.field_types import MOST_PERIODS
from stewart_drake.scenario.link import oldest
from stewart_drake.scenario.loading import load_controller
from stewart_drake.scenario.signals import (
    ACCELERATIONS,
    BIAS,
    DAMPING,
    NUM_STATE,
    PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    PLANT_PARAMETERS,
    POSE,
    WRENCHES,
)
from stewart_drake.scenario.timing import Delay, multiple_problem
from stewart_drake.types import Array, ArrayLike

LONGEST_REPLAN = 0.4
"""Longest plan back onto the reference where `controller.replan` is null, s."""
REPLAN_SHARE = 0.2
"""Longest one as a share of the assumed delay, too: the error is still small."""
LIMITED_REPLAN = 0.5
"""Longest plan under a torque limit, over the catch-up from rest. Longer ones start the way anew
where feedback alone would arrive earlier."""
SURE_ON_REFERENCE = 0.01
"""`law.planner.SURE` with a known delay, after a start on the reference. Feedback answers a noisy
prediction that is off now and then: plans would add to the noise of long delays with gravity."""
TOLERATED = 0.02
"""Largest standard deviation of the torques' timing at which their weight is not raised, as a share
of the loop's time constant, over 1 plus the delay in time constants: 0.6 ms in `paper`."""
BIAS_SHARE = 0.05
"""Prior standard deviation of torque bias and of damping at 1 rad/s, as a share of the torque that
the motion takes."""
PAYLOAD_SHARE = 0.1
"""Prior standard deviation of the payload, as a share of the plate's mass."""
POSITION_SHARE = 0.15
"""Prior standard deviation of the payload's position, as a share of the plate's radius."""
GENTLE = 3.0
"""Largest torque for which the default substeps suffice, over the torque scale of the law."""
_GENTLE_PERIOD = 0.1
"""Longest period for which that holds, s; beyond it a torque moves the plate further in a step."""
_MOST = 0.999
"""Share of the measurements that arrive within the longest delay of `longest_wait`."""
_POSES = 500
"""Instants of a reference at which clearances and accelerations are evaluated."""
_PATIENCE = 10
"""Further periods of waiting for a measurement before the model replaces it."""


def cost_of(experiment: Experiment, peak_torque: float) -> Cost:
    """Return the part of a law that computes its gain; `peak_torque` of the reference, N m."""
    c = experiment.scenario.controller
    if c.kind == "pd":
        return pd_gain(experiment)
    errors, integrals, torques = weight_scales(
        c.weight_scaling, experiment.nominal, experiment.peak_to_peak, peak_torque
    )
    return QuadraticCost(errors, c.integral_weight * integrals if c.integral else None, torques)


def pd_gain(experiment: Experiment) -> PdGain:
    """Return the gains of a scenario with `controller.kind: pd`.

    Gains that are not given follow equation (pd) of `law.cost`. The uncompensated delay is the true
    one less the assumed one, plus half a period for the hold. The pole is that of the plate held at
    the start pose. One given gain sets the other for critical damping, kd^2 = 4 kp.
    """
    sc = experiment.scenario
    c = sc.controller
    if c.kp is None and c.kd is None:
        late = max(0.0, sc.eta - believed_delay(sc).eta(c.period)) + c.period / 2
        pole = fastest_pole(experiment.nominal.linearize(experiment.start[POSE])[0])
        return PdGain(*pd_gains(late, pole), c.period)
    kp = (c.kd or 0.0) ** 2 / 4 if c.kp is None else c.kp
    return PdGain(kp, 2 * math.sqrt(kp) if c.kd is None else c.kd, c.period)


class Sizing(NamedTuple):
    """Step size and torque scales of a law, computed from its machine and motion."""

    substeps: int  # of the prediction, per period
    reference_torque: float  # largest along the reference, N m; it sets the weights
    # the same where the plate can follow it: at the end of a leg's reach torques have no bound
    reachable_torque: float
    machine_torque: float  # see `law.startup.machine_torque`, N m
    # that the motion's accelerations ask of the loop, rad/s (`motion_frequency`); 0 with servos
    frequency: float = 0.0


def one_step_sizing(experiment: Experiment) -> Sizing:
    """Return the sizing of a law that predicts with one step per period, as that for servos."""
    sc, nominal, reference = experiment.scenario, experiment.nominal, experiment.reference
    largest = reachable = reference_torque(nominal, reference, sc.duration)
    if sc.controller.limits == "qp":
        space = clear_space(experiment)
        reachable = reference_torque(nominal, reference, sc.duration, space)
    return Sizing(1, largest, reachable, machine_torque(nominal))


def sizing_of(experiment: Experiment) -> Sizing:
    """Return the sizing of a law, for the scenario's duration, period and believed delay."""
    sc, nominal, reference = experiment.scenario, experiment.nominal, experiment.reference
    period, steps = sc.controller.period, believed_delay(sc).steps
    substeps = choose_substeps(nominal, reference, period, steps, sc.duration)
    sizing = one_step_sizing(experiment)
    within_reach = sizing.reachable_torque == sizing.reference_torque
    if sc.controller.estimate and within_reach:  # no number of steps does beyond the reach
        model_std = assumed_model_error(experiment)
        assumed = filter_substeps(nominal, reference, period, sc.duration, model_std)
        substeps = max(substeps, assumed)
    substeps = max(substeps, turning_substeps(nominal, reference, period, sc.duration))
    return sizing._replace(substeps=substeps, frequency=motion_frequency(experiment))


_PREDICTORS: Final[Mapping[str, Predictor | NonlinearPredictor]] = {
    "linear": LinearPredictor(),
    "nonlinear": NonlinearPredictor(),
}
_FEEDFORWARDS: Final[Mapping[str, Feedforward]] = {
    "none": NoFeedforward(),
    "equilibrium": EquilibriumFeedforward(),
    "inverse_dynamics": InverseDynamicsFeedforward(),
}


def compose_law(experiment: Experiment, sizing: Sizing | None = None) -> PredictiveLqi:
    """Compose the law of a scenario from parts.

    Args:
        sizing: `sizing_of` the experiment, computed if None.

    Raises:
        ConfigError: the scenario has servos; see `loop.servos`.
    """
    sc, nominal = experiment.scenario, experiment.nominal
    if found := differing(sc, {"controller.command": "torque"}):
        raise ConfigError(found.problem(hint=", for a law that closes its loop across the delay"))
    c, timeline = sc.controller, Timeline(sc.controller.period, believed_delay(sc))
    substeps, peak_torque, reachable, machine_scale, frequency = sizing or sizing_of(experiment)
    torque_scale = max(machine_scale, reachable)
    motion_torque = max(STILL * machine_scale, reachable)
    parameters = estimated_parameters(experiment, torque_scale, motion_torque)
    noise = sc.sensor.noise_std if isinstance(sc.sensor, StateSensorConfig) else None
    tolerated, (white, _) = tolerated_timing(experiment, frequency), white_errors(sc)
    model_std = assumed_model_error(experiment)
    settings = filter_settings(model_std, c.period, parameters, c.timing_std, _learns(sc))
    gaps = sc.sensor.kind == "state" and sc.sensor.loss > 0
    timing = white and not any(noise or ()) and math.isfinite(tolerated)
    observer = CoreObserver(settings if c.estimate else None, gaps=gaps, timing=timing)
    open_loop = c.open_loop_start and sc.start == "rest"
    before = int(bool(c.estimate) and c.delay_estimator == "none")  # torques, as the filter asks
    waits = longest_wait(sc)
    channel = make_channel(experiment, timeline, waits)
    motors = TorqueLimit(experiment.torque_limit)
    gentle = GENTLE * min(1.0, _GENTLE_PERIOD / c.period) ** 2
    law = PredictiveLqi(
        timeline=timeline,
        plant=NominalPlant(nominal, substeps, gentle * torque_scale, motors),
        sensing=make_sensing(experiment),
        observer=observer,
        predictor=_PREDICTORS[c.prediction],
        feedforward=_FEEDFORWARDS[c.feedforward],
        model=PaperModel(c.torque_map) if c.model == "paper" else MultibodyModel(),
        cost=cost_of(experiment, peak_torque),
        channel=channel,
        longest_wait=waits,
        extra_torques=waits + (REPORTS if isinstance(channel, Packets) else before),
        open_loop_samples=_until_seen(timeline.delay, waits) if open_loop else 0,
        tolerated_timing=tolerated,
    )
    if c.delay_estimator != "none":
        prior = timeline.eta, c.delay_std, c.delay_max
        delay = DelaySettings.of(c.delay_estimator, *prior, open_loop)
        law = replace(
            law,
            observer=CoreObserver(settings, delay),
            predictor=ArrivalPredictor(),
            open_loop_samples=0,  # until the delay is found
        )
    if c.limits == "qp":
        law = LimitedLqi(**law.parts, limits=QpLimits(c.horizon, clear_space(experiment)))
    law = with_learned(law, learned_signal(experiment))
    return experiment.own.revised(law)


def clear_space(experiment: Experiment) -> ClearSpace:
    """Return the distances that plans keep, from the reference up to the last horizon's end."""
    sc = experiment.scenario
    period = sc.controller.period
    ahead = believed_delay(sc).eta(period) + sc.controller.horizon * period
    instants = check_instants(sc.duration + ahead)
    few = instants[:: max(1, len(instants) // _POSES)]
    poses = poses_along(experiment.reference, few)
    return ClearSpace.along(experiment.mechanism, poses)


def estimated_parameters(
    experiment: Experiment, torque_scale: float, motion_torque: float
) -> ParameterSet:
    """Return the estimated parameters and their prior.

    Args:
        torque_scale: of machine and motion, N m.
        motion_torque: largest torque that the motion takes, N m. It sets the scale of a wrench: the
            moment, and the force at the tip of the shortest crank.

    Raises:
        ConfigError: the calibration is beyond the bounds of such a machine.
    """
    sc, machine = experiment.scenario, experiment.mechanism
    found = usual_parameters(
        machine.plate.mass,
        torque_scale,
        experiment.planned_limit,
        plate_radius(machine),
        experiment.nominal.free,
        wrench=(motion_torque, motion_torque / machine.crank_lengths.min()),
    )
    by_motion = {
        **dict.fromkeys(PARAMETERS[BIAS], BIAS_SHARE * motion_torque),
        PARAMETERS[PAYLOAD]: PAYLOAD_SHARE * machine.plate.mass,
        PARAMETERS[DAMPING]: BIAS_SHARE * motion_torque,
        **dict.fromkeys(PLANT_PARAMETERS[PAYLOAD_POSITION], POSITION_SHARE * plate_radius(machine)),
    }
    found = replace(found, usual=found.std).trusting(by_motion)
    if experiment.calibration is not None:
        try:
            found = found.knowing(experiment.calibration)
        except ValueError as error:
            raise ConfigError(f"controller.calibration: {error}") from None
    prior = sc.controller.prior
    stds = {
        **dict.fromkeys(PARAMETERS[BIAS], prior.torque_bias),
        PARAMETERS[PAYLOAD]: prior.payload,
        PARAMETERS[DAMPING]: prior.damping,
        **dict.fromkeys(PLANT_PARAMETERS[PAYLOAD_POSITION], prior.payload_position),
        **dict.fromkeys(OFFSETS, prior.offsets),
    }
    found = found.trusting({name: std for name, std in stds.items() if std is not None})
    if WRENCHES[0] not in found.names:
        return found
    return found.changing(_of_wrench(prior.wrench_walk), _of_wrench(prior.wrench))


def _of_wrench(moment_and_force: Sequence[float] | None) -> dict[str, float]:
    """Return the scale of each component of a wrench, by name; nothing for None."""
    if moment_and_force is None:
        return {}
    return dict(zip(WRENCHES, np.repeat(moment_and_force, 3).tolist(), strict=True))


def _until_seen(delay: Delay, waits: int) -> int:
    """Return the samples until the first torque of the law has acted for a whole hold.

    Until then only the torque bias moves the plate. Estimates of payload and friction are noise,
    and feedback that rests on them would act for the whole delay.
    """
    late = max(waits - _PATIENCE, 0)
    return math.ceil(delay.periods + 1 - 1e-9) + late


def longest_wait(scenario: Scenario) -> int:
    """Return the periods for which the law waits for a late measurement; 0 if none is late.

    Raises:
        ConfigError: they exceed the bound of all delays.
    """
    sc, period, back = scenario, scenario.controller.period, scenario.link.back
    if sc.sensor.delay == 0 and back is None:
        return 0
    longest = oldest(sc, _MOST)
    if longest > MOST_PERIODS * period:
        field = "sensor.delay" if back is None else "link.return"
        raise ConfigError(
            f"{field}: got measurements that take {longest:.4g} s; expected at most "
            f"{MOST_PERIODS} periods"
        )
    return math.ceil(longest / period - 1e-9) + _PATIENCE


def control_law(experiment: Experiment) -> tuple[PredictiveLqi, Trajectory, float]:
    """Return the law, the motion that it follows, and the length of the blend, s."""
    law = compose_law(experiment)
    return with_catch_up(law, experiment, catch_up_of(experiment, law))


def with_catch_up(
    law: PredictiveLqi, experiment: Experiment, way: CatchUp | None
) -> tuple[PredictiveLqi, Trajectory, float]:
    """Return `control_law` for a composed law and its `catch_up_of` the reference."""
    sc, motion, length = experiment.scenario, experiment.reference, 0.0
    if way is not None:
        motion, length = way.plan(sc.controller.catch_up, experiment.planned_limit)
    apart = sc.start == "rest" and (way is not None or sc.controller.catch_up == 0)
    return _replanning(law, experiment, length, apart), motion, length


def _replanning(
    law: PredictiveLqi, experiment: Experiment, length: float, apart: bool
) -> PredictiveLqi:
    """Return the law that plans a way back onto the reference, or `law` where it does not.

    After a start from rest with a catch-up of `length` s it plans again for as long, under a torque
    limit for half as long at the most: payload and bias were unknown before. After a start on the
    reference (not `apart` from it) it takes back what they moved the plate by before they were
    known. It does not plan without estimated parameters, with a linear prediction, or with
    `replan: 0`. With a known delay it also does not plan over packets, with late measurements, or
    after a start `apart` without a catch-up (0 s).
    """
    replan = experiment.scenario.controller.replan
    if replan == 0 or not law.estimates or isinstance(law.predictor, LinearPredictor):
        return law
    prompt = isinstance(law.channel, Wire) and law.longest_wait == 0
    if not law.finds_delay and not (prompt and (length or not apart)):
        return law
    short = min(LONGEST_REPLAN, REPLAN_SHARE * law.timeline.eta)
    usual, longest = (length, length) if length else (short, LONGEST_REPLAN)
    if length and experiment.planned_limit is not None:
        usual, longest = short, LIMITED_REPLAN * length
    if replan:
        usual = longest = replan
    sure = SURE if length or law.finds_delay else SURE_ON_REFERENCE
    return replace(law, planner=Replan(usual, longest, experiment.scale, sure))


def _learns(scenario: Scenario) -> bool:
    """Return whether the estimator learns its noise: the plant has no errors of fixed steps."""
    return scenario.plant.kind == "exact"


def white_errors(scenario: Scenario) -> tuple[bool, bool]:
    """Return whether plant and sensor have white errors, and whether such a sensor has noise."""
    sensor = scenario.sensor
    white = _learns(scenario) and isinstance(sensor, StateSensorConfig)
    return white, isinstance(sensor, StateSensorConfig) and white and all(sensor.noise_std)


def assumed_model_error(experiment: Experiment) -> Array:
    """Return the error (12,) of the estimator's model over a period.

    Errors of an engine's steps and of rounded angles are not white but add up: their default is
    that of a USUAL_PERIOD at any period. It grows with steps above USUAL_STEP. With a white sensor
    that has noise, the default is INTEGRATION_ERROR. Without noise the filter would follow each
    digit of that error.
    """
    c, scale = experiment.scenario.controller, experiment.motion_scale
    if c.model_error is not None:
        return acceleration_noise(c.model_error, scale, c.period)
    white, noisy = white_errors(experiment.scenario)
    steps = max(1.0, (experiment.scenario.plant.step or 0.0) / USUAL_STEP)
    share = INTEGRATION_ERROR / MODEL_ERROR if noisy else steps
    return share * usual_model_error(scale, c.period if white else USUAL_PERIOD)


def motion_frequency(experiment: Experiment) -> float:
    """Return sqrt(a / TOLERANCE), a the largest acceleration of a coordinate over its amplitude."""
    times = spread_instants(experiment.scenario.duration, _POSES)
    accelerations = rows_along(experiment.reference, times)[:, ACCELERATIONS]
    amplitudes = np.where(experiment.peak_to_peak > 0, experiment.peak_to_peak / 2, np.inf)
    largest = np.abs(accelerations).max(axis=0)
    return math.sqrt(float((largest / amplitudes).max() / TOLERANCE))


def tolerated_timing(experiment: Experiment, frequency: float) -> float:
    """Return the standard deviation of single torques' timing that the loop tolerates, s.

    It is a share of the time constant of the loop that falls with the delay: a longer one carries
    late torques further. The time constant is 1 / bandwidth of theory.md, section 13, with the
    `motion_frequency`, and at least a period. It is infinite for weights that are given or set by a
    tuner, where the timing is only assumed, and for the paper's laws and baselines: they predict
    linearly or not at all.
    """
    sc, c = experiment.scenario, experiment.scenario.controller
    predicts = c.prediction == "nonlinear" and believed_delay(sc).eta(c.period) > 0
    if c.w_R is not None or sc.tuner.kind != "fixed" or not (c.estimate or predicts):
        return math.inf
    learnt = _learns(sc) or c.delay_estimator != "none"
    if not learnt and c.timing_std is None:
        return math.inf
    bandwidth = min(frequency, 1 / c.period)
    late = bandwidth * believed_delay(sc).eta(c.period)
    return TOLERATED / (bandwidth * (1 + late)) if bandwidth else math.inf


def catch_up_of(experiment: Experiment, law: PredictiveLqi) -> CatchUp | None:
    """Return the plans onto the reference after a start from rest, or None without them.

    A reference that goes on from the plate's state when the first torque acts needs none.
    """
    sc, nominal, timeline = experiment.scenario, experiment.nominal, law.timeline
    c = sc.controller
    if sc.start != "rest" or c.catch_up == 0:
        return None
    state, queue = experiment.start, experiment.torques_in_flight(timeline.delay)
    if len(queue):
        state = nominal.predict(state, *timeline.until_next(queue), law.plant.substeps)[-1]
    if continues(state, experiment.reference, timeline.eta, sc.duration):
        return None
    given = nominal, experiment.reference, state, timeline.eta, c.period
    if not isinstance(law.cost, QuadraticCost):
        return CatchUp(*given)
    Q, R = law.cost.matrices(np.array(c.weights))

    def least() -> LeastError:
        # A quadratic program keeps feedback within the limits.
        share = HEADROOM if c.limits == "qp" else LEAST_ERROR_SHARE
        return LeastError(law.plant, clear_space(experiment), np.diag(Q)[POSE], R, share)

    return CatchUp(*given, least)


def first_queue(experiment: Experiment, law: PredictiveLqi) -> Array:
    """Return the torques in flight at t = 0 that a law assumes.

    For a law that estimates the delay there is one for each period up to the longest delay. They
    begin at the samples, while those of a plant begin at k dt + eta0.
    """
    delay = Delay(law.queue_length) if law.finds_delay else law.timeline.delay
    return experiment.torques_in_flight(delay)


def followed_motion(
    law: PredictiveLqi, planned: Trajectory, reference: Trajectory
) -> tuple[Trajectory, Trajectory] | None:
    """Return the motions (planned, reference) if the law reads them at any instant, else None."""
    return (planned, reference) if law.moves else None


_HORIZON = 10.0
"""Part of an endless reference for the choice of weights and steps, s."""


@dataclass(eq=False)
class DesignedLaw:
    """Result of `design_law`; it can be added to several diagrams.

    Attributes:
        law: the control law, a pure function from one memory to the next.
        reference: trajectory (6, 1).
        planned: trajectory that the law follows: the reference, or first a way onto it.
        queue: (L, 6) assumed torques in flight at t = 0 in N m, oldest first. A law that
            estimates the delay has one for each period of the longest delay, from t = 0 on; those
            of a plant whose delay is no whole number of periods begin between its samples.
        weights: (2,) w_Q and w_R.
        experiment: from which `sd.controller_margin` and `sd.linear_models` make the loop.
    """

    law: PredictiveLqi
    reference: Trajectory
    planned: Trajectory
    queue: Array
    weights: Array
    experiment: Experiment

    def __repr__(self) -> str:
        timeline, dynamics = self.law.timeline, self.law.plant.dynamics
        return f"DesignedLaw(every {timeline.period:g} s, delay {timeline.eta:g} s, {dynamics})"

    def controller(self) -> DelayLqiController:
        """Return the law as a LeafSystem with unconnected `preview` and `weights`."""
        motion = followed_motion(self.law, self.planned, self.reference)
        return DelayLqiController(self.law, self.queue, motion)

    def delay_chain(self, delay: float | None = None) -> DelayChain:
        """Return the delay of the torques as a LeafSystem, with those in flight at t = 0.

        Args:
            delay: true one, s; that which the law assumes if None.
        """
        period, true = self.law.timeline.period, self.law.timeline.delay
        if delay is not None:
            late, step = float(fixed("delay", delay, (), 0.0)), self.experiment.scenario.plant.step
            if step and (problem := multiple_problem("delay", late, step)):
                raise ConfigError(problem)
            true = Delay.of(late, period)
        queue = self.experiment.torques_in_flight(true)
        return DelayChain(period, true.steps, true.fraction, queue)

    def AddToBuilder(
        self,
        builder: DiagramBuilder,
        name: str = "delay_lqi",
        weights: OutputPort | None = None,
    ) -> DelayLqiController:
        """Add the law, connected with its reference and weights.

        Args:
            name: of the controller, with a number if the builder has it already; its reference is
                `NAME_reference`, its weights `NAME_weights`.
            weights: w_Q and w_R (2,) of a tuner in the diagram; constant ones if None.

        Returns:
            The controller. Connect its `measurement` (12) and its `torque` (6). The system that
            holds and delays the torque must read it at the samples, multiples of the period less
            the lead of `scenario.timing.event_time`.
        """
        name = free_name(builder, name)
        controller = builder.AddNamedSystem(name, self.controller())
        reference = builder.AddNamedSystem(
            f"{name}_reference", Reference(self.reference, self.planned, self.law.preview_times)
        )
        if weights is None:
            constant = ConstantVectorSource(self.weights)
            weights = builder.AddNamedSystem(f"{name}_weights", constant).get_output_port()
        builder.Connect(reference.GetOutputPort("preview"), controller.GetInputPort("preview"))
        builder.Connect(weights, controller.GetInputPort("weights"))
        return controller


def _of_argument(message: str) -> str:
    """Return an error about a scenario's field with the argument of `design_law` that sets it."""
    fields = {
        "actuator.torque_limit": "torque_limit",
        "controller.period": "period",
        "controller": "options",
    }
    for field, argument in fields.items():
        message = re.sub(rf"^design_law: {field}\b", argument, message)
    return message


def design_law(
    dynamics: StewartDynamics | StewartPlatform,
    reference: Trajectory,
    period: float,
    delay: float,
    *,
    start: ArrayLike | None = None,
    queue: Literal["zero", "equilibrium", "reference"] | None = None,
    noise_std: ArrayLike = (0.0,) * NUM_STATE,
    torque_limit: float | None = None,
    horizon: float | None = None,
    options: ControllerConfig | str | Path | None = None,
) -> DesignedLaw:
    """Design the delayed LQI law for a machine and a motion.

    `sd.controller_margin` computes the stability margins of the result.

    Args:
        dynamics: the machine that the law assumes, or the platform that it is to drive: then the
            estimator does not take the errors of a MultibodyPlant's steps for a payload. Its `free`
            parameters are estimated; those of `options.estimate` where they are the default ones.
        reference: 6 x 1 trajectory of the pose, rad and m, with derivatives of order 1 and 2; held
            after its end.
        period: of the controller, s.
        delay: assumed time from the computation of a torque to its action, s.
        start: (12,) pose and rates at t = 0, from which a way onto the reference is planned; on the
            reference if None.
        queue: torques in flight at t = 0, as a scenario's `queue`: `zero`, the default without
            gravity; `equilibrium`, that with it; `reference` for a motion already under way.
        noise_std: (12,) of the measurement, rad, m and per s.
        torque_limit: of each motor, N m; None is the mechanism's, if it has one.
        horizon: part of the reference for the choice of weights and steps, and for the check of
            its reach, s; by default all of it, or 10 s of an endless one.
        options: other options, as a scenario's `controller`, or a controller's shipped name or
            file; their period and delay are ignored.

    Raises:
        ConfigError: bad input, a reference or a start out of reach.
    """
    if options is None or isinstance(options, str | Path):
        given = {} if options is None else load_controller(options)
        options = validate(ControllerConfig, given, "options")
    engine: dict[str, Any] = {}
    if isinstance(dynamics, StewartPlatform):
        engine, dynamics = dynamics.engine, dynamics.dynamics
    if not isinstance(dynamics, StewartDynamics):
        expected = "expected a StewartPlatform or a StewartDynamics"
        raise ConfigError(f"dynamics: got {brief(dynamics)}; {expected}")
    of_kind("reference", reference, Trajectory)
    of_kind("options", options, ControllerConfig)
    period, late = positive("period", period), float(fixed("delay", delay, (), 0.0))
    if step := engine.get("time_step"):
        for name, value in (("period", period), ("delay", late)):
            if problem := multiple_problem(name, value, step):
                raise ConfigError(problem)
    if horizon is None:
        horizon = reference.end_time() if math.isfinite(reference.end_time()) else _HORIZON
    believed = Delay.of(late, period)
    sections = {
        "duration": positive("horizon", horizon),
        "start": "on_reference" if start is None else "rest",
        "queue": ("zero" if dynamics.gravity == 0 else "equilibrium") if queue is None else queue,
        "plant": {"kind": "exact", "gravity": dynamics.gravity != 0},
        "delay": dataclasses.asdict(believed),
        "controller": dataclasses.asdict(options)
        | {"period": period, "delay_steps": believed.steps, "delay_fraction": believed.fraction},
        "actuator": {"torque_limit": torque_limit},
        "sensor": {"noise_std": fixed("noise_std", noise_std, (NUM_STATE,), 0.0).tolist()},
    }
    try:
        scenario = validate(Scenario, sections, "design_law")
        scenario.check("design_law")
    except ConfigError as error:
        raise ConfigError(_of_argument(str(error))) from None
    for name, value in engine.items():  # after the check: its grid of 20 ms is that of `simulate`
        setattr(scenario.plant, name, value)
    names = estimated_names(scenario)
    if dynamics.free == PARAMETERS:
        parts = dynamics.mechanism, dynamics.gravity, dynamics.plant_parameters
        dynamics = type(dynamics)(*parts, names)
    elif names not in (PARAMETERS, dynamics.free):
        raise ConfigError(
            f"options.estimate: got {', '.join(names)}, with dynamics in which "
            f"{', '.join(dynamics.free)} are free; expected one of the two"
        )
    motion = own_motion(reference, horizon)
    first = evaluate(motion, 0.0)[:NUM_STATE]
    at = first if start is None else fixed("start", start, (NUM_STATE,))
    experiment = Experiment(
        scenario=scenario,
        mechanism=dynamics.mechanism,
        truth=dynamics.mechanism,
        reference=motion,
        peak_to_peak=motion_range(motion, horizon),
        nominal=dynamics,
        start=at,
        network=None,
        own=Own(reference=reference),
        calibration=calibration_of(scenario, dynamics.mechanism),
    )
    check_reach(experiment)
    if outside := diagnose(dynamics.mechanism, 0.0, at[POSE]):
        raise ConfigError(f"start: got a pose where {outside.reason}; expected one within reach")
    if weak := experiment.weak_motors():
        warnings.warn(weak.replace("actuator.", ""), stacklevel=2)
    law, planned, _ = control_law(experiment)
    c = scenario.controller
    flying = first_queue(experiment, law)
    return DesignedLaw(law, motion, planned, flying, np.array(c.weights), experiment)
