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
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from stewart_drake.core.library import core
from stewart_drake.files.arguments import fixed, listed
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism import kinematics
from stewart_drake.scenario.signals import LEGS, NUM_LEGS
from stewart_drake.types import Array, ArrayLike

RESERVED_NAMES: Final = ("world", "WorldModelInstance", "DefaultModelInstance")
"""Names that SDFormat and Drake keep for themselves."""
THINNESS: Final = 20.0  # length over diameter of an estimated crank or rod
_BRANCHES: Final = slice(2 * NUM_LEGS, 3 * NUM_LEGS)  # place of the crank branches in the numbers


@dataclass(frozen=True)
class Body:
    mass: float  # kg
    inertia: Array  # principal moments (3,) about its COM, kg m^2
    _: KW_ONLY
    estimated: bool = False  # whether the moments are those of a uniform body, not measured ones

    def __post_init__(self) -> None:
        object.__setattr__(self, "inertia", fixed("inertia", self.inertia, (3,)))

    def problem(self, field: str, *, massless: bool = False) -> str | None:
        """Return why no rigid body has this mass and inertia, opened by `field`, or None."""
        moments, nothing = self.inertia, massless and self.mass == 0
        got = f"{field}.inertia: got {listed(moments)} kg m^2"
        if not (0 < self.mass < np.inf or nothing):
            return (
                f"{field}.mass: got {self.mass:g} kg; expected a positive mass{' or 0' * massless}"
            )
        if np.any(moments <= 0) and not nothing:
            return f"{got}; expected positive moments"
        # A moment larger than the sum of the other two needs negative mass somewhere.
        if (excess := 2 * moments.max() - moments.sum()) > 1e-9 * moments.max():
            return (
                f"{got}, which violates the triangle inequality by {excess:.3g}; expected the "
                "largest moment to be at most the sum of the other two"
            )
        return None


@dataclass(frozen=True)
class Link(Body):
    """A slender body between two joints; its COM lies at `center` (0 to 1) of its length.

    The principal axes are (along the link, in-plane, the rest): for a crank the last one is the
    motor axis, for a rod the middle one is the second axis of the universal joint.
    """

    center: float = 0.5

    def problem(self, field: str, *, massless: bool = False) -> str | None:
        if not 0 <= self.center <= 1:
            return (
                f"{field}.center: got {self.center:g}; expected a fraction of the length between "
                "0 and 1"
            )
        return super().problem(field, massless=massless)


