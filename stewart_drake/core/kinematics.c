/* See kinematics.h. */

#include "kinematics.h"
#include "short.h"

#define DEAD_CENTRE_SINE ((real)0.01) /* core/layout.py */
#define NEWTON_STEPS 50
#define LEAST_STEP ((real)1e-3) /* share of Newton's */
#define WRONG_BRANCH ((real)1e-5)
#define MOST_PIECES 16 /* of the way of the cranks from the guess, where one leads across a singularity */
#define TURN ((real)6.283185307179586)
#ifdef STEWART_FLOAT
#define TOLERANCE ((real)5e-7)   /* of a rod's length, relative */
#define DEAD_CENTRE ((real)5e-4)
#else
#define TOLERANCE 1e-13
#define DEAD_CENTRE 1e-7 /* |rod.tangent| that counts as zero: acos resolves angles to 1.5e-8 rad there */
#endif

/* The numbers of a leg. */
typedef struct {
    real crank, rod, branch, R[3][3] /* R_WS */, joint[3] /* p_PQ */, shaft[3] /* p_WS */;
} Leg;

static Leg leg_of(const real *geometry, int i)
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

/* R_WP of roll, pitch and yaw, and E. */
typedef struct {
    real R[3][3], E[3][3];
} Turn;

static Turn turn_of(const real *angles)
{
    const real sf = REAL(sin)(angles[0]), cf = REAL(cos)(angles[0]);
    const real st = REAL(sin)(angles[1]), ct = REAL(cos)(angles[1]);
    const real sp = REAL(sin)(angles[2]), cp = REAL(cos)(angles[2]);
    return (Turn){{{cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf},
                   {sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf},
                   {-st, ct * sf, ct * cf}},
                  {{cp * ct, -sp, 0}, {sp * ct, cp, 0}, {-st, 0, 1}}};
}

static real dot(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* arm (3), from the plate's COM to the joint, and q (3), in the motor's frame. */
static void joint_of(const Leg *leg, const Turn *turn, const real *pose, real *arm, real *q)
{
    real p[3];
    for (int i = 0; i < 3; i++) {
        arm[i] = dot(turn->R[i], leg->joint);
        p[i] = pose[3 + i] + arm[i] - leg->shaft[i];
    }
    for (int j = 0; j < 3; j++)
        q[j] = leg->R[0][j] * p[0] + leg->R[1][j] * p[1] + leg->R[2][j] * p[2];
}

/* Crank angle for a joint at q; NaN out of reach. */
static real angle_of(const Leg *leg, const real *q)
{
    const real a = 2 * leg->crank * q[0], b = 2 * leg->crank * q[1];
    const real c = dot(q, q) + leg->crank * leg->crank - leg->rod * leg->rod;
    return REAL(atan2)(b, a) + leg->branch * REAL(acos)(c / REAL(hypot)(a, b));
}

void stewart_crank_angles(const real *geometry, const real *pose, real *angles)
{
    const Turn turn = turn_of(pose);
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        real arm[3], q[3];
        joint_of(&leg, &turn, pose, arm, q);
        angles[i] = angle_of(&leg, q);
    }
}

int stewart_within_reach(const real *geometry, const real *pose, int strictly)
{
    const Turn turn = turn_of(pose);
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        real arm[3], q[3];
        joint_of(&leg, &turn, pose, arm, q);
        const real rho = REAL(hypot)(q[0], q[1]), shortest = REAL(hypot)(rho - leg.crank, q[2]);
        const real longest = REAL(hypot)(rho + leg.crank, q[2]);
        const real margin = REAL(fmin)(leg.rod - shortest, longest - leg.rod);
        if (!(strictly ? margin > 0 : margin >= 0)) /* or NaN */
            return 0;
    }
    return 1;
}

real stewart_margin(const real *geometry, const real *pose, real sign, const real *least)
{
    real measures[STEWART_MEASURES], margin = (real)HUGE_VAL;
    stewart_measures(geometry, pose, NULL, measures);
    measures[6] *= sign;
    for (int i = 0; i < STEWART_MEASURES; i++) {
        const real above = measures[i] - least[i];
        if (above < margin || isnan(above))
            margin = above;
    }
    return margin;
}

int stewart_is_workable(const real *geometry, const real *pose)
{
    real measures[STEWART_MEASURES];
    if (!stewart_within_reach(geometry, pose, 1))
        return 0;
    stewart_measures(geometry, pose, NULL, measures);
    for (int i = 0; i < LEGS; i++)
        if (measures[i] < DEAD_CENTRE_SINE)
            return 0;
    return 1;
}

/* row (6) = [(arm x along)' E, along'] / scale. */
static void row_of(const Turn *turn, const real *arm, const real *along, real scale, real *row)
{
    const real moment[3] = {arm[1] * along[2] - arm[2] * along[1],
                            arm[2] * along[0] - arm[0] * along[2],
                            arm[0] * along[1] - arm[1] * along[0]};
    for (int j = 0; j < 3; j++) {
        row[j] = (moment[0] * turn->E[0][j] + moment[1] * turn->E[1][j] + moment[2] * turn->E[2][j])
                 / scale;
        row[3 + j] = along[j] / scale;
    }
}

