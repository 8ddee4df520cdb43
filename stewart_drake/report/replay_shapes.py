"""The shapes that stand for the reference in a replay, as triangles around the plate's centre."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_RING: Final = (1.14, 0.022)
"""Radius of the ring and of its wire, in units of the drawn plate's radius."""


def ring(radius: float, around: int = 72, across: int = 8) -> tuple[Array, NDArray[np.int32]]:
    """Vertices (3, n) and triangles (3, m) of a torus in the plate's plane."""
    reach, wire = (factor * radius for factor in _RING)
    a, b = np.meshgrid(
        2 * np.pi * np.arange(around) / around, 2 * np.pi * np.arange(across) / across
    )
    distance = reach + wire * np.cos(b)
    vertices = np.array([distance * np.cos(a), distance * np.sin(a), wire * np.sin(b)])
    j, i = np.meshgrid(np.arange(around), np.arange(across))
    corner = [
        (i + di) % across * around + (j + dj) % around
        for di, dj in ((0, 0), (0, 1), (1, 1), (1, 0))
    ]
    faces = np.array(
        [[corner[k].ravel() for k in face] for face in ((0, 1, 2), (0, 2, 3))], dtype=np.int32
    )
    return vertices.reshape(3, -1), np.hstack(list(faces))


def pointer(radius: float) -> tuple[Array, NDArray[np.int32]]:
    """An arrowhead outside the ring, where the plate's x axis points."""
    reach, wire = (factor * radius for factor in _RING)
    base, tip = reach + wire, 1.3 * reach
    corners = [(base, y, z) for y in (-4 * wire, 4 * wire) for z in (-wire, wire)]
    vertices = np.array([*corners, (tip, 0, -wire), (tip, 0, wire)]).T
    faces = [(0, 2, 4), (1, 5, 3), (0, 1, 3), (0, 3, 2), (0, 4, 5), (0, 5, 1), (2, 3, 5), (2, 5, 4)]
    return vertices, np.array(faces, dtype=np.int32).T
