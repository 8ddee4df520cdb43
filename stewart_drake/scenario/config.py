"""The scenario: one plain dataclass per section and kind, with units, defaults and ranges.

A field is checked alone when it is set; `Scenario.check` checks what several fields share. Nothing
here needs a mechanism. `scenario.loading` reads scenarios from files.
"""

import dataclasses
import math
from dataclasses import field
from typing import Annotated, Any, Final, Literal

import pydantic
from pydantic import AfterValidator, Field

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve, shipped
from stewart_drake.files.schema import ByKind
from stewart_drake.files.yamlio import brief, differences, exactly, rule, validate
from stewart_drake.scenario.dependencies import ESTIMABLE, contradiction
from stewart_drake.scenario.field_types import (
    MOST_PERIODS,
    AngleRange,
    Deviation,
    Fraction,
    LegFault,
    Length,
    Loss,
    Name,
    Positive,
    Seconds,
    Seed,
    SensorFault,
    Six,
    Steps,
    TorqueLimit,
    Weight,
    section,
)
from stewart_drake.scenario.link_config import (
    ASSUMED_TIMES,
    LinkConfig,
    NetworkConfig,
    WireConfig,
)
from stewart_drake.scenario.reference_config import ReferenceConfig, SineConfig
from stewart_drake.scenario.signals import DEFAULT_BALL_JOINT_SPEED, DEFAULT_COULOMB_SPEED, SHAFTS
from stewart_drake.scenario.timing import METRIC_PERIOD, Delay, log_problem, step_problem

_Friction = Annotated[float, Field(ge=0, le=1e3)]
_Wrench = Annotated[list[Annotated[float, Field(ge=-1e9, le=1e9)]], exactly(6)]
_MomentAndForce = Annotated[list[Positive], exactly(2)]
_Speed = Annotated[float, Field(ge=1e-6, le=1e3)]
_SensorDelay = Annotated[float, Field(ge=0, le=100)]


@section
class PushConfig:
    """A constant wrench on the plate for a while, unknown to the controller.

    Attributes:
        wrench: moment in N m, then force in N, in the world at the plate's centre of mass.
        start: `from` in files, s after the begin of the run. A multibody plant has it from its next
            step on.
        to: end of the push, s; null is the end of the run.
    """

    wrench: _Wrench = field(default_factory=lambda: [0.0] * 6)
    start: Seconds = Field(default=0.0, alias="from")
    to: Seconds | None = None

    @property
    def end(self) -> float:
        """End of the push, s; infinite without one."""
        return math.inf if self.to is None else self.to

    def at(self, time: float) -> list[float]:
        """Return the wrench (6,) at a time in s."""
        return self.wrench if self.start <= time < self.end else [0.0] * 6

    def problem(self) -> str | None:
        if self.start < self.end:
            return None
        return (
            f"plant.push.to: got {self.to:g} s; expected more than plant.push.from, "
            f"{self.start:g} s, or null"
        )


