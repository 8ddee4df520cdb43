"""The equations of motion of a mechanism, compiled into CasADi functions on first use."""

from functools import lru_cache
from typing import Final

import casadi as ca

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.compiled import Compiled
from stewart_drake.dynamics.derivatives import residual_derivatives
from stewart_drake.dynamics.threads import BUILDING, built_once
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_PARAMETERS, NUM_STATE

_UNROLLED: Final = 64
"""Steps in one piece of a prediction; longer ones are loops of such pieces, because one piece of n
steps takes memory like n^2, 10 GB for 4000."""


@lru_cache(maxsize=64)
def compiled_functions(mechanism: Mechanism) -> "DynamicsFunctions":
    """The functions of a mechanism, shared by all who ask for it in this process."""
    return DynamicsFunctions(mechanism)


class DynamicsFunctions:
    """Functions of pose, rates, torque, parameters (8,) and gravity (m/s^2), built when needed."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.mechanism = mechanism
        self._many: dict[int, Compiled] = {}

    @built_once
    def _symbols(self) -> dict[str, ca.SX]:
        return equations.symbols()

    @built_once
    def _motion(self) -> equations.Motion:
        s = self._symbols
        return equations.equations_of_motion(
            self.mechanism, s["pose"], s["rates"], s["parameters"], s["gravity"]
        )

    def _compile(self, name: str, arguments: str, *results: ca.SX) -> Compiled:
        dense = [ca.densify(result) for result in results]
        inputs = [self._symbols[argument] for argument in arguments.split()]
        return Compiled(ca.Function(name, inputs, dense, {"cse": True}))

    @built_once
    def _force(self) -> ca.SX:
        """B torque - h, the generalised force (6,) beside M nu_dot."""
        torque = equations.shaft_torque(
            self._motion, self._symbols["torque"], self._symbols["parameters"]
        )
        return ca.mtimes(self._motion.arm.T, torque) - self._motion.bias

    @built_once
    def _nu_dot(self) -> ca.SX:
        """nu_dot (6,) that belongs to the accelerations of the pose."""
        return (
            ca.mtimes(self._motion.rates_map, self._symbols["accelerations"])
            + self._motion.nu_dot_bias
        )

    @built_once
    def accelerations(self) -> Compiled:
        """(pose, rates, torque, parameters, gravity) -> accelerations (6,)."""
        motion = self._motion
        nu_dot = equations.solve_symmetric(motion.mass, self._force)
        accelerations = ca.solve(motion.rates_map, nu_dot - motion.nu_dot_bias)
        return self._compile("accelerations", "pose rates torque parameters gravity", accelerations)

    @built_once
    def inverse_dynamics(self) -> Compiled:
        """(pose, rates, accelerations, parameters, gravity) -> torque (6,)."""
        # Without motor torque `force` is what bias, friction and h exert.
        passive = ca.substitute(self._force, self._symbols["torque"], ca.DM.zeros(6))
        load = ca.mtimes(self._motion.mass, self._nu_dot) - passive
        torque = ca.solve(self._motion.arm.T, load)
        return self._compile(
            "inverse_dynamics", "pose rates accelerations parameters gravity", torque
        )

    @built_once
    def energy(self) -> Compiled:
        """(pose, rates, parameters, gravity) -> J."""
        return self._compile("energy", "pose rates parameters gravity", self._motion.energy)

    @built_once
    def terms(self) -> Compiled:
        """(pose, rates, parameters, gravity) -> M, bias and B in pose coordinates."""
        motion = self._motion
        N = motion.rates_map
        return self._compile(
            "terms",
            "pose rates parameters gravity",
            ca.mtimes([N.T, motion.mass, N]),
            ca.mtimes(N.T, motion.bias + ca.mtimes(motion.mass, motion.nu_dot_bias)),
            ca.mtimes(N.T, motion.arm.T),
        )

    @built_once
    def residual_derivatives(self) -> Compiled:
        """Derivatives of F = M nu_dot + h - B torque; see `StewartDynamics.derivatives`."""
        return self._compile(
            "residual_derivatives",
            "pose rates accelerations torque parameters gravity",
            *residual_derivatives(self.mechanism, self._symbols),
        )

    @built_once
    def _runge_kutta4(self) -> ca.Function:
        """One step of the classical method: (state, torque, parameters, gravity, h) -> state."""
        accelerations = self.accelerations.function
        x, torque = ca.MX.sym("state", NUM_STATE), ca.MX.sym("torque", 6)
        parameters, gravity = ca.MX.sym("parameters", NUM_PARAMETERS), ca.MX.sym("gravity")
        h = ca.MX.sym("h")

        def derivative(state: ca.MX) -> ca.MX:
            rates = state[6:]
            return ca.vertcat(rates, accelerations(state[:6], rates, torque, parameters, gravity))

        k1 = derivative(x)
        k2 = derivative(x + h / 2 * k1)
        k3 = derivative(x + h / 2 * k2)
        k4 = derivative(x + h * k3)
        after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return ca.Function("runge_kutta4", [x, torque, parameters, gravity, h], [after])

    def many_steps(self, steps: int) -> Compiled:
        """(state, torques (n, 6), parameters, gravity, h (n,)) -> states (n, 12), one call."""
        found = self._many.get(steps)
        if found is None:
            with BUILDING:
                step = self._runge_kutta4
                accumulated = step.mapaccum("predict", steps, {"base": _UNROLLED})
                # Whoever has been here meanwhile has made the same.
                found = self._many.setdefault(steps, Compiled(accumulated))
        return found
