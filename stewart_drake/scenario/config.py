"""The scenario: one plain dataclass per section and kind, with units, defaults and ranges.

A field is checked alone when it is set; `Scenario.check` checks what several fields share. Nothing
here needs a mechanism. `scenario.loading` reads scenarios from files.
"""

import dataclasses
from dataclasses import field
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.schema import ByKind
from stewart_drake.files.yamlio import brief, differences, validate
from stewart_drake.scenario.delay import Delay
from stewart_drake.scenario.dependencies import contradiction
from stewart_drake.scenario.fault_config import SensorFault, fault_problem
from stewart_drake.scenario.field_types import (
    MOST_PERIODS,
    STRICT,
    Deviation,
    Fraction,
    Name,
    Positive,
    Seconds,
    Seed,
    Six,
    Steps,
    TorqueLimit,
    Weight,
)
from stewart_drake.scenario.reference_config import ReferenceConfig, SineConfig
from stewart_drake.scenario.renames import CONTROLLER
from stewart_drake.scenario.signals import DEFAULT_COULOMB_SPEED
from stewart_drake.scenario.timing import (
    METRIC_PERIOD,
    log_problem,
    samples_problem,
    step_problem,
    whole_problem,
)


@dataclass(config=STRICT)
class PlantConfig:
    """The simulated platform; fields from the payload on are unknown to the controller.

    Attributes:
        kind: `multibody` (MultibodyPlant with constraints, fixed steps), `exact` (closed-form
            dynamics, error-controlled integration) or `paper` (the paper's torque map, frozen at
            home, for the controller too; without limits: lost is an error above ten times the
            motion's peak to peak).
        gravity: whether gravity acts, 9.81 m/s^2; false stands for a counterbalanced platform.
        time_step: of the multibody plant, s.
        accuracy: of the exact plant's integrator, relative, 1e-12 to 1e-2.
        payload_mass: a point mass, kg.
        torque_bias: added to each motor's torque, N m.
        joint_damping: viscous damping on each crank shaft, N m s/rad.
        mechanism: the machine that is simulated, a shipped name or a path; null is the one that the
            controller knows, the scenario's `mechanism`.
        coulomb_friction: on each crank shaft, N m, times tanh(rate / coulomb_speed).
        coulomb_speed: over which that builds up, rad/s.
        payload_position: of the payload in the plate's frame, from its centre of mass, m.
    """

    kind: Literal["multibody", "exact", "paper"] = "multibody"
    gravity: bool = False
    time_step: Annotated[float, Field(ge=1e-6, le=METRIC_PERIOD)] = 0.001
    accuracy: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-8
    payload_mass: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    torque_bias: Six = field(default_factory=lambda: [0.0] * 6)
    joint_damping: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    mechanism: Name | None = None
    coulomb_friction: Annotated[float, Field(ge=0, le=1e3)] = 0.0
    coulomb_speed: Annotated[float, Field(ge=1e-6, le=1e3)] = DEFAULT_COULOMB_SPEED
    payload_position: Annotated[
        list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=3, max_length=3)
    ] = field(default_factory=lambda: [0.0] * 3)

    @property
    def parameters(self) -> list[float]:
        """All of the plant, in the order of `scenario.signals.PLANT_PARAMETERS`."""
        shafts = (self.joint_damping, self.coulomb_friction, self.coulomb_speed)
        return [*self.torque_bias, self.payload_mass, *shafts, *self.payload_position]

    @property
    def step(self) -> float | None:
        """Step of a discrete plant, s, None of a continuous one."""
        return self.time_step if self.kind == "multibody" else None

    @property
    def without_engine(self) -> "PlantConfig":
        """The same, exact where it is the multibody one."""
        if self.kind != "multibody":
            return self
        return dataclasses.replace(self, kind="exact")


