/* Observers with a filter, for a known delay. Their memory is an estimate, the last measurement, and the number
   of periods for which the code of each leg has been constant. */

#include "filter_attempt.h"
#include "observers.h"
#include "short.h"

/* Number of estimated parameters. */
static int estimated(const stewart_law *law) { return law->machine.estimated; }

static int posterior_size(const stewart_law *law)
{
    return stewart_posterior_size(X + estimated(law), law->num_values);
}

static int filtered_memory(const stewart_law *law)
{
    return posterior_size(law) + law->num_values + LEGS;
}

/* Views of the memory, in its order. */
typedef struct {
    stewart_posterior estimate;
    real *values; /* (m) last valid value of each measured quantity */
    real *unchanged;  /* (LEGS) periods for which each encoder code has been constant */
} Filtered;

static Filtered filtered_at(const stewart_law *law, real *memory)
{
    real *values = memory + posterior_size(law);
    return (Filtered){stewart_posterior_at(memory, X + estimated(law), law->num_values), values,
                      values + law->num_values};
}

static void filtered_restart(const stewart_law *law, real *memory)
{
    const int n = X + estimated(law);
    const Filtered f = filtered_at(law, memory);
    const stewart_posterior e = f.estimate;
    stewart_fill(X, (real)NAN, e.mean);
    stewart_fill(X, 0, e.record->low);
    stewart_fill(n * n, (real)NAN, e.root);
    stewart_fill(law->num_values, (real)NAN, e.outlier);
    e.record->outliers = e.record->age = e.record->left_out = e.record->disagreed = 0;
    stewart_fill(LEGS, 0, f.unchanged);
}

static void filtered_start(const stewart_law *law, real *memory)
{
    const stewart_filter_settings *settings = law->estimation;
    stewart_fill(filtered_memory(law), (real)NAN, memory);
    filtered_restart(law, memory);
    const stewart_posterior e = filtered_at(law, memory).estimate;
    e.record->chi2 = e.record->chi2_values = 0;
    stewart_noise_start(&e.record->noise);
    stewart_copy(estimated(law), settings->prior, e.mean + X);
}

static void filtered_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    const int n = X + estimated(law);
    const stewart_posterior e = filtered_at(law, (real *)memory).estimate;
    stewart_copy(estimated(law), e.mean + X, theta);
    for (int i = X; i < n; i++)
        std[i - X] = stewart_norm(n, e.root + n * i);
}

static real filtered_uncertainty(const stewart_law *law, const real *memory, real *L)
{
    const int n = X + estimated(law);
    const stewart_filter_settings *settings = law->estimation;
    const stewart_posterior e = filtered_at(law, (real *)memory).estimate;
    if (L)
        stewart_copy(n * n, e.root, L);
    return REAL(sqrt)(stewart_timing_scatter(&e.record->noise)) * settings->filter.timing_std;
}

static const real *filtered_low(const stewart_law *law, const real *memory)
{
    return filtered_at(law, (real *)memory).estimate.record->low;
}

static stewart_filter filter_of(const stewart_law *law, const stewart_sensing *sensing)
{
    stewart_filter filter = ((const stewart_filter_settings *)law->estimation)->filter;
    filter.machine = &law->machine;
    filter.sensing = sensing;
    filter.encoder_step = sensing->encoder_step;
    return filter;
}

static stewart_interval last_interval(const stewart_law *law, int number, const real *torques,
                                      stewart_scratch *scratch)
{
    stewart_interval period = stewart_last_periods(law, number, torques, 1, scratch);
    period.schedule.substeps =
        stewart_substeps(&law->machine, period.schedule.number, period.schedule.torques);
    return period;
}

