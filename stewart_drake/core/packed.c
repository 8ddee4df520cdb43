/* For who calls from another language. The functions of dynamics.h behind one packed buffer each: the
   arguments, the geometry, the results, matrices by columns (core/layout.py). */

#include <math.h>
#include <string.h>

#include "dynamics.h"

#ifndef SOURCE
#define SOURCE ""
#endif

#define EXPORT __attribute__((visibility("default")))

/* Of what it was compiled; a library that is older than its source is not used. */
EXPORT const char *source(void) { return SOURCE; }

/* Parameters and gravity follow one another in every buffer, and most often the geometry. */
static stewart_plant plant_at(const double *parameters)
{
    const double *gravity = parameters + STEWART_PARAMETERS;
    stewart_plant plant = {gravity + 1, parameters, gravity};
    return plant;
}

static double *results_after(const stewart_plant *plant)
{
    return (double *)plant->geometry + STEWART_GEOMETRY;
}

EXPORT void accelerations(double *b)
{
    stewart_plant plant = plant_at(b + 18);
    stewart_accelerations(&plant, b, b + 6, b + 12, results_after(&plant));
}

/* d[pose; rates]/dt, with the arguments of `accelerations`. */
EXPORT void change(double *b)
{
    stewart_plant plant = plant_at(b + 18);
    double *result = results_after(&plant);
    memcpy(result, b + 6, 6 * sizeof(double));
    stewart_accelerations(&plant, b, b + 6, b + 12, result + 6);
}

EXPORT void inverse_dynamics(double *b)
{
    stewart_plant plant = plant_at(b + 18);
    stewart_inverse_dynamics(&plant, b, b + 6, b + 12, results_after(&plant));
}

EXPORT void energy(double *b)
{
    stewart_plant plant = plant_at(b + 12);
    *results_after(&plant) = stewart_energy(&plant, b, b + 6);
}

EXPORT void terms(double *b)
{
    stewart_plant plant = plant_at(b + 12);
    double *M = results_after(&plant);
    stewart_terms(&plant, b, b + 6, M, M + 36, M + 42);
}

EXPORT void residual_derivatives(double *b)
{
    stewart_plant plant = plant_at(b + 24);
    double *dF_dx = results_after(&plant), *dF_dp = dF_dx + 72;
    double *MN = dF_dp + 6 * STEWART_PARAMETERS;
    stewart_residual_derivatives(&plant, b, b + 6, b + 12, b + 18, dF_dx, dF_dp, MN, MN + 36);
}

EXPORT void measures(double *b)
{
    stewart_measures(b + 6, b, NULL, b + 6 + STEWART_GEOMETRY);
}

EXPORT void measures_of_tree(double *b)
{
    stewart_measures(b + 12, b, b + 6, b + 12 + STEWART_GEOMETRY);
}

/* pose (6), sign, least (8), geometry -> the least that the measures are above `least`; a NaN stays. */
EXPORT void margin(double *b)
{
    double *sign = b + 6, *least = b + 7, *geometry = b + 15;
    double *result = geometry + STEWART_GEOMETRY, found[STEWART_MEASURES];
    stewart_measures(geometry, b, NULL, found);
    found[6] *= *sign;
    *result = found[0] - least[0];
    for (int i = 1; i < STEWART_MEASURES; i++) {
        double above = found[i] - least[i];
        if (above < *result || isnan(above))
            *result = above;
    }
}

/* steps, state (12), torques (6 each), parameters, gravity, durations, geometry -> states (12 each). */
EXPORT void predict(double *b)
{
    int n = (int)b[0];
    double *torque = b + 13, *parameters = torque + 6 * n, *gravity = parameters + STEWART_PARAMETERS;
    double *h = gravity + 1, *geometry = h + n, *result = geometry + STEWART_GEOMETRY, x[12];
    stewart_plant plant = {geometry, parameters, gravity};
    memcpy(x, b + 1, sizeof x);
    for (int step = 0; step < n; step++, torque += 6, result += 12) {
        stewart_move(&plant, torque, h[step], x);
        memcpy(result, x, sizeof x);
    }
}
