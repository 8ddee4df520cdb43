/* The interface of observers: state, parameters and delay at a sample, as they are estimated. */

#pragma once

#include "machine.h"
#include "sensing.h"

/* Bits of a step's result: problems that the law compensates. counts[i] of the memory counts bit 2^i. */
enum stewart_status {
    STEWART_RICCATI_FAILURE = 1,      /* no new gain: the last one was used */
    STEWART_UNREACHABLE = 2,          /* the predicted pose is out of the workspace: feedforward alone */
    STEWART_NONFINITE_TORQUE = 4,     /* not a number: the last torque was used */
    STEWART_MEASUREMENT_MISSING = 8,  /* replaced, at least in part, by the model's prediction */
    STEWART_MEASUREMENT_FROZEN = 16,  /* repeated bit for bit; replaced as well */
    STEWART_MEASUREMENT_REJECTED = 32, /* does not fit the machine or the estimate; replaced as well */
    STEWART_SATURATED = 64,           /* a torque is at the limit */
    STEWART_REFERENCE_MISSING = 128,  /* NaN or infinity in the preview: the reference continued */
    STEWART_MEASUREMENT_PARTIAL = 256 /* with the three of a measurement: only in part; not counted */
};
#define STEWART_CAUSES 8 /* number of these bits */
#define STEWART_CAUSES_AT 3 /* shift of a `fault` of `stewart_sensing` to its bits */

/* Whether a step used no part of its measurement, by its result. */
static inline int stewart_unmeasured(int status)
{
    const int causes =
        STEWART_MEASUREMENT_MISSING | STEWART_MEASUREMENT_FROZEN | STEWART_MEASUREMENT_REJECTED;
    return (status & causes) != 0 && !(status & STEWART_MEASUREMENT_PARTIAL);
}

typedef struct stewart_law stewart_law;

/* Pointers are valid until the step is over. */
typedef struct {
    int status;         /* problems of the measurement, bits of `stewart_status` */
    int feeds_back;     /* whether the estimate is good enough for feedback */
    int settled, found; /* whether the delay is known; whether it was found at this sample */
    int assumed;        /* whether the delay is the assumed one */
    real caution;       /* factor on the weight of torques */
    real state[STEWART_STATES]; /* now; NaN before there is any */
    real theta[STEWART_MAX_ESTIMATED];
    const real *observed;   /* memory of the observer */
    real eta;               /* s until the torque that is computed now begins to act */
    real fraction;          /* of a period, of `eta` beyond the last of `times` */
    stewart_schedule until_next; /* torques until then */
    stewart_schedule horizon; /* torques until the last of `times`, the same number of pieces each */
    int samples;            /* instants of the prediction */
    const real *times;      /* (samples) s from now */
    int pending;            /* number of the newest torques that still act then, left to the gain */
    int limited;            /* whether a torque since the last sample was at the limit */
    real *predicted; /* (until_next.number + 1, 12) states that a planner fills in, NULL without; first NaN */
} stewart_outlook;

/* A kind of observer. Its memory, a part of the law's, begins with the state (12), which may be set. */
typedef struct {
    int (*memory)(const stewart_law *law);  /* numbers of memory */
    int (*scratch)(const stewart_law *law); /* numbers of scratch memory for `observe` */
    void (*start)(const stewart_law *law, real *memory);
    /* Advance by a period and correct by a measurement (m) at its end, NaN where it is missing;
       `torques` (number, 6) in flight, the oldest first. Returns bits of `stewart_status`. */
    int (*observe)(const stewart_law *law, real *memory, int number, const real *torques,
                   const real *measurement, stewart_scratch scratch);
    /* Begin again, with the estimated parameters and the last measurement. */
    void (*restart)(const stewart_law *law, real *memory);
    /* Parameters (p) and their standard deviations (p), NaN where nothing is estimated. */
    void (*parameters)(const stewart_law *law, const real *memory, real *theta, real *std);
    /* NULL if the delay is the assumed one. Fill in all that follows from the estimated delay, with
       torques (number, 6) in flight now. */
    void (*outlook)(const stewart_law *law, const real *memory, int number, const real *torques,
                    stewart_outlook *outlook, stewart_scratch *scratch);
    /* The same: torques since the last sample, and the next torque. */
    void (*last_period)(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_schedule *schedule, const real **following, stewart_scratch *scratch);
    /* NULL without a covariance. Root L (12 + p, 12 + p) of that of state and parameters, NaN before
       there is any. Returns the standard deviation of the instant of a single torque, s; L may be NULL. */
    real (*uncertainty)(const stewart_law *law, const real *memory, real *L);
} stewart_observer;

/* The sensor of the law: `described`, else `read` of `sensing`. */
stewart_sensing stewart_sensing_of(const stewart_law *law);
