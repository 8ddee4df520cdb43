/* What the examples know of the scenario beside the controller: its motion, its start, its limits. */

#ifndef STEWART_MOTION_H
#define STEWART_MOTION_H

#include "protocol.h"
#include "stewart.h"

extern const double stewart_duration;                /* s */
extern const real stewart_weights[2];                /* of errors and of torques */
extern const real stewart_start[STEWART_STATES];     /* of the plate */
extern const real stewart_least[STEWART_MEASURES];   /* what the measures of the workspace must be above */
extern const real stewart_home_sign;                 /* of the measure of parallel singularity */
extern const int stewart_rows;                       /* torques in `stewart_queue` */

/* What both sides must agree on, of the scenario. */
extern const stewart_identity stewart_own_identity;
/* The words of each fault, with a place for the leg or the duration in s. */
extern const char *const stewart_faults[STEWART_FAULTS];

/* The reference at t: pose, rates, accelerations. Before 0 it is that at 0, and for NaN too. */
void stewart_reference(double t, real *reference);

#endif
