"""The equations of motion as CasADi expressions: the legs reduced to their plate joints.

With nu = (w, v), the plate's angular velocity and the velocity of its COM in W, the mechanism obeys

    M(q) nu_dot + h(q, nu) = B(q) torque + wrench.                                         (EOM)

A leg has three degrees of freedom and touches the plate in one point Q, whose position q and
velocity w, taken in the leg's motor frame S, fix the motion of crank and rod. By virtual power
(Jourdain's principle) a leg is therefore a 3 x 3 mass m, a bias c and a torque arm g at Q:

    m = sum J' I J,   c = sum J' (I J_dot w + omega x I omega) - J' f_gravity,   alpha_dot = g' w,

summed over crank and rod, their twists being J w. With b = p_PQ_W,  v_Q = v + w x b  and
v_Q_dot = v_dot + w_dot x b + w x (w x b), so that a force f at Q enters (EOM) as [b x f; f].
The same elimination of closed loops, for any tree: Wehage & Haug (1982).
"""

from typing import NamedTuple

import casadi as ca

from stewart_drake.core.layout import (
    COMMON_NUMBERS,
    DEAD_CENTRE_SINE,
    GEOMETRY,
    LEG_NUMBERS,
)
from stewart_drake.mechanism.geometry import Mechanism
from stewart_drake.scenario.signals import (
    BIAS,
    COULOMB,
    COULOMB_SPEED,
    DAMPING,
    NUM_LEGS,
    NUM_PLANT_PARAMETERS,
    PAYLOAD,
    PAYLOAD_POSITION,
    WRENCH,
)

Numbers = ca.DM | ca.SX


class LegNumbers(NamedTuple):
    """Numbers of one leg; see `Mechanism`."""

    crank_length: Numbers
    rod_length: Numbers
    branch: Numbers
    R_WS: Numbers
    p_PQ: Numbers
    p_WS: Numbers
    # Further arguments of a function of the numbers: none for known ones.
    symbols: tuple[ca.SX, ...]


class CommonNumbers(NamedTuple):
    """Numbers of plate, cranks and rods; the crank's inertia is that about the motor axis."""

    plate_mass: Numbers
    plate_inertia: Numbers
    crank_mass: Numbers
    crank_center: Numbers
    crank_inertia: Numbers
    rod_mass: Numbers
    rod_center: Numbers
    rod_inertia: tuple[Numbers, Numbers, Numbers]
    radius: Numbers  # mean distance of the plate's joints from its COM, m
    symbols: tuple[ca.SX, ...]


def numbers_of(mechanism: Mechanism) -> tuple[list[LegNumbers], CommonNumbers]:
    """Return the numbers of a machine."""
    legs, common = ca.vertsplit(ca.DM(mechanism.numbers), [0, NUM_LEGS * LEG_NUMBERS, GEOMETRY])
    by_leg = ca.horzsplit(ca.reshape(legs, NUM_LEGS, LEG_NUMBERS).T)
    return [leg_numbers(one) for one in by_leg], common_numbers(common)


def leg_numbers(numbers: Numbers) -> LegNumbers:
    """Return the numbers of a leg from its part (20,) of the geometry."""
    u, rod, branch, R_WS, p_PQ, p_WS, _ = ca.vertsplit(
        numbers, [0, 1, 2, 3, 12, 15, 18, LEG_NUMBERS]
    )
    return LegNumbers(u, rod, branch, ca.reshape(R_WS, 3, 3), p_PQ, p_WS, _symbols_of(numbers))


def common_numbers(numbers: Numbers) -> CommonNumbers:
    """Return the numbers of all legs and the plate from the last part (13,) of the geometry."""
    ends = [0, 1, *range(4, COMMON_NUMBERS + 1)]
    plate, inertia, m, center, I_crank, rod, f, I_a, I_y, I_t, radius = ca.vertsplit(numbers, ends)
    rods = rod, f, (I_a, I_y, I_t)
    return CommonNumbers(plate, inertia, m, center, I_crank, *rods, radius, _symbols_of(numbers))


