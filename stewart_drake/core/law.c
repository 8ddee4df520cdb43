/* The predictive LQI law: see law.h.

   At t = k dt the torques in flight are known. They give the state at the time at which the next torque
   begins to act, and there

       T_k = T_ff - K [e; z; ...],   e the predicted error of pose and rates, z its predicted integral. */

#include <string.h>

#include "law.h"
#include "reference.h"
#include "short.h"

/* ---- the memory ------------------------------------------------------------------------------- */

static int in_flight_length(const stewart_law *law)
{
    return law->layout.in_flight.rows;
}

void stewart_prepare(stewart_law *law)
{
    stewart_layout *l = &law->layout;
    const int observed = law->observer->memory(law), estimated = law->machine.estimated;
    law->memory = 0;
    l->in_flight = stewart_place(law, 1 + law->extra_torques + stewart_queue_length(law), U);
    l->observer = stewart_place(law, 1, observed);
    l->lag = stewart_place(law, 1, 1);
    l->state = stewart_place(law, 1, X);
    l->parameters = stewart_place(law, 1, estimated);
    l->measurement = stewart_place(law, 1, law->num_values);
    l->error = stewart_place(law, 1, 6);
    l->integral = stewart_place(law, 1, 6);
    l->gain = stewart_place(law, U,
                            law->design ? law->design->columns
                                        : stewart_order(&law->cost, law->fraction > 0));
    l->torque = stewart_place(law, 1, U);
    l->feedforward = stewart_place(law, 1, U);
    l->weights = stewart_place(law, 1, 2);
    l->open_loop_samples = stewart_place(law, 1, 1);
    l->times = stewart_place(law, 1, law->rows);
    l->reference = stewart_place(law, law->rows, ROW);
    l->followed = stewart_place(law, law->rows, ROW);
    l->gap = stewart_place(law, 1, 1);
    l->blend = stewart_place(law, 1, X + 2);
    l->channel = stewart_place(law, 1, law->channel ? law->channel->memory(law) : 0);
    l->planner = stewart_place(law, 1, law->planner ? law->planner->memory(law) : 0);
    l->counts = stewart_place(law, 1, STEWART_CAUSES);
    l->started = stewart_place(law, 1, 1);
}

static void copy_finite_torque(const real *torque, real *to)
{
    if (stewart_all_finite(U, torque))
        stewart_copy(U, torque, to);
}

void stewart_start(const stewart_law *law, real *memory, int number, const real *queue)
{
    const stewart_layout *l = &law->layout;
    const int length = in_flight_length(law);
    stewart_fill(law->memory, (real)NAN, memory);
    stewart_fill(U * length, 0, memory + l->in_flight.at);
    for (int i = 0; number > 0 && i < length; i++) /* the oldest torque has acted before, too */
        copy_finite_torque(queue + U * (i < number ? number - 1 - i : 0),
                           memory + l->in_flight.at + U * (length - 1 - i));
    stewart_fill(U, 0, memory + l->torque.at);
    if (number > 0)
        stewart_copy(U, memory + l->in_flight.at + U * (length - 1), memory + l->torque.at);
    law->observer->start(law, memory + l->observer.at);
    if (law->channel)
        law->channel->start(law, memory + l->channel.at);
    if (law->planner)
        law->planner->start(law, memory + l->planner.at);
    real std[STEWART_MAX_ESTIMATED];
    law->observer->parameters(law, memory + l->observer.at, memory + l->parameters.at, std);
    memory[l->lag.at] = 0;
    stewart_fill(6, 0, memory + l->error.at);
    stewart_fill(6, 0, memory + l->integral.at);
    memory[l->open_loop_samples.at] = (real)law->open_loop_samples;
    memory[l->gap.at] = 0;
    stewart_fill(X + 2, 0, memory + l->blend.at);
    stewart_fill(STEWART_CAUSES, 0, memory + l->counts.at);
    memory[l->started.at] = STEWART_STARTED;
}

void stewart_note_acted(const stewart_law *law, real *memory, int ago, int number, const real *torques)
{
    const int length = in_flight_length(law);
    real *in_flight = memory + law->layout.in_flight.at;
    for (int at = 1; number > 0 && at <= length; at++)
        if (ago <= at && ago > at - number)
            copy_finite_torque(torques + U * (at - ago), in_flight + U * (length - at));
}

