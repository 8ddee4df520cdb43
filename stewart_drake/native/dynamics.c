/* The dynamics of a mechanism: see dynamics.h. What is long is written by a program, in equations.h. */

#include <string.h>
#include <tgmath.h>

#include "dynamics.h"

#include "equations.h"

#if PARAMETERS != STEWART_PARAMETERS || GEOMETRY != STEWART_GEOMETRY
#error "dynamics.h and equations.h are of different equations"
#endif

#define NUM_LEGS 6
#define SUMS 28 /* numbers of `equations.Sums`, each triangle of a symmetric matrix once */
#define COMMON (NUM_LEGS * LEG_NUMBERS) /* where the geometry goes on after the legs */

/* Plate and legs, summed, and B' by columns. */
static void motion(const stewart_plant *plant, const real *pose, const real *rates, real *sums,
                   real *arms)
{
    const real *legs = plant->geometry, *common = legs + COMMON;
    real moving[21], added[SUMS * NUM_LEGS];
    plate_motion(pose, rates, plant->parameters, plant->gravity, common, moving, sums);
    leg_motion(moving, common, legs, added, arms);
    for (int i = 0; i < SUMS; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            sums[i] += added[NUM_LEGS * i + leg];
}

void stewart_accelerations(const stewart_plant *plant, const real *pose, const real *rates,
                           const real *torque, real *accelerations)
{
    real sums[SUMS], arms[36];
    motion(plant, pose, rates, sums, arms);
    solve_accelerations(pose, rates, torque, plant->parameters, sums, arms, accelerations);
}

void stewart_inverse_dynamics(const stewart_plant *plant, const real *pose, const real *rates,
                              const real *accelerations, real *torque)
{
    real sums[SUMS], arms[36];
    motion(plant, pose, rates, sums, arms);
    solve_torque(pose, rates, accelerations, plant->parameters, sums, arms, torque);
}

real stewart_energy(const stewart_plant *plant, const real *pose, const real *rates)
{
    real sums[SUMS], arms[36];
    motion(plant, pose, rates, sums, arms);
    return sums[SUMS - 1];
}

void stewart_terms(const stewart_plant *plant, const real *pose, const real *rates, real *M,
                   real *h, real *B)
{
    real sums[SUMS], arms[36];
    motion(plant, pose, rates, sums, arms);
    pose_terms(pose, rates, sums, arms, M, h, B);
}

void stewart_residual_derivatives(const stewart_plant *plant, const real *pose, const real *rates,
                                  const real *accelerations, const real *torque, real *dF_dx,
                                  real *dF_dp, real *M, real *B)
{
    const real *legs = plant->geometry, *common = legs + COMMON;
    const real *parameters = plant->parameters, *gravity = plant->gravity;
    real mass[36], arm_rates[NUM_LEGS], change_of_legs[72 * NUM_LEGS], mass_of_legs[36 * NUM_LEGS];
    plate_derivatives(pose, rates, accelerations, parameters, common, dF_dx, mass);
    leg_derivatives(pose, rates, accelerations, parameters, gravity, common, legs, torque, parameters,
                    change_of_legs, mass_of_legs, B, arm_rates);
    for (int i = 0; i < 72; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            dF_dx[i] += change_of_legs[NUM_LEGS * i + leg];
    for (int i = 0; i < 36; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            mass[i] += mass_of_legs[NUM_LEGS * i + leg];
    pose_derivatives(pose, accelerations, gravity, mass, B, arm_rates, dF_dp, M);
}

void stewart_measures(const real *geometry, const real *pose, const real *angles, real *measures)
{
    real sines[NUM_LEGS], wrenches[36];
    if (angles)
        leg_measures_of_tree(pose, geometry + COMMON, geometry, angles, sines, wrenches);
    else
        leg_measures(pose, geometry + COMMON, geometry, sines, wrenches);
    all_measures(pose, sines, wrenches, measures);
}

void stewart_move(const stewart_plant *plant, const real *torque, real h, real *x)
{
    static const real part[3] = {(real)0.5, (real)0.5, 1};
    real y[12], k[4][12];
    memcpy(y, x, sizeof y);
    for (int stage = 0; stage < 4; stage++) {
        memcpy(k[stage], y + 6, 6 * sizeof(real));
        stewart_accelerations(plant, y, y + 6, torque, k[stage] + 6);
        if (stage < 3)
            for (int i = 0; i < 12; i++)
                y[i] = x[i] + part[stage] * h * k[stage][i];
    }
    for (int i = 0; i < 12; i++)
        x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
}
