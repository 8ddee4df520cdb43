"""Mechanism YAML files: the schema, and how a `pattern` of anchors becomes six legs.

Moments of inertia may be left out; `mechanism.inertias` says what stands in for them.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, PlainValidator
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.files.yamlio import read_yaml, validate, yaml_of, yaml_text
from stewart_drake.mechanism.geometry import Body, Link, Mechanism
from stewart_drake.mechanism.inertias import bar_inertia, disc_inertia
from stewart_drake.mechanism.kinematics import UnreachablePoseError
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array

_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)

# Limits far beyond any platform keep squares and products of what a file says finite.
_SHORTEST, _LONGEST = 1e-6, 1e3
_MOST_LEAN = 2e-3
"""rad; directions written with three decimals are off the right angle by less."""
_PAPER = 0.1
"""kg/m^2, a sheet of paper; no plate is lighter, but one whose metres are millimetres."""


def _in_metres(value: float) -> float:
    if abs(value) > _LONGEST:
        raise ValueError(f"metres, {_LONGEST:g} at most (are these millimetres?)")
    return value


Coordinate = Annotated[float, AfterValidator(_in_metres)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Radius = Annotated[float, Field(ge=_SHORTEST), AfterValidator(_in_metres)]
Mass = Annotated[float, Field(le=1e6)]
Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Moments = Annotated[list[Mass], Field(min_length=3, max_length=3)]
Six = Annotated[list[Coordinate], Field(min_length=6, max_length=6)]
Indices = Annotated[list[Annotated[int, Field(ge=0, le=5)]], Field(min_length=6, max_length=6)]


def _one_or_six(value: object) -> object:
    # A union of number and list would name its alternatives in the error instead of the field.
    numbers = value if isinstance(value, list) else [value] * 6
    if len(numbers) != 6 or not all(_is_length(v) for v in numbers):
        raise ValueError(
            f"a positive number, or a list of six, metres of {_SHORTEST:g} to {_LONGEST:g}"
        )
    return value


def _is_length(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return _SHORTEST <= value <= _LONGEST


def _minus_one_or_one(value: object) -> object:
    # A Literal would take true for 1.
    if isinstance(value, bool) or value not in (-1, 1):
        raise ValueError("-1 or 1")
    return value


Branch = Annotated[int, PlainValidator(_minus_one_or_one)]
Branches = Annotated[list[Branch], Field(min_length=6, max_length=6)]
Length = Annotated[float | list[float], PlainValidator(_one_or_six)]


@dataclass(config=_STRICT)
class BodySpec:
    """`mass` in kg, `inertia`: principal moments about the COM in kg m^2; null: a uniform disc."""

    mass: Annotated[float, Field(ge=0, le=1e6)]
    inertia: Moments | None = None


@dataclass(config=_STRICT)
class LinkSpec:
    """`length` in m (one, or one per leg), `center`: where along it the COM lies (0 to 1).

    `inertia` as of a body, along the link first; null: a uniform bar of the mean length.
    """

    length: Length
    mass: Mass
    inertia: Moments | None = None
    center: float = 0.5


@dataclass(config=_STRICT)
class MotorSpec:
    """`effort_limit`: N m, each motor's torque limit, also in SDFormat; null: none."""

    effort_limit: Annotated[float, Field(le=1e6)] | None = None


@dataclass(config=_STRICT)
class PatternSpec:
    """Anchors of a platform with threefold symmetry; lengths in m, angles in degrees.

    Pair k (0, 1, 2) sits at rotation + 120 k, its legs half a separation to either side. The plate
    joints t_0 ... t_5 follow the same rule about rotation + plate_offset; leg i takes joint
    plate_order[i]. `installation` (beta): by how much the motor's y axis dips under the horizon.
    """

    rotation_deg: Degrees
    base_radius: Radius
    base_separation_deg: Degrees
    plate_radius: Radius
    plate_separation_deg: Degrees
    plate_offset_deg: Degrees
    plate_order: Indices
    shaft_height: Coordinate
    installation_deg: Degrees
    branches: Branches
    plate_height: Coordinate = 0.0


@dataclass(config=_STRICT)
class LegSpec:
    """One leg: points in m, W for the shaft, P for the plate joint; directions need no unit length.

    `crank_zero` is the direction of the crank at angle zero, perpendicular to `motor_axis`, about
    which the angle grows right-handed; what it leans by rounding is taken off. `branch` (-1 or 1):
    which of the two crank solutions.
    """

    shaft: Point
    motor_axis: Point
    crank_zero: Point
    plate_joint: Point
    branch: Branch


