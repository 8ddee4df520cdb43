/* A predictive LQI controller with delay compensation for a rotary Stewart platform.

   Once:           stewart_init(&config, &memory, queue);
   every period:   status = stewart_step(&config, &memory, &work, measurement, 0, preview, weights,
                                         torque);
   and only if something else was sent than `torque`, limited:   stewart_sent(&config, &memory, sent);
   or acted, as a link may have it:   stewart_acted(&config, &memory, ago, number, acted);

   A pose is roll, pitch, yaw (rad) and x, y, z (m) of the plate's centre of mass, a state the pose
   and its rates, a reference the pose, its rates and its accelerations. Matrices are stored by rows.
   Nothing is allocated, nothing kept but in what the caller hands over. */

#ifndef STEWART_H
#define STEWART_H

#include "dynamics.h"
#include "stewart_limits.h"
#include "riccati.h"

#define STEWART_STATES 12
#define STEWART_MOTORS 6
#define STEWART_REFERENCE 18
#define STEWART_ESTIMATED 8 /* the first of the parameters: torque biases, payload, damping */
#define STEWART_MEANS (STEWART_STATES + STEWART_ESTIMATED)
#define STEWART_IN_FLIGHT (1 + STEWART_MAX_KEPT + STEWART_MAX_QUEUE)
#define STEWART_PREVIEW (1 + STEWART_MAX_QUEUE + 8) /* rows of a reference, at the most */

/* What went wrong in a step and was survived; counts[i] of the memory is of bit i. */
enum {
    STEWART_RICCATI_FAILURE = 1,      /* no new gain: the last one was used */
    STEWART_UNREACHABLE = 2,          /* no model where the torque will act: feedforward alone */
    STEWART_NONFINITE_TORQUE = 4,     /* no number: the last torque was used */
    STEWART_MEASUREMENT_MISSING = 8,  /* the model stood in for it, and for the next two */
    STEWART_MEASUREMENT_FROZEN = 16,
    STEWART_MEASUREMENT_REJECTED = 32,
    STEWART_SATURATED = 64,           /* a torque is at the limit */
    STEWART_REFERENCE_MISSING = 128   /* NaN or infinity in the preview: the reference continued */
};
#define STEWART_CAUSES 8

/* What the controller knows; constant. */
typedef struct {
    real geometry[STEWART_GEOMETRY];
    real parameters[STEWART_PARAMETERS]; /* as they are known beforehand */
    real gravity;                        /* m/s^2 */
    real period;                         /* s */
    real fraction;                       /* of a period, that the delay is beyond `steps` */
    real torque_limit;                   /* of each motor, N m; infinite for none */
    real gentle_torque;                  /* N m, beyond which twice as many substeps are taken */
    real noise_std[STEWART_STATES];      /* of the measurement */
    real motion[6];                      /* how far each coordinate is expected to move, rad and m */
    real error_weights[6], integral_weights[6], torque_weights[6];
    /* The filter: of the parameters that it estimates, and of the model. */
    real prior[STEWART_ESTIMATED], std[STEWART_ESTIMATED];
    real lower[STEWART_ESTIMATED], upper[STEWART_ESTIMATED];
    real model_std[STEWART_STATES]; /* by which a step of the model may be off */
    real timing_std;                /* by which a torque may come early or late, s */
    real gate;                      /* squared innovation that makes an outlier */
    int estimates;                  /* whether there is a filter */
    int steps;                      /* of the delay, whole periods */
    int kept;                       /* torques that are remembered beyond the delay's */
    int longest_wait;               /* for a late measurement, periods */
    int substeps;                   /* Runge-Kutta steps per torque */
    int silence;                    /* samples at the start at which nothing is fed back */
} stewart_config;

/* What it remembers from one sample to the next. */
typedef struct {
    real in_flight[STEWART_IN_FLIGHT][STEWART_MOTORS]; /* the oldest first, as limited */
    real mean[STEWART_MEANS]; /* state and parameters, at the last measurement; NaN before any */
    real covariance[STEWART_MEANS * STEWART_MEANS];
    real state[STEWART_STATES];       /* now */
    real measurement[STEWART_STATES]; /* the last, as it came */
    real measured[STEWART_STATES];    /* last of each value that was there */
    real outlier[STEWART_STATES];     /* the last one */
    real error[6];                    /* of the pose */
    real integral[6];
    real gain[STEWART_MOTORS * STEWART_MAX_ORDER]; /* the last good one, (6, n) */
    real torque[STEWART_MOTORS];                   /* the last, as asked for */
    real feedforward[STEWART_MOTORS];              /* and how much of it takes no measurement */
    real weights[2];
    real reference[STEWART_PREVIEW - 1][STEWART_REFERENCE]; /* the last preview but its first row */
    real followed[STEWART_PREVIEW - 1][STEWART_REFERENCE];  /* the same with the way back after a gap */
    real offset[STEWART_STATES]; /* from the reference where the next torque acts, after a gap in it */
    int has_covariance, has_gain, has_started;
    int outliers; /* in a row that bear each other out */
    int unseen;   /* periods since a measurement was last used */
    int behind;   /* periods since that of `mean` */
    int gap;      /* whether the last row of the last preview was missing */
    int return_holds;   /* until the offset is zero */
    int return_samples; /* further ones at which torques in flight belong to the way back */
    int silence;  /* samples that are still to go on without feedback */
    int counts[STEWART_CAUSES];
} stewart_memory;

/* Place to compute in: 75 kB for a delay of 8 periods, in double precision. It keeps nothing from one
   call to the next. */
typedef struct stewart_workspace stewart_workspace;

/* Torques in flight at a sample. */
int stewart_queue_length(const stewart_config *config);

/* Instants (s from now) at which the reference must be known for a step; returns how many. */
int stewart_preview_times(const stewart_config *config, real *times);

/* Before the first step; `queue` has the torques that are under way, the oldest first. A torque that is
   not finite counts as 0. */
void stewart_init(const stewart_config *config, stewart_memory *memory, const real *queue);

/* One sample.

   measurement: a state; what is lost is NaN.
   age: of it in periods, 0 where measurements are those of now. A measurement with an age below 0 is
     lost.
   preview: the reference at the instants of `stewart_preview_times`, a row each. What is NaN or
     infinite continues from the rows next to it and from the last preview; after a gap the law goes
     back onto the reference. Without a complete row until now, the torque is the last one in flight.
   weights: of errors and of torques. With weights that are not finite the last gain is used.
   torque: what to send, as asked for; the motors' limit stands behind it.
   Returns what went wrong, bits of the enumeration above. */
int stewart_step(const stewart_config *config, stewart_memory *memory, stewart_workspace *work,
                 const real *measurement, int age, const real *preview, const real *weights,
                 real *torque);

/* Something else was sent at the last sample than its torque within the limit. */
void stewart_sent(const stewart_config *config, stewart_memory *memory, const real *torque);

/* What has acted, where that may not be what was sent: `number` torques, the newest first, the first
   in the place of the one computed `ago` >= 1 samples before the next step. Torques that are older than
   the memory, or not finite, change nothing. */
void stewart_acted(const stewart_config *config, stewart_memory *memory, int ago, int number,
                   const real *torques);

#include "workspace.h"

#endif
