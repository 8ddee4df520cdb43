#include "arrivals.h"
#include "short.h"

#define FURTHEST ((real)1e3) /* s, up to which periods are counted */

static real arrival(const stewart_arrivals *a, int i)
{
    return ((real)i * a->period + a->eta) * (1 + a->rate);
}

static int periods(const stewart_arrivals *a, real end)
{
    if (!(end > 0))
        return 0;
    return (int)((end < FURTHEST ? end : FURTHEST) / a->period);
}

int stewart_max_torques(const stewart_arrivals *a, real end)
{
    return 1 + periods(a, end) + a->num_own;
}

int stewart_switch_times(const stewart_arrivals *a, real begin, real end, int newest, real *at)
{
    const real first = a->num_own > 0 ? arrival(a, newest + 1 - a->num_own) : (real)INFINITY;
    const int grid = periods(a, end);
    int number = 0;
    for (int k = 1; k <= grid + a->num_own; k++) {
        const int own = k - grid;
        const real t = own > 0 ? arrival(a, newest + own - a->num_own) : a->period * (real)k;
        const int acts = own > 0 || t < first - STEWART_TIME_TOLERANCE;
        if (acts && t > begin + STEWART_TIME_TOLERANCE && t < end - STEWART_TIME_TOLERANCE)
            at[number++] = t;
    }
    return number;
}

int stewart_torque_schedule(const stewart_arrivals *a, int num_in_flight, const real *in_flight, real begin,
                            real end, int newest, real *torques, real *durations)
{
    const int number = 1 + stewart_switch_times(a, begin, end, newest, durations + 1);
    static const real none[U];
    int own = 0; /* controller's torques that have arrived */
    durations[0] = begin;
    for (int k = 0; k < number; k++) {
        const real start = durations[k], *torque;
        while (own < a->num_own && arrival(a, newest + 1 + own - a->num_own) <= start + STEWART_TIME_TOLERANCE)
            own++;
        if (own > 0) {
            torque = in_flight + U * (num_in_flight - a->num_own + own - 1);
        } else {
            const real passed = REAL(floor)(start / a->period + STEWART_TIME_TOLERANCE / a->period);
            const int last = a->num_others - 1;
            const int period = !(passed > 0) ? 0 : passed < (real)last ? (int)passed : last;
            torque = last < 0 ? none : a->other_torques + U * period;
        }
        stewart_copy(U, torque, torques + U * k);
        durations[k] = (k + 1 < number ? durations[k + 1] : end) - start;
    }
    return number;
}