@dataclass(config=_STRICT)
class MechanismSpec:
    """A mechanism file: bodies, and anchors as a `pattern` or explicitly as six `legs`."""

    name: Annotated[str, Field(max_length=100)]
    home: Six
    base: BodySpec
    plate: BodySpec
    crank: LinkSpec
    rod: LinkSpec
    motor: MotorSpec = Field(default_factory=MotorSpec)
    pattern: PatternSpec | None = None
    legs: Annotated[list[LegSpec], Field(min_length=6, max_length=6)] | None = None


class SixLegs(NamedTuple):
    """What kinematics needs (`mechanism.kinematics.Legs`); see `Mechanism`."""

    p_WS: Array
    R_WS: Array
    p_PQ: Array
    branches: Array
    crank_lengths: Array
    rod_lengths: Array


def load_mechanism(name_or_path: str | Path) -> Mechanism:
    """A shipped mechanism by name, or one from a YAML file (anything with a slash or `.yaml`).

    Raises:
        ConfigError: one line naming the file, the field, its value and what is allowed.
    """
    path = resolve("mechanism", name_or_path)
    return _of_content(read_yaml(path), path)


def as_mechanism(given: Mechanism | str | Path) -> Mechanism:
    """Return a mechanism as it is, or load it by its shipped name or path."""
    return given if isinstance(given, Mechanism) else load_mechanism(given)


def mechanism_spec(name_or_path: str | Path) -> MechanismSpec:
    """What a mechanism's file says, in its own words.

    Raises:
        ConfigError: as `load_mechanism` does of a file that is not well formed.
    """
    path = resolve("mechanism", name_or_path)
    return validate(MechanismSpec, yaml_of(read_yaml(path), path), str(path))