def _symbols_of(numbers: Numbers) -> tuple[ca.SX, ...]:
    return (numbers,) if isinstance(numbers, ca.SX) else ()


class Leg(NamedTuple):
    """One leg reduced to its plate joint, in its motor frame S."""

    mass: ca.SX  # m (3, 3), kg
    bias: ca.SX  # c (3,), N, gravity included
    arm: ca.SX  # g (3,), 1/m: crank rate alpha_dot = g' w, and force at Q per torque on the crank
    potential: ca.SX  # J


class Motion(NamedTuple):
    """Terms of (EOM) at symbolic pose, rates, parameters and gravity."""

    mass: ca.SX  # M (6, 6)
    bias: ca.SX  # h (6,)
    arm: ca.SX  # B' (6, 6): d alpha_dot / d nu
    crank_rates: ca.SX  # alpha_dot (6,), rad/s
    nu_dot_bias: ca.SX  # nu_dot (6,) at zero accelerations of the pose
    rates_map: ca.SX  # N (6, 6): nu = N rates
    energy: ca.SX  # kinetic plus potential, J


class Sums(NamedTuple):
    """Sums over plate and legs: blocks (3, 3) of M, parts (3,) of h, and the energy, J."""

    M_ww: ca.SX
    M_wv: ca.SX
    M_vv: ca.SX
    h_w: ca.SX
    h_v: ca.SX
    energy: ca.SX

    def plus(self, other: "Sums") -> "Sums":
        return Sums(*(a + b for a, b in zip(self, other, strict=True)))

    @property
    def mass(self) -> ca.SX:
        """M (6, 6)."""
        return ca.vertcat(ca.horzcat(self.M_ww, self.M_wv), ca.horzcat(self.M_wv.T, self.M_vv))


class PlateMotion(NamedTuple):
    """Motion of the plate, in W."""

    R_WP: ca.SX
    position: ca.SX  # (3,), m
    w: ca.SX
    v: ca.SX
    gravity: ca.SX  # (3,), m/s^2


def _held_above(x: ca.SX, threshold: float) -> ca.SX:
    """Return x above the threshold, continued smoothly to half the threshold below it.

    It is three times differentiable. Integrator stages pass the workspace boundary, where sin^2
    becomes negative, before the witness function detects it. With y = x / threshold in [0, 1] the
    slope is the quintic smoothstep; its integral is 5/2 y^4 - 3 y^5 + y^6.
    """
    y = x / threshold
    inside = ca.fmin(ca.fmax(y, 0.0), 1.0)
    held = 0.5 + inside**4 * (2.5 + inside * (inside - 3.0))
    return threshold * (held + ca.fmax(y - 1.0, 0.0))


