"""Machines that are singular at home."""

import dataclasses

import numpy as np

from stewart_drake.mechanism.geometry import Mechanism
from tests.mechanisms import PAPER


def stretched() -> Mechanism:
    """Leg 1 exactly at its dead centre at home: numbers without rounding, crank and rod in line."""
    p_WS, R_WS, p_PQ = PAPER.p_WS.copy(), PAPER.R_WS.copy(), PAPER.p_PQ.copy()
    p_WS[0], R_WS[0], p_PQ[0] = [-0.375, 0, 0.375], np.eye(3), [0.125, 0, 0]
    return dataclasses.replace(
        PAPER,
        name="stretched",
        home=np.array([0, 0, 0, 0, 0, 0.375]),
        p_WS=p_WS,
        R_WS=R_WS,
        p_PQ=p_PQ,
        crank_lengths=np.array([0.125, *PAPER.crank_lengths[1:]]),
        rod_lengths=np.array([0.375, *PAPER.rod_lengths[1:]]),
    )


def parallel_rods() -> Mechanism:
    """All rods vertical at home: they hold neither yaw nor shift. Cranks turn about `out`."""
    azimuth = np.arange(6) * np.pi / 3
    out = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(6)])
    up, across = np.array([0.0, 0.0, 1.0]), np.cross([0.0, 0.0, 1.0], out)
    p_PQ = 0.12 * out + 0.06 * across
    return dataclasses.replace(
        PAPER,
        name="parallel_rods",
        p_WS=PAPER.home[3:] + p_PQ - 0.35 * up - 0.1 * across,
        R_WS=np.stack([across, np.cross(out, across), out], axis=2),
        p_PQ=p_PQ,
        crank_lengths=np.full(6, 0.1),
        rod_lengths=np.full(6, 0.35),
        branches=np.full(6, -1.0),
    )
