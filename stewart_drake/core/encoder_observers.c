/* Observers of encoders with a known delay, with a filter and without: see observers.h. */

#include "encoder_filter.h"
#include "observing.h"
#include "short.h"

/* Differences of encoders: q_k by forward kinematics, v_k = (q_k - q_{k-1}) / dt. The rates are those of
   half a period ago, and quantisation is divided by the period. The model predicts where a leg is
   silent, or where no pose has the angles. */
static int differences_observe(const stewart_law *law, real *memory, int number,
                               const real *torques, const real *values, stewart_scratch scratch)
{
    const stewart_sensing sensing = stewart_sensing_of(law), newest = stewart_newest_encoders(law->sensing);
    const real *now = values + law->measured - LEGS;
    real *state = memory, *last = memory + X, found[X], *root = stewart_take(&scratch, X * X);
    const int had_state = stewart_all_finite(X, state), complete = stewart_all_finite(LEGS, now);
    stewart_keep_last(law->measured, values, last);
    if (complete && newest.start(&newest, now, had_state ? state : NULL, found, root, scratch)) {
        for (int i = 0; i < 6 && had_state; i++)
            found[6 + i] = (found[i] - state[i]) / law->period;
        stewart_copy(X, found, state);
        return sensing.fault(&sensing, NULL, law->period, values, last) << STEWART_CAUSES_AT;
    }
    if (had_state)
        stewart_move_on(law, number, torques, state, scratch);
    return complete ? STEWART_MEASUREMENT_REJECTED : STEWART_MEASUREMENT_MISSING;
}

static int differences_scratch(const stewart_law *law)
{
    return X * X + stewart_moving_scratch(law) + stewart_encoder_scratch(law->sensing);
}

const stewart_observer stewart_differences_observer = {
    stewart_plain_memory,  differences_scratch,      stewart_plain_start,
    differences_observe,   stewart_plain_tell,       stewart_plain_assume,
    stewart_plain_restart, stewart_plain_parameters, stewart_known_last_period,
    1,                     stewart_encoder_sensing,
};

static stewart_sensing sensing_with_legs(const void *sensor)
{
    stewart_sensing sensing = stewart_encoder_sensing(sensor);
    sensing.legs = &stewart_encoder_legs;
    return sensing;
}

const stewart_observer stewart_encoder_observer = {
    stewart_filtered_memory,  stewart_filtered_scratch,    stewart_filtered_start,
    stewart_filtered_observe, stewart_filtered_tell,       stewart_plain_assume,
    stewart_filtered_restart, stewart_filtered_parameters, stewart_known_last_period,
    1,                        sensing_with_legs,
};
