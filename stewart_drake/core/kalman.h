/* Iterated Kalman update in square-root form, for every filter of the law. */

#pragma once

#include "matrix.h"

#define STEWART_MAX_BOUNDED 21       /* components that may be at a bound at a time */

/* Prior N(mean, L L') of xi (n), and the model of a measurement.

   `residuals` computes e = y - h(xi) (m) and H = dh/dxi (m, n), both whitened: with noise of covariance
   R = C C' they are C^-1 e and C^-1 H. Values that are left out have no row. Returns m, at most
   `max_rows`, or -1 without a prediction from xi.

   `relinearize` ends an iteration, whose `change` (n) corrects xi to `updated`. Returns 1 if it is small, which
   ends the iterations. Otherwise it linearises at `updated`, and returns 0, or -1 if there is no
   prediction from there. */
typedef struct {
    int n, max_rows;
    int iterations;            /* largest number */
    const real *mean, *root;   /* prior: (n), L (n, n) */
    const real *lower, *upper; /* (n), infinite without a bound */
    void *context;
    int (*residuals)(void *context, const real *xi, real *e, real *H, stewart_scratch scratch);
    int (*relinearize)(void *context, const real *change, const real *updated, stewart_scratch scratch);
    real *low; /* (12) as of `stewart_accumulate`, of the first 12 of the prior, then of the result; or NULL */
    real max_distance; /* the update is given up if `distance` of the first iteration is larger; 0: never */
    real *innovations; /* (max_rows) result nu, whitened; or NULL */
    real *variances;   /* (max_rows) result, diagonal of S, whitened; or NULL */
} stewart_kalman;

/* Update xi (n), which holds an initial guess, to the posterior mean, and compute the root (n, n) of its
   covariance. `root` must not overlap that of the prior. `distance` is nu' S^-1 nu of the last innovation
   nu = e + H (xi - mean), with S = H P H' + R, and `log_ratio` is ln |S| - ln |R|. Returns 0 without a
   prediction, for NaN in a bounded mean, or if the update is given up; the caller checks the results for NaN.

   Scratch: `stewart_kalman_scratch` numbers, and those of the callbacks. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *log_ratio, stewart_scratch scratch);

int stewart_kalman_scratch(int n, int max_rows);

/* R (n, n) <- upper triangular root of R'R + W'W, the sum of two covariances, by the QR decomposition of
   [R; W]. R is upper triangular; W (m, n) is overwritten. */
void stewart_add_root(int n, int m, real *R, real *W);

/* L (n, n) <- root of F L L' F' + diag(std, walk)^2 + [K'K, 0; 0, 0], F = [H; 0 1] with H (12, n), std
   (12), walk (n - 12) and K (k, 12). Scratch: (2 n + k) n numbers. */
void stewart_root_of_prediction(int n, const real *H, const real *std, const real *walk, int k,
                                const real *K, real *L, stewart_scratch scratch);

/* L (n, n) <- root of L L' + diag(0, jump)^2 with jump (n - 12). Scratch: 2 n n + 12 n numbers. */
void stewart_widen_root(int n, const real *jump, real *L, stewart_scratch scratch);

/* Compute the point within bounds that is nearest to `mean` in the metric of the covariance L L'. Returns 0
   for NaN, or if a component without variance is out of bounds.
   Scratch: n + STEWART_MAX_BOUNDED^2 numbers. */
int stewart_within_bounds(int n, const real *mean, const real *L, const real *lower,
                          const real *upper, real *bounded, stewart_scratch scratch);
