/* The discrete algebraic Riccati equation by structure-preserving doubling. */

#pragma once

#include "matrix.h"

#define STEWART_MAX_ORDER 24 /* states: pose, rates, integral, and the previous torque */
#define STEWART_INPUTS 6

/* Gain K (6, n) of u = -K x that minimises sum x'Qx + u'Ru of x+ = A x + B u, and P (n, n), its cost
   x'Px, or NULL. A (n, n), B (n, 6), Q (n, n), R (6, 6) by rows; Q and R are symmetric, n is 6, 12,
   18 or 24.

   Returns the number of doublings, or 0 if no stabilising solution was found.
   Scratch: `stewart_lqr_scratch` numbers. */
int stewart_lqr(int n, const real *A, const real *B, const real *Q, const real *R, real *K, real *P,
                stewart_scratch scratch);

int stewart_lqr_scratch(int n);
