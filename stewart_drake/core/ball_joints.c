#include "ball_joints.h"
#include "legs.h"

#define BALL_DAMPING 13 /* scenario/signals.py */
#define BALL_FRICTION 14
#define BALL_SPEED 15
#define ROUNDS 60
/* Tolerance of Newton's last step; the error is of the order of its square. */
#ifdef STEWART_FLOAT
#define SPIN_TOLERANCE ((real)1e-4)
#define DIFFERENCE ((real)5e-3) /* of the central differences: rad, m over the crank's length, per s */
#else
#define SPIN_TOLERANCE 1e-9
#define DIFFERENCE 1e-5
#endif

/* Parameters c, f and s of a joint. */
typedef struct {
    real damping, friction, speed;
} Joint;

static Joint joint_of_plant(const real *parameters)
{
    return (Joint){parameters[BALL_DAMPING], parameters[BALL_FRICTION], parameters[BALL_SPEED]};
}

/* q = |tau| / |w|, and q' / |w|. */
typedef struct {
    real value, slope;
} Resistance;

static Resistance resistance(const Joint *joint, real square)
{
    const real f = joint->friction / joint->speed, w = REAL(sqrt)(square), slip = w / joint->speed;
    if (f == 0)
        return (Resistance){joint->damping, 0};
    if (slip < (real)1e-4)
        return (Resistance){joint->damping + f * (1 - slip * slip / 3),
                            -2 * f / (3 * joint->speed * joint->speed)};
    const real t = REAL(tanh)(slip), ratio = t / slip;
    return (Resistance){joint->damping + f * ratio, f * (1 - t * t - ratio) / square};
}

/* Spin z that minimises the potentials of both joints, whose angular velocities have the parts p = a + z
   and b - z along the rod and the squares m, n across it. The slope

       q_1 (a + z) - q_2 (b - z),    with the derivative of q p by p: q + (q' / |w|) p^2,

   rises with z and vanishes between -a and b: Newton's steps, halving that interval where one leaves it. */
static real spin_of(const Joint *joint, real a, real m, real b, real n)
{
    real low = REAL(fmin)(-a, b), high = REAL(fmax)(-a, b), z = (low + high) / 2, step = high - low;
    const real tolerance = SPIN_TOLERANCE * step;
    for (int round = 0; round < ROUNDS && REAL(fabs)(step) > tolerance; round++) {
        const real p = a + z, q = b - z;
        const Resistance one = resistance(joint, m + p * p), two = resistance(joint, n + q * q);
        const real slope = one.value * p - two.value * q;
        if (slope == 0)
            break;
        *(slope > 0 ? &high : &low) = z;
        step = slope / (one.value + one.slope * p * p + two.value + two.slope * q * q);
        if (!(low <= z - step && z - step <= high))
            step = z - (low + high) / 2;
        z -= step;
    }
    return z;
}

/* Add a leg's part of the force. With r the rod's direction, l its length, u the crank's length, n the motor
   axis, t the direction in which the crank's tip moves and d = v_Q - u alpha_dot t,

       omega_rod = r x d / l,  w_1 = omega_rod - alpha_dot n + z r,  w_2 = omega - omega_rod - z r.

   A virtual change of z does no work: at constant z, tau_1 - tau_2 does work on d as the force
   g = (tau_1 - tau_2) x r / l. With delta alpha = r.delta v_Q / (u r.t) the force at the joint Q is
   g - (u g.t + tau_1.n) / (u r.t) r. */
