"""What is not known of a machine before it runs: ranges, draws from them, and what they change.

A draw adds to what the scenario says already. All ranges are relative to the machine and its
motion, so that the same shares suit any mechanism.
"""

import dataclasses
import math
import re
from collections.abc import Iterable
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import brief, parse_yaml, validate
from stewart_drake.law.startup import INSTANTS
from stewart_drake.loop.experiment import Experiment, believed_delay, motion_scale
from stewart_drake.mechanism.geometry import Body, Mechanism
from stewart_drake.scenario.config import Scenario
from stewart_drake.scenario.signals import NUM_LEGS, NUM_TORQUES
from stewart_drake.scenario.trajectories import spread_instants
from stewart_drake.studies.range_units import RANGE_UNITS
from stewart_drake.studies.sizing import size_motors

Array = NDArray[np.float64]
Share = Annotated[float, Field(ge=0, lt=1)]
NonNegative = Annotated[float, Field(ge=0)]


@dataclass(config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class Ranges:
    """How far each quantity may be off; 0 (null for `torque_limit`) leaves it alone.

    The controller is told the torque limit and the sensor's noise, and nothing else.

    Attributes:
        payload: a mass at the plate's centre of mass, share of the plate's, uniform in +-.
        torque_bias: rms over the motors, share of the largest torque that the reference takes,
            uniform from 0; its direction in the space of the six motors is random.
        noise: standard deviation of the measured pose (rates: per second), share of half the
            reference's peak to peak, uniform from 0.
        torque_limit: of the motors, least and most, in units of the largest torque that the
            undisturbed run commands, uniform; what limits that run, the scenario's number or the
            mechanism's motors, is never exceeded.
        damping: friction torque of a crank at its highest speed on the reference, share of the
            largest torque that the reference takes, uniform from 0.
        delay: true delay less the believed one, periods, uniform in +-.
        delay_steps: the same in whole periods, each number in +- alike; adds to `delay`.
        lengths: error of crank and rod lengths, rms over the twelve, share of the mean crank
            length, uniform from 0.
        anchors: error of the coordinates of motor shafts and plate joints, rms over the 36, share
            of the mean crank length, uniform from 0.
    """

    payload: Share = 0.1
    torque_bias: NonNegative = 0.02
    noise: NonNegative = 1e-3
    torque_limit: (
        Annotated[list[Annotated[float, Field(gt=0)]], Field(min_length=2, max_length=2)] | None
    ) = dataclasses.field(default_factory=lambda: [1.0, 3.0])
    damping: NonNegative = 0.02
    delay: Annotated[float, Field(ge=0, le=100)] = 0.01
    delay_steps: Annotated[int, Field(ge=0, le=100)] = 0
    lengths: Share = 2e-4
    anchors: Share = 2e-4


class Scales(NamedTuple):
    """What shares are taken of, SI units."""

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


class Draw(NamedTuple):
    """One machine out of all that are possible; errors are true less believed."""

    payload: float
    """kg."""
    torque_bias: tuple[float, ...]
    """(6,) N m."""
    noise: float
    """Share of half the reference's peak to peak."""
    torque_limit: float | None
    """N m."""
    damping: float
    """N m s/rad."""
    delay: float
    """s."""
    lengths: tuple[float, ...]
    """(12,) six cranks, six rods, m."""
    anchors: tuple[float, ...]
    """(36,) six motor shafts in W, six plate joints in P, m."""
    seed: int
    """Of the sensor's noise."""


UNDISTURBED = Draw(0.0, (0.0,) * 6, 0.0, None, 0.0, 0.0, (0.0,) * 12, (0.0,) * 36, 0)


def read_ranges(settings: Iterable[str]) -> Ranges:
    """Ranges from `name=value` settings, the value in YAML; the rest keeps its default.

    Raises:
        ConfigError: in one line.
    """
    given: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals or not name.strip():
            raise ConfigError(f"--vary: got {brief(setting)}; expected name=value{_units(setting)}")
        given[name.strip()] = parse_yaml(text, f"--vary: {name.strip()}")
    try:
        ranges = validate(Ranges, given, "--vary")
    except ConfigError as error:
        raise ConfigError(f"{error}{_units(str(error), given)}") from None
    limit = ranges.torque_limit
    if limit is not None and limit[0] > limit[1]:
        raise ConfigError(
            f"--vary: torque_limit: got {limit!r}; expected the lesser one first"
            f"{_units('torque_limit')}"
        )
    return ranges


def _units(message: str, names: Iterable[str] = RANGE_UNITS) -> str:
    """What the numbers mean of those `names` that a message speaks of."""
    spoken = set(re.findall(r"\w+", message))
    told = [f"{name}: {RANGE_UNITS[name]}" for name in names if name in spoken & set(RANGE_UNITS)]
    return f" ({'; '.join(told)})" if told else ""


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
        motion=tuple(motion_scale(experiment).tolist()),
        torque=float(np.abs(sizing.torque).max()),
        speed=float(np.abs(sizing.speed).max()),
        crank=float(experiment.mechanism.crank_lengths.mean()),
        period=sc.controller.period,
        commanded=commanded,
        torque_limit=experiment.torque_limit,
    )