@section
class PlantConfig:
    """The simulated platform; fields from the payload on are unknown to a scenario's controller.

    Attributes:
        kind: `multibody` (MultibodyPlant with constraints, fixed steps), `exact` (closed-form
            dynamics, error-controlled integration) or `paper` (the paper's torque map, frozen at
            home, for the controller too; without limits, the plate counts as lost for an error
            above ten times the motion's peak to peak).
        gravity: whether gravity acts, 9.81 m/s^2; false stands for a counterbalanced platform.
        time_step: of the multibody plant, s.
        accuracy: of the exact plant's integrator, relative, 1e-12 to 1e-2.
        payload_mass: a point mass, kg.
        torque_bias: added to each motor's torque, N m.
        joint_damping: viscous damping on each crank shaft, N m s/rad.
        mechanism: the simulated machine, a shipped name or a path; null is that of the controller,
            the scenario's `mechanism`.
        coulomb_friction: on each crank shaft, N m, times tanh(rate / coulomb_speed).
        coulomb_speed: scale of the rate in that, rad/s.
        payload_position: of the payload in the plate's frame, from its centre of mass, m.
        push: section of a wrench on the plate for a while.
        ball_joint_damping: viscous damping of each ball joint between crank, rod and plate, N m
            s/rad; a mechanism's `ball_joints` lists those that have it.
        ball_joint_friction: Coulomb friction of each, N m, times
            tanh(w / ball_joint_friction_speed), w its angular speed without the rod's spin.
        ball_joint_friction_speed: scale of the speed in that, rad/s.
    """

    kind: Literal["multibody", "exact", "paper"] = "multibody"
    gravity: bool = False
    time_step: Annotated[float, Field(ge=1e-6, le=METRIC_PERIOD)] = 0.001
    accuracy: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-8
    payload_mass: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    torque_bias: Six = field(default_factory=lambda: [0.0] * 6)
    joint_damping: _Friction = 0.0
    mechanism: Name | None = None
    coulomb_friction: _Friction = 0.0
    coulomb_speed: _Speed = DEFAULT_COULOMB_SPEED
    payload_position: Annotated[list[Length], exactly(3)] = field(default_factory=lambda: [0.0] * 3)
    push: PushConfig = field(default_factory=PushConfig)
    ball_joint_damping: _Friction = 0.0
    ball_joint_friction: _Friction = 0.0
    ball_joint_friction_speed: _Speed = DEFAULT_BALL_JOINT_SPEED

    @property
    def parameters(self) -> list[float]:
        """All constants, in the order of `scenario.signals.CONSTANTS`."""
        shafts = (self.joint_damping, self.coulomb_friction, self.coulomb_speed)
        loads = [*self.torque_bias, self.payload_mass, *shafts, *self.payload_position]
        ball_joints = (self.ball_joint_damping, self.ball_joint_friction)
        return [*loads, *ball_joints, self.ball_joint_friction_speed]

    @property
    def step(self) -> float | None:
        """Step of a discrete plant, s, None for a continuous one."""
        return self.time_step if self.kind == "multibody" else None

    @property
    def without_engine(self) -> "PlantConfig":
        """The same plant, exact instead of multibody."""
        if self.kind != "multibody":
            return self
        return dataclasses.replace(self, kind="exact")


@section
class DelayConfig:
    """The true delay of a torque, by the time t at which it is computed.

    It is (steps + fraction) dt + drift t + swing sin(swing_frequency t),
    from `jump_time` on plus jump, plus jitter, and at least 0: `scenario.link.torque_delays`.

    Attributes:
        steps: whole controller periods.
        fraction: further part of a period, 0 to below 1; less than 1e-9 is 0.
        drift: growth of the delay, s/s.
        swing: amplitude of a slow change, s.
        swing_frequency: of that, rad/s.
        jump: sudden change, s.
        jump_time: of the jump, s.
        jitter_std: standard deviation of the jitter from torque to torque, s.
        seed: of the jitter.
    """

    steps: Steps = 8
    fraction: Fraction = 0.0
    drift: Annotated[float, Field(ge=-0.9, le=10)] = 0.0
    swing: Annotated[float, Field(ge=0, le=100)] = 0.0
    swing_frequency: Annotated[float, Field(gt=0, le=1e3)] = 1.0
    jump: Annotated[float, Field(ge=-100, le=100)] = 0.0
    jump_time: Seconds = 0.0
    jitter_std: Annotated[float, Field(ge=0, le=10)] = 0.0
    seed: Seed = 0

    @property
    def constant(self) -> bool:
        """Whether all torques have the same delay."""
        return self.drift == self.swing == self.jump == self.jitter_std == 0