/* ---- estimation ------------------------------------------------------------------------------- */

/* Fill in the part of an outlook that follows from a known delay. */
static void fixed_delay_outlook(const stewart_law *law, const real *in_flight, stewart_outlook *outlook,
                                stewart_scratch *scratch)
{
    const int queue = stewart_queue_length(law), pending = law->fraction > 0;
    const int length = in_flight_length(law);
    const real *torques = in_flight + U * (length - queue);
    real *times = stewart_take(scratch, law->steps + 1);
    real *durations = stewart_take(scratch, queue + 1);
    for (int k = 0; k < law->steps; k++)
        times[k] = law->period * (real)(k + 1);
    for (int k = 0; k < queue; k++)
        durations[k] = (k == 0 && pending ? law->fraction : 1) * law->period;
    outlook->eta = ((real)law->steps + law->fraction) * law->period;
    outlook->fraction = law->fraction;
    outlook->until_next = (stewart_schedule){queue, torques, durations, 0};
    outlook->horizon = stewart_schedule_of(law->period, law->fraction, law->steps, torques, scratch);
    outlook->assumed = 1;
    outlook->samples = law->steps;
    outlook->times = times;
    outlook->pending = pending;
    const stewart_schedule last = stewart_last_periods(law, length, in_flight, 1, scratch).schedule;
    outlook->limited = stewart_at_limit(&law->machine, last.number, last.torques);
}

/* Advance the observer to the newest measurement, which may be `age` periods old, and predict the present
   state from there. Without a usable measurement it stays up to `longest_wait` periods behind. */
static void estimate(const stewart_law *law, real *memory, const stewart_sample *sample,
                     stewart_outlook *outlook, stewart_scratch *scratch)
{
    const stewart_layout *l = &law->layout;
    const stewart_observer *observer = law->observer;
    const int length = in_flight_length(law), longest = law->longest_wait;
    const real *in_flight = memory + l->in_flight.at, *y = sample->measurement;
    real *missing = stewart_take(scratch, law->num_values), *observed = memory + l->observer.at;
    int lag = (int)memory[l->lag.at] + 1, usable = 0;
    for (int i = 0; i < law->num_values; i++) {
        usable |= isfinite(y[i]) != 0;
        missing[i] = (real)NAN;
    }
    usable &= sample->age >= 0 && sample->age <= longest && sample->age < lag; /* newer than the last */
    const int next_lag = usable ? sample->age : longest;
    outlook->status = usable ? 0 : STEWART_MEASUREMENT_MISSING;
    while (lag > next_lag) {
        lag--;
        const int fresh = usable && lag == sample->age;
        int status = observer->observe(law, observed, length - lag, in_flight,
                                       fresh ? y : missing, *scratch);
        if (fresh)
            outlook->status = status;
    }
    memory[l->lag.at] = (real)lag;
    outlook->feeds_back = outlook->settled = 1;
    outlook->found = outlook->assumed = 0;
    outlook->caution = 1;
    outlook->observed = observed;
    if (observer->outlook)
        observer->outlook(law, observed, length, in_flight, outlook, scratch);
    else
        fixed_delay_outlook(law, in_flight, outlook, scratch);
    real std[STEWART_MAX_ESTIMATED];
    if (law->tolerated_timing > 0 && observer->uncertainty) {
        const real ratio = observer->uncertainty(law, observed, NULL) / law->tolerated_timing;
        outlook->caution *= ratio > 1 ? ratio * ratio : 1; /* not for NaN */
    }
    stewart_copy(X, observed, outlook->state);
    stewart_fill(X, 0, outlook->low);
    if (observer->low)
        stewart_copy(X, observer->low(law, observed), outlook->low);
    observer->parameters(law, observed, outlook->theta, std);
    if (lag > 0 && stewart_all_finite(X, outlook->state)) {
        const stewart_schedule schedule =
            stewart_last_periods(law, length, in_flight, lag, scratch).schedule;
        real *states = stewart_take(scratch, X * schedule.number);
        stewart_predict(&law->machine, outlook->theta, &schedule, outlook->state, outlook->low, states);
        stewart_copy(X, states + X * (schedule.number - 1), outlook->state);
    }
    if (law->design && law->design->outlook)
        law->design->outlook(law, lag, outlook);
}

