"""Unknown quantities of a machine: their draws, their effect, and runs with them.

A quantity has a function that draws it, one that applies it, and a unit; a model is a table of
quantities by name. The table's order is that of the random numbers, so that a new quantity goes to
its end and leaves all other draws as they were. A draw adds to the values of the scenario. All
scales are those of the machine and its motion, so that the same shares suit any mechanism.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.random import Generator

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import validate
from stewart_drake.law.startup import INSTANTS
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.preparation import Experiment, motion_scale, simulated_machine
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.mechanism.trajectories import make_reference, peak_to_peak, spread_instants
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import NUM_LEGS, NUM_TORQUES
from stewart_drake.studies.runs import Outcome, outcome_of, run_file
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.workspace import rms, size_motors

Draw = dict[str, Any]
"""Values by name of the quantity, SI units: a number, a tuple of them, or None. An empty draw
changes nothing."""


@dataclass
class Variant:
    """Scenario and machine with a draw applied; the controller's belief stays."""

    scenario: Scenario  # without the draw
    mechanism: Mechanism  # without the draw
    fields: dict[str, Any]  # of the scenario with the draw
    # fields of the mechanism that the draw changes
    parts: dict[str, Any] = dataclasses.field(default_factory=dict)

    def as_scenario(self) -> Scenario:
        return validate(Scenario, self.fields, "drawn")

    def machine(self) -> Mechanism:
        """Return the machine with the draw, if its parts can be assembled at home."""
        return dataclasses.replace(self.mechanism, **self.parts) if self.parts else self.mechanism


class Quantity(NamedTuple):
    # function of random numbers and the context of its model. It takes the same number of random
    # numbers for any range, so that a narrower range leaves other draws unchanged.
    draw: Callable[[Generator, Any], Any]
    apply: Callable[[Variant, Any], None]  # changes `fields` or `parts` of a variant
    unit: str = ""  # in results; empty for a quantity that is not reported
    per_unit: float = 1.0  # number of units in one of SI
    signed: bool = False  # whether the sign matters
    sometimes: bool = False  # whether it is absent, 0, in half of the draws
    optional: bool = False  # whether it is reported only if it is drawn at all
    title: str = ""  # for readers

    def in_unit(self, value: Any) -> float:
        """Return the value in its unit: the rms of several numbers, infinite for None."""
        if value is None:
            return math.inf
        return self.per_unit * (rms(np.array(value)) if isinstance(value, tuple) else value)


Model = Mapping[str, Quantity]


def draw_from(model: Model, rng: Generator, about: Any) -> Draw:
    """Draw all quantities of a model in the context `about`."""
    some = [name for name, quantity in model.items() if quantity.sometimes]
    present = dict(zip(some, rng.integers(2, size=len(some)), strict=True)) if some else {}
    one: Draw = {}
    for name, quantity in model.items():
        value = quantity.draw(rng, about)
        if name in present:
            times = present[name]
            several = isinstance(value, tuple)
            value = tuple(float(times * x) for x in value) if several else float(times * value)
        one[name] = value
    return one


def apply_draw(model: Model, scenario: Scenario, mechanism: Mechanism, one: Draw) -> Variant:
    variant = Variant(scenario, mechanism, dataclasses.asdict(scenario))
    for name, value in one.items():
        model[name].apply(variant, value)
    return variant


# ---------------------------------------------------------------- effects


def add_to(section: str, field: str) -> Callable[[Variant, Any], None]:
    """Return a function that adds a number, or several, to a field of the scenario."""

    def apply(variant: Variant, value: Any) -> None:
        fields = variant.fields[section]
        if isinstance(value, tuple):
            fields[field] = [a + b for a, b in zip(fields[field], value, strict=True)]
        else:
            fields[field] += value

    return apply


