"""Machines that are singular at home, and mechanism files of any machine."""

import dataclasses
import json
from pathlib import Path

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


def write_mechanism(mechanism: Mechanism, path: Path) -> Path:
    """Return a mechanism file with explicit legs; JSON is YAML."""
    legs = [
        {
            "shaft": p_WS.tolist(),
            "motor_axis": R_WS[:, 2].tolist(),
            "crank_zero": R_WS[:, 0].tolist(),
            "plate_joint": p_PQ.tolist(),
            "branch": int(branch),
        }
        for p_WS, R_WS, p_PQ, branch in zip(
            mechanism.p_WS, mechanism.R_WS, mechanism.p_PQ, mechanism.branches, strict=True
        )
    ]
    bodies = {
        name: {"mass": body.mass, "inertia": body.inertia.tolist()}
        for name, body in (("base", mechanism.base), ("plate", mechanism.plate))
    }
    links = {
        name: {
            "length": lengths.tolist(),
            "mass": link.mass,
            "inertia": link.inertia.tolist(),
            "center": link.center,
        }
        for name, link, lengths in (
            ("crank", mechanism.crank, mechanism.crank_lengths),
            ("rod", mechanism.rod, mechanism.rod_lengths),
        )
    }
    head = {"name": mechanism.name, "home": mechanism.home.tolist()}
    motor = {"motor": {"effort_limit": mechanism.effort_limit}}
    path.write_text(json.dumps(head | bodies | links | motor | {"legs": legs}, indent=1))
    return path