def draw(ranges: Ranges, scales: Scales, scenario: Scenario, seed: int, index: int) -> Draw:
    """The machine with this index; it does not depend on any other, nor on their number.

    Every quantity takes the same share of the random numbers whatever its range, so that narrowing
    one range leaves the others' draws as they were.
    """
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, index])))
    r, s = ranges, scales
    payload = r.payload * s.plate_mass * rng.uniform(-1, 1)
    bias = _of_random_size(rng, NUM_TORQUES, r.torque_bias * s.torque)
    noise = r.noise * rng.uniform()
    strength = rng.uniform()
    damping = r.damping * rng.uniform()
    steps = math.floor((2 * r.delay_steps + 1) * rng.uniform()) - r.delay_steps
    late = steps + r.delay * rng.uniform(-1, 1)
    if scenario.plant.kind == "multibody":  # which sees torques change at its own steps only
        late = round(late * s.period / scenario.plant.time_step) * scenario.plant.time_step
        late /= s.period
    own = scenario.true_delay.periods
    return Draw(
        payload=float(payload),
        torque_bias=bias,
        noise=float(noise),
        torque_limit=_limit(r, s, strength, scenario.actuator.torque_limit),
        # A reference that rests moves no crank, and friction has no scale.
        damping=float(damping * s.torque / s.speed if s.speed > 0 else 0.0),
        delay=s.period * float(max(late, -own)),  # nothing acts before it is computed
        lengths=_of_random_size(rng, 2 * NUM_LEGS, r.lengths * s.crank),
        anchors=_of_random_size(rng, 6 * NUM_LEGS, r.anchors * s.crank),
        seed=int(rng.integers(2**31)),
    )


def disturbed(scenario: Scenario, motion: tuple[float, ...], one: Draw) -> Scenario:
    """The scenario with what a draw changes, but for the machine's own dimensions.

    Args:
        scenario: the undisturbed one; it stays as it is.
        motion: (6,) as in `Scales`.
        one: the draw.

    Raises:
        ConfigError: what was drawn is beyond what a scenario may hold.
    """
    sc, data = scenario, dataclasses.asdict(scenario)
    fraction = sc.delay.fraction + one.delay / sc.controller.period
    whole = math.floor(fraction + 1e-9)
    data["plant"] |= {
        "payload_mass": max(0.0, sc.plant.payload_mass + one.payload),
        "torque_bias": [a + b for a, b in zip(sc.plant.torque_bias, one.torque_bias, strict=True)],
        "joint_damping": sc.plant.joint_damping + one.damping,
    }
    data["delay"] |= {
        "steps": sc.delay.steps + whole,
        "fraction": round(max(0.0, fraction - whole), 12),
    }
    believed = believed_delay(sc)
    data["controller"] |= {"delay_steps": believed.steps, "delay_fraction": believed.fraction}
    if one.torque_limit is not None:
        data["actuator"]["torque_limit"] = one.torque_limit
    if one.noise != 0:
        std = np.array(sc.sensor.noise_std) + one.noise * np.tile(motion, 2)
        data["sensor"] |= {"noise_std": std.tolist(), "seed": one.seed}
    return validate(Scenario, data, "drawn")


def true_mechanism(mechanism: Mechanism, payload: float, one: Draw) -> Mechanism:
    """The machine as it is, whose drawing is `mechanism`.

    Args:
        mechanism: as the controller knows it.
        payload: of the undisturbed scenario, kg; what a draw takes off beyond it, the plate lacks.
        one: the draw.

    Raises:
        ConfigError, UnreachablePoseError: such parts cannot be assembled at home.
    """
    if not (any(one.lengths) or any(one.anchors)) and payload + one.payload >= 0:
        return mechanism
    cranks, rods = np.reshape(one.lengths, (2, NUM_LEGS))
    shafts, joints = np.reshape(one.anchors, (2, NUM_LEGS, 3))
    lacking = max(0.0, -(payload + one.payload))
    return dataclasses.replace(
        mechanism,
        crank_lengths=mechanism.crank_lengths + cranks,
        rod_lengths=mechanism.rod_lengths + rods,
        p_WS=mechanism.p_WS + shafts,
        p_PQ=mechanism.p_PQ + joints,
        plate=Body(mechanism.plate.mass - lacking, mechanism.plate.inertia),
    )


def _of_random_size(rng: np.random.Generator, number: int, largest: float) -> tuple[float, ...]:
    """So many values whose rms is uniform in [0, largest], in a direction that is uniform too."""
    size, direction = largest * rng.uniform(), rng.standard_normal(number)
    return tuple((size * np.sqrt(number) / np.linalg.norm(direction) * direction).tolist())


def _limit(
    ranges: Ranges, scales: Scales, strength: float, own: float | str | None
) -> float | None:
    # Where the undisturbed run takes no torque, as at rest without gravity, a limit has no scale.
    if ranges.torque_limit is None or scales.commanded == 0:
        return own if isinstance(own, float) else None
    low, high = ranges.torque_limit
    return min(scales.commanded * (low + (high - low) * strength), scales.torque_limit)