def add_payload(variant: Variant, mass: float) -> None:
    """Add kg at the plate's centre of mass; a mass below the payload is taken off the plate."""
    plant, plate = variant.fields["plant"], variant.mechanism.plate
    total = plant["payload_mass"] + mass
    plant["payload_mass"] = max(0.0, total)
    if total < 0:
        variant.parts["plate"] = Body(plate.mass + total, plate.inertia)


def add_noise(variant: Variant, share: float) -> None:
    """Add noise; its standard deviation is a share of half the reference's peak to peak.

    The only noise of encoders is that of their codes.
    """
    if share != 0 and variant.scenario.sensor.kind == "state":
        sc, reference = variant.scenario, variant.scenario.reference
        if (fields := variant.fields["reference"]) != dataclasses.asdict(reference):
            whole = dataclasses.asdict(sc) | {"reference": fields}
            reference = validate(Scenario, whole, "drawn").reference
        span = peak_to_peak(reference, make_reference(reference, sc.duration), sc.duration)
        motion = motion_scale(span, load_mechanism(sc.mechanism))
        sensor = variant.fields["sensor"]
        std = np.array(sensor["noise_std"]) + share * np.tile(motion, 2)
        sensor["noise_std"] = std.tolist()


def seed_noise(variant: Variant, seed: int) -> None:
    """Set the seed of drawn noise, or of the phases of encoders; else a sensor keeps its seed."""
    fields, sensor = variant.fields["sensor"], variant.scenario.sensor
    if sensor.kind != "state" or fields["noise_std"] != sensor.noise_std:
        fields["seed"] = seed


def draw_seed(rng: Generator, _: Any) -> int:
    return int(rng.integers(2**31))


def _over_network(variant: Variant) -> bool:
    return variant.scenario.link.kind == "network"


def _add_jitter(variant: Variant, std: float) -> None:
    if not _over_network(variant):
        variant.fields["delay"]["jitter_std"] += std


def _lose(variant: Variant, share: float) -> None:
    """Lose a share of the packets of a network, or of the measurements, that arrive."""
    section = variant.fields["link" if _over_network(variant) else "sensor"]
    section["loss"] += share * (1 - section["loss"])


def _seed_link(variant: Variant, seed: int) -> None:
    """Set the seed of drawn jitter and losses; an unchanged link keeps its seed."""
    for section, field in (("delay", "jitter_std"), ("link", "loss"), ("sensor", "loss")):
        own = getattr(getattr(variant.scenario, section), field, None)
        if variant.fields[section].get(field) != own:
            variant.fields[section]["seed"] = seed


def _limit_torque(variant: Variant, limit: float | None) -> None:
    if limit is not None:
        variant.fields["actuator"]["torque_limit"] = limit


def _add_delay(variant: Variant, late: float) -> None:
    """Add a delay in s that is unknown to the controller; over a network the buffer sets it."""
    if _over_network(variant):
        return
    sc, believed = variant.scenario, believed_delay(variant.scenario)
    fraction = sc.delay.fraction + late / sc.controller.period
    whole = math.floor(fraction + 1e-9)
    variant.fields["delay"] |= {
        "steps": sc.delay.steps + whole,
        "fraction": round(max(0.0, fraction - whole), 12),
    }
    belief = {"delay_steps": believed.steps, "delay_fraction": believed.fraction}
    variant.fields["controller"] |= belief


def _add_to_machine(*names: str) -> Callable[[Variant, tuple[float, ...]], None]:
    """Return a function that adds errors to arrays of the mechanism, one after the other."""

    def apply(variant: Variant, errors: tuple[float, ...]) -> None:
        if any(errors):
            arrays = [getattr(variant.mechanism, name) for name in names]
            split = np.reshape(errors, (len(names), *arrays[0].shape))
            variant.parts |= {n: a + e for n, a, e in zip(names, arrays, split, strict=True)}

    return apply


