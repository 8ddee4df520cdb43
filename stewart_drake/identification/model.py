"""The machine with its numbers as unknowns: accelerations, crank angles and their derivatives.

With the residual F = M nu_dot + h - B tau of the equations of motion, zero for the accelerations a
that a torque gives, every derivative at constant a is that of a itself by

    da/dz = -(M N)^-1 dF/dz,   nu_dot = N a + ...,

for z the state, parameters of the dynamics, or numbers of a leg. The expressions are those of
`dynamics.equations`; only the legs' numbers are symbols.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from stewart_drake.core.layout import LEG_NUMBERS
from stewart_drake.dynamics import equations
from stewart_drake.dynamics.equations import leg_numbers, numbers_of
from stewart_drake.dynamics.native_functions import NativeFunction
from stewart_drake.dynamics.stewart import plant_parameters
from stewart_drake.mechanism.geometry import Mechanism, geometry_of
from stewart_drake.scenario.signals import (
    NUM_CONSTANTS,
    NUM_COORDINATES,
    NUM_LEGS,
    NUM_STATE,
    WRENCHES,
)
from stewart_drake.types import Array

LEG_PLACES: Final = (0, 1, 12, 13, 14, 15, 16, 17)
"""In a leg's numbers (`mechanism.geometry.geometry_of`): crank, rod, plate joint, shaft; m."""
PER_LEG: Final = len(LEG_PLACES)
NUM_GEOMETRY: Final = NUM_LEGS * PER_LEG
NUM_DYNAMIC: Final = NUM_CONSTANTS  # parameters of the dynamics; a log has no wrench


Compiled = Callable[..., list[Array]]


def compiled(function: ca.Function) -> Compiled:
    """Return a dense CasADi function of arrays; CasADi's columns are numpy's rows.

    It keeps places for arguments and results, so one thread at a time may call it.
    """
    buffer: Any  # its stubs are those of the C interface
    buffer, evaluate = function.buffer()
    given = [np.zeros(function.size_in(k)[::-1]) for k in range(function.n_in())]
    results = [np.zeros(function.size_out(k)[::-1]) for k in range(function.n_out())]
    for put, places in ((buffer.set_arg, given), (buffer.set_res, results)):
        for k, place in enumerate(places):
            put(k, place.reshape(-1).data)

    def call(*arguments: Array) -> list[Array]:
        for place, argument in zip(given, arguments, strict=True):
            place.squeeze()[...] = argument
        evaluate()
        return [result.squeeze().copy() for result in results]

    call.owners = function, buffer  # type: ignore[attr-defined]  # `evaluate` keeps neither alive
    return call


class Numbers(NamedTuple):
    parameters: Array  # (NUM_DYNAMIC,) of the dynamics
    legs: Array  # (6, LEG_NUMBERS), see `core.layout`


class Slopes(NamedTuple):
    """Accelerations at n points, and their derivatives."""

    accelerations: Array  # (n, 6)
    state: Array  # (n, 6, 12)
    numbers: Array  # (n, 6, NUM_DYNAMIC + NUM_GEOMETRY)


class SymbolicLegs(NamedTuple):
    """Symbols of the equations, of a machine's legs (18, 6), and of its constants (13,)."""

    s: dict[str, ca.SX]
    legs: ca.SX
    constants: ca.SX

    @property
    def geometry(self) -> ca.SX:
        """Free numbers of the legs (NUM_GEOMETRY,), leg by leg."""
        return ca.vec(self.legs[list(LEG_PLACES), :])


