/* The vectors of a leg at a pose, for the sources of kinematics.h. */

#pragma once

#include "kinematics.h"
#include "short.h"

/* Lengths, branch and places of a leg; symbols as in kinematics.h. */
typedef struct {
    real crank, rod, branch, R[3][3] /* R_WS */, joint[3] /* p_PQ */, shaft[3] /* p_WS */;
} Leg;

static inline Leg leg_of(const real *geometry, int i)
{
    const real *own = geometry + i;
    Leg leg = {own[0], own[LEGS], own[2 * LEGS], {{0}}, {0}, {0}};
    for (int a = 0; a < 3; a++) {
        for (int b = 0; b < 3; b++)
            leg.R[b][a] = own[LEGS * (3 + 3 * a + b)];
        leg.joint[a] = own[LEGS * (12 + a)];
        leg.shaft[a] = own[LEGS * (15 + a)];
    }
    return leg;
}

/* R_WP of roll, pitch and yaw, and E, the map from their rates to the angular velocity. */
typedef struct {
    real R[3][3], E[3][3];
} Turn;

static inline Turn turn_of(const real *angles)
{
    const real sf = REAL(sin)(angles[0]), cf = REAL(cos)(angles[0]);
    const real st = REAL(sin)(angles[1]), ct = REAL(cos)(angles[1]);
    const real sp = REAL(sin)(angles[2]), cp = REAL(cos)(angles[2]);
    return (Turn){{{cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf},
                   {sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf},
                   {-st, ct * sf, ct * cf}},
                  {{cp * ct, -sp, 0}, {sp * ct, cp, 0}, {-st, 0, 1}}};
}

static inline real dot(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static inline void cross(const real *a, const real *b, real *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* Compute arm = p_PQ in W, and q = p_SQ in the motor's frame. */
static inline void joint_of(const Leg *leg, const Turn *turn, const real *pose, real *arm, real *q)
{
    real p[3];
    for (int i = 0; i < 3; i++) {
        arm[i] = dot(turn->R[i], leg->joint);
        p[i] = pose[3 + i] + arm[i] - leg->shaft[i];
    }
    for (int j = 0; j < 3; j++)
        q[j] = leg->R[0][j] * p[0] + leg->R[1][j] * p[1] + leg->R[2][j] * p[2];
}

/* Return the crank angle for a joint at q; NaN out of reach. */
static inline real angle_of(const Leg *leg, const real *q)
{
    const real a = 2 * leg->crank * q[0], b = 2 * leg->crank * q[1];
    const real c = dot(q, q) + leg->crank * leg->crank - leg->rod * leg->rod;
    return REAL(atan2)(b, a) + leg->branch * REAL(acos)(c / REAL(hypot)(a, b));
}

/* row (6) = [(arm x along)' E, along'] / scale. */
static inline void row_of(const Turn *turn, const real *arm, const real *along, real scale, real *row)
{
    real moment[3];
    cross(arm, along, moment);
    for (int j = 0; j < 3; j++) {
        row[j] = (moment[0] * turn->E[0][j] + moment[1] * turn->E[1][j] + moment[2] * turn->E[2][j])
                 / scale;
        row[3 + j] = along[j] / scale;
    }
}

/* A leg of a moving plate; unit vectors in W. */
typedef struct {
    real angle, rate;      /* of the crank */
    real arm[3];           /* from the plate's COM to the joint */
    real velocity[3];      /* of the joint */
    real tangent[3];       /* direction of the crank's tip */
    real rod[3];
    real lever;            /* u rod.tangent */
} LegMotion;

#define LEAST_TRANSMISSION ((real)0.01) /* |rod.tangent| is at least this; it is less outside the workspace */

/* Return the motion of a leg for the plate's angular velocity w and the velocity v of its COM. It is finite
   also out of reach and at dead centres, which the stages of an integrator may pass. */
static inline LegMotion leg_motion_of(const Leg *leg, const Turn *turn, const real *pose, const real *w,
                                      const real *v)
{
    LegMotion m;
    real q[3], length = 0;
    joint_of(leg, turn, pose, m.arm, q);
    const real a = 2 * leg->crank * q[0], b = 2 * leg->crank * q[1], far = REAL(hypot)(a, b);
    const real c = dot(q, q) + leg->crank * leg->crank - leg->rod * leg->rod;
    const real cosine = REAL(fmax)(-1, REAL(fmin)(1, c / far));
    const real sine = leg->branch * REAL(sqrt)((1 - cosine) * (1 + cosine));
    m.angle = REAL(atan2)(b, a) + leg->branch * REAL(acos)(cosine);
    const real ca = (a * cosine - b * sine) / far, sa = (b * cosine + a * sine) / far;
    cross(w, m.arm, m.velocity);
    for (int i = 0; i < 3; i++) {
        const real *axes = leg->R[i];
        m.velocity[i] += v[i];
        m.tangent[i] = ca * axes[1] - sa * axes[0];
        m.rod[i] = pose[3 + i] + m.arm[i] - leg->shaft[i] - leg->crank * (ca * axes[0] + sa * axes[1]);
        length += m.rod[i] * m.rod[i];
    }
    for (int i = 0; i < 3; i++)
        m.rod[i] /= REAL(sqrt)(length);
    /* rod.tangent has the sign of -branch. */
    const real transmission = REAL(fmax)(LEAST_TRANSMISSION, -leg->branch * dot(m.rod, m.tangent));
    m.lever = -leg->branch * leg->crank * transmission;
    m.rate = dot(m.rod, m.velocity) / m.lever;
    return m;
}