@section
class PriorConfig:
    """Prior standard deviations of the estimated parameters.

    A null is taken from `controller.calibration`, and without one from machine and motion.

    Attributes:
        torque_bias: of each motor, N m; null is 0.05 of the torque that the motion takes.
        payload: kg; null is a tenth of the plate.
        payload_position: of the payload from the plate's centre of mass, each coordinate, m; null
            is 0.15 of the plate's radius.
        damping: N m s/rad; null is 0.05 s/rad times the torque that the motion takes.
        rates: of the plate at the first sample, which encoders do not measure, rad/s and m/s; null
            is half the motion's peak to peak per second.
        offsets: mounting of an encoder, rad; null is 0.1 degrees.
        wrench: sudden wrench on the plate, [moment in N m, force in N]; null is 0.4 of the torque
            that the motion takes, and 0.4 of that torque's force at the tip of the shortest crank.
            A number given here also holds at the start, where null is `wrench_walk`.
        wrench_walk: its slow change per root second, in the same units; null is 0.0002 of that
            torque and force.
    """

    torque_bias: Positive | None = None
    payload: Positive | None = None
    payload_position: Positive | None = None
    damping: Positive | None = None
    rates: Annotated[list[Positive], exactly(6)] | None = None
    offsets: Positive | None = None
    wrench: _MomentAndForce | None = None
    wrench_walk: _MomentAndForce | None = None


ESTIMATED: Final = ["torque_bias", "payload", "damping"]  # parameters that are estimated by default


def _check_estimate(names: list[str]) -> list[str]:
    if not (len({*names}) == len(names) and {*names} <= {*ESTIMABLE}):
        raise ValueError(f"[], or some of {', '.join(ESTIMABLE)}")
    if "payload_position" in names and "payload" not in names:
        raise ValueError("payload_position with payload")
    return sorted(names, key=ESTIMABLE.index)


@pydantic.WrapValidator
def _no_controllers_name(value: Any, accept: pydantic.ValidatorFunctionWrapHandler) -> Any:
    """Accept a kind; name what the name of a shipped controller is for."""
    try:
        return accept(value)
    except pydantic.ValidationError as error:
        if value not in shipped("controller"):
            raise
        raise ValueError(
            f"{error.errors()[0]['ctx']['expected']}; {value} is a shipped controller: "
            f"--controller {value}, load_scenario(..., {value!r}).controller, or a copy of "
            f"{resolve('controller', value)} as your file"
        ) from None


_zero_or_long = rule(lambda s: not 0 < s < 1e-3, "0 for none, null, or at least 0.001 s")
Estimate = Annotated[list[str], AfterValidator(_check_estimate)]
"""Names of estimated parameters, in a fixed order."""


