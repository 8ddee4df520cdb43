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

import re
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stewart_drake.errors import ConfigError
from stewart_drake.mechanism import kinematics
from stewart_drake.signals import LEGS, NUM_LEGS

Array = NDArray[np.float64]

RESERVED_NAMES: Final = ("world", "WorldModelInstance", "DefaultModelInstance")
"""Names that SDFormat and Drake keep for themselves."""


@dataclass(frozen=True)
class Body:
    """A rigid body: mass in kg, principal moments of inertia (3,) about its COM in kg m^2."""

    mass: float
    inertia: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "inertia", _read_only(self.inertia))

    def check(self, field: str, *, massless: bool = False) -> None:
        """Raise ConfigError unless mass and inertia belong to a rigid body that can exist."""
        if self.inertia.shape != (3,):
            raise ConfigError(f"{field}.inertia: got shape {self.inertia.shape}; expected (3,)")
        if not np.all(np.isfinite([self.mass, *self.inertia])):
            raise ConfigError(
                f"{field}: got mass {self.mass:g} kg, inertia {_listed(self.inertia)} kg m^2; "
                "expected finite numbers"
            )
        if not self.mass > 0 and not (massless and self.mass == 0):
            raise ConfigError(f"{field}.mass: got {self.mass:g} kg; expected a positive mass")
        if np.any(self.inertia <= 0) and not (massless and self.mass == 0):
            raise ConfigError(
                f"{field}.inertia: got {_listed(self.inertia)} kg m^2; expected positive moments"
            )
        # A moment larger than the sum of the other two needs negative mass somewhere.
        excess = 2 * self.inertia.max() - self.inertia.sum()
        if excess > 1e-9 * self.inertia.max():
            raise ConfigError(
                f"{field}.inertia: got {_listed(self.inertia)} kg m^2, which violates the triangle "
                f"inequality by {excess:.3g}; expected the largest moment to be at most the sum of "
                "the other two"
            )


@dataclass(frozen=True)
class Link(Body):
    """A slender body between two joints; its COM lies at `center` (0 to 1) of its length.

    The principal axes are (along the link, in-plane, the rest): for a crank the last one is the
    motor axis, for a rod the middle one is the second axis of the universal joint.
    """

    center: float = 0.5


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
        effort_limit: torque limit of the motors in N m as written to SDFormat, or None.

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
        self.base.check("base", massless=True)
        self.plate.check("plate")
        for field, link in (("crank", self.crank), ("rod", self.rod)):
            link.check(field)
            if not 0 <= link.center <= 1:
                raise ConfigError(
                    f"{field}.center: got {link.center:g}; expected a fraction of the length "
                    "between 0 and 1"
                )
        if self.effort_limit is not None and not self.effort_limit > 0:
            raise ConfigError(
                f"motor.effort_limit: got {self.effort_limit:g} N m; expected a positive torque "
                "or null"
            )
        try:
            self.crank_angles(self.home)
        except kinematics.UnreachablePoseError as error:
            raise kinematics.UnreachablePoseError(
                error.margins, prefix=f"home: got {_listed(self.home)}, out of reach"
            ) from None

    def crank_angles(self, pose: Array) -> Array:
        """Inverse kinematics, equations (1)-(5): crank angles (6,) in rad at a pose (6,).

        Raises:
            UnreachablePoseError: naming the legs and by how much each falls short.
        """
        return kinematics.crank_angles(self, pose)

    def reach_margins(self, pose: Array) -> Array:
        """Distance (6,) in m that each leg has left to reach its plate joint; < 0 out of reach."""
        return kinematics.reach_margins(self, pose)

    def forward_kinematics(self, crank_angles: Array, guess: Array | None = None) -> Array:
        """Pose (6,) of the assembly nearest to `guess` (default: home) with these crank angles.

        Raises:
            ForwardKinematicsError: Newton did not converge, or found another crank branch.
        """
        return kinematics.forward_kinematics(
            self, crank_angles, self.home if guess is None else guess
        )

    def jacobian(self, pose: Array) -> Array:
        """d crank_angles / d pose (6, 6), in closed form.

        Raises:
            UnreachablePoseError: the pose is out of reach.
            SingularPoseError: a leg is at its dead centre, where the derivative does not exist.
        """
        return kinematics.jacobian(self, pose)


def _read_only(values: ArrayLike) -> Array:
    """A copy of its own that nobody can write to."""
    copy = np.array(values, dtype=np.float64)
    copy.setflags(write=False)
    return copy


def _listed(values: Array) -> str:
    return "[" + ", ".join(f"{v:g}" for v in np.ravel(values)) + "]"
