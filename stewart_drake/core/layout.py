"""The numbers of a machine, as the core takes them."""

from typing import Final

from stewart_drake.scenario.signals import NUM_LEGS

DEFAULT_GRAVITY: Final = 9.81
"""Gravity along -z of W, m/s^2; Drake's default."""
DEAD_CENTRE_SINE: Final = 0.01
"""Sine of the crank's angle off dead centre at which a leg counts as out of reach.

At a dead centre pose coordinates are singular: alpha_dot grows like 1 / sine.
"""
LEG_NUMBERS: Final = 20
"""Numbers of a leg, in this order: lengths of crank and rod, branch, R_WS by columns (9), p_PQ (3),
p_WS (3), whether the ball joints at crank and plate have friction (2). `GEOMETRY` has each of them
for six legs before the next one, then the common numbers."""
COMMON_NUMBERS: Final = 13
"""Numbers of all legs and the plate, in this order: mass and inertia (3) of the plate; mass, centre
and inertia about the motor axis of the crank; mass, centre and inertia (3) of the rod; the plate's
mean radius."""
MEASURES: Final = NUM_LEGS + 2
"""Six sines off dead centre, the measure of parallel singularity, minus |pitch|."""
GEOMETRY: Final = NUM_LEGS * LEG_NUMBERS + COMMON_NUMBERS
