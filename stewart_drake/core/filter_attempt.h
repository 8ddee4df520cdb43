/* One attempt of the filter at a period and a measurement, for filter.c and encoder_filter.c. */

#pragma once

#include "filter.h"

/* A period linearised about the prior. */
typedef struct {
    real end[STEWART_STATES], drift[STEWART_STATES];
    real *H; /* (12, n) at the end */
    int exists;
} stewart_linear;

typedef struct {
    const stewart_filter *filter;
    int n;
    const stewart_interval *period;
    const stewart_posterior *prior;
    const real *values; /* or NULL */
    const stewart_history *history;
    stewart_linear *linear;     /* about the prior, for the caller; or NULL */
    stewart_posterior *after;   /* its mean is that of the prior to begin with */
    real end[STEWART_STATES];   /* state at the end of the period */
    real drift[STEWART_STATES]; /* standard deviation of the model's error there */
    const real *last;           /* (12, n) d[end]/d[xi] */
    int partly;                 /* why values were left out */
} stewart_attempt;

/* With `end` and `last` of the prior: fill in `drift` and `linear`. */
void stewart_attempt_predicted(stewart_attempt *attempt);

/* With `end` and `last` of the corrected mean, and its root in `after`: what that is after the period.
   Returns 0 where it is not finite. Scratch: 2 n n + n numbers. */
int stewart_attempt_ended(stewart_attempt *attempt, stewart_scratch scratch);

/* A measurement that has more to it than the state at the sample. */
struct stewart_legs {
    /* Mean and root after a period and values; without values only what is predicted. Returns 0 for an
       outlier, or where there is no finite result. */
    int (*attempt)(stewart_attempt *attempt, stewart_scratch scratch);
    int (*scratch)(const stewart_filter *filter, int torques); /* numbers of that */
    /* B (6, p) <- J^-1 B, J = dh/dq at a state: changes of the pose that show the same as changes B of
       the offsets. Returns 0 where there are none. Scratch: 36 numbers. */
    int (*moved)(const stewart_filter *filter, const real *state, real *B, stewart_scratch scratch);
    int (*start_scratch)(const stewart_filter *filter); /* of `start` of the sensing */
    /* Count in `still` (6) the periods for which the code of each leg has been constant. */
    void (*count_still)(const stewart_sensing *sensing, const real *values, const real *last, real *still);
};
