/* The measured state as it comes, and the timing of torques from one-step predictions: see observers.h.

   With measured states y_{k-1} and y_k of noise R, nu = y_k - f(y_{k-1}) has the variances

       S = R + [1 dt; 0 1] R [1 dt; 0 1]' + Q + t K,

   to first order in the period dt; noise.h learns t. */

#include "noise.h"
#include "observers.h"
#include "short.h"

/* That of the plain observer, then the noise. */
static int timing_memory(const stewart_law *law) { return stewart_plain_memory(law) + STEWART_NOISE; }

static stewart_noise *noise_of(const stewart_law *law, real *memory)
{
    return (stewart_noise *)(memory + stewart_plain_memory(law));
}

static void timing_start(const stewart_law *law, real *memory)
{
    stewart_plain_start(law, memory);
    stewart_noise_start(noise_of(law, memory));
}

static int timing_observe(const stewart_law *law, real *memory, int number, const real *torques,
                          const real *values, stewart_scratch scratch)
{
    const stewart_timing_settings *settings = law->estimation;
    const real dt = law->period;
    const real *noise = ((const stewart_state_sensor *)law->sensing)->noise_std;
    real before[X], kicks[X], nu[X], S[X];
    stewart_copy(X, memory, before);
    const int status = stewart_state_observer.observe(law, memory, number, torques, values, scratch);
    if (status || !stewart_all_finite(X, before) || !stewart_all_finite(X, memory))
        return status;
    stewart_schedule schedule;
    const real *following;
    stewart_last_periods(law, number, torques, 1, &schedule, &following, &scratch);
    real *states = stewart_take(&scratch, X * schedule.number), *H = stewart_take(&scratch, X * X);
    const real *end = states + X * (schedule.number - 1);
    stewart_predict(&law->machine, NULL, &schedule, before, states);
    stewart_kicks(&law->machine, &schedule, following, end, NULL, kicks);
    stewart_fill(X * X, 0, H);
    stewart_noise *learnt = noise_of(law, memory);
    for (int i = 0; i < X; i++) {
        const real own = noise[i] * noise[i], rate = i < 6 ? dt * noise[6 + i] : 0;
        H[(X + 1) * i] = 1;
        nu[i] = memory[i] - end[i];
        kicks[i] *= settings->timing_std * settings->timing_std;
        S[i] = 2 * own + rate * rate + settings->model_std[i] * settings->model_std[i]
            + learnt->timing * kicks[i];
    }
    stewart_noise_learn(X, nu, S, H, kicks, 0, NULL, NULL, settings->keep, learnt);
    return status;
}

static int timing_scratch(const stewart_law *law)
{
    const int parts = law->parts > 0 ? law->parts * STEWART_REPORTED : 2;
    return stewart_state_observer.scratch(law) + 2 * X * X + (X + U + 1) * (parts + 2);
}

static real uncertainty(const stewart_law *law, const real *memory, real *L)
{
    const stewart_timing_settings *settings = law->estimation;
    const int n = X + law->machine.estimated;
    if (L)
        stewart_fill(n * n, 0, L);
    const stewart_noise *noise = (const stewart_noise *)(memory + stewart_plain_memory(law));
    return REAL(sqrt)(noise->timing) * settings->timing_std;
}

const stewart_observer stewart_timing_observer = {
    timing_memory,         timing_scratch,           timing_start,          timing_observe,
    stewart_plain_restart, stewart_plain_parameters, stewart_state_sensing, NULL, NULL,
    uncertainty,
};
