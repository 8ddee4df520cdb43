"""Unknown quantities of a machine: their draws, what they change, and runs with them.

A quantity says how it is drawn, what it changes, and its unit; a model is a table of them by
name. The table's order is that of the random numbers, so that a new quantity goes to its end and
leaves all other draws as they were. A draw adds to what the scenario says already. All scales are
those of the machine and its motion, so that the same shares suit any mechanism.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.random import Generator

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import validate
from stewart_drake.law.startup import INSTANTS
from stewart_drake.loop.bulk import run_in_bulk
from stewart_drake.loop.preparation import Experiment, assemble, simulated_machine
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.calibration import believed_delay
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.loading import scenario_to_dict
from stewart_drake.scenario.signals import NUM_LEGS, NUM_TORQUES
from stewart_drake.scenario.trajectories import spread_instants
from stewart_drake.studies.jobs import run_jobs
from stewart_drake.studies.runs import Outcome, outcome_of, run_file
from stewart_drake.studies.study_options import Ranges
from stewart_drake.studies.workspace import rms, size_motors

Draw = dict[str, Any]
"""What was drawn by name of the quantity, SI units: a number, a tuple of them, or None for nothing.
Empty it changes nothing."""


@dataclass
class Truth:
    """A scenario and its machine while a draw changes them; the controller's belief stays.

    Attributes:
        scenario, mechanism: as they were.
        fields: of the scenario, as they are.
        parts: fields of the mechanism that are others.
    """

    scenario: Scenario
    mechanism: Mechanism
    fields: dict[str, Any]
    parts: dict[str, Any] = dataclasses.field(default_factory=dict)

    def as_scenario(self) -> Scenario:
        """The scenario as it is.

        Raises:
            ConfigError: what was drawn is beyond what a scenario may hold.
        """
        return validate(Scenario, self.fields, "drawn")

    def machine(self) -> Mechanism:
        """The machine as it is.

        Raises:
            ConfigError, UnreachablePoseError: such parts cannot be assembled at home.
        """
        return dataclasses.replace(self.mechanism, **self.parts) if self.parts else self.mechanism


class Quantity(NamedTuple):
    """One thing that is not known."""

    draw: Callable[[Generator, Any], Any]
    """From random numbers and what its model draws with. It takes the same number of random numbers
    for any range, so that a narrower range leaves the other draws unchanged."""
    apply: Callable[[Truth, Any], None]
    """Changes `fields` or `parts`."""
    unit: str = ""
    """Unit in results; empty for a quantity that is not reported."""
    per_unit: float = 1.0
    """Units in one of SI."""
    signed: bool = False
    """Either direction may hurt."""
    sometimes: bool = False
    """Absent, 0, in half of the draws."""
    optional: bool = False
    """Told only where it is drawn at all."""

    def told(self, value: Any) -> float:
        """Return the value in its unit: the rms of several numbers, infinite for None."""
        if value is None:
            return math.inf
        return self.per_unit * (rms(np.array(value)) if isinstance(value, tuple) else value)


Model = Mapping[str, Quantity]


def draw_from(model: Model, rng: Generator, about: Any) -> Draw:
    """One draw of all quantities; `about` is what the model's quantities are drawn with."""
    some = [name for name, quantity in model.items() if quantity.sometimes]
    there = dict(zip(some, rng.integers(2, size=len(some)), strict=True)) if some else {}
    one: Draw = {}
    for name, quantity in model.items():
        value = quantity.draw(rng, about)
        one[name] = _times(there[name], value) if name in there else value
    return one


def drawn(model: Model, scenario: Scenario, mechanism: Mechanism, one: Draw) -> Truth:
    """A scenario and its mechanism with what was drawn; they themselves stay as they are."""
    truth = Truth(scenario, mechanism, dataclasses.asdict(scenario))
    for name, value in one.items():
        model[name].apply(truth, value)
    return truth


def _times(there: int, value: Any) -> Any:
    return (
        tuple(_times(there, x) for x in value) if isinstance(value, tuple) else float(there * value)
    )


# ---------------------------------------------------------------- what quantities change


def add_payload(truth: Truth, mass: float) -> None:
    """Add kg at the plate's centre of mass; a mass below the payload is taken off the plate."""
    plant, plate = truth.fields["plant"], truth.mechanism.plate
    total = plant["payload_mass"] + mass
    plant["payload_mass"] = max(0.0, total)
    if total < 0:
        truth.parts["plate"] = Body(plate.mass + total, plate.inertia)


def add_bias(truth: Truth, bias: tuple[float, ...]) -> None:
    """Add a bias (6,) in N m at the shafts."""
    plant = truth.fields["plant"]
    plant["torque_bias"] = [a + b for a, b in zip(plant["torque_bias"], bias, strict=True)]


def add_noise(truth: Truth, share: float) -> None:
    """Add noise; its standard deviation is a share of half the reference's peak to peak.

    Encoders have no other noise than their codes.
    """
    if share != 0 and truth.scenario.sensor.kind == "state":
        moving = dataclasses.asdict(truth.scenario) | {"reference": truth.fields["reference"]}
        motion = assemble(validate(Scenario, moving, "drawn")).motion_scale
        sensor = truth.fields["sensor"]
        std = np.array(sensor["noise_std"]) + share * np.tile(motion, 2)
        sensor["noise_std"] = std.tolist()