@section
class ControllerConfig:
    """The controller and its assumptions.

    Attributes:
        kind: of the feedback, `lqi` (optimal for w_Q and w_R, linearised again at each sample) or
            `pd` (constant kp and kd on the errors of pose and rates, times the plate's inertia;
            without integral).
        kp: of `pd`, 1/s^2; null is by kd, or by the uncompensated delay and gravity: `law.cost`.
        kd: of `pd`, 1/s; null is by kp, for critical damping, or as that.
        period: between two torques, s.
        integral: whether the error is also integrated.
        delay_steps: whole periods of the assumed delay, 0 for none; null is the true delay.
        delay_fraction: further part of a period of it, less than 1e-9 is 0; null is the true one
            where `delay_steps` is null too, else 0.
        prediction: across the delay, by the `linear` design model or the `nonlinear` dynamics.
        feedforward: `none`, `equilibrium` torque, or `inverse_dynamics` of the reference.
        model: for gain and prediction, `paper` (massless legs) or `multibody`.
        torque_map: of the paper's model, from `virtual_work` or as `printed`.
        estimate: estimated parameters of the machine: `torque_bias`, `payload` and `damping`, with
            or without `payload_position`, that of the payload's centre of mass, `coulomb`, the
            Coulomb friction of the shafts at the `coulomb_speed` of the calibration, else 0.02
            rad/s, `wrench`, a wrench on the plate that changes, and
            `offsets`, the mounting of encoders, for `sensor.kind` encoders and a known delay; empty
            for none.
        w_Q: weight of the errors.
        w_R: weight of the torques; null is 1, and more where the timing of the torques varies by
            more than the loop tolerates.
        integral_weight: weight of the integrals relative to the errors.
        weight_scaling: `bryson` (by the range of the reference) or `identity`.
        packet_torques: number of torques in a packet, for the next and further periods; over a
            network, where `delay_steps` is not 0.
        packet_repeats: number of earlier torques that a packet repeats, each for a period more of
            delay.
        catch_up: blend onto the reference after a start from rest, s; none where the reference
            itself begins there at rest. 0 is none, null the one of least error (for servos the
            shortest) within `actuator.torque_limit`, where that is a number, else 0.3 s.
        command: sent to the motors: a `torque` each, or for servos `cranks`: crank angles and
            rates of the reference for the time of arrival, and the torque of `feedforward`. With
            `cranks` only `estimate` feeds back, and only period, delay, feedforward, estimate and
            catch_up have an effect.
        delay_estimator: `none`; or the delay is estimated, starting with the assumed one, as
            `constant`, or as `drifting` at a rate that is estimated too.
        delay_std: prior standard deviation of the delay, s.
        delay_max: longest possible delay, s.
        open_loop_start: whether a start from rest has no feedback before the first own torque can
            have acted.
        replan: duration of a plan back onto the reference, s; 0 for none. It is made where the
            prediction is certain and off the reference: once payload and bias are known, or after a
            jump of an estimated delay. null: that of the catch-up; after a start on the reference
            0.2 times the assumed delay, at least two periods and at most 0.4 s.
        model_error: of the estimator's model: white noise of the accelerations, as a share of the
            motion's range per s^1.5; null is 2e-4 of it in each period, more with
            steps above 1 ms of a multibody plant, less in a short period on an exact plant.
        timing_std: standard deviation of the time at which a torque acts, s; null is learnt on an
            exact plant or with a delay estimator, else 1 % of the period.
        prior: section of prior standard deviations; null is the default of each.
        limits: of torque, reach and clearance, `ignore`: torques are cut, or `qp`: where a limit
            binds within the horizon, a quadratic program plans the torques within all of them.
        horizon: of these plans, periods.
        calibration: a file of the machine's parameters with their covariance, as `identify` writes
            it: means and covariance of the estimated ones, values of the others. Its delay is
            assumed where `delay_steps` is null.
        learned: a file of `learn`: what the same motion of the same machine took before, with the
            same period and delay. It is added to the torques of the law, or to its setpoints.
    """

    renamed = {  # since 0.2, see `files.yamlio.validate`; not annotated: no field
        "estimator": "estimate",
        "estimate_coulomb": "estimate",
        "estimate_offsets": "estimate",
        "quiet_start": "open_loop_start",
        "rejoin": "replan",
        "known": "calibration",
    }
    kind: Annotated[Literal["lqi", "pd"], _no_controllers_name] = "lqi"
    kp: Annotated[float, Field(gt=0, le=1e9)] | None = None
    kd: Annotated[float, Field(gt=0, le=1e6)] | None = None
    period: Annotated[
        float, Field(ge=1e-4), rule(lambda s: s <= 10, "at most 10 s; 20 ms is 0.02")
    ] = 0.1
    integral: bool = True
    delay_steps: Steps | None = None
    delay_fraction: Fraction | None = None
    prediction: Literal["linear", "nonlinear"] = "nonlinear"
    feedforward: Literal["none", "equilibrium", "inverse_dynamics"] = "inverse_dynamics"
    model: Literal["paper", "multibody"] = "multibody"
    torque_map: Literal["virtual_work", "printed"] = "virtual_work"
    estimate: Estimate = field(default_factory=lambda: [*ESTIMATED])
    w_Q: Weight = 1.0
    w_R: Weight | None = None
    integral_weight: Weight = 1.0
    weight_scaling: Literal["bryson", "identity"] = "bryson"
    packet_torques: Annotated[int, Field(ge=1, le=100)] = 16
    packet_repeats: Annotated[int, Field(ge=0, le=100)] = 1
    catch_up: Annotated[float, Field(ge=0, le=10), _zero_or_long] | None = None
    command: Literal["torque", "cranks"] = "torque"
    delay_estimator: Literal["none", "constant", "drifting"] = "none"
    delay_std: Annotated[float, Field(ge=1e-3, le=10)] = 0.3
    delay_max: Annotated[float, Field(gt=0, le=10)] = 1.5
    open_loop_start: bool = True
    replan: Annotated[float, Field(ge=0, le=10)] | None = None
    model_error: Positive | None = None
    timing_std: Deviation | None = None
    prior: PriorConfig = field(default_factory=PriorConfig)
    limits: Literal["ignore", "qp"] = "ignore"
    horizon: Annotated[int, Field(ge=2, le=100)] = 20
    calibration: Name | None = None
    learned: Name | None = None

    @property
    def weights(self) -> tuple[float, float]:
        """The weights w_Q and w_R; w_R is 1 where it is null."""
        return self.w_Q, 1.0 if self.w_R is None else self.w_R


