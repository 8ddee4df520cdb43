/* Extended Kalman filter over the state and constant parameters of the plant.

   The parameters theta (p) never change, the state obeys the exact dynamics under the torques that are
   known to act:

       [x_{k+1}; theta] = [f(x_k, T, theta); theta] + noise,    y_k = h(x_k) + measurement noise.

   Linearised, F = [[Phi, S], [0, 1]] with Phi = df/dx and S = df/dtheta. One-step prediction errors
   drive the filter: y_k corrects x_{k-1} and theta, and x_k follows by the model. The error of one step
   of the model counts as noise of y_k there, and widens the covariance of x_k. */

#pragma once

#include "instant.h"

#define STEWART_PATIENCE 3 /* outliers in a row, that agree with each other, after which they are believed */

/* An estimate of xi = [x; theta] (n = 12 + p), from measurements (m): views of one vector of
   `stewart_posterior_size` numbers, in this order. */
typedef struct {
    real *mean;     /* (n) */
    real *root;     /* L (n, n), covariance L L'; NaN where nothing is estimated */
    real *outlier;  /* (m) the last outlier, NaN without one */
    real *outliers; /* how many in a row, up to the last measurement, agree with each other */
    real *unseen;   /* periods since a measurement was last used */
    real *partly;   /* why values of that were left out, bits as of `stewart_state_fault` */
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
    real timing_std;        /* s by which a torque may come early or late */
    const real *model_std;  /* (12) by which one step of the model may be off */
    const real *prior_root; /* (p, p) */
    const real *usual_std;  /* (p) before anything is known but the machine's drawing */
    const real *lower;      /* (n), infinite for the state */
    const real *upper;
} stewart_filter;

/* What acted between two samples, as far as the delay is what it is believed to be. */
typedef struct {
    stewart_schedule schedule; /* with its substeps */
    const real *following; /* (6) N m, acts next */
} stewart_interval;

/* What was known of a sensor before a measurement; encoders look at it. */
typedef struct {
    const real *last;  /* (m) the values before, NaN for nothing */
    const real *still; /* (6) periods of each leg without a change of code, with this one */
} stewart_history;

/* The estimate from values (m) alone, with parameters theta (p) for a guess; `near` (12) or NULL as of
   `start` of the sensing. Returns 0 where they fix no state; the estimate then stays. */
int stewart_filter_start(const stewart_filter *filter, const real *values, const real *theta,
                         const real *near, real *estimate, stewart_scratch scratch);

/* One period, then values (m) at its end, or NULL for none.

   The first steps move the parameters far: linearising once is not enough. The mean xi of [previous
   state; parameters] is found by Gauss-Newton iterations of

       min (xi - mean)' P^-1 (xi - mean) + (y - h(f(xi)))' R^-1 (y - h(f(xi))),

   the iterated filter over one transition; one iteration is the extended Kalman filter.

   A measurement that does not fit (an outlier, iterations that diverge) is left out, and the model
   goes on alone. The plate may have been moved by hand, though: outliers that follow from one another
   by the model show a plate, not a broken sensor, and after three of them, or where the model cannot
   go on, the measurement is believed. So is the first one that fits after three or more periods
   without any, if little of the parameters was known by then: linearised along a way that is only
   guessed, the covariance means nothing. */
void stewart_filter_advance(const stewart_filter *filter, const stewart_interval *period,
                            const real *values, const stewart_history *history, real *estimate,
                            stewart_scratch scratch);

/* Numbers that both take at the most, for periods of so many torques. */
int stewart_filter_scratch(const stewart_filter *filter, int torques);

/* Changes (12) of the last state per s by which one of the changes of torque comes early, their squares
   summed. To first order: for that time the acceleration differs by B dT, which stays in the rates, and
   moves the pose for what is left of the period. */
void stewart_kicks(const stewart_machine *machine, const stewart_interval *period, const real *state,
                   const real *theta, real *squares);