static int filtered_observe(const stewart_law *law, real *memory, int number, const real *torques,
                            const real *values, stewart_scratch scratch)
{
    const int n = X + estimated(law), m = law->num_values;
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = filter_of(law, &sensing);
    const Filtered f = filtered_at(law, memory);
    const stewart_posterior e = f.estimate;
    real *last = stewart_take(&scratch, m);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, f.values);
    const stewart_interval period = last_interval(law, number, torques, &scratch);
    const stewart_history history = {last, f.unchanged};
    int repeated = 1; /* whether all values are the last ones */
    if (sensing.encoder_step)
        sensing.encoder_step->count_unchanged(&sensing, values, f.values, f.unchanged);
    stewart_copy(m, f.values, last);
    stewart_keep_last(m, values, f.values);
    for (int i = 0; i < m; i++)
        repeated &= values[i] == last[i];
    if (isnan(e.root[0])) {
        const int had_state = stewart_all_finite(X, e.mean);
        real *theta = stewart_take(&scratch, n);
        stewart_copy(estimated(law), e.mean + X, theta);
        if (!fault && stewart_filter_start(&filter, values, theta, had_state ? e.mean : NULL, memory,
                                           scratch))
            return 0;
        if (had_state)
            stewart_predict_nominal(law, number, torques, e.mean, scratch);
        return fault << STEWART_CAUSES_AT;
    }
    stewart_filter_advance(&filter, &period, fault ? NULL : values, &history, memory, scratch);
    if (e.record->outliers > 0 && repeated) { /* a repeated outlier does not confirm the one before */
        e.record->outliers = 0;
        return STEWART_MEASUREMENT_FROZEN;
    }
    if (e.record->outliers > 0)
        return STEWART_MEASUREMENT_REJECTED;
    const int partial = !fault && e.record->left_out > 0 ? STEWART_MEASUREMENT_PARTIAL : 0;
    return (fault | (int)e.record->left_out) << STEWART_CAUSES_AT | partial;
}

static int filtered_scratch(const stewart_law *law)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = filter_of(law, &sensing);
    const int most = stewart_most_acting(law);
    const int nominal = stewart_nominal_scratch(law), filtered = stewart_filter_scratch(&filter, most);
    return law->num_values + X + estimated(law) + (U + 1) * most + (nominal > filtered ? nominal : filtered);
}

const stewart_observer stewart_filter_observer = {
    .memory = filtered_memory,
    .scratch = filtered_scratch,
    .start = filtered_start,
    .observe = filtered_observe,
    .restart = filtered_restart,
    .parameters = filtered_parameters,
    .uncertainty = filtered_uncertainty,
    .low = filtered_low,
};

/* ---- over gaps -----------------------------------------------------------------------------------

   A filter without measurements linearises along a guessed path: while the parameters are uncertain, its
   covariance is then wrong. This observer keeps the estimate of the last measurement, the anchor, and the
   torques since. The next measurement corrects the anchor over all n periods at once:

       y_k = h(f(x_{k-n}, T_{k-n} ... T_{k-1}, theta)) + noise,

   linearised along the corrected path. With q_p and q_v the standard deviations of the model's error in
   pose and rates over one step, n steps have

       q_p^2 n + q_v^2 dt^2 (0^2 + 1^2 + ... + (n - 1)^2)   and   q_v^2 n.

   A parameter that walks is constant over the gap; its variance grows by n steps at the end. */

#define LONGEST_GAP 10 /* periods; after more the filter continues from its prediction */

enum { GAP_TORQUES = 2 * (LONGEST_GAP + 1) }; /* two in each period, that of the measurement included */

/* Views of the memory after that of the filter, in its order. */
typedef struct {
    real *anchor;    /* estimate, as of the filter */
    real *torques;   /* (GAP_TORQUES, 6) since the anchor, N m */
    real *durations; /* (GAP_TORQUES) s */
    real *pieces;    /* number of torques and durations */
    real *periods;   /* number of periods since the anchor; 0 without one */
} Gap;

static Gap gap_at(const stewart_law *law, real *memory)
{
    real *anchor = memory + filtered_memory(law), *torques = anchor + posterior_size(law);
    real *durations = torques + U * GAP_TORQUES, *counts = durations + GAP_TORQUES;
    return (Gap){anchor, torques, durations, counts, counts + 1};
}

static int gap_memory(const stewart_law *law)
{
    return filtered_memory(law) + posterior_size(law) + (U + 1) * GAP_TORQUES + 2;
}

