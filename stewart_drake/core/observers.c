/* Observers of a plate whose delay is known, with a filter and without: see observers.h. */

#include "observing.h"
#include "short.h"

static int estimated(const stewart_law *law) { return law->machine.estimated; }

void stewart_move_on(const stewart_law *law, int number, const real *torques, real *state,
                     stewart_scratch scratch)
{
    stewart_schedule schedule;
    stewart_last_periods(law, number, torques, 1, &schedule, NULL, &scratch);
    real *states = stewart_take(&scratch, X * schedule.number);
    stewart_predict(&law->machine, NULL, &schedule, state, states);
    stewart_copy(X, states + X * (schedule.number - 1), state);
}

int stewart_moving_scratch(const stewart_law *law)
{
    return (X + U + 1) * (law->parts > 0 ? law->parts : 2) + 2;
}

void stewart_keep_last(int number, const real *values, real *last)
{
    for (int i = 0; i < number; i++)
        if (isfinite(values[i]))
            last[i] = values[i];
}

void stewart_known_last_period(const stewart_law *law, const real *memory, int number,
                               const real *torques, stewart_schedule *schedule,
                               const real **following, stewart_scratch *scratch)
{
    (void)memory;
    stewart_last_periods(law, number, torques, 1, schedule, following, scratch);
}

/* ---- without a filter ---------------------------------------------------------------------------- */

int stewart_plain_memory(const stewart_law *law) { return X + law->measured; }

void stewart_plain_start(const stewart_law *law, real *memory)
{
    stewart_fill(stewart_plain_memory(law), (real)NAN, memory);
}

void stewart_plain_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    (void)memory;
    stewart_fill(estimated(law), (real)NAN, std);
    for (int i = 0; i < estimated(law); i++) {
        const int at = law->machine.place[i];
        theta[i] = at < 0 ? 0 : law->machine.parameters[at];
    }
}

void stewart_plain_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_outlook *outlook, stewart_scratch *scratch)
{
    real std[STEWART_MAX_ESTIMATED];
    (void)number, (void)torques, (void)scratch;
    stewart_copy(X, memory, outlook->state);
    stewart_plain_parameters(law, memory, outlook->theta, std);
}

void stewart_plain_assume(const stewart_law *law, real *memory, const real *state)
{
    (void)law;
    stewart_copy(X, state, memory);
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
    stewart_keep_last(law->measured, values, last);
    if ((fault || !sensing.start(&sensing, values, had_state ? state : NULL, state, root, scratch))
        && had_state)
        stewart_move_on(law, number, torques, state, scratch);
    return fault << STEWART_CAUSES_AT;
}

static int state_scratch(const stewart_law *law) { return X * X + stewart_moving_scratch(law); }

const stewart_observer stewart_state_observer = {
    stewart_plain_memory,  state_scratch,            stewart_plain_start,
    state_observe,         stewart_plain_tell,       stewart_plain_assume,
    stewart_plain_restart, stewart_plain_parameters, stewart_known_last_period,
    1,                     stewart_state_sensing,
};

/* ---- with a filter ------------------------------------------------------------------------------- */

int stewart_estimate_numbers(const stewart_law *law)
{
    return stewart_posterior_size(X + estimated(law), law->measured);
}

int stewart_filtered_memory(const stewart_law *law)
{
    return stewart_estimate_numbers(law) + law->measured + LEGS;
}

void stewart_filtered_restart(const stewart_law *law, real *memory)
{
    const int n = X + estimated(law);
    const stewart_posterior e = stewart_posterior_at(memory, n, law->measured);
    stewart_fill(X, (real)NAN, e.mean);
    stewart_fill(n * n, (real)NAN, e.root);
    stewart_fill(law->measured, (real)NAN, e.outlier);
    *e.outliers = *e.unseen = *e.left_out = 0;
    stewart_fill(LEGS, 0, memory + stewart_filtered_memory(law) - LEGS);
}

