#include "observers.h"
#include "short.h"

void stewart_predict_nominal(const stewart_law *law, int number, const real *torques, real *state,
                             stewart_scratch scratch)
{
    const stewart_schedule schedule = stewart_last_periods(law, number, torques, 1, &scratch).schedule;
    real *states = stewart_take(&scratch, X * schedule.number);
    stewart_predict(&law->machine, NULL, &schedule, state, NULL, states);
    stewart_copy(X, states + X * (schedule.number - 1), state);
}

int stewart_nominal_scratch(const stewart_law *law)
{
    return (X + U + 1) * stewart_most_acting(law) + 2;
}

void stewart_keep_last(int number, const real *values, real *last)
{
    for (int i = 0; i < number; i++)
        if (isfinite(values[i]))
            last[i] = values[i];
}

int stewart_plain_memory(const stewart_law *law) { return X + law->num_values; }

void stewart_plain_start(const stewart_law *law, real *memory)
{
    stewart_fill(stewart_plain_memory(law), (real)NAN, memory);
}

void stewart_plain_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    (void)memory;
    stewart_fill(law->machine.estimated, (real)NAN, std);
    for (int i = 0; i < law->machine.estimated; i++) {
        const int at = law->machine.place[i];
        theta[i] = at < 0 ? 0 : law->machine.parameters[at];
    }
}

void stewart_plain_restart(const stewart_law *law, real *memory)
{
    (void)law;
    stewart_fill(X, (real)NAN, memory);
}

/* The measured state; the model's prediction where the measurement has a fault. */
static int state_observe(const stewart_law *law, real *memory, int number, const real *torques,
                         const real *values, stewart_scratch scratch)
{
    real *state = memory, *last = memory + X, *root = stewart_take(&scratch, X * X);
    const stewart_sensing sensing = stewart_sensing_of(law);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, last);
    const int had_state = stewart_all_finite(X, state);
    stewart_keep_last(law->num_values, values, last);
    /* Without a state before there is nothing to predict from: it stays NaN. `start` copies the values. */
    if ((fault || !sensing.start(&sensing, values, had_state ? state : NULL, state, root, scratch))
        && had_state)
        stewart_predict_nominal(law, number, torques, state, scratch);
    return fault << STEWART_CAUSES_AT;
}

static int state_scratch(const stewart_law *law) { return X * X + stewart_nominal_scratch(law); }

const stewart_observer stewart_state_observer = {
    stewart_plain_memory,  state_scratch,            stewart_plain_start, state_observe,
    stewart_plain_restart, stewart_plain_parameters, NULL, NULL, NULL, NULL,
};