@dataclass(config=STRICT)
class DelayConfig:
    """The true delay between computing a torque and feeling it, by when it was computed.

    A torque computed at t waits for (steps + fraction) dt + drift t + swing sin(swing_frequency t),
    from `jump_time` on plus jump, plus jitter, in all at least 0: `scenario.link.torque_delays`.

    Attributes:
        steps: whole controller periods.
        fraction: a further part of one period, 0 to below 1; less than 1e-9 is 0.
        drift: growth of the delay, s/s.
        swing: amplitude of a slow change, s.
        swing_frequency: of that, rad/s.
        jump: a change all at once, s.
        jump_time: when that is, s.
        jitter_std: standard deviation of what differs from torque to torque, s.
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
        """Whether every torque waits as long."""
        return self.drift == self.swing == self.jump == self.jitter_std == 0


@dataclass(config=STRICT)
class PriorConfig:
    """Prior standard deviations of the estimated parameters.

    null is what `controller.calibration` says, and without it what machine and motion say. A number
    stands before both.

    Attributes:
        torque_bias: of each motor, N m; null is 0.3 of the torque that the motion takes.
        payload: kg; null is a quarter of the plate.
        damping: N m s/rad; null is 0.1 s/rad times the torque that the motion takes.
        rates: of the plate at the first sample, of which encoders tell nothing, rad/s and m/s; null
            is half the motion's peak to peak per second.
        offsets: of an encoder's mounting, rad; null is 0.1 degrees.
    """

    torque_bias: Positive | None = None
    payload: Positive | None = None
    damping: Positive | None = None
    rates: Annotated[list[Positive], Field(min_length=6, max_length=6)] | None = None
    offsets: Positive | None = None


ESTIMATED: Final = ["torque_bias", "payload", "damping"]
"""Parameters that are estimated by default."""


def _check_estimate(names: list[str]) -> list[str]:
    order = [*ESTIMATED, "coulomb", "offsets"]
    if not (len({*names}) == len(names) and {*names} <= {*order}):
        raise ValueError(f"[], or some of {', '.join(order)}")
    return sorted(names, key=order.index)


def _check_catch_up(duration: float) -> float:
    if 0 < duration < 1e-3:
        raise ValueError("0 for none, null, or at least 0.001 s")
    return duration


Estimate = Annotated[list[str], AfterValidator(_check_estimate)]
"""Names of what is estimated, in a fixed order."""


@dataclass(config=STRICT)
class ControllerConfig:
    """The controller and what it believes.

    Attributes:
        period: between two torques, s.
        integral: whether the error is also integrated.
        delay_steps: whole periods of delay that the controller believes in, 0 for none; null is
            the true delay.
        delay_fraction: the further part of a period that it believes in, less than 1e-9 is 0;
            null is the true one where `delay_steps` is null too, else 0.
        prediction: across the delay, by the `linear` design model or the `nonlinear` dynamics.
        feedforward: `none`, `equilibrium` torque, or `inverse_dynamics` of the reference.
        model: behind gain and prediction, `paper` (massless legs) or `multibody`.
        torque_map: of the paper's model, from `virtual_work` or as `printed`.
        estimate: parameters of the machine that are estimated: `torque_bias`, `payload` and
            `damping`, with or without `coulomb`, the Coulomb friction of the shafts at the
            `coulomb_speed` of the calibration, else 0.02 rad/s, and `offsets`, the mounting of
            encoders, for `sensor.kind` encoders and a known delay; empty for none.
        w_Q: weight of the errors.
        w_R: weight of the torques.
        integral_weight: of the integrals beside the errors, which share w_Q.
        weight_scaling: `bryson` (by what the reference asks for) or `identity`.
        packet_torques: how many torques a packet holds, for the next one and further periods; over
            a network, where `delay_steps` is not 0.
        packet_repeats: how many earlier torques it says again, each for a period more of delay.
        catch_up: blend onto the reference after a start from rest, s; 0 is none, null the shortest
            one that respects `actuator.torque_limit`, where that is a number, else 0.3 s.
        command: what is sent to the motors: a `torque` each, or `cranks`: to servos, crank angles
            and rates of the reference for the instant at which they are reached, and the torque
            that `feedforward` says. With `cranks` nothing is fed back but what `estimate` finds,
            and only period, delay, feedforward, estimate and catch_up count.
        delay_estimator: `none`; or the delay is estimated, beginning with the one that is believed
            in, as `constant`, or as `drifting` with a rate of its own.
        delay_std: of that belief, s.
        delay_max: longest delay that is thought possible, s.
        open_loop_start: whether a start from rest has no feedback before the first own torque can
            have acted.
        replan: duration of a plan back onto the reference, s; 0 for none. With a delay estimator,
            where the prediction is off the reference, as when the delay was found or has jumped.
        prior: standard deviations of what is estimated, a section of its own; null all of them.
        calibration: a file of the machine's parameters with their covariance, as `identify` writes
            it: means and covariance of what is estimated, and the values of what is not. Its delay
            is assumed where `delay_steps` is null.
    """

    renamed = CONTROLLER  # not annotated: no field
    period: Annotated[float, Field(ge=1e-4, le=10)] = 0.1
    integral: bool = True
    delay_steps: Steps | None = None
    delay_fraction: Fraction | None = None
    prediction: Literal["linear", "nonlinear"] = "nonlinear"
    feedforward: Literal["none", "equilibrium", "inverse_dynamics"] = "inverse_dynamics"
    model: Literal["paper", "multibody"] = "multibody"
    torque_map: Literal["virtual_work", "printed"] = "virtual_work"
    estimate: Estimate = field(default_factory=lambda: [*ESTIMATED])
    w_Q: Weight = 1.0
    w_R: Weight = 1.0
    integral_weight: Weight = 1.0
    weight_scaling: Literal["bryson", "identity"] = "bryson"
    packet_torques: Annotated[int, Field(ge=1, le=100)] = 8
    packet_repeats: Annotated[int, Field(ge=0, le=100)] = 1
    catch_up: Annotated[float, Field(ge=0, le=10), AfterValidator(_check_catch_up)] | None = None
    command: Literal["torque", "cranks"] = "torque"
    delay_estimator: Literal["none", "constant", "drifting"] = "none"
    delay_std: Annotated[float, Field(ge=1e-3, le=10)] = 0.3
    delay_max: Annotated[float, Field(gt=0, le=10)] = 1.5
    open_loop_start: bool = True
    replan: Annotated[float, Field(ge=0, le=10)] = 0.6
    prior: PriorConfig = field(default_factory=PriorConfig)
    calibration: Name | None = None


@dataclass(config=STRICT)
class TorqueActuatorConfig:
    """Motors that give the torque that arrives, within their limit.

    Attributes:
        kind: `torque`.
        torque_limit: of each motor, N m; null is the mechanism's `motor.effort_limit`, the text
            `none` no limit. Only a number is also planned with, see `ControllerConfig.catch_up`.
    """

    reflected_inertia = 0.0  # not annotated: no field
    kind: Literal["torque"] = "torque"
    torque_limit: TorqueLimit = None


@dataclass(config=STRICT)
class ServoActuatorConfig:
    """Position servos: a local loop at each motor that follows the crank angle which arrives.

    It puts out J (w^2 (a_r - a) + 2 d w (a_r' - a')) and the torque that came with the angle, at
    least 1000 times a second; w = 2 pi bandwidth, d the damping, J the mean inertia per motor at
    home, that of the rotors included. See `law.servos`.

    Attributes:
        kind: `servo`.
        bandwidth: Hz.
        damping: relative to critical damping, for an inertia of J.
        speed_limit: of the angle that is followed, rad/s; null is none.
        gear_ratio: turns of the rotor per turn of the crank.
        rotor_inertia: about the rotor's axis, kg m^2; at the crank gear_ratio^2 times as much.
        torque_limit: at the crank, as of `TorqueActuatorConfig`.
    """

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


AnyActuator = TorqueActuatorConfig | ServoActuatorConfig
ActuatorConfig = Annotated[AnyActuator, ByKind()]


def compatible_actuator(command: str, actuator: AnyActuator) -> AnyActuator:
    """Motors of the kind that a controller's command is for: these, or others of their limit."""
    wanted = TorqueActuatorConfig if command == "torque" else ServoActuatorConfig
    return actuator if actuator.kind == wanted.kind else wanted(torque_limit=actuator.torque_limit)