@section
class TorqueActuatorConfig:
    """Motors that apply the torque that arrives, within their limit.

    Attributes:
        torque_limit: of each motor, N m; null is the mechanism's `motor.effort_limit`, the text
            `none` no limit. The catch-up respects a number only, see `ControllerConfig.catch_up`.
    """

    reflected_inertia, shafts = 0.0, None  # not annotated: no fields
    kind: Literal["torque"] = "torque"
    torque_limit: TorqueLimit = None


@section
class ServoActuatorConfig:
    """Servos given by their bandwidth: a local loop at each motor follows the commanded angle.

    Its torque is J (w^2 (a_r - a) + 2 d w (a_r' - a')) plus the torque of the command, computed at
    least 1000 times a second; w = 2 pi bandwidth, d the damping, J the mean inertia per motor at
    home, with the rotors. See `law.servos`.

    Attributes:
        bandwidth: Hz.
        damping: relative to critical damping, for an inertia of J.
        speed_limit: of the commanded angle, rad/s; null is none.
        gear_ratio: turns of the rotor per turn of the crank.
        rotor_inertia: about the rotor's axis, kg m^2; at the crank gear_ratio^2 times as much.
        torque_limit: at the crank, as of `TorqueActuatorConfig`.
    """

    shafts = None  # not annotated: no field
    kind: Literal["servo"] = "servo"
    bandwidth: Annotated[float, Field(ge=0.01, le=1e3)] = 10.0
    damping: Annotated[float, Field(ge=0.01, le=100)] = 0.7
    speed_limit: Positive | None = None
    gear_ratio: Annotated[float, Field(ge=1e-3, le=1e4)] = 1.0
    rotor_inertia: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    torque_limit: TorqueLimit = None

    @property
    def reflected_inertia(self) -> float:
        """Inertia of the rotor at its crank, kg m^2."""
        return self.gear_ratio**2 * self.rotor_inertia


@section
class PositionServoConfig:
    """Servos given by their stiffness, as hobby servos are: the newest setpoint u acts, held.

    The torque at a crank of angle a is clip(stiffness (u - a) - velocity_gain a', torque_limit)
    - crank_damping a' - friction tanh(a' / friction_speed) - armature a''. The controller knows
    these numbers, unless its `calibration` has others. See `law.servos`.

    Attributes:
        stiffness: N m/rad.
        velocity_gain: of the servo's own loop, within the torque limit, N m s/rad.
        crank_damping: viscous, of motor and gear, N m s/rad.
        friction: Coulomb friction, N m.
        friction_speed: rate scale of the Coulomb friction, rad/s.
        armature: inertia of the rotor behind its gear, at the crank, kg m^2.
        torque_limit: at the crank, as of `TorqueActuatorConfig`.
        angle_range: of each crank, [low, high] in rad, or six of these; setpoints stay within it.
        speed_limit: of the setpoint, rad/s; null is none.
    """

    kind: Literal["position_servo"] = "position_servo"
    stiffness: Positive = 10.0
    velocity_gain: _Friction = 0.1
    crank_damping: _Friction = 0.15
    friction: _Friction = 0.1
    friction_speed: _Speed = 0.05
    armature: Annotated[float, Field(ge=0, le=1e3)] = 0.001
    torque_limit: TorqueLimit = None
    angle_range: AngleRange = None
    speed_limit: Positive | None = None

    @property
    def lag(self) -> float:
        """Time by which the servo follows its setpoint late, s."""
        return (self.velocity_gain + self.crank_damping) / self.stiffness

    @property
    def reflected_inertia(self) -> float:
        """Inertia of the rotor at its crank, kg m^2."""
        return self.armature

    @property
    def shafts(self) -> tuple[float, float, float]:
        """Damping, Coulomb friction and its speed at each crank."""
        return self.crank_damping, self.friction, self.friction_speed


