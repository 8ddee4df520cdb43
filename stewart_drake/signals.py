"""Names, sizes and slices of every vector that crosses a port (DESIGN: block order, SI units).

Nothing else in the package does index arithmetic on these vectors.
"""

from typing import Final

COORDINATES: Final = ("phi", "theta", "psi", "x", "y", "z")
COORDINATE_NAMES: Final = ("roll", "pitch", "yaw", "x", "y", "z")
"""The same for a person, and in files that a person writes."""
COORDINATE_UNITS: Final = ("rad", "rad", "rad", "m", "m", "m")
LEGS: Final = (1, 2, 3, 4, 5, 6)
"""Legs are numbered from one wherever a person reads the number."""

NUM_LEGS: Final = 6
NUM_COORDINATES: Final = 6
NUM_TORQUES: Final = NUM_LEGS
NUM_STATE: Final = 2 * NUM_COORDINATES
"""`state` = [pose(6); rates(6)]."""
NUM_REFERENCE: Final = 3 * NUM_COORDINATES
"""`reference` = [pose(6); rates(6); accelerations(6)]."""

POSE: Final = slice(0, 6)
RATES: Final = slice(6, 12)
ACCELERATIONS: Final = slice(12, 18)

ANGLES: Final = slice(0, 3)
"""Roll, pitch, yaw inside a pose."""
POSITION: Final = slice(3, 6)
"""xyz inside a pose."""

PARAMETERS: Final = (*(f"torque_bias_{leg}" for leg in LEGS), "payload_mass", "joint_damping")
"""Constant plant parameters that nobody tells the controller, in this order."""
PARAMETER_UNITS: Final = (*("N m",) * 6, "kg", "N m s/rad")
NUM_PARAMETERS: Final = len(PARAMETERS)
BIAS: Final = slice(0, 6)
PAYLOAD: Final = 6
DAMPING: Final = 7

WEIGHTS: Final = ("w_Q", "w_R")

TUNER_INPUTS: Final = (
    *(f"error_{name}" for name in COORDINATES),
    *(f"rate_error_{name}" for name in COORDINATES),
    *(f"torque_{leg}" for leg in LEGS),
)
"""What densities are taken of: `sample` = [state error(12); commanded torque(6)]."""


def queue_length(steps: int, fraction: float) -> int:
    """Number of torques in flight at a sampling instant: mu, and one more when eta0 > 0."""
    return steps + (1 if fraction > 0 else 0)
