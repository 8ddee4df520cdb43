"""`Mechanism`: the numbers of a rotary (6-RSS) Stewart platform, checked at construction.

Frames, in Drake's monogram notation, leg by leg (leading axis of length six):

| frame | origin | axes |
| --- | --- | --- |
| W | base centre | z up |
| P | plate's centre of mass | fixed in the plate |
| S | motor shaft centre | x where the crank angle is zero, z the motor axis |
| T | crank tip, universal joint between crank and rod | |
| Q | spherical joint between rod and plate | |
"""

import hashlib
import re
from dataclasses import KW_ONLY, dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism import kinematics
from stewart_drake.scenario.signals import LEGS, NUM_LEGS
from stewart_drake.types import Array

RESERVED_NAMES: Final = ("world", "WorldModelInstance", "DefaultModelInstance")
"""Names that SDFormat and Drake keep for themselves."""


@dataclass(frozen=True)
class Body:
    """A rigid body: mass in kg, principal moments of inertia (3,) about its COM in kg m^2.

    `estimated`: nobody measured the moments, they are those of a uniform body
    (`mechanism.inertias`); the mathematics does not care.
    """

    mass: float
    inertia: Array
    _: KW_ONLY
    estimated: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "inertia", _read_only(self.inertia))

    def problems(self, field: str, *, massless: bool = False) -> list[str]:
        """Why no rigid body has this mass and inertia: at most one line, opened by `field`."""
        found, moments = self.inertia, _listed(self.inertia)
        nothing = massless and self.mass == 0
        # A moment larger than the sum of the other two needs negative mass somewhere.
        if found.shape != (3,):
            problem = f".inertia: got shape {found.shape}; expected (3,)"
        elif not np.all(np.isfinite([self.mass, *found])):
            problem = (
                f": got mass {self.mass:g} kg, inertia {moments} kg m^2; expected finite numbers"
            )
        elif not self.mass > 0 and not nothing:
            problem = f".mass: got {self.mass:g} kg; expected a positive mass"
        elif np.any(found <= 0) and not nothing:
            problem = f".inertia: got {moments} kg m^2; expected positive moments"
        elif (excess := 2 * found.max() - found.sum()) > 1e-9 * found.max():
            problem = (
                f".inertia: got {moments} kg m^2, which violates the triangle inequality by "
                f"{excess:.3g}; expected the largest moment to be at most the sum of the other two"
            )
        else:
            return []
        return [field + problem]


