/* Sensor models, y = h(x) + noise: prediction, first estimate and faults. */

#pragma once

#include "machine.h"

/* Faults of a measurement or of a part of it. */
enum { STEWART_MISSING = 1, STEWART_FROZEN = 2, STEWART_REJECTED = 4 };

/* A sensor. Values (m) that are missing are NaN.

   `seen` writes h(x) (m) of a state (12), and `jacobian` dh/dx (m, 12), NaN where there is none; both
   are NULL where the state itself is measured.

   `start` writes the state (12), and a root (12, 12) of its covariance, from values (m) without a
   fault; `near` (12) is the expected state, or NULL at the beginning. Returns 0 where the values
   determine no state.

   `fault` returns the faults of values (m), as bits, for a machine and the values `last` (m) of `period` s
   ago. */
typedef struct stewart_sensing {
    int size;              /* m */
    const real *noise_std; /* (m) */
    const void *kind;      /* settings of the sensor, which the functions read */
    void (*seen)(const struct stewart_sensing *sensing, const real *state, real *values);
    void (*jacobian)(const struct stewart_sensing *sensing, const real *state, real *J);
    int (*start)(const struct stewart_sensing *sensing, const real *values, const real *near,
                 real *state, real *root, stewart_scratch scratch);
    int (*fault)(const struct stewart_sensing *sensing, const real *geometry, real period,
                 const real *values, const real *last);
    const struct stewart_encoder_step *encoder_step; /* filter step with encoders, or NULL */
} stewart_sensing;

/* Pose and rates. */
typedef struct {
    real noise_std[STEWART_STATES]; /* rad, m and per s */
    real motion[6];                 /* expected range of each coordinate, rad and m */
    int anywhere;                   /* whether poses out of the machine's reach are accepted */
} stewart_state_sensor;

stewart_sensing stewart_state_sensing(const void *sensor); /* `stewart_state_sensor` */
