/* The interface of observers: state, parameters and delay at a sample, as they are estimated. */

#ifndef STEWART_OBSERVER_H
#define STEWART_OBSERVER_H

#include "machine.h"

/* What went wrong in a step and was survived; counts[i] of the memory is of bit i. */
enum stewart_status {
    STEWART_RICCATI_FAILURE = 1,      /* no new gain: the last one was used */
    STEWART_UNREACHABLE = 2,          /* no model where the torque will act: feedforward alone */
    STEWART_NONFINITE_TORQUE = 4,     /* no number: the last torque was used */
    STEWART_MEASUREMENT_MISSING = 8,  /* the model stood in for it, or for a part of it */
    STEWART_MEASUREMENT_FROZEN = 16,
    STEWART_MEASUREMENT_REJECTED = 32,
    STEWART_SATURATED = 64,           /* a torque is at the limit */
    STEWART_REFERENCE_MISSING = 128   /* NaN or infinity in the preview: the reference continued */
};
#define STEWART_CAUSES 8

typedef struct stewart_law stewart_law;

/* Pointers are to numbers that stay until the step is over. */
typedef struct {
    int status;         /* what was wrong with the measurement, bits of `stewart_status` */
    int feeds_back;     /* whether the estimate is good enough to act on */
    int settled, found; /* whether the delay is known; whether it was found at this sample */
    real caution;       /* how many times as much torques weigh as they should */
    real state[STEWART_STATES]; /* now; NaN before there is any */
    real theta[STEWART_MAX_ESTIMATED];
    real eta;               /* s until the torque that is computed now begins to act */
    real fraction;          /* of a period, of `eta` beyond the last of `times` */
    stewart_schedule until;   /* what acts until then */
    stewart_schedule horizon; /* what acts until the last of `times`, the same number of pieces each */
    int samples;            /* instants of the prediction */
    const real *times;      /* (samples) s from now */
    int pending;            /* 1 where the newest torque has not acted wholly by then */
    int limited;            /* whether what acted since the last sample was at the limit */
} stewart_outlook;

/* A kind of observer. Its memory is a vector of numbers within the law's. */
typedef struct {
    int (*memory)(const stewart_law *law);  /* how many numbers */
    int (*scratch)(const stewart_law *law); /* numbers that `observe` computes in */
    void (*start)(const stewart_law *law, real *memory);
    /* One period, then a measurement (m) at its end, NaN where it is missing; `torques` (number, 6) in
       flight, the oldest first. Returns what was wrong with it, bits of `stewart_status`. */
    int (*observe)(const stewart_law *law, real *memory, int number, const real *torques,
                   const real *measurement, stewart_scratch scratch);
    /* Fills in `state` and `theta`; without a fixed delay also what follows from the estimated one, from
       torques (number, 6) in flight now. */
    void (*tell)(const stewart_law *law, const real *memory, int number, const real *torques,
                 stewart_outlook *outlook, stewart_scratch *scratch);
    /* The state (12) is this one, for want of any other. */
    void (*assume)(const stewart_law *law, real *memory, const real *state);
    /* Begins anew, with the parameters that it has found and the last measurement. */
    void (*restart)(const stewart_law *law, real *memory);
    /* Parameters (p) and their standard deviations (p), NaN where nothing is estimated. */
    void (*parameters)(const stewart_law *law, const real *memory, real *theta, real *std);
    /* What acted since the last sample of torques (number, 6) in flight, and what acts next. */
    void (*last_period)(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_schedule *schedule, const real **following, stewart_scratch *scratch);
    int fixed; /* whether the delay is the one that the law assumes, which then fills in what follows */
} stewart_observer;

#endif