/* ---- the reference to follow ------------------------------------------------------------------ */

/* Write the times of a preview: now, those of the prediction, and two nodes in each hold; for each further
   planned torque the last time of the prediction and the nodes again, a period later. */
static int preview_times(const stewart_law *law, const stewart_outlook *outlook, real *times)
{
    const int torques = law->channel ? law->channel->torques(law) : 1;
    int n = 0;
    times[n++] = 0;
    for (int k = 0; k < outlook->samples; k++)
        times[n++] = outlook->times[k];
    const int again = n - 1;
    for (int hold = -outlook->pending - 1; hold <= 1; hold++)
        for (int node = 0; node < 2; node++)
            times[n++] = outlook->eta + law->period * ((real)hold + GAUSS_NODES[node]);
    for (int i = 1, number = n - again; i < torques; i++)
        for (int k = 0; k < number; k++)
            times[n++] = times[again + k] + law->period * (real)i;
    return n;
}

/* Whether this sample belongs to the open-loop start. It does not while a torque in flight is at the limit,
   whose effect is known without a measurement. */
static int is_open_loop(const stewart_law *law, const real *memory)
{
    const stewart_field *in_flight = &law->layout.in_flight;
    return memory[law->layout.open_loop_samples.at] > 0 &&
           !stewart_at_limit(&law->machine, in_flight->rows, memory + in_flight->at);
}

/* Read the course of the last sample from the memory. */
static stewart_course last_course(const stewart_law *law, real *memory)
{
    const stewart_layout *l = &law->layout;
    stewart_course last = {
        .times = memory + l->times.at,
        .reference = memory + l->reference.at,
        .followed = memory + l->followed.at,
        .gap = memory[l->gap.at] > 0,
        .blend = {.holds = (int)memory[l->blend.at + X], .samples = (int)memory[l->blend.at + X + 1]},
    };
    while (last.number < law->rows && isfinite(last.times[last.number]))
        last.number++;
    stewart_copy(X, memory + l->blend.at, last.blend.offset);
    return last;
}

/* Read the reference, and compute the course to follow. */
static void follow(const stewart_law *law, real *memory, const stewart_sample *sample,
                   const stewart_outlook *outlook, stewart_course *c, stewart_scratch *scratch)
{
    const stewart_layout *l = &law->layout;
    const stewart_course last = last_course(law, memory);
    const stewart_course_input motion = {&law->machine,  law->period,    stewart_queue_length(law),
                                   outlook->eta,   outlook->state, outlook->theta,
                                   outlook->until_next, is_open_loop(law, memory)};
    real *given = stewart_take(scratch, ROW * law->rows);
    c->times = stewart_take(scratch, law->rows);
    c->reference = stewart_take(scratch, ROW * law->rows);
    c->followed = stewart_take(scratch, ROW * law->rows);
    c->number = preview_times(law, outlook, c->times);
    if (law->planner)
        law->planner->rows(law, memory + l->planner.at, sample, c->number, c->times, given);
    else
        sample->reference(sample->context, c->number, c->times, given);
    stewart_follow(&motion, &last, given, c, *scratch);
}

/* Store the course for the next sample. */
static void remember_course(const stewart_law *law, real *memory, const stewart_course *c)
{
    const stewart_layout *l = &law->layout;
    stewart_fill(law->rows, (real)NAN, memory + l->times.at);
    stewart_copy(c->number, c->times, memory + l->times.at);
    stewart_copy(ROW * c->number, c->reference, memory + l->reference.at);
    stewart_copy(ROW * c->number, c->followed, memory + l->followed.at);
    memory[l->gap.at] = (real)c->gap;
    stewart_copy(X, c->blend.offset, memory + l->blend.at);
    memory[l->blend.at + X] = (real)c->blend.holds;
    memory[l->blend.at + X + 1] = (real)c->blend.samples;
}

/* ---- feedback --------------------------------------------------------------------------------- */

