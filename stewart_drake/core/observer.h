/* Interface of observers, which estimate state, parameters and delay at a sample. */

#pragma once

#include "machine.h"
#include "sensing.h"

/* Bits of a step's result: problems that the law compensates. counts[i] of the memory counts bit 2^i. */
enum stewart_status {
    STEWART_RICCATI_FAILURE = 1,      /* no new gain: the last one was used */
    STEWART_UNREACHABLE = 2,          /* the predicted pose is out of the workspace: feedforward alone */
    STEWART_NONFINITE_TORQUE = 4,     /* NaN or infinity: the last torque was used */
    /* The model's prediction replaced the measurement, at least in part, which was */
    STEWART_MEASUREMENT_MISSING = 8,   /* lost, */
    STEWART_MEASUREMENT_FROZEN = 16,   /* repeated bit for bit, or */
    STEWART_MEASUREMENT_REJECTED = 32, /* not one of the machine, or an outlier */
    STEWART_SATURATED = 64,           /* a torque is at the limit */
    STEWART_REFERENCE_MISSING = 128,  /* NaN or infinity in the preview, filled in */
    STEWART_MEASUREMENT_PARTIAL = 256, /* with a bit of a measurement: a part of it was used; not counted */
    STEWART_NOT_STARTED = 512 /* alone: the memory was never started, the output is zero; not counted */
};
#define STEWART_CAUSES 8 /* number of bits that are counted */
#define STEWART_CAUSES_AT 3 /* shift from a `fault` of `stewart_sensing` to these bits */

/* Return whether a step with this result used no part of its measurement. */
static inline int stewart_unmeasured(int status)
{
    const int causes =
        STEWART_MEASUREMENT_MISSING | STEWART_MEASUREMENT_FROZEN | STEWART_MEASUREMENT_REJECTED;
    return (status & causes) != 0 && !(status & STEWART_MEASUREMENT_PARTIAL);
}

typedef struct stewart_law stewart_law;

/* Estimate at a sample, and the torques that act until the next one does. Pointers are valid until the step is
   over. */
typedef struct {
    int status;         /* problems of the measurement, bits of `stewart_status` */
    int feeds_back;     /* whether the estimate is good enough for feedback */
    int settled, found; /* whether the delay is known; whether it was found at this sample */
    int assumed;        /* whether the delay is the assumed one */
    real caution;       /* factor on the weight of torques */
    real state[STEWART_STATES]; /* now; NaN before the first measurement */
    real low[STEWART_STATES]; /* as of `stewart_accumulate`, of `state` */
    real theta[STEWART_MAX_ESTIMATED]; /* parameters */
    const real *observed;   /* memory of the observer */
    real eta;               /* s until the torque that is computed now begins to act */
    real fraction;          /* time from the last of `times` to `eta`, periods */
    stewart_schedule until_next; /* torques until `eta` */
    stewart_schedule horizon; /* torques until the last of `times`, the same number of pieces for each time */
    int samples;            /* number of times at which the prediction is compared with the reference */
    const real *times;      /* (samples) s from now */
    int pending;            /* number of the newest torques that still act after the last of `times`; the gain
                               accounts for them */
    int limited;            /* whether a torque since the last sample was at the limit */
    real *predicted;        /* (until_next.number + 1, 12) states that a planner writes, before that NaN; NULL
                               without a planner */
} stewart_outlook;

/* A kind of observer. Its memory is a part of the law's and begins with the state (12), which callers may set. */
typedef struct {
    int (*memory)(const stewart_law *law);  /* numbers of memory */
    int (*scratch)(const stewart_law *law); /* numbers of scratch memory for `observe` */
    void (*start)(const stewart_law *law, real *memory);
    /* Advance by a period and correct by a measurement (m) at its end, NaN where it is missing;
       `torques` (number, 6) in flight, the oldest first. Returns bits of `stewart_status`. */
    int (*observe)(const stewart_law *law, real *memory, int number, const real *torques,
                   const real *measurement, stewart_scratch scratch);
    /* Begin again, with the estimated parameters and the last measurement: after a missing report of servos. */
    void (*restart)(const stewart_law *law, real *memory);
    /* Parameters (p) and their standard deviations (p), NaN where nothing is estimated. */
    void (*parameters)(const stewart_law *law, const real *memory, real *theta, real *std);
    /* NULL if the delay is the assumed one. Fill in the fields that follow from the estimated delay, with
       torques (number, 6) in flight now. */
    void (*outlook)(const stewart_law *law, const real *memory, int number, const real *torques,
                    stewart_outlook *outlook, stewart_scratch *scratch);
    /* NULL likewise. Find the torques since the last sample, and the next torque. */
    void (*last_period)(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_schedule *schedule, const real **following, stewart_scratch *scratch);
    /* NULL without a covariance. Compute the root L (12 + p, 12 + p) of the covariance of state and parameters,
       NaN before the first estimate; L may be NULL. Returns the standard deviation of the timing of single
       torques, s. */
    real (*uncertainty)(const stewart_law *law, const real *memory, real *L);
    /* NULL if it is 0. Return what rounding has taken off the state (12), as of `stewart_accumulate`. */
    const real *(*low)(const stewart_law *law, const real *memory);
} stewart_observer;

/* Return the sensor model of a law. */
stewart_sensing stewart_sensing_of(const stewart_law *law);
