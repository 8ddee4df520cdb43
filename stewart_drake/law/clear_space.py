"""Distances that a plan must keep: reach of the legs, and clearance between the links."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics.workspace import border
from stewart_drake.mechanism.clearance import APART, clearances
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import legs_along, reach_margins
from stewart_drake.scenario.signals import NUM_COORDINATES, NUM_LEGS, POSE
from stewart_drake.types import Array

RESERVE = 0.06
"""Distance to keep, of legs from the end of their reach and of links, in shortest cranks."""
_SHARE = 0.9
"""Largest share of the reference's own distances that is kept."""
_STEP = 1e-6
"""Step of the difference quotients, rad and m."""


class Near(NamedTuple):
    """Distances with little room."""

    pose: NDArray[np.intp]  # (r,) number of the pose of each
    room: Array  # (r,) distance beyond the least one, in cranks
    slopes: Array  # (r, 6) its derivative by the pose


@dataclass(frozen=True, eq=False)
class ClearSpace:
    """Distances at a pose, each with the least value that a plan keeps, in shortest cranks."""

    mechanism: Mechanism  # the machine
    pairs: NDArray[np.intp]  # (k,) indices of guarded pairs of links in `mechanism.clearance.APART`
    least: Array  # (6 + k,) least distances of the six legs and of the pairs

    @classmethod
    def along(cls, mechanism: Mechanism, poses: Array) -> "ClearSpace":
        """Return the distances to keep for a reference with these poses (n, 6).

        The distance is RESERVE, or a share of the reference's own if that is less. Pairs that touch
        somewhere on the reference, by their capsules, are not guarded. Where the reference itself
        is out of reach, the legs keep RESERVE.
        """
        unit, every = mechanism.crank_lengths.min(), np.arange(len(APART))
        margins = reach_margins(mechanism, poses)
        within = poses[np.all(margins > 0, axis=1)]
        within = within if len(within) else mechanism.home[None]
        legs = margins.min(axis=0) / unit
        apart = clearances(mechanism, within, legs_along(mechanism, within)).min(axis=0) / unit
        pairs = every[apart > 0]
        kept = np.concatenate([np.where(legs > 0, legs, np.inf), apart[pairs]])
        return cls(mechanism, pairs, np.minimum(RESERVE, _SHARE * kept))

    def room(self, poses: Array, pairs: NDArray[np.intp] | None = None) -> Array:
        """Return the distances (n, 6 + k) beyond the least ones at poses (n, 6), in cranks.

        Legs out of reach have negative ones, and links that cannot be placed then NaN. `pairs`
        are places of some of the guarded pairs, by default all.
        """
        m, unit = self.mechanism, self.mechanism.crank_lengths.min()
        chosen = slice(None) if pairs is None else pairs
        guarded, least = self.pairs[chosen], self.least[NUM_LEGS:][chosen]
        legs = reach_margins(m, poses) / unit - self.least[:NUM_LEGS]
        if len(guarded) == 0:
            return legs
        apart = clearances(m, poses, legs_along(m, poses), guarded) / unit - least
        return np.hstack([legs, apart])

    def near(self, poses: Array, below: float) -> Near:
        """Return the distances with less room than `below` at poses (n, 6), with their slopes."""
        room = self.room(poses)
        is_near = room < below
        at = np.flatnonzero(is_near.any(axis=1))
        pairs = np.flatnonzero(is_near[:, NUM_LEGS:].any(axis=0))
        columns = np.concatenate([np.arange(NUM_LEGS), NUM_LEGS + pairs])
        some = poses[at]
        moved = np.concatenate([some[:, None], some[:, None] + _STEP * np.eye(6)], axis=1)
        found = self.room(moved.reshape(-1, NUM_COORDINATES), pairs).reshape(
            len(at), 7, len(columns)
        )
        slopes = np.swapaxes((found[:, 1:] - found[:, :1]) / _STEP, 1, 2)
        row, column = np.nonzero(is_near[at][:, columns] & np.isfinite(slopes).all(axis=2))
        return Near(at[row], room[at[row], columns[column]], slopes[row, column])

    def shrunk(self, poses: Array) -> float:
        """Return the largest share of the way from home at which all poses (n, 6) keep the reach.

        To a tenth of a percent, and 1 where nothing needs to shrink.
        """
        home = self.mechanism.home
        legs = self.least[:NUM_LEGS] * self.mechanism.crank_lengths.min()

        def fits(share: float) -> bool:
            return bool(
                np.all(reach_margins(self.mechanism, home + share * (poses - home)) >= legs)
            )

        if fits(1.0):
            return 1.0
        return border(fits, 0.0, 1.0, 1e-3)[0]

    def within(self, rows: Array) -> Array:
        """Return the rows (n, 18) of a motion, shrunk towards home until they keep the reach."""
        return self.moved(rows, self.shrunk(rows[:, POSE]))

    def moved(self, rows: Array, share: float) -> Array:
        """Return the rows (n, 18) of a motion, with its distance from home times a share."""
        if share == 1.0:
            return rows
        moved = share * rows
        moved[:, POSE] += (1 - share) * self.mechanism.home
        return moved
