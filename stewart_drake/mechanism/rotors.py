"""Rotors behind gears, as part of the cranks that they turn."""

from dataclasses import replace

import numpy as np

from stewart_drake.mechanism.geometry import Mechanism


def with_rotors(mechanism: Mechanism, inertia: float) -> Mechanism:
    """The machine with a rotor at each shaft.

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
