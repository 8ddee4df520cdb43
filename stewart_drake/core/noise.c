#include "noise.h"
#include "short.h"

#define ONE_TORQUE ((real)0.5) /* information of one torque at t = 1: 1 / (2 t^2) */
#define SIGNIFICANT ((real)2.5) /* standard deviations by which w exceeds 0 if it is significant */
#define LATENESS_SIGNIFICANT ((real)3.5) /* the same for l: friction causes a small one */
#define WIDER 12 /* factor on that excess: W is the change in one period, an effect lasts for many */
#define MOST_EXCESS 3 /* largest nu_i^2 / S_ii - 1 in the slope of w */
#define LARGEST_T 1000 /* largest t */
#define CHANGED_T 4  /* t at twice the assumed standard deviation */

void stewart_noise_start(stewart_noise *noise)
{
    *noise = (stewart_noise){.timing = 1};
}

real stewart_timing_scatter(const stewart_noise *noise)
{
    const real chance = LATENESS_SIGNIFICANT / REAL(sqrt)(noise->lateness_information);
    const real mean = REAL(fabs)(noise->lateness) - chance;
    return REAL(fmax)(0, noise->timing - (mean > 0 ? mean * mean : 0)); /* 0 for NaN */
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
    noise->timing_information *= forgetting;
    noise->wander_information *= forgetting;
    noise->lateness_information *= forgetting;
    for (int i = 0; i < m; i++) {
        real W = 0, S = variances[i];
        total += innovations[i] * innovations[i] / S;
        for (int k = 0; k < p; k++) {
            const real change = H[(X + p) * i + X + k] * wander[k];
            W += change * change;
        }
        const real S_at_w = S - (noise->wander_in_use - noise->wander) * W; /* not at the factor in use */
        S = S_at_w > S / 10 ? S_at_w : S / 10; /* above 0, also if W was most of it */
        const real excess_ratio = innovations[i] * innovations[i] / S - 1;
        wander_slope += W * (excess_ratio < MOST_EXCESS ? excess_ratio : MOST_EXCESS) / (2 * S);
        noise->wander_information += W * W / (2 * S * S);
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
        noise->timing_information += b * b / 2;
    }
    const real across = m > changes ? (total - along_all) / (real)(m - changes) : 1;
    const real r = across > 1 ? across : 1;
    const real timing_slope = (sum_a2 - sum_b * r) / 2;
    const real t = noise->timing > 1 ? noise->timing : 1;
    const real found = scored(noise->timing, timing_slope, noise->timing_information + ONE_TORQUE / (t * t));
    noise->timing = found < LARGEST_T ? found : LARGEST_T;
    noise->lateness_information += sum_b / r;
    if (noise->lateness_information > 0)
        noise->lateness += (sum_a - sum_b * noise->lateness) / r / noise->lateness_information;
    noise->wander = scored(noise->wander, wander_slope, noise->wander_information);
    const real excess = noise->wander - SIGNIFICANT / REAL(sqrt)(noise->wander_information);
    noise->wander_in_use *= REAL(sqrt)(forgetting);
    if (excess > 0 || noise->timing > CHANGED_T) /* not for NaN */
        noise->changed_values += (real)m;
    if (WIDER * excess > noise->wander_in_use)
        noise->wander_in_use = WIDER * excess;
}

int stewart_changes(const stewart_interval *period) { return period->schedule.number + 1; }

void stewart_timing_effects(const stewart_machine *machine, const stewart_interval *period,
                            const real *state, const real *theta, real *effects)
{
    const stewart_schedule *schedule = &period->schedule;
    const int number = schedule->number;
    stewart_model model;
    real before[6], after[6], remaining = 0; /* s from the change of torque to the period's end */
    stewart_set_model(machine, theta, &model);
    for (int k = 0; k < number; k++)
        remaining += schedule->durations[k];
    stewart_accelerate(&model, state, period->preceding, before);
    for (int k = 0; k <= number; k++, effects += X) {
        const real factor = k == 0 || k == number ? SQRT_HALF : 1;
        const real *torque = k < number ? schedule->torques + U * k : period->following;
        stewart_accelerate(&model, state, torque, after);
        for (int i = 0; i < 6; i++) {
            effects[6 + i] = factor * (before[i] - after[i]);
            effects[i] = remaining * effects[6 + i];
            before[i] = after[i];
        }
        remaining = k + 1 < number ? remaining - schedule->durations[k] : 0;
    }
}
