/* Motions of the plate that are known at all times: piecewise polynomials, then waves. They have double
   precision also in a build with single precision, since times may be long. */

#pragma once

#include "real.h"

typedef struct stewart_motion stewart_motion;

/* In piece i the pose is  sum_k c_k (t - t_i)^k;  after the last piece it is that of `then`, or without one
   offset + amplitude sin(frequency t). Before the first piece the plate rests. The time between two pieces
   belongs to the later one. */
struct stewart_motion {
    int pieces, degree;
    const double *times;        /* (pieces + 1) ascending, s */
    const double *coefficients; /* (degree + 1, pieces, 6), that of the highest power first */
    const stewart_motion *then;
    double offset[6], amplitude[6], frequency[6]; /* of the waves; rad/s */
};

/* Compute the pose and its derivatives (orders, 6), orders 0 to `orders` - 1, at a time in s. Times below 0,
   and NaN, count as 0. */
void stewart_derivatives_of_motion(const stewart_motion *motion, double time, int orders, double *values);

/* Compute the rows (number, 18) at times (number) in s. */
void stewart_rows_of_motion(const stewart_motion *motion, int number, const double *times, real *rows);

/* Motions of a sample, as the `context` of its `reference` and `goal`. */
typedef struct {
    const stewart_motion *planned, *goal;
    double now; /* of the sample, s */
} stewart_known_motion;

void stewart_planned_rows(void *context, int number, const real *times, real *rows);
void stewart_goal_rows(void *context, int number, const real *times, real *rows);
