"""Machines that a search for a layout chooses from, and measures of how good they are.

A point of the space is a value for each of `PARAMETERS`, together with an arrangement: which joint
of the plate each leg takes, and which crank solution. Both have a pattern's threefold symmetry.

Measures are the worst over the motion and home. The search takes them at some tens of instants with
the distances of `mechanism.clearance`, which are too small rather than too large; the judgement of
what was found at all instants that are checked, with the shapes themselves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.files.errors import ConfigError
from stewart_drake.files.yamlio import validate
from stewart_drake.mechanism.clearance import clearances
from stewart_drake.mechanism.files import (
    BodySpec,
    LinkSpec,
    MechanismSpec,
    PatternSpec,
    pattern_legs,
)
from stewart_drake.mechanism.kinematics import (
    LegGeometry,
    Legs,
    legs_along,
    reach_margins,
    rotation,
)
from stewart_drake.scenario.signals import ACCELERATIONS, ANGLES, POSE, RATES
from stewart_drake.scenario.trajectories import evaluate
from stewart_drake.types import Array


class Measure(NamedTuple):
    """Something that is asked of a layout."""

    more: bool
    """Whether more is better."""
    unit: str
    factor: float
    """From SI to what a person reads."""
    shown: str
    """The unit of that."""
    text: str


MEASURES: Final = {
    "reach": Measure(True, "m", 1e3, "mm", "least reach that a leg has left"),
    "transmission": Measure(True, "-", 1, "-", "least share of a crank's push along its rod"),
    "condition": Measure(
        False, "-", 1, "-", "worst condition number, 1 is alike in all directions"
    ),
    "clearance": Measure(True, "m", 1e3, "mm", "least distance of links that no joint holds"),
    "plate_joint_deg": Measure(
        False, "deg", 1, "deg", "largest turn of a rod at the plate from home"
    ),
    "crank_joint_deg": Measure(
        False, "deg", 1, "deg", "largest lean of a rod out of its crank's plane"
    ),
    "torque": Measure(False, "N m", 1, "N m", "largest motor torque, nominal plant"),
}
"""By name, the cheap ones first."""


class Motion(NamedTuple):
    """Home, and then a reference at some instants."""

    poses: Array
    """(n, 6) rad, m; the first is home."""
    wanted: Array
    """(n - 1, 18) pose, rates and accelerations of the reference."""


def motion_of(home: Array, reference: Trajectory, time: Array) -> Motion:
    """The motion at the instants (m,) in s, home (6,) before it."""
    wanted = np.array([evaluate(reference, t) for t in time])
    return Motion(np.vstack([home, wanted[:, POSE]]), wanted)


def least_reach(legs: Legs, motion: Motion) -> float:
    """m, negative where a pose is out of reach."""
    return float(reach_margins(legs, motion.poses).min())


def geometry(mechanism: Legs, motion: Motion) -> dict[str, float]:
    """All measures but the torque, of a machine that reaches every pose, and `parallel`.

    `parallel`: least det W, with its sign at home made positive; see `studies.workspace_map`.
    """
    legs = legs_along(mechanism, motion.poses)
    length = np.linalg.norm(mechanism.p_PQ, axis=1).mean()
    wrenches = np.concatenate([np.cross(legs.p_PQ_W, legs.rod) / length, legs.rod], axis=-1)
    parallel = np.linalg.det(wrenches)
    values = np.linalg.svd(
        wrenches / (mechanism.crank_lengths * legs.transmission)[..., None], compute_uv=False
    )
    # At a parallel singularity the least value is zero, and infinite is what that amounts to.
    with np.errstate(divide="ignore"):
        condition = float((values[:, 0] / values[:, -1]).max())
    lean = np.einsum("nli,li->nl", legs.rod, mechanism.R_WS[:, :, 2])
    return {
        "reach": least_reach(mechanism, motion),
        "transmission": float(np.abs(legs.transmission).min()),
        "condition": condition,
        "clearance": float(clearances(mechanism, motion.poses, legs).min()),
        "plate_joint_deg": float(np.rad2deg(_turns(legs, motion.poses).max())),
        "crank_joint_deg": float(np.rad2deg(np.abs(np.arcsin(np.clip(lean, -1, 1))).max())),
        "parallel": float((np.sign(parallel[0]) * parallel).min()),
    }


def _turns(legs: LegGeometry, poses: Array) -> Array:
    """Angles (n, 6) in rad between a rod as the plate sees it and as it saw it at home."""
    R_WP = rotation(poses[:, ANGLES])
    seen = legs.rod @ R_WP
    return np.arccos(np.clip(np.einsum("nli,li->nl", seen, seen[0]), -1.0, 1.0))


def peak_torque(dynamics: StewartDynamics, motion: Motion) -> float:
    """N m, of any motor, to follow the reference exactly."""
    torques = [
        dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in motion.wanted
    ]
    return float(np.abs(torques).max())


class Wish(NamedTuple):
    """Limits of a layout, and the goal of the search."""

    limits: dict[str, float]
    """By measure: the least value where more is better, else the largest."""
    goal: str

    def missed(self, found: Mapping[str, float]) -> dict[str, float]:
        """Return by how much each limit is missed, as a share of it; kept limits are left out."""
        missing = {
            name: (limit - found[name]) * (1 if MEASURES[name].more else -1) / (abs(limit) or 1.0)
            for name, limit in self.limits.items()
            if name in found
        }
        return {name: share for name, share in missing.items() if not share <= 0}

    def cost(self, found: Mapping[str, float]) -> float:
        """Return the cost of the goal; less is better."""
        return -found[self.goal] if MEASURES[self.goal].more else found[self.goal]


def wish_of(goal: str, limits: Mapping[str, float], usual: Mapping[str, float]) -> Wish:
    """Limits as asked for, and as usual where nothing was asked.

    Raises:
        ConfigError: an unknown measure, or a limit that is not a number.
    """
    for option, names in (("goal", [goal]), ("limit", limits)):
        for name in names:
            if name not in MEASURES:
                expected = f"expected one of {', '.join(MEASURES)}"
                raise ConfigError(f"--{option}: got {name}; {expected}")
    for name, value in limits.items():
        if not np.isfinite(value):
            raise ConfigError(f"--limit {name}: got {value:g}; expected a number")
    merged = {**usual, **limits}
    return Wish({name: merged[name] for name in MEASURES if name in merged}, goal)


def singular(found: Mapping[str, float]) -> float:
    """Return the shortfall of det W below its least accepted value; 0 for none."""
    return max(0.0, SINGULARITY_LIMIT - found["parallel"])


PARAMETERS: Final = (
    "rotation_deg",
    "base_radius",
    "base_separation_deg",
    "plate_radius",
    "plate_separation_deg",
    "plate_offset_deg",
    "shaft_height",
    "installation_deg",
    "crank",
    "rod",
)
"""What is varied: fields of `mechanism.files.PatternSpec`, and lengths of crank and rod in m."""
CHOICES: Final = ("plate_order", "branches")
"""What is chosen from a few."""
_LENGTHS: Final = ("base_radius", "plate_radius", "crank", "rod")
DIGITS: Final = 4
"""Decimals that are enough: of lengths in m a tenth of a millimetre."""


class Arrangement(NamedTuple):
    """How the legs go, for all three pairs alike."""

    order: tuple[int, ...]
    """(6,): leg i takes joint order[i] of the plate."""
    branches: tuple[int, ...]
    """(6,) of -1 or 1."""
    centre_deg: float
    """The plate offset that puts a pair's joints as far to the left of it as to the right."""

    @property
    def key(self) -> str:
        """Text for the name of a file."""
        signs = "".join("+" if branch > 0 else "-" for branch in self.branches[:2])
        return f"joints{''.join(map(str, self.order))}_cranks{signs}"


