#include <string.h>

#include "matrix.h"
#include "shooting.h"

/* Only two functions of equations.h are used here. */
#pragma GCC diagnostic ignored "-Wunused-function"
#include "equations.h"
#include "short.h"

#define MAX_COLUMNS (X + STEWART_CONSTANTS + LEGS * STEWART_PER_LEG + 1) /* of S; the last: the delay */

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

/* dF (6) by crank, rod, plate joint (3) and shaft (3) of each leg, leg by leg (6, 48), of F of dynamics.h by
   central differences. A leg's numbers change its own part only, so that one difference serves all six. */
static void derivatives_by_legs(const stewart_plant *plant, const real *pose, const real *rates,
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

static int numbers_of(int legs) { return STEWART_CONSTANTS + (legs ? LEGS * STEWART_PER_LEG : 0); }

/* With F(state, accelerations, numbers) = 0 the slopes are -(dF/da)^-1 dF/d[state; numbers]. */
void stewart_slopes(const stewart_plant *plant, int legs, const double *state, const double *torque,
                    double *accelerations, double *by_state, double *by_numbers)
{
    const int numbers = numbers_of(legs), columns = X + numbers;
    double by_x[6 * X], by_p[6 * STEWART_PARAMETERS], by_legs[6 * LEGS * STEWART_PER_LEG];
    double M[36], B[36], slopes[6 * MAX_COLUMNS];
    stewart_accelerations(plant, state, state + 6, torque, accelerations);
    stewart_residual_derivatives(plant, state, state + 6, accelerations, torque, by_x, by_p, M, B);
    if (legs)
        derivatives_by_legs(plant, state, state + 6, accelerations, torque, by_legs);
    stewart_transpose(6, M);
    for (int i = 0; i < 6; i++) {
        double *row = slopes + columns * i;
        for (int j = 0; j < X; j++)
            row[j] = -by_x[6 * j + i];
        for (int j = 0; j < numbers; j++)
            row[X + j] = j < STEWART_CONSTANTS ? -by_p[6 * j + i] : -by_legs[6 * (j - STEWART_CONSTANTS) + i];
    }
    if (!stewart_solve(6, columns, M, slopes))
        stewart_fill(6 * columns, NAN, slopes);
    for (int i = 0; i < 6; i++) {
        stewart_copy(X, slopes + columns * i, by_state + X * i);
        stewart_copy(numbers, slopes + columns * i + X, by_numbers + numbers * i);
    }
}

/* Compute the time derivative of z = [x; S], S (12, columns). */
static void change(const stewart_plant *plant, int legs, int columns, const double *z, const double *torque,
                   double *dz)
{
    const int numbers = numbers_of(legs);
    const double *S = z + X;
    double A[6 * X], P[6 * MAX_COLUMNS], *dS = dz + X;
    stewart_copy(6, z + 6, dz);
    stewart_slopes(plant, legs, z, torque, dz + 6, A, P);
    stewart_copy(6 * columns, S + 6 * columns, dS);
    stewart_multiply(6, X, columns, A, S, dS + 6 * columns);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < numbers; j++)
            dS[columns * (6 + i) + X + j] += P[numbers * i + j];
}

/* Advance z by a step of the classical Runge-Kutta method. */
static void step(const stewart_plant *plant, int legs, int columns, const double *torque, double h, double *z)
{
    static const double part[3] = {0.5, 0.5, 1};
    const int size = X + X * columns;
    double k[4][X + X * MAX_COLUMNS], at[X + X * MAX_COLUMNS];
    stewart_copy(size, z, at);
    for (int stage = 0; stage < 4; stage++) {
        change(plant, legs, columns, at, torque, k[stage]);
        for (int i = 0; stage < 3 && i < size; i++)
            at[i] = z[i] + part[stage] * h * k[stage][i];
    }
    for (int i = 0; i < size; i++)
        z[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
}

void stewart_shoot(const stewart_plant *plant, int legs, long number, const double *h,
                   const double *torques, const double *after, const int *sample, const double *first,
                   double *states, double *slopes)
{
    const int columns = slopes ? X + numbers_of(legs) + 1 : 0;
    double x[X + X * MAX_COLUMNS] = {0}, *S = x + X, before[6], then[6];
    stewart_copy(X, first, x);
    for (int i = 0; columns && i < X; i++)
        S[columns * i + i] = 1;
    for (long k = 0; k < number; k++) {
        const double *torque = torques + U * k, *next = after + U * k;
        if (columns)
            step(plant, legs, columns, torque, h[k], x);
        else
            stewart_runge_kutta_step(plant, torque, h[k], x, (double[X]){0});
        if (columns && memcmp(torque, next, U * sizeof *torque)) {
            /* Jump of the last column, d[rates]/d[delay]. It precedes the sample: a sample at the switch
               has the derivative after it. */
            stewart_accelerations(plant, x, x + 6, torque, before);
            stewart_accelerations(plant, x, x + 6, next, then);
            for (int i = 0; i < 6; i++)
                S[columns * (6 + i) + columns - 1] += before[i] - then[i];
        }
        if (sample[k] < 0)
            continue;
        stewart_copy(X, x, states + X * sample[k]);
        if (columns)
            stewart_copy(X * columns, S, slopes + X * columns * sample[k]);
    }
}
