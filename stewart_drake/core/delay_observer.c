/* The observer of an unknown delay. Its memory has the state, the belief about the delay, and the last measurement
   (of one sample). */

#include <stdint.h>

#include "delay.h"
#include "law.h"
#include "short.h"

typedef struct {
    stewart_delay delay; /* with machine and sensing */
    stewart_sensing sensing;
    int p, m, num_in_flight, numbers; /* parameters, values, torques in flight, numbers of the belief */
} Sizes;

static void sizes_of(const stewart_law *law, Sizes *s)
{
    s->delay = ((const stewart_delay_settings *)law->estimation)->delay;
    s->sensing = stewart_sensing_of(law);
    s->delay.filter.machine = &law->machine;
    s->delay.filter.sensing = &s->sensing;
    s->p = law->machine.estimated;
    s->m = s->sensing.size;
    s->num_in_flight = 1 + law->extra_torques + stewart_queue_length(law);
    s->numbers = stewart_delay_size(s->p, s->m, s->num_in_flight);
}

static int delayed_memory(const stewart_law *law)
{
    Sizes s;
    sizes_of(law, &s);
    return s.numbers + s.m + X;
}

static int delayed_scratch(const stewart_law *law)
{
    Sizes s;
    sizes_of(law, &s);
    return stewart_delay_scratch(s.p, s.m, s.num_in_flight) + s.m;
}

/* Arrivals as estimated at the last sample. */
static stewart_arrivals arrivals_of(const stewart_law *law, const real *memory)
{
    const stewart_delay_memory *m = (const stewart_delay_memory *)(memory + X);
    Sizes s;
    sizes_of(law, &s);
    return (stewart_arrivals){law->period, m->eta, m->rate, m->num_own > 0 ? (int)m->num_own : 0,
                              s.num_in_flight > 1 ? s.num_in_flight - 1 : 1, m->numbers};
}

static void delayed_start(const stewart_law *law, real *memory)
{
    Sizes s;
    sizes_of(law, &s);
    stewart_fill(s.numbers + s.m + X, (real)NAN, memory);
    stewart_delay_start(&s.delay, s.num_in_flight, (stewart_delay_memory *)(memory + X));
}

/* The most probable hypothesis; NULL before the first measurement. Only read: the cast removes const. */
static const stewart_hypothesis *best_of(const Sizes *s, const real *memory)
{
    stewart_delay_memory *m = (stewart_delay_memory *)(uintptr_t)(memory + X);
    if (!(m->known > 0))
        return NULL;
    return stewart_delay_hypothesis(s->p, s->m, s->num_in_flight, m, (int)m->best);
}

static int delayed_observe(const stewart_law *law, real *memory, int number, const real *torques,
                           const real *values, stewart_scratch scratch)
{
    Sizes s;
    sizes_of(law, &s);
    real *state = memory, *last = memory + X + s.numbers;
    stewart_delay_memory *delay = (stewart_delay_memory *)(memory + X);
    values += law->num_values - s.m;
    int fault = s.sensing.fault(&s.sensing, law->machine.geometry, law->period, values, last);
    if (!fault && !stewart_all_finite(s.m, values))
        fault = STEWART_MISSING;
    for (int i = 0; i < s.m; i++)
        if (isfinite(values[i]))
            last[i] = values[i];
    stewart_delay_observe(&s.delay, number, torques, fault ? NULL : values, state, delay, scratch);
    const stewart_hypothesis *best = best_of(&s, memory);
    if (best)
        stewart_copy(X, best->numbers, state);
    return delay->rejected > 0 ? STEWART_MEASUREMENT_REJECTED : fault << STEWART_CAUSES_AT;
}

static void delayed_parameters(const stewart_law *law, const real *memory, real *theta, real *std)
{
    Sizes s;
    sizes_of(law, &s);
    const stewart_hypothesis *best = best_of(&s, memory);
    stewart_copy(s.p, best ? best->numbers + X : s.delay.prior, theta);
    stewart_fill(s.p, (real)NAN, std);
    for (int i = 0; best && i < s.p; i++)
        std[i] = stewart_packed_std(X + i, best->numbers + X + s.p + 2);
}

static real delayed_uncertainty(const stewart_law *law, const real *memory, real *L)
{
    Sizes s;
    sizes_of(law, &s);
    const int n = X + s.p;
    const stewart_hypothesis *best = best_of(&s, memory);
    if (L && best)
        stewart_unpack_root(n, best->numbers + n + 2, L); /* without the last two rows, of the delay */
    else if (L)
        stewart_fill(n * n, (real)NAN, L);
    return best ? REAL(sqrt)(best->timing) : 0;
}

static void delayed_last_period(const stewart_law *law, const real *memory, int number,
                                const real *torques, stewart_schedule *schedule,
                                const real **following, stewart_scratch *scratch)
{
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    const real begins[2] = {-law->period, 0};
    for (int i = 0; i < 1 + (following != NULL); i++) {
        real *each = stewart_take(scratch, U * STEWART_MAX_SCHEDULE);
        real *durations = stewart_take(scratch, STEWART_MAX_SCHEDULE);
        const int pieces = stewart_torque_schedule(&arrivals, number, torques, begins[i],
                                                   begins[i] + law->period, -1, each, durations);
        if (i == 0)
            *schedule = (stewart_schedule){pieces, each, durations, 0};
        else
            *following = each;
    }
}

static void delayed_outlook(const stewart_law *law, const real *memory, int number,
                            const real *torques, stewart_outlook *outlook, stewart_scratch *scratch)
{
    const stewart_delay_memory *m = (const stewart_delay_memory *)(memory + X);
    const stewart_arrivals arrivals = arrivals_of(law, memory);
    const int most = ((const stewart_delay_settings *)law->estimation)->most;
    real *each = stewart_take(scratch, U * most), *durations = stewart_take(scratch, most);
    real *times = stewart_take(scratch, most);
    outlook->feeds_back = m->feeds_back > 0;
    outlook->settled = m->settled > 0;
    outlook->found = m->found > 0;
    outlook->caution = m->caution;
    outlook->eta = m->eta * (1 + m->rate);
    outlook->fraction = 0;
    outlook->pending = 0;
    const int pieces = stewart_torque_schedule(&arrivals, number, torques, 0, outlook->eta, -1, each,
                                               durations);
    outlook->until_next = outlook->horizon = (stewart_schedule){pieces, each, durations, 0};
    outlook->samples = stewart_switch_times(&arrivals, 0, outlook->eta, -1, times);
    times[outlook->samples++] = outlook->eta;
    outlook->times = times;
    stewart_schedule last;
    delayed_last_period(law, memory, number, torques, &last, NULL, scratch);
    outlook->limited = stewart_at_limit(&law->machine, last.number, last.torques);
}

const stewart_observer stewart_delay_observer = {
    delayed_memory, delayed_scratch,    delayed_start,   delayed_observe,
    delayed_start,  delayed_parameters, delayed_outlook, delayed_last_period,
    delayed_uncertainty, NULL,
};
