/* Replanning: a path back onto the reference, during the motion.

   The prediction can be far off the reference, for example after the delay was found or has jumped.
   Feedback of such an error through a long delay responds badly. Instead a plan leads back onto the
   reference, from the time at which the next torque begins to act. The law follows the predicted motion,
   then the plan, then the reference: the error is zero, and the integral starts again.

   A plan from an uncertain state can make the error worse. It is made only if each coordinate of the pose
   after the torques in flight has a standard deviation of at most `sure` times its size. This follows from
   the covariance P of state and parameters, P+ = H P H'. */

#pragma once

#include "law.h"
#include "planning.h"

typedef struct {
    int periods;  /* length of a plan, at least two; doubled while the plan exceeds the torque limit, */
    int most;     /* at most this; otherwise no plan is made */
    int until;    /* largest number of torques that act before the next one */
    real size[6]; /* of the motion, peak to peak, rad and m */
    real sure;    /* largest standard deviation of the predicted pose for a plan, over `size` */
    real sign;    /* of the parallel measure at home */
} stewart_replan;

extern const stewart_planner stewart_replanner;
