"""Derivatives of the equations of motion, by the chain rule leg by leg.

With F = M nu_dot + h - B torque - wrench, and each leg reduced to its plate joint Q (`equations`),

    F = F_plate + sum [b x R f; R f],   f(q, w, a) = m(q) a + c(q, w) - g(q) torque,

q, w and a being position, velocity and acceleration of Q in the leg's frame S, R = R_WS.
Only f is long; it is differentiated once with respect to six scalars, and the short kinematics of
q, w, a do the rest. Differentiating F as a whole takes three times as long to build.

The torque is that at the shaft, with d = damping, c = coulomb_friction, s = coulomb_speed,

    torque = T + bias - (d alpha_dot + c slip),   slip = tanh(alpha_dot / s),
    -d torque / d alpha_dot = d + c (1 - slip^2) / s,
    -d torque / ds = -c (1 - slip^2) alpha_dot / s^2.

Slips are arguments here: no compiler vectorises tanh over the legs, so it is computed outside.
"""

import casadi as ca

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.equations import CommonNumbers, LegNumbers, PlateMotion
from stewart_drake.scenario.signals import (
    COULOMB,
    COULOMB_SPEED,
    NUM_BALL_JOINT_PARAMETERS,
    NUM_PLANT_PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
)


def _plate(s: dict[str, ca.SX]) -> tuple[PlateMotion, ca.SX]:
    """Return the motion of the plate, and its angular acceleration, in W."""
    pose, rates = s["pose"], s["rates"]
    plate = equations.plate_motion(pose, rates, s["gravity"])
    w_dot = ca.mtimes(equations.angle_rate_map(pose[:3]), s["accelerations"][:3])
    w_dot += ca.jtimes(plate.w, pose[:3], rates[:3])
    return plate, w_dot


