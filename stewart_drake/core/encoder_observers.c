/* Observers of encoders with a known delay, with a filter and without: see observers.h. */

#include "encoder_filter.h"
#include "observing.h"

#define X STEWART_STATES
#define LEGS 6

/* Differences of encoders: q_k by forward kinematics, v_k = (q_k - q_{k-1}) / dt. The rates are those of
   half a period ago, and quantisation comes divided by the period. Where a leg is silent, or no pose has
   the angles, the model goes on. */
static int differences_observe(const stewart_law *law, real *memory, int number,
                               const real *torques, const real *values, stewart_scratch scratch)
{
    const stewart_encoders *encoders = law->sensing;
    const real *now = values + law->measured - LEGS;
    real *state = memory, *last = memory + X, found[X], *root = stewart_take(&scratch, X * X);
    stewart_encoders newest = *encoders;
    newest.samples = newest.nodes = 1;
    const stewart_sensing sensing = stewart_encoder_sensing(&newest);
    const int had_state = stewart_all_finite(X, state), complete = stewart_all_finite(LEGS, now);
    stewart_keep_last(law, values, last);
    if (complete && sensing.start(&sensing, now, had_state ? state : NULL, found, root, scratch)) {
        for (int i = 0; i < 6; i++) {
            if (had_state)
                found[6 + i] = (found[i] - state[i]) / law->period;
        }
        stewart_copy(X, found, state);
        return stewart_encoder_fault(encoders, values) << STEWART_CAUSES_AT;
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
    stewart_plain_restart, stewart_known_parameters, stewart_known_last_period,
    1,
};

static int filter_observe(const stewart_law *law, real *memory, int number, const real *torques,
                          const real *values, stewart_scratch scratch)
{
    const stewart_sensing sensing = stewart_encoder_sensing(law->sensing);
    real *last = memory + stewart_estimate_numbers(law);
    stewart_encoders_stood(law->sensing, values, last, last + law->measured);
    return stewart_filtered_observe(law, &sensing, &stewart_encoder_legs,
                                    stewart_encoder_fault(law->sensing, values), memory, number,
                                    torques, values, scratch);
}

static int filter_scratch(const stewart_law *law)
{
    const stewart_sensing sensing = stewart_encoder_sensing(law->sensing);
    return stewart_filtered_scratch(law, &sensing, &stewart_encoder_legs);
}

const stewart_observer stewart_encoder_observer = {
    stewart_filtered_memory,  filter_scratch,              stewart_filtered_start,
    filter_observe,           stewart_filtered_tell,       stewart_plain_assume,
    stewart_filtered_restart, stewart_filtered_parameters, stewart_known_last_period,
    1,
};
