"""Whether the parts of a machine touch: along a motion, and around home.

Distances are those of `loop.clearance`; a negative one is the depth of an overlap. Links are
cranks, rods and plate. The base with its motors is reported apart, because the place of its disc is
a choice of the drawing, not a property of the machine.
"""

from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.loop.clearance import ClearanceScene, Pair
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import reach_margins
from stewart_drake.scenario.signals import NUM_COORDINATES
from stewart_drake.studies.workspace_map import Section, Travel, last_inside, poses_in_section
from stewart_drake.types import Array

EVERY: Final = 3
"""Grid stride: every third pose of a section is checked, along both sides."""
_STEPS: Final = 60


class Nearest(NamedTuple):
    """Two parts at their least distance in m (negative: overlap), at a time in s."""

    pair: Pair
    distance: float
    time: float

    @property
    def where(self) -> str:
        return f"{self.pair}, t = {self.time:.2f} s"

    @property
    def summary(self) -> dict[str, Any]:
        return {"parts": list(self.pair), "distance": self.distance, "time": self.time}


class ClearanceAlong(NamedTuple):
    """Clearance along a motion, as far as the legs reach."""

    time: Array  # (n,) s
    links: Array  # (n,) m, of the nearest two links; NaN out of reach
    base: Array  # (n,) m, of the part nearest to the base or its motors; NaN out of reach
    # least distance of every pair, the nearest first; empty if no pose is in reach
    nearest: list[Nearest]

    def least(self, fixed: bool) -> Nearest | None:
        """Return the nearest pair of links, or (`fixed`) the nearest pair with the base."""
        return next((one for one in self.nearest if one.pair.fixed == fixed), None)

    @property
    def disc(self) -> Nearest | None:
        """Nearest link to the base's disc, which is drawn and not in the machine's file."""
        return next((one for one in self.nearest if "base" in one.pair), None)

    @property
    def stand(self) -> Nearest | None:
        """Nearest link to a motor or a post."""
        fixed = (one for one in self.nearest if one.pair.fixed and "base" not in one.pair)
        return next(fixed, None)

    @property
    def touching(self) -> list[Nearest]:
        """Links that cross somewhere, the deepest first."""
        return [one for one in self.nearest if not one.pair.fixed and one.distance < 0]

    @property
    def crossings(self) -> list[str]:
        """Sentences about links that cross, and about a link inside the base's disc."""
        found, disc = list[str](), self.disc
        if self.touching:
            worst, count = self.touching[0], len(self.touching)
            pairs = "one pair of links crosses" if count == 1 else f"{count} pairs of links cross"
            found.append(f"{pairs}, at worst {-1e3 * worst.distance:.3g} mm deep ({worst.where})")
        if disc is not None and disc.distance < 0:
            deep = f"{-1e3 * disc.distance:.3g} mm"
            found.append(
                f"{disc.pair.second} dips {deep} below the base: cut it out, or raise the shafts"
            )
        return found


class ClearTravel(NamedTuple):
    """Travel of one coordinate from home, the others staying, until links touch; rad or m.

    A pair is None if the workspace ends before any two touch; `low` and `high` are then its end.
    """

    coordinate: str
    low: float
    high: float
    low_pair: Pair | None
    high_pair: Pair | None


class ClearSection(NamedTuple):
    """Distances in a section of the workspace.

    `distance` (len(y), len(x)) in m is that of the nearest two links, NaN outside the workspace.
    `touching` is the share of the poses inside at which links touch; NaN without any.
    """

    x: Array
    y: Array
    distance: Array
    touching: float


class ClearanceStudy(NamedTuple):
    """Clearance of a machine along a motion and around home.

    `home` has the nearest two links at home, None for a home pose outside the workspace.
    """

    along: ClearanceAlong
    home: Nearest | None
    travel: list[ClearTravel]
    sections: list[ClearSection]

    @property
    def verdict(self) -> str:
        least, apart = self.along.least(fixed=False), list[str]()
        if least is None:
            return "no pose is in reach, so that nothing is known of links that touch"
        if least.distance >= 0:
            apart = [f"links stay {1e3 * least.distance:.3g} mm apart at least ({least.where})"]
        return "; ".join(apart + self.along.crossings)

    @property
    def summary(self) -> dict[str, Any]:
        pairs = {
            "least": self.along.least(fixed=False),
            "base": self.along.least(fixed=True),
            "home": self.home,
        }
        return {
            "verdict": self.verdict,
            **{name: None if one is None else one.summary for name, one in pairs.items()},
            "touching": [one.summary for one in self.along.touching],
            "pairs": [one.summary for one in self.along.nearest],
            "travel": [one._asdict() for one in self.travel],
            "touching_share_of_sections": [section.touching for section in self.sections],
        }