/* Predict state, error and integral to the time at which the next torque begins to act, by the equations of
   motion. The integral is constant in each period in which a motor is at its limit (anti-windup). */
static void predict(const stewart_law *law, const stewart_outlook *outlook, const real *followed,
                    const real *integral, stewart_predicted *a, stewart_scratch scratch)
{
    const stewart_schedule *schedule = &outlook->horizon;
    if (law->design && law->design->predict) {
        law->design->predict(law, outlook, followed, integral, a);
        return;
    }
    real *states = stewart_take(&scratch, X * (schedule->number + 1)), before[6], low[X];
    /* Number of torques of the schedule in each period. */
    const int per_period = outlook->samples > 0 ? schedule->number / outlook->samples : 1;
    stewart_copy(X, outlook->state, states);
    stewart_copy(X, outlook->low, low);
    stewart_copy(6, integral, a->integral);
    for (int i = 0; i < 6; i++)
        before[i] = outlook->state[i] - followed[i];
    if (outlook->fraction == 0 && outlook->predicted && !isnan(outlook->predicted[0]))
        stewart_copy(X * (schedule->number + 1), outlook->predicted, states);
    else
        stewart_predict(&law->machine, outlook->theta, schedule, states, low, states + X);
    for (int k = 0; k < outlook->samples; k++) {
        const real *wanted = followed + ROW * (k + 1), *end = states + X * per_period * (k + 1);
        const int limited = stewart_at_limit(&law->machine, per_period, schedule->torques + U * per_period * k);
        real h = 0;
        for (int i = 0; i < per_period; i++)
            h += schedule->durations[per_period * k + i];
        for (int i = 0; i < 6; i++) {
            real error = end[i] - wanted[i];
            if (!limited)
                a->integral[i] += h / 2 * (before[i] + error);
            before[i] = error;
        }
    }
    stewart_copy(X, states + X * schedule->number, a->state);
    for (int i = 0; i < X; i++)
        a->error[i] = a->state[i] - followed[ROW * outlook->samples + i];
}

int stewart_design_feedback(const stewart_law *law, const stewart_outlook *outlook, const real *theta,
                            const real *nodes, const real *state, const real *weights, real *torques,
                            real *error, real *K, stewart_scratch scratch)
{
    if (law->design && law->design->design)
        return law->design->design(law, outlook, theta, nodes, state, weights, torques, error, K);
    const real h = law->period, fraction = outlook->fraction;
    stewart_feedforward held;
    stewart_hold_feedforward(&law->machine, &law->cost, theta, outlook->pending, nodes, &held);
    stewart_copy(U * (1 + outlook->pending), held.torque[0], torques);
    if (!error)
        return 0;
    real *A = stewart_take(&scratch, X * X), *B = stewart_take(&scratch, X * U);
    const int failure =
        stewart_linearize(&law->machine, theta, h, fraction, state, &held, A, B, error, scratch);
    if (failure || !weights)
        return failure;
    return stewart_gain(&law->cost, h, fraction, A, B, weights, K, scratch);
}

/* Whether the last good gain has n numbers; under another delay it may have more or fewer. */
static int fits(const stewart_field *field, const real *gain, int n)
{
    const int size = field->rows * field->columns;
    return !isnan(gain[0]) && !isnan(gain[n - 1]) && (n == size || isnan(gain[n]));
}