def leg_at_joint(leg: LegNumbers, common: CommonNumbers) -> ca.Function:
    """Return crank and rod of a leg reduced to Q: (q, w, gravity) in S and the numbers -> `Leg`.

    Crank tip T at u c, its direction of motion t = n x c, rod direction r, all unit vectors, n the
    motor axis (z of S). The rod's length gives r.(w - v_T) = 0 with v_T = u alpha_dot t, so
    alpha_dot = g.w with g = r / (u r.t).  With d = w - v_T = D w, D = 1 - u t g', r_dot = d / l:

    * its derivative, at zero acceleration of Q:  alpha_acc = (d.d / l + u alpha_dot^2 r.c)/(u r.t),
      a_T = u (alpha_acc t - alpha_dot^2 c);
    * the rod's points move with v_T + s d, 0 <= s <= 1. Its mass, lateral inertia I_t and COM are
      those of a line mass with the moments mu_0 = m, mu_1 = m f, mu_2 = m f^2 + I_t / l^2 in s;
    * besides, it spins about itself with rate k.w: the universal joint leaves it no angular
      velocity along n x (n x r), so k = D'(n x r) r_z / (l (1 - r_z^2)). Axial inertia I_a adds
      the angular momentum I_a (k.w) r, whose rate does virtual power with J_omega;
    * I_y, about the universal joint's second axis y, may differ from I_t = I_z: a rank-one rest.
    """
    q, w, gravity = ca.SX.sym("q", 3), ca.SX.sym("w", 3), ca.SX.sym("gravity", 3)
    u, length = leg.crank_length, leg.rod_length
    c, t = crank_directions(q, u, length, leg.branch)
    r = q - u * c
    r /= ca.norm_2(r)  # which is the rod's length, but out of reach
    g = r / (u * ca.dot(r, t))

    alpha_dot = ca.dot(g, w)
    d = w - u * alpha_dot * t
    alpha_acc = (ca.sumsqr(d) / length + u * alpha_dot**2 * ca.dot(r, c)) / (u * ca.dot(r, t))
    a_T = u * (alpha_acc * t - alpha_dot**2 * c)

    I_a, I_y, I_t = common.rod_inertia
    mu_0, mu_1 = common.rod_mass, common.rod_mass * common.rod_center
    mu_2 = mu_1 * common.rod_center + I_t / length**2
    tip_mass, coupling = mu_0 - 2 * mu_1 + mu_2, mu_1 - mu_2
    shaft_inertia = common.crank_inertia + common.crank_mass * (common.crank_center * u) ** 2
    tg = u * ca.mtimes(t, g.T)
    mass = (
        (shaft_inertia + tip_mass * u**2) * ca.mtimes(g, g.T)
        + coupling * (tg + tg.T)
        + mu_2 * ca.SX.eye(3)
    )
    # Mass that the crank tip carries, kg.
    lever = common.crank_mass * common.crank_center + mu_0 - mu_1
    bias = (
        g
        * (shaft_inertia * alpha_acc + u**2 * tip_mass * alpha_acc - u * lever * ca.dot(t, gravity))
        + coupling * a_T
        - mu_1 * gravity
    )

    def at_Q(x: ca.SX) -> ca.SX:  # D' x
        return x - u * ca.dot(t, x) * g

    across = ca.vertcat(-r[1], r[0], 0)  # n x r
    horizontal = ca.sumsqr(across)  # 1 - r_z^2
    per_radian = r[2] / (length * horizontal)
    spin = per_radian * ca.dot(across, d)
    per_radian_dot = (1 + r[2] ** 2) / (length * horizontal) ** 2 * d[2]
    spin_acc = per_radian_dot * ca.dot(across, d) - per_radian * ca.dot(across, a_T)
    k = per_radian * at_Q(across)
    mass += I_a * ca.mtimes(k, k.T)
    bias += I_a * (k * spin_acc - spin / length**2 * at_Q(ca.cross(r, d)))
    if isinstance(I_y, ca.SX) or I_y != I_t:
        extra_mass, extra_bias = _unequal_sides(I_y - I_t, r, across, horizontal, d, a_T, length)
        mass += ca.mtimes([ca.SX.eye(3) - tg.T, extra_mass, ca.SX.eye(3) - tg])
        bias += at_Q(extra_bias)

    potential = -ca.dot(gravity, u * lever * c + mu_1 * q)
    mass = _symmetric(mass)
    arguments = [q, w, gravity, *leg.symbols, *common.symbols]
    return ca.Function("leg", arguments, [mass, bias, g, potential], {"cse": True})


def swing_cosine(q: ca.SX, u: Numbers, length: Numbers) -> ca.SX:
    """Return cos(delta) = C / hypot(A, B); beyond [-1, 1] the leg does not reach q."""
    return (ca.sumsqr(q) + u**2 - length**2) / (2 * u * ca.sqrt(q[0] ** 2 + q[1] ** 2))