@lru_cache(maxsize=16)
def _of_content(raw: bytes, path: Path) -> Mechanism:
    """Read once as long as the file stays as it is."""
    spec = validate(MechanismSpec, yaml_of(raw, path), str(path))
    try:
        return build_mechanism(spec)
    except (UnreachablePoseError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from None


def mechanism_yaml(mechanism: Mechanism) -> str:
    """A mechanism, leg by leg, as the text of a file that `load_mechanism` reads back."""
    m = mechanism
    legs = [
        {
            "shaft": p_WS.tolist(),
            "motor_axis": R_WS[:, 2].tolist(),
            "crank_zero": R_WS[:, 0].tolist(),
            "plate_joint": p_PQ.tolist(),
            "branch": int(branch),
        }
        for p_WS, R_WS, p_PQ, branch in zip(m.p_WS, m.R_WS, m.p_PQ, m.branches, strict=True)
    ]

    def link(lengths: Array, body: Link) -> dict[str, object]:
        return {"length": lengths.tolist(), "center": float(body.center), **of(body)}

    def of(body: Body) -> dict[str, object]:
        return {"mass": float(body.mass), "inertia": body.inertia.tolist()}

    data = {
        "name": m.name,
        "home": m.home.tolist(),
        "legs": legs,
        "base": of(m.base),
        "plate": of(m.plate),
        "crank": link(m.crank_lengths, m.crank),
        "rod": link(m.rod_lengths, m.rod),
        "motor": {"effort_limit": None if m.effort_limit is None else float(m.effort_limit)},
    }
    return yaml_text(data)


def build_mechanism(spec: MechanismSpec) -> Mechanism:
    """The checked `Mechanism` of a file's contents.

    Raises:
        ConfigError, UnreachablePoseError: as `Mechanism` does.
    """
    if (spec.pattern is None) == (spec.legs is None):
        given = "neither" if spec.pattern is None else "both"
        raise ConfigError(f"pattern, legs: got {given}; expected exactly one of the two")
    if spec.pattern is not None:
        legs = pattern_legs(spec.pattern, spec.crank.length, spec.rod.length)
    else:
        assert spec.legs is not None
        legs = _explicit_legs(spec.legs, spec.crank.length, spec.rod.length)
    p_WS, R_WS, p_PQ, branches, crank_lengths, rod_lengths = legs
    base_radius, plate_radius = (np.hypot(p[:, 0], p[:, 1]).max() for p in (p_WS, p_PQ))
    if plate_radius >= 1 and 0 < spec.plate.mass < _PAPER * np.pi * plate_radius**2:
        raise ConfigError(
            f"plate.mass: got {spec.plate.mass:g} kg on a radius of {plate_radius:g} m, lighter "
            "than paper; expected lengths in metres (are these millimetres?)"
        )
    return Mechanism(
        name=spec.name,
        home=np.array(spec.home),
        p_WS=p_WS,
        R_WS=R_WS,
        p_PQ=p_PQ,
        crank_lengths=crank_lengths,
        rod_lengths=rod_lengths,
        branches=branches,
        base=_disc(spec.base, base_radius),
        plate=_disc(spec.plate, plate_radius),
        crank=_bar(spec.crank, "crank"),
        rod=_bar(spec.rod, "rod"),
        effort_limit=spec.motor.effort_limit,
    )


def _disc(spec: BodySpec, radius: float) -> Body:
    """The plate, or the base, out to its joints; of what stands on it nothing is known."""
    if spec.inertia is None:
        return Body(spec.mass, disc_inertia(spec.mass, radius), estimated=True)
    return Body(spec.mass, np.array(spec.inertia))


def _bar(spec: LinkSpec, field: str) -> Link:
    if spec.inertia is not None:
        return Link(spec.mass, np.array(spec.inertia), spec.center)
    if spec.center != 0.5:
        raise ConfigError(
            f"{field}.inertia: is missing; expected it beside a center of {spec.center:g}, as only "
            f"that of a uniform {field} is estimated, whose center is 0.5"
        )
    moments = bar_inertia(spec.mass, float(np.mean(spec.length)))
    return Link(spec.mass, moments, spec.center, estimated=True)


def _pairs(first_deg: float, separation_deg: float) -> Array:
    """Azimuths (6,) in rad of three pairs."""
    pairs = np.repeat([0.0, 120.0, 240.0], 2) + np.tile([-0.5, 0.5], 3) * separation_deg
    return np.deg2rad(first_deg + pairs)


def pattern_legs(
    pattern: PatternSpec, crank: float | list[float], rod: float | list[float]
) -> SixLegs:
    """The legs of a pattern with these lengths in m, one or six of each.

    Raises:
        ConfigError: the order of the joints is none.
    """
    if sorted(pattern.plate_order) != list(range(6)):
        raise ConfigError(
            f"pattern.plate_order: got {pattern.plate_order}; expected each of 0 to 5 once"
        )
    azimuth = _pairs(pattern.rotation_deg, pattern.base_separation_deg)
    cos, sin, zero = np.cos(azimuth), np.sin(azimuth), np.zeros(6)
    p_WS = np.column_stack(
        [pattern.base_radius * cos, pattern.base_radius * sin, zero + pattern.shaft_height]
    )
    beta = np.deg2rad(pattern.installation_deg)
    x = np.column_stack([sin, -cos, zero])
    y = np.column_stack([np.cos(beta) * cos, np.cos(beta) * sin, zero - np.sin(beta)])
    R_WS = np.stack([x, y, np.cross(x, y)], axis=2)
    first_pair = pattern.rotation_deg + pattern.plate_offset_deg
    joints = _pairs(first_pair, pattern.plate_separation_deg)[pattern.plate_order]
    p_PQ = np.column_stack(
        [
            pattern.plate_radius * np.cos(joints),
            pattern.plate_radius * np.sin(joints),
            zero + pattern.plate_height,
        ]
    )
    branches = np.array(pattern.branches, dtype=np.float64)
    return SixLegs(p_WS, R_WS, p_PQ, branches, _six(crank), _six(rod))


def _six(lengths: float | list[float]) -> Array:
    return np.broadcast_to(np.array(lengths, dtype=np.float64), 6)


def _explicit_legs(
    legs: list[LegSpec], crank: float | list[float], rod: float | list[float]
) -> SixLegs:
    frames = []
    for leg, spec in zip(LEGS, legs, strict=True):
        axis, zero = np.array(spec.motor_axis), np.array(spec.crank_zero)
        lengths = np.linalg.norm(axis), np.linalg.norm(zero)
        for field, direction, length in zip(
            ("motor_axis", "crank_zero"), (spec.motor_axis, spec.crank_zero), lengths, strict=True
        ):
            if length == 0:
                raise ConfigError(
                    f"legs[{leg - 1}].{field}: got {direction}; expected a direction, not zero"
                )
        n, x = axis / lengths[0], zero / lengths[1]
        if abs(n @ x) > _MOST_LEAN:
            raise ConfigError(
                f"legs[{leg - 1}].crank_zero: got {np.rad2deg(np.arccos(n @ x)):.6g} degrees to "
                "motor_axis; expected a perpendicular direction"
            )
        x = x - (n @ x) * n
        x /= np.linalg.norm(x)
        frames.append(np.column_stack([x, np.cross(n, x), n]))
    return SixLegs(
        np.array([spec.shaft for spec in legs]),
        np.array(frames),
        np.array([spec.plate_joint for spec in legs]),
        np.array([spec.branch for spec in legs], dtype=np.float64),
        _six(crank),
        _six(rod),
    )
