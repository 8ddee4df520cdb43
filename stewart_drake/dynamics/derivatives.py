"""Derivatives of the equations of motion, by the chain rule leg by leg.

With F = M nu_dot + h - B torque and the reduction of each leg to its plate joint Q (`equations`),

    F = F_plate + sum [b x R f; R f],   f(q, w, a) = m(q) a + c(q, w) - g(q) torque,

q, w and a being position, velocity and acceleration of Q in the leg's frame S, R = R_WS.
Only f is long; it is differentiated once with respect to six scalars, and the short kinematics of
q, w, a do the rest. Differentiating F as a whole takes three times as long to build.
"""

from typing import NamedTuple

import casadi as ca

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.numbers import CommonNumbers, LegNumbers, numbers_of
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import BIAS, DAMPING, PAYLOAD


class Plate(NamedTuple):
    """How the plate moves, accelerations included; all in W."""

    R_WP: ca.SX
    w: ca.SX
    w_dot: ca.SX
    gravity: ca.SX


def residual_derivatives(mechanism: Mechanism, s: dict[str, ca.SX]) -> list[ca.SX]:
    """dF/d[pose; rates] (6, 12), dF/dparameters (6, 8), M N (6, 6) and B' (6, 6).

    Args:
        mechanism: the machine.
        s: symbols, see `equations.symbols`; F is taken at constant accelerations of the pose.
    """
    legs, common = numbers_of(mechanism)
    dF_dx, M = plate_alone(common, s)
    arms, arm_rates = [], []
    for number, leg in enumerate(legs):
        torque = s["torque"][number] + s["parameters"][BIAS][number]
        change, turn, mass, arm, arm_rate = leg_on_plate(leg, common, s, torque)
        dF_dx += change
        dF_dx[:3, :] -= turn
        M += mass
        arms.append(arm)
        arm_rates.append(arm_rate)
    return assembled(dF_dx, M, ca.vertcat(*arms), ca.vertcat(*arm_rates), s)


def _plate(s: dict[str, ca.SX]) -> Plate:
    pose, rates, accelerations = s["pose"], s["rates"], s["accelerations"]
    E = equations.angle_rate_map(pose[:3])
    w = ca.mtimes(E, rates[:3])
    w_dot = ca.mtimes(E, accelerations[:3]) + ca.jtimes(w, pose[:3], rates[:3])
    return Plate(equations.rotation(pose[:3]), w, w_dot, ca.vertcat(0, 0, -s["gravity"]))


def plate_alone(common: CommonNumbers, s: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Its part of dF/d[pose; rates] (6, 12) and of M (6, 6)."""
    R_WP, w, w_dot, g_W = _plate(s)
    mass = common.plate_mass + s["parameters"][PAYLOAD]
    I_W = ca.mtimes([R_WP, ca.diag(common.plate_inertia), R_WP.T])
    force = mass * (s["accelerations"][3:] - g_W)
    plate = ca.vertcat(ca.mtimes(I_W, w_dot) + ca.cross(w, ca.mtimes(I_W, w)), force)
    state = ca.vertcat(s["pose"], s["rates"])
    return ca.jacobian(plate, state), ca.diagcat(I_W, mass * ca.SX.eye(3))


def leg_on_plate(
    leg: LegNumbers, common: CommonNumbers, s: dict[str, ca.SX], torque: ca.SX
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """What a leg adds to both, its row (1, 6) of B', and its crank's rate; `torque` with bias.

    To the first in two parts: (6, 12), and less (3, 12) in the first rows, because b turns.
    """
    (R_WP, w, w_dot, g_W), R_WS = _plate(s), leg.R_WS
    pose, v, v_dot = s["pose"], s["rates"][3:], s["accelerations"][3:]
    state = ca.vertcat(pose, s["rates"])
    b = ca.mtimes(R_WP, leg.p_PQ)
    q = ca.mtimes(R_WS.T, pose[3:] + b - leg.p_WS)
    velocity = ca.mtimes(R_WS.T, v + ca.cross(w, b))
    acceleration = ca.mtimes(R_WS.T, v_dot + ca.cross(w_dot, b) + ca.cross(w, ca.cross(w, b)))
    damping, numbers = s["parameters"][DAMPING], (*leg.symbols, *common.symbols)
    f, df, m, g = _leg_residual(leg, common)(
        q, velocity, acceleration, torque, damping, ca.mtimes(R_WS.T, g_W), *numbers
    )
    at_joint = ca.vertcat(ca.mtimes(equations.cross_matrix(b), R_WS), R_WS)  # [b x R .; R .]
    motion = ca.jacobian(ca.vertcat(q, velocity), state)
    change = ca.mtimes(df, motion) + ca.mtimes(m, ca.jacobian(acceleration, state))
    turn = ca.mtimes(equations.cross_matrix(ca.mtimes(R_WS, f)), ca.jacobian(b, state))
    mass = ca.mtimes([at_joint, m, at_joint.T])
    return ca.mtimes(at_joint, change), turn, mass, ca.mtimes(at_joint, g).T, ca.dot(g, velocity)


def assembled(
    dF_dx: ca.SX, M: ca.SX, arm: ca.SX, arm_rates: ca.SX, s: dict[str, ca.SX]
) -> list[ca.SX]:
    """The results of `residual_derivatives` from sums over plate and legs, B' and cranks' rates."""
    payload = ca.vertcat(ca.SX.zeros(3), s["accelerations"][3:] + ca.vertcat(0, 0, s["gravity"]))
    dF_dp = ca.horzcat(-arm.T, payload, ca.mtimes(arm.T, arm_rates))
    E = equations.angle_rate_map(s["pose"][:3])
    return [dF_dx, dF_dp, ca.mtimes(M, ca.diagcat(E, ca.SX.eye(3))), arm]


def _leg_residual(leg: LegNumbers, common: CommonNumbers) -> ca.Function:
    """(q, w, a, torque, damping, gravity) in S -> f (3,), df/d[q; w] (3, 6), m (3, 3), g (3,)."""
    q, w, a, gravity = (ca.SX.sym(name, 3) for name in ("q", "w", "a", "gravity"))
    torque, damping = ca.SX.sym("torque"), ca.SX.sym("damping")
    numbers = (*leg.symbols, *common.symbols)
    reduced = equations.Leg(*equations.leg_at_joint(leg, common)(q, w, gravity, *numbers))
    shaft = torque - damping * ca.dot(reduced.arm, w)
    f = ca.mtimes(reduced.mass, a) + reduced.bias - reduced.arm * shaft
    df = ca.jacobian(f, ca.vertcat(q, w))
    arguments = [q, w, a, torque, damping, gravity, *numbers]
    return ca.Function("leg_residual", arguments, [f, df, reduced.mass, reduced.arm], {"cse": True})