def crank_directions(q: ca.SX, u: Numbers, length: Numbers, branch: Numbers) -> tuple[ca.SX, ca.SX]:
    """Return directions c of the crank and t of its tip's motion, equation (2) without its angles.

    alpha = azimuth of Q + branch * delta with cos(delta) = C / hypot(A, B).
    """
    rho = ca.sqrt(q[0] ** 2 + q[1] ** 2)
    cos_delta = swing_cosine(q, u, length)
    sin2_delta = 1 - cos_delta**2
    held = _held_above(sin2_delta, DEAD_CENTRE_SINE**2)
    # The factor, 1 within reach, lets the sine not fall below its threshold far out of reach.
    sin_delta = ca.sqrt(held * (1 + held - sin2_delta))
    unit = ca.sqrt(cos_delta**2 + sin_delta**2)  # 1 but for rounding within reach
    cos_delta, sin_delta = cos_delta / unit, branch * sin_delta / unit
    cos = (q[0] * cos_delta - q[1] * sin_delta) / rho
    sin = (q[1] * cos_delta + q[0] * sin_delta) / rho
    return ca.vertcat(cos, sin, 0), ca.vertcat(-sin, cos, 0)


def _unequal_sides(
    inertia: Numbers,
    r: ca.SX,
    across: ca.SX,
    horizontal: ca.SX,
    d: ca.SX,
    a_T: ca.SX,
    length: Numbers,
) -> tuple[ca.SX, ca.SX]:
    """Return mass (3, 3) and bias (3,), before D', of an inertia about y = n x r / |n x r|.

    omega_y = y.(r x d) / l = z.d with z = (y x r) / l. The angular momentum I omega_y y has the
    rate I (omega_y_dot y + omega_y y_dot). The second part does no virtual power: y stays
    perpendicular to n, so that y_dot lies along n x y, about which the rod cannot turn.
    """
    y = across / ca.sqrt(horizontal)
    z = ca.cross(y, r) / length
    across_dot = ca.vertcat(-d[1], d[0], 0) / length
    y_dot = (across_dot - y * ca.dot(y, across_dot)) / ca.sqrt(horizontal)
    z_dot = (ca.cross(y_dot, r) + ca.cross(y, d / length)) / length
    omega_y_acc = ca.dot(z_dot, d) - ca.dot(z, a_T)
    return inertia * ca.mtimes(z, z.T), inertia * z * omega_y_acc


def rotation(angles: ca.SX) -> ca.SX:
    """Return R_WP (3, 3) = Rz(psi) Ry(theta) Rx(phi)."""
    (cf, ct, cp), (sf, st, sp) = (ca.vertsplit(f(angles)) for f in (ca.cos, ca.sin))
    return ca.vertcat(
        ca.horzcat(cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf),
        ca.horzcat(sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf),
        ca.horzcat(-st, ct * sf, ct * cf),
    )


def angle_rate_map(angles: ca.SX) -> ca.SX:
    """Return E (3, 3): angular velocity in W = E d(roll, pitch, yaw)/dt."""
    (_, ct, cp), (_, st, sp) = (ca.vertsplit(f(angles)) for f in (ca.cos, ca.sin))
    return ca.vertcat(
        ca.horzcat(cp * ct, -sp, 0), ca.horzcat(sp * ct, cp, 0), ca.horzcat(-st, 0, 1)
    )


def plate_motion(pose: ca.SX, rates: ca.SX, gravity: ca.SX) -> PlateMotion:
    angles, position = pose[:3], pose[3:]
    w, v = ca.mtimes(angle_rate_map(angles), rates[:3]), rates[3:]
    return PlateMotion(rotation(angles), position, w, v, ca.vertcat(0, 0, -gravity))


def plate_alone(common: CommonNumbers, plate: PlateMotion, parameters: ca.SX) -> Sums:
    """Return the plate's part of (EOM), with its payload.

    The payload is a point mass m at r, fixed in the plate. It moves with v + w x r and takes the
    force f = m (v_dot + w_dot x r + w x (w x r) - g), which enters as [r x f; f]. At r = 0 it is
    part of the plate's mass; the terms with r are added here.
    """
    R_WP, position, w, v, g_W = plate
    payload = parameters[PAYLOAD]
    mass = common.plate_mass + payload
    I_W = ca.mtimes([R_WP, ca.diag(common.plate_inertia), R_WP.T])
    r = ca.mtimes(R_WP, parameters[PAYLOAD_POSITION])
    lever, turning = payload * ca.skew(r), ca.cross(w, r)
    pull = payload * ca.cross(w, turning)
    return Sums(
        M_ww=I_W + ca.mtimes(lever, ca.skew(r).T),
        M_wv=lever,
        M_vv=mass * ca.SX.eye(3),
        h_w=ca.cross(w, ca.mtimes(I_W, w)) + ca.cross(r, pull - payload * g_W),
        h_v=pull - mass * g_W,
        energy=(ca.dot(w, ca.mtimes(I_W, w)) + mass * ca.sumsqr(v)) / 2
        - mass * ca.dot(g_W, position)
        + payload * (ca.dot(v + turning / 2, turning) - ca.dot(g_W, r)),
    )


