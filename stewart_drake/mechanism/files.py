"""Mechanism YAML files: the schema, and the six legs of a `pattern` of anchors.

Moments of inertia may be left out; `mechanism.geometry` estimates them.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from stewart_drake.files.errors import ConfigError
from stewart_drake.files.resources import resolve
from stewart_drake.files.schema import plain
from stewart_drake.files.yamlio import exactly, load_yaml, one_message, rule, validate, yaml_text
from stewart_drake.mechanism.geometry import Body, Link, Mechanism, bar_inertia, disc_inertia
from stewart_drake.mechanism.kinematics import Legs, UnreachablePoseError, dot
from stewart_drake.scenario.field_types import STRICT
from stewart_drake.scenario.signals import LEGS
from stewart_drake.types import Array, ArrayLike

# Limits far beyond any platform keep squares and products finite.
_SHORTEST, _LONGEST = 1e-6, 1e3
_MOST_LEAN = 2e-3  # rad; directions written with three decimals are off the right angle by less
_UNLIKE = 20  # lengths of one machine that differ by more are in different units
_PAPER = 0.1  # kg/m^2, a sheet of paper; a lighter plate has its lengths in millimetres


_in_metres = rule(
    lambda length: abs(length) <= _LONGEST,
    f"metres, {_LONGEST:g} at most (are these millimetres?)",
)
_each_once = rule(lambda order: len(set(order)) == len(order), "each of 0 to 5 once")

Coordinate = Annotated[float, _in_metres]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Radius = Annotated[float, Field(ge=_SHORTEST), _in_metres]
Mass = Annotated[float, Field(le=1e6)]  # `Body.problem` has the lower limit
Point = Annotated[list[Coordinate], exactly(3)]
Moments = Annotated[list[Annotated[float, Field(le=1e6)]], exactly(3)]
Six = Annotated[list[Coordinate], exactly(6)]
Joint = Annotated[int, Field(ge=0, le=5)]
Order = Annotated[list[Joint], exactly(6), _each_once]
Branch = Annotated[int, rule(lambda branch: abs(branch) == 1, "-1 or 1"), one_message("-1 or 1")]
Branches = Annotated[list[Branch], exactly(6)]
Fingerprint = Annotated[
    str, Field(pattern="^[0-9a-f]{16}$"), one_message("16 hexadecimal digits in quotes")
]
LegNumbers = Annotated[list[Annotated[int, Field(ge=1, le=6)]], Field(max_length=6)]
Length = Annotated[
    Radius | Annotated[list[Radius], exactly(6)],
    one_message(f"a positive number, or a list of six, metres of {_SHORTEST:g} to {_LONGEST:g}"),
]


@dataclass(config=STRICT)
class BodySpec:
    mass: Mass  # kg
    # principal moments about the COM, kg m^2; null estimates those of a uniform disc
    inertia: Moments | None = None


@dataclass(config=STRICT)
class LinkSpec:
    """All cranks, or all rods."""

    length: Length  # m, one for all legs or one per leg
    mass: Mass  # kg
    # principal moments about the COM, along the link first, kg m^2; null estimates those of a
    # uniform bar of the mean length
    inertia: Moments | None = None
    center: float = 0.5  # position of the COM along the link, 0 to 1


@dataclass(config=STRICT)
class MotorSpec:
    effort_limit: Annotated[float, Field(gt=0, le=1e6)] | None = None  # N m; null is none


@dataclass(config=STRICT)
class BallJointSpec:
    """Legs, 1 to 6, whose ball joints have the friction of a scenario's `plant.ball_joint_...`.

    `crank` joints are those between crank and rod, `plate` joints those between rod and plate.
    """

    crank: LegNumbers = Field(default_factory=lambda: list(LEGS))
    plate: LegNumbers = Field(default_factory=lambda: list(LEGS))


@dataclass(config=STRICT)
class PatternSpec:
    """Anchors of a platform with threefold symmetry; lengths in m, angles in degrees.

    Pair k (0, 1, 2) sits at rotation + 120 k, its legs half a separation to either side. The plate
    joints t_0 ... t_5 follow the same rule about rotation + plate_offset; leg i takes joint
    plate_order[i]. `installation` (beta) is the angle of the motor's y axis below the horizon.
    """

    rotation_deg: Degrees
    base_radius: Radius
    base_separation_deg: Degrees
    plate_radius: Radius
    plate_separation_deg: Degrees
    plate_offset_deg: Degrees
    plate_order: Order
    shaft_height: Coordinate
    installation_deg: Degrees
    branches: Branches
    plate_height: Coordinate = 0.0


@dataclass(config=STRICT)
class LegSpec:
    shaft: Point  # centre of the motor shaft in W, m
    motor_axis: Point  # direction of any length; the crank angle grows right-handed about it
    crank_zero: Point  # crank at angle zero, perpendicular to `motor_axis` but for rounding
    plate_joint: Point  # position in P, m
    branch: Branch  # -1 or 1, the crank solution


@dataclass(config=STRICT)
class MechanismSpec:
    """A mechanism file: bodies, and anchors as a `pattern` or explicitly as six `legs`."""

    name: Annotated[str, Field(max_length=100)]
    home: Six
    base: BodySpec
    plate: BodySpec
    crank: LinkSpec
    rod: LinkSpec
    motor: MotorSpec = Field(default_factory=MotorSpec)
    ball_joints: BallJointSpec = Field(default_factory=BallJointSpec)
    drawn: Fingerprint | None = None  # of the drawing, in a file of `identify`
    pattern: PatternSpec | None = None
    legs: Annotated[list[LegSpec], exactly(6, "legs")] | None = None


def load_mechanism(name_or_path: str | Path) -> Mechanism:
    """Load a shipped mechanism by name, or one from a YAML file (with a slash or `.yaml`).

    Raises:
        ConfigError: one line naming the file, the field, its value and what is allowed.
    """
    path = resolve("mechanism", name_or_path)
    found = path.stat()
    return _load(path, found.st_mtime_ns, found.st_size)


@lru_cache(maxsize=16)
def _load(path: Path, *unchanged: int) -> Mechanism:
    """Read a file once until its time or size changes: a Monte Carlo run takes milliseconds."""
    spec = mechanism_spec(path)
    try:
        return build_mechanism(spec)
    except (UnreachablePoseError, ConfigError) as error:
        raise ConfigError(f"{path}: {error}") from None


def as_mechanism(given: Mechanism | str | Path) -> Mechanism:
    """Return a mechanism as it is, or load it by its shipped name or path."""
    return given if isinstance(given, Mechanism) else load_mechanism(given)


def mechanism_spec(name_or_path: str | Path) -> MechanismSpec:
    """Return the content of a mechanism's file, as far as it is well formed."""
    path = resolve("mechanism", name_or_path)
    data = load_yaml(path)
    if "mechanism" in data and "home" not in data:
        raise ConfigError(
            f"{path}: got a scenario; expected a mechanism, such as its field mechanism names: "
            f"{data['mechanism']}"
        )
    return validate(MechanismSpec, data, str(path))


