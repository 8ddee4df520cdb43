/* Data of the scenario for the examples over UDP: start, limits, motion. */

#pragma once

#include "protocol.h"
#include "stewart_motion.h"

extern const uint64_t stewart_period;                  /* ns; exact, also where `real` is float */
extern const real stewart_weights[2];                  /* of errors and of torques */
extern const real stewart_first_state[STEWART_STATES]; /* of the plate */
extern const real stewart_least[STEWART_NUM_MEASURES];     /* lower limits of the workspace measures */
extern const real stewart_home_sign;                   /* of the measure of parallel singularity */

/* Identity that both sides must agree on. */
extern const stewart_identity stewart_own_identity;
/* The words of each fault, with a place for the leg or the duration in s. */
extern const char *const stewart_faults[STEWART_FAULTS];
