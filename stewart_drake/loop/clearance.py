"""Distances between the parts of a machine: Drake's distances between the shapes of its model.

The machine is alone in a scene, and pairs are queried one by one, without collision filters. Rods
have round ends here, like the joints at them. Drake's iteration for two long cylinders stops early,
with errors of 0.6 mm at 1 mm between flat ends and 0.09 mm between round ones. The distance of two
rods is therefore that of their centre lines in closed form less two radii, exact for capsules. The
distance of a rod and a crank is Drake's, some tenths of a percent too large at most.
"""

import re
from itertools import combinations
from typing import Any, Final, NamedTuple, cast

import numpy as np
from pydrake.geometry import Capsule, Cylinder, GeometryId, QueryObject, Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from stewart_drake.loop.platforms import add_mechanism, add_scene, set_pose
from stewart_drake.mechanism.clearance import LINKS, center_lines, proportions, segment_distances
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.mechanism.kinematics import legs_along
from stewart_drake.scenario.signals import NUM_LEGS
from stewart_drake.types import Array

_AT_REST: Final = np.zeros(6)


class Pair(NamedTuple):
    """Two parts without a common joint, such as `crank 2` and `rod 1`."""

    first: str
    second: str

    @property
    def fixed(self) -> bool:
        """Whether one of them belongs to the base."""
        return any(name.split()[0] in ("base", "motor", "post") for name in self)

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class ClearanceScene:
    """A machine alone in a scene, for distances between its parts.

    Args:
        mechanism: the machine.
        base: whether to include its base, motors and posts.

    Attributes:
        pairs: pairs of parts in the order of `distances`.
    """

    def __init__(self, mechanism: Mechanism, base: bool = True) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = add_scene(builder)
        add_mechanism(plant, mechanism, collision=True)
        _round_off(scene_graph, plant)
        self._mechanism, self._plant = mechanism, plant
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._tree = plant.GetMyMutableContextFromRoot(self._context)
        self._query: Any = scene_graph.get_query_output_port()
        self._shapes = scene_graph.GetMyContextFromRoot(self._context)
        parts = _parts(scene_graph)
        pairs = [Pair(*names) for names in combinations(parts, 2) if not _joined(*names)]
        self.pairs = tuple(pair for pair in pairs if base or not pair.fixed)
        self._ids = [(parts[pair.first], parts[pair.second]) for pair in self.pairs]
        rods = {LINKS[i]: i for i in range(NUM_LEGS, len(LINKS))}
        of_rods = [k for k, pair in enumerate(self.pairs) if all(name in rods for name in pair)]
        others = [k for k in range(len(self.pairs)) if k not in of_rods]
        self._of_rods, self._others = np.array(of_rods), np.array(others)
        self._rods = np.array([[rods[name] for name in self.pairs[k]] for k in of_rods]).T

    def distances(self, pose: Array) -> Array:
        """Return the distances of all pairs (p,), in m, at a pose (6,); negative for an overlap.

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        m = self._mechanism
        set_pose(self._plant, self._tree, m, pose, _AT_REST)
        query = cast(QueryObject, self._query.Eval(self._shapes))
        found = np.empty(len(self.pairs))
        found[self._others] = [
            query.ComputeSignedDistancePairClosestPoints(*self._ids[k]).distance
            for k in self._others
        ]
        one = np.asarray(pose)[None]
        start, along = (x[0] for x in center_lines(m, one, legs_along(m, one)))
        first, second = self._rods
        apart = segment_distances(start[first], along[first], start[second], along[second])
        found[self._of_rods] = apart - 2 * proportions(m).rod_radius
        return found


def _round_off(scene_graph: SceneGraph, plant: MultibodyPlant) -> None:
    """Replace the cylinders of the rods by capsules."""
    for shape in scene_graph.model_inspector().GetAllGeometryIds(Role.kProximity):
        inspector = scene_graph.model_inspector()
        if inspector.GetName(shape).endswith("tube"):
            tube = cast(Cylinder, inspector.GetShape(shape))
            capsule = Capsule(tube.radius(), tube.length())
            scene_graph.ChangeShape(cast(Any, plant.get_source_id()), shape, capsule)


def _parts(scene_graph: SceneGraph) -> dict[str, GeometryId]:
    """Return the shapes by name: `base`, `motor 1`, `post 1`, `plate`, `crank 1`, `rod 1`."""
    inspector, found = scene_graph.model_inspector(), {}
    for shape in inspector.GetAllGeometryIds(Role.kProximity):
        body = inspector.GetName(inspector.GetFrameId(shape)).split("::")[-1]
        name = inspector.GetName(shape).split("::")[-1]
        on_base = body == "base" and name != "disc"
        found[(name if on_base else body).replace("_", " ")] = shape
    return {name: found[name] for name in sorted(found, key=_place)}


def _place(name: str) -> tuple[int, str]:
    kinds = ("base", "motor", "post", "plate", "crank", "rod")
    return kinds.index(name.split()[0]), name


def _joined(first: str, second: str) -> bool:
    """Return whether two parts belong to one body or meet in a joint."""
    kinds = {name.split()[0] for name in (first, second)}
    if kinds <= {"base", "motor", "post"} or kinds == {"plate", "rod"}:
        return True
    same_leg = len({re.sub("[^0-9]", "", name) for name in (first, second)}) == 1
    return same_leg and kinds in ({"motor", "crank"}, {"post", "crank"}, {"crank", "rod"})