static void gap_start(const stewart_law *law, real *memory)
{
    stewart_fill(gap_memory(law), 0, memory);
    filtered_start(law, memory);
}

static int gap_observe(const stewart_law *law, real *memory, int number, const real *torques,
                       const real *values, stewart_scratch scratch)
{
    const int size = posterior_size(law), n = X + estimated(law), m = law->num_values;
    const stewart_filter_settings *settings = law->estimation;
    const Filtered now = filtered_at(law, memory);
    const Gap gap = gap_at(law, memory);
    real *old = stewart_take(&scratch, size), *last = stewart_take(&scratch, m);
    real gap_std[X], gap_walk[STEWART_MAX_ESTIMATED], gap_wander[STEWART_MAX_ESTIMATED];
    const stewart_sensing sensing = stewart_sensing_of(law);
    stewart_filter filter = filter_of(law, &sensing);
    stewart_copy(size, memory, old);
    stewart_copy(m, now.values, last);
    const stewart_posterior before = stewart_posterior_at(old, n, m);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, last);
    const int status = filtered_observe(law, memory, number, torques, values, scratch);
    const int had_anchor = *gap.periods > 0, parts = (int)*gap.pieces;
    stewart_interval period = last_interval(law, number, torques, &scratch);
    const stewart_history history = {last, NULL};
    const int unusable = isnan(before.root[0]) || before.record->outliers > 0 || *gap.periods >= LONGEST_GAP;
    const int unused = now.estimate.record->age > before.record->age && !(now.estimate.record->outliers > 0);
    if (!unusable && (unused || had_anchor)) {
        if (!had_anchor)
            stewart_copy(size, old, gap.anchor);
        stewart_copy(U * period.schedule.number, period.schedule.torques, gap.torques + U * parts);
        stewart_copy(period.schedule.number, period.schedule.durations, gap.durations + parts);
        *gap.pieces += (real)period.schedule.number;
        *gap.periods += 1;
    }
    if (!unusable && unused)
        return status;
    const real steps = *gap.periods, h = law->period;
    period.schedule = (stewart_schedule){(int)*gap.pieces, gap.torques, gap.durations, 0};
    *gap.periods = *gap.pieces = 0;
    if (unusable || !had_anchor || fault)
        return status;
    period.schedule.substeps = stewart_substeps(&law->machine, period.schedule.number, gap.torques);
    for (int i = 0; i < 6; i++) {
        const real pose = settings->filter.model_std[i], rate = settings->filter.model_std[6 + i];
        const real squares = (steps - 1) * steps * (2 * steps - 1) / 6; /* 0^2 + .. + (steps - 1)^2 */
        gap_std[i] = REAL(sqrt)(steps * pose * pose + squares * h * h * rate * rate);
        gap_std[6 + i] = REAL(sqrt)(steps * rate * rate);
    }
    for (int i = 0; i < estimated(law); i++) {
        gap_walk[i] = REAL(sqrt)(steps) * filter.walk_std[i];
        gap_wander[i] = REAL(sqrt)(steps) * filter.wander_std[i];
    }
    filter.model_std = gap_std;
    filter.walk_std = gap_walk;
    filter.wander_std = gap_wander;
    filter.forgetting = REAL(pow)(filter.forgetting, steps);
    stewart_filter_advance(&filter, &period, values, &history, gap.anchor, scratch);
    if (stewart_posterior_at(gap.anchor, n, m).record->outliers > 0)
        return status;
    stewart_copy(size, gap.anchor, memory);
    return 0;
}

static int gap_scratch(const stewart_law *law)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = filter_of(law, &sensing);
    return filtered_scratch(law) + posterior_size(law) + law->num_values +
           (U + 1) * 2 + stewart_filter_scratch(&filter, GAP_TORQUES);
}

const stewart_observer stewart_gap_observer = {
    .memory = gap_memory,
    .scratch = gap_scratch,
    .start = gap_start,
    .observe = gap_observe,
    .restart = filtered_restart,
    .parameters = filtered_parameters,
    .uncertainty = filtered_uncertainty,
    .low = filtered_low,
};
