/* See shooting.h. Separate from dynamics.c, which is exported to boards. */

#include <string.h>

#include "shooting.h"

/* Only two functions of equations.h are used here. */
#pragma GCC diagnostic ignored "-Wunused-function"
#include "equations.h"
#include "short.h"

/* The part (6) of each leg in F, from the sums, arms and rates of `leg_motion`. */
static void forces_of_legs(const real *parameters, const real *nu_dot, const real *torque, const real *sums,
                           const real *arms, const real *rates, real force[LEGS][6])
{
    static const int entry[6][6] = {{0, 1, 3, 6, 9, 12},     {1, 2, 4, 7, 10, 13},
                                    {3, 4, 5, 8, 11, 14},    {6, 7, 8, 15, 16, 18},
                                    {9, 10, 11, 16, 17, 19}, {12, 13, 14, 18, 19, 20}};
    for (int leg = 0; leg < LEGS; leg++) {
        const real resisted = parameters[DAMPING] * rates[leg] +
                              parameters[COULOMB] * REAL(tanh)(rates[leg] / parameters[COULOMB_SPEED]);
        const real at_shaft = torque[leg] + parameters[leg] - resisted;
        for (int i = 0; i < 6; i++) {
            force[leg][i] = sums[LEGS * (BIAS_FORCE + i) + leg] - arms[LEGS * i + leg] * at_shaft;
            for (int j = 0; j < 6; j++)
                force[leg][i] += sums[LEGS * entry[i][j] + leg] * nu_dot[j];
        }
    }
}

/* A leg's numbers change its own part only, so that one difference serves all six. */
void stewart_leg_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                             const real *accelerations, const real *torque, real *dF_dlegs)
{
    static const int places[8] = {0, 1, 12, 13, 14, 15, 16, 17};
    const real *common = plant->geometry + COMMON, *p = plant->parameters;
    const real st = REAL(sin)(pose[1]), ct = REAL(cos)(pose[1]), h = (real)1e-5 * plant->geometry[0];
    const real sp = REAL(sin)(pose[2]), cp = REAL(cos)(pose[2]), *a = accelerations, *r = rates;
    /* nu_dot = [E a + E_dot r; a] */
    const real nu_dot[6] = {
        cp * ct * a[0] - sp * a[1] - (sp * ct * r[2] + cp * st * r[1]) * r[0] - cp * r[2] * r[1],
        sp * ct * a[0] + cp * a[1] + (cp * ct * r[2] - sp * st * r[1]) * r[0] - sp * r[2] * r[1],
        a[2] - st * a[0] - ct * r[1] * r[0],
        a[3],
        a[4],
        a[5],
    };
    real moving[21], alone[SUMS], legs[COMMON], force[2][LEGS][6];
    plate_motion(pose, rates, p, plant->gravity, common, moving, alone);
    memcpy(legs, plant->geometry, sizeof legs);
    for (int k = 0; k < 8; k++) {
        for (int side = 0; side < 2; side++) {
            real sums[SUMS * LEGS], arms[36], crank_rates[LEGS];
            for (int i = LEGS * places[k]; i < LEGS * (places[k] + 1); i++)
                legs[i] = plant->geometry[i] + (side ? h : -h);
            leg_motion(moving, common, legs, sums, arms, crank_rates);
            forces_of_legs(p, nu_dot, torque, sums, arms, crank_rates, force[side]);
        }
        memcpy(legs, plant->geometry, sizeof legs);
        for (int leg = 0; leg < LEGS; leg++)
            for (int i = 0; i < 6; i++)
                dF_dlegs[6 * (8 * leg + k) + i] = (force[1][leg][i] - force[0][leg][i]) / (2 * h);
    }
}