def mechanism_yaml(mechanism: Mechanism) -> str:
    """Return a mechanism, leg by leg, as the text of a file that `load_mechanism` reads back."""
    m = mechanism
    legs = [
        LegSpec(p_WS.tolist(), R_WS[:, 2].tolist(), R_WS[:, 0].tolist(), p_PQ.tolist(), int(branch))
        for p_WS, R_WS, p_PQ, branch in zip(m.p_WS, m.R_WS, m.p_PQ, m.branches, strict=True)
    ]
    rubbing = ([leg for leg, rubs in zip(LEGS, row, strict=True) if rubs] for row in m.ball_joints)

    def link(one: Link, lengths: Array) -> LinkSpec:
        return LinkSpec(lengths.tolist(), one.mass, one.inertia.tolist(), one.center)

    spec = MechanismSpec(
        m.name,
        m.home.tolist(),
        base=BodySpec(m.base.mass, m.base.inertia.tolist()),
        plate=BodySpec(m.plate.mass, m.plate.inertia.tolist()),
        crank=link(m.crank, m.crank_lengths),
        rod=link(m.rod, m.rod_lengths),
        motor=MotorSpec(m.effort_limit),
        ball_joints=BallJointSpec(*rubbing),
        drawn=m.drawn,
        legs=legs,
    )
    usual = {"ball_joints"} if np.all(m.ball_joints) else set()
    given = plain(spec).items()
    return yaml_text({name: one for name, one in given if one is not None and name not in usual})


def build_mechanism(spec: MechanismSpec) -> Mechanism:
    """Return the mechanism of a file's contents; errors are those of `Mechanism`."""
    if spec.pattern is not None and spec.legs is None:
        legs = pattern_legs(spec.pattern, spec.crank.length, spec.rod.length)
    elif spec.legs is not None and spec.pattern is None:
        legs = _explicit_legs(spec.legs, spec.crank.length, spec.rod.length)
    else:
        given = "neither" if spec.pattern is None else "both"
        raise ConfigError(f"pattern, legs: got {given}; expected exactly one of the two")
    ends = spec.ball_joints
    base_radius, plate_radius = (
        float(np.hypot(p[:, 0], p[:, 1]).max()) for p in (legs.p_WS, legs.p_PQ)
    )
    if plate_radius >= 1 and 0 < spec.plate.mass < _PAPER * np.pi * plate_radius**2:
        raise ConfigError(
            f"plate.mass: got {spec.plate.mass:g} kg on a radius of {plate_radius:g} m, lighter "
            "than paper; expected lengths in metres (are these millimetres?)"
        )
    crank, rod = (float(np.max(link.length)) for link in (spec.crank, spec.rod))
    if crank > _UNLIKE * rod:
        raise _unlike({"crank.length": crank, "rod.length": rod})
    try:
        return Mechanism(
            **vars(legs),
            name=spec.name,
            home=np.array(spec.home),
            base=_disc(spec.base, base_radius),
            plate=_disc(spec.plate, plate_radius),
            crank=_bar(spec.crank, "crank"),
            rod=_bar(spec.rod, "rod"),
            effort_limit=spec.motor.effort_limit,
            ball_joints=np.array(
                [[leg in rubs for leg in LEGS] for rubs in (ends.crank, ends.plate)]
            ),
            drawn=spec.drawn,
        )
    except UnreachablePoseError:
        anchors = "legs" if spec.pattern is None else "pattern"
        sizes = {
            "crank.length" if crank > rod else "rod.length": max(crank, rod),
            anchors: max(base_radius, plate_radius),
            "home": float(np.linalg.norm(spec.home[3:])),
        }
        largest, other, _ = sorted(sizes, key=lambda name: -sizes[name])
        if largest == "home" or sizes[largest] < _UNLIKE * sizes[other]:
            raise
        raise _unlike({name: sizes[name] for name in (largest, other)}) from None


