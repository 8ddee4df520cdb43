"""How far a mechanism is from where it must not be, as CasADi expressions; see `workspace`."""

import casadi as ca

from stewart_drake.dynamics import equations
from stewart_drake.dynamics.numbers import CommonNumbers, LegNumbers


def leg_measures(
    leg: LegNumbers, common: CommonNumbers, R_WP: ca.SX, position: ca.SX, angle: ca.SX | None
) -> tuple[ca.SX, ca.SX]:
    """Sine of the crank's angle off dead centre, and the wrench (6,) of the rod's unit force.

    The sine is defined also out of reach, where the square is negative. The wrench's moment is
    taken over the plate's mean radius, so that all six have no unit.
    """
    u, R_WS = leg.crank_length, leg.R_WS
    b = ca.mtimes(R_WP, leg.p_PQ)
    q = ca.mtimes(R_WS.T, position + b - leg.p_WS)
    azimuth = ca.atan2(q[1], q[0])
    if angle is None:
        cosine = equations.swing_cosine(q, u, leg.rod_length)
        square = 1 - cosine**2
        swing = ca.acos(ca.fmin(ca.fmax(cosine, -1.0), 1.0))
        alpha, sine = azimuth + leg.branch * swing, ca.sign(square) * ca.sqrt(ca.fabs(square))
    else:
        alpha, sine = angle, leg.branch * ca.sin(angle - azimuth)
    rod = (q - u * ca.vertcat(ca.cos(alpha), ca.sin(alpha), 0)) / leg.rod_length
    e = ca.mtimes(R_WS, rod)
    return sine, ca.vertcat(ca.cross(b, e) / common.radius, e)


def assembled(sines: ca.SX, wrenches: ca.SX, pose: ca.SX) -> ca.SX:
    """(8,) from the sines (6,) and the wrenches (6, 6)."""
    # CasADi expands the determinant by minors: no division, so it passes zero smoothly.
    return ca.vertcat(sines, ca.det(wrenches), -ca.fabs(pose[1]))