int stewart_crank_jacobian(const real *geometry, const real *pose, real *J)
{
    const Turn turn = turn_of(pose);
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        real arm[3], q[3], rod[3];
        joint_of(&leg, &turn, pose, arm, q);
        const real alpha = angle_of(&leg, q), c = REAL(cos)(alpha), s = REAL(sin)(alpha);
        const real local[3] = {(q[0] - leg.crank * c) / leg.rod, (q[1] - leg.crank * s) / leg.rod,
                               q[2] / leg.rod};
        const real transmission = c * local[1] - s * local[0];
        if (!(REAL(fabs)(transmission) >= DEAD_CENTRE)) { /* or NaN */
            stewart_fill(LEGS * LEGS, (real)NAN, J);
            return 0;
        }
        for (int j = 0; j < 3; j++)
            rod[j] = dot(leg.R[j], local);
        row_of(&turn, arm, rod, leg.crank * transmission, J + LEGS * i);
    }
    return 1;
}

/* Residuals of Newton's equations at a pose. */
typedef struct {
    Turn turn;
    real f[LEGS], arm[LEGS][3], along[LEGS][3]; /* p_TQ */
    real largest, square;
} Misfit;

static void misfit(const Leg *legs, real (*tips)[3], const real *pose, Misfit *m)
{
    m->turn = turn_of(pose);
    m->largest = m->square = 0;
    for (int i = 0; i < LEGS; i++) {
        for (int j = 0; j < 3; j++) {
            m->arm[i][j] = dot(m->turn.R[j], legs[i].joint);
            m->along[i][j] = pose[3 + j] + m->arm[i][j] - tips[i][j];
        }
        m->f[i] = dot(m->along[i], m->along[i]) / (legs[i].rod * legs[i].rod) - 1;
        m->square += m->f[i] * m->f[i];
        if (!(REAL(fabs)(m->f[i]) <= m->largest)) /* NaN too */
            m->largest = REAL(fabs)(m->f[i]);
    }
}

/* Newton's method from a guess in the place of the pose. */
static int newton(const real *geometry, const real *angles, real *pose, stewart_scratch scratch)
{
    Leg legs[LEGS];
    Misfit at, next;
    real tips[LEGS][3], tangents[LEGS][3];
    real *df = stewart_take(&scratch, LEGS * LEGS), *step = stewart_take(&scratch, LEGS);
    real *moved = stewart_take(&scratch, LEGS);
    for (int i = 0; i < LEGS; i++) {
        const real c = REAL(cos)(angles[i]), s = REAL(sin)(angles[i]);
        legs[i] = leg_of(geometry, i);
        for (int j = 0; j < 3; j++) {
            const real *axes = legs[i].R[j];
            tips[i][j] = legs[i].shaft[j] + legs[i].crank * (c * axes[0] + s * axes[1]);
            tangents[i][j] = c * axes[1] - s * axes[0];
        }
    }
    misfit(legs, tips, pose, &at);
    for (int round = 0; round < NEWTON_STEPS && !(at.largest <= TOLERANCE); round++) {
        real size = 1;
        for (int i = 0; i < LEGS; i++) {
            const real scale = legs[i].rod * legs[i].rod / 2;
            row_of(&at.turn, at.arm[i], at.along[i], scale, df + LEGS * i);
            step[i] = at.f[i];
        }
        if (!stewart_solve(LEGS, 1, df, step))
            return 0;
        for (;; size /= 2) {
            for (int i = 0; i < LEGS; i++)
                moved[i] = pose[i] - size * step[i];
            misfit(legs, tips, moved, &next);
            if (next.square < at.square || size <= LEAST_STEP)
                break;
        }
        stewart_copy(LEGS, moved, pose);
        at = next;
    }
    /* Rounding limits the misfit to a few units in the last place; a failure is orders above. */
    if (!(at.largest <= 100 * TOLERANCE))
        return 0;
    for (int i = 0; i < LEGS; i++) /* rod.tangent = -branch rho sin(delta) / l */
        if (legs[i].branch * dot(at.along[i], tangents[i]) > WRONG_BRANCH * legs[i].rod)
            return 0;
    return 1;
}

/* Sign of the measure of parallel singularity. */
static int side_of(const real *geometry, const real *pose)
{
    real measures[STEWART_MEASURES];
    stewart_measures(geometry, pose, NULL, measures);
    return (measures[LEGS] > 0) - (measures[LEGS] < 0);
}

static real turned(real angle, real near)
{
    return angle - TURN * REAL(floor)((angle - near) / TURN + (real)0.5);
}

int stewart_forward_kinematics(const real *geometry, const real *angles, real *pose,
                               stewart_scratch scratch)
{
    real guess[LEGS], first[LEGS], next[LEGS];
    const int side = side_of(geometry, pose);
    stewart_copy(LEGS, pose, guess);
    stewart_crank_angles(geometry, pose, first);
    for (int pieces = 1; pieces <= MOST_PIECES; pieces *= 2) {
        int found = 1;
        stewart_copy(LEGS, guess, pose);
        for (int piece = 1; piece <= pieces && found; piece++) {
            for (int i = 0; i < LEGS; i++)
                next[i] = angles[i] + (real)(pieces - piece) / (real)pieces
                                          * (first[i] - turned(angles[i], first[i]));
            found = newton(geometry, piece < pieces ? next : angles, pose, scratch);
        }
        for (int i = 0; i < 3 && found; i++)
            pose[i] = turned(pose[i], guess[i]);
        if (found && side_of(geometry, pose) * side >= 0)
            return 1;
        if (!stewart_all_finite(LEGS, first)) /* the guess is out of reach */
            return 0;
    }
    return 0;
}
