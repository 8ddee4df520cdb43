/* Observers of a plate whose delay is known, with a filter and without: see observers.h. */

#include <string.h>

#include "observers.h"

#define X STEWART_STATES
#define U STEWART_MOTORS
#define LEGS 6
#define LONGEST_GAP 10 /* periods that are worth the time; after more the filter goes on by itself */
#define CAUSES_AT 3    /* a cause of stewart_sensing is so many bits further to the left in a status */

static int estimated(const stewart_law *law) { return law->machine.estimated; }

static int estimate_numbers(const stewart_law *law)
{
    return stewart_posterior_size(X + estimated(law), law->measured);
}

/* The state (12) a period later by what is known beforehand. */
static void move_on(const stewart_law *law, int number, const real *torques, real *state,
                    stewart_scratch scratch)
{
    stewart_acting acting;
    stewart_last_periods(law, number, torques, 1, &acting, NULL, &scratch);
    real *states = stewart_take(&scratch, X * acting.number);
    stewart_predict(&law->machine, NULL, &acting, state, states);
    stewart_copy(X, states + X * (acting.number - 1), state);
}

static int moving_scratch(const stewart_law *law)
{
    return (X + U + 1) * (law->parts > 0 ? law->parts : 2) + 2;
}

/* The last value of each measured quantity that was there. */
static void keep_last(const stewart_law *law, const real *values, real *last)
{
    for (int i = 0; i < law->measured; i++)
        if (isfinite(values[i]))
            last[i] = values[i];
}

static void known_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    (void)memory;
    stewart_fill(estimated(law), (real)NAN, std);
    for (int i = 0; i < estimated(law); i++) {
        const int at = law->machine.place[i];
        theta[i] = at < 0 ? 0 : law->machine.parameters[at];
    }
}

static void last_period(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_acting *acting, const real **following, stewart_scratch *scratch)
{
    (void)memory;
    stewart_last_periods(law, number, torques, 1, acting, following, scratch);
}

/* ---- without a filter: the memory is a state and the last measurement ---------------------------- */

static int plain_memory(const stewart_law *law) { return X + law->measured; }

static void plain_start(const stewart_law *law, real *memory)
{
    stewart_fill(plain_memory(law), (real)NAN, memory);
}

static void plain_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                       stewart_told *told, stewart_scratch *scratch)
{
    real std[STEWART_MAX_ESTIMATED];
    (void)number, (void)torques, (void)scratch;
    stewart_copy(X, memory, told->state);
    known_parameters(law, memory, told->theta, std);
}

static void plain_assume(const stewart_law *law, real *memory, const real *state)
{
    (void)law;
    stewart_copy(X, state, memory);
}

static void plain_restart(const stewart_law *law, real *memory)
{
    (void)law;
    stewart_fill(X, (real)NAN, memory);
}

/* The state as it is measured; by the model where the measurement has a fault. */
static int state_observe(const stewart_law *law, real *memory, int number, const real *torques,
                         const real *values, stewart_scratch scratch)
{
    real *state = memory, *last = memory + X;
    int fault = stewart_state_fault(law->sensing, law->machine.geometry, law->period, values, last);
    keep_last(law, values, last);
    if (!fault)
        stewart_copy(X, values, state);
    else if (stewart_all_finite(X, state))
        move_on(law, number, torques, state, scratch);
    return fault << CAUSES_AT;
}

/* Differences of encoders: q_k by forward kinematics, v_k = (q_k - q_{k-1}) / dt. The rates are those of
   half a period ago, and quantisation comes divided by the period. Where a leg is silent, or no pose has
   the angles, the model goes on. */
static int encoder_observe(const stewart_law *law, real *memory, int number, const real *torques,
                           const real *values, stewart_scratch scratch)
{
    const stewart_encoders *encoders = law->sensing;
    const real *now = values + law->measured - LEGS;
    real *state = memory, *last = memory + X, found[X], *root = stewart_take(&scratch, X * X);
    stewart_encoders newest = *encoders;
    newest.samples = newest.nodes = 1;
    const stewart_sensing sensing = stewart_encoder_sensing(&newest);
    const int had_state = stewart_all_finite(X, state), complete = stewart_all_finite(LEGS, now);
    keep_last(law, values, last);
    if (complete && sensing.start(&sensing, now, had_state ? state : NULL, found, root, scratch)) {
        for (int i = 0; i < 6; i++) {
            if (had_state)
                found[6 + i] = (found[i] - state[i]) / law->period;
        }
        stewart_copy(X, found, state);
        return stewart_encoder_fault(encoders, values) << CAUSES_AT;
    }
    if (had_state)
        move_on(law, number, torques, state, scratch);
    return complete ? STEWART_MEASUREMENT_REJECTED : STEWART_MEASUREMENT_MISSING;
}

static int differences_scratch(const stewart_law *law)
{
    return X * X + moving_scratch(law) + stewart_encoder_scratch(law->sensing);
}

const stewart_observer stewart_state_observer = {
    plain_memory, moving_scratch, plain_start,       state_observe, plain_tell,
    plain_assume, plain_restart,  known_parameters, last_period,   1,
};

