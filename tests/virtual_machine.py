"""Equations of motion of one mechanism on CasADi's virtual machine, the oracle of the core.

Derivatives are CasADi's own, of the residual as a whole; the core has them by the chain rule, leg
by leg.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.equations import leg_measures, numbers_of, workspace_measures
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_LEGS, NUM_PLANT_PARAMETERS, NUM_STATE, POSE, RATES
from stewart_drake.types import Array

_UNROLLED = 64
"""Steps in one piece of a prediction; a piece of n steps takes memory like n^2, 10 GB for 4000."""


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


class VirtualMachine:
    """The functions of `dynamics.native_functions.NativeFunctions`, built when needed."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism

    @cached_property
    def _symbols(self) -> dict[str, ca.SX]:
        return equations.symbols()

    @cached_property
    def _motion(self) -> equations.Motion:
        s, (legs, common) = self._symbols, numbers_of(self.mechanism)
        plate = equations.plate_motion(s["pose"], s["rates"], s["gravity"])
        sums, arms, crank_rates = equations.plate_alone(common, plate, s["parameters"]), [], []
        for leg in legs:
            added, arm, crank_rate = equations.leg_on_plate(leg, common, plate)
            sums = sums.plus(added)
            arms.append(arm)
            crank_rates.append(crank_rate)
        rows = ca.vertcat(*arms), ca.vertcat(*crank_rates)
        return equations.assembled(sums, *rows, s["pose"], s["rates"])

    @cached_property
    def _slip(self) -> ca.SX:
        return equations.slip(self._motion.crank_rates, self._symbols["parameters"])

    def _function(self, name: str, arguments: str, *results: ca.SX) -> ca.Function:
        dense = [ca.densify(result) for result in results]
        inputs = [self._symbols[argument] for argument in arguments.split()]
        return ca.Function(name, inputs, dense, {"cse": True})

    def _compile(self, name: str, arguments: str, *results: ca.SX) -> Compiled:
        return compiled(self._function(name, arguments, *results))

    @cached_property
    def _accelerations(self) -> ca.Function:
        s = self._symbols
        found = equations.accelerations(self._motion, s["torque"], s["parameters"], self._slip)
        return self._function("accelerations", "pose rates torque parameters gravity", found)

    @cached_property
    def accelerations(self) -> Compiled:
        return compiled(self._accelerations)

    @cached_property
    def inverse_dynamics(self) -> Compiled:
        s = self._symbols
        found = equations.inverse_dynamics(
            self._motion, s["accelerations"], s["parameters"], self._slip
        )
        return self._compile("inverse", "pose rates accelerations parameters gravity", found)

    @cached_property
    def energy(self) -> Compiled:
        return self._compile("energy", "pose rates parameters gravity", self._motion.energy)

    @cached_property
    def terms(self) -> Compiled:
        """M, h and B' in pose coordinates: N' times those of nu = N rates."""
        motion, N = self._motion, self._motion.rates_map
        h = motion.bias + ca.mtimes(motion.mass, motion.nu_dot_bias)
        found = [ca.mtimes(N.T, each) for each in (ca.mtimes(motion.mass, N), h, motion.arm.T)]
        return self._compile("terms", "pose rates parameters gravity", *found)

    @cached_property
    def residual_derivatives(self) -> Compiled:
        """dF/d[pose; rates], dF/dparameters, M N and B' of F = M nu_dot - force."""
        s, motion, p = self._symbols, self._motion, self._symbols["parameters"]
        nu_dot = ca.mtimes(motion.rates_map, s["accelerations"]) + motion.nu_dot_bias
        F = ca.mtimes(motion.mass, nu_dot)
        F -= equations.force(motion, s["torque"], p, self._slip)
        return self._compile(
            "residual_derivatives",
            "pose rates accelerations torque parameters gravity",
            ca.jacobian(F, ca.vertcat(s["pose"], s["rates"])),
            ca.jacobian(F, p),
            ca.mtimes(motion.mass, motion.rates_map),
            -ca.jacobian(F, s["torque"]).T,
        )

    def _measures(self, angles: ca.SX | None) -> ca.SX:
        pose, (legs, common) = self._symbols["pose"], numbers_of(self.mechanism)
        R_WP = equations.rotation(pose[:3])
        each = [
            leg_measures(leg, common, R_WP, pose[3:], None if angles is None else angles[i])
            for i, leg in enumerate(legs)
        ]
        sines, wrenches = zip(*each, strict=True)
        return workspace_measures(ca.vertcat(*sines), ca.horzcat(*wrenches), pose)

    @cached_property
    def measures(self) -> Compiled:
        return self._compile("measures", "pose", self._measures(None))

    @cached_property
    def measures_of_tree(self) -> Compiled:
        return self._compile("tree", "pose angles", self._measures(self._symbols["angles"]))

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        (found,) = self.accelerations(state[POSE], state[RATES], torque, parameters, gravity)
        return np.concatenate([state[RATES], found])

    def margin(self, pose: Array, sign: float, least: Array) -> float:
        measures = self.measures(pose)[0]
        above = measures - least
        above[NUM_LEGS] = sign * measures[NUM_LEGS] - least[NUM_LEGS]
        return float(above.min())

    def many_steps(self, steps: int) -> Compiled:
        """Return classical Runge-Kutta steps: (x, torques, p, g, h (n,)) -> states."""
        accelerations = self._accelerations
        x, torque = ca.MX.sym("state", NUM_STATE), ca.MX.sym("torque", 6)
        parameters, gravity = ca.MX.sym("parameters", NUM_PLANT_PARAMETERS), ca.MX.sym("gravity")
        h = ca.MX.sym("h")

        def derivative(state: ca.MX) -> ca.MX:
            rates = state[6:]
            return ca.vertcat(rates, accelerations(state[:6], rates, torque, parameters, gravity))

        k1 = derivative(x)
        k2 = derivative(x + h / 2 * k1)
        k3 = derivative(x + h / 2 * k2)
        k4 = derivative(x + h * k3)
        after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        step = ca.Function("runge_kutta4", [x, torque, parameters, gravity, h], [after])
        return compiled(step.mapaccum("predict", steps, {"base": _UNROLLED}))