def seed_noise(truth: Truth, seed: int) -> None:
    """Set the seed of drawn noise, or of the phases of encoders; else a sensor keeps its seed."""
    fields, sensor = truth.fields["sensor"], truth.scenario.sensor
    if sensor.kind != "state" or fields["noise_std"] != sensor.noise_std:
        truth.fields["sensor"]["seed"] = seed


def draw_seed(rng: Generator, _: Any) -> int:
    """A seed for the sensor."""
    return int(rng.integers(2**31))


def _over_network(truth: Truth) -> bool:
    return truth.scenario.link.kind == "network"


def _jitter(truth: Truth, std: float) -> None:
    if _over_network(truth):
        return
    truth.fields["delay"]["jitter_std"] += std


def _lose(truth: Truth, share: float) -> None:
    """Lose a share of the packets or measurements that arrive."""
    place = _lossy(truth)
    place["loss"] += share * (1 - place["loss"])


def _lossy(truth: Truth) -> dict[str, Any]:
    """Return the section with the loss: a network of packets, else the sensor of measurements."""
    return truth.fields["link" if _over_network(truth) else "sensor"]


def _seed_link(truth: Truth, seed: int) -> None:
    """Set the seed of drawn jitter and losses; an unchanged link keeps its seed."""
    if truth.fields["delay"]["jitter_std"] != truth.scenario.delay.jitter_std:
        truth.fields["delay"]["seed"] = seed
    own = dataclasses.asdict(truth.scenario)
    for place in ("link", "sensor"):
        if truth.fields[place].get("loss") != own[place].get("loss"):
            truth.fields[place]["seed"] = seed


def _limit_torque(truth: Truth, limit: float | None) -> None:
    if limit is not None:
        truth.fields["actuator"]["torque_limit"] = limit


def _damp(truth: Truth, damping: float) -> None:
    truth.fields["plant"]["joint_damping"] += damping


def _rub(truth: Truth, friction: float) -> None:
    truth.fields["plant"]["coulomb_friction"] += friction


def _move_payload(truth: Truth, errors: tuple[float, ...]) -> None:
    plant = truth.fields["plant"]
    place = plant["payload_position"]
    plant["payload_position"] = [a + b for a, b in zip(place, errors, strict=True)]


def _delay(truth: Truth, late: float) -> None:
    if _over_network(truth):  # whose buffer sets the delay
        return
    sc, believed = truth.scenario, believed_delay(truth.scenario)
    fraction = sc.delay.fraction + late / sc.controller.period
    whole = math.floor(fraction + 1e-9)
    truth.fields["delay"] |= {
        "steps": sc.delay.steps + whole,
        "fraction": round(max(0.0, fraction - whole), 12),
    }
    told = {"delay_steps": believed.steps, "delay_fraction": believed.fraction}
    truth.fields["controller"] |= told


def _lengthen(truth: Truth, errors: tuple[float, ...]) -> None:
    if any(errors):
        cranks, rods = np.reshape(errors, (2, NUM_LEGS))
        m = truth.mechanism
        lengths = {"crank_lengths": m.crank_lengths + cranks, "rod_lengths": m.rod_lengths + rods}
        truth.parts |= lengths


def _move_anchors(truth: Truth, errors: tuple[float, ...]) -> None:
    if any(errors):
        shafts, joints = np.reshape(errors, (2, NUM_LEGS, 3))
        m = truth.mechanism
        truth.parts |= {"p_WS": m.p_WS + shafts, "p_PQ": m.p_PQ + joints}


# ---------------------------------------------------------------- a machine out of all possible


class Scales(NamedTuple):
    """Scales that shares refer to, SI units."""

    plate_mass: float
    motion: tuple[float, ...]
    """(6,) half the reference's peak to peak, rad and m."""
    torque: float
    """Largest on the reference, N m."""
    speed: float
    """Largest crank rate on the reference, rad/s."""
    crank: float
    """Mean length, m."""
    period: float
    """Of the controller, s."""
    commanded: float
    """Largest torque that the undisturbed run commands, N m."""
    torque_limit: float = math.inf
    """That of the undisturbed run, N m, infinite for none."""


class About(NamedTuple):
    """Ranges and scales that machines are drawn with."""

    ranges: Ranges
    scales: Scales
    scenario: Scenario


def scales_of(experiment: Experiment, commanded: float) -> Scales:
    """The scales of an experiment.

    Args:
        experiment: as `prepare` returns it.
        commanded: largest torque that the undisturbed run commands, N m.
    """
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
    """The machine with this index; it does not depend on any other, nor on their number."""
    rng = Generator(np.random.Philox(np.random.SeedSequence([seed, index])))
    return draw_from(MACHINE, rng, About(ranges, scales, scenario))