@dataclass(frozen=True)
class Space:
    """Set of the layouts to choose from.

    Attributes:
        spec: of the machine that the search begins from; what is not varied stays as it is there.
        bounds: lowest and highest value by parameter; of the plate's offset, where it is not kept,
            from the arrangement's centre.
        kept: of `CHOICES`, what stays as in `spec`.
        offset_from_centre: whether the plate's offset is counted from the arrangement's centre.
    """

    spec: MechanismSpec
    bounds: dict[str, tuple[float, float]]
    kept: tuple[str, ...]
    offset_from_centre: bool

    @property
    def pattern(self) -> PatternSpec:
        """Pattern of the machine that the search begins from."""
        assert self.spec.pattern is not None
        return self.spec.pattern

    def arrangements(self) -> list[Arrangement]:
        """All of them, that of the machine itself first."""
        own_order, own_branches = tuple(self.pattern.plate_order), tuple(self.pattern.branches)
        neighbours, pairs = (5, 0, 1, 2, 3, 4), (0, 1, 2, 3, 4, 5)
        orders, signs = [own_order, neighbours, pairs], [own_branches]
        signs += [sign * 3 for sign in product((-1, 1), repeat=2)]
        orders = orders[:1] if "plate_order" in self.kept else orders
        signs = signs[:1] if "branches" in self.kept else signs
        unique = dict.fromkeys(product(orders, signs))
        return [Arrangement(order, branches, _centre(order)) for order, branches in unique]

    def ranges(self, arrangement: Arrangement) -> list[tuple[float, float]]:
        """Bounds of `PARAMETERS` for one arrangement."""
        shift = arrangement.centre_deg if self.offset_from_centre else 0.0
        return [
            (low + shift, high + shift) if name == "plate_offset_deg" else (low, high)
            for name, (low, high) in self.bounds.items()
        ]

    def legs(self, values: Sequence[float] | Array, arrangement: Arrangement) -> Legs:
        """Return the legs, which kinematics needs."""
        named = dict(zip(PARAMETERS, map(float, values), strict=True))
        crank, rod = named.pop("crank"), named.pop("rod")
        return pattern_legs(self._pattern(named, arrangement), crank, rod)

    def machine(
        self, values: Sequence[float] | Array, arrangement: Arrangement, name: str
    ) -> MechanismSpec:
        """A machine file's contents.

        A longer link of the same section has a mass that grows with its length, and moments that
        grow with the cube of it; the plate keeps its mass and is as wide as its joints. All three
        moments of a body are scaled alike, so that there is still a body that has them: the small
        one along a link is taken as more than it is.
        """
        named = dict(zip(PARAMETERS, map(float, values), strict=True))
        crank, rod = named.pop("crank"), named.pop("rod")
        wider = named["plate_radius"] / self.pattern.plate_radius
        return replace(
            self.spec,
            name=name,
            pattern=self._pattern(named, arrangement),
            crank=_longer(self.spec.crank, crank),
            rod=_longer(self.spec.rod, rod),
            plate=BodySpec(self.spec.plate.mass, _times(self.spec.plate.inertia, wider**2)),
        )

    def _pattern(self, named: Mapping[str, float], arrangement: Arrangement) -> PatternSpec:
        order, branches = list(arrangement.order), list(arrangement.branches)
        return replace(self.pattern, plate_order=order, branches=branches, **named)

    def rounded(self, values: Array, digits: int = DIGITS) -> Array:
        """Return values rounded to `digits` decimals, except those that do not vary."""
        free = np.array([low < high for low, high in self.bounds.values()])
        return np.where(free, np.round(values, digits), values)