def _strengthen(variant: Variant, share: float) -> None:
    """Multiply the motors' torques by g = 1 + share: M a + c = g T + F is (M a + c - F) / g = T."""
    if share == 0:
        return
    g, plant, machine = 1 + share, variant.fields["plant"], variant.machine()
    for name in ("plate", "crank", "rod"):
        body = getattr(machine, name)
        lighter = {"mass": body.mass / g, "inertia": body.inertia / g}
        variant.parts[name] = dataclasses.replace(body, **lighter)
    frictions = ("joint_damping", "coulomb_friction", "ball_joint_damping", "ball_joint_friction")
    for name in ("payload_mass", *frictions):
        plant[name] /= g
    plant["torque_bias"] = [one / g for one in plant["torque_bias"]]
    plant["push"]["wrench"] = [one / g for one in plant["push"]["wrench"]]


# ---------------------------------------------------------------- the unknown machine


class Scales(NamedTuple):
    """Scales of the drawn shares, SI units."""

    plate_mass: float  # kg
    motion: tuple[float, ...]  # (6,) half the reference's peak to peak, rad and m
    torque: float  # largest on the reference, N m
    speed: float  # largest crank rate on the reference, rad/s
    crank: float  # mean length, m
    period: float  # of the controller, s
    commanded: float  # largest torque that the undisturbed run commands, N m
    torque_limit: float = math.inf  # that of the undisturbed run, N m, infinite for none


class About(NamedTuple):
    ranges: Ranges
    scales: Scales
    scenario: Scenario


def scales_of(experiment: Experiment, commanded: float) -> Scales:
    """Return the scales of an experiment whose undisturbed run commands up to `commanded` N m."""
    sc = experiment.scenario
    times = spread_instants(sc.duration, INSTANTS)
    sizing = size_motors(experiment.nominal, experiment.reference, times)
    return Scales(
        plate_mass=experiment.mechanism.plate.mass,
        motion=tuple(experiment.motion_scale.tolist()),
        torque=float(np.abs(sizing.torque).max()),
        speed=float(np.abs(sizing.speed).max()),
        crank=float(experiment.mechanism.crank_lengths.mean()),
        period=sc.controller.period,
        commanded=commanded,
        torque_limit=experiment.torque_limit,
    )


def draw(ranges: Ranges, scales: Scales, scenario: Scenario, seed: int, index: int) -> Draw:
    """Draw the machine with this index; it does not depend on any other, nor on their number."""
    rng = Generator(np.random.Philox(np.random.SeedSequence([seed, index])))
    return draw_from(MACHINE, rng, About(ranges, scales, scenario))


def _vector(name: str, scale: str, number: int) -> Callable[[Generator, About], tuple[float, ...]]:
    """Return a draw of values with an rms uniform from 0 to the range, in a uniform direction."""

    def draw(rng: Generator, about: About) -> tuple[float, ...]:
        largest = getattr(about.ranges, name) * getattr(about.scales, scale)
        size, direction = largest * rng.uniform(), rng.standard_normal(number)
        return tuple((size * np.sqrt(number) / np.linalg.norm(direction) * direction).tolist())

    return draw


def _number(name: str, scale: str = "", low: float = 0.0) -> Callable[[Generator, About], float]:
    """Return a draw of a number, uniform from `low` (0 or -1) to 1 times the range."""

    def draw(rng: Generator, about: About) -> float:
        largest = getattr(about.ranges, name) * (getattr(about.scales, scale) if scale else 1.0)
        return float(largest * rng.uniform(low, 1))

    return draw


def _draw_limit(rng: Generator, about: About) -> float | None:
    strength, scales, own = rng.uniform(), about.scales, about.scenario.actuator.torque_limit
    # If the undisturbed run takes no torque, as at rest without gravity, a limit has no scale.
    if about.ranges.torque_limit is None or scales.commanded == 0:
        return own if isinstance(own, float) else None
    low, high = about.ranges.torque_limit
    return min(scales.commanded * (low + (high - low) * strength), scales.torque_limit)