def with_actuator(given: dict[str, Any], change: Any, where: str) -> AnyActuator:
    """The motors of a section of a file, and of a row of `compare` that is laid over it.

    Raises:
        ConfigError: in one line, opened by `where`.
    """
    laid = given | change if isinstance(change, dict) else change
    return validate(Scenario, {"actuator": laid}, where).actuator


@dataclass(config=STRICT)
class WireConfig:
    """A link between controller and motors that delays every torque by `delay`, and loses none.

    Attributes:
        kind: `wire`.
    """

    back, burst, acknowledged, follows_delay = None, 1, True, False  # not annotated: no fields
    kind: Literal["wire"] = "wire"


@dataclass(config=STRICT)
class PacketsConfig:
    """How long packets are under way, and how many are lost.

    Attributes:
        distribution: of the time under way, `uniform` from `low` to `high`, or `lognormal`.
        low, high: of the uniform one, s; null otherwise.
        median: of the lognormal one, s; null otherwise.
        sigma: of the lognormal one, standard deviation of its logarithm; null otherwise.
        loss: share of the packets that never arrive.
        burst: number of packets in a row that are lost together.
    """

    distribution: Literal["uniform", "lognormal"] = "uniform"
    low: Seconds | None = None
    high: Seconds | None = None
    median: Positive | None = None
    sigma: Annotated[float, Field(gt=0, le=10)] | None = None
    loss: Annotated[float, Field(ge=0, le=0.99)] = 0.05
    burst: Annotated[int, Field(ge=1, le=1000)] = 1

    def times_problem(self, where: str) -> str | None:
        """Return what is wrong with the times, or None."""
        used = ("low", "high") if self.distribution == "uniform" else ("median", "sigma")
        for name in ("low", "high", "median", "sigma"):
            value = getattr(self, name)
            if (value is None) == (name in used):
                got, expected = ("null", "a number") if name in used else (f"{value:g}", "null")
                return (
                    f"{where}.{name}: got {got} with distribution {self.distribution!r}; "
                    f"expected {expected}"
                )
        if self.low is not None and self.high is not None and self.low > self.high:
            return f"{where}.low: got {self.low:g} s; expected at most high, {self.high:g} s"
        return None


