"""Machines that a search for a layout chooses from, and measures of how good they are.

A point of the space is a value for each of `PARAMETERS`, together with an arrangement: which joint
of the plate each leg takes, and which crank solution. Both have a pattern's threefold symmetry.

Measures are the worst over the motion and home. The search computes them at some tens of instants,
with the distances of `mechanism.clearance`, which are lower bounds. The result is judged at all
instants that are checked, with the shapes themselves.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
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
from stewart_drake.mechanism.kinematics import Legs, legs_along, reach_margins, rotation
from stewart_drake.mechanism.trajectories import rows_along
from stewart_drake.scenario.signals import ANGLES, POSE
from stewart_drake.studies.workspace_map import rate_gains, wrenches
from stewart_drake.types import Array


class Measure(NamedTuple):
    """Quantity that a layout is judged by."""

    more: bool  # whether more is better
    factor: float  # from SI units, or degrees, to `shown`
    shown: str  # unit for readers
    text: str


MEASURES: Final = {
    "reach": Measure(True, 1e3, "mm", "least reach that a leg has left"),
    "transmission": Measure(True, 1, "-", "least share of a crank's push along its rod"),
    "condition": Measure(False, 1, "-", "worst condition number, 1 is alike in all directions"),
    "clearance": Measure(True, 1e3, "mm", "least distance of links that no joint holds"),
    "plate_joint_deg": Measure(False, 1, "deg", "largest turn of a rod at the plate from home"),
    "crank_joint_deg": Measure(False, 1, "deg", "largest lean of a rod out of its crank's plane"),
    "torque": Measure(False, 1, "N m", "largest motor torque, nominal plant"),
}
"""By name, the cheap ones first."""


class Motion(NamedTuple):
    """Home and a reference at some instants."""

    poses: Array  # (n, 6) rad, m; the first is home
    wanted: Array  # (n - 1, 18) pose, rates and accelerations of the reference


def motion_of(home: Array, reference: Trajectory, time: Array) -> Motion:
    """Return the motion at the instants (m,) in s, after home (6,)."""
    wanted = rows_along(reference, time)
    return Motion(np.vstack([home, wanted[:, POSE]]), wanted)


def least_reach(legs: Legs, motion: Motion) -> float:
    """Return the least reach margin in m, negative if a pose is out of reach."""
    return float(reach_margins(legs, motion.poses).min())


def geometry(mechanism: Legs, motion: Motion) -> dict[str, float]:
    """Return all measures but the torque, and `parallel`; every pose must be in reach.

    `parallel` is the least det W, positive at home; see `studies.workspace_map`.
    """
    legs = legs_along(mechanism, motion.poses)
    W = wrenches(mechanism, legs)
    parallel, values = np.linalg.det(W), rate_gains(mechanism, legs, W)
    with np.errstate(divide="ignore"):  # infinite at a parallel singularity
        condition = float((values[:, 0] / values[:, -1]).max())
    lean = np.einsum("nli,li->nl", legs.rod, mechanism.R_WS[:, :, 2])
    # The angle between a rod in the frame of the plate and the same at home.
    rods = legs.rod @ rotation(motion.poses[:, ANGLES])
    turns = np.arccos(np.clip(np.einsum("nli,li->nl", rods, rods[0]), -1.0, 1.0))
    return {
        "reach": least_reach(mechanism, motion),
        "transmission": float(np.abs(legs.transmission).min()),
        "condition": condition,
        "clearance": float(clearances(mechanism, motion.poses).min()),
        "plate_joint_deg": float(np.rad2deg(turns.max())),
        "crank_joint_deg": float(np.rad2deg(np.abs(np.arcsin(np.clip(lean, -1, 1))).max())),
        "parallel": float((np.sign(parallel[0]) * parallel).min()),
    }


def peak_torque(dynamics: StewartDynamics, motion: Motion) -> float:
    """Return the largest torque in N m of any motor that follows the reference exactly."""
    return float(np.abs(dynamics.torques_along(motion.wanted)).max())


class Requirements(NamedTuple):
    """Limits of a layout by measure, and the goal of the search.

    A limit is the least value if more is better, else the largest.
    """

    limits: dict[str, float]
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


def requirements(
    goal: str, limits: Mapping[str, float], usual: Mapping[str, float]
) -> Requirements:
    """Return the goal with the given limits, and the usual ones for other measures."""
    _check_names("goal", [goal], MEASURES)
    _check_names("limit", limits, MEASURES)
    for name, value in limits.items():
        if not np.isfinite(value):
            raise ConfigError(f"--limit {name}: got {value:g}; expected a number")
    merged = {**usual, **limits}
    return Requirements({name: merged[name] for name in MEASURES if name in merged}, goal)


def _check_names(option: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise ConfigError(f"--{option}: got {name}; expected one of {', '.join(known)}")


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
"""Numbers that vary: fields of `mechanism.files.PatternSpec`, lengths of crank and rod in m."""
CHOICES: Final = ("plate_order", "branches")
_LENGTHS: Final = ("base_radius", "plate_radius", "crank", "rod")
DIGITS: Final = 4
"""Decimals of a found value: tenths of a millimetre."""


class Arrangement(NamedTuple):
    """Order and crank solutions of the legs, the same for all three pairs."""

    order: tuple[int, ...]  # (6,): leg i takes joint order[i] of the plate
    branches: tuple[int, ...]  # (6,) of -1 or 1

    @property
    def centre_deg(self) -> float:
        """Offset of the plate at which the joints of legs 1 and 2 are symmetric about their pair.

        Minus the mean azimuth of the joints, degrees.
        """
        azimuths = [(120.0 * (joint // 2) + 180.0) % 360.0 - 180.0 for joint in self.order[:2]]
        return -float(np.mean(azimuths))

    @property
    def key(self) -> str:
        """Part of the name of a file."""
        signs = "".join("+" if branch > 0 else "-" for branch in self.branches[:2])
        return f"joints{''.join(map(str, self.order))}_cranks{signs}"


@dataclass(frozen=True)
class Space:
    # of the machine that the search begins from; everything that does not vary stays
    spec: MechanismSpec
    bounds: dict[str, tuple[float, float]]  # lowest and highest value by parameter
    kept: tuple[str, ...]  # those of `CHOICES` that stay as in `spec`
    offset_from_centre: bool  # whether the plate's offset is counted from the arrangement's centre

    @property
    def pattern(self) -> PatternSpec:
        assert self.spec.pattern is not None
        return self.spec.pattern

    def arrangements(self) -> list[Arrangement]:
        """Return all arrangements, that of the machine itself first."""
        own_order, own_branches = tuple(self.pattern.plate_order), tuple(self.pattern.branches)
        neighbours, pairs = (5, 0, 1, 2, 3, 4), (0, 1, 2, 3, 4, 5)
        orders, signs = [own_order, neighbours, pairs], [own_branches]
        signs += [sign * 3 for sign in product((-1, 1), repeat=2)]
        orders = orders[:1] if "plate_order" in self.kept else orders
        signs = signs[:1] if "branches" in self.kept else signs
        return [Arrangement(*one) for one in dict.fromkeys(product(orders, signs))]

    def ranges(self, arrangement: Arrangement) -> list[tuple[float, float]]:
        """Return the bounds of `PARAMETERS` for one arrangement."""
        shift = arrangement.centre_deg if self.offset_from_centre else 0.0
        return [
            (low + shift, high + shift) if name == "plate_offset_deg" else (low, high)
            for name, (low, high) in self.bounds.items()
        ]

    def _pattern(
        self, values: Sequence[float] | Array, arrangement: Arrangement
    ) -> tuple[PatternSpec, float, float]:
        """Return the pattern, and the lengths of crank and rod."""
        named = dict(zip(PARAMETERS, map(float, values), strict=True))
        crank, rod = named.pop("crank"), named.pop("rod")
        order, branches = list(arrangement.order), list(arrangement.branches)
        pattern = replace(self.pattern, plate_order=order, branches=branches, **named)
        return pattern, crank, rod

    def legs(self, values: Sequence[float] | Array, arrangement: Arrangement) -> Legs:
        return pattern_legs(*self._pattern(values, arrangement))

    def machine(
        self, values: Sequence[float] | Array, arrangement: Arrangement, name: str
    ) -> MechanismSpec:
        """Return the contents of a machine file.

        A longer link of the same section has a mass that grows with its length, and moments that
        grow with the cube of it. The plate keeps its mass and is as wide as its joints. All three
        moments of a body are scaled alike, so that a body with them exists; the small one along a
        link is overestimated.
        """
        pattern, crank, rod = self._pattern(values, arrangement)
        wider = pattern.plate_radius / self.pattern.plate_radius
        return replace(
            self.spec,
            name=name,
            pattern=pattern,
            crank=_longer(self.spec.crank, crank),
            rod=_longer(self.spec.rod, rod),
            plate=BodySpec(self.spec.plate.mass, _scaled(self.spec.plate.inertia, wider**2)),
        )

    def rounded(self, values: Array, digits: int = DIGITS) -> Array:
        """Return values rounded to `digits` decimals, except those that do not vary."""
        free = np.array([low < high for low, high in self.bounds.values()])
        return np.where(free, np.round(values, digits), values)


def space_around(
    spec: MechanismSpec, vary: Mapping[str, tuple[float, float]], keep: Sequence[str]
) -> Space:
    """Return the layouts around a machine: by default half to twice its lengths, and all angles.

    `vary` has lowest and highest value by parameter; equal ones fix it. `keep` has parameters and
    choices that stay as they are.
    """
    if spec.pattern is None:
        raise ConfigError(
            f"mechanism: got {spec.name}, described leg by leg; expected one with a pattern, whose "
            "numbers can be varied"
        )
    _check_names("vary", vary, PARAMETERS)
    _check_names("keep", keep, PARAMETERS + CHOICES)
    for name in vary:
        if name in keep:
            raise ConfigError(f"--keep: got {name}, which --vary varies; expected one of the two")
    own = own_numbers(spec)
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
    return np.array(list(own_numbers(spec).values()))


def own_numbers(spec: MechanismSpec) -> dict[str, float]:
    """Return `PARAMETERS` of a machine with a pattern; the mean of lengths given leg by leg."""
    lengths = {"crank": spec.crank.length, "rod": spec.rod.length}
    return {
        name: float(np.mean(lengths[name])) if name in lengths else getattr(spec.pattern, name)
        for name in PARAMETERS
    }


def _longer(spec: LinkSpec, length: float) -> LinkSpec:
    ratio = length / float(np.mean(spec.length))
    return replace(
        spec, length=length, mass=spec.mass * ratio, inertia=_scaled(spec.inertia, ratio**3)
    )


def _scaled(moments: list[float] | None, factor: float) -> list[float] | None:
    if moments is None or factor == 1:
        return moments
    larger = [factor * moment for moment in moments]
    # One moment of a flat plate is the sum of the other two; rounding must not lift it above.
    sums = [larger[1] + larger[2], larger[2] + larger[0], larger[0] + larger[1]]
    return [min(one, (1 - 1e-15) * most) for one, most in zip(larger, sums, strict=True)]
