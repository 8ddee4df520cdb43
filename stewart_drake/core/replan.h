/* The way back onto the reference, planned in flight.

   When the prediction is far off the reference, for example after the delay was found or has jumped,
   feedback of a large error through a long delay responds badly. From the instant at which the next
   torque acts, a plan leads back onto the reference. The law follows the predicted motion, then the
   plan, then the reference: the error is zero, and the integral starts again. */

#pragma once

#include "law.h"
#include "planning.h"

typedef struct {
    int periods;  /* of a plan, two at least */
    int until;    /* torques that act until the next one does, at the most */
    real size[6]; /* of the motion, peak to peak, rad and m */
    real sign;    /* of the parallel measure at home */
} stewart_replan;

extern const stewart_planner stewart_replanner;