def space_around(
    spec: MechanismSpec, vary: Mapping[str, tuple[float, float]], keep: Sequence[str]
) -> Space:
    """The space about a machine: half to twice its lengths, all angles, unless said otherwise.

    Args:
        spec: of a machine with a pattern.
        vary: bounds, lowest and highest, by parameter; equal ones fix it.
        keep: parameters and choices that stay as they are.

    Raises:
        ConfigError: a machine without a pattern, names that are unknown or both varied and kept,
            bounds the wrong way round, or beyond what a machine's file may hold.
    """
    if spec.pattern is None:
        raise ConfigError(
            f"mechanism: got {spec.name}, described leg by leg; expected one with a pattern, whose "
            "numbers can be varied"
        )
    for option, names in (("vary", vary), ("keep", keep)):
        known = PARAMETERS if option == "vary" else PARAMETERS + CHOICES
        for name in names:
            if name not in known:
                raise ConfigError(f"--{option}: got {name}; expected one of {', '.join(known)}")
    for name in vary:
        if name in keep:
            raise ConfigError(f"--keep: got {name}, which --vary varies; expected one of the two")
    own = _own(spec)
    rod, turned = own["rod"], own["rotation_deg"]
    usual = {
        "rotation_deg": (max(-360.0, turned - 60), min(360.0, turned + 60)),
        "base_separation_deg": (5.0, 110.0),
        "plate_separation_deg": (5.0, 110.0),
        "plate_offset_deg": (-60.0, 60.0),
        "shaft_height": (own["shaft_height"] - rod / 2, own["shaft_height"] + rod / 2),
        "installation_deg": (0.0, 180.0),
        **{name: (own[name] / 2, own[name] * 2) for name in _LENGTHS},
    }
    bounds = {}
    for name in PARAMETERS:
        low, high = (own[name],) * 2 if name in keep else vary.get(name, usual[name])
        if not low <= high:
            raise ConfigError(f"--vary {name}: got {low:g}:{high:g}; expected the lower one first")
        bounds[name] = (float(low), float(high))
        for bound in bounds[name]:
            if name in ("crank", "rod"):
                validate(LinkSpec, asdict(spec.crank) | {"length": bound}, f"--vary {name}")
            else:
                validate(PatternSpec, asdict(spec.pattern) | {name: bound}, "--vary")
    if all(low == high for low, high in bounds.values()):
        raise ConfigError("--keep: got every number of the pattern; expected one to search for")
    kept = tuple(name for name in CHOICES if name in keep)
    centred = "plate_offset_deg" not in vary and "plate_offset_deg" not in keep
    return Space(spec, bounds, kept, centred)


