"""The scenario: one plain dataclass per section, with units, defaults and ranges.

A field is checked alone when it is set; `Scenario.check` checks what several fields share. Nothing
here needs a mechanism. `scenario_loading` reads scenarios from files.
"""

import dataclasses
import math
from dataclasses import field
from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.errors import ConfigError
from stewart_drake.timing import METRIC_PERIOD, step_problem
from stewart_drake.yamlio import brief, validate

KIND_FIELDS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "reference": {
        "sine": ("amplitude", "offset", "frequency", "frequency_unit"),
        "hold": ("offset",),
        "waypoints": ("times", "poses", "file"),
        "csv": ("file",),
    },
    "tuner": {"fixed": (), "ann": ("weights",)},
}
"""Section -> kind -> the fields that mean something for this kind, beside `kind` itself."""

_STRICT: Final = ConfigDict(
    extra="forbid", strict=True, allow_inf_nan=False, validate_assignment=True
)

# Limits far beyond any platform keep squares and products of what a file says finite.
Positive = Annotated[float, Field(gt=0, le=1e6)]
Weight = Annotated[float, Field(gt=0, le=1e12)]
Seconds = Annotated[float, Field(ge=0, le=1e5)]
Deviation = Annotated[float, Field(ge=0, le=1e3)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Steps = Annotated[int, Field(ge=0, le=1000)]
Row = Annotated[list[float], Field(min_length=6, max_length=6)]
Six = Annotated[list[Annotated[float, Field(ge=-1e3, le=1e3)]], Field(min_length=6, max_length=6)]
Name = Annotated[str, Field(min_length=1)]


@dataclass(config=_STRICT)
class ReferenceConfig:
    """The motion that the plate is asked to follow.

    Attributes:
        kind: `sine`, `hold` (one constant pose), `waypoints` (a smooth motion through poses, at
            rest in the first and the last) or `csv` (a sampled motion).
        amplitude: of the sine, [roll, pitch, yaw, x, y, z] in rad and m.
        offset: of the sine, or the pose to hold, rad and m.
        frequency: of the sine, in `frequency_unit`.
        frequency_unit: `rad/s` or `Hz`.
        times: of the waypoints, s, increasing.
        poses: of the waypoints, one [roll, pitch, yaw, x, y, z] per time, rad and m.
        file: for `csv`, a file of time and six columns; for `waypoints`, a YAML file of `times`
            and `poses`.
    """

    kind: Literal["sine", "hold", "waypoints", "csv"] = "sine"
    amplitude: Six = field(
        default_factory=lambda: [0.2617993878, 0.2617993878, 0.2617993878, 0.02, 0.02, 0.08]
    )
    offset: Six = field(default_factory=lambda: [0.0, 0.0, 0.0, 0.0, 0.0, 0.38])
    frequency: Annotated[float, Field(gt=0, le=1e4)] = 1.0
    frequency_unit: Literal["rad/s", "Hz"] = "rad/s"
    times: Annotated[list[Seconds], Field(min_length=2)] | None = None
    poses: Annotated[list[Row], Field(min_length=2)] | None = None
    file: Name | None = None


@dataclass(config=_STRICT)
class PlantConfig:
    """The simulated platform; the controller is not told the last three fields.

    Attributes:
        kind: `multibody` (MultibodyPlant with constraints, fixed steps) or `exact` (closed-form
            dynamics, error-controlled integration).
        gravity: whether gravity acts; false stands for a counterbalanced platform.
        time_step: of the multibody plant, s.
        accuracy: of the exact plant's integrator, relative, 1e-12 to 1e-2.
        payload_mass: a point mass at the plate's centre of mass, kg.
        torque_bias: added to each motor's torque, N m.
        joint_damping: viscous damping on each crank shaft, N m s/rad.
    """

    kind: Literal["multibody", "exact"] = "multibody"
    gravity: bool = False
    time_step: Annotated[float, Field(ge=1e-6, le=METRIC_PERIOD)] = 0.001
    accuracy: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-8
    payload_mass: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    torque_bias: Six = field(default_factory=lambda: [0.0] * 6)
    joint_damping: Annotated[float, Field(ge=0, le=1e3)] = 0.0


@dataclass(config=_STRICT)
class DelayConfig:
    """The true delay between computing a torque and feeling it.

    Attributes:
        steps: whole controller periods.
        fraction: a further part of one period, 0 to below 1.
    """

    steps: Steps = 8
    fraction: Fraction = 0.0


@dataclass(config=_STRICT)
class ControllerConfig:
    """The controller and what it believes.

    Attributes:
        period: between two torques, s.
        integral: whether the error is also integrated.
        delay_steps: whole periods of delay that the controller believes in, 0 for none; null is
            the true delay.
        delay_fraction: the further part of a period that it believes in; null is the true one
            where `delay_steps` is null too, else 0.
        prediction: across the delay, by the `linear` design model or the `nonlinear` dynamics.
        feedforward: `none`, `equilibrium` torque, or `inverse_dynamics` of the reference.
        model: behind gain and prediction, `paper` (massless legs) or `multibody`.
        torque_map: of the paper's model, from `virtual_work` or as `printed`.
        estimator: `none`, or `parameters` (torque bias, payload and damping).
        w_Q: weight of the errors.
        w_R: weight of the torques.
        weight_scaling: `bryson` (errors and torques by what the reference asks for) or
            `identity`.
        catch_up: blend onto the reference after a start from rest, s; null is the shortest one
            that respects the torque limit, 0 is none.
    """

    period: Annotated[float, Field(ge=1e-4, le=10)] = 0.1
    integral: bool = True
    delay_steps: Steps | None = None
    delay_fraction: Fraction | None = None
    prediction: Literal["linear", "nonlinear"] = "nonlinear"
    feedforward: Literal["none", "equilibrium", "inverse_dynamics"] = "inverse_dynamics"
    model: Literal["paper", "multibody"] = "multibody"
    torque_map: Literal["virtual_work", "printed"] = "virtual_work"
    estimator: Literal["none", "parameters"] = "parameters"
    w_Q: Weight = 1.0
    w_R: Weight = 1.0
    weight_scaling: Literal["bryson", "identity"] = "bryson"
    catch_up: Annotated[float, Field(ge=0, le=10)] | None = None


@dataclass(config=_STRICT)
class ActuatorConfig:
    """The motors.

    Attributes:
        torque_limit: of each motor, N m; null is none.
    """

    torque_limit: Positive | None = None


@dataclass(config=_STRICT)
class SensorConfig:
    """The measurement of pose and rates.

    Attributes:
        noise_std: of [pose; rates], in rad, m, rad/s and m/s.
        seed: of the noise; the same seed gives the same run.
    """

    noise_std: Annotated[list[Deviation], Field(min_length=12, max_length=12)] = field(
        default_factory=lambda: [0.0] * 12
    )
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0


@dataclass(config=_STRICT)
class TunerConfig:
    """Who sets w_Q and w_R while the controller runs.

    Attributes:
        kind: `fixed` (nobody) or `ann` (a neural network, which starts from the controller's w_Q
            and w_R and goes back to them where it fails).
        weights: the network, a shipped name or a JSON file; null is the shipped `tuner`.
    """

    kind: Literal["fixed", "ann"] = "fixed"
    weights: Name | None = None


@dataclass(config=_STRICT)
class Scenario:
    """One closed-loop experiment; the defaults are the paper's.

    Attributes:
        mechanism: a shipped name or a path.
        duration: of the simulation, s.
        start: `rest` (at the reference's first pose, zero rates) or `on_reference`.
        queue: torques in flight at t = 0: `zero`, `equilibrium`, or `reference` (the inverse
            dynamics of the reference).
        reference, plant, delay, controller, actuator, sensor, tuner: the sections.
    """

    mechanism: Name = "paper"
    duration: Annotated[float, Field(gt=0, le=1e5)] = 10.0
    start: Literal["rest", "on_reference"] = "rest"
    queue: Literal["zero", "equilibrium", "reference"] = "zero"
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)
    plant: PlantConfig = field(default_factory=PlantConfig)
    delay: DelayConfig = field(default_factory=DelayConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    actuator: ActuatorConfig = field(default_factory=ActuatorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    tuner: TunerConfig = field(default_factory=TunerConfig)

    def check(self, where: str = "scenario") -> None:
        """Checks every field again, and everything that takes several of them.

        Args:
            where: what the scenario is, opening the message.

        Raises:
            ConfigError: the first problem, in one line.
        """
        # Assignment is validated, but a list can also be changed in place.
        validate(Scenario, dataclasses.asdict(self), where)
        for problem in (
            _reference_problem(self.reference),
            _controller_problem(self.controller),
            self._step_problem(),
        ):
            if problem:
                raise ConfigError(f"{where}: {problem}")

    def _step_problem(self) -> str | None:
        if self.plant.kind != "multibody":
            return None
        return step_problem(self.plant.time_step, self.controller.period, self.delay.fraction)


def _reference_problem(reference: ReferenceConfig) -> str | None:
    if reference.kind in ("sine", "hold"):
        swing = abs(reference.amplitude[1]) if reference.kind == "sine" else 0.0
        largest = swing + abs(reference.offset[1])
        if largest >= math.pi / 2:
            return (
                f"reference.offset: the pitch reaches {largest:.4g} rad; expected |offset| + "
                "|amplitude| of pitch below pi/2, where roll and yaw stay distinct"
            )
    elif reference.kind == "csv":
        if reference.file is None:
            return "reference.file: got None; expected the CSV file that kind csv reads"
    elif reference.file is not None:
        if reference.times is not None or reference.poses is not None:
            return "reference.file: got both a file and times or poses; expected one of the two"
    elif reference.times is None or reference.poses is None:
        missing = "times" if reference.times is None else "poses"
        return f"reference.{missing}: got None; expected times and poses, or a file"
    elif len(reference.times) != len(reference.poses):
        return (
            f"reference.poses: got {len(reference.poses)} poses; expected "
            f"{len(reference.times)}, one per time"
        )
    return None


def _controller_problem(controller: ControllerConfig) -> str | None:
    if controller.delay_fraction is not None and controller.delay_steps is None:
        return (
            f"controller.delay_fraction: got {brief(controller.delay_fraction)} without "
            "delay_steps; expected both or neither"
        )
    if controller.catch_up is not None and 0 < controller.catch_up < 1e-3:
        return (
            f"controller.catch_up: got {controller.catch_up!r}; expected 0 for none, null, or at "
            "least 0.001 s"
        )
    if controller.torque_map == "printed" and controller.model != "paper":
        return (
            "controller.torque_map: got 'printed' with model 'multibody'; expected "
            "'virtual_work', or model 'paper'"
        )
    return None
