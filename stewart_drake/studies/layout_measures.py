"""How good a layout is for a motion: what can be asked of it, and by how much it falls short.

Numbers are the worst over the motion and home. The search takes them at some tens of instants with
the distances of `mechanism.clearance`, which are too small rather than too large; the judgement of
what was found at all instants that are checked, with the shapes themselves.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple

import numpy as np
from pydrake.trajectories import Trajectory

from stewart_drake.dynamics.stewart import StewartDynamics
from stewart_drake.dynamics.workspace import SINGULARITY_LIMIT
from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.clearance import clearances
from stewart_drake.mechanism.kinematics import (
    LegGeometry,
    Legs,
    legs_along,
    reach_margins_along,
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
    return float(reach_margins_along(legs, motion.poses).min())


def geometry(mechanism: Legs, motion: Motion) -> dict[str, float]:
    """All measures but the torque, of a machine that reaches every pose, and `parallel`.

    `parallel`: least det W, with its sign at home made positive; see `studies.singularity`.
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
    R_WP = np.moveaxis(rotation(poses[:, ANGLES].T), -1, 0)
    seen = legs.rod @ R_WP
    return np.arccos(np.clip(np.einsum("nli,li->nl", seen, seen[0]), -1.0, 1.0))


def peak_torque(dynamics: StewartDynamics, motion: Motion) -> float:
    """N m, of any motor, to follow the reference exactly."""
    torques = [
        dynamics.inverse_dynamics(x[POSE], x[RATES], x[ACCELERATIONS]) for x in motion.wanted
    ]
    return float(np.abs(torques).max())


class Wish(NamedTuple):
    """What a layout must keep to, and what should be as good as can be."""

    limits: dict[str, float]
    """By measure; at least so much of what is better the more there is, else at most."""
    goal: str

    def missed(self, found: Mapping[str, float]) -> dict[str, float]:
        """By how much each limit is missed, as a share of it; those that are kept are left out."""
        missing = {
            name: (limit - found[name]) * (1 if MEASURES[name].more else -1) / (abs(limit) or 1.0)
            for name, limit in self.limits.items()
            if name in found
        }
        return {name: share for name, share in missing.items() if not share <= 0}

    def cost(self, found: Mapping[str, float]) -> float:
        """Of the goal; less is better."""
        return -found[self.goal] if MEASURES[self.goal].more else found[self.goal]


def wish_of(goal: str, limits: Mapping[str, float], usual: Mapping[str, float]) -> Wish:
    """Limits as asked for, and as usual where nothing was asked.

    Raises:
        ConfigError: an unknown measure, or a limit that is no number.
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
    """By how much a motion misses staying off parallel singularities; 0 where it does not."""
    return max(0.0, SINGULARITY_LIMIT - found["parallel"])
