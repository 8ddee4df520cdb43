/* See delay_observer.h. The memory has what is believed of the delay, the last measurement (of the sample
   alone), and the state that stands for one before there is any. */

#include <stdint.h>

#include "delay_observer.h"

#define X STEWART_STATES
#define U STEWART_MOTORS
#define LEGS 6
#define CAUSES_AT 3 /* a cause of stewart_sensing is so many bits further to the left in a status */

static int estimated(const stewart_law *law) { return law->machine.estimated; }

static int flights_of(const stewart_law *law) { return 1 + law->kept + stewart_queue_length(law); }

/* Values of a sample alone. */
static int size_of(const stewart_law *law)
{
    const stewart_delay_settings *settings = law->estimation;
    return settings->encoders ? LEGS : X;
}

static int believed_numbers(const stewart_law *law)
{
    return stewart_delay_size(estimated(law), size_of(law), flights_of(law));
}

static int delay_memory(const stewart_law *law) { return believed_numbers(law) + size_of(law) + X; }

static int delay_scratch(const stewart_law *law)
{
    return stewart_delay_scratch(estimated(law), size_of(law), flights_of(law)) + size_of(law);
}

/* Arrivals as they are believed at the last sample. */
static stewart_arrivals arrivals_of(const stewart_law *law, const real *memory)
{
    const stewart_delay_memory *m = (const stewart_delay_memory *)memory;
    const int flights = flights_of(law);
    return (stewart_arrivals){law->period, m->eta, m->rate, (int)m->sent,
                              flights > 1 ? flights - 1 : 1, m->numbers};
}

/* What a hypothesis needs, in one place because its parts point to each other. */
typedef struct {
    stewart_delay delay;
    stewart_sensing sensing;
    stewart_encoders newest;
} searching;

static void prepare(const stewart_law *law, searching *s)
{
    const stewart_delay_settings *settings = law->estimation;
    s->delay = settings->delay;
    s->delay.machine = &law->machine;
    if (settings->encoders) {
        s->newest = *(const stewart_encoders *)law->sensing;
        s->newest.samples = s->newest.nodes = 1;
        s->sensing = stewart_encoder_sensing(&s->newest);
    } else {
        s->sensing = stewart_state_sensing(law->sensing);
    }
    s->delay.sensing = &s->sensing;
}

static void delay_start(const stewart_law *law, real *memory)
{
    searching s;
    prepare(law, &s);
    stewart_fill(delay_memory(law), (real)NAN, memory);
    stewart_delay_start(&s.delay, flights_of(law), (stewart_delay_memory *)memory);
}

static int delay_observe(const stewart_law *law, real *memory, int number, const real *torques,
                         const real *values, stewart_scratch scratch)
{
    const int m = size_of(law);
    const real *now = values + law->measured - m;
    real *last = memory + believed_numbers(law), *state = last + m;
    stewart_delay_memory *believed = (stewart_delay_memory *)memory;
    searching s;
    prepare(law, &s);
    const stewart_delay_settings *settings = law->estimation;
    int fault = settings->encoders
                    ? stewart_encoder_fault(&s.newest, now)
                    : stewart_state_fault(law->sensing, law->machine.geometry, law->period, now, last);
    if (!fault && !stewart_all_finite(m, now))
        fault = STEWART_MISSING;
    for (int i = 0; i < m; i++)
        if (isfinite(now[i]))
            last[i] = now[i];
    stewart_delay_observe(&s.delay, number, torques, fault ? NULL : now, state, believed, scratch);
    if (believed->known > 0)
        stewart_copy(X, stewart_delay_guess(estimated(law), m, flights_of(law), believed,
                                            (int)believed->best)->numbers, state);
    return believed->rejected > 0 ? STEWART_MEASUREMENT_REJECTED : fault << CAUSES_AT;
}

static const stewart_guess *best_of(const stewart_law *law, const real *memory)
{
    stewart_delay_memory *m = (stewart_delay_memory *)(uintptr_t)memory;
    return stewart_delay_guess(estimated(law), size_of(law), flights_of(law), m, (int)m->best);
}

static void delay_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    const stewart_delay_settings *settings = law->estimation;
    const int n = X + estimated(law) + 2;
    stewart_copy(estimated(law), settings->delay.prior, theta);
    stewart_fill(estimated(law), (real)NAN, std);
    if (!(((const stewart_delay_memory *)memory)->known > 0))
        return;
    const real *mean = best_of(law, memory)->numbers, *row = mean + n; /* lower triangle, by rows */
    stewart_copy(estimated(law), mean + X, theta);
    for (int i = 0; i < X + estimated(law); row += ++i) {
        real sum = 0;
        for (int j = 0; j <= i; j++)
            sum += row[j] * row[j];
        if (i >= X)
            std[i - X] = REAL(sqrt)(sum);
    }
}

static void delay_tell(const stewart_law *law, const real *memory, int number, const real *torques,
                       stewart_told *told, stewart_scratch *scratch)
{
    const stewart_delay_settings *settings = law->estimation;
    const stewart_delay_memory *m = (const stewart_delay_memory *)memory;
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    const int most = settings->most;
    real *acting = stewart_take(scratch, U * most), *durations = stewart_take(scratch, most);
    real *times = stewart_take(scratch, most);
    stewart_copy(X, memory + believed_numbers(law) + size_of(law), told->state);
    real std[STEWART_MAX_ESTIMATED];
    delay_parameters(law, memory, told->theta, std);
    told->feeds_back = m->feeds_back > 0;
    told->settled = m->settled > 0;
    told->found = m->found > 0;
    told->caution = m->caution;
    told->eta = m->eta * (1 + m->rate);
    told->fraction = 0;
    told->pending = 0;
    const int pieces = stewart_within(&arrivals, number, torques, 0, told->eta, -1, acting, durations);
    told->until = told->horizon = (stewart_acting){pieces, acting, durations, 0};
    told->samples = stewart_switches(&arrivals, 0, told->eta, -1, times);
    times[told->samples++] = told->eta;
    told->times = times;
    stewart_acting last;
    law->observer->last_period(law, memory, number, torques, &last, NULL, scratch);
    told->limited = stewart_at_limit(&law->machine, last.number, last.torques);
}

static void delay_last_period(const stewart_law *law, const real *memory, int number,
                              const real *torques, stewart_acting *acting, const real **following,
                              stewart_scratch *scratch)
{
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    real *each = stewart_take(scratch, U * STEWART_MOST_ACTING);
    real *durations = stewart_take(scratch, STEWART_MOST_ACTING);
    const int pieces = stewart_within(&arrivals, number, torques, -law->period, 0, -1, each, durations);
    *acting = (stewart_acting){pieces, each, durations, 0};
    if (following) {
        real *next = stewart_take(scratch, U * STEWART_MOST_ACTING), *h = stewart_take(scratch, STEWART_MOST_ACTING);
        stewart_within(&arrivals, number, torques, 0, law->period, -1, next, h);
        *following = next;
    }
}

static void delay_assume(const stewart_law *law, real *memory, const real *state)
{
    stewart_copy(X, state, memory + believed_numbers(law) + size_of(law));
}

static void delay_restart(const stewart_law *law, real *memory) { delay_start(law, memory); }

const stewart_observer stewart_delay_observer = {
    delay_memory, delay_scratch, delay_start,      delay_observe,     delay_tell,
    delay_assume, delay_restart, delay_parameters, delay_last_period, 0,
};
