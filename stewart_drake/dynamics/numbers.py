"""A mechanism's numbers as the equations take them: floats, or symbols in their place.

With floats an expression is that of one machine. With symbols it is that of every machine, whose
geometry (`mechanism.geometry.geometry_of`) is one more argument.
"""

from typing import NamedTuple

import casadi as ca

from stewart_drake.core.layout import COMMON_NUMBERS, LEG_NUMBERS
from stewart_drake.mechanism.geometry import Mechanism, plate_radius

Number = float | ca.SX
Numbers = ca.DM | ca.SX


class LegNumbers(NamedTuple):
    """Of one leg; see `Mechanism`."""

    crank_length: Number
    rod_length: Number
    branch: Number
    R_WS: Numbers
    p_PQ: Numbers
    p_WS: Numbers
    symbols: tuple[ca.SX, ...] = ()
    """What a function of them takes beside its arguments: nothing where they are floats."""


class CommonNumbers(NamedTuple):
    """Of plate, cranks and rods; the crank's inertia is that about the motor axis."""

    plate_mass: Number
    plate_inertia: Numbers
    crank_mass: Number
    crank_center: Number
    crank_inertia: Number
    rod_mass: Number
    rod_center: Number
    rod_inertia: tuple[Number, Number, Number]
    radius: Number
    """Mean distance of the plate's joints from its COM, m."""
    symbols: tuple[ca.SX, ...] = ()


def numbers_of(mechanism: Mechanism) -> tuple[list[LegNumbers], CommonNumbers]:
    """Floats: those of a machine."""
    m = mechanism
    legs = [
        LegNumbers(float(u), float(rod), float(branch), ca.DM(R_WS), ca.DM(p_PQ), ca.DM(p_WS))
        for u, rod, branch, R_WS, p_PQ, p_WS in zip(
            m.crank_lengths, m.rod_lengths, m.branches, m.R_WS, m.p_PQ, m.p_WS, strict=True
        )
    ]
    I_a, I_y, I_t = (float(moment) for moment in m.rod.inertia)
    common = CommonNumbers(
        m.plate.mass,
        ca.DM(m.plate.inertia),
        m.crank.mass,
        m.crank.center,
        float(m.crank.inertia[2]),
        m.rod.mass,
        m.rod.center,
        (I_a, I_y, I_t),
        plate_radius(m),
    )
    return legs, common


def leg_numbers(symbols: ca.SX) -> LegNumbers:
    """What stands where in the part of a leg (18,) of the geometry."""
    u, rod, branch, R_WS, p_PQ, p_WS = ca.vertsplit(symbols, [0, 1, 2, 3, 12, 15, LEG_NUMBERS])
    return LegNumbers(u, rod, branch, ca.reshape(R_WS, 3, 3), p_PQ, p_WS, (symbols,))


def common_numbers(symbols: ca.SX) -> CommonNumbers:
    """What stands where in the part (13,) of the geometry that is not of a leg."""
    ends = [0, 1, *range(4, COMMON_NUMBERS + 1)]
    plate, inertia, m, center, I_crank, rod, f, I_a, I_y, I_t, radius = ca.vertsplit(symbols, ends)
    moments = I_a, I_y, I_t
    return CommonNumbers(plate, inertia, m, center, I_crank, rod, f, moments, radius, (symbols,))
