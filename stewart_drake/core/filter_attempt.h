/* An attempt: a prior advanced by a period and corrected by its measurement. filter.c makes several, with
   other priors, where the measurement does not fit. */

#pragma once

#include "filter.h"

typedef struct {
    const stewart_filter *filter;
    int n; /* 12 + p */
    const stewart_interval *period;
    const stewart_posterior *prior;
    const real *values; /* measurement (m), or NULL to predict only */
    const stewart_history *history;
    stewart_posterior *after;      /* result; its mean begins as that of the prior */
    real end[2 * STEWART_STATES];  /* state at the end of the period, and `low` of it */
    const real *transition;        /* (12, n) d[state at the end]/d[xi] */

    /* Errors of the model over the period, as standard deviations of the state there. The timing of torques has
       the covariance t sum_c k_c k_c' of noise.h. A part of it is in `end_std`, as if uncorrelated. */
    int changes;                  /* number of k_c */
    real *effects;                /* (changes, 12) k_c at t = 1 */
    real timing_factor;           /* t, without the part in `end_std` */
    real *timing_root;            /* (changes, 12) k_c times the root of `timing_factor` */
    real end_std[STEWART_STATES]; /* all other errors */

    real distance, max_distance; /* as of `stewart_kalman` */
    real log_likelihood; /* log-density of the values, but for a constant; -infinity before it is known */
    int left_out;      /* causes of left-out values, bits as of a `fault` */
    int gated_legs;    /* number of legs with a value beyond their gate */
    real *cache; /* last prediction from a prior: 1 if F was of fourth order, 0 if not, NaN for none; then
                    the prior's mean, `end`, F (12, n) */
} stewart_attempt;

/* Compute the errors of the model from the state there, as the prior predicts it. */
void stewart_attempt_noise(stewart_attempt *attempt);

/* Update the noise in `after` by whitened innovations (m) and their variances. H (m, n) is the derivative
   of the values, `effects` (m, changes) is the effect of the torques' timing on them. */
void stewart_attempt_learn(const stewart_attempt *attempt, int m, const real *innovations,
                           const real *variances, const real *H, const real *effects);

/* Move `after` to the end of the period, by `end` and `transition` at its mean. Without values its root
   is that of the prior first. Returns 0 if a result is not finite. Scratch: (2 n + changes) n + n numbers. */
int stewart_attempt_finish(stewart_attempt *attempt, stewart_scratch scratch);

/* Filter step for encoders, whose readings depend on the motion within the period. */
struct stewart_encoder_step {
    /* Compute mean and root after a period and values, if there are any. Returns 0 for an outlier, or
       without a finite result. */
    int (*attempt)(stewart_attempt *attempt, stewart_scratch scratch);
    /* Numbers of scratch memory for `attempt` with `torques` in a period; they suffice for a start, too. */
    int (*scratch)(const stewart_filter *filter, int torques);
    /* B (6, p) <- J^-1 B with J = dh/dq at a state: turn changes of the angles into changes of the pose.
       Returns 0 for a singular J. Scratch: 36 numbers. */
    int (*pose_changes)(const stewart_filter *filter, const real *state, real *B, stewart_scratch scratch);
    /* Count in `unchanged` (6) the periods for which the code of each leg has been constant. */
    void (*count_unchanged)(const stewart_sensing *sensing, const real *values, const real *last,
                        real *unchanged);
};