def plate_alone(common: CommonNumbers, s: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the plate's part of dF/d[pose; rates] (6, 12) and of M (6, 6)."""
    plate, w_dot = _plate(s)
    R_WP, w, payload = plate.R_WP, plate.w, s["parameters"][PAYLOAD]
    I_W = ca.mtimes([R_WP, ca.diag(common.plate_inertia), R_WP.T])
    mass = common.plate_mass + payload
    (r, turned), at_com = _payload(plate, w_dot, s), s["accelerations"][3:] - plate.gravity
    moment = ca.mtimes(I_W, w_dot) + ca.cross(w, ca.mtimes(I_W, w))
    moment += ca.cross(r, payload * (at_com + turned))
    whole = ca.vertcat(moment, mass * at_com + payload * turned)
    state = ca.vertcat(s["pose"], s["rates"])
    M = equations.plate_alone(common, plate, s["parameters"]).mass
    return ca.jacobian(whole, state), M


def _payload(plate: PlateMotion, w_dot: ca.SX, s: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the place r of the payload from the COM, and its relative acceleration, in W."""
    r = ca.mtimes(plate.R_WP, s["parameters"][PAYLOAD_POSITION])
    return r, ca.cross(w_dot, r) + ca.cross(plate.w, ca.cross(plate.w, r))


def _joint(leg: LegNumbers, plate: PlateMotion, s: dict[str, ca.SX]) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return b (3,) in W, and position q and velocity (3,) of Q in S."""
    b = ca.mtimes(plate.R_WP, leg.p_PQ)
    q = ca.mtimes(leg.R_WS.T, s["pose"][3:] + b - leg.p_WS)
    return b, q, ca.mtimes(leg.R_WS.T, s["rates"][3:] + ca.cross(plate.w, b))


def crank_rate(leg: LegNumbers, common: CommonNumbers, s: dict[str, ca.SX]) -> ca.SX:
    """Return alpha_dot of a leg, rad/s."""
    _, q, velocity = _joint(leg, _plate(s)[0], s)
    numbers = (*leg.symbols, *common.symbols)
    reduced = equations.Leg(*equations.leg_at_joint(leg, common)(q, velocity, 0, *numbers))
    return ca.dot(reduced.arm, velocity)


def leg_on_plate(
    leg: LegNumbers,
    common: CommonNumbers,
    s: dict[str, ca.SX],
    torque: ca.SX,
    bias: ca.SX,
    slip: ca.SX,
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return a leg's parts of dF/d[pose; rates] and M, and its row (1, 6) of B'.

    The first has two parts: (6, 12), less (3, 12) in the first rows, because b turns.
    """
    (plate, w_dot), R_WS = _plate(s), leg.R_WS
    w = plate.w
    state = ca.vertcat(s["pose"], s["rates"])
    b, q, velocity = _joint(leg, plate, s)
    v_dot = s["accelerations"][3:] + ca.cross(w_dot, b) + ca.cross(w, ca.cross(w, b))
    acceleration = ca.mtimes(R_WS.T, v_dot)
    numbers = (*leg.symbols, *common.symbols)
    gravity = ca.mtimes(R_WS.T, plate.gravity)
    f, df, m, g = _leg_residual(leg, common)(
        q, velocity, acceleration, torque, bias, slip, s["parameters"], gravity, *numbers
    )
    at_joint = ca.vertcat(ca.mtimes(ca.skew(b), R_WS), R_WS)  # [b x R .; R .]
    motion = ca.jacobian(ca.vertcat(q, velocity), state)
    change = ca.mtimes(df, motion) + ca.mtimes(m, ca.jacobian(acceleration, state))
    turn = ca.mtimes(ca.skew(ca.mtimes(R_WS, f)), ca.jacobian(b, state))
    mass = ca.mtimes([at_joint, m, at_joint.T])
    return ca.mtimes(at_joint, change), turn, mass, ca.mtimes(at_joint, g).T


def assembled(
    M: ca.SX, arm: ca.SX, arm_rates: ca.SX, slips: ca.SX, s: dict[str, ca.SX]
) -> tuple[ca.SX, ca.SX]:
    """Return dF/d[parameters] and M N from sums over plate and legs.

    The payload m takes the force m k, with k its acceleration less gravity. Its place changes k:

        dr = R dp,   dk = ([w_dot x] + [w x]^2) dr,   d[r x m k; m k] = m [dr x k + r x dk; dk].
    """
    (plate, w_dot), p, cross = _plate(s), s["parameters"], ca.skew
    r, turned = _payload(plate, w_dot, s)
    k = s["accelerations"][3:] - plate.gravity + turned
    K = cross(w_dot) + ca.mtimes(cross(plate.w), cross(plate.w))
    moving = ca.vertcat(ca.mtimes(cross(r), K) - cross(k), K)
    steep = p[COULOMB] * (1 - slips**2) * arm_rates / p[COULOMB_SPEED] ** 2
    dF_dp = ca.horzcat(
        -arm.T,
        ca.vertcat(ca.cross(r, k), k),
        ca.mtimes(arm.T, ca.horzcat(arm_rates, slips, -steep)),
        p[PAYLOAD] * ca.mtimes(moving, plate.R_WP),
        ca.SX.zeros(6, NUM_BALL_JOINT_PARAMETERS),  # core/ball_joints.c
        -ca.SX.eye(6),  # a wrench at constant accelerations
    )
    E = equations.angle_rate_map(s["pose"][:3])
    return dF_dp, ca.mtimes(M, ca.diagcat(E, ca.SX.eye(3)))


def _leg_residual(leg: LegNumbers, common: CommonNumbers) -> ca.Function:
    """(q, w, a, torque, bias, slip, parameters, gravity) -> f, df/d[q; w] (3, 6), m and g, in S."""
    q, w, a, gravity = (ca.SX.sym(name, 3) for name in ("q", "w", "a", "gravity"))
    torque, bias, slip = (ca.SX.sym(name) for name in ("torque", "bias", "slip"))
    p, moved = ca.SX.sym("parameters", NUM_PLANT_PARAMETERS), ca.vertcat(q, w)
    numbers = (*leg.symbols, *common.symbols)
    reduced = equations.Leg(*equations.leg_at_joint(leg, common)(q, w, gravity, *numbers))
    rate = ca.dot(reduced.arm, w)
    shaft = equations.shaft_torque(torque, bias, rate, slip, p)
    f = ca.mtimes(reduced.mass, a) + reduced.bias - reduced.arm * shaft
    # at constant slip, plus the change of the slip with the crank's rate
    slope = p[COULOMB] * (1 - slip**2) / p[COULOMB_SPEED]
    df = ca.jacobian(f, moved) + slope * ca.mtimes(reduced.arm, ca.jacobian(rate, moved))
    arguments = [q, w, a, torque, bias, slip, p, gravity, *numbers]
    return ca.Function("leg_residual", arguments, [f, df, reduced.mass, reduced.arm], {"cse": True})
