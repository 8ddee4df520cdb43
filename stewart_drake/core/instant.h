/* A Kalman update by a measurement at one instant, the end of a period. */

#pragma once

#include "kalman.h"
#include "sensing.h"

/* h(x) (m) of a state (12). */
void stewart_predict_measurement(const stewart_sensing *sensing, const real *state, real *values);

/* dh/dx (m, 12) at a state; not written where the state itself is measured. */
void stewart_measurement_jacobian(const stewart_sensing *sensing, const real *state, real *J);

/* J A' (m, k) of changes A (k, 12) of the state. */
void stewart_apply_jacobian(const stewart_sensing *sensing, const real *J, int k, const real *A,
                          real *seen);

/* C (m, m), lower triangular, with C C' = J (A'A + diag(std)^2) J' + diag(noise)^2 at a state, A (k, 12).
   Returns 0 where it does not exist. Scratch: m (12 + k) numbers. */
int stewart_innovation_root(const stewart_sensing *sensing, const real *state, int k, const real *A,
                      const real *std, real *C, stewart_scratch scratch);

/* B (m, n) <- C^-1 B, C (m, m) lower triangular. */
void stewart_whiten(int m, int n, const real *C, real *B);

/* Measurement at the end of a period that begins in xi (n). */
typedef struct {
    const stewart_sensing *sensing;
    const real *values; /* (m) */
    int n;
    real *state;        /* (12) at the end, from the xi where the period is linearised */
    real *H;            /* (12, n) d[state]/d[xi] there */
    real *C;            /* (m, m) root of the covariance of the noise, the model's error too */
    real *J;            /* (m, 12) */
    void *period;
    /* Write the state at the end, and then H, both from xi. Return 0 where they do not exist. */
    int (*predict)(void *period, const real *xi, real *state);
    int (*linearize)(void *period, const real *xi, real *H, stewart_scratch scratch);
} stewart_instant;

/* `rows` and `settle` of a `stewart_kalman` whose model begins with a `stewart_instant`. A correction is
   small relative to the noise, since the error of linearising is of second order. */
int stewart_instant_rows(void *model, const real *xi, real *e, real *H, stewart_scratch scratch);
int stewart_instant_settle(void *model, const real *xi, const real *better, stewart_scratch scratch);