def study_clearance(
    mechanism: Mechanism,
    time: Array,
    poses: Array,
    travel: list[Travel],
    sections: list[Section],
) -> ClearanceStudy:
    """Check a motion of `poses` (n, 6) at `time` (n,), and the given parts of the workspace."""
    links = ClearanceScene(mechanism, base=False)
    return ClearanceStudy(
        along=clearance_along(ClearanceScene(mechanism), mechanism, time, poses),
        home=_nearest(links, mechanism.home) if travel else None,
        travel=[_clear_travel(links, mechanism, k, one) for k, one in enumerate(travel)],
        sections=[_clear_section(links, mechanism, one) for one in sections],
    )


def clearance_along(
    scene: ClearanceScene, mechanism: Mechanism, time: Array, poses: Array
) -> ClearanceAlong:
    """Return the clearance at the poses (n, 6) that are in reach."""
    distances = np.full((len(time), len(scene.pairs)), np.nan)
    for k in np.flatnonzero((reach_margins(mechanism, poses) > 0).all(axis=1)):
        distances[k] = scene.distances(poses[k])
    seen = np.flatnonzero(np.isfinite(distances[:, 0]))
    rows = seen[distances[seen].argmin(axis=0)] if len(seen) else []
    nearest = [
        Nearest(pair, float(distances[row, k]), float(time[row]))
        for k, (pair, row) in enumerate(zip(scene.pairs, rows, strict=bool(len(seen))))
    ]
    fixed = np.array([pair.fixed for pair in scene.pairs])
    links = distances[:, ~fixed].min(axis=1)
    base = distances[:, fixed].min(axis=1, initial=np.inf)
    return ClearanceAlong(time, links, base, sorted(nearest, key=lambda one: one.distance))


def _nearest(scene: ClearanceScene, pose: Array) -> Nearest:
    distances = scene.distances(pose)
    k = int(distances.argmin())
    return Nearest(scene.pairs[k], float(distances[k]), 0.0)


def _clear_travel(
    scene: ClearanceScene, mechanism: Mechanism, number: int, whole: Travel
) -> ClearTravel:
    axis = np.eye(NUM_COORDINATES)[number]

    def end(limit: float, direction: float) -> tuple[float, Pair | None]:
        def at(s: float) -> Array:
            return mechanism.home + s * direction * axis

        def clear(s: float) -> bool:
            return bool(scene.distances(at(s)).min() >= 0)

        if not clear(0.0):
            return 0.0, _nearest(scene, mechanism.home).pair
        # Slightly inside: at the very end rounding may put a leg out of reach.
        limit *= 1 - 1e-6
        s = last_inside(clear, limit, _STEPS, tolerance=1e-3 * limit)
        return s, None if s == limit else _nearest(scene, at(s + 1e-3 * limit)).pair

    (low, low_pair), (high, high_pair) = end(-whole.low, -1.0), end(whole.high, 1.0)
    return ClearTravel(whole.coordinate, 0.0 - low, high, low_pair, high_pair)


def _clear_section(scene: ClearanceScene, mechanism: Mechanism, section: Section) -> ClearSection:
    x, y = section.x[::EVERY], section.y[::EVERY]
    inside = np.isfinite(section.condition[::EVERY, ::EVERY])
    poses = poses_in_section(mechanism, (section.first, section.second), x, y)
    seen = np.array([scene.distances(pose).min() for pose in poses[inside]])
    distance = np.full(inside.shape, np.nan)
    distance[inside] = seen
    return ClearSection(x, y, distance, float(np.mean(seen < 0)) if len(seen) else np.nan)