@dataclass(config=STRICT | ConfigDict(populate_by_name=True))
class NetworkConfig(PacketsConfig):
    """Packets of torques with the times at which they shall act, and a buffer at the machine.

    Each packet takes a time of its own, see `PacketsConfig`. Without `low` and `high` a uniform one
    is between 0.8 and 1.2 times the constant delay that `delay` gives, for which nothing else uses
    `delay`; `Scenario.assumed_link` has the numbers. A torque acts at its time, a bound later than
    it was sent. Where no packet has brought one for a period, the buffer is dry. Clocks agree.

    Attributes:
        kind: `network`.
        playout: the bound, s; null is the one that makes late packets as rare as lost ones
            (`scenario.packets.default_bound`). The controller adds its `packet_repeats` periods.
        dry: what a dry buffer does, `hold` the last torque or put out `zero`.
        back: `return` in files, how measurements come back, with times of its own; null is at once
            and all of them.
        acknowledged: whether each measurement tells which packets have arrived and what has acted.
        seed: of times and losses.
    """

    kind: Literal["network"] = "network"
    playout: Seconds | None = None
    dry: Literal["hold", "zero"] = "hold"
    back: PacketsConfig | None = Field(default=None, alias="return")
    acknowledged: bool = True
    seed: Seed = 0

    @property
    def follows_delay(self) -> bool:
        """Whether the times of packets are those of the scenario's delay."""
        return self.distribution == "uniform" and self.low is None and self.high is None


LinkConfig = Annotated[WireConfig | NetworkConfig, ByKind()]
ASSUMED_TIMES: Final = (0.8, 1.2)
"""Shortest and longest time under way, in delays, of a network without `low` and `high`."""


@dataclass(config=STRICT)
class StateSensorConfig:
    """The measurement of pose and rates.

    Attributes:
        kind: `state`.
        noise_std: of [pose; rates], in rad, m, rad/s and m/s.
        delay: between measuring and having the measurement, s; by the next sample after that.
        loss: share of the measurements that are lost.
        seed: of the noise, of spikes and losses; the same seed gives the same run.
        faults: when it measures nothing, the same again, or nonsense; see `fault_config`.
    """

    measures_state, samples = True, None  # not annotated: no fields
    kind: Literal["state"] = "state"
    noise_std: Annotated[list[Deviation], Field(min_length=12, max_length=12)] = field(
        default_factory=lambda: [0.0] * 12
    )
    delay: Annotated[float, Field(ge=0, le=100)] = 0.0
    loss: Annotated[float, Field(ge=0, le=0.99)] = 0.0
    seed: Seed = 0
    faults: list[SensorFault] = field(default_factory=list)

    def problem(self) -> str | None:
        """Return what is wrong with the faults, or None."""
        return fault_problem(self.faults, legs=False)


