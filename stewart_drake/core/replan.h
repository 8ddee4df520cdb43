/* The way back onto the reference, planned in flight.

   When the prediction is far off the reference, for example after the delay was found or has jumped,
   feedback of a large error through a long delay responds badly. From the instant at which the next
   torque acts, a plan leads back onto the reference. The law follows the predicted motion, then the
   plan, then the reference: the error is zero, and the integral starts again.

   A plan from an uncertain state can make things worse. It is made where the covariance P of state and
   parameters, carried through the torques in flight, P+ = H P H', leaves the pose known to `sure`. */

#pragma once

#include "law.h"
#include "planning.h"

typedef struct {
    int periods;  /* of a plan, two at least */
    int until;    /* torques that act until the next one does, at the most */
    real size[6]; /* of the motion, peak to peak, rad and m */
    real sure;    /* largest standard deviation of the predicted pose, share of `size` */
    real sign;    /* of the parallel measure at home */
} stewart_replan;

/* Whether the pose at the end of a schedule is known to the share `sure` of `size` (6), from xi =
   [state; theta] with the root L of its covariance, along the `states` (1 + number, 12). */
int stewart_is_sure(const stewart_machine *machine, const stewart_schedule *schedule, const real *states,
                    const real *theta, const real *L, const real *size, real sure, stewart_scratch scratch);
int stewart_sure_scratch(int estimated, int torques);

extern const stewart_planner stewart_replanner;
