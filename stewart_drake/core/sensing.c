/* See sensing.h. */

#include "kinematics.h"
#include "sensing.h"
#include "short.h"

#define MOVED ((real)1e-3)     /* share of the motion within a period that counts as moved */
#define NOISY ((real)1048576)  /* units in the last place; larger noise repeats once in a million */
#define SIGMAS 6               /* standard deviations of rates that do not prove a motion */
#define STEEPEST ((real)1.5707963267948966) /* rad; beyond, other angles are the same pose */

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

static int fault_of_state(const stewart_sensing *sensing, const real *geometry, real period,
                          const real *values, const real *last)
{
    return stewart_state_fault(sensing->kind, geometry, period, values, last);
}

stewart_sensing stewart_state_sensing(const void *kind)
{
    const stewart_state_sensor *sensor = kind;
    return (stewart_sensing){X,    sensor->noise_std, kind,           NULL,
                             NULL, start_of_state,    fault_of_state, NULL};
}

int stewart_state_fault(const stewart_state_sensor *sensor, const real *geometry, real period,
                        const real *values, const real *last)
{
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
