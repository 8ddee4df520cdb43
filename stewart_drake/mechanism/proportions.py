"""How thick the parts of a machine are, in proportion to its lengths: its file does not say."""

from typing import NamedTuple

from stewart_drake.mechanism.kinematics import Legs


class Proportions(NamedTuple):
    """Of the shapes that are drawn and that collide, in m."""

    crank_thickness: float
    """Along the motor axis."""
    crank_width: float
    motor_radius: float
    motor_length: float
    rod_radius: float
    plate_thickness: float


def proportions(mechanism: Legs) -> Proportions:
    """By the shortest crank and the shortest rod."""
    u, rod = float(mechanism.crank_lengths.min()), float(mechanism.rod_lengths.min())
    thickness = 0.10 * u
    return Proportions(
        crank_thickness=thickness,
        crank_width=1.6 * thickness,
        motor_radius=0.22 * u,
        motor_length=0.40 * u,
        rod_radius=0.012 * rod,
        plate_thickness=0.03 * rod,
    )