@dataclass(frozen=True, eq=False, kw_only=True)
class Mechanism(kinematics.Legs):
    """A rotary Stewart platform (6-RSS), SI units.

    Attributes:
        name: identifier, used for file and model names.
        home: pose (6,) at which the machine is assembled.
        p_WS, R_WS, p_PQ, crank_lengths, rod_lengths, branches: see `kinematics.Legs`.
        base, plate, crank, rod: masses and inertias; the six cranks are alike, so are the rods.
        effort_limit: of each motor in N m, written to SDFormat and the default of a scenario's
            `actuator.torque_limit`; or None.
        ball_joints: (2, 6) of 0 or 1, whether the joints at the crank tips (first row) and at the
            plate have the friction of a scenario's `plant.ball_joint_friction` and
            `ball_joint_damping`; by default all.
        drawn: `fingerprint` of the drawing of an identified machine, or None.

    Raises:
        ConfigError: naming the field, its value and what is allowed.
        UnreachablePoseError: the home pose is out of reach.
    """

    name: str
    home: Array
    base: Body
    plate: Body
    crank: Link
    rod: Link
    effort_limit: float | None = None
    ball_joints: Array = field(default_factory=lambda: np.ones((2, NUM_LEGS)))
    drawn: str | None = None

    def __post_init__(self) -> None:
        for name, shape in (
            ("home", (6,)),
            ("ball_joints", (2, NUM_LEGS)),
            *(("p_WS", (NUM_LEGS, 3)), ("R_WS", (NUM_LEGS, 3, 3)), ("p_PQ", (NUM_LEGS, 3))),
            *((name, (NUM_LEGS,)) for name in ("crank_lengths", "rod_lengths", "branches")),
        ):
            object.__setattr__(self, name, fixed(name, getattr(self, name), shape))
        self._check()

    def __repr__(self) -> str:
        cranks, rods = (
            " to ".join(f"{1e3 * length:.4g}" for length in sorted({values.min(), values.max()}))
            for values in (self.crank_lengths, self.rod_lengths)
        )
        return f"Mechanism({self.name!r}, cranks {cranks} mm, rods {rods} mm)"

    @cached_property
    def numbers(self) -> Array:
        """The numbers (133,) of the machine as the core takes them, see `core.layout`."""
        legs = *kinematics.numbers_of(self), *self.ball_joints.ravel()
        crank = [self.crank.mass, self.crank.center, self.crank.inertia[2]]
        rod = [self.rod.mass, self.rod.center, *self.rod.inertia]
        plate = [self.plate.mass, *self.plate.inertia]
        return np.array([*legs, *plate, *crank, *rod, plate_radius(self)])

    @cached_property
    def _key(self) -> tuple[object, ...]:
        bodies = (x for b in (self.base, self.crank) for x in (b.mass, *b.inertia))
        numbers = np.array([*self.home, *bodies, *self.numbers])
        return self.name, self.effort_limit, numbers.tobytes()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Mechanism) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def _check(self) -> None:
        u, rods = self.crank_lengths, self.rod_lengths
        skew = np.abs(self.R_WS @ self.R_WS.transpose(0, 2, 1) - np.eye(3)).max()
        leg = int(np.argmax(rods <= u))
        bodies = (
            self.base.problem("base", massless=True),
            *(getattr(self, name).problem(name) for name in ("plate", "crank", "rod")),
        )
        problems = "; ".join(filter(None, bodies))
        for is_met, problem in (
            (
                re.fullmatch("[A-Za-z][A-Za-z0-9_-]*", self.name)
                and self.name not in RESERVED_NAMES,
                f"name: got {self.name!r}; expected a letter, then letters, digits, _ or -, and "
                f"none of {', '.join(RESERVED_NAMES)}",
            ),
            (np.all(u > 0), f"crank.length: got {listed(u)} m; expected positive lengths"),
            (
                np.all(rods > u),
                f"rod.length: got {rods[leg]:g} m for leg {LEGS[leg]}, whose crank is {u[leg]:g} "
                "m; expected a rod longer than its crank",
            ),
            (
                np.all(np.abs(self.branches) == 1),
                f"branches: got {listed(self.branches)}; expected -1 or 1 six times",
            ),
            (
                skew <= 1e-9 and np.all(np.linalg.det(self.R_WS) > 0),
                f"motor frames: off a rotation by {skew:.1e}; expected right-handed frames",
            ),
            (
                abs(self.home[1]) < np.pi / 2,
                f"home: got a pitch of {self.home[1]:g} rad; expected less than pi/2 in magnitude",
            ),
            (not problems, problems),
            (
                self.effort_limit is None or self.effort_limit > 0,
                f"motor.effort_limit: got {self.effort_limit} N m; expected a positive torque or "
                "null",
            ),
        ):
            if not is_met:
                raise ConfigError(problem)
        margins = kinematics.reach_margins(self, self.home)
        if not np.all(margins >= 0):
            heights = kinematics.reachable_heights(self, self.home)
            where = "at this x, y and orientation"
            if heights is None:
                accepted = f"but none exists {where}"
            else:
                low, high = heights
                middle = (low + high) / 2
                accepted = f"{where} z between {low:.4g} and {high:.4g} m, such as {middle:.4g}"
            raise kinematics.UnreachablePoseError(
                margins,
                prefix=f"home: got {listed(self.home)}, out of reach",
                suffix=f"; expected a home pose within reach, {accepted}",
            )

    def crank_angles(self, pose: ArrayLike) -> Array:
        """Return the crank angles (6,) in rad at a pose (6,), equations (1)-(5).

        Raises:
            UnreachablePoseError: naming the legs and by how much each falls short.
        """
        return kinematics.leg_geometry(self, _six("pose", pose)).crank_angles

    def reach_margins(self, pose: ArrayLike) -> Array:
        """Return the distance (6,) in m that each leg has left; negative out of reach."""
        return kinematics.reach_margins(self, _six("pose", pose))

    def forward_kinematics(self, crank_angles: ArrayLike, guess: ArrayLike | None = None) -> Array:
        """Return the pose (6,) of the assembly near `guess` (default: home), see core/kinematics.h.

        Raises:
            ForwardKinematicsError: no such pose on the mechanism's crank branches.
        """
        guess = self.home if guess is None else _six("guess", guess)
        angles, numbers = _six("crank_angles", crank_angles), self.numbers
        pose = _pose_of(numbers, angles, guess)
        if pose is not None:
            return pose
        for leg in LEGS:
            other = numbers.copy()
            other[_BRANCHES][leg - 1] *= -1
            if _pose_of(other, angles, guess) is not None:
                raise kinematics.ForwardKinematicsError(
                    "forward kinematics found a pose that needs the other crank branch on leg "
                    f"{leg}; expected crank angles of the mechanism's own branches"
                )
        raise kinematics.ForwardKinematicsError(
            "forward kinematics did not converge: no pose near the guess has these crank angles; "
            "give a guess closer to the assembly"
        )

    def jacobian(self, pose: ArrayLike) -> Array:
        """Return d crank_angles / d pose (6, 6), in closed form.

        Raises:
            UnreachablePoseError: the pose is out of reach.
            SingularPoseError: a leg is at its dead centre, where the derivative does not exist.
        """
        return kinematics.jacobian(self, _six("pose", pose))


