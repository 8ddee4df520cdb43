/* See delay_observer.h. The memory has what is believed of the delay, the last measurement (of the sample
   alone), and the state that stands for one before there is any. */

#include <stdint.h>

#include "delay_observing.h"

#define X STEWART_STATES
#define U STEWART_MOTORS
#define CAUSES_AT 3 /* a cause of stewart_sensing is so many bits further to the left in a status */

static int estimated(const stewart_law *law) { return law->machine.estimated; }

static int flights_of(const stewart_law *law) { return 1 + law->kept + stewart_queue_length(law); }

/* Values of a sample alone. */
static int size_of(const stewart_law *law)
{
    const stewart_delay_settings *settings = law->estimation;
    return settings->values;
}

static int believed_numbers(const stewart_law *law)
{
    return stewart_delay_size(estimated(law), size_of(law), flights_of(law));
}

int stewart_delayed_memory(const stewart_law *law) { return believed_numbers(law) + size_of(law) + X; }

int stewart_delayed_scratch(const stewart_law *law)
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

static stewart_delay delay_of(const stewart_law *law, const stewart_sensing *sensing)
{
    const stewart_delay_settings *settings = law->estimation;
    stewart_delay delay = settings->delay;
    delay.machine = &law->machine;
    delay.sensing = sensing;
    return delay;
}

void stewart_delayed_start(const stewart_law *law, const stewart_sensing *sensing, real *memory)
{
    const stewart_delay delay = delay_of(law, sensing);
    stewart_fill(stewart_delayed_memory(law), (real)NAN, memory);
    stewart_delay_start(&delay, flights_of(law), (stewart_delay_memory *)memory);
}

real *stewart_delayed_last(const stewart_law *law, real *memory)
{
    return memory + believed_numbers(law);
}

int stewart_delayed_observe(const stewart_law *law, const stewart_sensing *sensing, int fault,
                            real *memory, int number, const real *torques, const real *values,
                            stewart_scratch scratch)
{
    const int m = sensing->size;
    real *last = stewart_delayed_last(law, memory), *state = last + m;
    stewart_delay_memory *believed = (stewart_delay_memory *)memory;
    const stewart_delay delay = delay_of(law, sensing);
    if (!fault && !stewart_all_finite(m, values))
        fault = STEWART_MISSING;
    for (int i = 0; i < m; i++)
        if (isfinite(values[i]))
            last[i] = values[i];
    stewart_delay_observe(&delay, number, torques, fault ? NULL : values, state, believed, scratch);
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

void stewart_delayed_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
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

void stewart_delayed_tell(const stewart_law *law, const real *memory, int number,
                          const real *torques, stewart_outlook *outlook, stewart_scratch *scratch)
{
    const stewart_delay_settings *settings = law->estimation;
    const stewart_delay_memory *m = (const stewart_delay_memory *)memory;
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    const int most = settings->most;
    real *each = stewart_take(scratch, U * most), *durations = stewart_take(scratch, most);
    real *times = stewart_take(scratch, most);
    stewart_copy(X, memory + believed_numbers(law) + size_of(law), outlook->state);
    real std[STEWART_MAX_ESTIMATED];
    stewart_delayed_parameters(law, memory, outlook->theta, std);
    outlook->feeds_back = m->feeds_back > 0;
    outlook->settled = m->settled > 0;
    outlook->found = m->found > 0;
    outlook->caution = m->caution;
    outlook->eta = m->eta * (1 + m->rate);
    outlook->fraction = 0;
    outlook->pending = 0;
    const int pieces = stewart_within(&arrivals, number, torques, 0, outlook->eta, -1, each, durations);
    outlook->until = outlook->horizon = (stewart_schedule){pieces, each, durations, 0};
    outlook->samples = stewart_switches(&arrivals, 0, outlook->eta, -1, times);
    times[outlook->samples++] = outlook->eta;
    outlook->times = times;
    stewart_schedule last;
    law->observer->last_period(law, memory, number, torques, &last, NULL, scratch);
    outlook->limited = stewart_at_limit(&law->machine, last.number, last.torques);
}

void stewart_delayed_last_period(const stewart_law *law, const real *memory, int number,
                                 const real *torques, stewart_schedule *schedule,
                                 const real **following, stewart_scratch *scratch)
{
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    real *each = stewart_take(scratch, U * STEWART_MAX_SCHEDULE);
    real *durations = stewart_take(scratch, STEWART_MAX_SCHEDULE);
    const int pieces = stewart_within(&arrivals, number, torques, -law->period, 0, -1, each, durations);
    *schedule = (stewart_schedule){pieces, each, durations, 0};
    if (following) {
        real *next = stewart_take(scratch, U * STEWART_MAX_SCHEDULE), *h = stewart_take(scratch, STEWART_MAX_SCHEDULE);
        stewart_within(&arrivals, number, torques, 0, law->period, -1, next, h);
        *following = next;
    }
}

void stewart_delayed_assume(const stewart_law *law, real *memory, const real *state)
{
    stewart_copy(X, state, memory + believed_numbers(law) + size_of(law));
}

/* ---- of the measured state ----------------------------------------------------------------------- */

static void start(const stewart_law *law, real *memory)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    stewart_delayed_start(law, &sensing, memory);
}

static int observe(const stewart_law *law, real *memory, int number, const real *torques,
                   const real *values, stewart_scratch scratch)
{
    const stewart_sensing sensing = stewart_sensing_of(law);
    const real *last = stewart_delayed_last(law, memory);
    const int fault = sensing.fault(&sensing, law->machine.geometry, law->period, values, last);
    return stewart_delayed_observe(law, &sensing, fault, memory, number, torques, values, scratch);
}

const stewart_observer stewart_delay_observer = {
    stewart_delayed_memory, stewart_delayed_scratch,    start,
    observe,                stewart_delayed_tell,       stewart_delayed_assume,
    start,                  stewart_delayed_parameters, stewart_delayed_last_period,
    0,
};
