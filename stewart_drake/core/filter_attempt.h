/* One attempt of the filter at a period and a measurement, for filter.c and encoder_filter.c. */

#pragma once

#include "filter.h"

typedef struct {
    const stewart_filter *filter;
    int n;
    const stewart_interval *period;
    const stewart_posterior *prior;
    const real *values; /* or NULL */
    const stewart_history *history;
    stewart_posterior *after;   /* its mean is that of the prior to begin with */
    real end[STEWART_STATES];   /* state at the end of the period */
    real drift[STEWART_STATES]; /* standard deviation of the model's error there */
    real kicks[STEWART_STATES]; /* its variance by the timing, as assumed at first */
    real likelihood;            /* log of the density of the values, without a constant */
    const real *last;           /* (12, n) d[end]/d[xi] */
    int left_out;                 /* why values were left out */
    int gated;                    /* legs with a value that does not fit */
} stewart_attempt;

/* Fill in `drift` from `end` of the prior. */
void stewart_attempt_predicted(stewart_attempt *attempt);

/* Predict mean and root in `after` over the period, with `end` and `last` of that mean; without values
   the root is that of the prior. Returns 0 if a result is not finite. Scratch: 2 n n + n numbers. */
int stewart_attempt_ended(stewart_attempt *attempt, stewart_scratch scratch);

/* A measurement that has more to it than the state at the sample. */
struct stewart_legs {
    /* Compute mean and root after a period and values, if there are any. Returns 0 for an outlier, or
       without a finite result. */
    int (*attempt)(stewart_attempt *attempt, stewart_scratch scratch);
    int (*scratch)(const stewart_filter *filter, int torques); /* numbers of that */
    /* B (6, p) <- J^-1 B, J = dh/dq at a state: changes of the pose that change the angles as changes B
       of the offsets do. Returns 0 for a singular J. Scratch: 36 numbers. */
    int (*moved)(const stewart_filter *filter, const real *state, real *B, stewart_scratch scratch);
    int (*start_scratch)(const stewart_filter *filter); /* of `start` of the sensing */
    /* Count in `still` (6) the periods for which the code of each leg has been constant. */
    void (*count_still)(const stewart_sensing *sensing, const real *values, const real *last, real *still);
};