@dataclass(frozen=True)
class Link(Body):
    """A slender body between two joints; its COM lies at `center` (0 to 1) of its length.

    The principal axes are (along the link, in-plane, the rest): for a crank the last one is the
    motor axis, for a rod the middle one is the second axis of the universal joint.
    """

    center: float = 0.5

    def problems(self, field: str, *, massless: bool = False) -> list[str]:
        """As for any body; and a centre of mass beyond the ends."""
        found = super().problems(field, massless=massless)
        if not 0 <= self.center <= 1:
            found.append(
                f"{field}.center: got {self.center:g}; expected a fraction of the length "
                "between 0 and 1"
            )
        return found


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A rotary Stewart platform (6-RSS), SI units.

    Attributes:
        name: identifier, used for file and model names.
        home: pose (6,) at which the machine is assembled.
        p_WS: motor shaft centres (6, 3) in m.
        R_WS: motor frames (6, 3, 3); columns x, y and the motor axis z.
        p_PQ: plate joints (6, 3) in the plate frame, m.
        crank_lengths, rod_lengths: (6,) m.
        branches: (6,) of -1 or +1, which of the two crank solutions a leg uses.
        base, plate, crank, rod: masses and inertias; the six cranks are alike, so are the rods.
        effort_limit: of each motor in N m, written to SDFormat and the default of a scenario's
            `actuator.torque_limit`; or None.

    Raises:
        ConfigError: naming the field, its value and what is allowed.
        UnreachablePoseError: the home pose is out of reach.
    """

    name: str
    home: Array
    p_WS: Array
    R_WS: Array
    p_PQ: Array
    crank_lengths: Array
    rod_lengths: Array
    branches: Array
    base: Body
    plate: Body
    crank: Link
    rod: Link
    effort_limit: float | None = None

    def __post_init__(self) -> None:
        for field, shape in (
            ("home", (6,)),
            ("p_WS", (NUM_LEGS, 3)),
            ("R_WS", (NUM_LEGS, 3, 3)),
            ("p_PQ", (NUM_LEGS, 3)),
            ("crank_lengths", (NUM_LEGS,)),
            ("rod_lengths", (NUM_LEGS,)),
            ("branches", (NUM_LEGS,)),
        ):
            value = _read_only(getattr(self, field))
            if value.shape != shape:
                raise ConfigError(f"{field}: got shape {value.shape}; expected {shape}")
            if not np.all(np.isfinite(value)):
                raise ConfigError(f"{field}: got {_listed(value)}; expected finite numbers")
            object.__setattr__(self, field, value)
        self._check()

    def __repr__(self) -> str:
        cranks, rods = (
            " to ".join(f"{1e3 * length:.4g}" for length in sorted({values.min(), values.max()}))
            for values in (self.crank_lengths, self.rod_lengths)
        )
        return f"Mechanism({self.name!r}, cranks {cranks} mm, rods {rods} mm)"

    @cached_property
    def _key(self) -> tuple[object, ...]:
        values: list[object] = []
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Body):
                values += [value.mass, value.inertia.tobytes(), getattr(value, "center", None)]
            else:
                values.append(value.tobytes() if isinstance(value, np.ndarray) else value)
        return tuple(values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mechanism) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def _check(self) -> None:
        if not re.fullmatch("[A-Za-z][A-Za-z0-9_-]*", self.name) or self.name in RESERVED_NAMES:
            raise ConfigError(
                f"name: got {self.name!r}; expected a letter, then letters, digits, _ or -, and "
                f"none of {', '.join(RESERVED_NAMES)}"
            )
        for field, lengths in (("crank", self.crank_lengths), ("rod", self.rod_lengths)):
            if np.any(lengths <= 0):
                raise ConfigError(
                    f"{field}.length: got {_listed(lengths)} m; expected positive lengths"
                )
        for leg, (u, rod) in enumerate(zip(self.crank_lengths, self.rod_lengths, strict=True)):
            if rod <= u:
                raise ConfigError(
                    f"rod.length: got {rod:g} m for leg {LEGS[leg]}, whose crank is {u:g} m; "
                    "expected a rod longer than its crank"
                )
        if not np.all(np.abs(self.branches) == 1):
            raise ConfigError(f"branches: got {_listed(self.branches)}; expected -1 or 1 six times")
        skew = np.abs(self.R_WS @ self.R_WS.transpose(0, 2, 1) - np.eye(3)).max()
        if skew > 1e-9 or np.any(np.linalg.det(self.R_WS) < 0):
            raise ConfigError(
                f"motor frames: off a rotation by {skew:.1e}; expected right-handed frames"
            )
        if abs(self.home[1]) >= np.pi / 2:
            raise ConfigError(
                f"home: got a pitch of {self.home[1]:g} rad; expected less than pi/2 in magnitude"
            )
        self._check_bodies()
        if self.effort_limit is not None and not self.effort_limit > 0:
            raise ConfigError(
                f"motor.effort_limit: got {self.effort_limit:g} N m; expected a positive torque "
                "or null"
            )
        try:
            self.crank_angles(self.home)
        except kinematics.UnreachablePoseError as error:
            raise kinematics.UnreachablePoseError(
                error.margins,
                prefix=f"home: got {_listed(self.home)}, out of reach",
                suffix=f"; expected a home pose within reach, {self._reachable_z()}",
            ) from None

    def _check_bodies(self) -> None:
        # All four are looked at, so that a file is mended in one go.
        problems = [
            *self.base.problems("base", massless=True),
            *self.plate.problems("plate"),
            *self.crank.problems("crank"),
            *self.rod.problems("rod"),
        ]
        if problems:
            raise ConfigError("; ".join(problems))

    def _reachable_z(self) -> str:
        """What z would do for home, in words."""
        where = "at this x, y and orientation"
        found = kinematics.reachable_heights(self, self.home)
        if found is None:
            return f"of which there is none {where}"
        low, high = found
        return f"{where} z between {low:.4g} and {high:.4g} m, such as {(low + high) / 2:.4g}"

    def crank_angles(self, pose: ArrayLike) -> Array:
        """Inverse kinematics, equations (1)-(5): crank angles (6,) in rad at a pose (6,).

        This and the methods below take what numpy makes six numbers of; else a ValueError.

        Raises:
            UnreachablePoseError: naming the legs and by how much each falls short.
        """
        return kinematics.crank_angles(self, _six("pose", pose))

    def reach_margins(self, pose: ArrayLike) -> Array:
        """Distance (6,) in m that each leg has left to reach its plate joint; < 0 out of reach."""
        return kinematics.reach_margins(self, _six("pose", pose))

    def forward_kinematics(self, crank_angles: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Pose (6,) of the assembly nearest to `guess` (default: home) with these crank angles.

        Raises:
            ForwardKinematicsError: Newton did not converge, or found another crank branch.
        """
        guess = self.home if guess is None else _six("guess", guess)
        return kinematics.forward_kinematics(self, _six("crank_angles", crank_angles), guess)

    def jacobian(self, pose: ArrayLike) -> Array:
        """d crank_angles / d pose (6, 6), in closed form.

        Raises:
            UnreachablePoseError: the pose is out of reach.
            SingularPoseError: a leg is at its dead centre, where the derivative does not exist.
        """
        return kinematics.jacobian(self, _six("pose", pose))


def fingerprint(mechanism: Mechanism) -> str:
    """Of the numbers that a machine moves by: what was found of one is not used for another.

    Lengths count to a nanometre, masses and inertias to nine digits: writing a machine to a file
    and reading it again changes nothing. Name, home, base and motors do not count.
    """
    m = mechanism
    places = (m.p_WS, m.R_WS, m.p_PQ, m.crank_lengths, m.rod_lengths, m.branches)
    words = [f"{round(x, 9) + 0.0:.9f}" for x in np.concatenate([np.ravel(x) for x in places])]
    for body in (m.plate, m.crank, m.rod):
        words += [f"{x:.8e}" for x in (body.mass, *body.inertia)]
    words += [f"{link.center:.9f}" for link in (m.crank, m.rod)]
    return hashlib.sha256(" ".join(words).encode()).hexdigest()[:16]


def _six(name: str, values: ArrayLike) -> Array:
    """Six numbers; fewer would be broadcast, or end in a message about arrays."""
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (6,):
        what = (
            "six crank angles in rad"
            if name == "crank_angles"
            else ("[roll, pitch, yaw, x, y, z] in rad and m")
        )
        raise ValueError(f"{name}: got shape {numbers.shape}; expected (6,), {what}")
    return numbers


def _read_only(values: ArrayLike) -> Array:
    """A copy of its own that nobody can write to."""
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{v:g}" for v in np.ravel(values)) + "]"