def own_values(spec: MechanismSpec) -> Array:
    """`PARAMETERS` of a machine with a pattern; of lengths leg by leg their mean."""
    return np.array([_own(spec)[name] for name in PARAMETERS])


def _own(spec: MechanismSpec) -> dict[str, float]:
    lengths = {"crank": spec.crank.length, "rod": spec.rod.length}
    return {
        name: float(np.mean(lengths[name])) if name in lengths else getattr(spec.pattern, name)
        for name in PARAMETERS
    }


def _centre(order: tuple[int, ...]) -> float:
    """Minus the mean azimuth of the first two legs' joints as seen from their own pair, degrees."""
    azimuths = [(120.0 * (joint // 2) + 180.0) % 360.0 - 180.0 for joint in order[:2]]
    return -float(np.mean(azimuths))


def _longer(spec: LinkSpec, length: float) -> LinkSpec:
    ratio = length / float(np.mean(spec.length))
    return replace(
        spec, length=length, mass=spec.mass * ratio, inertia=_times(spec.inertia, ratio**3)
    )


def _times(moments: list[float] | None, factor: float) -> list[float] | None:
    if moments is None or factor == 1:
        return moments
    larger = [factor * moment for moment in moments]
    # Of a flat plate one is the sum of the other two, which it must not exceed by rounding.
    sums = [larger[1] + larger[2], larger[2] + larger[0], larger[0] + larger[1]]
    return [min(one, (1 - 1e-15) * most) for one, most in zip(larger, sums, strict=True)]
