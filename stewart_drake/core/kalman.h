/* One Kalman update in square-root form, iterated, for every filter of the law. */

#pragma once

#include "matrix.h"

#define STEWART_MAX_JUMP ((real)100) /* largest factor on the `jump_std` of parameters that is tried */
#define STEWART_MAX_BOUNDED 21       /* components that may be at a bound at a time */

/* Prior N(mean, L L') of xi (n), and the model of a measurement.

   `residuals` computes e = y - h(xi) (m) and H = dh/dxi (m, n), both whitened: with noise of covariance
   R = C C' they are C^-1 e and C^-1 H. Values that are left out have no row. Returns m, at most
   `max_rows`, or -1 if xi has no prediction.

   `step` ends an iteration, which led from `xi` to `better`. It linearises at `better`, unless the
   correction is small. Returns 1 for a small correction, which ends the iterations, 0 for another one,
   or -1 if `better` has no prediction. */
typedef struct {
    int n, max_rows;
    int iterations;            /* at the most */
    const real *mean, *root;   /* prior: (n), L (n, n) */
    const real *lower, *upper; /* (n), infinite without a bound */
    void *model;
    int (*residuals)(void *model, const real *xi, real *e, real *H, stewart_scratch scratch);
    int (*step)(void *model, const real *xi, const real *better, stewart_scratch scratch);
    real max_distance; /* the update is given up if the first iteration's `distance` is larger; 0: never */
    real *innovations; /* (max_rows) result nu, whitened; or NULL */
    real *variances;   /* (max_rows) result, diagonal of S, whitened; or NULL */
} stewart_kalman;

/* Compute the updated mean xi (n), which holds a first guess before, and the root (n, n) of its covariance.
   `root` must be other memory than that of the prior. `distance` is nu' S^-1 nu of the last innovation
   nu = e + H (xi - mean), with S = H P H' + R, and `log_ratio` is ln |S| - ln |R|. Returns 0 if there is no
   prediction, for NaN in a bounded mean, or if it is given up; the caller checks all other numbers.

   Scratch: `stewart_kalman_scratch` numbers, and what the model takes. */
int stewart_kalman_update(const stewart_kalman *filter, real *xi, real *root, real *distance,
                          real *log_ratio, stewart_scratch scratch);

int stewart_kalman_scratch(int n, int max_rows);

/* R (n, n) <- root of R'R + W'W, the sum of two covariances, by the QR decomposition of [R; W]. R is upper
   triangular; W (m, n) is overwritten. */
void stewart_add_root(int n, int m, real *R, real *W);

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
