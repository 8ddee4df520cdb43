"""Options of all studies, and measurements of a new machine; nothing heavy is imported here."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import one_message, rule, units_of, validate, validate_pairs
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.dependencies import differing
from stewart_drake.scenario.field_types import STRICT
from stewart_drake.studies.options import JobOptions, Options, option

_TORQUE_SHARE: Final = "share of the reference's largest torque"
_CRANK_SHARE: Final = "share of the mean crank length"


def _share(unit: str, **bounds: Any) -> Any:
    return Field(ge=0, description=unit, **bounds)


@dataclass(config=STRICT)
class Ranges:
    """Size of the variation of each quantity; 0 (null for `torque_limit`) switches it off.

    Only the torque limit and the noise of the sensor are known to the controller. The unit of each
    number is in `RANGE_UNITS`.
    """

    # mass at the plate's centre of mass, uniform in +-
    payload: Annotated[float, _share("+-share of the plate's mass", lt=1)] = 0.1
    # rms over the motors, uniform from 0; its direction in the space of the six motors is random
    torque_bias: Annotated[float, _share(_TORQUE_SHARE)] = 0.02
    # standard deviation of the measured pose (rates: per second), uniform from 0
    noise: Annotated[float, _share("share of half the reference's peak to peak")] = 1e-3
    # least and largest limit of the motors, uniform. The limit of the undisturbed run (the
    # scenario's, or that of the mechanism's motors) is never exceeded.
    torque_limit: Annotated[
        Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=2, max_length=2)] | None,
        Field(description="[least, most] in peak torques of the undisturbed run"),
        rule(lambda pair: not pair or pair[0] <= pair[1], "the lesser one first"),
    ] = field(default_factory=lambda: [1.0, 3.0])
    # friction torque of a crank, uniform from 0
    damping: Annotated[float, _share(f"{_TORQUE_SHARE}, at its largest crank speed")] = 0.02
    # true minus believed delay, uniform in +-; over a wire
    delay: Annotated[float, _share("+-periods of the controller", le=100)] = 0.01
    # the same in whole periods, uniform in +-; adds to `delay`
    delay_steps: Annotated[int, _share("+-whole periods", le=100)] = 0
    # error of crank and rod lengths, rms over the twelve, uniform from 0
    lengths: Annotated[float, _share(_CRANK_SHARE, lt=1)] = 2e-4
    # error of the coordinates of motor shafts and plate joints, rms over the 36, uniform from 0
    anchors: Annotated[float, _share(_CRANK_SHARE, lt=1)] = 2e-4
    # Coulomb friction of a crank, uniform from 0
    coulomb: Annotated[float, _share(_TORQUE_SHARE)] = 0.0
    # error of the coordinates of the payload, rms over the three, uniform from 0; without effect on
    # a plate without payload
    payload_position: Annotated[float, _share(_CRANK_SHARE)] = 0.0
    # standard deviation of the delay from torque to torque, uniform from 0; over a wire
    jitter: Annotated[float, _share("periods of the controller", le=1)] = 0.0
    # share of the measurements that are lost, uniform from 0; over a network of packets
    loss: Annotated[float, _share("share of measurements, of packets over a network", lt=0.99)] = (
        0.0
    )
    # true over believed torque of all motors less 1, uniform in +-; not of servos
    gain: Annotated[float, _share("+-share of the motors' torque", lt=1)] = 0.0


RANGE_UNITS: Final = units_of(Ranges)
_DEFAULTS: Final = asdict(Ranges())


class DelayOptions(Options):
    simulations: Annotated[
        bool, Field(description="Whether to simulate over delay and amplitude too, on all cores.")
    ] = True


class LearnOptions(Options):
    repetitions: int = option(6, "Largest number of repetitions.", "N", ge=1, le=1000)

    def check_scenario(self, scenario: Scenario) -> None:
        if found := differing(scenario, {"link.kind": "wire"}):
            raise ConfigError(
                found.problem(
                    "for learning",
                    ", with a delay.steps that covers the round trip; over a network `live "
                    "--learn` measures the link itself",
                )
            )


class LinkOptions(Options):
    runs: int = option(5, "Number of seeds for each bound and loss.", "N", ge=1, le=10_000)

    def check_scenario(self, scenario: Scenario) -> None:
        if scenario.link.kind != "network":
            raise ConfigError(
                f"link.kind: got {scenario.link.kind!r}; expected 'network', which has a play-out "
                "bound, as by --set link.kind=network"
            )


def _read_also(names: list[str], load: Callable[[str], Scenario]) -> dict[str, Scenario]:
    others = {Path(name).stem: name for name in names}
    if len(others) < len(names):
        raise ConfigError(
            f"--also: got two of one name, {', '.join(names)}; expected each but once"
        )
    return {key: load(name) for key, name in others.items()}


class RobustnessOptions(JobOptions):
    ranges: Annotated[
        Ranges | Mapping[str, Any] | None, one_message("a mapping of sizes by name")
    ] = option(
        None,
        "Size of a variation, 0: none; in brackets the default. "
        + "; ".join(f"{name}: {unit} ({_DEFAULTS[name]})" for name, unit in RANGE_UNITS.items())
        + ". torque_limit takes null too: as the scenario has it.",
        "NAME=VALUE",
        name="vary",
        read=lambda texts, _: validate_pairs(Ranges, texts, "--vary"),
    )
    runs: int = option(200, "Number of machines.", "N", ge=1, le=100_000)
    seed: int = option(0, "Random seed.", ge=0)
    limit: float | None = option(
        None, "E_ac above which a run counts as failed, % s.", "E_AC", gt=0
    )
    also: Mapping[str, Scenario] | None = option(
        None,
        "Run the same machines with this controller too, such as adaptive_lqi, "
        "which finds the delay.",
        "CONTROLLER",
        read=_read_also,
    )

    @property
    def sizes(self) -> Ranges:
        given = self.ranges or {}
        return validate(Ranges, given, "ranges") if isinstance(given, Mapping) else given


def _numbers(option: str, form: str, texts: list[str], most: int) -> dict[str, list[float]]:
    """Return the numbers of texts such as `NAME=LOW:HIGH`, at most `most` in each."""
    found = {}
    for text in texts:
        name, _, values = text.partition("=")
        try:
            found[name.strip()] = [float(value) for value in values.split(":", most - 1)]
        except ValueError:
            raise ConfigError(
                f"--{option}: got {text!r}; expected {form}, numbers without units"
            ) from None
    return found


def _read_limits(texts: list[str], _: object) -> dict[str, float]:
    return {name: value for name, (value,) in _numbers("limit", "NAME=VALUE", texts, 1).items()}


def _read_bounds(texts: list[str], _: object) -> dict[str, tuple[float, float]]:
    found = _numbers("vary", "NAME=LOW:HIGH or NAME=VALUE", texts, 2)
    return {name: (ends[0], ends[-1]) for name, ends in found.items()}


def _pairs(bounds: Any) -> Any:
    """Return bounds with a pair in place of each number."""
    if not isinstance(bounds, Mapping):
        return bounds
    return {k: (v, v) if isinstance(v, int | float) else v for k, v in bounds.items()}


class LayoutOptions(JobOptions):
    goal: str = option(
        "condition",
        "Goal of the search: condition, torque, reach, clearance, "
        "transmission, plate_joint_deg or crank_joint_deg.",
        "NAME",
    )
    limits: Mapping[str, float] | None = option(
        None,
        "Least (reach, clearance, transmission) or largest value, SI units.",
        "NAME=VALUE",
        name="limit",
        read=_read_limits,
    )
    vary: Annotated[Mapping[str, tuple[float, float]] | None, BeforeValidator(_pairs)] = option(
        None,
        "Bounds of a number of the pattern, or of crank or rod; one value fixes it.",
        "NAME=LOW:HIGH",
        read=_read_bounds,
    )
    keep: Sequence[str] = option(
        (), "Number to keep, or branches or plate_order.", "NAME", read=lambda texts, _: texts
    )
    best: int = option(3, "Number of machines to write.", "N", ge=1)
    starts: int = option(1, "Number of searches per arrangement of legs.", "N", ge=1)
    generations: int = option(100, "Largest number of generations of a search.", "N", ge=1)
    seed: int = option(0, "Random seed.", ge=0)


LARGEST: Final = 5.0
"""Largest length in m; above, millimetres were probably meant."""
STEEL: Final = 7850.0
"""kg/m^3; a part heavier than a solid disc of its size was probably given in grams."""
_Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Mass = Annotated[float, Field(gt=0, lt=1e6)]


class Measurements(Options):
    """Measurements of a machine with a ruler and scales, in m, kg, s, N m, or as `300 mm`."""

    base_radius: _Length = option(..., "Radius of the circle of the motor shafts, m.", unit="m")
    shaft_distance: _Length = option(..., "Distance of the two shafts of a pair, m.", unit="m")
    plate_radius: _Length = option(..., "Radius of the circle of the plate's joints, m.", unit="m")
    joint_distance: _Length = option(
        ..., "Distance of two neighbouring joints of the plate, m.", unit="m"
    )
    crank: _Length = option(..., "Crank, from shaft to rod, m.", unit="m")
    rod: _Length = option(..., "Rod, from joint to joint, m.", unit="m")
    plate_mass: _Mass = option(..., "Mass of the plate with its load, kg.", unit="kg")
    crank_mass: _Mass = option(..., "Mass of a crank, kg.", unit="kg")
    rod_mass: _Mass = option(..., "Mass of a rod, kg.", unit="kg")
    shaft_height: float = option(0.0, "Height of the shafts, m.", unit="m", ge=-LARGEST, le=LARGEST)
    upright: float = option(
        90.0, "Degrees from the horizon of the planes the cranks turn in.", ge=-180, le=180
    )
    cranks: Literal["apart", "together"] = option(
        "apart", "Cranks of a pair point apart, or together."
    )
    torque_limit: float | None = option(
        None, "Torque limit of each motor, N m.", unit="N m", gt=0, lt=1e6
    )
    delay: float = option(
        0.1,
        "Time from a measurement until the torque computed from it acts, s; over a radio the "
        "longest round trip, a period, and computing.",
        unit="s",
        ge=0,
        le=5,
    )
    gravity: bool = option(True, "Gravity acts; not on a counterbalanced plate.")

    def __init__(self, **values: object) -> None:
        super().__init__(**values)
        for one in self.described():
            if one.unit == "m" and (value := getattr(self, one.name)) > LARGEST:
                raise ConfigError(
                    f"{one.name}: got {value:g} m; expected metres, {value / 1000:g} for "
                    f"{value:g} mm"
                )
        if self.rod <= self.crank:
            raise ConfigError(
                f"rod: got {self.rod:g} m with cranks of {self.crank:g} m; expected a rod longer "
                "than its crank"
            )
        for name, size in (("plate", self.plate_radius), ("crank", self.crank), ("rod", self.rod)):
            mass = getattr(self, f"{name}_mass")
            if mass > STEEL * math.pi * size**3:
                raise ConfigError(
                    f"{name}_mass: got {mass:g} kg; expected kilograms, {mass / 1000:g} for "
                    f"{mass:g} g"
                )
        for name, radius in (("shaft", self.base_radius), ("joint", self.plate_radius)):
            distance = getattr(self, f"{name}_distance")
            if distance >= math.sqrt(3) * radius:
                raise ConfigError(
                    f"{name}_distance: got {distance:g} m on a circle of radius {radius:g} m; "
                    f"expected less than {math.sqrt(3) * radius:.4g}, where pairs meet"
                )
