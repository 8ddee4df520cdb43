/* Reach of the legs, see kinematics.h. */

#include "legs.h"

#define DEAD_CENTRE_SINE ((real)0.01) /* least sine of a crank's angle off dead centre, as in core/layout.py */

int stewart_within_reach(const real *geometry, const real *pose, int strictly)
{
    const Turn turn = turn_of(pose);
    for (int i = 0; i < LEGS; i++) {
        const Leg leg = leg_of(geometry, i);
        real arm[3], q[3];
        joint_of(&leg, &turn, pose, arm, q);
        /* From the tip of the crank, on a circle of radius u about the z axis, to the joint q, rho off that axis:
           (rho - u)^2 + q_z^2 <= rod^2 <= (rho + u)^2 + q_z^2. */
        const real rho = REAL(hypot)(q[0], q[1]), u = leg.crank, square = leg.rod * leg.rod;
        const real least = (rho - u) * (rho - u) + q[2] * q[2], most = least + 4 * rho * u;
        const real margin = REAL(fmin)(square - least, most - square);
        if (!(strictly ? margin > 0 : margin >= 0)) /* or NaN */
            return 0;
    }
    return 1;
}

int stewart_is_workable(const real *geometry, const real *pose)
{
    real measures[STEWART_NUM_MEASURES];
    if (!stewart_within_reach(geometry, pose, 1))
        return 0;
    stewart_measures(geometry, pose, NULL, measures);
    for (int i = 0; i < LEGS; i++)
        if (measures[i] < DEAD_CENTRE_SINE)
            return 0;
    return 1;
}
