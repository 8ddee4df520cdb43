"""Distances between the parts of a machine.

Drake computes them from the shapes of the model, pair by pair, without collision filters. Here rods
have round ends, like the joints at them. Drake's iteration stops early for two long cylinders: at a
distance of 1 mm its error is 0.6 mm with flat ends, 0.09 mm with round ones. The distance of two
rods is therefore that of their centre lines in closed form less two radii, exact for capsules. The
distance of a rod and a crank is Drake's, at most some tenths of a percent too large.
"""

import re
from itertools import combinations
from typing import Any, Final, NamedTuple, cast

import numpy as np
from pydrake.geometry import Capsule, Cylinder, GeometryId, QueryObject, Role, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from stewart_drake.loop.platforms import add_mechanism, add_scene, set_pose
from stewart_drake.mechanism.clearance import LINK_PAIRS, LINKS, clearances
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

_AT_REST: Final = np.zeros(6)
_ON_BASE: Final = {"base", "motor", "post"}
"""Kinds of parts that belong to the base."""


class Pair(NamedTuple):
    """Two parts without a common joint, such as `crank 2` and `rod 1`."""

    first: str
    second: str

    @property
    def fixed(self) -> bool:
        return any(_kind(name) in _ON_BASE for name in self)

    def __str__(self) -> str:
        return f"{self.first} and {self.second}"


class ClearanceScene:
    """A machine alone in a scene, for distances between its parts.

    Args:
        base: whether to include pairs with its base, motors and posts.

    Attributes:
        pairs: pairs of parts in the order of `distances`.
    """

    def __init__(self, mechanism: Mechanism, base: bool = True) -> None:
        builder = DiagramBuilder()
        plant, scene_graph = add_scene(builder)
        add_mechanism(plant, mechanism, collision=True)
        _round_rod_ends(scene_graph, plant)
        self._mechanism, self._plant = mechanism, plant
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = plant.GetMyMutableContextFromRoot(self._context)
        self._query_port: Any = scene_graph.get_query_output_port()
        self._scene_context = scene_graph.GetMyContextFromRoot(self._context)
        parts = _parts(scene_graph)
        pairs = [Pair(*names) for names in combinations(parts, 2) if not _joined(*names)]
        self.pairs = tuple(pair for pair in pairs if base or not pair.fixed)
        self._ids = [(parts[pair.first], parts[pair.second]) for pair in self.pairs]
        two_rods = np.array([all(_kind(name) == "rod" for name in pair) for pair in self.pairs])
        self._rod_pairs, self._other_pairs = np.flatnonzero(two_rods), np.flatnonzero(~two_rods)
        rods = (tuple(map(LINKS.index, self.pairs[k])) for k in self._rod_pairs)
        self._rods = [LINK_PAIRS.index(pair) for pair in rods]

    def distances(self, pose: Array) -> Array:
        """Return the distances of all pairs (p,), in m, at a pose (6,); negative for an overlap.

        Raises:
            UnreachablePoseError: the pose is out of reach.
        """
        set_pose(self._plant, self._plant_context, self._mechanism, pose, _AT_REST)
        query = cast(QueryObject, self._query_port.Eval(self._scene_context))
        distances = np.empty(len(self.pairs))
        distances[self._other_pairs] = [
            query.ComputeSignedDistancePairClosestPoints(*self._ids[k]).distance
            for k in self._other_pairs
        ]
        apart = clearances(self._mechanism, np.asarray(pose)[None])[0]
        distances[self._rod_pairs] = apart[self._rods]
        return distances


def _round_rod_ends(scene_graph: SceneGraph, plant: MultibodyPlant) -> None:
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
        on_base = body == "base" and name != "disc"  # motors and posts; the disc is the base
        found[(name if on_base else body).replace("_", " ")] = shape
    return {name: found[name] for name in sorted(found, key=_order)}


def _kind(name: str) -> str:
    """Return the kind of a part: `crank` of `crank 1`."""
    return name.split()[0]


def _order(name: str) -> tuple[int, str]:
    return ("base", "motor", "post", "plate", "crank", "rod").index(_kind(name)), name


def _joined(first: str, second: str) -> bool:
    """Return whether two parts belong to one body or meet in a joint."""
    kinds = {_kind(first), _kind(second)}
    if kinds <= _ON_BASE or kinds == {"plate", "rod"}:
        return True
    same_leg = len({re.sub("[^0-9]", "", name) for name in (first, second)}) == 1
    return same_leg and kinds in ({"motor", "crank"}, {"post", "crank"}, {"crank", "rod"})
