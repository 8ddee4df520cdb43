/* Noise of the model, learnt from the innovations of a filter.

   The covariance of an innovation nu (m) is

       S = S_0 + t K + w W,

   K of torques that act early or late by the assumed standard deviation, W of parameters that wander by
   their assumed change in a period, S_0 the rest. The factors t >= 0 and w >= 0 are not known. With the
   density of single values, -1/2 (nu_i^2 / S_ii + ln S_ii), slope and information are

       g = 1/2 sum_i d_i (nu_i^2 - S_ii) / S_ii^2,   I = 1/2 sum_i d_i^2 / S_ii^2,   d_i = K_ii or W_ii,

   and Fisher scoring is t <- t + g / J with the sum J of the information, which forgets within the
   memory of the filter. Torques begin with t = 1, and with the information of one torque. Parameters
   begin as constants, w = 0. They wander only where w exceeds SURE standard deviations J^-1/2: friction,
   a payload off the centre or a push then widens the stated uncertainty, and chance does not. An error
   that the model lacks lasts for many periods, while W is of one, so that WIDER times this w is used. It
   decays slowly, with half the rate of J. */

#pragma once

#include "machine.h"

enum { STEWART_NOISE = 6 }; /* numbers of these */

typedef struct {
    real timing, wander;              /* t, w */
    real known_timing, known_wander;  /* J of both */
    real used;                        /* factor of W in use */
    real asked;                       /* number of values at which w exceeded SURE deviations, or t UNTIMELY */
} stewart_noise;

void stewart_noise_start(stewart_noise *noise);

/* Values (m) with innovations nu, variances S, H (m, 12) the derivative of the values by the state, and
   G (12, 12 + p) the derivative of the state by state and parameters a period before. `timing` (12) are
   the variances of the state at t = 1, `wander` (p) the standard deviations of the parameters at w = 1;
   both may be 0. `keep` is the share of J that is kept in a period. */
void stewart_noise_learn(int m, const real *innovations, const real *variances, const real *H,
                         const real *timing, int p, const real *G, const real *wander, real keep,
                         stewart_noise *noise);

/* Sum over the changes of torque in a period, the last to `following`, of the squared changes (12) of the last state, per s that the change
   comes early. To first order the acceleration differs by B dT for that time; this stays in the rates
   and moves the pose for the rest of the period. */
void stewart_kicks(const stewart_machine *machine, const stewart_schedule *schedule, const real *following,
                   const real *state, const real *theta, real *squares);