def _unlike(sizes: dict[str, float]) -> ConfigError:
    """Return the error about two lengths in m, of which the first one is in another unit."""
    (name, length), (other, size) = sizes.items()
    return ConfigError(
        f"{name}: got up to {length:g} m, {length / size:.0f} times the size of {other}; expected "
        "metres (are these millimetres?)"
    )


def _disc(spec: BodySpec, radius: float) -> Body:
    """Return the plate or the base; a missing inertia is that of a disc out to its joints."""
    if spec.inertia is None:
        return Body(spec.mass, disc_inertia(spec.mass, radius), estimated=True)
    return Body(spec.mass, np.array(spec.inertia))


def _bar(spec: LinkSpec, field: str) -> Link:
    if spec.inertia is not None:
        return Link(spec.mass, np.array(spec.inertia), spec.center)
    if spec.center != 0.5:
        raise ConfigError(
            f"{field}.inertia: is missing; expected one for a center of {spec.center:g}, as it is "
            "estimated for a uniform bar only, with its center at 0.5"
        )
    moments = bar_inertia(spec.mass, float(np.mean(spec.length)))
    return Link(spec.mass, moments, spec.center, estimated=True)


def pattern_legs(
    pattern: PatternSpec, crank: float | list[float], rod: float | list[float]
) -> Legs:
    """Return the legs of a pattern with these lengths in m, one or six of each."""
    pairs = np.repeat([0.0, 120.0, 240.0], 2)

    def on_circle(radius: float, first: float, separation: float, z: float) -> tuple[Array, ...]:
        azimuth = np.deg2rad(first + (pairs + np.tile([-0.5, 0.5], 3) * separation))
        cos, sin = np.cos(azimuth), np.sin(azimuth)
        return np.column_stack([radius * cos, radius * sin, np.full(6, z)]), cos, sin

    p = pattern
    p_WS, cos, sin = on_circle(p.base_radius, p.rotation_deg, p.base_separation_deg, p.shaft_height)
    first = p.rotation_deg + p.plate_offset_deg
    joints, *_ = on_circle(p.plate_radius, first, p.plate_separation_deg, p.plate_height)
    beta, zero = np.deg2rad(p.installation_deg), np.zeros(6)
    x = np.column_stack([sin, -cos, zero])
    y = np.column_stack([np.cos(beta) * cos, np.cos(beta) * sin, zero - np.sin(beta)])
    R_WS = np.stack([x, y, np.cross(x, y)], axis=2)
    return Legs(p_WS, R_WS, joints[p.plate_order], *map(_each, (crank, rod, p.branches)))


def _each(values: ArrayLike) -> Array:
    """Return the numbers (6,) of the legs from one or six."""
    return np.broadcast_to(np.array(values, dtype=np.float64), 6)


def _explicit_legs(
    legs: list[LegSpec], crank: float | list[float], rod: float | list[float]
) -> Legs:
    def unit(field: str) -> Array:
        directions = np.array([getattr(leg, field) for leg in legs])
        for i in np.flatnonzero(~directions.any(axis=1))[:1]:
            raise ConfigError(
                f"legs[{i}].{field}: got {directions[i].tolist()}; expected a direction, not zero"
            )
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))

    n, x = unit("motor_axis"), unit("crank_zero")
    lean = dot(n, x)
    for i in np.flatnonzero(np.abs(lean) > _MOST_LEAN)[:1]:
        raise ConfigError(
            f"legs[{i}].crank_zero: got {np.rad2deg(np.arccos(lean[i])):.6g} degrees to "
            "motor_axis; expected a perpendicular direction"
        )
    x = x - lean[:, None] * n
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    shafts, joints = (np.array([getattr(leg, f) for leg in legs]) for f in ("shaft", "plate_joint"))
    R_WS = np.stack([x, np.cross(n, x), n], axis=2)
    branches = [leg.branch for leg in legs]
    return Legs(shafts, R_WS, joints, *map(_each, (crank, rod, branches)))
