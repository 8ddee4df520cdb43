#include "kinematics.h"
#include "sensing.h"
#include "short.h"

#define MOVED ((real)1e-3)    /* part of the motion within a period that counts as moved */
#define NOISY ((real)1048576) /* units in the last place; larger noise repeats once in a million */
#define SIGMAS 6              /* standard deviations of the rates up to which they do not prove a motion */
#define STEEPEST ((real)1.5707963267948966) /* rad, largest pitch: beyond it other angles are the same pose */

static int start_of_state(const stewart_sensing *sensing, const real *values, const real *near,
                          real *state, real *root, stewart_scratch scratch)
{
    (void)near;
    (void)scratch;
    stewart_copy(X, values, state);
    stewart_fill(X * X, 0, root);
    for (int i = 0; i < X; i++)
        root[(X + 1) * i] = sensing->noise_std[i];
    return 1;
}

/* A value is frozen if it repeats the last one bit for bit although it must have changed: with noise that
   the numbers resolve, always. Without noise it depends on the rates v: between two samples a smooth motion
   goes

       q_k - q_{k-1} = dt/2 (v_{k-1} + v_k) + O(dt^3),

   so a coordinate that repeats is frozen if its rates show a motion. A plate at rest repeats pose and rates
   and is not frozen. A pose that the machine cannot have is rejected. */
static int fault_of_state(const stewart_sensing *sensing, const real *geometry, real period,
                          const real *values, const real *last)
{
    const stewart_state_sensor *sensor = sensing->kind;
    for (int i = 0; i < X; i++)
        if (!isfinite(values[i]))
            return STEWART_MISSING;
    for (int i = 0; i < X; i++) {
        const real size = REAL(fabs)(values[i]);
        const real unit = REAL(nextafter)(size, (real)HUGE_VAL) - size;
        if (values[i] == last[i] && sensor->noise_std[i] > NOISY * unit)
            return STEWART_FROZEN;
    }
    for (int i = 0; i < 6; i++) {
        const real moved = period / 2 * REAL(fabs)(values[6 + i] + last[6 + i]);
        const real perhaps = MOVED * sensor->motion[i] + SIGMAS * period * sensor->noise_std[6 + i];
        if (values[i] == last[i] && moved > perhaps)
            return STEWART_FROZEN;
    }
    if (sensor->anywhere)
        return 0;
    if (REAL(fabs)(values[1]) >= STEEPEST || !stewart_within_reach(geometry, values, 0))
        return STEWART_REJECTED;
    return 0;
}

stewart_sensing stewart_state_sensing(const void *kind)
{
    const stewart_state_sensor *sensor = kind;
    return (stewart_sensing){X,    sensor->noise_std, kind,           NULL,
                             NULL, start_of_state,    fault_of_state, NULL};
}
