"""Unknowns of a machine and its delay, and their prior.

The vector of unknowns is [parameters of the dynamics; numbers of the legs; offsets of the encoders;
delay]. An unknown without a tolerance is fixed.
"""

import dataclasses
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from stewart_drake.core.layout import LEG_NUMBERS
from stewart_drake.identification.model import LEG_PLACES, NUM_DYNAMIC, NUM_GEOMETRY, Numbers
from stewart_drake.identification.tolerances import Tolerances
from stewart_drake.mechanism.geometry import Mechanism, drawing_of, plate_radius
from stewart_drake.scenario import calibration
from stewart_drake.scenario.signals import (
    BALL_JOINT_FRICTION_SPEED,
    BIAS,
    CONSTANT_UNITS,
    CONSTANTS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    DEFAULT_BALL_JOINT_SPEED,
    DEFAULT_COULOMB_SPEED,
    LEGS,
    NUM_LEGS,
    PAYLOAD,
    PAYLOAD_POSITION,
)
from stewart_drake.types import Array

DYNAMIC: Final = slice(0, NUM_DYNAMIC)
GEOMETRY: Final = slice(NUM_DYNAMIC, NUM_DYNAMIC + NUM_GEOMETRY)
OFFSETS: Final = slice(GEOMETRY.stop, GEOMETRY.stop + NUM_LEGS)
DELAY: Final = OFFSETS.stop
NUM_UNKNOWNS: Final = DELAY + 1

_OF_A_LEG: Final = (
    *("crank_length", "rod_length"),
    *(f"plate_joint_{axis}" for axis in "xyz"),
    *(f"shaft_{axis}" for axis in "xyz"),
)
NAMES: Final = (
    *CONSTANTS,
    *(f"{name}_{leg}" for leg in LEGS for name in _OF_A_LEG),
    *(*calibration.OFFSETS, calibration.DELAY),
)
UNITS: Final = (*CONSTANT_UNITS, *("m",) * NUM_GEOMETRY, *("rad",) * NUM_LEGS, "s")
ONE_SIDED: Final = (DAMPING, COULOMB)  # unknowns that are not negative


@dataclass(frozen=True)
class Unknowns:
    """Prior of the unknowns."""

    mechanism: Mechanism  # as drawn
    mean: Array  # (NUM_UNKNOWNS,) in SI units
    std: Array  # (NUM_UNKNOWNS,), 0 for known ones

    @property
    def free(self) -> NDArray[np.intp]:
        """Places of the unknowns with a tolerance."""
        return np.flatnonzero(self.std > 0)

    def numbers(self, values: Array) -> Numbers:
        """Return the numbers of the machine with values (NUM_UNKNOWNS,) of the unknowns."""
        legs = self.mechanism.numbers[: LEG_NUMBERS * NUM_LEGS].reshape(-1, NUM_LEGS).T.copy()
        legs[:, LEG_PLACES] = values[GEOMETRY].reshape(NUM_LEGS, -1)
        return Numbers(values[DYNAMIC], legs)

    def whole(self, covariance: Array) -> Array:
        """Return the covariance of all unknowns, 0 for known ones, from that of the free ones."""
        found = np.zeros((NUM_UNKNOWNS, NUM_UNKNOWNS))
        found[np.ix_(self.free, self.free)] = covariance
        return found

    def at_delay(self, delay: float) -> Array:
        """Return the means (NUM_UNKNOWNS,) with a delay in s."""
        values = self.mean.copy()
        values[DELAY] = delay
        return values

    def without(self, known: slice) -> "Unknowns":
        """Return a prior in which these unknowns are known."""
        std = self.std.copy()
        std[known] = 0.0
        return dataclasses.replace(self, std=std)

    def machine(self, values: Array) -> Mechanism:
        """Return the mechanism with values (NUM_UNKNOWNS,) of the unknowns."""
        legs = values[GEOMETRY].reshape(NUM_LEGS, -1)
        return dataclasses.replace(
            self.mechanism,
            crank_lengths=legs[:, 0],
            rod_lengths=legs[:, 1],
            p_PQ=legs[:, 2:5],
            p_WS=legs[:, 5:8],
            drawn=drawing_of(self.mechanism),
        )


def unknowns_of(
    mechanism: Mechanism, tolerances: Tolerances, delay: float, torque: float, speed: float
) -> Unknowns:
    """Return the prior of a machine's unknowns, around the drawing and the believed delay.

    The largest commanded torque is the prior of bias and of friction at the largest crank speed.
    """
    mean, std = np.zeros(NUM_UNKNOWNS), np.zeros(NUM_UNKNOWNS)
    m, t = mechanism, tolerances
    legs = np.column_stack([m.crank_lengths, m.rod_lengths, m.p_PQ, m.p_WS])
    mean[GEOMETRY], mean[DELAY] = legs.ravel(), delay
    std[GEOMETRY] = np.tile([t.lengths] * 2 + [t.joints] * 6, NUM_LEGS)
    std[OFFSETS], std[DELAY] = t.offsets, t.delay
    mean[COULOMB_SPEED] = DEFAULT_COULOMB_SPEED
    mean[BALL_JOINT_FRICTION_SPEED] = DEFAULT_BALL_JOINT_SPEED
    for place, given, usual in (
        (BIAS, t.bias, torque),
        (PAYLOAD, t.payload, m.plate.mass),
        (DAMPING, t.damping, torque / speed),
        (COULOMB, t.coulomb, torque),
        (PAYLOAD_POSITION, t.position, plate_radius(m) / 2),
    ):
        std[place] = usual if given is None else given
    return Unknowns(mechanism, mean, std)
