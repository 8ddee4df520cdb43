/* Torque schedules under a known delay, the limit of the motors, and what laws remember. See law.h. */

#include "law.h"
#include "short.h"

int stewart_queue_length(const stewart_law *law) { return law->steps + (law->fraction > 0); }

stewart_sensing stewart_sensing_of(const stewart_law *law)
{
    return law->own_sensing ? *law->own_sensing : law->make_sensing(law->sensing);
}

int stewart_limit(const stewart_machine *machine, const real *torque, real *limited)
{
    const real most = machine->torque_limit;
    int saturated = 0;
    if (machine->own)
        return machine->own->limit(machine, torque, limited);
    for (int i = 0; i < U; i++) {
        limited[i] = clamped(-most, torque[i], most);
        saturated |= limited[i] != torque[i];
    }
    return saturated;
}

stewart_field stewart_place(stewart_law *law, int rows, int columns)
{
    stewart_field field = {law->memory, rows, columns};
    law->memory += rows * columns;
    return field;
}

void stewart_count(int number, real *count)
{
    if (*count < (real)1e6)
        *count += (real)number;
}

/* With a fraction each torque acts for the end of one period and the beginning of the next. */
stewart_schedule stewart_schedule_of(real period, real fraction, int periods, const real *torques,
                                     stewart_scratch *scratch)
{
    const int parts = 1 + (fraction > 0), number = parts * periods;
    real *durations = stewart_take(scratch, number), *each = stewart_take(scratch, U * number);
    for (int i = 0; i < number; i++) {
        const real split = i % 2 ? 1 - fraction : fraction;
        durations[i] = (parts == 1 ? 1 : split) * period;
        stewart_copy(U, torques + U * (parts == 1 ? i : (i + 1) / 2), each + U * i);
    }
    stewart_schedule schedule = {number, each, durations, 0};
    return schedule;
}

int stewart_most_acting(const stewart_law *law)
{
    return law->parts > 0 ? law->parts * STEWART_REPORTED : 2;
}

stewart_interval stewart_last_periods(const stewart_law *law, int number, const real *torques, int periods,
                                      stewart_scratch *scratch)
{
    const int queue = stewart_queue_length(law);
    const real *first = torques + U * (number - queue - periods);
    if (law->parts > 0) { /* the motors decide the next torque: assume no change */
        real *durations = stewart_take(scratch, number);
        stewart_fill(number, law->period / (real)law->parts, durations);
        return (stewart_interval){{number, torques, durations, 0}, torques, torques + U * (number - 1)};
    }
    /* Without a delay the next torque is not computed yet; the one before may not be remembered. */
    const real *before = first > torques ? first - U : first;
    const real *after = first + U * (queue > 0 ? periods : periods - 1);
    return (stewart_interval){stewart_schedule_of(law->period, law->fraction, periods, first, scratch),
                              before, after};
}

void stewart_given_rows(void *context, int number, const real *times, real *rows)
{
    (void)times;
    stewart_copy(STEWART_REFERENCE * number, context, rows);
}