static void add_leg(const Joint *joint, const Leg *leg, const LegMotion *m, const real *w, int at_crank,
                    int at_plate, real *force)
{
    real d[3], omega[3], w_1[3], w_2[3], tau_1[3], tau_2[3], rod_torque[3], g[3], f[3], moment[3];
    for (int i = 0; i < 3; i++)
        d[i] = m->velocity[i] - leg->crank * m->rate * m->tangent[i];
    cross(m->rod, d, omega);
    for (int i = 0; i < 3; i++) {
        omega[i] /= leg->rod;
        w_1[i] = omega[i] - m->rate * leg->R[i][2];
        w_2[i] = w[i] - omega[i];
    }
    const real a = dot(w_1, m->rod), b = dot(w_2, m->rod);
    const real across_1 = REAL(fmax)(dot(w_1, w_1) - a * a, 0);
    const real across_2 = REAL(fmax)(dot(w_2, w_2) - b * b, 0);
    real z = at_crank ? -a : b;
    if (at_crank && at_plate)
        z = spin_of(joint, a, across_1, b, across_2);
    const real q_1 = at_crank ? resistance(joint, across_1 + (a + z) * (a + z)).value : 0;
    const real q_2 = at_plate ? resistance(joint, across_2 + (b - z) * (b - z)).value : 0;
    for (int i = 0; i < 3; i++) {
        tau_1[i] = q_1 * (w_1[i] + z * m->rod[i]);
        tau_2[i] = q_2 * (w_2[i] - z * m->rod[i]);
        rod_torque[i] = (tau_1[i] - tau_2[i]) / leg->rod;
    }
    cross(rod_torque, m->rod, g);
    const real axis[3] = {leg->R[0][2], leg->R[1][2], leg->R[2][2]};
    const real along = (leg->crank * dot(g, m->tangent) + dot(tau_1, axis)) / m->lever;
    for (int i = 0; i < 3; i++)
        f[i] = g[i] - along * m->rod[i];
    cross(m->arm, f, moment);
    for (int i = 0; i < 3; i++) {
        force[i] += moment[i] + tau_2[i];
        force[3 + i] += f[i];
    }
}

static void force_at(const stewart_plant *plant, const real *pose, const real *rates, real *force)
{
    const Joint joint = joint_of_plant(plant->parameters);
    const real *crank_ends = plant->geometry + LEGS * 18, *plate_ends = crank_ends + LEGS;
    const Turn turn = turn_of(pose);
    const real w[3] = {dot(turn.E[0], rates), dot(turn.E[1], rates), dot(turn.E[2], rates)};
    for (int i = 0; i < 6; i++)
        force[i] = 0;
    for (int i = 0; i < LEGS; i++) {
        const int at_crank = crank_ends[i] != 0, at_plate = plate_ends[i] != 0;
        if (!at_crank && !at_plate)
            continue;
        const Leg leg = leg_of(plant->geometry, i);
        const LegMotion motion = leg_motion_of(&leg, &turn, pose, w, rates + 3);
        add_leg(&joint, &leg, &motion, w, at_crank, at_plate, force);
    }
}

static void derivatives_at(const stewart_plant *plant, const real *pose, const real *rates,
                           real *by_state, real *by_parameters)
{
    const real length = plant->geometry[0], speed = plant->parameters[BALL_SPEED];
    real state[12], parameters[STEWART_PARAMETERS], above[6], below[6];
    stewart_plant moved = *plant;
    moved.parameters = parameters;
    stewart_copy(6, pose, state);
    stewart_copy(6, rates, state + 6);
    stewart_copy(STEWART_PARAMETERS, plant->parameters, parameters);
    for (int j = 0; j < 12 + 3; j++) {
        real *at = j < 12 ? state + j : parameters + BALL_DAMPING + j - 12, before = *at;
        /* Rates resolve the slope of tanh; the force is linear in c and f. */
        real h = DIFFERENCE * (j % 6 < 3 ? 1 : length);
        if (j >= 6)
            h *= j < 12 ? REAL(fmin)(1, 10 * speed) : j < 14 ? 1 : speed;
        *at = before + h;
        force_at(&moved, state, state + 6, above);
        *at = before - h;
        force_at(&moved, state, state + 6, below);
        *at = before;
        for (int i = 0; i < 6; i++) {
            const real slope = (above[i] - below[i]) / (2 * h);
            if (j < 12)
                by_state[6 * j + i] += slope;
            else
                by_parameters[6 * (j - 12) + i] = slope;
        }
    }
}

const stewart_joint_friction stewart_ball_joints = {force_at, derivatives_at};
