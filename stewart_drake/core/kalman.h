/* One Kalman update in square-root form, iterated, for every filter of the law. */

#pragma once

#include "matrix.h"

#define STEWART_MAX_BOUNDED 21 /* components that may be at a bound at a time */

/* What is believed of xi (n) before a measurement, N(mean, L L'), and how that is seen.

   `rows` writes the residuals e (m), measured less seen at xi, and H (m, n), the derivative of what
   is seen; both divided by the noise: with R = C C' they are C^-1 e and C^-1 H. Returns m, at most
   `most`, or -1 where nothing can be seen from xi. What is left out is not among the rows.

   `settle` goes on from `xi` to `better`, the result of an iteration: it linearises there, unless
   the correction is so small that nothing would change. Returns 1 for such a correction, which ends
   the iterations, 0 for another one, or -1 where nothing can be seen from there. */
typedef struct {
    int n, most, iterations;
    const real *mean, *root;   /* (n), L (n, n) */
    const real *lower, *upper; /* (n), infinite where there is no bound */
    void *model;
    int (*rows)(void *model, const real *xi, real *e, real *H, stewart_scratch scratch);
    int (*settle)(void *model, const real *xi, const real *better, stewart_scratch scratch);
} stewart_kalman;

/* The mean xi (n), from a first guess in its place, and the root (n, n) of its covariance, not that of
   the prior. `distance` is nu' S^-1 nu of the last innovation nu = e + H (xi - mean), S = H P H' + R,
   and `spread` is ln |S| - ln |R|. Returns 0 where the model cannot go on, or for NaN in a bounded
   mean; other numbers that are not finite are for the caller to look for.

   Scratch: `stewart_kalman_scratch` numbers, and what the model takes. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *spread, stewart_scratch scratch);

int stewart_kalman_scratch(int n, int most);

/* R (n, n), upper triangular, <- R of the QR decomposition of [R; W]; W (m, n) is lost. With covariances
   R'R and W'W that is the root of their sum. Scratch: n numbers. */
void stewart_absorb(int n, int m, real *R, real *W, stewart_scratch scratch);

/* L (n, n) <- root of F L L' F' + diag(std)^2, F = [H; 0 1] with H (12, n), std (12).
   Scratch: 2 n n + n numbers. */
void stewart_root_of_prediction(int n, const real *H, const real *std, real *L,
                                stewart_scratch scratch);

/* P (n, n) <- L, lower triangular with L L' = P, which is symmetric and may be singular: a component
   that the ones before it determine has a column of zeros. Returns 0 for a negative variance beyond rounding, or NaN. */
int stewart_root(int n, real *P);

/* The mean nearest to `mean`, as the covariance L L' measures it, with every component in its bounds.
   Returns 0 for NaN, or where a component without variance is out of bounds.
   Scratch: n + STEWART_MAX_BOUNDED^2 numbers. */
int stewart_within_bounds(int n, const real *mean, const real *L, const real *lower,
                          const real *upper, real *moved, stewart_scratch scratch);