const stewart_observer stewart_differences_observer = {
    plain_memory, differences_scratch, plain_start,       encoder_observe, plain_tell,
    plain_assume, plain_restart,       known_parameters, last_period,     1,
};

/* ---- with a filter: an estimate, the last measurement, periods without a change of code ---------- */

static int filter_memory(const stewart_law *law)
{
    return estimate_numbers(law) + law->measured + LEGS;
}

static void filter_start(const stewart_law *law, real *memory)
{
    const stewart_filter_settings *settings = law->estimation;
    const stewart_posterior e = stewart_posterior_at(memory, X + estimated(law), law->measured);
    stewart_fill(filter_memory(law), (real)NAN, memory);
    stewart_copy(estimated(law), settings->prior, e.mean + X);
    *e.outliers = *e.unseen = *e.partly = 0;
    stewart_fill(LEGS, 0, memory + estimate_numbers(law) + law->measured);
}

static void filter_restart(const stewart_law *law, real *memory)
{
    const int n = X + estimated(law);
    const stewart_posterior e = stewart_posterior_at(memory, n, law->measured);
    stewart_fill(X, (real)NAN, e.mean);
    stewart_fill(n * n, (real)NAN, e.root);
    stewart_fill(law->measured, (real)NAN, e.outlier);
    *e.outliers = *e.unseen = *e.partly = 0;
    stewart_fill(LEGS, 0, memory + estimate_numbers(law) + law->measured);
}

static void filter_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                        stewart_told *told, stewart_scratch *scratch)
{
    (void)number, (void)torques, (void)scratch;
    stewart_copy(X, memory, told->state);
    stewart_copy(estimated(law), memory + X, told->theta);
}

static void filter_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    const int n = X + estimated(law);
    stewart_copy(estimated(law), memory + X, theta);
    for (int i = X; i < n; i++) {
        const real *row = memory + n + n * i;
        real sum = 0;
        for (int j = 0; j < n; j++)
            sum += row[j] * row[j];
        std[i - X] = REAL(sqrt)(sum);
    }
}

/* What a filter is made of at a sample, in one place because its parts point to each other. */
typedef struct {
    stewart_filter filter;
    stewart_sensing sensing;
    stewart_acted period;
    stewart_history history;
    real last[1];
} filtering;

static void prepare(const stewart_law *law, filtering *f)
{
    const stewart_filter_settings *settings = law->estimation;
    f->filter = settings->filter;
    f->filter.machine = &law->machine;
    f->filter.encoders = settings->encoders ? law->sensing : NULL;
    f->sensing = settings->encoders ? stewart_encoder_sensing(law->sensing)
                                    : stewart_state_sensing(law->sensing);
    f->filter.sensing = &f->sensing;
}

/* The fault of values, and in `period` and `history` what a filter has to know of the last period. */
static int look(const stewart_law *law, int number, const real *torques, const real *values,
                const real *last, real *still, filtering *f, stewart_scratch *scratch)
{
    const stewart_filter_settings *settings = law->estimation;
    prepare(law, f);
    stewart_last_periods(law, number, torques, 1, &f->period.acting, &f->period.following, scratch);
    f->period.acting.substeps =
        stewart_substeps(&law->machine, f->period.acting.number, f->period.acting.torques);
    f->history.last = last;
    f->history.still = still;
    if (!settings->encoders)
        return stewart_state_fault(law->sensing, law->machine.geometry, law->period, values, last);
    stewart_encoders_stood(law->sensing, values, last, still);
    return stewart_encoder_fault(law->sensing, values);
}

static int filter_observe(const stewart_law *law, real *memory, int number, const real *torques,
                          const real *values, stewart_scratch scratch)
{
    const int n = X + estimated(law), m = law->measured;
    const stewart_posterior e = stewart_posterior_at(memory, n, m);
    real *kept = memory + estimate_numbers(law), *last = stewart_take(&scratch, m);
    filtering f;
    stewart_copy(m, kept, last);
    int fault = look(law, number, torques, values, last, kept + m, &f, &scratch), same = 1;
    keep_last(law, values, kept);
    for (int i = 0; i < m; i++)
        same &= values[i] == last[i];
    if (isnan(e.root[0])) {
        const int had_state = stewart_all_finite(X, e.mean);
        real *theta = stewart_take(&scratch, n);
        stewart_copy(estimated(law), e.mean + X, theta);
        if (!fault && stewart_filter_start(&f.filter, values, theta, had_state ? e.mean : NULL, memory,
                                           scratch))
            return 0;
        if (had_state)
            move_on(law, number, torques, e.mean, scratch);
        return fault << CAUSES_AT;
    }
    stewart_filter_advance(&f.filter, &f.period, fault ? NULL : values, &f.history, memory, scratch);
    int status = (fault | (int)*e.partly) << CAUSES_AT;
    if (*e.outliers > 0 && same) { /* such a one said so before: it is no second witness */
        *e.outliers = 0;
        return STEWART_MEASUREMENT_FROZEN;
    }
    return *e.outliers > 0 ? STEWART_MEASUREMENT_REJECTED : status;
}

