/* Noise of the model, learnt from the innovations of a filter.

   The covariance of an innovation nu (m) is

       S = S_0 + t sum_c k_c k_c' + w W,

   k_c is the effect of a change of torque whose timing is off by the assumed standard deviation. W is the
   covariance due to the assumed change of the parameters in one period. S_0 is the rest. The factors
   t >= 0 and w >= 0 are unknown. With S diagonal the log-density has the slopes g and the information I

       g_t = 1/2 sum_c (a_c^2 - b_c r),              I_t = 1/2 sum_c b_c^2,
       g_w = 1/2 sum_i W_ii (nu_i^2 - S_ii) / S_ii^2,   I_w = 1/2 sum_i W_ii^2 / S_ii^2,

   with a_c = k_c' S^-1 nu and b_c = k_c' S^-1 k_c. Fisher scoring is t <- t + g / J, with J the sum of the
   information; J is multiplied by `forgetting` each period. r is the mean square of the innovation across
   all k_c, but at least 1: where the model is wrong in every direction, the timing is not the cause. In
   the slope of w, nu_i^2 / S_ii - 1 is at most MOST_EXCESS, so that a few values do not decide. A delay
   that is off by the same time for all torques raises t, too. The mean l of that time, in assumed standard
   deviations, has the slope sum_c (a_c - b_c l) / r and the information sum_c b_c / r.

   Initially t = 1 with the information of one torque, and w = 0: parameters are constant. The covariance is
   widened only by the excess of w over SIGNIFICANT standard deviations J^-1/2: friction, a payload off the
   centre or a push widens it, chance does not. An unmodelled effect lasts for many periods, while W is the
   change in one, so the factor in use is WIDER times this excess. It decays with half the rate of J. */

#pragma once

#include "machine.h"

typedef struct {
    real timing, wander;                         /* t, w */
    real timing_information, wander_information; /* J of t and w */
    real wander_in_use;                          /* factor on W that the filter uses */
    real lateness, lateness_information;         /* l, and J of it */
    real changed_values; /* number of values while w was significant, or t above CHANGED_T */
} stewart_noise;

void stewart_noise_start(stewart_noise *noise);

/* Return t less l^2, where |l| counts from LATENESS_SIGNIFICANT standard deviations on. */
real stewart_timing_scatter(const stewart_noise *noise);

/* Update the factors by values (m) with innovations nu and variances S. H (m, 12 + p) is the derivative of
   the values by state and parameters a period before, `effects` (m, changes) the effects k_c of torques on
   them, and `wander` (p) the standard deviations of the parameters' changes at w = 1; both may be 0. */
void stewart_noise_learn(int m, const real *innovations, const real *variances, int p, const real *H,
                         const real *wander, int changes, const real *effects, real forgetting,
                         stewart_noise *noise);

/* Return the number of changes of torque in a period, with those at both of its samples. */
int stewart_changes(const stewart_interval *period);

/* Compute effects (changes, 12): change of the state at the period's end, per second that a torque is late.
   To first order the acceleration differs by B dT for that time: this stays in the rates, and moves the
   pose for the rest of the period. A torque that changes at a sample acts in the period after it if it is
   late and in the one before if it is early: each has half the variance. */
void stewart_timing_effects(const stewart_machine *machine, const stewart_interval *period,
                            const real *state, const real *theta, real *effects);