_OF_STIFFNESS: Final = {f.name for f in dataclasses.fields(PositionServoConfig)} - {
    f.name for f in dataclasses.fields(ServoActuatorConfig)
}
AnyActuator = TorqueActuatorConfig | ServoActuatorConfig | PositionServoConfig
ActuatorConfig = Annotated[AnyActuator, ByKind()]


def compatible_actuator(command: str, actuator: AnyActuator) -> AnyActuator:
    """Return these motors, or others with their limit that accept a controller's command."""
    wanted = TorqueActuatorConfig if command == "torque" else ServoActuatorConfig
    if (actuator.kind == "torque") == (command == "torque"):
        return actuator
    return wanted(torque_limit=actuator.torque_limit)


def with_actuator(given: dict[str, Any], change: Any, where: str) -> AnyActuator:
    """Return the motors of a section of a file, with a row of `compare` laid over it."""
    laid = given | change if isinstance(change, dict) else change
    return validate(Scenario, {"actuator": laid}, where).actuator


@section
class StateSensorConfig:
    """The measurement of pose and rates.

    Attributes:
        noise_std: of [pose; rates], in rad, m, rad/s and m/s.
        delay: age of a measurement when it arrives, s; it is used at the next sample after that.
        loss: share of the measurements that are lost.
        seed: of the noise, of spikes and losses; the same seed gives the same run.
        faults: frozen, missing or wrong measurements, see `field_types.SensorFault`.
    """

    measures_state, samples = True, None  # not annotated: no fields
    kind: Literal["state"] = "state"
    noise_std: Annotated[list[Deviation], exactly(12)] = field(default_factory=lambda: [0.0] * 12)
    delay: _SensorDelay = 0.0
    loss: Loss = 0.0
    seed: Seed = 0
    faults: list[SensorFault] = field(default_factory=list)


@section
class EncoderSensorConfig:
    """The measurement of the six crank angles, by an encoder at each motor.

    Attributes:
        bits: of a turn; null is exact.
        samples: readings of each encoder per period of the controller, the last one at its sample.
        offset: of each encoder on its shaft, unknown to the controller, rad.
        delay: age of a measurement when it arrives, s; it is used at the next sample after that.
        loss: share of the measurements, those of a period each, that are lost.
        seed: of the first code's place, of spikes and losses; the same seed gives the same run.
        faults: frozen, missing or wrong readings of legs, see `field_types.LegFault`.
    """

    measures_state = False  # not annotated: no field
    kind: Literal["encoders"] = "encoders"
    bits: Annotated[int, Field(ge=4, le=32)] | None = 14
    samples: Annotated[int, Field(ge=1, le=1000)] = 1
    offset: Six = field(default_factory=lambda: [0.0] * 6)
    delay: _SensorDelay = 0.0
    loss: Loss = 0.0
    seed: Seed = 0
    faults: list[LegFault] = field(default_factory=list)


SensorConfig = Annotated[StateSensorConfig | EncoderSensorConfig, ByKind()]


@section
class FixedTunerConfig:
    """Constant w_Q and w_R, those of the controller."""

    kind: Literal["fixed"] = "fixed"


@section
class AnnTunerConfig:
    """A neural network that sets w_Q and w_R at run time.

    It starts from the controller's w_Q and w_R and returns to them where it fails.

    Attributes:
        weights: the network, a shipped name or a JSON file; null is the shipped `tuner`.
    """

    kind: Literal["ann"] = "ann"
    weights: Name | None = None


