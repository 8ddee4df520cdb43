/* The way back onto the reference, planned in flight.

   When the prediction is far off the reference, as where the delay has just been found or has jumped,
   feedback of a large error through a long delay is no good way back. What the torques in flight do
   cannot be changed; from the instant on from which the next one acts, a plan leads back onto the
   reference. What is followed is the predicted way, then the plan, then the reference: there is no error
   left to feed back, and the integral begins anew. */

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
