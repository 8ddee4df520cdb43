/* Extended Kalman filter over the state and parameters of the plant.

   Each of the parameters theta (p) is a constant or a random walk, which steps between periods and is
   constant within one. The state obeys the exact dynamics under the torques that are known to act:

       [x_{k+1}; theta_{k+1}] = [f(x_k, T, theta_k); theta_k] + noise,    y_k = h(x_k) + measurement noise.

   Linearised, F = [[Phi, S], [0, 1]] with Phi = df/dx and S = df/dtheta. y_k corrects x_{k-1} and theta,
   and x_k follows by the model. The error of one step of the model counts as noise of y_k in that
   correction, and widens the covariance of x_k. */

#pragma once

#include "measurement.h"
#include "noise.h"
#include "observer.h"

#define STEWART_PATIENCE 3 /* consecutive outliers that agree with each other and restart the estimate */
#define STEWART_MAX_JUMP ((real)100) /* largest factor on the `jump_std` of parameters that is tried */
/* Largest e^2 / S of a leg at a node that is used. Noise exceeds it with probability 4.3e-8, so that one of the
   18 values of three nodes does with 8e-7. It is for one value; `gate` is for all m at once. */
#define STEWART_LEG_GATE 30

/* What is known of an estimate besides its distribution. */
typedef struct {
    real outliers;    /* consecutive ones that agree with each other, up to the last measurement */
    real age;         /* periods since a measurement was last used */
    real left_out;    /* causes of left-out values of that measurement, bits as of a `fault` */
    real chi2;        /* sum of nu' S^-1 nu of all measurements that were used */
    real chi2_values; /* number of values in them */
    real disagreed;   /* outliers since a measurement was last used that disagree with the one before */
    real low[STEWART_STATES]; /* as of `stewart_accumulate`, of the state */
    stewart_noise noise; /* factors of the assumed noise */
} stewart_record;

/* An estimate of xi = [x; theta] (n = 12 + p), from measurements (m): views of one vector of
   `stewart_posterior_size` numbers, in this order. */
typedef struct {
    real *mean;     /* (n) */
    real *root;     /* L (n, n), covariance L L'; NaN where nothing is estimated */
    real *outlier;  /* (m) the last outlier, NaN without one */
    stewart_record *record;
} stewart_posterior;

int stewart_posterior_size(int n, int m);
stewart_posterior stewart_posterior_at(real *numbers, int n, int m);

/* Filter step for encoders, which are read at several times of a period: see filter_attempt.h. */
typedef struct stewart_encoder_step stewart_encoder_step;

/* Assumptions of the filter; standard deviations in SI units. */
typedef struct {
    const stewart_machine *machine; /* its p estimated parameters are theta */
    const stewart_sensing *sensing;
    const stewart_encoder_step *encoder_step; /* of encoders; NULL for a measurement of the sample alone */
    int offsets;            /* place in theta of the first of six encoders' offsets; -1 for none */
    real gate;              /* largest nu' S^-1 nu of m values that are not an outlier; for one in a million, 38.26 for
                               m = 6; `encoder_step` tests single values instead */
    real timing_std;        /* s, of the timing of a torque, before innovations correct it */
    int learns_timing;      /* whether innovations correct it */
    const real *model_std;  /* (12) error of one step of the model */
    const real *prior_root; /* (p, p) */
    const real *usual_std;  /* (p) prior from the machine's drawing alone */
    const real *walk_std;   /* (p) change of a parameter in a period; 0 for a constant */
    const real *jump_std;   /* (p) sudden change of a parameter; 0 for a constant; NULL for none */
    const real *wander_std; /* (p) assumed change in a period, if innovations show one (noise.h) */
    real forgetting;        /* factor on the information about the noise, per period dt: exp(-dt / 5 s) */
    const real *lower;      /* (n), infinite for the state */
    const real *upper;
} stewart_filter;

/* Codes of encoders before a measurement. */
typedef struct {
    const real *last;  /* (m) the last measurement, NaN without one */
    const real *unchanged; /* (6) periods for which each leg's code is constant, this one included */
} stewart_history;

/* Start an estimate from values (m) alone, with initial parameters theta (p). `near` (12) or NULL is
   passed to `start` of the sensing. Returns 0 and keeps the estimate if the values determine no state. */
int stewart_filter_start(const stewart_filter *filter, const real *values, const real *theta,
                         const real *near, real *estimate, stewart_scratch scratch);

/* Advance by one period, and correct by values (m) at its end unless NULL.

   The first measurements move the parameters far, so linearising once is not enough. The mean xi of
   [previous state; parameters] is found by Gauss-Newton iterations of

       min (xi - mean)' P^-1 (xi - mean) + (y - h(f(xi)))' R^-1 (y - h(f(xi))),

   the iterated filter over one transition; one iteration is the extended Kalman filter.

   If a measurement or one of its legs does not fit, these explanations are tried in turn:

   1. A parameter that walks has jumped. The update is repeated with jump_std^2 added to its variance,
      and, unless a single leg does not fit, with 10 and 100 times jump_std.
   2. For a sensor of the state: a torque came far too early or late, or all parameters have changed by a
      factor on `usual_std`, the least that explains the values. The likelier of the two counts.

   A measurement that nothing explains is an outlier: it is left out, and the model predicts.

   If the plate was moved by hand, consecutive outliers agree with each other under the model. If it was
   pushed by more than the prior explains, they do not: each outlier that disagrees with the one before
   allows the parameters three usual deviations more of change. The estimate starts again from the
   measurement after STEWART_PATIENCE outliers that agree, or where the model has no finite prediction. It
   also does so at the first measurement after as many periods without one, if the parameters are
   uncertain: the covariance, linearised along a guessed path, is then wrong. */
void stewart_filter_advance(const stewart_filter *filter, const stewart_interval *period,
                            const real *values, const stewart_history *history, real *estimate,
                            stewart_scratch scratch);

/* Numbers of scratch memory for both, with at most `torques` in a period. */
int stewart_filter_scratch(const stewart_filter *filter, int torques);

/* Settings of the observers with this filter, for a known delay, at `law->estimation`. In `filter`, leave
   machine, sensing and encoder_step unset: the observer fills them in from the law. */
typedef struct {
    stewart_filter filter;
    const real *prior; /* (p) initial estimate of the parameters */
} stewart_filter_settings;

extern const stewart_observer stewart_filter_observer; /* of the measured state, or of encoders */
extern const stewart_observer stewart_gap_observer;    /* of the state, re-linearised over gaps */

extern const stewart_encoder_step stewart_encoder_filter_step; /* filter step with encoders, see filter_attempt.h */
stewart_sensing stewart_encoder_filter_sensing(const void *sensor); /* with that step; `stewart_encoders` */
