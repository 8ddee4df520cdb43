/* Extended Kalman filter over the state and parameters of the plant.

   The parameters theta (p) are constants, or random walks: such a one changes by noise from period to
   period, by nothing within. The state obeys the exact dynamics under the torques that are known to act:

       [x_{k+1}; theta_{k+1}] = [f(x_k, T, theta_k); theta_k] + noise,    y_k = h(x_k) + measurement noise.

   Linearised, F = [[Phi, S], [0, 1]] with Phi = df/dx and S = df/dtheta. One-step prediction errors
   drive the filter: y_k corrects x_{k-1} and theta, and x_k follows by the model. The error of one step
   of the model counts as noise of y_k there, and widens the covariance of x_k. */

#pragma once

#include "instant.h"
#include "noise.h"

#define STEWART_PATIENCE 3 /* outliers in a row, that agree with each other, after which they are believed */

/* An estimate of xi = [x; theta] (n = 12 + p), from measurements (m): views of one vector of
   `stewart_posterior_size` numbers, in this order. */
typedef struct {
    real *mean;     /* (n) */
    real *root;     /* L (n, n), covariance L L'; NaN where nothing is estimated */
    real *outlier;  /* (m) the last outlier, NaN without one */
    real *outliers; /* number in a row, up to the last measurement, that agree with each other */
    real *unseen;   /* periods since a measurement was last used */
    real *left_out;   /* reasons for left-out values of that measurement, bits as of a `fault` */
    real *squares;  /* sum of nu' S^-1 nu of all measurements that were used, see stewart_kalman_update */
    real *values;   /* number of values in them */
    stewart_noise *noise; /* factors of the assumed noise */
} stewart_posterior;

int stewart_posterior_size(int n, int m);
stewart_posterior stewart_posterior_at(real *numbers, int n, int m);

/* Legs at several instants of a period, see filter_attempt.h. */
typedef struct stewart_legs stewart_legs;

/* What the filter assumes; standard deviations in SI units. */
typedef struct {
    const stewart_machine *machine; /* its p estimated parameters are theta */
    const stewart_sensing *sensing;
    const stewart_legs *legs; /* how that sensing, of encoders, is read within a period; or NULL, for a
                                 measurement of the sample alone */
    int offsets;            /* first of theta that are offsets of six encoders, or -1 for none */
    real gate;              /* nu' S^-1 nu of m values from which on they are an outlier */
    real timing_std;        /* s by which a torque may come early or late, at first */
    int learns_timing;      /* whether innovations correct that */
    const real *model_std;  /* (12) by which one step of the model may be off */
    const real *prior_root; /* (p, p) */
    const real *usual_std;  /* (p) before anything is known but the machine's drawing */
    const real *walk_std;   /* (p) by which a parameter changes in a period; 0 for a constant */
    const real *jump_std;   /* (p) by which one may change at once; 0 for a constant; NULL for none */
    const real *wander_std; /* (p) assumed change of one in a period, where innovations ask for it */
    real keep;              /* share of what is known of the noise that is kept in a period */
    const real *lower;      /* (n), infinite for the state */
    const real *upper;
} stewart_filter;

/* Torques between two samples, under the assumed delay. */
typedef struct {
    stewart_schedule schedule; /* with its substeps */
    const real *following; /* (6) N m, the next torque */
} stewart_interval;

/* State of a sensor before a measurement, for encoders. */
typedef struct {
    const real *last;  /* (m) the values before, NaN for nothing */
    const real *still; /* (6) periods of each leg without a change of code, with this one */
} stewart_history;

/* Estimate from values (m) alone, with first parameters theta (p); `near` (12) or NULL as of `start` of
   the sensing. Returns 0 if they do not determine a state; the estimate then stays. */
int stewart_filter_start(const stewart_filter *filter, const real *values, const real *theta,
                         const real *near, real *estimate, stewart_scratch scratch);

/* One period, then values (m) at its end, or NULL for none.

   The first steps move the parameters far: linearising once is not enough. The mean xi of [previous
   state; parameters] is found by Gauss-Newton iterations of

       min (xi - mean)' P^-1 (xi - mean) + (y - h(f(xi)))' R^-1 (y - h(f(xi))),

   the iterated filter over one transition; one iteration is the extended Kalman filter.

   If a measurement or one of its legs does not fit, parameters that walk may have jumped: the update is
   repeated with their variances widened by jump_std^2, then, unless a single leg does not fit, by 10 and
   100 times jump_std. For a sensor of the state, the update is then repeated with a torque that came
   far too early or late, and with all parameters changed by a growing share of `usual_std`; the likelier
   of the two counts. A measurement that does not fit then either (an outlier, or diverging iterations)
   is left out, and the model predicts. If the plate was moved by hand, the outliers agree with each
   other under the model: after three of them, or where the model has no finite prediction, the estimate starts again from the
   measurement. So it does with the first measurement after three or more periods without any, if the
   parameters are uncertain: linearised along a guessed path, the covariance is wrong. */
void stewart_filter_advance(const stewart_filter *filter, const stewart_interval *period,
                            const real *values, const stewart_history *history, real *estimate,
                            stewart_scratch scratch);

/* Numbers of scratch memory for both, with `torques` in a period at the most. */
int stewart_filter_scratch(const stewart_filter *filter, int torques);
