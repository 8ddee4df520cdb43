/* See shooting.h. */

#include <string.h>

#include "matrix.h"
#include "shooting.h"
#include "short.h"

#define MAX_COLUMNS (X + STEWART_CONSTANTS + LEGS * STEWART_PER_LEG + 1) /* of S; the last: the delay */

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
        stewart_leg_derivatives(plant, state, state + 6, accelerations, torque, by_legs);
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

/* Time derivatives of x, and of S (12, columns). */
static void time_derivatives(const stewart_plant *plant, int legs, int columns, const double *x,
                             const double *S, const double *torque, double *dx, double *dS)
{
    const int numbers = numbers_of(legs);
    double A[6 * X], P[6 * MAX_COLUMNS];
    stewart_copy(6, x + 6, dx);
    stewart_slopes(plant, legs, x, torque, dx + 6, A, P);
    stewart_copy(6 * columns, S + 6 * columns, dS);
    stewart_multiply(6, X, columns, A, S, dS + 6 * columns);
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < numbers; j++)
            dS[columns * (6 + i) + X + j] += P[numbers * i + j];
}

/* Add the increment of a classical Runge-Kutta step of h to x (size), from the slopes k of its stages. */
static void add_increment(int size, double h, const double *const k[4], double *x)
{
    for (int i = 0; i < size; i++)
        x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
}

static void step(const stewart_plant *plant, int legs, int columns, const double *torque, double h,
                 double *x, double *S)
{
    static const double part[3] = {0.5, 0.5, 1};
    const int size = X * columns;
    double k[4][X], K[4][X * MAX_COLUMNS], y[X], Y[X * MAX_COLUMNS];
    stewart_copy(X, x, y);
    stewart_copy(size, S, Y);
    for (int stage = 0; stage < 4; stage++) {
        time_derivatives(plant, legs, columns, y, Y, torque, k[stage], K[stage]);
        for (int i = 0; stage < 3 && i < X; i++)
            y[i] = x[i] + part[stage] * h * k[stage][i];
        for (int i = 0; stage < 3 && i < size; i++)
            Y[i] = S[i] + part[stage] * h * K[stage][i];
    }
    add_increment(X, h, (const double *const[4]){k[0], k[1], k[2], k[3]}, x);
    add_increment(size, h, (const double *const[4]){K[0], K[1], K[2], K[3]}, S);
}

void stewart_shoot(const stewart_plant *plant, int legs, long number, const double *h,
                   const double *torques, const double *after, const int *sample, const double *first,
                   double *states, double *slopes)
{
    const int columns = slopes ? X + numbers_of(legs) + 1 : 0;
    double x[X], S[X * MAX_COLUMNS] = {0}, before[6], then[6];
    stewart_copy(X, first, x);
    for (int i = 0; columns && i < X; i++)
        S[columns * i + i] = 1;
    for (long k = 0; k < number; k++) {
        const double *torque = torques + U * k, *next = after + U * k;
        if (columns)
            step(plant, legs, columns, torque, h[k], x, S);
        else
            stewart_runge_kutta_step(plant, torque, h[k], x);
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
