/* An observer that corrects the estimate before a gap, see observers.h. Its memory has that estimate too,
   and the torques since.

   A filter without measurements linearises along a guessed path: while the parameters are uncertain, its
   covariance is then wrong. So the estimate of the last measurement is kept, and the next measurement
   corrects it, over all n periods at once:

       y_k = h(f(x_{k-n}, T_{k-n} ... T_{k-1}, theta)) + noise,

   linearised along the corrected path. With q_p and q_v the standard deviations of the model's error in
   pose and rates over one step, n steps have

       q_p^2 n + q_v^2 dt^2 (0^2 + 1^2 + ... + (n - 1)^2)   and   q_v^2 n. */

#include "observing.h"
#include "short.h"

#define LONGEST_GAP 10 /* periods; after more the filter continues from its prediction */

static int estimated(const stewart_law *law) { return law->machine.estimated; }

enum { GAP_TORQUES = 2 * (LONGEST_GAP + 1) };

/* The anchor, then torques and durations, how many, and of how many periods. */
static int gap_memory(const stewart_law *law)
{
    return stewart_filtered_memory(law) + stewart_estimate_numbers(law) + (U + 1) * GAP_TORQUES + 2;
}

static void gap_start(const stewart_law *law, real *memory)
{
    stewart_fill(gap_memory(law), 0, memory);
    stewart_filtered_start(law, memory);
}

static int gap_observe(const stewart_law *law, real *memory, int number, const real *torques,
                       const real *values, stewart_scratch scratch)
{
    const int size = stewart_estimate_numbers(law), n = X + estimated(law), m = law->measured;
    const stewart_filter_settings *settings = law->estimation;
    const stewart_posterior now = stewart_posterior_at(memory, n, m);
    real *anchor = memory + stewart_filtered_memory(law), *since = anchor + size;
    real *durations = since + U * GAP_TORQUES, *pieces = durations + GAP_TORQUES, *periods = pieces + 1;
    real *known = stewart_take(&scratch, size), *last = stewart_take(&scratch, m);
    real longer[X];
    const stewart_sensing sensing = stewart_sensing_of(law);
    stewart_filter filter = stewart_filter_of(law, &sensing);
    stewart_copy(size, memory, known);
    stewart_copy(m, memory + size, last);
    const stewart_posterior before = stewart_posterior_at(known, n, m);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, last);
    const int status = stewart_filtered_observe(law, memory, number, torques, values, scratch);
    const int had_anchor = *periods > 0, parts = (int)*pieces;
    stewart_interval period = stewart_last_interval(law, number, torques, &scratch);
    const stewart_history history = {last, NULL};
    const int gone = isnan(before.root[0]) || *before.outliers > 0 || *periods >= LONGEST_GAP;
    const int unseen = *now.unseen > *before.unseen && !(*now.outliers > 0);
    if (!gone && (unseen || had_anchor)) {
        if (!had_anchor)
            stewart_copy(size, known, anchor);
        stewart_copy(U * period.schedule.number, period.schedule.torques, since + U * parts);
        stewart_copy(period.schedule.number, period.schedule.durations, durations + parts);
        *pieces += (real)period.schedule.number;
        *periods += 1;
    }
    if (!gone && unseen)
        return status;
    const real passed = *periods, h = law->period;
    period.schedule = (stewart_schedule){(int)*pieces, since, durations, 0};
    *periods = *pieces = 0;
    if (gone || !had_anchor || fault)
        return status;
    period.schedule.substeps = stewart_substeps(&law->machine, period.schedule.number, since);
    for (int i = 0; i < 6; i++) {
        const real pose = settings->filter.model_std[i], rate = settings->filter.model_std[6 + i];
        const real drifts = (passed - 1) * passed * (2 * passed - 1) / 6 * h * h;
        longer[i] = REAL(sqrt)(passed * pose * pose + drifts * rate * rate);
        longer[6 + i] = REAL(sqrt)(passed * rate * rate);
    }
    filter.model_std = longer;
    stewart_filter_advance(&filter, &period, values, &history, anchor, scratch);
    if (*stewart_posterior_at(anchor, n, m).outliers > 0)
        return status;
    stewart_copy(size, anchor, memory);
    return 0;
}

static int gap_scratch(const stewart_law *law)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    const stewart_filter filter = stewart_filter_of(law, &sensing);
    return stewart_filtered_scratch(law) + stewart_estimate_numbers(law) + law->measured +
           (U + 1) * 2 + stewart_filter_scratch(&filter, GAP_TORQUES);
}

const stewart_observer stewart_gap_observer = {
    gap_memory,               gap_scratch,                 gap_start,
    gap_observe,              stewart_filtered_tell,       stewart_plain_assume,
    stewart_filtered_restart, stewart_filtered_parameters, stewart_known_last_period,
    1,                        stewart_state_sensing,
};
