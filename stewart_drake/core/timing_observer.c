/* See observers.h.

   A torque that changes by D and comes delta late moves the rates at the next sample by
   r = -M^-1 B D delta. With T(x, a) the inverse dynamics at accelerations a, the impulse of the motors
   that corresponds to the observed r is u = dt (T(x, r / dt) - T(x, 0)) = -D delta. Unknown bias, payload
   and friction change u slowly, so its second difference w = u_k - 2 u_{k-1} + u_{k-2} is used. Timing
   errors of variance sigma^2 give w the variance c |D|^2 sigma^2 along D, and none across D. The mean square
   across D, per direction, is other noise and is subtracted:

       sigma^2 = sum((D.w)^2 - |D|^2 |w_across|^2 / 5) / sum(c |D|^4).

   c = 1 + 4 + 1 for torques that change within a period. Where they change at the samples, a late one moves
   the rates of the sample after it and an early one those of the sample before. Either is half a normal
   deviate, of mean +-sigma / sqrt(2 pi) and variance sigma^2 (1/2 - 1/(2 pi)), so that u has the variance
   1 - 1/pi and the covariance 1/(2 pi) with the one before: c = 6 (1 - 1/pi) - 8 / (2 pi). */

#include "observers.h"
#include "short.h"

#define VARIANCE_WITHIN ((real)6) /* c, for torques that change within a period */
#define VARIANCE_AT_SAMPLES ((real)2.8169011381620934) /* c, for torques that change at the samples */
#define FORGETTING ((real)0.9) /* factor on both sums per period */
#define LARGEST_FORGETTING ((real)0.98) /* the same, on the largest term of `weight` */
#define LEAST_WEIGHT ((real)1) /* of `weight`, in largest terms: small changes are noisy */

typedef struct {
    real impulses[2 * U]; /* u at the last two samples, the newest first; NaN without */
    real change[U];       /* D at the last sample; NaN without */
    real excess, weight;  /* numerator and denominator of sigma^2 */
    real largest;         /* term of `weight`, which decays slowly */
} Timing;

enum { TIMING_NUMBERS = sizeof(Timing) / sizeof(real) };

static int timing_memory(const stewart_law *law) { return stewart_plain_memory(law) + TIMING_NUMBERS; }

static Timing *timing_of(const stewart_law *law, real *memory)
{
    return (Timing *)(memory + stewart_plain_memory(law));
}

/* Forget the last samples, not the sums. */
static void forget(Timing *timing)
{
    stewart_fill(2 * U, (real)NAN, timing->impulses);
    stewart_fill(U, (real)NAN, timing->change);
}

static void timing_start(const stewart_law *law, real *memory)
{
    Timing *timing = timing_of(law, memory);
    stewart_plain_start(law, memory);
    forget(timing);
    timing->excess = timing->weight = timing->largest = 0;
}

static void timing_restart(const stewart_law *law, real *memory)
{
    stewart_plain_restart(law, memory);
    forget(timing_of(law, memory));
}

/* Compute the impulse u (6) from the predicted to the measured state. */
static void impulse_between(const stewart_law *law, const real *predicted, const real *measured, real *u)
{
    stewart_model model;
    real row[ROW], unaccelerated[U];
    stewart_set_model(&law->machine, NULL, &model);
    stewart_copy(X, measured, row);
    stewart_fill(6, 0, row + X);
    stewart_required_torque(&model, row, unaccelerated);
    for (int i = 0; i < 6; i++)
        row[X + i] = (measured[6 + i] - predicted[6 + i]) / law->period;
    stewart_required_torque(&model, row, u);
    for (int i = 0; i < U; i++)
        u[i] = law->period * (u[i] - unaccelerated[i]);
}

static void learn(Timing *timing, const real *u, const real *D, real c)
{
    real along = 0, square = 0, all = 0;
    for (int i = 0; i < U; i++) {
        const real w = u[i] - 2 * timing->impulses[i] + timing->impulses[U + i];
        along += D[i] * w;
        square += D[i] * D[i];
        all += w * w;
    }
    if (!(square > 0) || !isfinite(along)) /* or NaN */
        return;
    const real across = (all - along * along / square) / (U - 1), weight = c * square * square;
    timing->excess = FORGETTING * timing->excess + along * along - square * across;
    timing->weight = FORGETTING * timing->weight + weight;
    timing->largest = REAL(fmax)(LARGEST_FORGETTING * timing->largest, weight);
}

static int timing_observe(const stewart_law *law, real *memory, int number, const real *torques,
                          const real *values, stewart_scratch scratch)
{
    Timing *timing = timing_of(law, memory);
    real predicted[X], u[U], D[U];
    stewart_copy(X, memory, predicted);
    const int status = stewart_state_observer.observe(law, memory, number, torques, values, scratch);
    if (status || !stewart_all_finite(X, predicted) || !stewart_all_finite(X, memory)) {
        forget(timing);
        return status;
    }
    const stewart_interval period = stewart_last_periods(law, number, torques, 1, &scratch);
    const stewart_schedule *schedule = &period.schedule;
    stewart_predict_nominal(law, number, torques, predicted, scratch);
    impulse_between(law, predicted, memory, u);
    const int within = schedule->number > 1;
    const real *first = schedule->torques;
    const real *last = within ? first + U * (schedule->number - 1) : period.following;
    for (int i = 0; i < U; i++) {
        const real change = last[i] - first[i];
        D[i] = within ? change : (change + timing->change[i]) / 2;
        timing->change[i] = change;
    }
    learn(timing, u, D, within ? VARIANCE_WITHIN : VARIANCE_AT_SAMPLES);
    stewart_copy(U, timing->impulses, timing->impulses + U);
    stewart_copy(U, u, timing->impulses);
    return status;
}

static int timing_scratch(const stewart_law *law)
{
    return stewart_state_observer.scratch(law) + stewart_nominal_scratch(law);
}

static real timing_uncertainty(const stewart_law *law, const real *memory, real *L)
{
    const Timing *timing = (const Timing *)(memory + stewart_plain_memory(law));
    const int n = X + law->machine.estimated;
    if (L)
        stewart_fill(n * n, 0, L);
    const real weight = REAL(fmax)(timing->weight, LEAST_WEIGHT * timing->largest);
    return timing->excess > 0 ? REAL(sqrt)(timing->excess / weight) : 0;
}

const stewart_observer stewart_timing_observer = {
    timing_memory,  timing_scratch,           timing_start, timing_observe,
    timing_restart, stewart_plain_parameters, NULL,         NULL,
    timing_uncertainty, NULL,
};