void stewart_filtered_start(const stewart_law *law, real *memory)
{
    const stewart_filter_settings *settings = law->estimation;
    stewart_fill(stewart_filtered_memory(law), (real)NAN, memory);
    stewart_filtered_restart(law, memory);
    stewart_copy(estimated(law), settings->prior, memory + X);
}

void stewart_filtered_tell(const stewart_law *law, const real *memory, int number,
                           const real *torques, stewart_outlook *outlook, stewart_scratch *scratch)
{
    (void)number, (void)torques, (void)scratch;
    stewart_copy(X, memory, outlook->state);
    stewart_copy(estimated(law), memory + X, outlook->theta);
}

void stewart_filtered_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    const int n = X + estimated(law);
    stewart_copy(estimated(law), memory + X, theta);
    for (int i = X; i < n; i++)
        std[i - X] = stewart_norm(n, memory + n + n * i);
}

stewart_filter stewart_filter_of(const stewart_law *law, const stewart_sensing *sensing)
{
    stewart_filter filter = ((const stewart_filter_settings *)law->estimation)->filter;
    filter.machine = &law->machine;
    filter.sensing = sensing;
    filter.legs = sensing->legs;
    return filter;
}

stewart_interval stewart_last_interval(const stewart_law *law, int number, const real *torques,
                                       stewart_scratch *scratch)
{
    stewart_interval period;
    stewart_last_periods(law, number, torques, 1, &period.schedule, &period.following, scratch);
    period.schedule.substeps =
        stewart_substeps(&law->machine, period.schedule.number, period.schedule.torques);
    return period;
}

int stewart_filtered_observe(const stewart_law *law, real *memory, int number, const real *torques,
                             const real *values, stewart_scratch scratch)
{
    const int n = X + estimated(law), m = law->measured;
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = stewart_filter_of(law, &sensing);
    const stewart_posterior e = stewart_posterior_at(memory, n, m);
    real *kept = memory + stewart_estimate_numbers(law), *last = stewart_take(&scratch, m);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, kept);
    const stewart_interval period = stewart_last_interval(law, number, torques, &scratch);
    const stewart_history history = {last, kept + m};
    int same = 1;
    if (sensing.legs)
        sensing.legs->count_still(&sensing, values, kept, kept + m);
    stewart_copy(m, kept, last);
    stewart_keep_last(m, values, kept);
    for (int i = 0; i < m; i++)
        same &= values[i] == last[i];
    if (isnan(e.root[0])) {
        const int had_state = stewart_all_finite(X, e.mean);
        real *theta = stewart_take(&scratch, n);
        stewart_copy(estimated(law), e.mean + X, theta);
        if (!fault && stewart_filter_start(&filter, values, theta, had_state ? e.mean : NULL, memory,
                                           scratch))
            return 0;
        if (had_state)
            stewart_move_on(law, number, torques, e.mean, scratch);
        return fault << STEWART_CAUSES_AT;
    }
    stewart_filter_advance(&filter, &period, fault ? NULL : values, &history, memory, scratch);
    if (*e.outliers > 0 && same) { /* a repeated outlier does not confirm the one before */
        *e.outliers = 0;
        return STEWART_MEASUREMENT_FROZEN;
    }
    return *e.outliers > 0 ? STEWART_MEASUREMENT_REJECTED
                           : (fault | (int)*e.left_out) << STEWART_CAUSES_AT;
}

int stewart_filtered_scratch(const stewart_law *law)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = stewart_filter_of(law, &sensing);
    const int parts = law->parts > 0 ? law->parts * STEWART_REPORTED : 2;
    return law->measured + X + estimated(law) + (U + 1) * parts + stewart_moving_scratch(law) +
           stewart_filter_scratch(&filter, parts);
}

const stewart_observer stewart_filter_observer = {
    stewart_filtered_memory,  stewart_filtered_scratch,    stewart_filtered_start,
    stewart_filtered_observe, stewart_filtered_tell,       stewart_plain_assume,
    stewart_filtered_restart, stewart_filtered_parameters, stewart_known_last_period,
    1,                        stewart_state_sensing,
};
