/* Trajectories of a machine under held torques, and their sensitivities. */

#pragma once

#include "dynamics.h"

#define STEWART_CONSTANTS 16  /* parameters of the dynamics that are unknowns */
#define STEWART_PER_LEG 8     /* crank, rod, plate joint (3), shaft (3): unknowns of a leg */

/* Accelerations (6) of a state, their slopes by it (6, 12), by the constants and, if `legs`, by the numbers
   of the legs, leg by leg (6, 16 + 48 or 16), all by rows. They are NaN where M is singular. */
void stewart_slopes(const stewart_plant *plant, int legs, const double *state, const double *torque,
                    double *accelerations, double *by_state, double *by_numbers);

/* Steps h (number) in s of the classical Runge-Kutta method under `torques` (number, 6), which become
   `after` (number, 6) at the end of the step; `sample` (number): row of `states` that is kept there, or -1.

   S (12, columns) is the derivative of the state by [first state; numbers of `stewart_slopes`; delay],
   exactly that of the steps. A switch, which moves with the delay, adds the accelerations before it less
   those after it. `slopes` has S at the samples; NULL for none. */
void stewart_shoot(const stewart_plant *plant, int legs, long number, const double *h,
                   const double *torques, const double *after, const int *sample, const double *first,
                   double *states, double *slopes);
