#include "legs.h"

#define NEWTON_STEPS 50
#define LEAST_STEP ((real)1e-3) /* over Newton's step */
#define WRONG_BRANCH ((real)1e-5) /* rod.tangent that counts as another branch */
#define MOST_PIECES 16 /* steps from the angles of the guess, where a single one crosses a singularity */
#ifdef STEWART_FLOAT
#define TOLERANCE ((real)5e-7)   /* of a rod's length, relative */
#define DEAD_CENTRE ((real)5e-4)
#else
#define TOLERANCE 1e-13
#define DEAD_CENTRE 1e-7 /* |rod.tangent| that counts as zero: acos resolves angles to 1.5e-8 rad there */
#endif

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

/* Newton's method; `pose` holds a guess before. */
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
    real measures[STEWART_NUM_MEASURES];
    stewart_measures(geometry, pose, NULL, measures);
    return (measures[LEGS] > 0) - (measures[LEGS] < 0);
}

/* Return an angle, moved by whole turns to within half a turn of another. */
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