/* Compute the torque by feedback of the predicted error. Returns bits of `stewart_status`. */
static int feed_back(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                     const real *followed, const real *weights, stewart_predicted *a, real *torque,
                     stewart_scratch scratch)
{
    const stewart_layout *l = &law->layout;
    const int pending = outlook->pending, n = U * stewart_order(&law->cost, pending);
    const real *nodes = followed + ROW * (1 + outlook->samples), h = law->period;
    const real *pending_torques = memory + l->in_flight.at + U * (in_flight_length(law) - pending);
    real *error = memory + l->error.at, *integral = memory + l->integral.at;
    real *gain = memory + l->gain.at, *K = stewart_take(&scratch, n);
    real *torques = stewart_take(&scratch, U * (1 + pending));
    const real cautious[2] = {weights[0], weights[1] * outlook->caution};
    const int had_state = stewart_all_finite(X, memory + l->state.at);
    for (int i = 0; i < 6; i++) {
        real now = outlook->state[i] - followed[i];
        if (law->cost.integrates && had_state && !outlook->limited)
            integral[i] += h / 2 * (error[i] + now);
        error[i] = now;
    }
    predict(law, outlook, followed, integral, a, scratch);
    const int failure = stewart_design_feedback(law, outlook, outlook->theta, nodes, a->state, cautious,
                                                torques, a->error, K, scratch);
    stewart_copy(U, torques + U * pending, torque);
    stewart_copy(U, torque, memory + l->feedforward.at);
    if (failure == STEWART_UNREACHABLE) /* no linear model: the feedforward alone */
        return failure;
    if (!failure) {
        stewart_fill(U * l->gain.columns, (real)NAN, gain);
        stewart_copy(n, K, gain);
    }
    if (!fits(&l->gain, gain, n)) /* no usable gain: the feedforward alone */
        return failure;
    a->gain = gain;
    stewart_feed_back(&law->cost, gain, a->error, a->integral, pending, pending_torques, torques, torque);
    return failure;
}

/* ---- a sample --------------------------------------------------------------------------------- */

/* Compute the torque of a sample, with feedback or without. `waiting`: no row of the reference has been
   complete yet. Returns bits of `stewart_status`. */
static int respond(const stewart_law *law, real *memory, const stewart_outlook *outlook,
                   const stewart_course *c, int waiting, const real *weights, stewart_predicted *a, real *torque,
                   stewart_scratch scratch)
{
    const stewart_layout *l = &law->layout;
    const real *nodes = c->followed + ROW * (1 + outlook->samples);
    const int feeds_back = outlook->feeds_back && !is_open_loop(law, memory);
    a->gain = NULL;
    a->theta = feeds_back ? outlook->theta : NULL;
    a->rows = nodes + ROW * 2 * (3 + outlook->pending);
    if (!waiting && feeds_back)
        return feed_back(law, memory, outlook, c->followed, weights, a, torque, scratch);
    if (waiting) { /* hold the last torque */
        a->theta = outlook->theta;
        stewart_copy(U, memory + l->torque.at, torque);
    } else { /* the feedforward, with the parameters known beforehand */
        real *torques = stewart_take(&scratch, U * (1 + outlook->pending));
        stewart_design_feedback(law, outlook, NULL, nodes, NULL, NULL, torques, NULL, NULL, scratch);
        stewart_copy(U, torques + U * outlook->pending, torque);
    }
    stewart_copy(X, nodes - ROW, a->state);
    stewart_fill(X, 0, a->error);
    stewart_fill(6, 0, a->integral);
    stewart_copy(U, torque, memory + l->feedforward.at);
    stewart_fill(6, 0, memory + l->error.at);
    return 0;
}

/* Whether a planner predicts across a known delay, as feedback does. */
static int shares_prediction(const stewart_law *law) { return law->planner && !law->observer->outlook; }

int stewart_step_scratch(const stewart_law *law)
{
    const stewart_channel *channel = law->channel;
    const int queue = law->design ? in_flight_length(law) + law->rows : stewart_queue_length(law);
    const int rows = ROW * law->rows, parts = 2 * queue + 2, most_pending = law->design ? queue : 1;
    /* Each torque of a schedule takes U + 1 numbers, with its duration; a state X more. */
    const int known_delay = 2 * queue + 2 + (U + 1) * (parts + 2); /* of `fixed_delay_outlook` */
    const int lag = (X + U + 1) * 2 * (law->longest_wait + 1); /* of `estimate`: two torques in a period */
    const int course = 2 * rows + X * (queue + 2); /* of `stewart_follow` */
    const int sent = channel ? channel->scratch(law) : 0;
    const int gain = stewart_gain_scratch(&law->cost, law->fraction > 0);
    const int design = stewart_linearize_scratch() + gain;
    const int order = X + 6 + U * most_pending; /* largest `stewart_order`: error, integral, pending torques */
    const int gains = U * (order + 1); /* K, and a torque */
    const int feedback = gains + U * (1 + most_pending) + X * (X + U) + X * (parts + 1) + design;
    const int planner = law->planner ? law->planner->scratch(law) : 0;
    const int part = planner > sent ? planner : sent;
    const int own = feedback > course ? feedback : course;
    const int followed = 3 * rows + law->rows + (own > part ? own : part);
    const int predicted = shares_prediction(law) ? X * (queue + 1) : 0;
    const int observer = law->observer->scratch(law);
    /* `delayed_outlook` takes times and torques of the prediction, and torques of two periods. */
    const int two_periods = 2 * (U + 1) * STEWART_MAX_SCHEDULE;
    const int outlook = law->observer->outlook ? (U + 2) * law->rows + two_periods : known_delay;
    return law->num_values + outlook + lag + predicted +
           (followed > observer ? followed : observer);
}