static int filter_scratch(const stewart_law *law)
{
    filtering f;
    prepare(law, &f);
    const int parts = law->parts > 0 ? law->parts * STEWART_REPORTED : 2;
    return law->measured + X + estimated(law) + (U + 1) * parts + moving_scratch(law) +
           stewart_filter_scratch(&f.filter, parts);
}

const stewart_observer stewart_filter_observer = {
    filter_memory, filter_scratch, filter_start,      filter_observe, filter_tell,
    plain_assume,  filter_restart, filter_parameters, last_period,    1,
};

/* ---- a filter that looks back over gaps: and the estimate before the gap, and what acted since ------

   A filter that goes on without measurements linearises along a way that is only guessed: as long as
   little is known of the parameters, its covariance is then worth nothing. So the estimate of the last
   measurement is kept, and the next one corrects that, over all n periods at once:

       y_k = h(f(x_{k-n}, T_{k-n} ... T_{k-1}, theta)) + noise,

   linearised along the way that explains it. With q_p and q_v what one step of the model may be off in
   pose and rates, n of them are off by

       q_p^2 n + q_v^2 dt^2 (0^2 + 1^2 + ... + (n - 1)^2)   and   q_v^2 n. */

enum { GAP_TORQUES = 2 * (LONGEST_GAP + 1) };

/* The anchor, then torques and durations, how many, and of how many periods. */
static int gap_memory(const stewart_law *law)
{
    return filter_memory(law) + estimate_numbers(law) + (U + 1) * GAP_TORQUES + 2;
}

static void gap_start(const stewart_law *law, real *memory)
{
    stewart_fill(gap_memory(law), 0, memory);
    filter_start(law, memory);
}

static int gap_observe(const stewart_law *law, real *memory, int number, const real *torques,
                       const real *values, stewart_scratch scratch)
{
    const int size = estimate_numbers(law), n = X + estimated(law), m = law->measured;
    const stewart_filter_settings *settings = law->estimation;
    const stewart_posterior now = stewart_posterior_at(memory, n, m);
    real *anchor = memory + filter_memory(law), *since = anchor + size;
    real *durations = since + U * GAP_TORQUES, *pieces = durations + GAP_TORQUES, *periods = pieces + 1;
    real *known = stewart_take(&scratch, size), *last = stewart_take(&scratch, m);
    real *still = stewart_take(&scratch, LEGS), longer[X];
    filtering f;
    stewart_copy(size, memory, known);
    stewart_copy(m, memory + size, last);
    stewart_copy(LEGS, memory + size + m, still);
    const stewart_posterior before = stewart_posterior_at(known, n, m);
    const int status = filter_observe(law, memory, number, torques, values, scratch);
    const int had_anchor = *periods > 0, parts = (int)*pieces;
    const int fault = look(law, number, torques, values, last, still, &f, &scratch);
    const int gone = isnan(before.root[0]) || *before.outliers > 0 || *periods >= LONGEST_GAP;
    const int unseen = *now.unseen > *before.unseen && !(*now.outliers > 0);
    if (!gone && (unseen || had_anchor)) {
        if (!had_anchor)
            stewart_copy(size, known, anchor);
        stewart_copy(U * f.period.acting.number, f.period.acting.torques, since + U * parts);
        stewart_copy(f.period.acting.number, f.period.acting.durations, durations + parts);
        *pieces += (real)f.period.acting.number;
        *periods += 1;
    }
    if (!gone && unseen)
        return status;
    const real passed = *periods, h = law->period;
    f.period.acting = (stewart_acting){(int)*pieces, since, durations, 0};
    *periods = *pieces = 0;
    if (gone || !had_anchor || fault)
        return status;
    f.period.acting.substeps = stewart_substeps(&law->machine, f.period.acting.number, since);
    for (int i = 0; i < 6; i++) {
        const real pose = settings->filter.model_std[i], rate = settings->filter.model_std[6 + i];
        const real drifts = (passed - 1) * passed * (2 * passed - 1) / 6 * h * h;
        longer[i] = REAL(sqrt)(passed * pose * pose + drifts * rate * rate);
        longer[6 + i] = REAL(sqrt)(passed * rate * rate);
    }
    f.filter.model_std = longer;
    stewart_filter_advance(&f.filter, &f.period, values, &f.history, anchor, scratch);
    if (*stewart_posterior_at(anchor, n, m).outliers > 0)
        return status;
    stewart_copy(size, anchor, memory);
    return 0;
}

static int gap_scratch(const stewart_law *law)
{
    filtering f;
    prepare(law, &f);
    return filter_scratch(law) + estimate_numbers(law) + law->measured + LEGS + (U + 1) * 2 +
           stewart_filter_scratch(&f.filter, GAP_TORQUES);
}

const stewart_observer stewart_gap_observer = {
    gap_memory,   gap_scratch,    gap_start,         gap_observe, filter_tell,
    plain_assume, filter_restart, filter_parameters, last_period, 1,
};