@dataclass(config=STRICT)
class EncoderSensorConfig:
    """The measurement of the six crank angles, by an encoder at each motor.

    Attributes:
        kind: `encoders`.
        bits: of a turn; null is exact.
        samples: how often each is read per period of the controller, the last time at its sample.
        offset: of each encoder on its shaft, which the controller is not told, rad.
        delay: between measuring and having the measurement, s; by the next sample after that.
        loss: share of the measurements, those of a period each, that are lost.
        seed: of where codes begin, of spikes and losses; the same seed gives the same run.
        faults: when legs measure nothing, the same again, or nonsense; see `fault_config`.
    """

    measures_state = False  # not annotated: no field
    kind: Literal["encoders"] = "encoders"
    bits: Annotated[int, Field(ge=4, le=32)] | None = 14
    samples: Annotated[int, Field(ge=1, le=1000)] = 1
    offset: Six = field(default_factory=lambda: [0.0] * 6)
    delay: Annotated[float, Field(ge=0, le=100)] = 0.0
    loss: Annotated[float, Field(ge=0, le=0.99)] = 0.0
    seed: Seed = 0
    faults: list[SensorFault] = field(default_factory=list)

    def problem(self) -> str | None:
        """Return what is wrong with the faults, or None."""
        return fault_problem(self.faults, legs=True)


SensorConfig = Annotated[StateSensorConfig | EncoderSensorConfig, ByKind()]


@dataclass(config=STRICT)
class FixedTunerConfig:
    """w_Q and w_R stay those of the controller.

    Attributes:
        kind: `fixed`.
    """

    kind: Literal["fixed"] = "fixed"


@dataclass(config=STRICT)
class AnnTunerConfig:
    """A neural network sets w_Q and w_R while the controller runs.

    It starts from the controller's w_Q and w_R and goes back to them where it fails.

    Attributes:
        kind: `ann`.
        weights: the network, a shipped name or a JSON file; null is the shipped `tuner`.
    """

    kind: Literal["ann"] = "ann"
    weights: Name | None = None


@dataclass(config=STRICT)
class RuleTunerConfig:
    """Two lines set w_Q / w_R: a constant while predictions hold, less where they do not.

    log10(w_Q / w_R) = ratio - slope max(0, x - knee), x the logarithm of the last three seconds'
    largest innovation; see `tuner.source.Rule`.

    Attributes:
        kind: `rule`.
        ratio, slope, knee: see above; null is what was found for controllers with an estimator,
            or without one.
    """

    kind: Literal["rule"] = "rule"
    ratio: Annotated[float, Field(ge=-4, le=2)] | None = None
    slope: Annotated[float, Field(ge=0, le=100)] | None = None
    knee: Annotated[float, Field(ge=-6, le=4)] | None = None


TunerConfig = Annotated[FixedTunerConfig | AnnTunerConfig | RuleTunerConfig, ByKind()]


