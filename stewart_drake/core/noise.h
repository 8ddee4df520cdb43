/* Noise of the model, learnt from the innovations of a filter.

   The covariance of an innovation nu (m) is

       S = S_0 + t K + w W,

   t K is due to torques that act early or late: K holds for the assumed standard deviation of their
   timing. w W is due to parameters that wander: W holds for their assumed change in a period. S_0 is the
   rest. The factors t >= 0 and w >= 0 are unknown. The log-density of single values,
   -1/2 (nu_i^2 / S_ii + ln S_ii), has the slope and the information

       g = 1/2 sum_i d_i (nu_i^2 - S_ii) / S_ii^2,   I = 1/2 sum_i d_i^2 / S_ii^2,   d_i = K_ii or W_ii,

   and Fisher scoring is t <- t + g / J, with J the sum of the information; each period keeps the share
   `keep` of J. In the slope of w, nu_i^2 / S_ii - 1 is at most ODD, so that a few values do not
   decide.

   Torques begin with t = 1, and with the information of one torque. Parameters begin as constants,
   w = 0. The covariance is widened only by the excess of w over SURE standard deviations J^-1/2:
   friction, a payload off the centre or a push widens it, and chance does not. An unmodelled effect
   lasts for many periods, while W is the change in one, so the factor in use is WIDER times this
   excess. It decays slowly, with half the rate of J. */

#pragma once

#include "machine.h"

enum { STEWART_NOISE = 6 }; /* numbers in a stewart_noise */

typedef struct {
    real timing, wander;              /* t, w */
    real known_timing, known_wander;  /* J of both */
    real used;                        /* factor of W in use */
    real asked;                       /* values at which w exceeded SURE deviations, or t UNTIMELY */
} stewart_noise;

void stewart_noise_start(stewart_noise *noise);

/* Update the factors by values (m) with innovations nu and variances S. H (m, 12) is the derivative of
   the values by the state, and G (12, 12 + p) that of the state by state and parameters a period before.
   `timing` (12) are the variances of the state at t = 1, `wander` (p) the standard deviations of the
   parameters at w = 1; both may be 0. `keep` is the share of J that is kept in a period. */
void stewart_noise_learn(int m, const real *innovations, const real *variances, const real *H,
                         const real *timing, int p, const real *G, const real *wander, real keep,
                         stewart_noise *noise);

/* squares (12) <- squared changes of the state at a period's end, per second that a torque comes early,
   summed over the changes of torque in the period. The last change is to `following`, at the end. To
   first order the acceleration differs by B dT for that time: this stays in the rates, and moves the
   pose for the rest of the period. */
void stewart_kicks(const stewart_machine *machine, const stewart_schedule *schedule, const real *following,
                   const real *state, const real *theta, real *squares);
