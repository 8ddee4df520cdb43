/* Model of a measurement at the end of a period, for a Kalman update of the period's beginning. */

#pragma once

#include "kalman.h"
#include "sensing.h"

/* Compute h(x) (m) of a state (12); m = sensing->size here and below. */
void stewart_predict_measurement(const stewart_sensing *sensing, const real *state, real *predicted);

/* Compute J (m, 12) = dh/dx at a state; not written if the state itself is measured. */
void stewart_measurement_jacobian(const stewart_sensing *sensing, const real *state, real *J);

/* Compute J A' (m, k): changes of the values for changes A (k, 12) of the state. */
void stewart_apply_jacobian(const stewart_sensing *sensing, const real *J, int k, const real *A,
                            real *JA);

/* Part of the variance due to the torques' timing that counts as uncorrelated noise of the state. */
#define STEWART_UNCORRELATED ((real)0.01)

/* Compute C (m, m), lower triangular, with C C' = J (A'A + diag(std)^2) J' + diag(noise)^2 at a state; A is
   (k, 12). Returns 0 where C does not exist. Scratch: m (12 + k) numbers. */
int stewart_innovation_root(const stewart_sensing *sensing, const real *state, int k, const real *A,
                            const real *std, real *C, stewart_scratch scratch);

/* B (m, n) <- C^-1 B, with C (m, m) lower triangular. */
void stewart_whiten(int m, int n, const real *C, real *B);

/* Measurement at the end of a period that begins in xi (n). */
typedef struct {
    const stewart_sensing *sensing;
    const real *values; /* (m) */
    int n;
    real *state;        /* (12) at the period's end, for the current xi */
    real *low;          /* (12) as of `stewart_accumulate`, of `state`; or NULL */
    real *H;            /* (12, n) d[state]/d[xi] there */
    real *C;            /* (m, m) Cholesky factor of the covariance of measurement noise plus model error */
    real *J;            /* (m, 12) dh/dx at `state` */
    void *context;      /* first argument of the two callbacks */
    /* Compute the state at the period's end; then H for the same xi. Return 0 where they do not exist. */
    int (*predict)(void *context, const real *xi, real *state);
    int (*linearize)(void *context, const real *xi, real *H, stewart_scratch scratch);
} stewart_measurement;

/* Compute H (m, n) = C^-1 d[values]/d[xi] of the last linearisation. */
void stewart_whitened_derivative(const stewart_measurement *a, real *H);

/* Callbacks of a `stewart_kalman` whose `context` has a `stewart_measurement` as its first member. Iteration
   ends at a correction below 0.1 standard deviations: the linearisation error, of second order, is then
   negligible. */
int stewart_measurement_residuals(void *context, const real *xi, real *e, real *H, stewart_scratch scratch);
int stewart_measurement_relinearize(void *context, const real *change, const real *updated,
                                    stewart_scratch scratch);
