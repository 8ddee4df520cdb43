/* See noise.h. */

#include "noise.h"
#include "short.h"

#define ONE_TORQUE ((real)0.5) /* information of one torque at t = 1: 1 / (2 t^2) */
#define SURE ((real)2.5) /* standard deviations of w by which it must exceed 0 */
#define LATENESS_SURE ((real)3.5) /* the same of l: friction is taken for a little of it */
#define WIDER 12         /* factor on that excess: W is the change in one period, an effect lasts for many */
#define ODD 3       /* largest nu_i^2 / S_ii - 1 in the slope of w */
#define LATEST 1000 /* largest t */
#define UNTIMELY 4  /* t of torques that are off by twice the assumed standard deviation */

void stewart_noise_start(stewart_noise *noise)
{
    *noise = (stewart_noise){.timing = 1};
}

real stewart_timing_scatter(const stewart_noise *noise)
{
    const real mean = REAL(fabs)(noise->lateness) - LATENESS_SURE / REAL(sqrt)(noise->known_lateness);
    return REAL(fmax)(0, noise->timing - (mean > 0 ? mean * mean : 0)); /* not for NaN */
}

/* Return factor + slope / information, at least 0: one step of Fisher scoring. 0 for NaN. */
static real scored(real factor, real slope, real information)
{
    const real found = information > 0 ? factor + slope / information : 0;
    return found > 0 ? found : 0;
}

void stewart_noise_learn(int m, const real *innovations, const real *variances, int p, const real *H,
                         const real *wander, int changes, const real *effects, real forgetting,
                         stewart_noise *noise)
{
    real wander_slope = 0, total = 0;
    noise->known_timing *= forgetting;
    noise->known_wander *= forgetting;
    noise->known_lateness *= forgetting;
    for (int i = 0; i < m; i++) {
        real W = 0, S = variances[i];
        total += innovations[i] * innovations[i] / S;
        for (int k = 0; k < p; k++) {
            const real change = H[(X + p) * i + X + k] * wander[k];
            W += change * change;
        }
        const real S_at_w = S - (noise->used - noise->wander) * W; /* not at the factor in use */
        S = S_at_w > S / 10 ? S_at_w : S / 10;
        const real excess_ratio = innovations[i] * innovations[i] / S - 1;
        wander_slope += W * (excess_ratio < ODD ? excess_ratio : ODD) / (2 * S);
        noise->known_wander += W * W / (2 * S * S);
    }
    real sum_a = 0, sum_a2 = 0, sum_b = 0, along_all = 0; /* a, b, r as in noise.h */
    for (int c = 0; c < changes; c++) {
        real a = 0, b = 0;
        for (int i = 0; i < m; i++) {
            const real k = effects[changes * i + c];
            a += k * innovations[i] / variances[i];
            b += k * k / variances[i];
        }
        sum_a += a;
        sum_a2 += a * a;
        sum_b += b;
        along_all += b > 0 ? a * a / b : 0;
        noise->known_timing += b * b / 2;
    }
    const real across = m > changes ? (total - along_all) / (real)(m - changes) : 1;
    const real r = across > 1 ? across : 1;
    const real timing_slope = (sum_a2 - sum_b * r) / 2;
    const real t = noise->timing > 1 ? noise->timing : 1;
    const real found = scored(noise->timing, timing_slope, noise->known_timing + ONE_TORQUE / (t * t));
    noise->timing = found < LATEST ? found : LATEST;
    noise->known_lateness += sum_b / r;
    if (noise->known_lateness > 0)
        noise->lateness += (sum_a - sum_b * noise->lateness) / r / noise->known_lateness;
    noise->wander = scored(noise->wander, wander_slope, noise->known_wander);
    const real excess = noise->wander - SURE / REAL(sqrt)(noise->known_wander);
    noise->used *= REAL(sqrt)(forgetting);
    if (excess > 0 || noise->timing > UNTIMELY) /* not for NaN */
        noise->asked += (real)m;
    if (WIDER * excess > noise->used)
        noise->used = WIDER * excess;
}

int stewart_changes(const stewart_interval *period) { return period->schedule.number + 1; }

void stewart_timing_effects(const stewart_machine *machine, const stewart_interval *period,
                            const real *state, const real *theta, real *effects)
{
    const stewart_schedule *schedule = &period->schedule;
    const int number = schedule->number;
    stewart_belief belief;
    real before[6], after[6], remaining = 0; /* s from the change of torque to the period's end */
    stewart_believe(machine, theta, &belief);
    for (int k = 0; k < number; k++)
        remaining += schedule->durations[k];
    stewart_accelerate(&belief, state, period->preceding, before);
    for (int k = 0; k <= number; k++, effects += X) {
        const real share = k == 0 || k == number ? SQRT_HALF : 1;
        const real *torque = k < number ? schedule->torques + U * k : period->following;
        stewart_accelerate(&belief, state, torque, after);
        for (int i = 0; i < 6; i++) {
            effects[6 + i] = share * (before[i] - after[i]);
            effects[i] = remaining * effects[6 + i];
            before[i] = after[i];
        }
        remaining = k + 1 < number ? remaining - schedule->durations[k] : 0;
    }
}