def leg_on_plate(
    leg: LegNumbers, common: CommonNumbers, plate: PlateMotion
) -> tuple[Sums, ca.SX, ca.SX]:
    """Return a leg's part of (EOM), its row (1, 6) of B', and its crank's rate."""
    R_WP, position, w, v, g_W = plate
    R_WS = leg.R_WS
    b = ca.mtimes(R_WP, leg.p_PQ)
    v_Q = v + ca.cross(w, b)
    q = ca.mtimes(R_WS.T, position + b - leg.p_WS)
    reduced = leg_at_joint(leg, common)
    arguments = q, ca.mtimes(R_WS.T, v_Q), ca.mtimes(R_WS.T, g_W), *leg.symbols, *common.symbols
    at_joint = Leg(*reduced(*arguments))
    m = _symmetric(ca.mtimes([R_WS, at_joint.mass, R_WS.T]))
    f = ca.mtimes(R_WS, at_joint.bias) + ca.mtimes(m, ca.cross(w, ca.cross(w, b)))
    bx_m = ca.mtimes(ca.skew(b), m)
    arm = ca.mtimes(R_WS, at_joint.arm)
    added = Sums(
        M_ww=ca.mtimes(bx_m, ca.skew(b).T),
        M_wv=bx_m,
        M_vv=m,
        h_w=ca.cross(b, f),
        h_v=f,
        energy=ca.dot(v_Q, ca.mtimes(m, v_Q)) / 2 + at_joint.potential,
    )
    row = ca.horzcat(ca.cross(b, arm).T, arm.T)
    return added, row, ca.mtimes(row, ca.vertcat(w, v))


def assembled(sums: Sums, arm: ca.SX, crank_rates: ca.SX, pose: ca.SX, rates: ca.SX) -> Motion:
    """Return (EOM) of plate and legs; `arm` is B'."""
    E = angle_rate_map(pose[:3])
    w = ca.mtimes(E, rates[:3])
    return Motion(
        mass=_symmetric(sums.mass),
        bias=ca.vertcat(sums.h_w, sums.h_v),
        arm=arm,
        crank_rates=crank_rates,
        nu_dot_bias=ca.vertcat(ca.jtimes(w, pose[:3], rates[:3]), ca.SX.zeros(3)),
        rates_map=ca.diagcat(E, ca.SX.eye(3)),
        energy=sums.energy,
    )


def _symmetric(matrix: ca.SX) -> ca.SX:
    """Return a symmetric matrix from its lower triangle, which halves the work."""
    return ca.tril2symm(ca.tril(matrix))


def slip(crank_rates: ca.SX, parameters: ca.SX) -> ca.SX:
    """Return (6,) Coulomb friction over its size, tanh(alpha_dot / its speed).

    Unlike real Coulomb friction it is smooth at zero rate, so that integrators keep their order. A
    crank that holds a load creeps, slower for a smaller coulomb_speed.
    """
    return ca.tanh(crank_rates / parameters[COULOMB_SPEED])


def shaft_torque(
    torque: ca.SX, bias: ca.SX, crank_rate: ca.SX, slip: ca.SX, parameters: ca.SX
) -> ca.SX:
    """Return the torque at a crank, or six: motor and bias less viscous and Coulomb friction."""
    return torque + bias - (parameters[DAMPING] * crank_rate + parameters[COULOMB] * slip)


