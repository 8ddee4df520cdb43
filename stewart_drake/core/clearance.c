#include "clearance.h"
#include "legs.h"

#define PARALLEL ((real)1e-14) /* square of the sine between lines that count as parallel */

/* Centre line of a link, m. */
typedef struct {
    real start[3], along[3];
} Line;

/* Lines of the crank and the rod of a leg. Returns the reach that it has left, m; out of reach they are NaN. */
static real lines_of(const Leg *leg, const Turn *turn, const real *pose, Line *crank, Line *rod)
{
    real arm[3], q[3];
    joint_of(leg, turn, pose, arm, q);
    /* As in reach.c: the joint's distance from the circle of the crank's tip. */
    const real rho = REAL(hypot)(q[0], q[1]), u = leg->crank;
    const real left = REAL(fmin)(leg->rod - REAL(hypot)(rho - u, q[2]), REAL(hypot)(rho + u, q[2]) - leg->rod);
    const real alpha = left >= 0 ? angle_of(leg, q) : (real)NAN;
    const real c = REAL(cos)(alpha), s = REAL(sin)(alpha);
    for (int i = 0; i < 3; i++) {
        crank->start[i] = leg->shaft[i];
        crank->along[i] = u * (c * leg->R[i][0] + s * leg->R[i][1]);
        rod->start[i] = leg->shaft[i] + crank->along[i];
        rod->along[i] = pose[3 + i] + arm[i] - rod->start[i];
    }
    return left;
}

/* Distance of two lines, at the shares s and t of them. Its square is convex in s and t. The best s of the whole
   lines is cut to the segment, then the best t for it, then the best s for that: where one was cut, the minimum
   lies on the border of the square, and these steps end there. Parallel lines have many minima, and s = 0
   leads to one. */
static real distance(const Line *a, const Line *b)
{
    real r[3], d[3];
    for (int i = 0; i < 3; i++)
        r[i] = a->start[i] - b->start[i];
    const real uu = dot(a->along, a->along), vv = dot(b->along, b->along), uv = dot(a->along, b->along);
    const real ur = dot(a->along, r), vr = dot(b->along, r), area = uu * vv - uv * uv;
    real s = area > PARALLEL * uu * vv ? clamped(0, (uv * vr - ur * vv) / area, 1) : 0;
    const real t = clamped(0, (uv * s + vr) / vv, 1);
    s = clamped(0, (uv * t - ur) / uu, 1);
    for (int i = 0; i < 3; i++)
        d[i] = r[i] + s * a->along[i] - t * b->along[i];
    return REAL(sqrt)(dot(d, d));
}

void stewart_room(const real *geometry, int number, const real *poses, int pairs, const int *links,
                  const real *radii, real unit, const real *least, real *room)
{
    Line lines[2 * LEGS];
    for (int k = 0; k < number; k++, poses += 6) {
        const Turn turn = turn_of(poses);
        for (int i = 0; i < LEGS; i++) {
            const Leg leg = leg_of(geometry, i);
            *room++ = lines_of(&leg, &turn, poses, lines + i, lines + LEGS + i) / unit - least[i];
        }
        for (int i = 0; i < pairs; i++) {
            const int a = links[2 * i], b = links[2 * i + 1];
            const real apart = distance(lines + a, lines + b) - radii[a] - radii[b];
            *room++ = apart / unit - least[LEGS + i];
        }
    }
}
