"""The equations of motion of one mechanism, run by CasADi's virtual machine."""

from typing import Final

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.compiled import Compiled
from stewart_drake.dynamics.derivatives import residual_derivatives
from stewart_drake.dynamics.functions import margin_of
from stewart_drake.dynamics.measures import measures
from stewart_drake.dynamics.threads import BUILDING, built_once
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import NUM_PLANT_PARAMETERS, NUM_STATE, POSE, RATES

Array = NDArray[np.float64]

_UNROLLED: Final = 64
"""Steps in one piece of a prediction; longer ones are loops of such pieces, because one piece of n
steps takes memory like n^2, 10 GB for 4000."""


class VirtualMachine:
    """Functions that are built when needed, tenths of a second each."""

    backend = "casadi"

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

    @built_once
    def _slip(self) -> ca.SX:
        return equations.slip(self._motion.crank_rates, self._symbols["parameters"])

    def _compile(self, name: str, arguments: str, *results: ca.SX) -> Compiled:
        dense = [ca.densify(result) for result in results]
        inputs = [self._symbols[argument] for argument in arguments.split()]
        return Compiled(ca.Function(name, inputs, dense, {"cse": True}))

    @built_once
    def accelerations(self) -> Compiled:
        """(pose, rates, torque, parameters, gravity) -> accelerations (6,)."""
        s = self._symbols
        found = equations.accelerations(self._motion, s["torque"], s["parameters"], self._slip)
        return self._compile("accelerations", "pose rates torque parameters gravity", found)

    @built_once
    def inverse_dynamics(self) -> Compiled:
        """(pose, rates, accelerations, parameters, gravity) -> torque (6,)."""
        s = self._symbols
        found = equations.inverse_dynamics(
            self._motion, s["accelerations"], s["parameters"], self._slip
        )
        return self._compile(
            "inverse_dynamics", "pose rates accelerations parameters gravity", found
        )

    @built_once
    def energy(self) -> Compiled:
        """(pose, rates, parameters, gravity) -> J."""
        return self._compile("energy", "pose rates parameters gravity", self._motion.energy)

    @built_once
    def terms(self) -> Compiled:
        """(pose, rates, parameters, gravity) -> M, bias and B in pose coordinates."""
        return self._compile(
            "terms", "pose rates parameters gravity", *equations.terms(self._motion)
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
    def measures(self) -> Compiled:
        """(pose) -> the measures of the workspace (8,)."""
        pose = self._symbols["pose"]
        return self._compile("measures", "pose", measures(self.mechanism, pose))

    @built_once
    def measures_of_tree(self) -> Compiled:
        """(pose, angles) -> the same with crank angles (6,) that are known."""
        pose, angles = self._symbols["pose"], self._symbols["angles"]
        return self._compile("tree", "pose angles", measures(self.mechanism, pose, angles))

    @built_once
    def _runge_kutta4(self) -> ca.Function:
        """One step of the classical method: (state, torque, parameters, gravity, h) -> state."""
        accelerations = self.accelerations.function
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
        return ca.Function("runge_kutta4", [x, torque, parameters, gravity, h], [after])

    def change(self, state: Array, torque: Array, parameters: Array, gravity: float) -> Array:
        """d[pose; rates]/dt (12,)."""
        rates = state[RATES]
        (found,) = self.accelerations(state[POSE], rates, torque, parameters, gravity)
        return np.concatenate([rates, found])

    def margin(self, pose: Array, sign: float, least: Array) -> float:
        """`margin_of` the measures of a pose."""
        return margin_of(self.measures(pose)[0], sign, least)

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