def force(motion: Motion, torque: ca.SX, parameters: ca.SX, slip: ca.SX) -> ca.SX:
    """Return the generalised force (6,) of nu, B torque + wrench - h.

    A wrench F = [moment; force] at the plate's COM, in W, has the power moment . w + force . v =
    F . nu, so that it is a generalised force of nu as it is.
    """
    shaft = shaft_torque(torque, parameters[BIAS], motion.crank_rates, slip, parameters)
    return ca.mtimes(motion.arm.T, shaft) + parameters[WRENCH] - motion.bias


def accelerations(motion: Motion, torque: ca.SX, parameters: ca.SX, slip: ca.SX) -> ca.SX:
    """Return the accelerations of the pose (6,) under motor torques."""
    nu_dot = solve_symmetric(motion.mass, force(motion, torque, parameters, slip))
    return ca.solve(motion.rates_map, nu_dot - motion.nu_dot_bias)


def inverse_dynamics(motion: Motion, accelerations: ca.SX, parameters: ca.SX, slip: ca.SX) -> ca.SX:
    """Return the motor torques (6,) for given accelerations of the pose."""
    # `force` without motor torque: bias, friction, wrench and h
    passive = force(motion, ca.SX.zeros(NUM_LEGS), parameters, slip)
    nu_dot = ca.mtimes(motion.rates_map, accelerations) + motion.nu_dot_bias
    return ca.solve(motion.arm.T, ca.mtimes(motion.mass, nu_dot) - passive)


def solve_symmetric(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Return matrix^-1 right for a positive definite matrix (n, n), by unrolled Cholesky."""
    upper = ca.chol(matrix)  # matrix = upper' upper
    n = matrix.shape[0]
    x = ca.SX(right)
    for i in range(n):
        x[i, :] = (x[i, :] - ca.mtimes(upper[:i, i].T, x[:i, :])) / upper[i, i]
    for i in reversed(range(n)):
        x[i, :] = (x[i, :] - ca.mtimes(upper[i, i + 1 :], x[i + 1 :, :])) / upper[i, i]
    return x


def symbols() -> dict[str, ca.SX]:
    """Return new symbols for all arguments of the equations."""
    six = ("pose", "rates", "accelerations", "torque", "angles")
    sizes = dict.fromkeys(six, 6) | {"parameters": NUM_PLANT_PARAMETERS, "gravity": 1}
    return {name: ca.SX.sym(name, size) for name, size in sizes.items()}


def leg_measures(
    leg: LegNumbers, common: CommonNumbers, R_WP: ca.SX, position: ca.SX, angle: ca.SX | None
) -> tuple[ca.SX, ca.SX]:
    """Return the sine of the crank's angle off dead centre, and the rod's unit wrench (6,).

    The sine is defined also out of reach, where the square is negative. The wrench's moment is
    taken over the plate's mean radius, so that all six have no unit.
    """
    u, R_WS = leg.crank_length, leg.R_WS
    b = ca.mtimes(R_WP, leg.p_PQ)
    q = ca.mtimes(R_WS.T, position + b - leg.p_WS)
    azimuth = ca.atan2(q[1], q[0])
    if angle is None:
        cosine = swing_cosine(q, u, leg.rod_length)
        square = 1 - cosine**2
        swing = ca.acos(ca.fmin(ca.fmax(cosine, -1.0), 1.0))
        alpha, sine = azimuth + leg.branch * swing, ca.sign(square) * ca.sqrt(ca.fabs(square))
    else:
        alpha, sine = angle, leg.branch * ca.sin(angle - azimuth)
    rod = (q - u * ca.vertcat(ca.cos(alpha), ca.sin(alpha), 0)) / leg.rod_length
    e = ca.mtimes(R_WS, rod)
    return sine, ca.vertcat(ca.cross(b, e) / common.radius, e)


def workspace_measures(sines: ca.SX, wrenches: ca.SX, pose: ca.SX) -> ca.SX:
    """Return the measures (8,) of `workspace` from the sines (6,) and the wrenches (6, 6)."""
    # CasADi expands the determinant by minors: no division, so it passes zero smoothly.
    return ca.vertcat(sines, ca.det(wrenches), -ca.fabs(pose[1]))
