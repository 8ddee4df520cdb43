/* See noise.h. */

#include "noise.h"
#include "short.h"

#define ONE_TORQUE ((real)0.5) /* information of one torque at t = 1: 1 / (2 t^2) */
#define SURE ((real)2.5)
#define WIDER 12
#define ODD 3       /* largest nu^2 / S - 1 of a value in the slope of w */
#define LATEST 1000 /* largest t */
#define UNTIMELY 4  /* t of torques that are off by twice the assumed standard deviation */

void stewart_noise_start(stewart_noise *noise)
{
    *noise = (stewart_noise){.timing = 1};
}

/* Fisher scoring of one factor; 0 for NaN. */
static real scored(real factor, real slope, real information)
{
    const real found = information > 0 ? factor + slope / information : 0;
    return found > 0 ? found : 0;
}

void stewart_noise_learn(int m, const real *innovations, const real *variances, const real *H,
                         int changes, const real *kicks, int p, const real *G, const real *wander,
                         real keep, stewart_noise *noise)
{
    real wander_slope = 0, all = 0;
    noise->known_timing *= keep;
    noise->known_wander *= keep;
    for (int i = 0; i < m; i++) {
        const real *h = H + X * i;
        real W = 0, S = variances[i];
        all += innovations[i] * innovations[i] / S;
        for (int k = 0; k < p; k++) {
            real change = 0;
            for (int j = 0; j < X; j++)
                change += h[j] * G[(X + p) * j + X + k];
            change *= wander[k];
            W += change * change;
        }
        const real S_at_w = S - (noise->used - noise->wander) * W; /* not at the factor in use */
        S = S_at_w > S / 10 ? S_at_w : S / 10;
        const real off = innovations[i] * innovations[i] / S - 1;
        wander_slope += W * (off < ODD ? off : ODD) / (2 * S);
        noise->known_wander += W * W / (2 * S * S);
    }
    real pulls = 0, squares = 0, along = 0;
    for (int c = 0; c < changes; c++) {
        real pull = 0, square = 0;
        for (int i = 0; i < m; i++) {
            const real k = stewart_dot(X, H + X * i, kicks + X * c);
            pull += k * innovations[i] / variances[i];
            square += k * k / variances[i];
        }
        pulls += pull * pull;
        squares += square;
        along += square > 0 ? pull * pull / square : 0;
        noise->known_timing += square * square / 2;
    }
    const real across = m > changes ? (all - along) / (real)(m - changes) : 1;
    const real timing_slope = (pulls - squares * (across > 1 ? across : 1)) / 2;
    const real t = noise->timing > 1 ? noise->timing : 1;
    const real found = scored(noise->timing, timing_slope, noise->known_timing + ONE_TORQUE / (t * t));
    noise->timing = found < LATEST ? found : LATEST;
    noise->wander = scored(noise->wander, wander_slope, noise->known_wander);
    const real excess = noise->wander - SURE / REAL(sqrt)(noise->known_wander);
    noise->used *= REAL(sqrt)(keep);
    if (excess > 0 || noise->timing > UNTIMELY) /* not for NaN */
        noise->asked += (real)m;
    if (WIDER * excess > noise->used)
        noise->used = WIDER * excess;
}

int stewart_changes(const stewart_interval *period) { return period->schedule.number + 1; }

void stewart_kicks(const stewart_machine *machine, const stewart_interval *period, const real *state,
                   const real *theta, real *kicks)
{
    const stewart_schedule *schedule = &period->schedule;
    const int number = schedule->number;
    stewart_belief belief;
    real before[6], after[6], left = 0; /* s from a change of torque to the end */
    stewart_believe(machine, theta, &belief);
    for (int k = 0; k < number; k++)
        left += schedule->durations[k];
    stewart_accelerate(&belief, state, period->preceding, before);
    for (int k = 0; k <= number; k++, kicks += X) {
        const real share = k == 0 || k == number ? SQRT_HALF : 1;
        const real *torque = k < number ? schedule->torques + U * k : period->following;
        stewart_accelerate(&belief, state, torque, after);
        for (int i = 0; i < 6; i++) {
            kicks[6 + i] = share * (before[i] - after[i]);
            kicks[i] = left * kicks[6 + i];
            before[i] = after[i];
        }
        left = k + 1 < number ? left - schedule->durations[k] : 0;
    }
}