def _of_random_size(rng: Generator, number: int, largest: float) -> tuple[float, ...]:
    """Draw values whose rms is uniform in [0, largest], in a uniform direction."""
    size, direction = largest * rng.uniform(), rng.standard_normal(number)
    return tuple((size * np.sqrt(number) / np.linalg.norm(direction) * direction).tolist())


def _draw_limit(rng: Generator, about: About) -> float | None:
    strength, scales, own = rng.uniform(), about.scales, about.scenario.actuator.torque_limit
    # Where the undisturbed run takes no torque, as at rest without gravity, a limit has no scale.
    if about.ranges.torque_limit is None or scales.commanded == 0:
        return own if isinstance(own, float) else None
    low, high = about.ranges.torque_limit
    return min(scales.commanded * (low + (high - low) * strength), scales.torque_limit)


def _draw_damping(rng: Generator, about: About) -> float:
    damping, s = about.ranges.damping * rng.uniform(), about.scales
    # A reference that rests moves no crank, and friction has no scale.
    return float(damping * s.torque / s.speed if s.speed > 0 else 0.0)


def _draw_delay(rng: Generator, about: About) -> float:
    r, period, plant = about.ranges, about.scales.period, about.scenario.plant
    steps = math.floor((2 * r.delay_steps + 1) * rng.uniform()) - r.delay_steps
    late = steps + r.delay * rng.uniform(-1, 1)
    if plant.kind == "multibody":  # which sees torques change at its own steps only
        late = round(late * period / plant.time_step) * plant.time_step / period
    # Nothing acts before it is computed.
    return period * float(max(late, -about.scenario.true_delay.periods))


MACHINE: Final[Model] = {
    "payload": Quantity(
        lambda rng, a: float(a.ranges.payload * a.scales.plate_mass * rng.uniform(-1, 1)),
        add_payload, "kg", signed=True,
    ),
    "torque_bias": Quantity(
        lambda rng, a: _of_random_size(rng, NUM_TORQUES, a.ranges.torque_bias * a.scales.torque),
        add_bias, "mN m", 1e3,
    ),
    "noise": Quantity(lambda rng, a: float(a.ranges.noise * rng.uniform()), add_noise, "%", 100),
    "torque_limit": Quantity(_draw_limit, _limit_torque, "N m"),
    "damping": Quantity(_draw_damping, _damp, "mN m s/rad", 1e3),
    "delay": Quantity(_draw_delay, _delay, "ms", 1e3, signed=True),
    "lengths": Quantity(
        lambda rng, a: _of_random_size(rng, 2 * NUM_LEGS, a.ranges.lengths * a.scales.crank),
        _lengthen, "mm", 1e3,
    ),
    "anchors": Quantity(
        lambda rng, a: _of_random_size(rng, 6 * NUM_LEGS, a.ranges.anchors * a.scales.crank),
        _move_anchors, "mm", 1e3,
    ),
    "seed": Quantity(draw_seed, seed_noise),
    "coulomb": Quantity(
        lambda rng, a: float(a.ranges.coulomb * a.scales.torque * rng.uniform()),
        _rub, "mN m", 1e3, optional=True,
    ),
    "payload_position": Quantity(
        lambda rng, a: _of_random_size(rng, 3, a.ranges.payload_position * a.scales.crank),
        _move_payload, "mm", 1e3, optional=True,
    ),
    "jitter": Quantity(
        lambda rng, a: float(a.ranges.jitter * a.scales.period * rng.uniform()), _jitter, "ms", 1e3,
        optional=True,
    ),
    "loss": Quantity(
        lambda rng, a: float(a.ranges.loss * rng.uniform()), _lose, "%", 100, optional=True
    ),
    "link_seed": Quantity(draw_seed, _seed_link),
}  # fmt: skip
"""True less believed value of each quantity of `Ranges`."""


# ---------------------------------------------------------------- runs


def undisturbed_run(scenario: Scenario, name: str, folder: Path, common: dict[str, Any]) -> Outcome:
    settings = common["settings"] | {"scenario": scenario_to_dict(scenario)}
    first = {"undisturbed": (scenario, Draw())}
    one = run_jobs(first, run_draw, folder, **(common | {"settings": settings}))["undisturbed"]
    if one.status != "completed":
        raise ConfigError(
            f"robustness{f' with {name}' if name else ''}: the undisturbed run fails at "
            f"{one.time:.2f} s ({one.reason}), so no machine was drawn; expected a scenario and a "
            "controller that complete undisturbed"
        )
    return one


def run_draw(scenario: Scenario, one: Draw) -> bytes:
    """The file of one run of a scenario with what was drawn."""
    return run_file(_run(scenario, one), one)


def _run(scenario: Scenario, one: Draw) -> Outcome:
    try:
        changed = drawn(MACHINE, scenario, simulated_machine(scenario), one)
        variant = changed.as_scenario()
    except ConfigError as error:
        return Outcome("refused", str(error), time=0.0)
    try:
        truth = changed.machine()
    except (ConfigError, UnreachablePoseError) as error:
        return Outcome("not_assembled", str(error), time=0.0)
    try:
        return outcome_of(run_in_bulk(variant, truth))
    except ConfigError as error:
        return Outcome("refused", str(error), time=0.0)
