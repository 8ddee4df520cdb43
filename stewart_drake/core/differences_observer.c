/* The observer of encoders without a filter: q_k by forward kinematics, v_k = (q_k - q_{k-1}) / dt. The
   rates are those of half a period ago, and quantisation is divided by the period. The model predicts
   if a leg has no value, or if no pose has the angles. */

#include "encoders.h"
#include "observers.h"
#include "short.h"

static int differences_observe(const stewart_law *law, real *memory, int number,
                               const real *torques, const real *values, stewart_scratch scratch)
{
    const stewart_sensing newest = stewart_newest_encoder_sensing(law->sensing);
    const real *now = values + law->num_values - LEGS;
    real *state = memory, *last = memory + X, found[X], *root = stewart_take(&scratch, X * X);
    const int had_state = stewart_all_finite(X, state), complete = stewart_all_finite(LEGS, now);
    stewart_keep_last(law->num_values, values, last);
    if (complete && newest.start(&newest, now, had_state ? state : NULL, found, root, scratch)) {
        for (int i = 0; i < 6 && had_state; i++)
            found[6 + i] = (found[i] - state[i]) / law->period;
        stewart_copy(X, found, state);
        return 0;
    }
    if (had_state)
        stewart_predict_nominal(law, number, torques, state, scratch);
    return complete ? STEWART_MEASUREMENT_REJECTED : STEWART_MEASUREMENT_MISSING;
}

static int differences_scratch(const stewart_law *law)
{
    return X * X + stewart_nominal_scratch(law) + stewart_encoder_scratch(law->sensing);
}

const stewart_observer stewart_differences_observer = {
    stewart_plain_memory,  differences_scratch,      stewart_plain_start, differences_observe,
    stewart_plain_restart, stewart_plain_parameters, NULL, NULL, NULL, NULL,
};
