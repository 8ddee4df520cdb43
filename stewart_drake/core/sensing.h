/* Models of sensors, y = h(x) + noise: prediction, first estimate and faults. */

#pragma once

#include "machine.h"

/* Faults of a measurement or of a part of it. */
enum { STEWART_MISSING = 1, STEWART_FROZEN = 2, STEWART_REJECTED = 4 };

/* A sensor. Values (m) that are missing are NaN.

   `seen` writes h(x) (m) of a state (12), and `jacobian` dh/dx (m, 12), NaN where there is none; both
   are NULL where the state itself is measured.

   `start` writes the state (12), and a root (12, 12) of its covariance, from values (m) without a
   fault; `near` (12) is where the plate is thought to be, or NULL at the beginning. Returns 0 where
   they fix no state.

   `fault` returns what is wrong with values (m), bits of the causes above, for a machine and the values
   `last` (m) of `period` s ago. */
typedef struct stewart_sensing {
    int size;              /* m */
    const real *noise_std; /* (m) */
    const void *kind;      /* what the functions read */
    void (*seen)(const struct stewart_sensing *sensing, const real *state, real *values);
    void (*jacobian)(const struct stewart_sensing *sensing, const real *state, real *J);
    int (*start)(const struct stewart_sensing *sensing, const real *values, const real *near,
                 real *state, real *root, stewart_scratch scratch);
    int (*fault)(const struct stewart_sensing *sensing, const real *geometry, real period,
                 const real *values, const real *last);
    const struct stewart_legs *legs; /* how a filter reads encoders within a period, or NULL */
} stewart_sensing;

/* Pose and rates. */
typedef struct {
    real noise_std[STEWART_STATES]; /* rad, m and per s */
    real motion[6];                 /* how far each coordinate is expected to move, rad and m */
    int anywhere;                   /* whether poses out of the machine's reach are believed */
} stewart_state_sensor;

stewart_sensing stewart_state_sensing(const void *sensor); /* `stewart_state_sensor` */