@dataclass(config=STRICT)
class Scenario:
    """One closed-loop experiment; the defaults are the paper's.

    Attributes:
        mechanism: a shipped name or a path.
        duration: of the simulation, s.
        start: `rest` (at the reference's first pose, zero rates) or `on_reference`.
        queue: torques in flight at t = 0: `zero`, `equilibrium`, or `reference` (the inverse
            dynamics of the reference). With servos the cranks of the first pose, or of the
            reference, are in flight too, where the controller sends torques with such torques.
        reference, plant, delay, link, controller, actuator, sensor, tuner: the sections; all but
            plant, delay and controller come in kinds, each a class of its own.
        log_period: of the recorded signals, s; null is every 20 ms and every sample of the
            controller. The multibody plant is seen on its own steps only, so that it must be a
            multiple of `plant.time_step`. What is measured of a run does not depend on it.
        compare: what `compare` lays over each controller last, by its name. Another name is one
            row more, of the shipped or own file that its `controller` says; `actuator` in a row is
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
            from stewart_drake.scenario.packets import (
                default_bound,
            )  # numpy, which --help goes without

            bound = default_bound(link, c.packet_repeats, c.period)
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

    def _delay_problem(self) -> str | None:
        c = self.controller
        if c.delay_estimator == "none" or (c.delay_steps is None and c.calibration is not None):
            return None  # what is known may say a delay, see `loop.preparation`
        if c.delay_steps is None:
            return self.delay_max_problem(self.true_delay)
        return self.delay_max_problem(Delay(c.delay_steps, c.delay_fraction or 0.0))

    def delay_max_problem(self, believed: Delay) -> str | None:
        """Return what is wrong with the longest delay that an estimator thinks possible, or None.

        Args:
            believed: the delay that the controller assumes at first.
        """
        c = self.controller
        if c.delay_estimator == "none" or believed.eta(c.period) <= c.delay_max:
            return None
        return (
            f"controller.delay_max: got {c.delay_max:g} s, less than the "
            f"{believed.eta(c.period):g} s that are believed in; expected as much or more"
        )

    def _times_problem(self, link: NetworkConfig) -> str | None:
        """Return what is wrong with the times of packets, or None."""
        if not link.follows_delay:
            return link.times_problem("link")
        nothing = self.delay.steps + self.delay.fraction == 0
        if self.delay.constant and not nothing:
            return dataclasses.replace(link, low=0.0, high=0.0).times_problem("link")
        return (
            f"link.low: got null with a delay that is {'0' if nothing else 'not constant'}; "
            "expected link.low and link.high in s, or a constant delay, of which they are then "
            f"{ASSUMED_TIMES[0]:g} and {ASSUMED_TIMES[1]:g} times"
        )

    def _network_problem(self) -> str | None:
        """Return what is wrong with a network and with what is believed of it, or None."""
        link = self.link
        if link.kind == "wire":
            return None
        back = link.back.times_problem("link.return") if link.back else None
        if problem := self._times_problem(link) or back:
            return problem
        if self.true_delay.steps <= MOST_PERIODS:
            return None
        bound = "null" if link.playout is None else f"{link.playout:g} s"
        return (
            f"link.playout: got {bound}, with which torques wait for more than {MOST_PERIODS} "
            "periods; expected a shorter one, or a quicker network"
        )

    def check(self, where: str = "scenario") -> None:
        """Checks every field again, and everything that takes several of them.

        Args:
            where: what the scenario is, opening the message.

        Raises:
            ConfigError: the first problem, in one line.
        """
        # Assignment is validated, but a list can also be changed in place.
        validate(Scenario, dataclasses.asdict(self), where)
        self.check_rows(where)
        step = self.plant.step
        problem = (
            self.reference.problem()
            or contradiction(self)
            or self.sensor.problem()
            or self._network_problem()
            or self._delay_problem()
            or (self.step_problem(step) if step else log_problem(self.log_period, self.duration))
        )
        if problem:
            raise ConfigError(f"{where}: {problem}")

    def check_rows(self, where: str) -> None:
        """Checks what `compare` says, each row by itself.

        Raises:
            ConfigError: the first problem, in one line, opened by `where`.
        """
        for row, change in self.compare.items():
            place, fields = f"{where}: compare.{row}", dict(change)
            if "/" in row:
                raise ConfigError(f"{place}: names its signals' file; expected no slash")
            controller = fields.pop("controller", row)
            if not isinstance(controller, str):
                raise ConfigError(f"{place}: controller: got {brief(controller)}; expected text")
            with_actuator({"kind": "servo"}, fields.pop("actuator", {}), place)  # has every field
            validate(ControllerConfig, fields, place)

    def step_problem(self, step: float) -> str | None:
        """Return what does not fit a discrete plant with steps of `step` s, or None."""
        period, link, sensor = self.controller.period, self.link, self.sensor
        fraction, bound, samples = self.delay.fraction, None, None
        if link.kind == "network":
            fraction = 0.0
            bound = link.playout and whole_problem("link.playout", link.playout, step)
        if sensor.samples is not None:
            samples = samples_problem(sensor.samples, period, step)
        logged = log_problem(self.log_period, self.duration, step)
        return samples or step_problem(step, period, fraction) or bound or logged