def _draw_damping(rng: Generator, about: About) -> float:
    damping, s = about.ranges.damping * rng.uniform(), about.scales
    # A reference that rests moves no crank, and friction has no scale. Servos have their own.
    scaled = s.speed > 0 and about.scenario.actuator.kind != "position_servo"
    return float(damping * s.torque / s.speed if scaled else 0.0)


def _draw_gain(rng: Generator, about: About) -> float:
    share = about.ranges.gain * float(rng.uniform(-1, 1))
    return share if about.scenario.actuator.kind == "torque" else 0.0


def _draw_delay(rng: Generator, about: About) -> float:
    r, period, plant = about.ranges, about.scales.period, about.scenario.plant
    steps = math.floor((2 * r.delay_steps + 1) * rng.uniform()) - r.delay_steps
    late = steps + r.delay * rng.uniform(-1, 1)
    if plant.kind == "multibody":  # torques change at its own steps only
        late = round(late * period / plant.time_step) * plant.time_step / period
    # Nothing acts before it is computed.
    return period * float(max(late, -about.scenario.true_delay.periods))


MACHINE: Final[Model] = {
    "payload": Quantity(
        _number("payload", "plate_mass", -1), add_payload, "kg", signed=True, title="payload"
    ),
    "torque_bias": Quantity(
        _vector("torque_bias", "torque", NUM_TORQUES), add_to("plant", "torque_bias"), "mN m", 1e3,
        title="torque bias (rms)",
    ),
    "noise": Quantity(_number("noise"), add_noise, "%", 100, title="noise of the sensor"),
    "torque_limit": Quantity(_draw_limit, _limit_torque, "N m", title="torque limit"),
    "damping": Quantity(
        _draw_damping, add_to("plant", "joint_damping"), "mN m s/rad", 1e3, title="joint damping"
    ),
    "delay": Quantity(_draw_delay, _add_delay, "ms", 1e3, signed=True, title="delay error"),
    "lengths": Quantity(
        _vector("lengths", "crank", 2 * NUM_LEGS), _add_to_machine("crank_lengths", "rod_lengths"),
        "mm", 1e3, title="lengths (rms)",
    ),
    "anchors": Quantity(
        _vector("anchors", "crank", 6 * NUM_LEGS), _add_to_machine("p_WS", "p_PQ"), "mm", 1e3,
        title="anchors (rms)",
    ),
    "seed": Quantity(draw_seed, seed_noise),
    "coulomb": Quantity(
        _number("coulomb", "torque"), add_to("plant", "coulomb_friction"), "mN m", 1e3,
        optional=True, title="Coulomb friction",
    ),
    "payload_position": Quantity(
        _vector("payload_position", "crank", 3), add_to("plant", "payload_position"), "mm", 1e3,
        optional=True, title="payload's place (rms)",
    ),
    "jitter": Quantity(
        _number("jitter", "period"), _add_jitter, "ms", 1e3,
        optional=True, title="jitter of the delay",
    ),
    "loss": Quantity(_number("loss"), _lose, "%", 100, optional=True, title="lost on the way"),
    "link_seed": Quantity(draw_seed, _seed_link),
    "gain": Quantity(
        _draw_gain, _strengthen, "%", 100, signed=True, optional=True, title="motors' gain"
    ),
}  # fmt: skip
"""True minus believed value of each quantity of `Ranges`."""


def run_draw(scenario: Scenario, one: Draw) -> bytes:
    return run_file(_run(scenario, one), one)


def _run(scenario: Scenario, one: Draw) -> Outcome:
    try:
        changed = apply_draw(MACHINE, scenario, simulated_machine(scenario), one)
        variant = changed.as_scenario()
        try:
            truth = changed.machine()
        except (ConfigError, UnreachablePoseError) as error:
            return Outcome("not_assembled", str(error), time=0.0)
        return outcome_of(run_in_bulk(variant, truth))
    except ConfigError as error:
        return Outcome("refused", str(error), time=0.0)
