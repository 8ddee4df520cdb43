/* The dynamics of a mechanism behind one packed buffer per function: its arguments, the geometry, its
   results, matrices by columns (native/layout.py). No state, no allocation: any thread may call, with
   a buffer of its own. */

#include <math.h>
#include <string.h>

#include "equations.h"

#ifndef SOURCE
#define SOURCE ""
#endif

#define EXPORT __attribute__((visibility("default")))
#define NUM_LEGS 6
#define SUMS 28 /* numbers of `equations.Sums`, each triangle of a symmetric matrix once */
#define COMMON (NUM_LEGS * LEG_NUMBERS) /* where the geometry goes on after the legs */

/* Of what it was compiled; a library that is older than its source is not used. */
EXPORT const char *source(void) { return SOURCE; }

/* `equations.slip` of six cranks. */
static void slips(const double *crank_rates, const double *parameters, double *slip)
{
    for (int leg = 0; leg < NUM_LEGS; leg++)
        slip[leg] = tanh(crank_rates[leg] / parameters[COULOMB_SPEED]);
}

/* Plate and legs, summed, B' by columns, rates and slips of the cranks. */
typedef struct {
    double sums[SUMS], arms[36], rates[NUM_LEGS], slip[NUM_LEGS];
} Motion;

static void motion(const double *pose, const double *rates, const double *parameters,
                   const double *gravity, const double *geometry, Motion *m)
{
    double plate[21], added[SUMS * NUM_LEGS];
    plate_motion(pose, rates, parameters, gravity, geometry + COMMON, plate, m->sums);
    leg_motion(plate, geometry + COMMON, geometry, added, m->arms, m->rates);
    for (int i = 0; i < SUMS; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            m->sums[i] += added[NUM_LEGS * i + leg];
    /* They cost a tenth of all this, and nobody reads them without Coulomb friction. */
    memset(m->slip, 0, sizeof m->slip);
    if (parameters[COULOMB] != 0.)
        slips(m->rates, parameters, m->slip);
}

static void accelerate(const double *pose, const double *rates, const double *torque,
                       const double *parameters, const double *gravity, const double *geometry,
                       double *accelerations)
{
    Motion m;
    motion(pose, rates, parameters, gravity, geometry, &m);
    solve_accelerations(pose, rates, torque, parameters, m.rates, m.slip, m.sums, m.arms,
                        accelerations);
}

EXPORT void accelerations(double *b)
{
    double *parameters = b + 18, *gravity = parameters + PARAMETERS, *geometry = gravity + 1;
    accelerate(b, b + 6, b + 12, parameters, gravity, geometry, geometry + GEOMETRY);
}

/* d[pose; rates]/dt, with the arguments of `accelerations`. */
EXPORT void change(double *b)
{
    double *parameters = b + 18, *gravity = parameters + PARAMETERS, *geometry = gravity + 1;
    double *result = geometry + GEOMETRY;
    memcpy(result, b + 6, 6 * sizeof(double));
    accelerate(b, b + 6, b + 12, parameters, gravity, geometry, result + 6);
}

EXPORT void inverse_dynamics(double *b)
{
    double *parameters = b + 18, *gravity = parameters + PARAMETERS, *geometry = gravity + 1;
    Motion m;
    motion(b, b + 6, parameters, gravity, geometry, &m);
    solve_torque(b, b + 6, b + 12, parameters, m.rates, m.slip, m.sums, m.arms,
                 geometry + GEOMETRY);
}

EXPORT void energy(double *b)
{
    double *parameters = b + 12, *gravity = parameters + PARAMETERS, *geometry = gravity + 1;
    Motion m;
    motion(b, b + 6, parameters, gravity, geometry, &m);
    geometry[GEOMETRY] = m.sums[SUMS - 1];
}

EXPORT void terms(double *b)
{
    double *parameters = b + 12, *gravity = parameters + PARAMETERS, *geometry = gravity + 1;
    double *M = geometry + GEOMETRY;
    Motion m;
    motion(b, b + 6, parameters, gravity, geometry, &m);
    pose_terms(b, b + 6, m.sums, m.arms, M, M + 36, M + 42);
}

EXPORT void residual_derivatives(double *b)
{
    double *torque = b + 18, *parameters = b + 24, *gravity = parameters + PARAMETERS;
    double *geometry = gravity + 1, *common = geometry + COMMON;
    double *dF_dx = geometry + GEOMETRY, *dF_dp = dF_dx + 72, *MN = dF_dp + 6 * PARAMETERS;
    double *arms = MN + 36, M[36], arm_rates[NUM_LEGS], slip[NUM_LEGS];
    double change_of_legs[72 * NUM_LEGS], mass_of_legs[36 * NUM_LEGS];
    plate_derivatives(b, b + 6, b + 12, parameters, gravity, common, dF_dx, M);
    crank_rates(b, b + 6, geometry, arm_rates);
    slips(arm_rates, parameters, slip);
    leg_derivatives(b, b + 6, b + 12, parameters, gravity, common, geometry, torque, parameters,
                    slip, change_of_legs, mass_of_legs, arms);
    for (int i = 0; i < 72; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            dF_dx[i] += change_of_legs[NUM_LEGS * i + leg];
    for (int i = 0; i < 36; i++)
        for (int leg = 0; leg < NUM_LEGS; leg++)
            M[i] += mass_of_legs[NUM_LEGS * i + leg];
    pose_derivatives(b, b + 6, b + 12, parameters, gravity, M, arms, arm_rates, slip, dF_dp, MN);
}

EXPORT void measures(double *b)
{
    double *geometry = b + 6, sines[NUM_LEGS], wrenches[36];
    leg_measures(b, geometry + COMMON, geometry, sines, wrenches);
    all_measures(b, sines, wrenches, geometry + GEOMETRY);
}

EXPORT void measures_of_tree(double *b)
{
    double *angles = b + 6, *geometry = b + 12, sines[NUM_LEGS], wrenches[36];
    leg_measures_of_tree(b, geometry + COMMON, geometry, angles, sines, wrenches);
    all_measures(b, sines, wrenches, geometry + GEOMETRY);
}

/* pose (6), sign, least (8), geometry -> the least that the measures are above `least`; a NaN stays. */
EXPORT void margin(double *b)
{
    double *sign = b + 6, *least = b + 7, *geometry = b + 15, *result = geometry + GEOMETRY;
    double sines[NUM_LEGS], wrenches[36], found[8];
    leg_measures(b, geometry + COMMON, geometry, sines, wrenches);
    all_measures(b, sines, wrenches, found);
    found[6] *= *sign;
    *result = found[0] - least[0];
    for (int i = 1; i < 8; i++) {
        double above = found[i] - least[i];
        if (above < *result || isnan(above))
            *result = above;
    }
}

/* steps, state (12), torques (6 each), parameters, gravity, durations, geometry -> states (12 each):
   steps of the classical Runge-Kutta method, in the order of operations of `virtual_machine`. */
EXPORT void predict(double *b)
{
    int n = (int)b[0];
    double *torque = b + 13, *parameters = torque + 6 * n, *gravity = parameters + PARAMETERS;
    double *h = gravity + 1, *geometry = h + n, *result = geometry + GEOMETRY;
    double x[12], y[12], k[4][12];
    static const double part[3] = {0.5, 0.5, 1.};
    memcpy(x, b + 1, sizeof x);
    for (int step = 0; step < n; step++, torque += 6, h++, result += 12) {
        memcpy(y, x, sizeof x);
        for (int stage = 0; stage < 4; stage++) {
            memcpy(k[stage], y + 6, 6 * sizeof(double));
            accelerate(y, y + 6, torque, parameters, gravity, geometry, k[stage] + 6);
            if (stage < 3)
                for (int i = 0; i < 12; i++)
                    y[i] = x[i] + part[stage] * *h * k[stage][i];
        }
        for (int i = 0; i < 12; i++)
            x[i] += *h / 6. * (k[0][i] + 2. * k[1][i] + 2. * k[2][i] + k[3][i]);
        memcpy(result, x, sizeof x);
    }
}
