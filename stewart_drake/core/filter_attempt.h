/* One attempt of the filter at a period and a measurement, for filter.c and encoder_filter.c. */

#pragma once

#include "filter.h"

typedef struct {
    const stewart_filter *filter;
    int n; /* 12 + p */
    const stewart_interval *period;
    const stewart_posterior *prior;
    const real *values; /* or NULL */
    const stewart_history *history;
    stewart_posterior *after;   /* result; its mean begins as that of the prior */
    real end[STEWART_STATES];   /* state at the end of the period */
    real drift[STEWART_STATES]; /* standard deviation of the model's other errors there */
    int changes;        /* of torque, see noise.h */
    real *kicks, *late; /* (changes, 12) effect on `end` of the torques' timing at t = 1, and now: */
    real along;         /* variance of the latter over the former, but for that in `drift` */
    real distance;              /* of the last innovation, as of `stewart_kalman` */
    real likelihood;            /* log of the density of the values, without a constant; -inf without one */
    const real *last;           /* (12, n) d[end]/d[xi] */
    real *kept; /* of the last prediction from a prior: 1 if F was of fourth order, 0 if not, NaN for none;
                   the prior's mean, the state at the end, H */
    real hopeless;              /* `max_distance` of `stewart_kalman` */
    int left_out;               /* why values were left out, bits as of a `fault` */
    int gated;                  /* number of legs with a value that does not fit */
} stewart_attempt;

/* Fill in `kicks`, `late`, `along` and `drift` from `end` of the prior. */
void stewart_attempt_predicted(stewart_attempt *attempt);

/* Learn the noise in `after` from whitened innovations (m) with their variances, H (m, n) and the effects
   of torques on the values, `kicks` (m, changes). */
void stewart_attempt_learn(const stewart_attempt *attempt, int m, const real *innovations,
                           const real *variances, const real *H, const real *kicks);

/* Predict mean and root in `after` over the period, with `end` and `last` of that mean; without values
   the root is that of the prior. Returns 0 if a result is not finite. Scratch: (2 n + changes) n + n numbers. */
int stewart_attempt_ended(stewart_attempt *attempt, stewart_scratch scratch);

/* Measurement by encoders, whose readings depend on the motion within the period. */
struct stewart_legs {
    /* Compute mean and root after a period and values, if there are any. Returns 0 for an outlier, or
       without a finite result. */
    int (*attempt)(stewart_attempt *attempt, stewart_scratch scratch);
    int (*scratch)(const stewart_filter *filter, int torques); /* numbers for `attempt`, more than a start */
    /* B (6, p) <- J^-1 B with J = dh/dq at a state: from changes of the angles to the changes of the pose
       that cause them. Returns 0 for a singular J. Scratch: 36 numbers. */
    int (*moved)(const stewart_filter *filter, const real *state, real *B, stewart_scratch scratch);
    /* Count in `still` (6) the periods for which the code of each leg has been constant. */
    void (*count_still)(const stewart_sensing *sensing, const real *values, const real *last,
                        real *still);
};