class MachineModel:
    """Accelerations and crank angles of a machine with any numbers, and their derivatives.

    Bodies, motor frames and branches stay. Each call evaluates a number of points. Gravity is along
    -z.
    """

    def __init__(self, mechanism: Mechanism, gravity: float, points: int) -> None:
        self.mechanism, self.gravity, self.points = mechanism, gravity, points

    @cached_property
    def _symbols(self) -> SymbolicLegs:
        constants = ca.SX.sym("constants", NUM_CONSTANTS)
        whole = ca.vertcat(constants, ca.SX.zeros(len(WRENCHES)))
        legs = ca.SX.sym("legs", LEG_NUMBERS, NUM_LEGS)
        return SymbolicLegs(equations.symbols() | {"parameters": whole}, legs, constants)

    @cached_property
    def _motion(self) -> equations.Motion:
        (s, legs, _), common = self._symbols, numbers_of(self.mechanism)[1]
        plate = equations.plate_motion(s["pose"], s["rates"], ca.SX(self.gravity))
        sums = equations.plate_alone(common, plate, s["parameters"])
        numbers, arms, crank_rates = ca.SX.sym("leg", LEG_NUMBERS), [], []
        one, *others = equations.leg_on_plate(leg_numbers(numbers), common, plate)
        leg = ca.Function("leg", [s["pose"], s["rates"], numbers], [*one, *others])
        for number in range(NUM_LEGS):
            *added, arm, crank_rate = leg(s["pose"], s["rates"], legs[:, number])
            sums = sums.plus(equations.Sums(*added))
            arms.append(arm)
            crank_rates.append(crank_rate)
        rows = ca.vertcat(*arms), ca.vertcat(*crank_rates)
        return equations.assembled(sums, *rows, s["pose"], s["rates"])

    def _many(self, name: str, inputs: list[ca.SX], results: list[ca.SX], shared: int) -> Compiled:
        """Return a function of all points; the last `shared` inputs are the same for all."""
        one = ca.Function(name, inputs, [ca.densify(one) for one in results], {"cse": True})
        same = list(range(len(inputs) - shared, len(inputs)))
        return compiled(one.map(name, "serial", self.points, same, []))

    @cached_property
    def _accelerations(self) -> Compiled:
        s, legs, constants = self._symbols
        p = s["parameters"]
        slip = equations.slip(self._motion.crank_rates, p)
        found = equations.accelerations(self._motion, s["torque"], p, slip)
        inputs = [s["pose"], s["rates"], s["torque"], constants, legs]
        return self._many("forward", inputs, [found], 2)

    @cached_property
    def _residual(self) -> Compiled:
        (s, legs, constants), motion = self._symbols, self._motion
        p = s["parameters"]
        nu_dot = ca.mtimes(motion.rates_map, s["accelerations"]) + motion.nu_dot_bias
        force = equations.force(motion, s["torque"], p, equations.slip(motion.crank_rates, p))
        F = ca.mtimes(motion.mass, nu_dot) - force
        by_legs = ca.jacobian(F, ca.vec(legs))
        places = [LEG_NUMBERS * leg + k for leg in range(NUM_LEGS) for k in LEG_PLACES]
        state = ca.vertcat(s["pose"], s["rates"])
        slopes = ca.horzcat(ca.jacobian(F, state), ca.jacobian(F, constants), by_legs[:, places])
        inputs = [s["pose"], s["rates"], s["accelerations"], s["torque"], constants, legs]
        return self._many("residual", inputs, [slopes, ca.mtimes(motion.mass, motion.rates_map)], 2)

    @cached_property
    def _angles(self) -> Compiled:
        (s, legs, _), geometry = self._symbols, self._symbols.geometry
        R_WP, angles = equations.rotation(s["pose"][:3]), []
        for number in range(NUM_LEGS):
            leg = leg_numbers(legs[:, number])
            p_SQ_W = s["pose"][3:] + ca.mtimes(R_WP, leg.p_PQ) - leg.p_WS
            q = ca.mtimes(leg.R_WS.T, p_SQ_W)
            cosine = equations.swing_cosine(q, leg.crank_length, leg.rod_length)
            angles.append(ca.atan2(q[1], q[0]) + leg.branch * ca.acos(cosine))
        alpha = ca.vertcat(*angles)
        slopes = ca.jacobian(alpha, s["pose"]), ca.jacobian(alpha, geometry)
        return self._many("angles", [s["pose"], legs], [alpha, *slopes], 1)

    def accelerations(self, states: Array, torques: Array, numbers: Numbers) -> Array:
        """Return the pose's accelerations (n, 6) at states (n, 12) under torques (n, 6)."""
        found: Array = self._accelerations(states[:, :6], states[:, 6:], torques, *numbers)[0]
        return found.reshape(self.points, NUM_COORDINATES)

    def slopes(self, states: Array, torques: Array, numbers: Numbers) -> Slopes:
        a = self.accelerations(states, torques, numbers)
        dF, MN = self._residual(states[:, :6], states[:, 6:], a, torques, *numbers)
        n = self.points
        dF, MN = dF.reshape(n, -1, NUM_COORDINATES), MN.reshape(n, 6, 6)
        da = np.negative(np.linalg.solve(MN.transpose(0, 2, 1), dF.transpose(0, 2, 1)), dtype=float)
        return Slopes(a, da[:, :, :NUM_STATE], da[:, :, NUM_STATE:])

    def crank_angles(self, poses: Array, numbers: Numbers) -> tuple[Array, Array, Array]:
        """Return angles (n, 6), d/dpose (n, 6, 6) and d/dgeometry (n, 6, NUM_GEOMETRY).

        They are NaN out of reach.
        """
        n = self.points
        alpha, by_pose, by_geometry = self._angles(poses, numbers.legs)
        return (
            alpha.reshape(n, NUM_LEGS),
            by_pose.reshape(n, 6, 6).transpose(0, 2, 1),
            by_geometry.reshape(n, NUM_GEOMETRY, 6).transpose(0, 2, 1),
        )


class DrawnModel(MachineModel):
    """Machine with its legs as drawn: fifty times as fast, zero derivatives by the geometry."""

    def _compiled(self, name: str) -> Compiled:
        """Return a function of the core at all points; its last argument, the legs, is unused."""
        function = NativeFunction(name, geometry_of(self.mechanism), self.points)
        parameters = plant_parameters()

        def call(*arguments: Array) -> list[Array]:
            *at, parameters[:NUM_DYNAMIC], _ = arguments
            return [*function(*at, parameters, self.gravity)]

        return call

    @cached_property
    def _accelerations(self) -> Compiled:
        return self._compiled("accelerations")

    @cached_property
    def _residual(self) -> Compiled:
        derivatives = self._compiled("residual_derivatives")
        by_geometry = np.zeros((self.points, NUM_GEOMETRY, NUM_COORDINATES))

        def slopes(*arguments: Array) -> list[Array]:
            by_state, by_parameters, MN, _ = derivatives(*arguments)
            by_constants = by_parameters[:, :NUM_DYNAMIC]
            return [np.concatenate([by_state, by_constants, by_geometry], axis=1), MN]

        return slopes
