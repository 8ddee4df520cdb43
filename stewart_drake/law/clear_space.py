"""Distances that a plan must keep: reach of the legs, and clearance between the links."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.workspace import border
from stewart_drake.mechanism.clearance import clearances, room
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import reach_margins
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_LEGS, POSE
from stewart_drake.types import Array

RESERVE = 0.06
"""Reach margin of each leg and clearance of each pair of links to keep, in shortest cranks."""
_KEPT_SHARE = 0.9
"""Share to keep of the reference's own least distance, where that is less than RESERVE."""
_STEP = 1e-6
"""Step of the difference quotients, rad and m."""


class NearLimit(NamedTuple):
    """Distances near their bounds, at several poses."""

    pose: NDArray[np.intp]  # (r,) index of the pose of each
    room: Array  # (r,) distance minus its bound, in shortest cranks
    slopes: Array  # (r, 6) derivative of the room by the pose


@dataclass(frozen=True, eq=False)
class ClearSpace:
    """Lower bounds of the distances at a pose, in lengths of the shortest crank."""

    mechanism: Mechanism  # the machine
    pairs: NDArray[np.intp]  # (k,) of guarded links, indices in `clearance.LINK_PAIRS`
    least: Array  # (6 + k,) bounds of the six reach margins and of the pairs' clearances

    @classmethod
    def along(cls, mechanism: Mechanism, poses: Array) -> "ClearSpace":
        """Return the distances to keep for a reference with these poses (n, 6).

        Each is RESERVE, or a share of the reference's own least distance if that is less. Pairs of
        links whose capsules touch somewhere on the reference are not guarded. Legs that do not
        reach it keep RESERVE.
        """
        unit = mechanism.crank_lengths.min()
        margins = reach_margins(mechanism, poses)
        reached = poses[np.all(margins > 0, axis=1)]
        reached = reached if len(reached) else mechanism.home[None]
        legs = margins.min(axis=0) / unit
        apart = clearances(mechanism, reached).min(axis=0) / unit
        pairs = np.flatnonzero(apart > 0)
        own = np.concatenate([np.where(legs > 0, legs, np.inf), apart[pairs]])
        return cls(mechanism, pairs, np.minimum(RESERVE, _KEPT_SHARE * own))

    def room(self, poses: Array, chosen: NDArray[np.intp] | None = None) -> Array:
        """Return distances minus their bounds (n, 6 + k) at poses (n, 6), in shortest cranks.

        They are negative for legs out of reach, and NaN for links that cannot be placed then.
        `chosen` are places in `pairs`, by default all.
        """
        pairs, legs = self.pairs, np.arange(NUM_LEGS)
        chosen = np.arange(len(pairs)) if chosen is None else chosen
        least = self.least[np.concatenate([legs, NUM_LEGS + chosen])]
        unit = self.mechanism.crank_lengths.min()
        return room(self.mechanism, poses, pairs[chosen], unit, least)

    def near(self, poses: Array, below: float) -> NearLimit:
        """Return the distances with less room than `below` at poses (n, 6), with their slopes."""
        left = self.room(poses)
        is_near = left < below
        near_poses = np.flatnonzero(is_near.any(axis=1))
        near_pairs = np.flatnonzero(is_near[:, NUM_LEGS:].any(axis=0))
        columns = np.concatenate([np.arange(NUM_LEGS), NUM_LEGS + near_pairs])
        base = poses[near_poses][:, None]
        stepped = np.concatenate([base, base + _STEP * np.eye(NUM_COORDINATES)], axis=1)
        rooms = self.room(stepped.reshape(-1, NUM_COORDINATES), near_pairs)
        rooms = rooms.reshape(len(near_poses), 1 + NUM_COORDINATES, len(columns))
        slopes = np.swapaxes((rooms[:, 1:] - rooms[:, :1]) / _STEP, 1, 2)
        usable = is_near[near_poses][:, columns] & np.isfinite(slopes).all(axis=2)
        row, column = np.nonzero(usable)
        pose = near_poses[row]
        return NearLimit(pose, left[pose, columns[column]], slopes[row, column])

    def reachable_share(self, poses: Array) -> float:
        """Return the largest share of the way from home at which all poses (n, 6) keep the reach.

        It is at most 1, and accurate to 0.001.
        """
        m, least = self.mechanism, self.least[:NUM_LEGS] * self.mechanism.crank_lengths.min()

        def fits(share: float) -> bool:
            return bool(np.all(reach_margins(m, m.home + share * (poses - m.home)) >= least))

        if fits(1.0):
            return 1.0
        return border(fits, 0.0, 1.0, 1e-3)[0]

    def shrunk(self, rows: Array) -> Array:
        """Return the rows (n, 18) of a motion, shrunk towards home until they keep the reach."""
        return self.scaled(rows, self.reachable_share(rows[:, POSE]))

    def scaled(self, rows: Array, share: float) -> Array:
        """Return the rows (n, 18) of a motion, scaled about home."""
        if share == 1.0:
            return rows
        scaled = share * rows
        scaled[:, POSE] += (1 - share) * self.mechanism.home
        return scaled
