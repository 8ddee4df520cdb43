/* One Kalman update in square-root form, iterated, for every filter of the law. */

#pragma once

#include "matrix.h"

#define STEWART_LARGEST_JUMP ((real)100) /* of a parameter, in its standard deviations jump_std */
#define STEWART_MAX_BOUNDED 21 /* components that may be at a bound at a time */

/* Prior N(mean, L L') of xi (n), and the model of a measurement.

   `rows` computes the residuals e (m) at xi and H (m, n), the derivative of the prediction, both
   whitened: with R = C C' they are C^-1 e and C^-1 H. Returns m, at most `most`, or -1 if xi has no
   prediction. Values that are left out have no row.

   `settle` moves from `xi` to `better`, the result of an iteration, and linearises there unless the
   correction is small. Returns 1 for a small correction, which ends the iterations, 0 for another one,
   or -1 if `better` has no prediction. */
typedef struct {
    int n, most, iterations;
    const real *mean, *root;   /* (n), L (n, n) */
    const real *lower, *upper; /* (n), infinite without a bound */
    void *model;
    int (*rows)(void *model, const real *xi, real *e, real *H, stewart_scratch scratch);
    int (*settle)(void *model, const real *xi, const real *better, stewart_scratch scratch);
    real max_distance; /* of the first iteration, above which the update is given up; 0: none */
    real *innovations, *variances; /* (most) results, NULL: none: nu and the diagonal of S, both whitened */
} stewart_kalman;

/* Compute the mean xi (n), from a first guess in its place, and the root (n, n) of its covariance, which
   must not be that of the prior. `distance` is nu' S^-1 nu of the last innovation
   nu = e + H (xi - mean), with S = H P H' + R, and `spread` is ln |S| - ln |R|. Returns 0 if there is no
   prediction, for NaN in a bounded mean, or if it is given up; the caller checks all other numbers.

   Scratch: `stewart_kalman_scratch` numbers, and what the model takes. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *spread, stewart_scratch scratch);

int stewart_kalman_scratch(int n, int most);

/* R (n, n), upper triangular, <- R of the QR decomposition of [R; W]; W (m, n) is lost. With covariances
   R'R and W'W that is the root of their sum. */
void stewart_absorb(int n, int m, real *R, real *W);

/* L (n, n) <- root of F L L' F' + diag(std, walk)^2 + [K'K, 0; 0, 0], F = [H; 0 1] with H (12, n), std
   (12), walk (n - 12) and K (k, 12). Scratch: (2 n + k) n numbers. */
void stewart_root_of_prediction(int n, const real *H, const real *std, const real *walk, int k,
                                const real *K, real *L, stewart_scratch scratch);

/* L (n, n) <- root of L L' + diag(0, jump)^2 with jump (n - 12). Scratch: 2 n n + 12 n numbers. */
void stewart_widen_root(int n, const real *jump, real *L, stewart_scratch scratch);

/* Compute the mean within bounds that is nearest to `mean` in the metric of the covariance L L'. Returns 0
   for NaN, or if a component without variance is out of bounds.
   Scratch: n + STEWART_MAX_BOUNDED^2 numbers. */
int stewart_within_bounds(int n, const real *mean, const real *L, const real *lower,
                          const real *upper, real *bounded, stewart_scratch scratch);