int stewart_step(const stewart_law *law, real *memory, real *scratch_memory,
                 const stewart_sample *sample, real *torque)
{
    const stewart_layout *l = &law->layout;
    const int length = in_flight_length(law);
    stewart_scratch scratch = {scratch_memory};
    real *in_flight = memory + l->in_flight.at, *sent = memory + l->channel.at;
    stewart_outlook outlook;
    stewart_predicted ahead;
    stewart_course c;
    if (memory[l->started.at] != STEWART_STARTED) {
        stewart_fill(U, 0, torque);
        return STEWART_NOT_STARTED;
    }
    if (law->channel)
        law->channel->update(law, sent, sample->report, in_flight, scratch);
    estimate(law, memory, sample, &outlook, &scratch);
    outlook.predicted = NULL;
    if (shares_prediction(law)) {
        outlook.predicted = stewart_take(&scratch, X * (outlook.until_next.number + 1));
        outlook.predicted[0] = (real)NAN;
    }
    if (law->planner &&
        law->planner->follow(law, memory + l->planner.at, &outlook, sample, scratch)) {
        stewart_fill(6, 0, memory + l->error.at); /* the law follows the prediction: no error remains */
        stewart_fill(6, 0, memory + l->integral.at);
    }
    follow(law, memory, sample, &outlook, &c, &scratch);
    int status = outlook.status | (c.missing ? STEWART_REFERENCE_MISSING : 0);
    const real *nodes = c.followed + ROW * (1 + outlook.samples);
    const int waiting = !stewart_all_finite(ROW * 2 * (3 + outlook.pending), nodes);
    /* A reference with filled-in numbers ends the open-loop start: its torques were computed for another
       reference. */
    if (c.missing && !c.gap && !waiting)
        memory[l->open_loop_samples.at] = 0;
    if (!stewart_all_finite(X, outlook.state)) { /* no measurement yet: assume the reference */
        stewart_copy(X, c.followed, outlook.state);
        if (law->longest_wait == 0) /* then the observer's state is the present one */
            stewart_copy(X, outlook.state, memory + l->observer.at);
    }
    status |= respond(law, memory, &outlook, &c, waiting, sample->weights, &ahead, torque, scratch);
    if (!stewart_all_finite(U, torque)) {
        status |= STEWART_NONFINITE_TORQUE;
        stewart_copy(U, memory + l->torque.at, torque);
    }
    if (stewart_limit(&law->machine, torque, ahead.limited))
        status |= STEWART_SATURATED;
    if (law->channel)
        law->channel->send(law, sent, &outlook, &ahead, in_flight, scratch);
    memmove(in_flight, in_flight + U, (size_t)(U * (length - 1)) * sizeof(real));
    stewart_copy(U, ahead.limited, in_flight + U * (length - 1));
    remember_course(law, memory, &c);
    stewart_copy(X, outlook.state, memory + l->state.at);
    stewart_copy(law->machine.estimated, outlook.theta, memory + l->parameters.at);
    stewart_copy(U, torque, memory + l->torque.at);
    stewart_copy(law->num_values, sample->measurement, memory + l->measurement.at);
    stewart_copy(2, sample->weights, memory + l->weights.at);
    if (memory[l->open_loop_samples.at] > 0 && !waiting)
        memory[l->open_loop_samples.at] -= 1;
    for (int i = 0; i < STEWART_CAUSES; i++)
        stewart_count(status >> i & 1, memory + l->counts.at + i);
    return status;
}
