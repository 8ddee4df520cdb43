"""Derivatives of the equations of motion, by the chain rule leg by leg.

With F = M nu_dot + h - B torque and the reduction of each leg to its plate joint Q (`equations`),

    F = F_plate + sum [b x R f; R f],   f(q, w, a) = m(q) a + c(q, w) - g(q) torque,

q, w and a being position, velocity and acceleration of Q in the leg's frame S, R = R_WS.
Only f is long; it is differentiated once with respect to six scalars, and the short kinematics of
q, w, a do the rest. Differentiating F as a whole takes three times as long to build.
"""

from functools import lru_cache

import casadi as ca

from stewart_drake.dynamics import equations
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import BIAS, DAMPING, NUM_LEGS, PAYLOAD


def residual_derivatives(mechanism: Mechanism, s: dict[str, ca.SX]) -> list[ca.SX]:
    """dF/d[pose; rates] (6, 12), dF/dparameters (6, 8), M N (6, 6) and B' (6, 6).

    Args:
        mechanism: the machine.
        s: symbols, see `equations.symbols`; F is taken at constant accelerations of the pose.
    """
    pose, rates, accelerations = s["pose"], s["rates"], s["accelerations"]
    state = ca.vertcat(pose, rates)
    R_WP, E = equations.rotation(pose[:3]), equations.angle_rate_map(pose[:3])
    w, v = ca.mtimes(E, rates[:3]), rates[3:]
    w_dot = ca.mtimes(E, accelerations[:3]) + ca.jtimes(w, pose[:3], rates[:3])
    v_dot = accelerations[3:]
    g_W = ca.vertcat(0, 0, -s["gravity"])

    mass = mechanism.plate.mass + s["parameters"][PAYLOAD]
    I_W = ca.mtimes([R_WP, ca.diag(ca.DM(mechanism.plate.inertia)), R_WP.T])
    plate = ca.vertcat(ca.mtimes(I_W, w_dot) + ca.cross(w, ca.mtimes(I_W, w)), mass * (v_dot - g_W))
    dF_dx = ca.jacobian(plate, state)
    M = ca.diagcat(I_W, mass * ca.SX.eye(3))
    arms, arm_rates = [], []
    for leg in range(NUM_LEGS):
        R_WS = ca.DM(mechanism.R_WS[leg])
        b = ca.mtimes(R_WP, ca.DM(mechanism.p_PQ[leg]))
        q = ca.mtimes(R_WS.T, pose[3:] + b - ca.DM(mechanism.p_WS[leg]))
        velocity = ca.mtimes(R_WS.T, v + ca.cross(w, b))
        acceleration = ca.mtimes(R_WS.T, v_dot + ca.cross(w_dot, b) + ca.cross(w, ca.cross(w, b)))
        torque = s["torque"][leg] + s["parameters"][BIAS][leg]
        f, df, m, g = _leg_residual(mechanism, leg)(
            q, velocity, acceleration, torque, s["parameters"][DAMPING], ca.mtimes(R_WS.T, g_W)
        )
        at_joint = ca.vertcat(ca.mtimes(equations.cross_matrix(b), R_WS), R_WS)  # [b x R .; R .]
        motion = ca.jacobian(ca.vertcat(q, velocity), state)
        change = ca.mtimes(df, motion) + ca.mtimes(m, ca.jacobian(acceleration, state))
        dF_dx += ca.mtimes(at_joint, change)
        dF_dx[:3, :] -= ca.mtimes(equations.cross_matrix(ca.mtimes(R_WS, f)), ca.jacobian(b, state))
        M += ca.mtimes([at_joint, m, at_joint.T])
        arms.append(ca.mtimes(at_joint, g).T)
        arm_rates.append(ca.dot(g, velocity))
    arm = ca.vertcat(*arms)
    payload = ca.vertcat(ca.SX.zeros(3), v_dot - g_W)
    dF_dp = ca.horzcat(-arm.T, payload, ca.mtimes(arm.T, ca.vertcat(*arm_rates)))
    return [dF_dx, dF_dp, ca.mtimes(M, ca.diagcat(E, ca.SX.eye(3))), arm]


@lru_cache(maxsize=64)
def _leg_residual(mechanism: Mechanism, leg: int) -> ca.Function:
    """(q, w, a, torque, damping, gravity) in S -> f (3,), df/d[q; w] (3, 6), m (3, 3), g (3,)."""
    q, w, a, gravity = (ca.SX.sym(name, 3) for name in ("q", "w", "a", "gravity"))
    torque, damping = ca.SX.sym("torque"), ca.SX.sym("damping")
    reduced = equations.Leg(*equations.leg_at_joint(mechanism, leg)(q, w, gravity))
    shaft = torque - damping * ca.dot(reduced.arm, w)
    f = ca.mtimes(reduced.mass, a) + reduced.bias - reduced.arm * shaft
    df = ca.jacobian(f, ca.vertcat(q, w))
    arguments = [q, w, a, torque, damping, gravity]
    return ca.Function("leg_residual", arguments, [f, df, reduced.mass, reduced.arm], {"cse": True})
