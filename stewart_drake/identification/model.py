"""The machine with its numbers as unknowns: slopes of accelerations and crank angles.

With the residual F = M nu_dot + h - B tau of the equations of motion, zero for the accelerations a
that a torque gives, every derivative at constant a is that of a itself by

    da/dz = -(M N)^-1 dF/dz,   nu_dot = N a + ...,

for z the state, parameters of the dynamics, or numbers of a leg (core/shooting.h).
"""

from typing import Any, Final, NamedTuple

import numpy as np

from stewart_drake.core.layout import LEG_NUMBERS
from stewart_drake.core.library import core
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.mechanism.kinematics import Legs, angle_rate_map, dot, legs_along, rotation
from stewart_drake.scenario.signals import (
    ANGLES,
    NUM_CONSTANTS,
    NUM_COORDINATES,
    NUM_LEGS,
    NUM_STATE,
)
from stewart_drake.types import Array

LEG_PLACES: Final = (0, 1, 12, 13, 14, 15, 16, 17)
"""In a leg's numbers (`mechanism.geometry.geometry_of`): crank, rod, plate joint, shaft; m."""
PER_LEG: Final = len(LEG_PLACES)
NUM_GEOMETRY: Final = NUM_LEGS * PER_LEG
NUM_DYNAMIC: Final = NUM_CONSTANTS  # parameters of the dynamics; a log has no wrench


class Numbers(NamedTuple):
    parameters: Array  # (NUM_DYNAMIC,) of the dynamics
    legs: Array  # (6, LEG_NUMBERS), see `core.layout`


class Slopes(NamedTuple):
    """Accelerations at a point, and their derivatives."""

    accelerations: Array  # (6,)
    state: Array  # (6, 12)
    numbers: Array  # (6, NUM_DYNAMIC + NUM_GEOMETRY)


class MachineModel:
    """Accelerations and crank angles of a machine with any numbers, and their derivatives.

    Bodies, motor frames and branches stay. Gravity is along -z. `free_legs` is whether derivatives
    by the numbers of the legs are wanted, which take most of the time.
    """

    def __init__(self, mechanism: Mechanism, gravity: float, free_legs: bool = True) -> None:
        self.mechanism, self.gravity, self.free_legs = mechanism, gravity, free_legs

    def plant(self, numbers: Numbers) -> tuple[Any, object]:
        """Return a `stewart_plant` with these numbers, and the memory that it uses."""
        geometry, parameters = geometry_of(self.mechanism).copy(), plant_parameters()
        geometry[: LEG_NUMBERS * NUM_LEGS] = numbers.legs.T.ravel()
        parameters[:NUM_DYNAMIC] = numbers.parameters
        kept = [core().at(one) for one in (geometry, parameters, np.array([self.gravity]))]
        return core().plant(*kept), kept

    def slopes(self, state: Array, torque: Array, numbers: Numbers) -> Slopes:
        """Return accelerations and derivatives at a state (12,) under a torque (6,)."""
        plant, _kept = self.plant(numbers)
        columns = NUM_DYNAMIC + NUM_GEOMETRY * self.free_legs
        found = Slopes(*(np.empty(6 * n) for n in (1, NUM_STATE, columns)))
        core().call("slopes", plant, self.free_legs, np.array(state), np.array(torque), *found)
        return Slopes(found[0], found[1].reshape(6, -1), found[2].reshape(6, -1))

    def crank_angles(self, poses: Array, numbers: Numbers) -> tuple[Array, Array, Array]:
        """Return angles (..., 6), d/dpose (..., 6, 6) and d/dgeometry (..., 6, NUM_GEOMETRY).

        They are NaN out of reach. With r the rod's direction, t that of the crank's tip, e the
        crank's, u and l the lengths, and Q, W the plate joint and the shaft,

            u r.t d alpha = r.(dQ - dW) - r.e du - dl.
        """
        legs = Legs(
            p_WS=numbers.legs[:, 15:18],
            R_WS=numbers.legs[:, 3:12].reshape(-1, 3, 3).swapaxes(1, 2),
            p_PQ=numbers.legs[:, 12:15],
            crank_lengths=numbers.legs[:, 0],
            rod_lengths=numbers.legs[:, 1],
            branches=numbers.legs[:, 2],
        )
        flat = poses.reshape(-1, NUM_COORDINATES)
        turns = flat[:, ANGLES]
        E = np.array([angle_rate_map(one) for one in turns])
        with np.errstate(all="ignore"):
            at = legs_along(legs, flat)
            lever = (legs.crank_lengths * at.transmission)[..., None]
            by_pose = np.concatenate([np.cross(at.p_PQ_W, at.rod) @ E, at.rod], axis=2) / lever
            stretch = -dot(at.rod, at.crank)[..., None]
            lengths = np.concatenate([stretch, -np.ones_like(stretch)], axis=2)
            of_leg = np.concatenate([lengths, at.rod @ rotation(turns), -at.rod], axis=2) / lever
        by_geometry = np.zeros((len(flat), NUM_LEGS, NUM_LEGS, PER_LEG))
        by_geometry[:, range(NUM_LEGS), range(NUM_LEGS)] = of_leg
        shape = poses.shape[:-1]
        return (
            at.crank_angles.reshape(*shape, NUM_LEGS),
            by_pose.reshape(*shape, NUM_LEGS, NUM_COORDINATES),
            by_geometry.reshape(*shape, NUM_LEGS, NUM_GEOMETRY),
        )