@section
class RuleTunerConfig:
    """A piecewise linear rule for w_Q / w_R: constant for small innovations, then falling.

    log10(w_Q / w_R) = ratio - slope max(0, x - knee), x the logarithm of the last three seconds'
    largest innovation; see `tuner.source.Rule`.

    Attributes:
        ratio, slope, knee: see above; null is the shipped value for controllers with an estimator,
            or without one.
    """

    kind: Literal["rule"] = "rule"
    ratio: Annotated[float, Field(ge=-4, le=2)] | None = None
    slope: Annotated[float, Field(ge=0, le=100)] | None = None
    knee: Annotated[float, Field(ge=-6, le=4)] | None = None


TunerConfig = Annotated[FixedTunerConfig | AnnTunerConfig | RuleTunerConfig, ByKind()]


@section
class Scenario:
    """One closed-loop experiment; the defaults are the paper's.

    Attributes:
        mechanism: a shipped name or a path.
        duration: of the simulation, s.
        start: `rest` (at the reference's first pose, zero rates) or `on_reference`.
        queue: torques in flight at t = 0: `zero`, `equilibrium`, or `reference` (the inverse
            dynamics of the reference). With servos also the cranks of the first pose, or those of
            the reference where the torques are.
        reference, plant, delay, link, controller, actuator, sensor, tuner: the sections; all but
            plant, delay and controller come in kinds, each a class.
        log_period: of the recorded signals, s; null is every 20 ms and every sample of the
            controller. The multibody plant is recorded at its own steps only, so that it must be a
            multiple of `plant.time_step`. Figures of merit do not depend on it.
        compare: fields that `compare` lays over each controller last, by its name. Another name is
            a further row, of the shipped or own file in its `controller`; `actuator` in a row is
            laid over that section.
    """

    mechanism: Name = "paper"
    duration: Annotated[float, Field(gt=0, le=1e5)] = 10.0
    start: Literal["rest", "on_reference"] = "rest"
    queue: Literal["zero", "equilibrium", "reference"] = "zero"
    reference: ReferenceConfig = field(default_factory=SineConfig)
    plant: PlantConfig = field(default_factory=PlantConfig)
    delay: DelayConfig = field(default_factory=DelayConfig)
    link: LinkConfig = field(default_factory=WireConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    actuator: ActuatorConfig = field(default_factory=TorqueActuatorConfig)
    sensor: SensorConfig = field(default_factory=StateSensorConfig)
    tuner: TunerConfig = field(default_factory=FixedTunerConfig)
    log_period: Annotated[float, Field(ge=1e-5, le=1e5)] | None = None
    compare: dict[Name, dict[str, Any]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Scenario({differences(self, Scenario())})"

    @property
    def plant_parameters(self) -> list[float]:
        """All parameters of the simulated plant, with the friction of its servos."""
        parameters = self.plant.parameters
        if self.actuator.shafts is not None:
            parameters[SHAFTS] = self.actuator.shafts
        return parameters

    @property
    def assumed_link(self) -> WireConfig | NetworkConfig:
        """The link with all its numbers: times that follow the delay, and the play-out bound.

        Raises:
            ConfigError: they shall follow the delay, which is none or not constant.
        """
        link, c = self.link, self.controller
        if link.kind == "wire":
            return link
        if problem := self._times_problem(link):
            raise ConfigError(problem)
        if link.follows_delay:
            eta = Delay(self.delay.steps, self.delay.fraction).eta(c.period)
            low, high = (round(share * eta, 12) for share in ASSUMED_TIMES)
            link = dataclasses.replace(link, low=low, high=high)
        if link.playout is None:
            from stewart_drake.scenario import packets  # numpy, which --help does not import

            bound = packets.default_bound(link, c.packet_repeats, c.period)
            link = dataclasses.replace(link, playout=bound)
        return link

    @property
    def true_delay(self) -> Delay:
        """Delay of the torques at t = 0, which may be unknown to the controller."""
        c, link = self.controller, self.assumed_link
        if link.kind == "network":
            assert link.playout is not None
            return Delay.of(link.playout + c.packet_repeats * c.period, c.period)
        return Delay(self.delay.steps, self.delay.fraction)

    @property
    def eta(self) -> float:
        """The true delay in s."""
        return self.true_delay.eta(self.controller.period)

    def delay_max_problem(self, assumed: Delay | None = None) -> str | None:
        """Return why an estimator's longest delay excludes the assumed one, or None.

        By default that is the delay of the scenario, unless a calibration may have another.
        """
        c = self.controller
        if c.delay_estimator == "none":
            return None
        if assumed is None and c.delay_steps is not None:
            assumed = Delay(c.delay_steps, c.delay_fraction or 0.0)
        elif assumed is None and c.calibration is None:
            assumed = self.true_delay
        if assumed is None or assumed.eta(c.period) <= c.delay_max:
            return None
        return (
            f"controller.delay_max: got {c.delay_max:g} s, less than the assumed delay of "
            f"{assumed.eta(c.period):g} s; expected as much or more"
        )

    def _times_problem(self, link: NetworkConfig) -> str | None:
        if not link.follows_delay:
            return link.problem("link")
        zero = self.delay.steps + self.delay.fraction == 0
        if self.delay.constant and not zero:
            return dataclasses.replace(link, low=0.0, high=0.0).problem("link")
        low, high = ASSUMED_TIMES
        return (
            f"link.low: got null with a delay that is {'0' if zero else 'not constant'}; expected "
            f"link.low and link.high in s, or a constant delay; null is {low:g} and {high:g} "
            "times that"
        )

    def _network_problem(self) -> str | None:
        link = self.link
        if link.kind == "wire":
            return None
        back = link.back.problem("link.return") if link.back else None
        if problem := self._times_problem(link) or back:
            return problem
        if self.true_delay.steps <= MOST_PERIODS:
            return None
        given = {"link.playout": link.playout, "link.high": link.high, "link.median": link.median}
        given["delay.steps"] = self.delay.steps
        field, got = next(one for one in given.items() if one[1] is not None)
        return (
            f"{field}: got {got:g}, a delay of more than {MOST_PERIODS} periods of "
            f"{self.controller.period:g} s; expected less, in s (are these milliseconds?)"
        )

    def check(self, where: str = "scenario") -> None:
        """Check every field again, and all rules that take several of them.

        A ConfigError has the first problem, in one line that `where` opens.
        """
        # Assignment is validated, but a list can also be changed in place.
        validate(Scenario, dataclasses.asdict(self), where)
        self.check_rows(where)
        step = self.plant.step
        problem = (
            self.reference.problem()
            or self.plant.push.problem()
            or contradiction(self)
            or self._network_problem()
            or self.delay_max_problem()
            or (self.step_problem(step) if step else log_problem(self.log_period, self.duration))
        )
        if problem:
            raise ConfigError(f"{where}: {problem}")

    def check_rows(self, where: str) -> None:
        """Check each row of `compare` by itself; raise ConfigError."""
        for row, change in self.compare.items():
            place, fields = f"{where}: compare.{row}", dict(change)
            if "/" in row:
                raise ConfigError(f"{place}: names a file of signals; expected no slash")
            controller = fields.pop("controller", row)
            if not isinstance(controller, str):
                raise ConfigError(f"{place}: controller: got {brief(controller)}; expected text")
            laid = fields.pop("actuator", {})
            by_stiffness = isinstance(laid, dict) and laid.keys() & _OF_STIFFNESS
            kind = "position_servo" if by_stiffness else "servo"  # which has all other fields
            with_actuator({"kind": kind}, laid, place)
            validate(ControllerConfig, fields, place)

    def step_problem(self, step: float) -> str | None:
        """Return the first number that does not fit a plant with steps of `step` s, or None."""
        link, networked = self.link, self.link.kind == "network"
        return step_problem(
            step,
            self.controller.period,
            fraction=0.0 if networked else self.delay.fraction,
            samples=self.sensor.samples,
            playout=link.playout if link.kind == "network" else None,
        ) or log_problem(self.log_period, self.duration, step)
