"""Moments of inertia that a mechanism file leaves out, and those of rotors behind gears.

*Bar*, of length L, diameter d and mass m: with the density m/(pi d^2/4 L) constant,

    about its axis     I_x = integral of r^2 dm           = m d^2/8
    across it          I_y = I_z = integral of x^2 dm + half of I_x = m (L^2/12 + d^2/16).

How thick a crank or rod is no file tells; a bar THINNESS times as long as thick is taken, for which
the second term is 0.2 % of the first. A slender rod is the limit d = 0, which no rigid body with a
spin of its own can have.

*Disc*, thin, of radius R and mass m: I_z = integral of r^2 dm = m R^2/2 about its axis, and since
I_z = I_x + I_y for anything flat, m R^2/4 across it.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.types import Array

THINNESS: Final = 20.0
"""Length of an estimated crank or rod, in its diameters."""


def bar_inertia(mass: float, length: float) -> Array:
    """Principal moments (3,) in kg m^2, along and twice across, of a uniform round bar.

    Args:
        mass: kg.
        length: m; the bar is THINNESS times as long as thick.
    """
    diameter = length / THINNESS
    across = length**2 / 12 + diameter**2 / 16
    return mass * np.array([diameter**2 / 8, across, across])


def disc_inertia(mass: float, radius: float) -> Array:
    """Principal moments (3,) in kg m^2 of a thin uniform disc, the last about its axis.

    Args:
        mass: kg.
        radius: m.
    """
    return mass * radius**2 * np.array([0.25, 0.25, 0.5])


def with_rotors(mechanism: Mechanism, inertia: float) -> Mechanism:
    """Return the machine with a rotor at each shaft.

    A rotor of moment I that turns N times as fast as its crank has the energy I (N a')^2 / 2, as if
    the crank had N^2 I more about the motor axis; the axis stands still, so that no other moment of
    a crank counts. Half of it goes to each of these, as for a thin disk: a body has no moment that
    is larger than the other two together.

    Args:
        mechanism: without them.
        inertia: N^2 I in kg m^2.
    """
    if inertia == 0:
        return mechanism
    crank = mechanism.crank
    disk = inertia * np.array([0.5, 0.5, 1.0])
    return replace(mechanism, crank=replace(crank, inertia=crank.inertia + disk))
