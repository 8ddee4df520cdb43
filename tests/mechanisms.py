"""Random valid mechanisms and reachable poses for the tests; everything from a seeded generator."""

import dataclasses

import numpy as np

from stewart_drake.files.errors import ConfigError
from stewart_drake.mechanism.files import load_mechanism
from stewart_drake.mechanism.geometry import Body, Link, Mechanism
from stewart_drake.mechanism.kinematics import UnreachablePoseError, leg_geometry
from stewart_drake.types import Array

PAPER = load_mechanism("paper")
SPREAD = np.array([0.25, 0.25, 0.25, 0.03, 0.03, 0.06])
"""How far random poses lie from home, rad and m."""


def random_inertia(rng: np.random.Generator, scale: float) -> Array:
    """Three different principal moments that some rigid body has."""
    # Second moments of mass about three planes are free; moments of inertia are their sums.
    second_moments = scale * rng.uniform(0.1, 1.0, 3)
    return second_moments.sum() - second_moments


def random_mechanism(rng: np.random.Generator) -> Mechanism:
    """Return a mechanism without symmetry: legs, motor frames, lengths and inertias differ."""
    while True:
        tilt = [_small_rotation(rng, 0.3) for _ in range(6)]
        scale = rng.uniform(0.5, 3.0)
        home = PAPER.home + rng.normal(0, [0.05] * 3 + [0.01] * 3)
        try:
            mechanism = dataclasses.replace(
                PAPER,
                name="random",
                home=home * ([1] * 3 + [scale] * 3),
                p_WS=scale * (PAPER.p_WS + rng.normal(0, 0.01, (6, 3))),
                R_WS=np.array([t @ R for t, R in zip(tilt, PAPER.R_WS, strict=True)]),
                p_PQ=scale * (PAPER.p_PQ + rng.normal(0, 0.01, (6, 3))),
                crank_lengths=scale * PAPER.crank_lengths * rng.uniform(0.9, 1.1, 6),
                rod_lengths=scale * PAPER.rod_lengths * rng.uniform(0.97, 1.03, 6),
                plate=Body(rng.uniform(1, 10), random_inertia(rng, 1e-2)),
                crank=Link(rng.uniform(0.02, 0.5), random_inertia(rng, 1e-3), rng.uniform(0, 1)),
                rod=Link(rng.uniform(0.02, 0.5), random_inertia(rng, 1e-3), rng.uniform(0, 1)),
            )
            if np.abs(leg_geometry(mechanism, mechanism.home).transmission).min() > 0.3:
                return mechanism
        except (ConfigError, UnreachablePoseError):
            continue


def random_pose(
    rng: np.random.Generator, mechanism: Mechanism, least_transmission: float = 0.2
) -> Array:
    """Return a pose (6,) in reach, each leg arcsin(least_transmission) or more off dead centre."""
    size = mechanism.rod_lengths.mean() / PAPER.rod_lengths.mean()
    scale = SPREAD * ([1] * 3 + [size] * 3)
    while True:
        pose = mechanism.home + rng.uniform(-1, 1, 6) * scale
        try:
            if np.abs(leg_geometry(mechanism, pose).transmission).min() > least_transmission:
                return pose
        except UnreachablePoseError:
            continue


def _small_rotation(rng: np.random.Generator, size: float) -> Array:
    a = rng.uniform(-size, size, 3)
    angle = np.linalg.norm(a)
    K = np.cross(np.eye(3), a / angle)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