def _pose_of(numbers: Array, angles: Array, guess: Array) -> Array | None:
    c, pose = core(), guess.copy()
    given = (c.at(numbers), c.at(angles), c.at(pose), c.scratch(48))
    return pose if c.lib.stewart_forward_kinematics(*given) else None


def plate_radius(mechanism: kinematics.Legs) -> float:
    """Return the mean distance of the plate's joints from its COM, m."""
    return float(np.linalg.norm(mechanism.p_PQ, axis=1).mean())


def fingerprint(mechanism: Mechanism) -> str:
    """Return a hash of the numbers that determine the motion, so that data of others are refused.

    Lengths count to a nanometre, masses and inertias to nine digits: writing a machine to a file
    and reading it again changes nothing. Name, home, base and motors do not count.
    """
    m = mechanism
    places = (m.p_WS, m.R_WS, m.p_PQ, m.crank_lengths, m.rod_lengths, m.branches)
    words = [f"{round(x, 9) + 0.0:.9f}" for x in np.concatenate([np.ravel(x) for x in places])]
    for body in (m.plate, m.crank, m.rod):
        words += [f"{x:.8e}" for x in (body.mass, *body.inertia)]
    words += [f"{link.center:.9f}" for link in (m.crank, m.rod)]
    if not np.all(m.ball_joints):
        words += [f"{x:.0f}" for x in m.ball_joints.ravel()]
    return hashlib.sha256(" ".join(words).encode()).hexdigest()[:16]


def drawing_of(mechanism: Mechanism) -> str:
    """Return the fingerprint of a machine's drawing, which identification does not change."""
    return mechanism.drawn or fingerprint(mechanism)


def bar_inertia(mass: float, length: float) -> Array:
    """Return the principal moments (3,) in kg m^2, along and twice across, of a uniform round bar.

    With length L, diameter d and constant density m / (pi d^2/4 L),

        about its axis     I_x = integral of r^2 dm           = m d^2/8
        across it          I_y = I_z = integral of x^2 dm + half of I_x = m (L^2/12 + d^2/16).

    The diameter is unknown; with L/d = THINNESS the second term is 0.2 % of the first. The limit
    d = 0, a slender rod, has no inertia about its own axis, which no rigid body can have.
    """
    diameter = length / THINNESS
    across = length**2 / 12 + diameter**2 / 16
    return mass * np.array([diameter**2 / 8, across, across])


def disc_inertia(mass: float, radius: float) -> Array:
    """Return the principal moments (3,) in kg m^2 of a thin uniform disc, the last about its axis.

    I_z = integral of r^2 dm = m R^2/2 about its axis, and since I_z = I_x + I_y for any flat body,
    m R^2/4 across it.
    """
    return mass * radius**2 * np.array([0.25, 0.25, 0.5])


def with_rotors(mechanism: Mechanism, inertia: float) -> Mechanism:
    """Return the machine with rotors of inertia N^2 I in kg m^2 at the shafts.

    A rotor of moment I that turns N times as fast as its crank has the energy I (N a')^2 / 2, as if
    the crank had N^2 I more about the motor axis. The axis is fixed, so the crank's other moments
    have no effect. Each gets half of it, as for a thin disc: no body has a moment that is larger
    than the sum of the other two.
    """
    if inertia == 0:
        return mechanism
    crank, disc = mechanism.crank, inertia * np.array([0.5, 0.5, 1.0])
    return replace(mechanism, crank=replace(crank, inertia=crank.inertia + disc))


def _six(name: str, values: ArrayLike) -> Array:
    """Return six numbers; fewer would be broadcast."""
    numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape != (6,):
        angles = name == "crank_angles"
        what = "crank angles in rad" if angles else "[roll, pitch, yaw, x, y, z] in rad and m"
        raise ValueError(f"{name}: got shape {numbers.shape}; expected (6,), {what}")
    return numbers
